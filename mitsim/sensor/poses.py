"""Make the pose of a sensor, with :func:`look_at` or from a matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.errors import InputError
from mitsim.sensor import transforms
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform, is_rotation


def look_at(
    position: ArrayLike,
    target: ArrayLike = (0.0, 0.0, 0.0),
    *,
    up: ArrayLike = (0.0, 0.0, 1.0),
    roll_deg: float = 0.0,
    sensor: Sensor | None = None,
) -> Transform:
    """Return the pose ``world_from_sensor`` of a sensor at one place that looks at another.

    Parameters
    ----------
    position
        Place of the sensor (3,) [mm] in the world frame, which is the frame of the scene.
    target
        Place at which it looks (3,) [mm], in the same frame.
    up
        (3,) direction to which the top of the image is turned, as closely as possible.
    roll_deg
        Rotation about the view axis [deg], clockwise as the sensor sees it.
    sensor
        If given, its reference camera is at ``position``; otherwise, the origin of the sensor frame is. The two differ
        only if the sensor's frame is not that of its reference camera.

    Returns
    -------
    Transform
        Takes points from the sensor frame (x right, y down, z forward) to the world frame.

    Raises
    ------
    InputError
        If an argument is not three finite numbers, or position and target are the same place.

    Examples
    --------
    >>> import mitsim as ms
    >>> pose = ms.look_at((0, -300, 400))
    >>> print(pose.translation)
    [   0. -300.  400.]
    >>> print(pose.points([[0.0, 0.0, 500.0]]).round(6) + 0.0)
    [[0. 0. 0.]]
    """
    for name, coordinates in (("position", position), ("target", target), ("up", up)):
        array = _numbers(coordinates)
        if array is None or array.shape != (3,) or not np.isfinite(array).all():
            raise InputError("look_at", name, coordinates, "three numbers [mm]")
    turn = _numbers(roll_deg)
    if turn is None or turn.shape != () or not np.isfinite(turn):
        raise InputError("look_at", "roll_deg", roll_deg, "a finite number [deg]")
    if not np.linalg.norm(np.subtract(position, target)) > 0 or not np.linalg.norm(up) > 0:
        raise InputError("look_at", "position", "the target itself, or no direction up", "two places, and a direction")
    pose = transforms.look_at(position, target, up, roll_deg)
    return pose if sensor is None else pose @ sensor.rig.reference.sensor_from_camera.inverse()


def as_pose(pose: Transform | ArrayLike, where: str) -> Transform:
    """Return a pose given as a transform or as a (4, 4) matrix [mm]. Raises InputError if it is not a rigid motion."""
    matrix = pose.matrix() if isinstance(pose, Transform) else _numbers(pose)
    if matrix is None or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        found = "no array of numbers" if matrix is None else f"an array {matrix.shape}"
        raise InputError(where, "pose", found, "a Transform, or a (4, 4) matrix [mm], of finite numbers")
    moved = pose if isinstance(pose, Transform) else Transform.from_matrix(matrix)
    if not is_rotation(moved.rotation, 1e-4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(where, "pose", "a matrix that is not a rigid motion", "a rotation and a translation [mm]")
    return moved


def _numbers(values: ArrayLike) -> NDArray[np.float64] | None:
    """Return values as an array of numbers, None if they are not."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return None
