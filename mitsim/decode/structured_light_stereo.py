"""Structured light with two cameras: the code only says which pixels see the same place; the cameras measure it.

Signal chain: images of both cameras [DN] -> projector coordinate u seen by each raw pixel -> coordinates (not images)
rectified -> along each row, the place in the right image that has the left pixel's u, between two neighbours that
enclose it -> disparity d [px] -> depth Z = f B / (d + cx_right - cx_left) [mm] -> points on the rectified left grid.

The projector needs no calibration and may have any distortion: it only has to show the same code to both. A rectified
pixel interpolates four raw ones, and has a coordinate only if all four have.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from mitsim.decode.projector_coordinate import ProjectorCoordinate
from mitsim.decode.stereo import StereoGeometry, stereo_geometry
from mitsim.decode.structured_light import decode_coordinates
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode, axes

#: neighbours whose coordinates differ by more than this [projector px] lie on the two sides of an edge
LARGEST_STEP_PX = 8.0


def decode_structured_light_stereo(
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    rig: Rig | StereoGeometry,
    code: LightCode,
    settings: DecoderSettings,
    *,
    projector_size: tuple[int, int],
    sensor: str,
    source: str,
    full_scale: float,
    imager: Imager | None = None,
) -> PointCloud:
    """Decode the images that two cameras took of one code.

    Parameters
    ----------
    left, right
        (P, H, W) raw images [DN] of the first and second camera of the rig, in the order of
        :func:`mitsim.sensor.light_code.roles`.
    rig
        The calibration of the cameras, or the geometry made of it by :func:`mitsim.decode.stereo.stereo_geometry`.
    projector_size
        Width and height of the pattern [px].
    imager
        Its noise is what phases of different periods are held against; the cloud's own is not told, because rectified
        coordinates are interpolated.

    Returns
    -------
    PointCloud
        On the rectified left grid, points in the sensor frame [mm]. A pixel whose coordinate the right image does not
        show in its row is ``HIDDEN``, one whose coordinate it shows more than once ``AMBIGUOUS``.

    Raises
    ------
    InputError
        If the code does not run along the columns, or the images are not what code and calibration say.
    """
    if "columns" not in axes(code):
        raise InputError(
            "pattern", "axis", ", ".join(axes(code)), "'columns' or 'both', for cameras that stand side by side"
        )
    geometry = rig if isinstance(rig, StereoGeometry) else stereo_geometry(rig)
    for name, stack, size in zip(("left", "right"), (left, right), geometry.raw_size, strict=True):
        if stack.shape[1:] != size:
            raise InputError(f"{name} images", "shape", stack.shape, f"(images, {size[0]}, {size[1]})")
    grid, rectification = geometry.grid, geometry.rectification
    seen = [
        decode_coordinates(stack, code, *projector_size, settings, full_scale=full_scale, imager=imager)
        for stack in (left, right)
    ]
    u_left = _rectified(seen[0]["columns"], geometry.map_left, geometry.seen_left)
    u_right = _rectified(seen[1]["columns"], geometry.map_right, geometry.seen_right)

    place, several = np.full(u_left.shape, np.nan), np.zeros(u_left.shape, bool)
    for row in range(grid.height):
        place[row], several[row] = _same_coordinate(u_left[row], u_right[row])
    depth = rectification.depth(np.arange(grid.width) - place)
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)

    raw_status = seen[0]["columns"].status
    status = cv2.remap(raw_status, geometry.map_left[0], geometry.map_left[1], cv2.INTER_NEAREST)
    status = np.where(status == Status.VALID, np.uint8(Status.HIDDEN), status)
    found = np.isfinite(place)
    status = np.where(found, np.where(in_range, Status.VALID, Status.OUT_OF_RANGE), status)
    status[several] = Status.AMBIGUOUS
    status[~geometry.seen_left] = Status.NO_SURFACE
    local = grid.rays() @ grid.rotation
    points = (local / local[..., 2:] * depth[..., None]) @ grid.rotation.T + grid.origin
    points[status != Status.VALID] = np.nan
    return PointCloud(
        points.astype(np.float32), status.astype(np.uint8), grid, sensor, source, geometry.baseline
    )  # fmt: skip


def _rectified(
    coordinate: ProjectorCoordinate, positions: NDArray[np.float32], seen: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Coordinate shown by each rectified pixel; NaN if one of its four raw pixels has none."""
    # not cv2.remap, which rounds positions to 1/32 px
    out = map_coordinates(coordinate.value, positions[::-1], order=1, mode="constant", cval=np.nan)
    return np.where(seen, out, np.nan)


def _same_coordinate(
    wanted: NDArray[np.float64], row: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where a row (W,) has the ``wanted`` coordinates (w,): columns, NaN if nowhere; and whether in several places.

    Linear between neighbouring pixels that rise, as they do wherever camera and projector see a surface from the same
    side.
    """
    columns = np.flatnonzero(np.isfinite(row[:-1]) & np.isfinite(row[1:]))
    step = row[columns + 1] - row[columns]
    columns = columns[(step > 0) & (step <= LARGEST_STEP_PX)]
    place, several = np.full(wanted.shape, np.nan), np.zeros(wanted.shape, bool)
    asked = np.flatnonzero(np.isfinite(wanted))
    if columns.size == 0 or asked.size == 0:
        return place, several
    low, high = row[columns], row[columns + 1]
    # how many pieces begin at or below a coordinate, less how many end there, is how many enclose it
    u = wanted[asked]
    begun = np.searchsorted(np.sort(low), u, side="right")
    ended = np.searchsorted(np.sort(high), u, side="right")
    several[asked] = begun - ended > 1
    once = begun - ended == 1
    # nearly always it is the piece that began last; where that one has ended and an older encloses u, none is taken
    order = np.argsort(low)
    piece = order[begun[once] - 1]
    enclosed = u[once] < high[piece]
    fraction = (u[once] - low[piece]) / (high[piece] - low[piece])
    place[asked[once]] = np.where(enclosed, columns[piece] + fraction, np.nan)
    return place, several
