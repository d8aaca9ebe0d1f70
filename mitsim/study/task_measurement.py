"""Measure a task in a cloud, at a known pose of the part, as a study does.

Signal chain: cloud, scene and pose -> label of each pixel, the shape of the part that it shows, away from edges -> fits
and values with standard uncertainties (:func:`characterisation.tasks.evaluation.measure`) -> bias subtracted, if a
statement of uncertainty is given.

A statement holds for one sensor, part and view, because its bias changes with the view. It is rejected for another
sensor, for a measurement that it lacks, and for another pose of the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.checked_files import read_json_object
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.tasks.evaluation import measure
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from mitsim.maps.prediction.predictor import EDGE_MARGIN_PX, Predictor
from mitsim.scene.load import Scene
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.transforms import Transform

#: largest difference between the sensor's pose and that of a statement [mm], [deg]
SAME_PLACE_MM, SAME_ANGLE_DEG = 10.0, 2.0


@dataclass(frozen=True)
class Correction:
    """Bias of one measurement, and its standard uncertainty after the bias is subtracted, both in ``unit``."""

    unit: str
    bias: float
    uncertainty: float


@dataclass(frozen=True)
class ViewStatement:
    """Statement of uncertainty for one view, from the ``statement.json`` at ``path``.

    ``sensor`` is its name; ``world_from_sensor`` is the pose of the view; ``corrections`` are by measurement.
    """

    path: Path
    sensor: str
    world_from_sensor: Transform
    corrections: Mapping[str, Correction]

    def check(self, sensor: str, pose: Transform) -> None:
        """Check that a cloud's sensor and its ``pose``, world from sensor, are those of the statement.

        Raises
        ------
        InputError
            If the sensor differs, or the pose by more than :data:`SAME_PLACE_MM` or :data:`SAME_ANGLE_DEG`.
        """
        if sensor != self.sensor:
            raise InputError(self.path, "sensor", self.sensor, f"{sensor}, the sensor of the cloud")
        difference = self.world_from_sensor.inverse() @ pose
        distance_mm = float(np.linalg.norm(difference.translation))
        rotation_deg = math.degrees(math.acos(min(max((float(np.trace(difference.rotation)) - 1) / 2, -1.0), 1.0)))
        if distance_mm > SAME_PLACE_MM or rotation_deg > SAME_ANGLE_DEG:
            raise InputError(
                self.path,
                "world_from_sensor",
                f"a view {distance_mm:.1f} mm and {rotation_deg:.1f} deg from that of the cloud",
                f"up to {SAME_PLACE_MM:g} mm and {SAME_ANGLE_DEG:g} deg: a bias holds only for its view",
                "make a statement for this view: mitsim study state STUDY --view N",
            )


def measure_task(
    cloud: PointCloud,
    task: Task,
    scene: Scene,
    world_from_sensor: Transform,
    statement: ViewStatement | None = None,
    margin_px: int = 0,
) -> list[Result]:
    """Measure a task in a cloud of a part whose pose is known within a few mm.

    Parameters
    ----------
    cloud
        Organised cloud in the sensor frame [mm].
    task, scene
        Measurements, and the part that they refer to.
    world_from_sensor
        Pose of the sensor in the part frame.
    statement
        Its biases are subtracted; None subtracts nothing.
    margin_px
        Pixels closer to the edge of a shape than this, and at least 3 px, are not used.

    Returns
    -------
    list of Result
        One for each measurement of the task, in mm or deg.

    Raises
    ------
    InputError
        If the statement is for another sensor or view, or lacks a measurement.
    """
    if statement is not None:
        statement.check(cloud.sensor, world_from_sensor)
    results = measure_labelled(labelled_cloud(cloud, scene, world_from_sensor, margin_px), task, world_from_sensor)
    return results if statement is None else [corrected(one, statement) if one.possible else one for one in results]


def labelled_cloud(cloud: PointCloud, scene: Scene, world_from_sensor: Transform, margin_px: int = 0) -> PointCloud:
    """Label each pixel of a cloud with the shape of the part that it shows.

    The label is the index in ``scene.names``. It is -1 within ``margin_px`` of the edge of a shape, at least 3 px.
    """
    labels = _predictor_of_grid(cloud, max(margin_px, EDGE_MARGIN_PX)).quick_labels(scene, world_from_sensor)
    return replace(cloud, feature=labels, feature_names=scene.names)


def measure_labelled(labelled: PointCloud, task: Task, world_from_sensor: Transform) -> list[Result]:
    """Measure a task in a labelled cloud (:func:`labelled_cloud`), whose labels include all shapes of the task."""
    return list(measure(labelled, task, world_from_sensor.inverse().matrix()).values())


def corrected(result: Result, statement: ViewStatement) -> Result:
    """Subtract the bias of a measurement; its uncertainty becomes that of the statement.

    Raises
    ------
    InputError
        If the statement lacks the measurement, has it in another unit, or has no bias for it.
    """
    if result.name not in statement.corrections:
        known = ", ".join(statement.corrections)
        raise InputError(
            statement.path, "measurements", known, f"a statement with {result.name}, a measurement of the task"
        )
    correction = statement.corrections[result.name]
    if correction.unit != result.unit or not math.isfinite(correction.bias):
        found = f"bias {correction.bias:g} {correction.unit}"
        raise InputError(statement.path, f"measurements.{result.name}", found, f"a bias in {result.unit}")
    return replace(
        result,
        value=result.value - correction.bias,
        bias=correction.bias,
        uncertainty=correction.uncertainty,
        origin="statement",
    )


def read_view_statement(path: Path) -> ViewStatement:
    """Read sensor, pose, biases and uncertainties from a ``statement.json``.

    The uncertainty after correction is sqrt(u^2 + u_bias^2), from ``standard_uncertainty`` and ``bias_uncertainty``.

    Raises
    ------
    InputError
        If the file cannot be read, or is not a statement.
    """
    table = _json(path, "a statement.json of mitsim run or mitsim study state")
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
        return ViewStatement(path, str(table["sensor"]), pose, corrections)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, "", f"a file that is not a statement ({error!r})", "a statement.json") from None


def read_pose(path: Path, view: int | None = None) -> Transform:
    """Read ``world_from_sensor`` from a pose.json, a statement.json, or one view of a poses.json.

    Raises
    ------
    InputError
        If the file cannot be read, has no pose or no such view, or its matrix is not a rigid motion.
    """
    table = _json(path, "pose.json of a capture, poses.json of a run, or statement.json")
    matrix = table.get("world_from_sensor")
    if "views" in table:
        try:
            known = {int(one["view"]): one["part_from_sensor"] for one in table["views"]}
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                path, "views", f"entries that cannot be read ({error!r})", "a list as mitsim run writes it"
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
    orthogonal = np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-4)
    if not orthogonal or np.linalg.det(pose.rotation) < 0 or not np.isfinite(pose.translation).all():
        raise InputError(
            path, "world_from_sensor", "a matrix that is not a rigid motion", "a rotation, and a translation in mm"
        )
    return pose


def _predictor_of_grid(cloud: PointCloud, margin_px: int) -> Predictor:
    """Return a predictor to label a cloud with. Labels depend on the grid alone, so one camera stands for the rig."""
    grid = cloud.grid
    matrix = np.array([[grid.fx, 0, grid.cx], [0, grid.fy, grid.cy], [0, 0, 1]])
    camera = Camera(matrix, np.zeros(0), grid.width, grid.height, Transform(grid.rotation, grid.origin))
    return Predictor(Rig({"grid": camera}), grid, np.ones((grid.height, grid.width), bool), cloud.sensor, margin_px)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _json(path: Path, description: str) -> dict[str, Any]:
    return read_json_object(path, description)
