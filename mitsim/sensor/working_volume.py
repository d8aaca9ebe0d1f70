"""Compute where a sensor can measure: the common view of its eyes between its working distances.

An eye is a camera or the projector. The working distances are depths along the axis of the reference camera. A point is
in an eye's view if it projects into its image. Points farther off the axis than the corners of the image are excluded.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.orientations import sphere_directions
from characterisation.region_of_interest import Roi
from mitsim.sensor.camera import Camera
from mitsim.sensor.rig_parameters import eyes
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform, look_at


def in_image(camera: Camera, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether points (..., 3) [mm], sensor frame, project into a camera's or projector's image."""
    local = camera.sensor_from_camera.inverse().points(np.asarray(points, float))
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = camera.rays_to_fold(np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]]))
    near_axis = local[..., 2] >= corners[:, 2].min() * np.linalg.norm(local, axis=-1)
    pixels = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels <= [right, bottom])).all(axis=-1)
    return np.asarray(near_axis & inside)


def depth(sensor: Sensor, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the distance along the axis of the reference camera [mm] of points (..., 3), sensor frame."""
    return np.asarray(sensor.rig.reference.sensor_from_camera.inverse().points(points)[..., 2])


def in_working_volume(sensor: Sensor, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether points (..., 3) [mm], sensor frame, lie in the working volume; occlusion is ignored."""
    near, far = sensor.working_range_mm
    along = depth(sensor, points)
    inside = (along >= near) & (along <= far)
    for camera in eyes(sensor.rig).values():
        inside &= in_image(camera, points)
    return np.asarray(inside)


def common_view(sensor: Sensor, depth_mm: float, step: int = 1) -> NDArray[np.bool_]:
    """Return which pixels (H, W) of the reference camera have a point at one depth that every eye sees.

    ``step`` samples every ``step``-th pixel of every ``step``-th row.
    """
    camera = sensor.rig.reference
    rays = camera.rays(camera.pixel_grid()[::step, ::step])
    return _seen_by_others(sensor, rays, depth_mm)


def _seen_by_others(sensor: Sensor, rays: NDArray[np.floating], depth_mm: float) -> NDArray[np.bool_]:
    points = sensor.rig.reference.sensor_from_camera.points(rays / rays[..., 2:] * depth_mm)
    seen = np.ones(rays.shape[:-1], bool)
    for other in list(eyes(sensor.rig).values())[1:]:
        seen &= in_image(other, points)
    return seen


def field_of_view(sensor: Sensor, depth_mm: float) -> tuple[float, float]:
    """Return width and height [mm] of the common view of all eyes at one depth, to 2 %; (0, 0) if empty."""
    camera = sensor.rig.reference
    columns, rows = (np.linspace(0, size - 1, 64) for size in (camera.width, camera.height))
    rays = camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1))
    rays = rays[_seen_by_others(sensor, rays, depth_mm)]
    if not len(rays):
        return 0.0, 0.0
    width, height = np.ptp(rays[:, :2] / rays[:, 2:], axis=0) * depth_mm
    return float(width), float(height)


def nearest_standoff(sensor: Sensor, radius_mm: float) -> float:
    """Return the shortest |V| [mm], a multiple of 10, at which the sensor sees a ball on its reference camera's axis.

    The whole ball must lie in the working volume. If it never does, because the part is deeper or wider than that
    volume, the result is the geometric mean of the working range.
    """
    near, far = sensor.working_range_mm
    axis = sensor.rig.reference.sensor_from_camera
    ball = radius_mm * sphere_directions(3)
    first, last = math.ceil((near + radius_mm) / 10), math.floor((far - radius_mm) / 10)
    for tens in range(first, last + 1):
        if in_working_volume(sensor, axis.points(np.array([0.0, 0.0, 10.0 * tens]) + ball)).all():
            return 10.0 * tens
    return 10.0 * round(math.sqrt(near * far) / 10)


def usual_place(sensor: Sensor, centre: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return a default sensor position (3,) [mm]: 45 deg above the part's centre, at the middle of the range."""
    return np.asarray(centre + sum(sensor.working_range_mm) / 2 * np.array([0.0, -np.sqrt(0.5), np.sqrt(0.5)]))


def pose_at(
    sensor: Sensor, position: NDArray[np.floating], target: NDArray[np.floating], roll_deg: float = 0.0
) -> Transform:
    """Return ``world_from_sensor`` with the axis of the reference camera along a line, z up.

    Parameters
    ----------
    sensor, roll_deg
        The sensor, and its rotation about the axis [deg].
    position, target
        Ends of the line (3,) [mm].

    See Also
    --------
    usual_place : a default place of the sensor
    """
    camera = sensor.rig.reference.sensor_from_camera
    return look_at(position, target, (0.0, 0.0, 1.0), roll_deg) @ camera.inverse()


def roi_around(camera: Camera, points: NDArray[np.floating], margin: int) -> Roi | None:
    """Return the region of a camera's image that holds points (n, 3) of the sensor frame; None if one is behind it."""
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return None
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - margin, 0, [camera.width - 1, camera.height - 1])
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, low + 1, [camera.width, camera.height])
    return Roi.between(*low, *high)
