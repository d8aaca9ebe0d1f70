"""Measure a task in a cloud: label pixels with features, and evaluate the measurements."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.tasks import task_reading
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from characterisation.tasks.task_reading import check_features
from mitsim.interface.poses import as_pose
from mitsim.measuring.clouds import margin_of
from mitsim.measuring.of_task import labelled_cloud, measure_labelled
from mitsim.scene.load import Scene
from mitsim.sensor.preset import Sensor
from mitsim.sensor.transforms import Transform


def read_task(path: str | Path) -> Task:
    """Read a task TOML file: features of a part, and the measurements of them.

    Parameters
    ----------
    path
        The file; its keys are in ``docs/reference/task.md``.

    Returns
    -------
    Task
        ``features`` and ``measurements`` by name, geometry in the part frame [mm].

    Raises
    ------
    InputError
        If it is missing, is not TOML, or requests an impossible measurement; the error names the key.

    Examples
    --------
    >>> import mitsim as ms
    >>> task = ms.read_task("task.toml")
    >>> task.measurements["pillar1_radius"].nominal
    20.0
    """
    return task_reading.read_task(Path(path))


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
    return labelled_cloud(cloud, scene, as_pose(pose, "label"), margin_of(sensor.settings))


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
    >>> found = ms.measure(cloud, ms.read_task("task.toml"), pose)
    >>> radius = found["pillar1_radius"]
    >>> radius.unit, radius.possible, radius.points > 100
    ('mm', True, True)
    """
    if cloud.feature is None:
        raise InputError(
            "measure",
            "cloud",
            "a cloud without labels",
            "a cloud with labelled pixels",
            "label it with mitsim.label",
        )
    check_features(task, "measure: task", cloud.feature_names)
    return {one.name: one for one in measure_labelled(cloud, task, as_pose(pose, "measure"))}
