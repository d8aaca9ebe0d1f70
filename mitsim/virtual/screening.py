"""Screening: scores of all candidates of a study, by the one function that runs and validations both use.

Signal chain: study -> fields of what its calibration and temperature leave open, and light by way of other surfaces
where faces see one another -> scores (:mod:`mitsim.score`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.maps.performance_map import PerformanceMap
from characterisation.tasks.measuring import InputQuantity
from mitsim.calibration.accuracy import measured_points
from mitsim.predict import Effect, Predictor
from mitsim.predict.other_light import OtherLightEffect
from mitsim.predict.shared_errors import SharedErrors, independent_fields
from mitsim.scene.self_view import sees_itself
from mitsim.score import score_candidates
from mitsim.sensor.rig_parameters import moved, path_error
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.virtual.plan import study_unknowns
from mitsim.virtual.world import Unknowns, scaled_baseline, scaled_focal

Floats = NDArray[np.float64]

#: rays, along rows and columns of the image, and distances at which displacements are taken
_RAYS, _DISTANCES = 9, 6


def screen(
    study: Study, predictor: Predictor, performance_map: PerformanceMap
) -> tuple[xr.Dataset, list[dict[InputQuantity, Any]]]:  # fmt: skip
    """Score all views of a study: see :func:`mitsim.score.score_candidates`."""
    return score_candidates(
        study.scene, study.task, study.views, predictor, performance_map, MINIMUM_POINTS, effects_of(study)
    )


def effects_of(study: Study) -> list[Effect]:
    """All that is allowed for beside the map."""
    effects: list[Effect] = [shared_errors(study, study_unknowns(study))]
    depth = study.file.score.light_path_depth
    if depth > 1 and sees_itself(study.scene):
        effects.append(OtherLightEffect(study.sensor, depth))
    return effects


def shared_errors(study: Study, unknowns: Unknowns) -> SharedErrors:
    """Fields of what the calibration and the sensor's temperature leave open, over the volume that views look at."""
    sensor, calibration, temperature = study.sensor, unknowns.calibration, unknowns.table.temperature
    points = _places(study)
    values, vectors = np.linalg.eigh(calibration.correlation)
    root = calibration.one_sigma[:, None] * vectors * np.sqrt(np.clip(values, 0, None))
    causes = [(calibration.names, column) for column in root.T]
    causes += [
        scaled_baseline(sensor.rig, temperature.body_per_kelvin * temperature.sensor_kelvin),
        scaled_focal(sensor.rig, temperature.focal_per_kelvin * temperature.sensor_kelvin),
    ]
    nominal = measured_points(sensor, points, sensor.rig)
    moves = [
        measured_points(sensor, points, moved(sensor.rig, names, step), path_error(names, step)) - nominal
        for names, step in causes
    ]
    return independent_fields(points, np.array(moves))


def _places(study: Study) -> Floats:
    """Places (n, 3) [mm] in the sensor frame, on rays of the whole image, where the parts of views stand."""
    camera = study.sensor.rig.reference
    size = float(np.linalg.norm(np.ptp(study.scene.bounds, axis=0))) / 2
    standoffs = [view.standoff for view in study.views]
    near = max(min(standoffs) - size, 0.3 * min(standoffs))
    distances = 1 / np.linspace(1 / near, 1 / (max(standoffs) + size), _DISTANCES)
    columns, rows = (np.linspace(0, count - 1, _RAYS) for count in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    rays = camera.sensor_from_camera.directions(camera.rays(pixels))
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray((camera.centre + rays * distances[:, None, None]).reshape(-1, 3))
