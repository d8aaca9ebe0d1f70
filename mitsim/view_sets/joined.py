"""Virtual measurements of a set of views: render every view in one random world, and measure the joined clouds.

Signal chain: day -> world (calibration, finish, light, temperature and position of the part shared by all views; noise
and speckle fresh in each) -> a cloud of each view -> assumed pose of each view, with its error -> points of every
feature in the part frame -> joining, by these poses or by best fit of all views to shapes they share -> measurement
-> error of every measurement.

A set of one view is measured like a single view. Joined points have no common viewpoint, and are fitted by their
orthogonal distances (:func:`characterisation.tasks.evaluation.measure_points`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from characterisation.features.best_fit import best_fit, motion_matrix
from characterisation.features.fits import belonging
from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import PointCloud
from characterisation.scores.joining import pose_covariance
from characterisation.tasks.evaluation import measure, measure_points
from mitsim.study import MINIMUM_POINTS, SetTable
from mitsim.views import View
from mitsim.virtual.rendered import RenderedMeasurements
from mitsim.virtual.trials import Outcome
from mitsim.virtual.world import Trial

Floats = NDArray[np.float64]

#: seed of the streams of pose errors, different from those of the groups of unknowns
_POSE_STREAM = 31


@dataclass(frozen=True)
class _Seen:
    """One view of a day: ``points`` (n, 3) [mm] of each feature, in the part frame by the assumed pose of the view."""

    points: dict[str, Floats]
    told: Floats
    cloud: PointCloud


class JoinedMeasurements:
    """A set of views of one part, prepared for virtual measurements of all views together."""

    def __init__(self, here: RenderedMeasurements, views: Sequence[View], table: SetTable) -> None:
        self.here, self.views, self.table = here, list(views), table
        self.centre = np.asarray(here.study.scene.centre, float)
        self.known = pose_covariance(*table.pose_known)

    def run(self, days: Iterable[int]) -> Iterable[tuple[int, Outcome]]:
        """Yield the outcome of every virtual measurement, day by day.

        Days with the same finish are consecutive.
        """
        draw = self.here.unknowns.draw
        order = sorted(days, key=lambda day: draw(Trial(day)).finish)
        for _, some in groupby(order, key=lambda day: draw(Trial(day)).finish):
            row = list(some)
            seen = [{day: self._measure_view(view, k, day) for day in row} for k, view in enumerate(self.views)]
            for day in row:
                yield day, self._measured([one[day] for one in seen], day)

    def _measure_view(self, view: View, place: int, day: int) -> _Seen:
        """Return the points of one view on one day; its ``place`` in the set is the number of its capture."""
        here, first = self.here, self.here.unknowns.draw(Trial(day))
        world = replace(here.unknowns.draw(Trial(day, place)), placed=first.placed, told=first.told)
        cloud, told = here.cloud_of(view, world)
        motion = motion_matrix(self._pose_error(place, day), self.centre) @ told.matrix()
        points = {}
        for name in here.study.task.shapes:
            some = cloud.of_feature(name)
            nominal = here.study.task.features[name].nominal(told.inverse().matrix())
            kept = some[belonging(some, nominal, cloud.grid.origin)] if len(some) else some
            points[name] = kept @ motion[:3, :3].T + motion[:3, 3]
        return _Seen(points, told.matrix(), cloud)

    def _pose_error(self, place: int, day: int) -> Floats:
        """Return the error of the assumed pose of a view, as a motion [w (rad), t (mm)]."""
        rng = np.random.default_rng(np.random.SeedSequence([self.here.unknowns.seed, _POSE_STREAM, day, place]))
        return np.asarray(np.sqrt(np.diag(self.known)) * rng.standard_normal(6))

    def _measured(self, seen: Sequence[_Seen], day: int) -> Outcome:
        task = self.here.study.task
        if len(seen) == 1:
            motion = np.linalg.inv(seen[0].told)
            found = measure(seen[0].cloud, task, motion, MINIMUM_POINTS, False)
        else:
            try:
                points = self._join(seen, day)
            except FitError as error:
                names = task.measurements
                return Outcome(dict.fromkeys(names, math.nan), dict.fromkeys(names, f"the views do not join: {error}"))
            found = measure_points(points, task, MINIMUM_POINTS, False)
        return Outcome.of(found)

    def _join(self, seen: Sequence[_Seen], day: int) -> dict[str, Floats]:
        """Return the points of every feature from all views together."""
        motions = [np.eye(4)] * len(seen)
        if self.table.joining == "best_fit":
            task = self.here.study.task
            shapes = {name: task.features[name].nominal() for name in task.shapes}
            motions = best_fit([one.points for one in seen], shapes, self.centre, self.known, day)
        return {
            name: np.concatenate(
                [one.points[name] @ motion[:3, :3].T + motion[:3, 3] for one, motion in zip(seen, motions, strict=True)]
            )
            for name in seen[0].points
        }
