"""What a device has measured itself, to an organised point cloud: a map of depth, of disparity or of points.

Signal chain: depth Z along the camera's axis [mm] -> points on the view rays of the camera's pixels; or disparity
d = x_left - x_right of a rectified pair [px] -> Z = f B / (d + cx_right - cx_left) -> points on the rectified left
grid; or points as they are -> those between near and far.

NaN is a pixel that was not measured. The device does not say why, so such a pixel is ``NO_SURFACE``. Nothing is
filtered or filled here; what the device itself has filled cannot be told any more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from characterisation.documents import Document
from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decode.grid_cloud import placed_cloud
from mitsim.decode.structured_light.geometry import camera_grid
from mitsim.sensor.camera import Rectification, Rig
from mitsim.sensor.roi import Roi, checked_roi


class DeviceMapSettings(Document):
    """Depths ``near_mm`` to ``far_mm`` along the camera's axis between which points are accepted."""

    near_mm: float = Field(gt=0)
    far_mm: float = Field(gt=0)

    @model_validator(mode="after")
    def _ordered(self) -> DeviceMapSettings:
        if self.near_mm >= self.far_mm:
            raise ValueError("near_mm under far_mm")
        return self


@dataclass(frozen=True)
class DeviceMapGeometry:
    """The ``grid`` of a map's pixels, its ``baseline`` (3,), and the ``rectification`` of a map of disparities."""

    grid: ViewGrid
    baseline: NDArray[np.float64]
    rectification: Rectification | None = None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W): what the device sees of its own map is not known, so all of it."""
        return np.ones((self.grid.height, self.grid.width), bool)


def camera_map_geometry(rig: Rig) -> DeviceMapGeometry:
    """Grid of the first camera's pixels, for depths and points."""
    return DeviceMapGeometry(camera_grid(rig.reference), rig.baseline_direction)


def disparity_map_geometry(rig: Rig) -> DeviceMapGeometry:
    """Grid of the rectified left image.

    Raises
    ------
    InputError
        If the rig has no rectification: disparities mean nothing without that of the device.
    """
    pair = rig.rectification
    if pair is None:
        raise InputError("rig", "rectification", "none", "that of the device which made the disparities")
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
    """Put depths on their view rays.

    Parameters
    ----------
    depth
        (H, W) [mm] along the axis of the grid, NaN where there is none.
    near_mm, far_mm
        Depths between which points are accepted [mm].
    sensor, source
        Carried into the cloud.
    roi
        Region of the grid: decode only this.

    Raises
    ------
    InputError
        If the map is not of the grid's size.
    """
    grid = geometry.grid
    if depth.shape != (grid.height, grid.width):
        raise _wrong_size("depth", depth.shape, grid)
    roi = checked_roi(roi, grid.width, grid.height, "decode_depth_map")
    columns, rows = roi.pixels()
    z, ray = depth[roi.slices].astype(np.float64), grid.rays_at(columns, rows)
    points = grid.origin + ray * (z / (ray @ grid.rotation[:, 2]))[..., None]
    return _within(points, z, geometry, (near_mm, far_mm), sensor, source, roi)


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
    """Triangulate disparities (H, W) [px] of the rectified left image; the rest as :func:`decode_depth_map`."""
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
    """Take points (H, W, 3) [mm] of the sensor frame as they are; the rest as :func:`decode_depth_map`."""
    grid = geometry.grid
    if points.shape != (grid.height, grid.width, 3):
        raise _wrong_size("points", points.shape, grid)
    roi = checked_roi(roi, grid.width, grid.height, "decode_point_map")
    shown = points[roi.slices].astype(np.float64)
    depth = (shown - grid.origin) @ grid.rotation[:, 2]
    return _within(shown, depth, geometry, (near_mm, far_mm), sensor, source, roi)


def roi_of_other_grid(grid: ViewGrid, other: ViewGrid, roi: Roi, near_mm: float, far_mm: float) -> Roi | None:
    """Return the region of ``other`` that holds all that ``roi`` of ``grid`` shows from near to far; None if nothing.

    The edge of the region is projected at both depths, pixel by pixel, so that it also holds for bent rays.
    """
    columns, rows = np.arange(roi.left, roi.right), np.arange(roi.top, roi.bottom)
    edge = np.concatenate(
        [np.stack(np.broadcast_arrays(columns, row), axis=-1) for row in (roi.top, roi.bottom - 1)]
        + [np.stack(np.broadcast_arrays(column, rows), axis=-1) for column in (roi.left, roi.right - 1)]
    )
    ray = grid.rays_at(edge[:, 0], edge[:, 1])
    along = ray / (ray @ grid.rotation[:, 2])[:, None]
    seen = other.project(np.concatenate([grid.origin + along * depth for depth in (near_mm, far_mm)]))
    if not np.isfinite(seen).all():
        return Roi.whole(other.width, other.height)
    size = np.array([other.width, other.height])
    low = np.clip(np.floor(seen.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(seen.max(axis=0)) + 1, 0, size).astype(int)
    return None if (low >= high).any() else Roi.between(*low, *high)


def _within(
    points: NDArray[np.float64],
    depth: NDArray[np.float64],
    geometry: DeviceMapGeometry,
    range_mm: tuple[float, float],
    sensor: str,
    source: str,
    roi: Roi,
) -> PointCloud:
    near_mm, far_mm = range_mm
    measured = np.isfinite(points).all(axis=-1)
    with np.errstate(invalid="ignore"):
        accepted = measured & (depth >= near_mm) & (depth <= far_mm)
    status = np.select([accepted, measured], [Status.VALID, Status.OUT_OF_RANGE], Status.NO_SURFACE).astype(np.uint8)
    points = np.where(accepted[..., None], points, np.nan)
    return placed_cloud(points, status, None, roi, geometry, sensor, source)


def _wrong_size(name: str, shape: tuple[int, ...], grid: ViewGrid) -> InputError:
    allowed = f"{grid.width} x {grid.height} px, as the calibration says"
    return InputError(f"map of {name}", "size", " x ".join(map(str, shape[1::-1])) + " px", allowed)
