"""Virtual measurements from the map: clouds drawn by the talk's method, with the same unknowns as rendered ones.

Signal chain: view and trial -> draw (:mod:`mitsim.study.virtual.world`) -> F and sigma of every pixel from the map,
with random errors and spread of the map -> P + R_N sigma V, with the measured correlation of neighbours, kept if R_U <
F -> displacement of ideal points by the true calibration (:func:`mitsim.study.calibration.accuracy.measured_points`) ->
path, temperature and form -> measurement at the assumed pose -> error of every measurement -> plus effects outside the
map (:mod:`mitsim.study.virtual.beyond_map`), in units of the predicted uncertainty of the view.

A sensor that was characterised on hardware, without a simulated twin, allows only this kind of virtual measurement. The
map contains what flat coupons show. It does not contain edges, curved faces, interreflections, clusters of false
matches, or the light of the user's room.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.maps.lay import LAY_FIELDS, LAY_NODES
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud
from characterisation.tasks.evaluation import measure
from characterisation.tasks.folded import folded_values
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign.acquire import one_ahead
from mitsim.maps.prediction import CharacterisedScene, Predictor
from mitsim.maps.prediction.shared_errors import terms
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.sensor.sensor import Sensor
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.study.calibration.accuracy import measured_points
from mitsim.study.virtual.beyond_map import beyond_map
from mitsim.study.virtual.displacement import RealFaces
from mitsim.study.virtual.form import measured_with_form
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.screening import screen
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.world import BEYOND, DrawnValues, Unknowns
from mitsim.views import View

#: number of points of a cloud whose displacement by the calibration is computed; a polynomial of direction and inverse
#: distance interpolates between them
_POINTS = 600

#: number of drawn maps that are kept: views are compared with the same draws
_MAPS = 32

#: dimensions of a map's nodes, and limits of the fields of which errors and spread are drawn
_NODES = ("sample", "distance", "b", "a")
_LIMITS = {"recovered_fraction": (0.0, 1.0), "ray_noise_std": (1e-6, np.inf)}

#: reason of a measurement without a value that screening rates as impossible
_NOT_PREDICTED = "by the map, too few points are recovered in this view"


class MappedMeasurements:
    """The map of a sensor, prepared for virtual measurements of one part."""

    source = "map"

    def __init__(self, study: Study, unknowns: Unknowns) -> None:
        assert study.performance_map is not None
        self.study, self.unknowns, self.performance_map = study, unknowns, study.performance_map
        self.geometry = sensor_geometry(study.sensor)
        self.predictor = Predictor.of_sensor(study.sensor, self.geometry)
        self._characterised: dict[int, CharacterisedScene] = {}
        self.faces = RealFaces(study.scene, study.task, unknowns.table)
        self._beyond_sizes = beyond_map().of(study.sensor) if BEYOND in unknowns.varied else None
        self._predicted: dict[int, dict[str, float]] = {}
        self._folded = folded_values(study.task)

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Outcome]]:
        """Yield the outcome of every virtual measurement, job by job.

        A cloud is fitted while the next is drawn.
        """
        jobs = list(jobs)
        if self._beyond_sizes is not None:
            self._predict({job.view.number: job.view for job in jobs})
        return one_ahead(jobs, self._take, self._finish)

    def _take(self, job: Job) -> tuple[PointCloud, DrawnValues, NDArray[np.int16], Surfaces | None]:
        drawn = self.unknowns.draw(job.trial)
        true, assumed = (motion.inverse() @ job.view.world_from_sensor for motion in (drawn.placed, drawn.assumed))
        rng = np.random.default_rng(drawn.seed)
        cloud = self.predictor.predict(self._scene(drawn.finish), true, rng, correlated=True)
        labels = self.predictor.quick_labels(self.study.scene, assumed)
        surfaces = self.predictor.surfaces(self.study.scene, assumed) if self.faces.lie_off(drawn) else None
        return cloud, drawn, labels, surfaces

    def _finish(self, drawing: tuple[PointCloud, DrawnValues, NDArray[np.int16], Surfaces | None], job: Job) -> Outcome:
        cloud, drawn, labels, surfaces = drawing
        assumed = drawn.assumed.inverse() @ job.view.world_from_sensor
        cloud = replace(cloud, points=moved_by_calibration(cloud, self.study.sensor, drawn))

        def evaluate(task: Task, with_form: bool) -> dict[str, Result]:
            labelled = self.faces.labelled(cloud, drawn, assumed, surfaces, labels, with_form)
            return measure(labelled, task, assumed.inverse().matrix(), MINIMUM_POINTS, False)

        results = measured_with_form(self.study.task, evaluate, self.faces.deviate(drawn))
        return self._with_beyond(Outcome.of(results), job.view, drawn)

    def _predict(self, views: dict[int, View]) -> None:
        """Compute and keep the predicted uncertainties of views."""
        new = [view for number, view in views.items() if number not in self._predicted]
        if not new:
            return
        study = replace(self.study, candidates=replace(self.study.candidates, views=new))
        scores, _ = screen(study, self.predictor, self.performance_map, self.unknowns)
        predicted = scores["predicted_uncertainty"].transpose("view", "measurement").values
        for view, row in zip(new, predicted.tolist(), strict=True):
            self._predicted[view.number] = dict(zip(scores["measurement"].values.tolist(), row, strict=True))

    def _with_beyond(self, outcome: Outcome, view: View, drawn: DrawnValues) -> Outcome:
        """Add effects outside the map, randomly directed for folded values; NaN for impossible measurements."""
        if self._beyond_sizes is None:
            return outcome
        sizes = self._beyond_sizes.draw(np.random.default_rng(drawn.beyond), len(outcome.errors))
        predicted = self._predicted[view.number]
        added = {name: predicted[name] * float(size) for name, size in zip(outcome.errors, sizes, strict=True)}
        errors = {name: error + added[name] for name, error in outcome.errors.items()}
        deviations = {}
        for name, rows in outcome.deviations.items():
            folded = self._folded[name]
            moved = folded.moved(np.reshape(rows, folded.shape), added[name], drawn.beyond)
            errors[name] = folded.error(moved)
            deviations[name] = moved.ravel().tolist()
        impossible = {name: _NOT_PREDICTED for name in errors if not np.isfinite(predicted[name])}
        return Outcome(errors, impossible | dict(outcome.reasons), deviations)

    def _scene(self, finish: int) -> CharacterisedScene:
        if finish not in self._characterised:
            if len(self._characterised) >= _MAPS:
                self._characterised.pop(next(iter(self._characterised)))
            drawn = drawn_map(self.performance_map, self.unknowns, finish)
            self._characterised[finish] = CharacterisedScene(self.study.scene, drawn)
        return self._characterised[finish]


def drawn_map(performance_map: PerformanceMap, unknowns: Unknowns, finish: int) -> PerformanceMap:
    """Return the map with random errors and spread of finishes; -1 returns the map unchanged.

    The spread is one draw for a whole sample, scaled like the finishes of rendered measurements. Errors of the map are
    drawn for every node, and for every node of each direction of a lay, of which a face with a known lay has no spread.
    """
    if finish < 0:
        return performance_map
    data = performance_map.data.copy(deep=True)
    for name, common, error in _map_draws(performance_map, unknowns, finish):
        values = data[name].transpose(*_NODES).values
        moved = values.copy()
        for suffix, draw in (("spread", common[:, None, None, None] * unknowns.table.finish.alpha), ("error", error)):
            if f"{name}_{suffix}" in data:
                moved = moved + np.nan_to_num(data[f"{name}_{suffix}"].transpose(*_NODES).values) * draw
        data[name] = (_NODES, np.clip(moved, *_LIMITS[name]))
    rng = np.random.default_rng(np.random.SeedSequence([unknowns.seed, 102, finish]))
    for name, limits in _LIMITS.items():
        stored = LAY_FIELDS[name]
        if stored in data:
            values, error = (data[one].transpose(*LAY_NODES).values for one in (stored, LAY_FIELDS[f"{name}_error"]))
            data[stored] = (
                LAY_NODES,
                np.clip(values + np.nan_to_num(error) * rng.standard_normal(error.shape), *limits),
            )
    return PerformanceMap(data)


def drawn_spread(study: Study, unknowns: Unknowns, finish: int) -> Floats:
    """Return the numbers (2 s,) that the spread of finishes drew for the map's s samples; 0 at the best estimate."""
    performance_map = study.performance_map
    assert performance_map is not None
    used = set[int]()
    for material in study.scene.finishes:
        if material is not None:
            with suppress(InputError):  # a surface that no view shows
                members, rough = performance_map.known.representing(material.name, material.roughness, material.light)
                index = int(np.searchsorted(performance_map.known.roughness[members], rough))
                used |= set(members if math.isnan(rough) else members[max(index - 1, 0) : index + 1])
    draws = [common for _, common, _ in _map_draws(performance_map, unknowns, finish)] if finish >= 0 else []
    return np.array([draw[sorted(used)] for draw in draws] or np.zeros((2, len(used)))).ravel()


def _map_draws(
    performance_map: PerformanceMap, unknowns: Unknowns, finish: int
) -> Iterator[tuple[str, Floats, Floats]]:
    """Yield F and sigma with the draws of their spread, by sample (s,), and of their errors, by node."""
    rng = np.random.default_rng(np.random.SeedSequence([unknowns.seed, 101, finish]))
    shape = tuple(performance_map.data.sizes[name] for name in _NODES)
    for name in _LIMITS:
        yield name, rng.standard_normal(shape[0]), rng.standard_normal(shape)


def moved_by_calibration(cloud: PointCloud, sensor: Sensor, drawn: DrawnValues) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm] as the nominal calibration places them if the drawn rig is the true one.

    The second camera of the true rig has the misalignment of the sensor file, as in a rendered measurement. Parameters
    of a time-of-flight path are excluded; :func:`mitsim.study.virtual.displacement.displaced` applies them.
    """
    valid = cloud.valid
    points = cloud.points[valid].astype(float)
    if len(points) < 4:
        return cloud.points
    sample = points[:: max(1, len(points) // _POINTS)]
    moves = measured_points(sensor, sample, sensor.misaligned(drawn.rig)) - measured_points(sensor, sample, sensor.rig)
    fine = np.isfinite(moves).all(axis=1)
    if fine.sum() < 40:
        return cloud.points
    solution, *_ = np.linalg.lstsq(terms(sample[fine]), moves[fine], rcond=None)
    out = cloud.points.copy()
    out[valid] = points + terms(points) @ solution
    return out
