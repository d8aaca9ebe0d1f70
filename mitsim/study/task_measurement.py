"""Measure a task in a cloud, at a known pose of the part, as a study does.

Signal chain: cloud, scene and pose -> label of each pixel, the shape of the part that it shows, away from edges -> fits
and values with standard uncertainties (:func:`characterisation.tasks.evaluation.measure`) -> bias subtracted, if a
statement of uncertainty is given.

A statement holds for one sensor, part and view, because its bias changes with the view. It is rejected for another
sensor, for a measurement that it lacks, and for another pose of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from characterisation.files.checked_files import read_json_object
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.tasks import evaluation
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import LINE_ANGLES, Task
from characterisation.tasks.task_reading import check_features
from mitsim.capture.recordings.cloud_numbers import METRES_UNDER
from mitsim.capture.recordings.pose_file import read_pose as read_pose_file
from mitsim.decoding.input_clouds import margin_of
from mitsim.maps.prediction.predictor import EDGE_MARGIN_PX, Predictor
from mitsim.scene.load import Scene
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.poses import as_pose
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.study.statement_file import PartialDocument
from mitsim.views.written_poses import rigid_pose, written_poses

#: largest distance between the sensor's place and that of a statement [mm]; chosen
SAME_PLACE_MM = 10.0

#: largest rotation between the two poses [deg]; chosen
SAME_ANGLE_DEG = 2.0


#: ratio of distances from which one of them has another unit: less than that of cm and mm; chosen
_ANOTHER_UNIT = 5.0


def label(cloud: PointCloud, scene: Scene, sensor: Sensor, pose: Transform | ArrayLike) -> PointCloud:
    """Label every pixel of a cloud with the shape of the part that it shows, by the part's geometry.

    Parameters
    ----------
    cloud
        Decoded or predicted; (H, W, 3) [mm] in the sensor frame.
    scene
        The part.
    sensor
        Pixels closer to the edge of a shape than half its matching block, and at least 3 px, are not labelled.
    pose
        ``world_from_sensor``, known within a few mm.

    Returns
    -------
    PointCloud
        The same points, with ``feature`` (H, W), an index into ``feature_names``, -1 for none.

    Raises
    ------
    InputError
        If the pose is not a rigid motion.

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("small.toml")
    >>> scene, pose = ms.load_scene("two_pillars.xml", sensor), ms.look_at((0, -300, 400))
    >>> cloud = ms.label(ms.read_cloud("cloud.ply"), scene, sensor, pose)
    >>> cloud.feature_names
    ('plane', 'pillar1', 'pillar1_top', 'pillar2', 'pillar2_top')
    >>> cloud.of_feature("plane").shape[1]
    3
    """
    return _labelled(cloud, scene, as_pose(pose, "label"), margin_of(sensor.settings))


def measure(cloud: PointCloud, task: Task, pose: Transform | ArrayLike) -> dict[str, Result]:
    """Measure a task in a labelled cloud.

    Parameters
    ----------
    cloud
        From :func:`label`, or from :func:`predict`, whose clouds are labelled.
    task
        From :func:`read_task`.
    pose
        ``world_from_sensor``: fits start from the nominal features at this pose, known within a few mm.

    Returns
    -------
    dict of str to Result
        By measurement: ``value``, ``error`` against the nominal, and standard ``uncertainty`` from the covariance of
        the fit, each in ``unit`` (mm or deg); ``points``, the number of points used. If a measurement was not possible,
        ``value`` is NaN and ``reason`` gives the cause. The uncertainty excludes errors common to many points:
        calibration, reflections, correlated noise. :func:`statement` includes them.

    Raises
    ------
    InputError
        If the cloud has no labels, or lacks a shape of the task.

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("small.toml")
    >>> scene, pose = ms.load_scene("two_pillars.xml", sensor), ms.look_at((0, -300, 400))
    >>> cloud = ms.label(ms.read_cloud("cloud.ply"), scene, sensor, pose)
    >>> results = ms.measure(cloud, ms.read_task("task.toml"), pose)
    >>> radius = results["pillar1_radius"]
    >>> radius.unit, radius.possible, radius.points > 100
    ('mm', True, True)
    """
    if cloud.feature is None:
        allowed = "a cloud with labelled pixels"
        raise InputError("measure", "cloud", "a cloud without labels", allowed, "label it with mitsim.label")
    check_features(task, "measure: task", cloud.feature_names)
    return evaluation.measure(cloud, task, as_pose(pose, "measure").inverse().matrix())


class Correction(PartialDocument):
    """Bias of one measurement, its standard uncertainty, and that of the error, all in ``unit``; None if unknown."""

    unit: str
    bias: float | None
    bias_uncertainty: float | None
    standard_uncertainty: float | None

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty after the bias is subtracted, sqrt(u^2 + u_bias^2); NaN if one is unknown."""
        u, u_bias = self.standard_uncertainty, self.bias_uncertainty
        return math.nan if u is None or u_bias is None else math.hypot(u, u_bias)


class ViewStatement(PartialDocument):
    """Statement of uncertainty for one view, from the ``statement.json`` at ``path``."""

    path: Path
    sensor: str
    world_from_sensor: list[list[float]]
    measurements: dict[str, Correction]

    def check(self, sensor: str, pose: Transform) -> None:
        """Check that a cloud's sensor and its ``pose``, world from sensor, are those of the statement.

        Raises InputError if the sensor differs, or the pose by more than :data:`SAME_PLACE_MM` or
        :data:`SAME_ANGLE_DEG`.
        """
        if sensor != self.sensor:
            raise InputError(self.path, "sensor", self.sensor, f"{sensor}, the sensor of the cloud")
        difference = rigid_pose(self.path, "world_from_sensor", self.world_from_sensor).inverse() @ pose
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

    Returns: one for each measurement of the task, in mm or deg. Raises InputError if the statement is for another
    sensor or view, or lacks a measurement.

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

    See Also
    --------
    measure : a labelled cloud
    """
    if statement is not None:
        statement.check(cloud.sensor, world_from_sensor)
    labelled = _labelled(cloud, scene, world_from_sensor, margin_px)
    results = evaluation.measure(labelled, task, world_from_sensor.inverse().matrix()).values()
    return [
        result
        if statement is None or not result.possible
        else corrected(result, statement, 90.0 if task.measurements[result.name].kind in LINE_ANGLES else math.inf)
        for result in results
    ]


def _labelled(cloud: PointCloud, scene: Scene, world_from_sensor: Transform, margin_px: int) -> PointCloud:
    labels = _predictor_of_grid(cloud, max(margin_px, EDGE_MARGIN_PX)).quick_labels(scene, world_from_sensor)
    return replace(cloud, feature=labels, feature_names=scene.names)


def corrected(result: Result, statement: ViewStatement, most: float = math.inf) -> Result:
    """Subtract the bias of a measurement; its uncertainty becomes that of the statement.

    A value that folds stays at least 0, and at ``most`` 90 deg for an angle of lines: its bias is that of a part at the
    limit of the tolerance. Raises InputError if the statement lacks the measurement, has it in another unit, or has no
    bias for it.
    """
    if result.name not in statement.measurements:
        names = ", ".join(statement.measurements)
        raise InputError(
            statement.path, "measurements", names, f"a statement with {result.name}, a measurement of the task"
        )
    correction = statement.measurements[result.name]
    if correction.unit != result.unit or correction.bias is None:
        bias = "no bias" if correction.bias is None else f"bias {correction.bias:g} {correction.unit}"
        raise InputError(statement.path, f"measurements.{result.name}", bias, f"a bias in {result.unit}")
    value = result.value - correction.bias
    return replace(
        result,
        value=min(value if result.deviations is None else max(value, 0.0), most),
        bias=correction.bias,
        uncertainty=correction.uncertainty,
        origin="statement",
    )


def read_view_statement(path: Path) -> ViewStatement:
    """Read sensor, pose, biases and uncertainties from a ``statement.json``.

    Raises InputError if the file cannot be read, or is not a statement.
    """
    table = read_json_object(path, "a statement.json of mitsim run or mitsim study state")
    return validate(path, table | {"path": path}, ViewStatement)


def read_pose(path: Path, view: int | None = None) -> Transform:
    """Read ``world_from_sensor`` from a pose.json, a statement.json, one view of a poses.json, or a text of ``import``.

    Raises InputError if the file cannot be read, has no pose or no such view, or its matrix is not a rigid motion.
    """
    if path.suffix.lower() != ".json":
        return read_pose_file(path)
    table = read_json_object(path, "pose.json of a capture, poses.json of a run, or statement.json")
    if "views" in table:
        poses = written_poses(path, table)
        if not poses:
            raise InputError(path, "views", "no view", "a list as mitsim run writes it")
        if view not in poses:
            allowed = f"a view of {path}: {min(poses)} to {max(poses)}"
            raise InputError("--view", "", "none" if view is None else view, allowed)
        return poses[view]["part_from_sensor"]
    return rigid_pose(path, "world_from_sensor", table.get("world_from_sensor"))


def unit_doubt(cloud: PointCloud, scene: Scene, pose: Transform) -> str:
    """Return a warning about a pose far nearer to the part, or farther, than any of a cloud's points; else empty."""
    distances = np.linalg.norm(cloud.points[cloud.valid] - cloud.grid.origin, axis=-1)
    near, far = np.quantile(distances, [0.05, 0.95]) if len(distances) else (0.0, np.inf)
    away = float(np.linalg.norm(pose.translation - scene.centre))
    in_metres = 0 < np.linalg.norm(pose.translation) < METRES_UNDER and away < near  # of a large part
    if near / _ANOTHER_UNIT <= away <= far * _ANOTHER_UNIT and not in_metres:
        return ""
    return (
        f"by the pose the sensor is {away:.3g} mm from the middle of the part, by the cloud its points are {near:.3g} "
        f"to {far:.3g} mm away: write the position of the pose in mm"
    )


def _predictor_of_grid(cloud: PointCloud, margin_px: int) -> Predictor:
    """Return a predictor to label a cloud with. Labels depend on the grid alone, so one camera stands for the rig."""
    grid = cloud.grid
    matrix = np.array([[grid.fx, 0, grid.cx], [0, grid.fy, grid.cy], [0, 0, 1]])
    camera = Camera(matrix, np.zeros(0), grid.width, grid.height, Transform(grid.rotation, grid.origin))
    return Predictor(Rig({"grid": camera}), grid, np.ones((grid.height, grid.width), bool), cloud.sensor, margin_px)
