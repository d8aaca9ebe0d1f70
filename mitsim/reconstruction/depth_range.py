"""Whether a surface stands within the depths that a capture's decoder searches, and a warning if it does not.

A decoder finds nothing outside its range, and F is 0 there without any fault. Two ways to tell:

*Pose and part are known* (captures of coupons): the depth of the part along the axis of the cloud's grid, against
``near_mm`` and ``far_mm`` (:func:`depths_of`).

*They are not known* (:func:`surface_beyond`), and almost nothing was decoded, or points that do not agree with their
neighbours: a coarse look. Signal chain: capture -> fewer pixels, binned for a matcher (so that its texture stays),
every n-th for a decoder of single pixels -> the same decoder over a range wider by :data:`WIDER` at either end ->
points outside the range that agree with their neighbours. An ordinary capture is not looked at twice.

A matcher makes false points of a surface that it does not search for. Simulated matt plates before ``oak-d-pro``,
``ensenso-n10``, ``realsense-d435`` and ``primesense-carmine-1.09``, out of range: up to 26 % of the image came back,
and 16 to 45 % of these points agreed with their neighbours. In range 99 % or more did. Of recordings of three Ensensos
and an OAK in range 82 to 95 % agreed, of the OAK's wall (``oak/wall_3470mm``) decoded from 0.3 to 1.2 m 41 %.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.reconstruction.cloud import Settings, capture_cloud
from mitsim.reconstruction.decoder_registry import technology_of
from mitsim.sensor.camera import Rig, stereo_rectification
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import TimeOfFlightSettings

#: a share of valid pixels under which almost nothing was decoded
ALMOST_NOTHING = 0.01

#: share of the points that agree with their neighbours under which they are not believed: between the shares out of
#: range and in range that are told above
BELIEVED = 0.6

#: share of the pixels that must stand outside the range together, and how many times as many as agree in range
CLEARLY, TIMES_AS_MANY = 0.05, 3.0

#: factor by which the coarse look goes nearer and farther than the decoder
WIDER = 8.0

#: columns of the coarse look, about
_COARSE_COLUMNS = 400

#: depths on one surface differ by less than this share from the median of the square of this side [px] around them
_SMOOTH, _AROUND = 0.02, 7

#: points of a cloud that are compared with their neighbours, at most
_SOME_POINTS = 2000

_TABLES = {MatcherSettings: "matcher", DecoderSettings: "decoder", TimeOfFlightSettings: "demodulation"}


@dataclass(frozen=True)
class SurfaceBeyond:
    """A surface outside the range: ``depths`` [mm] of the nearest and farthest tenth, ``share`` of the pixels [1]."""

    depths: tuple[float, float]
    share: float


def depths_of(points: NDArray[np.floating], rig: Rig, settings: Settings) -> NDArray[np.float64]:
    """Return depths (n,) [mm] of points (n, 3) in the sensor frame, along the axis in which a range is searched.

    It is that of the rectified left camera for a pair that is matched or decoded together, else of the first camera.
    """
    left = rig.reference
    axis = left.sensor_from_camera.rotation[:, 2]
    if _is_pair(rig, settings):
        left, right = list(rig.cameras.values())[:2]
        pair = rig.rectification or stereo_rectification(left, right)
        axis = left.sensor_from_camera.rotation @ pair.rotation_left.T[:, 2]
    return np.asarray((points - left.centre) @ axis)


def outside(what: str, depths: tuple[float, float], settings: Settings, sensor: str | None, known: str) -> str:
    """Word the warning: ``what`` stands at depths [mm] that its decoder does not search, and how that is ``known``.

    ``sensor``: whose file holds the decoder's settings; None where they are the capture's own.
    """
    near, far = (f"{depth:.0f}" for depth in depths)
    stands = f"{near} mm" if near == far else f"{near} to {far} mm"
    place = f"[{_TABLES.get(type(settings), 'decoder')}] of the sensor file of {sensor}"
    if sensor is None:
        place = "settings.json of the capture (mitsim import --range), or decode with --sensor"
    return (
        f"warning: {what} stands at a depth of {stands} ({known}), and the decoder searches {settings.near_mm:g} to "
        f"{settings.far_mm:g} mm: change near_mm and far_mm in {place}"
    )


def surface_beyond(capture: Capture, cloud: PointCloud, settings: Settings) -> SurfaceBeyond | None:
    """Look coarsely for a surface outside the range of a capture's decoder, if its ``cloud`` has almost no points.

    None if the cloud has points, or there is no clear surface outside the range; also where the wider range cannot be
    decoded.
    """
    decoded = float(cloud.valid.mean())
    believed = agreement(cloud)
    if decoded >= ALMOST_NOTHING and believed >= BELIEVED:
        return None
    wide = settings.model_copy(update={"near_mm": settings.near_mm / WIDER, "far_mm": settings.far_mm * WIDER})
    if isinstance(wide, MatcherSettings):  # binned texture is fainter, and steps of the device would hide the depth
        wide = wide.model_copy(update={"minimum_contrast_dn": wide.minimum_contrast_dn / 2, "disparity_step": 0.0})
    step = max(1, round(capture.rig.reference.width / _COARSE_COLUMNS))
    if isinstance(wide, MatcherSettings):
        step = max(2, step)
    try:
        found = capture_cloud(_coarse(capture, step, binned=isinstance(wide, MatcherSettings)), wide)
    except InputError:
        return None
    depth = _depth(found)
    smooth = (depth > 0) & (np.abs(depth - median_filter(depth, _AROUND, mode="nearest")) < _SMOOTH * depth)
    new = smooth & ((depth < settings.near_mm) | (depth > settings.far_mm))
    share = float(new.mean())
    if share < max(CLEARLY, TIMES_AS_MANY * believed * decoded):
        return None
    low, high = np.percentile(depth[new], [10, 90])
    return SurfaceBeyond((float(low), float(high)), share)


def agreement(cloud: PointCloud) -> float:
    """Return the share of a cloud's points that agree in depth with the median of 7 x 7 pixels around them, missing
    points counting as far off; of some of the points, evenly chosen. 1 for a cloud without points.
    """
    rows, columns = np.nonzero(cloud.valid)
    if not len(rows):
        return 1.0
    some = slice(None, None, -(-len(rows) // _SOME_POINTS))
    rows, columns = rows[some], columns[some]
    beside = np.arange(_AROUND) - _AROUND // 2
    height, width = cloud.status.shape
    around_rows = np.clip(rows[:, None, None] + beside[:, None], 0, height - 1)
    around_columns = np.clip(columns[:, None, None] + beside[None, :], 0, width - 1)
    origin, axis = cloud.grid.origin, cloud.grid.rotation[:, 2]
    around = np.nan_to_num((cloud.points[around_rows, around_columns].astype(float) - origin) @ axis)
    depth = (cloud.points[rows, columns].astype(float) - origin) @ axis
    middle = np.median(around.reshape(len(rows), -1), axis=1)
    return float(np.mean(np.abs(depth - middle) < _SMOOTH * depth))


def _depth(cloud: PointCloud) -> NDArray[np.float64]:
    """Depths (H, W) [mm] along the grid's axis, 0 where there is no point."""
    local = (cloud.points.astype(float) - cloud.grid.origin) @ cloud.grid.rotation[:, 2]
    return np.where(cloud.valid, local, 0.0)


def _is_pair(rig: Rig, settings: Settings) -> bool:
    joint = isinstance(settings, MatcherSettings) or (
        isinstance(settings, DecoderSettings) and settings.triangulate == "cameras"
    )
    return joint and len(rig.cameras) > 1


def _coarse(capture: Capture, step: int, *, binned: bool) -> Capture:
    """The capture with pixels of step x step (``binned``), or with every ``step``-th pixel of every such row.

    A device's own map stays as it is: taking its points costs nothing.
    """
    if step == 1 or technology_of(capture.technology).measured:
        return capture
    first = 0 if binned else step // 2
    images = {name: _fewer(stack, step, first, binned) for name, stack in capture.images.items()}
    cameras = {}
    for name, camera in capture.rig.cameras.items():
        shift = (step - 1) / 2 if binned else first
        height, width = images[name].shape[1:]
        cameras[name] = replace(camera, matrix=_fewer_px(camera.matrix, step, shift), width=width, height=height)
    pair = capture.rig.rectification
    if pair is not None:
        left, right = (_fewer_px(matrix, step, (step - 1) / 2) for matrix in (pair.matrix_left, pair.matrix_right))
        pair = replace(pair, matrix_left=left, matrix_right=right, width=pair.width // step, height=pair.height // step)
    settings: dict[str, Any] = dict(capture.settings)
    if "read_out" in settings:  # whole coarse pixels inside the part
        settings["read_out"] = {
            name: [-(-column // step), -(-row // step), max(width // step - 1, 1), max(height // step - 1, 1)]
            for name, (column, row, width, height) in settings["read_out"].items()
        }
    return replace(
        capture,
        images=images,
        rig=replace(capture.rig, cameras=cameras, rectification=pair),
        settings=settings,
        derived={},
    )


def _fewer(
    stack: NDArray[np.unsignedinteger[Any]], step: int, first: int, binned: bool
) -> NDArray[np.unsignedinteger[Any]]:
    """Images (n, H, W) of fewer pixels; means where binned, what is left over at the rims is cut."""
    if not binned:
        return np.ascontiguousarray(stack[:, first::step, first::step])
    count, height, width = len(stack), stack.shape[1] // step, stack.shape[2] // step
    tiles = stack[:, : height * step, : width * step].reshape(count, height, step, width, step)
    return np.asarray(np.rint(tiles.mean(axis=(2, 4)))).astype(stack.dtype)


def _fewer_px(matrix: NDArray[np.float64], step: int, shift: float) -> NDArray[np.float64]:
    """Camera matrix for pixels ``step`` apart, the first centred at pixel ``shift`` of the whole image."""
    fewer = matrix.copy()
    fewer[:2, 2] -= shift
    fewer[:2] /= step
    return fewer
