"""Match a rectified pair by census codes and semi-global matching, as depth cameras do in hardware.

Signal chain: 8-bit strips of both images, a stack of frames each -> code of each pixel: which pixels of a window are
darker than its middle -> number of different bits at each disparity, summed over the frames and over a block -> paths
(:mod:`mitsim.decoding.matching.sgbm_bands`) -> best disparity, uniqueness, sub-pixel step, and the best left match
of each right pixel by the same sums -> :class:`~mitsim.decoding.matching.sgbm.Matches`.

Sources: Zabih and Woodfill, ECCV 1994, for the code; Hirschmueller, IEEE PAMI 30(2), 2008, for the paths. A code does
not change if a camera is brighter or has more contrast, so that no equalisation is needed.

Smoothness penalties are multiplied by the area of the block, and refer to a code of 62 bits, that of 9 x 7 pixels in
terms of which authors state them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from mitsim.decoding.matching.sgbm import BUDGET_BYTES, Matches, both_ways_disagreement, pixels_matched_back
from mitsim.decoding.matching.sgbm_bands import (
    BlockCosts,
    Costs,
    Penalties,
    beside_each_other,
    rows_in_budget,
    summed_paths,
)
from mitsim.decoding.matching.sub_pixel import Fit, offset_of_minimum
from mitsim.sensor.matcher import MatcherSettings

Words = NDArray[np.uint64]

#: bits of the code to which the penalties refer
_BITS = 62

_LARGEST = np.iinfo(np.int16).max


def census_words(image: NDArray[np.uint8], window: int) -> list[Words]:
    """Return the code of each pixel of an image (h, W), in words (h, W) of up to 64 bits.

    A bit tells whether a pixel of the window, of ``window`` x ``window`` pixels without the middle one, is darker than
    the middle. Beyond the image, its edge is repeated.
    """
    height, width = image.shape
    reach = window // 2
    padded = np.pad(image, reach, mode="edge")
    places = [(down, right) for down in range(window) for right in range(window) if (down, right) != (reach, reach)]
    words = []
    for begin in range(0, len(places), 64):
        word = np.zeros(image.shape, np.uint64)
        for bit, (down, right) in enumerate(places[begin : begin + 64]):
            darker = padded[down : down + height, right : right + width] < image
            word |= darker.astype(np.uint64) << np.uint64(bit)
        words.append(word)
    return words


class _CensusCosts:
    """Number of different bits of the codes of both images, over all words."""

    def __init__(self, reference: list[Words], other: list[Words], count: int, shift: int) -> None:
        self.height, self.width, self.count = len(reference[0]), reference[0].shape[1] - count, count
        self.reference, self.shift = reference, shift
        self.compared = [beside_each_other(each, count) for each in other]

    def row(self, row: int) -> Costs:
        """Return the costs (w, count) of a row."""
        total = np.zeros((self.width, self.count), np.int16)
        for one, other in zip(self.reference, self.compared, strict=True):
            total += np.bitwise_count(one[row, self.count :, None] ^ other[row])
        return total >> self.shift


def match_census_both_ways(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    columns: tuple[int, int],
    first: int,
    count: int,
    settings: MatcherSettings,
    budget: float = BUDGET_BYTES,
) -> Matches:
    """Match columns of the left strips to the right strips, and in the reverse direction.

    Parameters
    ----------
    left, right
        (F, h, W) rectified strips [DN], the same rows of both.
    columns
        First left column to match, and one past the last.
    first, count
        Search range, from :func:`mitsim.decoding.matching.sgbm.search_range`.
    settings
        Window, block, penalties, uniqueness and sub-pixel fit.
    budget
        Memory for costs and sums [bytes]; it does not affect the result.

    See Also
    --------
    mitsim.decoding.matching.sgbm.match_both_ways : the same with OpenCV's costs
    """
    (begin, end), (_, height, whole) = columns, left.shape
    source, width = np.arange(begin - count, end), end - begin
    window = settings.census_window_px
    reference, other = (
        [word[:, np.clip(at, 0, whole - 1)] for frame in frames for word in census_words(frame, window)]
        for frames, at in ((left, source), (right, source - first))
    )
    bits = settings.block_size**2 * len(left) * (window**2 - 1)
    shift = _shift(bits, (settings.p1 + settings.p2) * bits / _BITS)
    scale = bits / _BITS / 2**shift
    p1 = max(round(settings.p1 * scale), 1)
    penalties = Penalties(
        settings.block_size, p1, max(round(settings.p2 * scale), p1 + 1), 0, settings.uniqueness_percent
    )
    fit: Fit = "equiangular" if settings.sub_pixel == "equiangular" else "parabola"
    found = np.full((height, width), np.nan, np.float32)
    back = np.full((height, width + 2 * count), np.nan, np.float32)
    exists = (source - first >= 0) & (source - first < whole)
    rows = rows_in_budget(budget, height, width, count)
    for row, total in summed_paths(
        BlockCosts(_CensusCosts(reference, other, count, shift), penalties), rows, settings.mode
    ):
        found[row] = _best_disparities(total, penalties.uniqueness, fit)
        back[row, : width + count][exists] = _best_of_right(total)[exists]
        del total  # a view of a whole band, which would live on beside the next
    matched_back = pixels_matched_back(back)[:, count : count + width]
    return Matches(found + np.float32(first), both_ways_disagreement(found, back, count), matched_back)


def _shift(bits: int, penalties: float) -> int:
    """Return the power of two by which costs are divided, so that sums fit into 16 bits.

    A path costs up to all bits of a block and the penalties. The sum of eight paths of a match, which differs in less
    than half of its bits, must not saturate.
    """
    return max(math.ceil(math.log2(max(bits + penalties, 4 * bits) / _LARGEST)), 0)


def _best_disparities(total: Costs, uniqueness: int, fit: Fit) -> NDArray[np.float32]:
    """Return disparities (w,) from a row's sums (w, count), NaN where another is nearly as good."""
    count, column = total.shape[1], np.arange(len(total))
    best = total.argmin(axis=1)
    beside = [np.clip(best + step, 0, count - 1) for step in (-1, 0, 1)]
    lower, least, upper = (total[column, each].astype(np.float32) for each in beside)
    competing = total * np.float32(100 - uniqueness) < 100 * least[:, None]
    for each in beside:
        competing[column, each] = False
    inside = (best > 0) & (best < count - 1)
    disparity = best + np.where(inside, offset_of_minimum(lower, least, upper, fit), 0)
    return np.where(competing.any(axis=1), np.nan, disparity).astype(np.float32)


def _best_of_right(total: Costs) -> NDArray[np.float32]:
    """Return the disparity (w + count,) of least sum of each right column; left column i sees i + count - k at k.

    NaN for columns that no left column sees.
    """
    width, count = total.shape
    padded = np.full((width + 2 * count, count), _LARGEST, np.int16)
    padded[count : count + width] = total
    step = padded.strides[0]
    seen = as_strided(padded, (width + count, count), (step, step + padded.strides[1]), writeable=False)
    best = seen.argmin(axis=1)
    known = np.take_along_axis(seen, best[:, None], axis=1)[:, 0] < _LARGEST
    return np.where(known, best, np.nan).astype(np.float32)
