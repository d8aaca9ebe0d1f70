"""The measurements of a task in a cloud, at a pose of the part, as a study makes them.

Signal chain: cloud, scene and pose -> the shape of the part that each pixel shows, away from edges -> fits and values
with standard uncertainties (:func:`characterisation.tasks.evaluation.measure`) -> the bias of a statement subtracted,
where asked.

A statement belongs to a sensor, a part and a view. It is refused for another sensor or other measurements, and where
the sensor stands elsewhere: its bias changes with the view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.checked_files import read_json_object
from characterisation.errors import InputError
from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import PointCloud
from characterisation.tasks.evaluation import fit_features, measure
from characterisation.tasks.task_file import Task
from mitsim.measuring.result import Result, failed
from mitsim.prediction.predictor import EDGE_MARGIN_PX, Predictor
from mitsim.scene.load import Scene
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.transforms import Transform

#: a part is placed and a sensor stands as a statement says if they differ by no more than this [mm], [deg]
SAME_PLACE_MM, SAME_ANGLE_DEG = 10.0, 2.0


@dataclass(frozen=True)
class Correction:
    """Bias and standard uncertainty after its correction of one measurement, in its unit."""

    unit: str
    bias: float
    uncertainty: float


@dataclass(frozen=True)
class StatedView:
    """What a ``statement.json`` says of a view: its sensor, its pose, and the correction of each measurement."""

    path: Path
    sensor: str
    world_from_sensor: Transform
    corrections: Mapping[str, Correction]

    def check(self, sensor: str, pose: Transform) -> None:
        """Refuse to correct what was taken by another sensor, or from elsewhere.

        Raises
        ------
        InputError
            If so.
        """
        if sensor != self.sensor:
            raise InputError(self.path, "sensor", self.sensor, f"{sensor}, which took the cloud")
        between = self.world_from_sensor.inverse() @ pose
        moved = float(np.linalg.norm(between.translation))
        turned = math.degrees(math.acos(min(max((float(np.trace(between.rotation)) - 1) / 2, -1.0), 1.0)))
        if moved > SAME_PLACE_MM or turned > SAME_ANGLE_DEG:
            raise InputError(
                self.path,
                "world_from_sensor",
                f"a view {moved:.1f} mm and {turned:.1f} deg from the cloud's",
                f"up to {SAME_PLACE_MM:g} mm and {SAME_ANGLE_DEG:g} deg: a bias belongs to its view",
                "state this view: mitsim budget STUDY --view N",
            )


def measure_task(
    cloud: PointCloud,
    task: Task,
    scene: Scene,
    world_from_sensor: Transform,
    stated: StatedView | None = None,
    margin_px: int = 0,
) -> list[Result]:
    """Measure a task in a cloud of a part whose pose is known to some mm.

    Points within ``margin_px`` of the edge of a shape, and at least within three pixels, belong to none.

    Raises
    ------
    InputError
        If the statement is not of this sensor, view and task.
    """
    if stated is not None:
        stated.check(cloud.sensor, world_from_sensor)
    results = measure_labelled(labelled_cloud(cloud, scene, world_from_sensor, margin_px), task, world_from_sensor)
    return results if stated is None else [corrected(one, stated) if one.possible else one for one in results]


def labelled_cloud(cloud: PointCloud, scene: Scene, world_from_sensor: Transform, margin_px: int = 0) -> PointCloud:
    """A cloud with the shape of a part that each pixel shows; -1 within ``margin_px`` of an edge, at least 3 px."""
    labels = _grid_predictor(cloud, max(margin_px, EDGE_MARGIN_PX)).quick_labels(scene, world_from_sensor)
    return replace(cloud, feature=labels, feature_names=scene.names)


def measure_labelled(labelled: PointCloud, task: Task, world_from_sensor: Transform) -> list[Result]:
    """Measure a task in a cloud whose pixels are told to the shapes of a part, which has all that the task names."""
    assert labelled.feature is not None
    sensor_from_part = world_from_sensor.inverse().matrix()
    found = measure(labelled, task, sensor_from_part)
    fits = fit_features(labelled, task, sensor_from_part)
    used = {name: 0 if isinstance(fit, FitError) else fit.count for name, fit in fits.items()}
    results = []
    for name, one in found.items():
        asked = task.measurements[name]
        shapes = [labelled.feature_names.index(shape) for shape in task.shapes_for(name)]
        given = int((np.isin(labelled.feature, shapes) & labelled.valid).sum())
        if not one.possible:
            results.append(failed(name, asked.unit, one.reason, points_given=given))
            continue
        points = sum(used[feature] for feature in task.fitted_for(name))
        results.append(
            Result(name, asked.unit, one.value, one.standard_uncertainty, "fit", points, given, nominal=asked.nominal)
        )
    return results


def corrected(result: Result, stated: StatedView) -> Result:
    """Subtract the bias that a statement has of a measurement; the uncertainty is then the statement's.

    Raises
    ------
    InputError
        If the statement does not know the measurement, in its unit, or knows no bias.
    """
    if result.name not in stated.corrections:
        known = ", ".join(stated.corrections)
        raise InputError(stated.path, "measurements", known, f"{result.name}, which the task asks for")
    correction = stated.corrections[result.name]
    if correction.unit != result.unit or not math.isfinite(correction.bias):
        found = f"bias {correction.bias:g} {correction.unit}"
        raise InputError(stated.path, f"measurements.{result.name}", found, f"a bias in {result.unit}")
    return replace(
        result,
        value=result.value - correction.bias,
        bias=correction.bias,
        uncertainty=correction.uncertainty,
        origin="statement",
    )


def read_stated_view(path: Path) -> StatedView:
    """Read what a ``statement.json`` corrects.

    Raises
    ------
    InputError
        If it cannot be read, or is none.
    """
    table = _json(path, "a statement.json of mitsim run or mitsim budget")
    try:
        corrections = {
            str(name): Correction(
                str(one["unit"]),
                _number(one["bias"]),
                math.hypot(_number(one["standard_uncertainty"]), _number(one["bias_uncertainty"])),
            )
            for name, one in table["measurements"].items()
        }
        pose = Transform.from_matrix(np.array(table["world_from_sensor"], float).reshape(4, 4))
        return StatedView(path, str(table["sensor"]), pose, corrections)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, "", f"a file that is no statement ({error!r})", "a statement.json") from None


def read_pose(path: Path, view: int | None = None) -> Transform:
    """``world_from_sensor`` of a pose.json, a statement.json, or one view of a poses.json.

    Raises
    ------
    InputError
        If the file cannot be read, holds no pose, or no such view.
    """
    table = _json(path, "pose.json of a capture, poses.json of a run, or statement.json")
    matrix = table.get("world_from_sensor")
    if "views" in table:
        try:
            known = {int(one["view"]): one["part_from_sensor"] for one in table["views"]}
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                path, "views", f"what does not make sense ({error!r})", "as mitsim run writes it"
            ) from None
        if view not in known:
            raise InputError(
                "--view",
                "",
                "none" if view is None else view,
                f"a view of {path}: {min(known, default=0)} to {max(known, default=0)}",
            )
        matrix = known[view]
    try:
        pose = Transform.from_matrix(np.array(matrix, float).reshape(4, 4))
    except (TypeError, ValueError):
        raise InputError(path, "world_from_sensor", repr(matrix)[:60], "a 4 x 4 matrix, rows first [mm]") from None
    if not np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(pose.rotation) < 0:
        raise InputError(path, "world_from_sensor", "a matrix that is no rigid motion", "a rotation and a place in mm")
    return pose


def _grid_predictor(cloud: PointCloud, margin_px: int) -> Predictor:
    """What labels a cloud: its grid is all that it takes, so the eyes of the rig do not matter."""
    grid = cloud.grid
    matrix = np.array([[grid.fx, 0, grid.cx], [0, grid.fy, grid.cy], [0, 0, 1]])
    camera = Camera(matrix, np.zeros(0), grid.width, grid.height, Transform(grid.rotation, grid.origin))
    return Predictor(Rig({"grid": camera}), grid, np.ones((grid.height, grid.width), bool), cloud.sensor, margin_px)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _json(path: Path, what: str) -> dict[str, Any]:
    return read_json_object(path, what)
