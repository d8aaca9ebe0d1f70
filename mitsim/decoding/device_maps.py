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
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.decoding.grid_cloud import cloud_on_grid
from mitsim.decoding.structured_light.geometry import camera_grid
from mitsim.sensor.camera import Rectification, Rig

MapName = Literal["depth", "disparity", "points"]


@dataclass(frozen=True)
class DeviceMapGeometry:
    """Geometry of a device's map."""

    grid: ViewGrid  # pixels of the map
    baseline: NDArray[np.float64]  # (3,) unit vector in the sensor frame
    rectification: Rectification | None = None  # of a map of disparities; else None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W), all true: the part of its map that the device can see is not known."""
        return np.ones((self.grid.height, self.grid.width), bool)


def camera_map_geometry(rig: Rig) -> DeviceMapGeometry:
    """Return the geometry of a map of depths or points: the grid of the first camera's pixels."""
    return DeviceMapGeometry(camera_grid(rig.reference), rig.baseline_direction)


def disparity_map_geometry(rig: Rig) -> DeviceMapGeometry:
    """Return the geometry of disparities, on the rectified left grid; InputError without the device's rectification."""
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


def decode_device_map(
    name: MapName,
    values: NDArray[np.floating],
    geometry: DeviceMapGeometry,
    range_mm: tuple[float, float],
    *,
    sensor: str,
    source: str,
    roi: Roi | None = None,
) -> PointCloud:
    """Convert a map to points on the view rays of the grid; a map of points is accepted as it is.

    - ``name``: ``depth``, ``disparity`` or ``points``.
    - ``values``: depths along the axis of the grid (H, W) [mm]; disparities of the rectified left image (H, W) [px]; or
      points in the sensor frame (H, W, 3) [mm]. NaN where there is none.
    - ``geometry``: from :func:`camera_map_geometry`, or :func:`disparity_map_geometry` for disparities.
    - ``range_mm``: nearest and farthest accepted depth [mm].
    - ``sensor``, ``source``: copied into the cloud.
    - ``roi``: region of the grid to decode; None for all.

    Returns: points in the sensor frame [mm]. Status ``NO_SURFACE`` where the map is NaN, ``OUT_OF_RANGE`` outside the
    range, ``UNCALIBRATED`` where the pixel has no ray, since the distortion of the camera folds over before it. Raises
    InputError if the map does not have the grid's size, or the region does not lie in the grid.
    """
    grid = geometry.grid
    if values.shape != (grid.height, grid.width, *((3,) if name == "points" else ())):
        found = " x ".join(map(str, values.shape[1::-1])) + " px"
        allowed = f"{grid.width} x {grid.height} px, as the calibration says"
        raise InputError(f"map of {name}", "size", found, allowed)
    roi = checked_roi(roi, grid.width, grid.height, "decode_device_map")
    measured = values[roi.slices].astype(np.float64)
    without_ray = np.zeros(measured.shape[:2], bool)
    if name == "points":
        points, depth = measured, (measured - grid.origin) @ grid.rotation[:, 2]
    else:
        depth = measured
        if name == "disparity":
            assert geometry.rectification is not None  # disparity_map_geometry
            with np.errstate(divide="ignore"):
                depth = geometry.rectification.depth(values[roi.slices]).astype(np.float64)
        columns, rows = roi.pixels()
        rays = grid.rays_at(columns, rows)
        points = grid.origin + rays * (depth / (rays @ grid.rotation[:, 2]))[..., None]
        without_ray = np.isnan(rays[..., 0])
    is_measured = np.isfinite(points).all(axis=-1)
    with np.errstate(invalid="ignore"):
        accepted = is_measured & (depth >= range_mm[0]) & (depth <= range_mm[1])
    status = np.select(
        [without_ray, accepted, is_measured],
        [Status.UNCALIBRATED, Status.VALID, Status.OUT_OF_RANGE],
        Status.NO_SURFACE,
    ).astype(np.uint8)
    return cloud_on_grid(np.where(accepted[..., None], points, np.nan), status, None, roi, geometry, sensor, source)


def roi_of_other_grid(grid: ViewGrid, other: ViewGrid, roi: Roi, near_mm: float, far_mm: float) -> Roi | None:
    """Return the region of another grid that contains all that a region shows in a range of depths; None if empty.

    The boundary of the region is projected pixel by pixel at both depths, so distorted rays are included. If a point of
    it cannot be projected, the result is the whole of ``other``.

    ``grid``, ``other``: grid of the region, and grid of the result. ``roi``: region of ``grid``. ``near_mm``,
    ``far_mm``: range of depths [mm].
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
