"""Convert a map that a device has measured to an organised point cloud: depths, disparities or points.

Signal chain, for each kind of map:

- depth Z along the camera's axis [mm] -> points on the view rays of the camera's pixels
- disparity d = x_left - x_right of a rectified pair [px] -> Z = f B / (d + cx_right - cx_left) -> points on the
  rectified left grid (:meth:`mitsim.sensor.camera.Rectification.depth`)
- points in the sensor frame [mm], which remain as they are

Points outside the range ``near_mm`` to ``far_mm`` are then rejected.

A pixel without a measurement is NaN. The device does not give the reason, so the status is ``NO_SURFACE``. This module
filters and fills nothing. Points that the device has filled cannot be recognised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.decode.grid_cloud import cloud_on_grid
from mitsim.decode.structured_light.geometry import camera_grid
from mitsim.sensor.camera import Rectification, Rig


@dataclass(frozen=True)
class DeviceMapGeometry:
    """Geometry of a device's map.

    Attributes
    ----------
    grid
        Pixels of the map.
    baseline
        (3,) unit vector in the sensor frame.
    rectification
        Of a map of disparities; else None.
    """

    grid: ViewGrid
    baseline: NDArray[np.float64]
    rectification: Rectification | None = None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W), all true: the part of its map that the device can see is not known."""
        return np.ones((self.grid.height, self.grid.width), bool)


def camera_map_geometry(rig: Rig) -> DeviceMapGeometry:
    """Return the geometry of a map of depths or points: the grid of the first camera's pixels."""
    return DeviceMapGeometry(camera_grid(rig.reference), rig.baseline_direction)


def disparity_map_geometry(rig: Rig) -> DeviceMapGeometry:
    """Return the geometry of a map of disparities: the grid of the rectified left image.

    Raises
    ------
    InputError
        If the rig has no rectification. Disparities need the rectification with which the device made them.
    """
    pair = rig.rectification
    if pair is None:
        raise InputError("rig", "rectification", "none", "the rectification with which the device made the disparities")
    left = rig.reference
    rotation = left.sensor_from_camera.rotation @ pair.rotation_left.T
    K = pair.matrix_left
    grid = ViewGrid(
        float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), pair.width, pair.height, rotation, left.centre
    )
    return DeviceMapGeometry(grid, rig.baseline_direction, pair)


def decode_depth_map(
    depth: NDArray[np.floating],
    geometry: DeviceMapGeometry,
    near_mm: float,
    far_mm: float,
    *,
    sensor: str,
    source: str,
    roi: Roi | None = None,
) -> PointCloud:
    """Convert depths to points on the view rays of the grid.

    Parameters
    ----------
    depth
        (H, W) [mm] along the axis of the grid, NaN where there is none.
    geometry
        From :func:`camera_map_geometry` or :func:`disparity_map_geometry`.
    near_mm, far_mm
        Range of accepted depths [mm].
    sensor, source
        Copied into the cloud.
    roi
        Region of the grid to decode; None for all.

    Returns
    -------
    PointCloud
        Points in the sensor frame [mm]. Status ``NO_SURFACE`` where the map is NaN, ``OUT_OF_RANGE`` outside the range,
        ``UNCALIBRATED`` where the pixel has no ray, since the distortion of the camera folds over before it.

    Raises
    ------
    InputError
        If the map does not have the grid's size, or the region does not lie in the grid.
    """
    grid = geometry.grid
    if depth.shape != (grid.height, grid.width):
        raise _wrong_size("depth", depth.shape, grid)
    roi = checked_roi(roi, grid.width, grid.height, "decode_depth_map")
    columns, rows = roi.pixels()
    z, rays = depth[roi.slices].astype(np.float64), grid.rays_at(columns, rows)
    points = grid.origin + rays * (z / (rays @ grid.rotation[:, 2]))[..., None]
    cloud = _cloud_in_range(points, z, geometry, (near_mm, far_mm), sensor, source, roi)
    without_ray = np.isnan(rays[..., 0])
    cloud.status[roi.slices][without_ray] = Status.UNCALIBRATED
    return cloud


def decode_disparity_map(
    disparity: NDArray[np.floating],
    geometry: DeviceMapGeometry,
    near_mm: float,
    far_mm: float,
    *,
    sensor: str,
    source: str,
    roi: Roi | None = None,
) -> PointCloud:
    """Triangulate disparities (H, W) [px] of the rectified left image; otherwise as :func:`decode_depth_map`."""
    assert geometry.rectification is not None  # disparity_map_geometry
    with np.errstate(divide="ignore"):
        depth = geometry.rectification.depth(disparity)
    return decode_depth_map(depth, geometry, near_mm, far_mm, sensor=sensor, source=source, roi=roi)


def decode_point_map(
    points: NDArray[np.floating],
    geometry: DeviceMapGeometry,
    near_mm: float,
    far_mm: float,
    *,
    sensor: str,
    source: str,
    roi: Roi | None = None,
) -> PointCloud:
    """Accept points (H, W, 3) [mm] in the sensor frame as they are; otherwise as :func:`decode_depth_map`."""
    grid = geometry.grid
    if points.shape != (grid.height, grid.width, 3):
        raise _wrong_size("points", points.shape, grid)
    roi = checked_roi(roi, grid.width, grid.height, "decode_point_map")
    measured = points[roi.slices].astype(np.float64)
    depth = (measured - grid.origin) @ grid.rotation[:, 2]
    return _cloud_in_range(measured, depth, geometry, (near_mm, far_mm), sensor, source, roi)


def roi_of_other_grid(grid: ViewGrid, other: ViewGrid, roi: Roi, near_mm: float, far_mm: float) -> Roi | None:
    """Return the region of ``other`` that contains all that ``roi`` of ``grid`` shows in the range; None if empty.

    The boundary of the region is projected pixel by pixel at both depths [mm], so distorted rays are included. If a
    point of it cannot be projected, the result is the whole of ``other``.
    """
    columns, rows = np.arange(roi.left, roi.right), np.arange(roi.top, roi.bottom)
    boundary = np.concatenate(
        [np.stack(np.broadcast_arrays(columns, row), axis=-1) for row in (roi.top, roi.bottom - 1)]
        + [np.stack(np.broadcast_arrays(column, rows), axis=-1) for column in (roi.left, roi.right - 1)]
    )
    rays = grid.rays_at(boundary[:, 0], boundary[:, 1])
    ray_per_depth = rays / (rays @ grid.rotation[:, 2])[:, None]
    projected = other.project(np.concatenate([grid.origin + ray_per_depth * depth for depth in (near_mm, far_mm)]))
    if not np.isfinite(projected).all():
        return Roi.whole(other.width, other.height)
    size = np.array([other.width, other.height])
    low = np.clip(np.floor(projected.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(projected.max(axis=0)) + 1, 0, size).astype(int)
    return None if (low >= high).any() else Roi.between(*low, *high)


def _cloud_in_range(
    points: NDArray[np.float64],
    depth: NDArray[np.float64],
    geometry: DeviceMapGeometry,
    range_mm: tuple[float, float],
    sensor: str,
    source: str,
    roi: Roi,
) -> PointCloud:
    """Return the cloud of points (h, w, 3) of a region, with depths (h, w); points outside the range are rejected."""
    near_mm, far_mm = range_mm
    measured = np.isfinite(points).all(axis=-1)
    with np.errstate(invalid="ignore"):
        accepted = measured & (depth >= near_mm) & (depth <= far_mm)
    status = np.select([accepted, measured], [Status.VALID, Status.OUT_OF_RANGE], Status.NO_SURFACE).astype(np.uint8)
    points = np.where(accepted[..., None], points, np.nan)
    return cloud_on_grid(points, status, None, roi, geometry, sensor, source)


def _wrong_size(name: str, shape: tuple[int, ...], grid: ViewGrid) -> InputError:
    allowed = f"{grid.width} x {grid.height} px, as the calibration says"
    return InputError(f"map of {name}", "size", " x ".join(map(str, shape[1::-1])) + " px", allowed)
