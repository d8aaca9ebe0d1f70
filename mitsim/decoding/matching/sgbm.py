"""Match a rectified pair by semi-global matching, from the left and from the right, with OpenCV.

Signal chain: 8-bit strips of both images -> columns within the search range, with repeated edges -> SGBM left to right
-> the same for the mirrored, exchanged pair -> :class:`Matches`.

The method is that of Hirschmueller (IEEE PAMI 30(2), 2008) with OpenCV's block costs. These are Birchfield-Tomasi
differences of the clipped horizontal gradient, summed over a block. The smoothness penalties are P1 for steps of one
pixel and P2 for larger ones. Both are scaled by the block's area, as OpenCV documents (P1 = 8 block^2, P2 = 32 block^2
by default).

Disparities have steps of 1/16 px. They are biased toward whole pixels (pixel locking) by up to 0.14 px at 3/8 of a
pixel. Modes of one pass have no paths from below: where the disparity changes from row to row, they follow it late.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from mitsim.sensor.camera import Rectification
from mitsim.sensor.matcher import MatcherSettings

_MODES = {
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
}


@dataclass(frozen=True)
class Matches:
    """Results of both directions for a strip of left pixels (h, w).

    A pixel without a match from the right image is hidden from the right camera. This is Hirschmueller's way to
    distinguish occlusions from mismatches.

    - ``disparity``: x_left - x_right [px], NaN without a unique match.
    - ``disagreement``: difference [px] from the disparity that the right image has at the matched position. NaN if it
      has none, or the position is outside the image.
    - ``matched_back``: whether the best match of a right pixel is this pixel or one beside it.
    """

    disparity: NDArray[np.float32]
    disagreement: NDArray[np.float32]
    matched_back: NDArray[np.bool_]


#: memory for the costs of all paths [bytes]; beyond it, strips of rows are matched by themselves
LARGEST_BYTES = 4e9

#: rows that strips share: a path carries the effect of a cut over some 100 rows where the pattern is faint
_SHARED_ROWS = 100

#: grey levels [DN of 8 bit] to which a local standard deviation is scaled; the range holds +-2.6 of them
_TARGET_DEVIATION_DN = 48.0

#: added to the local standard deviation [DN], so that noise in areas without texture is not amplified to full contrast
_DEVIATION_FLOOR_DN = 0.5


def local_contrast(image: NDArray[np.uint8], window: int) -> NDArray[np.uint8]:
    """Return an image (h, w) with its local mean subtracted and its local standard deviation made equal.

    ``window`` is the side of the neighbourhood [px]; 0 returns the image unchanged.

    A surface with a highlight toward one camera only has a different brightness and contrast in the two images. SGBM
    compares grey levels, and would lose it. Without equal contrast, the effect of the smoothness penalties also depends
    on the exposure.
    """
    if window == 0:
        return image
    size = (window, window)
    values = image.astype(np.float32)
    mean = cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.boxFilter(values * values, -1, size, borderType=cv2.BORDER_REPLICATE)
    deviation = np.sqrt(np.maximum(square - mean * mean, 0))
    scaled = 128 + _TARGET_DEVIATION_DN * (values - mean) / (deviation + _DEVIATION_FLOOR_DN)
    return np.asarray(np.clip(np.rint(scaled), 0, 255)).astype(np.uint8)


def search_range(rectification: Rectification, settings: MatcherSettings) -> tuple[int, int]:
    """Return the first disparity [px] and the number of disparities that contain the range of depths.

    The number is a multiple of 16, rounded up at the near end. One pixel is added at each end for the sub-pixel step.

    Raises
    ------
    InputError
        If no pixel of the right image shows anything between ``near_mm`` and ``far_mm``.
    """
    limit = rectification.width - 1  # beyond it, no column of an image has its match in the other
    smallest, largest = (float(rectification.disparity(depth)) for depth in (settings.far_mm, settings.near_mm))
    if not np.isfinite([smallest, largest]).all() or smallest > limit or largest < -limit:
        raise InputError(
            "matcher settings",
            "near_mm, far_mm",
            f"{settings.near_mm} to {settings.far_mm} mm",
            "depths that both cameras can see, at a finite disparity",
        )
    first = max(int(np.floor(smallest)) - 1, -limit)
    last = min(int(np.ceil(largest)) + 1, limit)
    return first, 16 * -(-(last - first + 1) // 16)


def strips(height: int, width: int, count: int) -> Iterator[tuple[slice, slice]]:
    """Yield strips of rows that fit into :data:`LARGEST_BYTES`, with the rows that they share, and their parts without.

    ``height``, ``width`` [px] and the number of disparities, ``count``, have costs and sums of 16 bits. Images beyond
    4 GB differ from those matched as a whole in some 1 % of the pixels beside a cut.
    """
    most = max(int(LARGEST_BYTES / (4 * width * count)), 1)
    rows = height if most >= height else max(most - 2 * _SHARED_ROWS, _SHARED_ROWS)
    for top in range(0, height, rows):
        begin = max(top - _SHARED_ROWS, 0)
        yield slice(begin, min(top + rows + _SHARED_ROWS, height)), slice(top - begin, min(top + rows, height) - begin)


def match_both_ways(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    columns: tuple[int, int],
    first: int,
    count: int,
    settings: MatcherSettings,
) -> Matches:
    """Match columns of the left strip to the right strip, and in the reverse direction.

    Parameters
    ----------
    left, right
        (h, W) rectified strips [DN], the same rows of both.
    columns
        First left column to match, and one past the last.
    first, count
        Search range, from :func:`search_range`.
    settings
        Block size, penalties and uniqueness.
    """
    begin, end = columns
    width = end - begin
    # Shift the right strip by `first`, so that the search starts at 0. Add `count` columns on both sides, since SGBM
    # finds nothing where part of its range is outside the image. Outside the image, the edge is repeated.
    source = np.arange(begin - count, end + count)
    last_column = left.shape[1] - 1
    padded_left = left[:, np.clip(source, 0, last_column)]
    padded_right = right[:, np.clip(source - first, 0, last_column)]

    # From the right: only right columns that exist. Uniqueness is required of the left match only; here only the
    # position counts.
    start = max(0, count - begin + first)
    stop = max(start, min(count + width, right.shape[1] + count - begin + first))
    mirrored_columns = slice(start, stop + count)
    pairs = [(padded_left[:, : count + width], padded_right[:, : count + width], settings.uniqueness_percent)]
    if start < stop:
        pairs.append((padded_right[:, mirrored_columns][:, ::-1], padded_left[:, mirrored_columns][:, ::-1], 0))
    # OpenCV's matcher uses one core, so both directions together take the time of one
    workers = 1 if settings.mode == "hh" and 8 * left.shape[0] * width * count > LARGEST_BYTES else 2
    from_left, *from_right = in_threads(
        lambda pair: _disparities(pair[0], pair[1], count, settings, pair[2]), pairs, workers
    )
    disparities = from_left[:, count:]
    back = np.full((left.shape[0], padded_left.shape[1]), np.nan, np.float32)
    if from_right:
        back[:, start:stop] = from_right[0][:, count:][:, ::-1]

    matched_back = pixels_matched_back(back)[:, count : count + width]
    return Matches(disparities + np.float32(first), both_ways_disagreement(disparities, back, count), matched_back)


def _disparities(
    reference: NDArray[np.uint8], other: NDArray[np.uint8], count: int, settings: MatcherSettings, uniqueness: int
) -> NDArray[np.float32]:
    """Return disparities from 0 on [px], NaN where the matcher found none (which it writes as -1).

    OpenCV adds the offset of its parabola [1/16 px] to the whole disparity, with a division that rounds toward zero.
    Negative offsets are therefore one step too large, and zero represents -1.5 to 0.5. The mean bias would be 0.03 px.
    Here each step becomes the middle of the interval that it represents, unless ``settings.sub_pixel`` is ``opencv``.
    """
    reference, other = np.ascontiguousarray(reference), np.ascontiguousarray(other)
    height, width = reference.shape
    if width - count <= settings.block_size // 2:  # OpenCV refuses fewer columns
        return np.full((height, width), np.nan, np.float32)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=settings.block_size,
        P1=round(settings.p1 * settings.block_size**2),
        P2=round(settings.p2 * settings.block_size**2),
        disp12MaxDiff=-1,
        preFilterCap=settings.prefilter_cap,
        uniquenessRatio=uniqueness,
        speckleWindowSize=0,
        speckleRange=0,
        mode=_MODES[settings.mode],
    )
    # the other modes hold the costs of one row
    parts = strips(height, width - count, count) if settings.mode == "hh" else [(slice(None), slice(None))]
    disparities = [matcher.compute(reference[shared], other[shared])[inner] for shared, inner in parts]
    sixteenths = np.concatenate(disparities).astype(np.float32)
    if settings.sub_pixel == "opencv":
        return np.where(sixteenths < 0, np.float32(np.nan), sixteenths / 16)
    offset = np.mod(sixteenths, 16)  # 0 to 8 are not negative; 9 to 15 are -7 to -1
    too_large = np.where(offset > 8, np.float32(1), np.where(offset == 0, np.float32(0.5), np.float32(0)))
    return np.where(sixteenths < 0, np.float32(np.nan), (sixteenths - too_large) / 16)


def both_ways_disagreement(
    disparities: NDArray[np.float32], back: NDArray[np.float32], count: int
) -> NDArray[np.float32]:
    """Return the least difference [px] between a left match and the matches of the two right pixels at its position.

    ``disparities`` (h, w) are of left pixels, less the first of the range, ``back`` (h, w + 2 count) of right pixels;
    ``count`` is the number of disparities.
    """
    right_column = np.arange(count, count + disparities.shape[1], dtype=np.float32) - disparities
    matched = np.isfinite(disparities)
    column = np.floor(np.where(matched, right_column, 0)).astype(np.intp)
    next_column = np.minimum(column + (right_column > column), back.shape[1] - 1)
    lower = np.abs(np.take_along_axis(back, column, axis=1) - disparities)
    upper = np.abs(np.take_along_axis(back, next_column, axis=1) - disparities)
    return np.asarray(np.fmin(lower, upper))


def pixels_matched_back(back: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the left pixels that are the match of a right pixel, or lie beside one."""
    rows, columns = np.nonzero(np.isfinite(back))
    matched_back = np.zeros(back.shape, np.uint8)
    matched_back[rows, columns + np.rint(back[rows, columns]).astype(np.intp)] = 1
    return np.asarray(cv2.dilate(matched_back, np.ones((1, 3), np.uint8)) > 0)
