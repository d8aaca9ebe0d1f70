"""Match a rectified pair by census codes and semi-global matching, as depth cameras do in hardware.

Signal chain: 8-bit strips of both images, a stack of frames each -> code of each pixel: which pixels of a window are
darker than its middle -> number of different bits at each disparity, summed over the frames and over a block -> paths
-> best disparity, uniqueness, sub-pixel step, and the best left match of each right pixel by the same sums ->
:class:`~mitsim.decoding.matching.sgbm.Matches`.

Sources: Zabih and Woodfill, ECCV 1994, for the code; Hirschmueller, IEEE PAMI 30(2), 2008, for the paths. A code does
not change if a camera is brighter or has more contrast, so that no equalisation is needed.

Smoothness penalties are multiplied by the area of the block, and refer to a code of 62 bits, that of 9 x 7 pixels in
terms of which authors state them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from numpy.typing import NDArray

from mitsim.decoding.matching.sgbm import Matches, both_ways_disagreement, pixels_matched_back, strips
from mitsim.decoding.matching.sub_pixel import Fit, offset_of_minimum
from mitsim.sensor.matcher import MatcherSettings

Words = NDArray[np.uint64]
Costs = NDArray[np.int16]

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


def match_census_both_ways(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    columns: tuple[int, int],
    first: int,
    count: int,
    settings: MatcherSettings,
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
        Window, block, penalties, paths, uniqueness and sub-pixel fit.

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
    penalties = _Penalties(p1, max(round(settings.p2 * scale), p1 + 1))
    fit: Fit = "equiangular" if settings.sub_pixel == "equiangular" else "parabola"
    found = np.full((height, width), np.nan, np.float32)
    back = np.full((height, width + 2 * count), np.nan, np.float32)
    exists = (source - first >= 0) & (source - first < whole)
    for shared, inner in strips(height, width, count):
        mine, theirs = ([each[shared] for each in words] for words in (reference, other))
        cost = _block_costs(mine, theirs, count, shift, settings.block_size, penalties)
        total = _summed_paths(cost, penalties, settings)
        for row, costs in enumerate(total[inner], shared.start + inner.start):
            found[row] = _best_disparities(costs, settings.uniqueness_percent, fit)
            back[row, : width + count][exists] = _best_of_right(costs)[exists]
    matched_back = pixels_matched_back(back)[:, count : count + width]
    return Matches(found + np.float32(first), both_ways_disagreement(found, back, count), matched_back)


def _shift(bits: int, penalties: float) -> int:
    """Return the power of two by which costs are divided, so that sums fit into 16 bits.

    A path costs up to all bits of a block and the penalties. The sum of eight paths of a match, which differs in less
    than half of its bits, must not saturate.
    """
    return max(math.ceil(math.log2(max(bits + penalties, 4 * bits) / _LARGEST)), 0)


@dataclass(frozen=True)
class _Penalties:
    """Smoothness penalties of a step of one pixel, and of larger ones."""

    p1: int
    p2: int


def _block_costs(
    reference: list[Words], other: list[Words], count: int, shift: int, block: int, penalties: _Penalties
) -> Costs:
    """Return costs (h, w, count): different bits of both codes over a block and all words, divided, plus P2."""
    height, width, reach = len(reference[0]), reference[0].shape[1] - count, block // 2
    # the pixels compared with column x, at x - d; the disparities of a column are adjacent in the mirrored image
    compared = [
        sliding_window_view(np.ascontiguousarray(each[:, ::-1]), count, axis=1)[:, :width][:, ::-1] for each in other
    ]
    along = np.empty((height, width, count), np.int16)
    for row in range(height):
        bits = np.zeros((width, count), np.int16)
        for word, words in zip(reference, compared, strict=True):
            bits += np.bitwise_count(word[row, count:, None] ^ words[row])
        padded = np.pad(bits >> shift, ((reach, reach), (0, 0)), mode="edge")
        along[row] = sum(padded[step : step + width] for step in range(2 * reach + 1))
    out = np.full_like(along, penalties.p2)
    for row in range(height):
        for step in range(-reach, reach + 1):
            out[row] += along[min(max(row + step, 0), height - 1)]
    return out


def _summed_paths(cost: Costs, penalties: _Penalties, settings: MatcherSettings) -> Costs:
    """Return the sums (h, w, count) of the paths that end in each pixel.

    All eight paths for the mode ``hh``. One pass over the image, as in hardware, has none from below: both along the
    row and the three from above for ``sgbm``, or the one straight from above for ``3way``.
    """
    height, width, count = cost.shape
    total = np.zeros_like(cost)
    for columns in (range(width), range(width - 1, -1, -1)):
        path, least = np.zeros((height, count), np.int16), np.zeros(height, np.int16)
        for column in columns:
            path = _next_path_costs(path, least, cost[:, column], penalties)
            least = path.min(axis=1)
            _add_saturated(total[:, column], path)
    ways = [range(height), range(height - 1, -1, -1)] if settings.mode == "hh" else [range(height)]
    for rows in ways:
        # from the column before, the same and the next; beyond the image paths are 0, as in OpenCV
        paths, leasts = np.zeros((3, width + 2, count), np.int16), np.zeros((3, width + 2), np.int16)
        for row in rows:
            for direction in (1,) if settings.mode == "3way" else (0, 1, 2):
                before = slice(direction, direction + width)
                path = _next_path_costs(paths[direction, before], leasts[direction, before], cost[row], penalties)
                paths[direction, 1:-1], leasts[direction, 1:-1] = path, path.min(axis=1)
                _add_saturated(total[row], path)
    return total


def _next_path_costs(previous: Costs, least: Costs, cost: Costs, penalties: _Penalties) -> Costs:
    """Return the path costs (..., count) one pixel further, by formula 13 of Hirschmueller.

    ``previous`` (..., count) are the costs one pixel before, and ``least`` (...) their minima.
    """
    limit, stepped = least[..., None] + np.int16(penalties.p2), previous + np.int16(penalties.p1)
    path: Costs = np.minimum(previous, limit)
    np.minimum(path[..., 1:], stepped[..., :-1], out=path[..., 1:])
    np.minimum(path[..., :-1], stepped[..., 1:], out=path[..., :-1])
    path -= limit
    path += cost
    return path


def _add_saturated(total: Costs, term: Costs) -> None:
    """Add in place, limited to the largest 16-bit integer."""
    np.minimum(total, np.int16(_LARGEST) - term, out=total)
    total += term


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
