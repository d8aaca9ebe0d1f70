"""Screen the candidate views of a study; runs and validations use this one function.

Signal chain: study -> displacement fields of the errors of its calibration and temperature, and interreflections if
faces see one another -> scores (:mod:`mitsim.views.view_scores`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.maps.performance_map import PerformanceMap
from characterisation.tasks.measurement_model import InputQuantity
from mitsim.maps.prediction import Effect, Predictor
from mitsim.maps.prediction.interreflections import InterreflectionEffect
from mitsim.maps.prediction.shared_errors import SharedErrors, independent_fields
from mitsim.running.time_limit import TimeLimit
from mitsim.scene.ray_casting.self_view import sees_itself
from mitsim.sensor.rig_parameters import moved, path_error
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.working_volume import in_image
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.study.calibration.accuracy import measured_points
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.world import Unknowns, warmed
from mitsim.views.scoring_time import scoring_order
from mitsim.views.view_scores import score_candidates

#: number of places along each axis of the box around a part for which displacements are computed; chosen
_RASTER = 4

#: about the largest number of places in all views together, which bounds the time; chosen
_PLACES = 4000

#: largest distance [mm] between a place and its reconstruction by the nominal rig
_FOUND_AGAIN_MM = 1e-3


def screen(
    study: Study,
    predictor: Predictor,
    performance_map: PerformanceMap,
    unknowns: Unknowns | None = None,
    limit: TimeLimit | None = None,
) -> tuple[xr.Dataset, list[dict[InputQuantity, Any]]]:
    """Score all views of a study; see :func:`mitsim.views.view_scores.score_candidates`.

    Parameters
    ----------
    study
        Part, task, sensor and views.
    predictor
        Of the sensor.
    performance_map
        F and sigma of the sensor.
    unknowns
        Those of the study, if the caller has prepared them: a calibration may take seconds to simulate.
    limit
        Time of the scoring; by default all views are scored.
    """
    effects = effects_of(study, study_unknowns(study) if unknowns is None else unknowns, limit)
    return score_candidates(
        study.scene, study.task, study.views, predictor, performance_map, MINIMUM_POINTS, effects, limit
    )


def effects_of(study: Study, unknowns: Unknowns, limit: TimeLimit | None = None) -> list[Effect]:
    """Return the effects that screening includes beyond the map; views follow one another as within the ``limit``."""
    effects: list[Effect] = [shared_errors(study, unknowns)]
    depth = study.file.score.light_path_depth
    if depth > 1 and sees_itself(study.scene):
        poses = [study.views[index].world_from_sensor for index in scoring_order(study.views, limit)]
        effects.append(InterreflectionEffect(study.sensor, depth, poses=poses))
    return effects


def shared_errors(study: Study, unknowns: Unknowns) -> SharedErrors:
    """Return displacement fields of calibration, temperature and misalignment over the volume of the views."""
    sensor, calibration, temperature = study.sensor, unknowns.calibration, unknowns.table.temperature
    points = _places(study)
    values, vectors = np.linalg.eigh(calibration.correlation)
    root = calibration.one_sigma[:, None] * vectors * np.sqrt(np.clip(values, 0, None))
    causes = [(calibration.names, column) for column in root.T]
    causes.append(warmed(sensor.rig, temperature, temperature.sensor_kelvin))
    points = points[_measurable(sensor, points)]
    nominal = measured_points(sensor, points, sensor.rig)
    moves = [
        measured_points(sensor, points, moved(sensor.rig, names, step), path_error(names, step)) - nominal
        for names, step in causes
    ]
    if sensor.true_rig is not sensor.rig:
        moves.append(measured_points(sensor, points, sensor.true_rig) - nominal)
    return independent_fields(points, np.array(moves))


def _places(study: Study) -> Floats:
    """Return places (n, 3) [mm] in the sensor frame: a grid over the box around the part, in some of the views."""
    low, high = study.scene.bounds
    steps = np.linspace(0, 1, _RASTER)
    box = low + np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3) * (high - low)
    views = study.views[:: max(1, len(study.views) * len(box) // _PLACES)]
    return np.concatenate([view.world_from_sensor.inverse().points(box) for view in views])


def _measurable(sensor: Sensor, points: Floats) -> NDArray[np.bool_]:
    """Return which points (n, 3) all measuring eyes see and the nominal rig reconstructs."""
    rig = sensor.measuring_rig
    eyes = list(rig.cameras.values())
    if rig.projector is not None and len(eyes) == 1 and sensor.technology != "time_of_flight":
        eyes.append(rig.projector)
    seen = np.all([in_image(eye, points) for eye in eyes], axis=0)
    off = np.linalg.norm(measured_points(sensor, points, sensor.rig) - points, axis=1)
    return np.asarray(seen & (off < _FOUND_AGAIN_MM))
