"""Detect a surface outside the depths that a capture's decoder searches, and word a warning.

A decoder finds nothing outside its range, and F is then 0 without any fault. There are two methods:

*If pose and part are known* (captures of coupons), the depth of the part is compared with ``near_mm`` and ``far_mm``.
The depth is measured along the axis of the cloud's grid (:func:`depths_of`).

*If they are not known*, a coarse capture is decoded (:func:`surface_beyond`). This is done only if the decoder returned
almost no points, or points that disagree with their neighbours. Signal chain: capture -> fewer pixels -> the same
decoder with a range extended by the factor :data:`RANGE_FACTOR` at both ends -> points outside the range that agree
with their neighbours. For a matcher the pixels are binned, which keeps the texture. For a decoder of single pixels
every n-th one is kept.

A matcher returns false points of a surface outside its range. Simulated matt plates out of the range of ``oak-d-pro``,
``ensenso-n10``, ``realsense-d435`` and ``primesense-carmine-1.09`` gave points at up to 26 % of the pixels. Of these
points, 16 to 45 % agreed with their neighbours. Within the range it was 99 % or more. On recordings within the range,
by three Ensensos and an OAK, it was 82 to 95 %. On the OAK's wall (``oak/wall_3470mm``), decoded from 0.3 to 1.2 m, it
was 41 %.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import Settings, capture_cloud
from mitsim.decoding.decoder_registry import technology_of
from mitsim.decoding.matching.reference_matching import rectifying_rotation
from mitsim.sensor.camera import Rig, stereo_rectification
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import TimeOfFlightSettings

#: share of valid pixels below which a cloud has almost no points
MINIMUM_VALID = 0.01

#: share of points that agree with their neighbours, below which they are not trusted. It lies between the shares out of
#: range and in range given above
MINIMUM_AGREEMENT = 0.6

#: least share of the pixels that must lie outside the range on a surface; chosen
MINIMUM_OUTSIDE = 0.05

#: its least ratio to the share that agrees within the range; chosen
OUTSIDE_RATIO = 3.0

#: factor by which the coarse search extends the range at both ends
RANGE_FACTOR = 8.0

#: approximate number of columns of the coarse capture
_COARSE_COLUMNS = 400

#: largest difference of a depth on a surface from the median around it, as a share of the depth; chosen
_DEPTH_TOLERANCE = 0.02

#: side of the square for this median [px]; chosen
_NEIGHBOURHOOD_PX = 7

#: largest number of points of a cloud that are compared with their neighbours
_SAMPLED_POINTS = 2000

_TABLES = {MatcherSettings: "matcher", DecoderSettings: "decoder", TimeOfFlightSettings: "demodulation"}


@dataclass(frozen=True)
class SurfaceBeyond:
    """A surface out of range: 10th and 90th percentile of its ``depths`` [mm], and its ``share`` of the pixels [1]."""

    depths: tuple[float, float]
    share: float


def depths_of(points: NDArray[np.floating], rig: Rig, settings: Settings) -> NDArray[np.float64]:
    """Return depths (n,) [mm] of points (n, 3) in the sensor frame, along the axis of the decoder's range.

    For a pair that is matched or decoded together, or a camera and a reference, it is the axis of the rectified first
    camera, else that of the first camera.
    """
    left = rig.reference
    axis = left.sensor_from_camera.rotation[:, 2]
    if _uses_pair(rig, settings):
        left, right = list(rig.cameras.values())[:2]
        pair = rig.rectification or stereo_rectification(left, right)
        axis = left.sensor_from_camera.rotation @ pair.rotation_left.T[:, 2]
    elif isinstance(settings, MatcherSettings) and rig.projector is not None:
        baseline = rig.projector.centre - left.centre
        axis = rectifying_rotation(baseline / np.linalg.norm(baseline), left.sensor_from_camera.rotation)[:, 2]
    return np.asarray((points - left.centre) @ axis)


def range_warning(
    surface: str, depths: tuple[float, float], settings: Settings, sensor: str | None, reason: str
) -> str:
    """Word the warning that a surface is outside the depths that its decoder searches.

    Parameters
    ----------
    surface
        Name of the surface in the warning.
    depths
        Nearest and farthest depth of the surface [mm].
    settings
        Settings of the decoder.
    sensor
        Sensor whose file holds these settings; None if they are the capture's own.
    reason
        How the depth is known.

    See Also
    --------
    surface_beyond : finds that surface
    """
    near, far = (f"{depth:.0f}" for depth in depths)
    extent = f"{near} mm" if near == far else f"{near} to {far} mm"
    location = f"[{_TABLES.get(type(settings), 'decoder')}] of the sensor file of {sensor}"
    if sensor is None:
        location = "settings.json of the capture (mitsim import --range), or decode with --sensor"
    return (
        f"{surface} is at a depth of {extent} ({reason}), but the decoder searches {settings.near_mm:g} to "
        f"{settings.far_mm:g} mm: change near_mm and far_mm in {location}"
    )


def surface_beyond(capture: Capture, cloud: PointCloud, settings: Settings) -> SurfaceBeyond | None:
    """Search coarsely for a surface outside the decoder's range, if the ``cloud`` of a capture has almost no points.

    The result is None in three cases: the cloud has points that agree with their neighbours, no surface is clearly
    outside the range, or the wider range cannot be decoded.
    """
    valid_share = float(cloud.valid.mean())
    agreement = neighbour_agreement(cloud)
    if valid_share >= MINIMUM_VALID and agreement >= MINIMUM_AGREEMENT:
        return None
    wide = settings.model_copy(
        update={"near_mm": settings.near_mm / RANGE_FACTOR, "far_mm": settings.far_mm * RANGE_FACTOR}
    )
    # binned texture has less contrast, and the device's disparity steps would hide the depth
    if isinstance(wide, MatcherSettings):
        wide = wide.model_copy(update={"minimum_contrast_dn": wide.minimum_contrast_dn / 2, "disparity_step": 0.0})
    step = max(1, round(capture.rig.reference.width / _COARSE_COLUMNS))
    if isinstance(wide, MatcherSettings):
        step = max(2, step)
    coarse = _coarse_capture(capture, step, binned=isinstance(wide, MatcherSettings))
    # time of flight is ambiguous beyond some depth, and refuses a range that reaches it
    reaches = (RANGE_FACTOR, 4, 2, 1) if isinstance(wide, TimeOfFlightSettings) else (RANGE_FACTOR,)
    wide_cloud = None
    for reach in reaches:
        with suppress(InputError):
            wide_cloud = capture_cloud(coarse, wide.model_copy(update={"far_mm": settings.far_mm * reach}))
            break
    if wide_cloud is None:
        return None
    depth = _depth(wide_cloud)
    smooth = (depth > 0) & (
        np.abs(depth - median_filter(depth, _NEIGHBOURHOOD_PX, mode="nearest")) < _DEPTH_TOLERANCE * depth
    )
    outside = smooth & ((depth < settings.near_mm) | (depth > settings.far_mm))
    share = float(outside.mean())
    if share < max(MINIMUM_OUTSIDE, OUTSIDE_RATIO * agreement * valid_share):
        return None
    low, high = np.percentile(depth[outside], [10, 90])
    return SurfaceBeyond((float(low), float(high)), share)


def neighbour_agreement(cloud: PointCloud) -> float:
    """Return the share of a cloud's points that agree in depth with the median of the 7 x 7 pixels around them.

    Missing pixels count as disagreeing depths. At most ``_SAMPLED_POINTS`` points, evenly selected, are compared. The
    result is 1 for a cloud without points.
    """
    rows, columns = np.nonzero(cloud.valid)
    if not len(rows):
        return 1.0
    sample = slice(None, None, -(-len(rows) // _SAMPLED_POINTS))
    rows, columns = rows[sample], columns[sample]
    offsets = np.arange(_NEIGHBOURHOOD_PX) - _NEIGHBOURHOOD_PX // 2
    height, width = cloud.status.shape
    neighbour_rows = np.clip(rows[:, None, None] + offsets[:, None], 0, height - 1)
    neighbour_columns = np.clip(columns[:, None, None] + offsets[None, :], 0, width - 1)
    origin, axis = cloud.grid.origin, cloud.grid.rotation[:, 2]
    neighbour_depths = np.nan_to_num((cloud.points[neighbour_rows, neighbour_columns].astype(float) - origin) @ axis)
    depth = (cloud.points[rows, columns].astype(float) - origin) @ axis
    median = np.median(neighbour_depths.reshape(len(rows), -1), axis=1)
    return float(np.mean(np.abs(depth - median) < _DEPTH_TOLERANCE * depth))


def _depth(cloud: PointCloud) -> NDArray[np.float64]:
    """Return depths (H, W) [mm] along the grid's axis, 0 where there is no point."""
    local = (cloud.points.astype(float) - cloud.grid.origin) @ cloud.grid.rotation[:, 2]
    return np.where(cloud.valid, local, 0.0)


def _uses_pair(rig: Rig, settings: Settings) -> bool:
    """Return whether the decoder uses two cameras together."""
    two_cameras = isinstance(settings, MatcherSettings) or (
        isinstance(settings, DecoderSettings) and settings.triangulate == "cameras"
    )
    return two_cameras and len(rig.cameras) > 1


def _coarse_capture(capture: Capture, step: int, *, binned: bool) -> Capture:
    """Return the capture, but of a device's map, ``binned`` by step x step, or of every ``step``-th pixel each way."""
    if step == 1 or technology_of(capture.technology).from_device:
        return capture
    offset = 0 if binned else step // 2
    images = {name: _coarse_images(stack, step, offset, binned) for name, stack in capture.images.items()}
    cameras = {}
    for name, camera in capture.rig.cameras.items():
        shift = (step - 1) / 2 if binned else offset
        height, width = images[name].shape[1:]
        cameras[name] = replace(camera, matrix=_coarse_matrix(camera.matrix, step, shift), width=width, height=height)
    pair = capture.rig.rectification
    if pair is not None:
        left, right = (_coarse_matrix(matrix, step, (step - 1) / 2) for matrix in (pair.matrix_left, pair.matrix_right))
        pair = replace(pair, matrix_left=left, matrix_right=right, width=pair.width // step, height=pair.height // step)
    read_out = {  # whole coarse pixels within the region
        name: Roi(-(-left // step), -(-top // step), max(width // step - 1, 1), max(height // step - 1, 1))
        for name, roi in capture.decoding.read_out.items()
        for left, top, width, height in [(roi.left, roi.top, roi.width, roi.height)]
    }
    return replace(
        capture,
        images=images,
        rig=replace(capture.rig, cameras=cameras, rectification=pair),
        decoding=capture.decoding.model_copy(update={"read_out": read_out}),
        derived={},
    )


def _coarse_images(
    stack: NDArray[np.unsignedinteger[Any]], step: int, offset: int, binned: bool
) -> NDArray[np.unsignedinteger[Any]]:
    """Return images (n, H, W) with fewer pixels: means if binned, without the rest at the right and lower edges."""
    if not binned:
        return np.ascontiguousarray(stack[:, offset::step, offset::step])
    count, height, width = len(stack), stack.shape[1] // step, stack.shape[2] // step
    tiles = stack[:, : height * step, : width * step].reshape(count, height, step, width, step)
    return np.asarray(np.rint(tiles.mean(axis=(2, 4)))).astype(stack.dtype)


def _coarse_matrix(matrix: NDArray[np.float64], step: int, shift: float) -> NDArray[np.float64]:
    """Return the camera matrix for pixels ``step`` apart, the first centred at pixel ``shift`` of the whole image."""
    coarse = matrix.copy()
    coarse[:2, 2] -= shift
    coarse[:2] /= step
    return coarse
