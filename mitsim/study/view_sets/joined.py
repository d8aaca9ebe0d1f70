"""Virtual measurements of a set of views: render every view with one draw of the unknowns, and measure joined clouds.

Signal chain: day -> draw (calibration, finish, light, temperature and position of the part shared by all views; noise
and speckle fresh in each) -> a cloud of each view -> assumed pose of each view, with its error -> points of every
feature in the part frame -> joining, by these poses or by best fit of all views to shapes they share -> measurement
-> error of every measurement.

A set of one view is measured like a single view. Joined points have no common viewpoint, and are fitted by their
orthogonal distances (:func:`characterisation.tasks.evaluation.measure_points`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from characterisation.features.best_fit import best_fit, motion_matrix
from characterisation.features.fits import belonging
from characterisation.features.robust_fit import SMALLEST_SCALE, FitError
from characterisation.features.starts import rounding_scale
from characterisation.files.arrays import Floats
from characterisation.scores.joining import pose_covariance
from characterisation.tasks.evaluation import measure_points
from mitsim.study import MINIMUM_POINTS, SetTable
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.world import Trial
from mitsim.views import View

#: seed of the streams of pose errors, different from those of the groups of unknowns
_POSE_STREAM = 31


class JoinedMeasurements:
    """A set of views of one part, prepared for virtual measurements of all views together."""

    def __init__(self, renderer: RenderedMeasurements, views: Sequence[View], table: SetTable) -> None:
        self.renderer, self.views, self.table = renderer, list(views), table
        self.centre = np.asarray(renderer.study.scene.centre, float)
        self.covariance = pose_covariance(*table.pose_known)

    def run(self, days: Iterable[int]) -> Iterable[tuple[int, Outcome]]:
        """Yield the outcome of every virtual measurement, day by day."""
        if len(self.views) == 1:
            jobs = [Job(self.views[0], Trial(day)) for day in days]
            yield from ((job.trial.day, outcome) for job, outcome in self.renderer.run(jobs))
            return
        for day in days:
            yield day, self._measured([self._measure_view(view, k, day) for k, view in enumerate(self.views)], day)

    def _measure_view(self, view: View, number: int, day: int) -> dict[str, tuple[Floats, float]]:
        """Return the points (n, 3) [mm] of each feature of one view on one day, part frame by its assumed pose.

        With them comes the least scale [mm] of their residuals. The ``number`` of the view is that of its capture.
        """
        renderer, first = self.renderer, self.renderer.unknowns.draw(Trial(day))
        drawn = replace(renderer.unknowns.draw(Trial(day, number)), placed=first.placed, assumed=first.assumed)
        cloud, assumed = renderer.cloud_of(view, drawn)
        rng = np.random.default_rng(np.random.SeedSequence([renderer.unknowns.seed, _POSE_STREAM, day, number]))
        # error of the assumed pose, a motion [w (rad), t (mm)]
        error = np.sqrt(np.diag(self.covariance)) * rng.standard_normal(6)
        motion = motion_matrix(error, self.centre) @ assumed.matrix()
        points = {}
        for name in renderer.study.task.shapes:
            face_points = cloud.of_feature(name)
            nominal = renderer.study.task.features[name].nominal(assumed.inverse().matrix())
            kept = face_points[belonging(face_points, nominal, cloud.grid.origin)] if len(face_points) else face_points
            scale = rounding_scale(kept, nominal) if len(kept) else SMALLEST_SCALE
            points[name] = kept @ motion[:3, :3].T + motion[:3, 3], scale
        return points

    def _measured(self, measured: Sequence[dict[str, tuple[Floats, float]]], day: int) -> Outcome:
        task = self.renderer.study.task
        try:
            points = self._join(measured, day)
        except FitError as error:
            names = task.measurements
            return Outcome(dict.fromkeys(names, math.nan), dict.fromkeys(names, f"the views do not join: {error}"))
        return Outcome.of(measure_points(points, task, MINIMUM_POINTS, False))

    def _join(self, measured: Sequence[dict[str, tuple[Floats, float]]], day: int) -> dict[str, Floats]:
        """Return the points of every feature from all views together."""
        views = [{name: points for name, (points, _) in view.items()} for view in measured]
        motions = [np.eye(4)] * len(views)
        if self.table.joining == "best_fit":
            task = self.renderer.study.task
            shapes = {name: task.features[name].nominal() for name in task.shapes}
            scales = [{name: scale for name, (_, scale) in view.items()} for view in measured]
            motions = best_fit(views, shapes, self.centre, self.covariance, day, scales)
        return {
            name: np.concatenate(
                [points[name] @ motion[:3, :3].T + motion[:3, 3] for points, motion in zip(views, motions, strict=True)]
            )
            for name in views[0]
        }
