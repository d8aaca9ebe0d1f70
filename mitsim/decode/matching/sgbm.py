"""Semi-global matching of a rectified pair, from the left and from the right, by OpenCV.

Signal chain: 8-bit strips of both images -> columns that the search can reach, edges repeated -> SGBM left to right
-> the same on the mirrored, exchanged pair -> :class:`Matches`.

The method is Hirschmueller's (IEEE PAMI 30(2), 2008) with OpenCV's block costs: a Birchfield-Tomasi difference of the
clipped horizontal gradient, summed over a block, and smoothness penalties P1 (steps of one pixel) and P2 (more), both
scaled by the block's area as OpenCV documents (P1 = 8 block^2, P2 = 32 block^2 by default). Disparities come in steps
of 1/16 px, and are drawn toward whole pixels ("pixel locking") by up to 0.14 px at quarters of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.threads import in_threads
from mitsim.decode.matching.sgbm_bands import (
    Penalties,
    bytes_by_opencv,
    bytes_of_band,
    fits,
    match_in_bands,
    rows_within,
)
from mitsim.sensor.camera import Rectification
from mitsim.sensor.matcher import MatcherSettings

_MODES = {
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
}


@dataclass(frozen=True)
class Matches:
    """What both directions say about a strip of left pixels (h, w).

    ``disparity`` x_left - x_right [px], NaN without a unique match; ``disagreement`` [px] to the disparity that the
    right image finds at the matched place, NaN where it finds none or the place lies outside of it; ``claimed``: some
    right pixel has its best match here or one pixel beside. A pixel that none claims is hidden from the right camera;
    so does Hirschmueller tell occlusions from mismatches.
    """

    disparity: NDArray[np.float32]
    disagreement: NDArray[np.float32]
    claimed: NDArray[np.bool_]


#: memory for costs and sums of both ways [bytes]; with images, maps and the interpreter the process stays
#: under 1.5 GB (1.3 GB for 1280 x 1024 pixels from 275 to 3878 mm)
BUDGET_BYTES = 0.8e9

#: grey levels of 8 bit that one local standard deviation becomes; +-2.6 of them fill the range
_CONTRAST_DN = 48.0

#: added to the local standard deviation [DN], so that blank areas are not blown up to full contrast
_CONTRAST_FLOOR_DN = 0.5


def local_contrast(image: NDArray[np.uint8], window: int) -> NDArray[np.uint8]:
    """Image (h, w) with the local mean taken away and the local standard deviation made equal; 0 leaves it alone.

    A surface that shines toward one camera and not toward the other shows them the same pattern at different
    brightness and contrast. SGBM compares grey levels, so without this it loses such surfaces, and its smoothness
    penalties mean something else at every exposure.
    """
    if window == 0:
        return image
    size = (window, window)
    values = image.astype(np.float32)
    mean = cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.boxFilter(values * values, -1, size, borderType=cv2.BORDER_REPLICATE)
    deviation = np.sqrt(np.maximum(square - mean * mean, 0))
    scaled = 128 + _CONTRAST_DN * (values - mean) / (deviation + _CONTRAST_FLOOR_DN)
    return np.asarray(np.clip(np.rint(scaled), 0, 255)).astype(np.uint8)


def search_range(rectification: Rectification, settings: MatcherSettings) -> tuple[int, int]:
    """First disparity [px] and number of disparities (a multiple of 16) that hold ``near_mm`` to ``far_mm``.

    One pixel more at either end leaves room for the sub-pixel step; the rounding to 16 goes to the near side.

    Raises
    ------
    InputError
        If no pixel of the right image shows anything between ``near_mm`` and ``far_mm``.
    """
    limit = rectification.width - 1  # beyond it, no column of the one image has its partner in the other
    least, most = (float(rectification.disparity(depth)) for depth in (settings.far_mm, settings.near_mm))
    if not np.isfinite([least, most]).all():
        raise InputError(
            "matcher settings",
            "near_mm, far_mm",
            f"{settings.near_mm} to {settings.far_mm} mm",
            "depths whose disparity is a number",
        )
    first = max(int(np.floor(least)) - 1, -limit)
    last = min(int(np.ceil(most)) + 1, limit)
    if least > limit or most < -limit:
        raise InputError(
            "matcher settings",
            "near_mm, far_mm",
            f"{settings.near_mm} to {settings.far_mm} mm",
            "depths that both cameras can see",
        )
    return first, 16 * -(-(last - first + 1) // 16)


def match_both_ways(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    columns: tuple[int, int],
    first: int,
    count: int,
    settings: MatcherSettings,
    budget: float = BUDGET_BYTES,
) -> Matches:
    """Match columns of the left strip against the right strip, and back.

    Parameters
    ----------
    left, right
        (h, W) rectified strips, the same rows of both.
    columns
        First and one past the last left column to be matched.
    first, count
        The search range, from :func:`search_range`.
    settings
        Block, penalties and uniqueness.
    budget
        Memory [bytes] for costs and sums. The result does not depend on it: what OpenCV would need more for is matched
        one way after the other, or in bands (:mod:`mitsim.decode.matching.sgbm_bands`).
    """
    begin, end = columns
    width = end - begin
    # Shift the right strip by `first`, so that the search runs from 0, and bring in `count` columns on both sides, so
    # that SGBM, which gives up where part of its range leaves the image, gives up nowhere. Outside: repeat the edge.
    source = np.arange(begin - count, end + count)
    inside = left.shape[1] - 1
    padded_left = left[:, np.clip(source, 0, inside)]
    padded_right = right[:, np.clip(source - first, 0, inside)]

    # Back: only right columns that exist. Uniqueness has been asked of the left match; here only the place counts.
    start = max(0, count - begin + first)
    stop = max(start, min(count + width, right.shape[1] + count - begin + first))
    reach = slice(start, stop + count)
    share, ways = _memory(settings, left.shape[0], max(width, stop - start), count, budget)
    pairs = [(padded_left[:, : count + width], padded_right[:, : count + width], settings.uniqueness_percent)]
    if start < stop:
        pairs.append((padded_right[:, reach][:, ::-1], padded_left[:, reach][:, ::-1], 0))
    # OpenCV's matcher runs on one core: both ways take the time of one
    forth, *mirrored = in_threads(lambda pair: _steps(pair[0], pair[1], count, settings, pair[2], share), pairs, ways)
    found = forth[:, count:]
    back = np.full((left.shape[0], padded_left.shape[1]), np.nan, np.float32)
    if mirrored:
        back[:, start:stop] = mirrored[0][:, count:][:, ::-1]

    claimed = claimed_pixels(back)[:, count : count + width]
    return Matches(found + np.float32(first), both_ways_disagreement(found, back, count), claimed)


def _sgbm(count: int, settings: MatcherSettings, uniqueness: int) -> cv2.StereoSGBM:
    area = settings.block_size**2
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=settings.block_size,
        P1=round(settings.p1 * area),
        P2=round(settings.p2 * area),
        disp12MaxDiff=-1,
        preFilterCap=settings.prefilter_cap,
        uniquenessRatio=uniqueness,
        speckleWindowSize=0,
        speckleRange=0,
        mode=_MODES[settings.mode],
    )


def _memory(settings: MatcherSettings, height: int, width: int, count: int, budget: float) -> tuple[float, int]:
    """Memory [bytes] that each way may take, and how many ways at once."""
    whole = bytes_by_opencv(height, width, count)
    if settings.mode != "hh" or 2 * whole <= budget:
        return budget, 2
    if whole <= budget or not fits(_penalties(settings, 0)):
        return budget, 1
    rows = rows_within(budget / 2, height, width, count)
    return (budget / 2, 2) if bytes_of_band(rows, height, width, count) <= budget / 2 else (budget, 1)


def _penalties(settings: MatcherSettings, uniqueness: int) -> Penalties:
    area = settings.block_size**2
    p1, p2 = round(settings.p1 * area), round(settings.p2 * area)
    return Penalties(settings.block_size, p1, p2, settings.prefilter_cap, uniqueness)


def _steps(
    reference: NDArray[np.uint8],
    other: NDArray[np.uint8],
    count: int,
    settings: MatcherSettings,
    uniqueness: int,
    budget: float,
) -> NDArray[np.float32]:
    """Disparities from 0 up [px], NaN where the matcher found none (it then writes -1).

    OpenCV adds the offset of its parabola [1/16 px] to the whole disparity with a division that rounds toward zero:
    offsets under zero come out one step too large, and zero stands for -1.5 to 0.5. Left alone, that is a mean bias of
    0.03 px; here every step stands for the middle of what it can mean.
    """
    reference, other = np.ascontiguousarray(reference), np.ascontiguousarray(other)
    height, width = reference.shape[0], reference.shape[1] - count
    penalties = _penalties(settings, uniqueness)
    if settings.mode != "hh" or bytes_by_opencv(height, width, count) <= budget or not fits(penalties):
        found = _sgbm(count, settings, uniqueness).compute(reference, other)
    else:
        found = match_in_bands(reference, other, count, penalties, rows_within(budget, height, width, count))
    sixteenths = found.astype(np.float32)
    offset = np.mod(sixteenths, 16)  # 0 to 8: not under zero; 9 to 15: -7 to -1
    too_large = np.where(offset > 8, np.float32(1), np.where(offset == 0, np.float32(0.5), np.float32(0)))
    return np.where(sixteenths < 0, np.float32(np.nan), (sixteenths - too_large) / 16)


def both_ways_disagreement(found: NDArray[np.float32], back: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Smallest difference between a left match and the two right pixels around its place."""
    place = np.arange(count, count + found.shape[1], dtype=np.float32) - found
    matched = np.isfinite(found)
    floor = np.floor(np.where(matched, place, 0)).astype(np.intp)
    beside = np.minimum(floor + (place > floor), back.shape[1] - 1)
    lower = np.abs(np.take_along_axis(back, floor, axis=1) - found)
    upper = np.abs(np.take_along_axis(back, beside, axis=1) - found)
    return np.asarray(np.fmin(lower, upper))


def claimed_pixels(back: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Left pixels that are the match of a right pixel, or lie beside one."""
    rows, columns = np.nonzero(np.isfinite(back))
    claimed = np.zeros(back.shape, np.uint8)
    claimed[rows, columns + np.rint(back[rows, columns]).astype(np.intp)] = 1
    return np.asarray(cv2.dilate(claimed, np.ones((1, 3), np.uint8)) > 0)
