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
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from numpy.typing import NDArray

from mitsim.decoding.matching.sgbm import Matches, both_ways_disagreement, pixels_matched_back, strips
from mitsim.decoding.matching.sub_pixel import SubPixelFit, offset_of_minimum
from mitsim.sensor.matcher import MatcherSettings

Words = NDArray[np.unsignedinteger[Any]]
Costs = NDArray[np.int16]

#: bits of the code to which the penalties refer
_BITS = 62

_LARGEST = np.iinfo(np.int16).max


def census_words(image: NDArray[np.uint8], window: int) -> list[Words]:
    """Return the code of each pixel of an image (h, W), in words (h, W) of the fewest bytes that hold it.

    A bit tells whether a pixel of the window, of ``window`` x ``window`` pixels without the middle one, is darker than
    the middle. Beyond the image, its edge is repeated.
    """
    height, width = image.shape
    reach = window // 2
    padded = np.pad(image, reach, mode="edge")
    offsets = [(down, right) for down in range(window) for right in range(window) if (down, right) != (reach, reach)]
    words = list[Words]()
    for begin in range(0, len(offsets), 64):
        block = offsets[begin : begin + 64]
        size = next(size for size in (1, 2, 4, 8) if 8 * size >= len(block))
        # bit by bit in a byte of its own, with an eighth of the memory that a word has
        code = np.zeros((*image.shape, size), np.uint8)
        byte, darker = np.empty(image.shape, np.uint8), np.empty(image.shape, bool)
        for number in range(0, len(block), 8):
            byte[:] = 0
            for down, right in block[number : number + 8]:
                np.less(padded[down : down + height, right : right + width], image, out=darker)
                np.add(byte, byte, out=byte)
                byte |= darker.view(np.uint8)
            code[..., number // 8] = byte
        words.append(code.view(f"u{size}")[..., 0])
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
    fit: SubPixelFit = "equiangular" if settings.sub_pixel == "equiangular" else "parabola"
    disparities = np.full((height, width), np.nan, np.float32)
    back = np.full((height, width + 2 * count), np.nan, np.float32)
    exists = (source - first >= 0) & (source - first < whole)
    for shared, inner in strips(height, width, count):
        mine, theirs = ([word[shared] for word in words] for words in (reference, other))
        cost = _block_costs(mine, theirs, count, shift, settings.block_size)
        total = _summed_paths(cost, penalties, settings.mode)[inner]
        rows = slice(shared.start + inner.start, shared.start + inner.stop)
        least = _least_sums(total)
        disparities[rows] = _best_disparities(least, count, settings.uniqueness_percent, fit)
        back[rows, : width + count][:, exists] = least.of_right[:, exists]
    matched_back = pixels_matched_back(back)[:, count : count + width]
    return Matches(disparities + np.float32(first), both_ways_disagreement(disparities, back, count), matched_back)


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


def _block_costs(reference: list[Words], other: list[Words], count: int, shift: int, block: int) -> Costs:
    """Return costs (h, count, w): different bits of both codes over a block and all words, divided.

    The pixels of a row are adjacent, so that every sum and minimum over disparities runs along them.
    """
    height, width, reach = len(reference[0]), reference[0].shape[1] - count, block // 2
    # the pixels compared with column x, at x - d
    compared = [sliding_window_view(codes, width, axis=1)[:, count:0:-1] for codes in other]
    along = np.empty((height, count, width), np.int16)
    different, bits = [np.empty((count, width), codes.dtype) for codes in reference], np.empty((count, width), np.uint8)
    padded = np.empty((count, width + 2 * reach), np.int16)
    middle = padded[:, reach : reach + width]
    for row, sums in enumerate(along):
        middle[:] = 0
        for word, words, differing in zip(reference, compared, different, strict=True):
            np.bitwise_xor(word[row, count:], words[row], out=differing)
            middle += np.bitwise_count(differing, out=bits)
        if shift:
            middle >>= shift
        padded[:, :reach], padded[:, reach + width :] = middle[:, :1], middle[:, -1:]
        sums[:] = padded[:, :width]
        for step in range(1, block):
            sums += padded[:, step : step + width]
    if block == 1:
        return along
    out = np.empty_like(along)
    for row, sums in enumerate(out):
        if row == 0:
            sums[:] = along[0]
            for step in range(1, reach + 1):
                sums += along[0]
                sums += along[min(step, height - 1)]
        else:
            np.add(out[row - 1], along[min(row + reach, height - 1)], out=sums)
            sums -= along[max(row - reach - 1, 0)]
    return out


#: rows whose costs are turned at once, so that their columns become lines
_TOGETHER = 512


def _summed_paths(cost: Costs, penalties: _Penalties, mode: str) -> Costs:
    """Return the sums (h, count, w) of the paths that end in each pixel.

    All eight paths for the mode ``hh``. One pass over the image, as in hardware, has none from below: both along the
    row and the three from above for ``sgbm``, or the one straight from above for ``3way``.
    """
    _, count, width = cost.shape
    directions, orders = (1,) if mode == "3way" else (0, 1, 2), (1, -1) if mode == "hh" else (1,)
    saturates = (2 + len(directions) * len(orders)) * (int(cost.max()) + penalties.p2) > _LARGEST
    total = np.empty_like(cost)
    for begin in range(0, len(cost), _TOGETHER):
        band = cost[begin : begin + _TOGETHER]
        columns = np.empty((count, width, len(band)), np.int16)
        cv2.transpose(band.reshape(len(band), -1), columns.reshape(-1, len(band)))
        sums = np.zeros_like(columns)
        for order in (1, -1):
            _add_paths(sums.swapaxes(0, 1)[::order], columns.swapaxes(0, 1)[::order], (1,), penalties, saturates)
        cv2.transpose(sums.reshape(-1, len(band)), total[begin : begin + _TOGETHER].reshape(len(band), -1))
    for order in orders:
        _add_paths(total[::order], cost[::order], directions, penalties, saturates)
    return total


def _add_paths(total: Costs, cost: Costs, directions: tuple[int, ...], penalties: _Penalties, saturates: bool) -> None:
    """Add to sums, in place, the costs of paths from each line of pixels to the next, by formula 13 of Hirschmueller.

    Parameters
    ----------
    total, cost
        (lines, count, n) sums and costs.
    directions
        From which pixel of the line before: 0 the one before, 1 the same, 2 the one after.
    penalties
        Smoothness penalties.
    saturates
        Whether sums may exceed 16 bits; they are then limited to the largest integer.
    """
    _, count, width = cost.shape
    # costs above the least of each pixel are what the formula needs; beyond the image they are 0, as in OpenCV
    edge = 0 if directions == (1,) else 1
    above = np.zeros((len(directions), count, width + 2 * edge), np.int16)
    path, stepped = np.empty((count, width), np.int16), np.empty((count, width), np.int16)
    step, limit = np.int16(penalties.p1), np.full(path.shape, penalties.p2, np.int16)  # no loop of NumPy has a scalar
    for sums, costs in zip(total, cost, strict=True):
        for before, direction in zip(above, directions, strict=True):
            start = direction + edge - 1
            previous, now = before[:, start : start + width], before[:, edge : edge + width]
            np.add(previous, step, out=stepped)
            np.minimum(previous, limit, out=path)
            np.minimum(path[1:], stepped[:-1], out=path[1:])
            np.minimum(path[:-1], stepped[1:], out=path[:-1])
            path += costs
            np.subtract(path, path.min(axis=0), out=now)
            if saturates:
                np.minimum(sums, np.subtract(_LARGEST, path, out=stepped), out=sums)
            sums += path


@dataclass(frozen=True)
class _Least:
    """Least sums (h, count, w) of left pixels and right columns.

    - ``best``: (h, w) disparity of the least sum of each left pixel, the first of equal ones.
    - ``sums``: (3, h, w) sums at one disparity less, at the best one, and at one more.
    - ``second``: (h, w) least sum of the other disparities.
    - ``of_right``: (h, w + count) disparity of the least sum of each right column; left column i sees i + count - k at
      k. NaN for columns that no left column sees.
    """

    best: NDArray[np.intp]
    sums: Costs
    second: Costs
    of_right: NDArray[np.float32]


def _least_sums(total: Costs) -> _Least:
    """Return the least sums of sums (h, count, w), which are overwritten."""
    height, count, width = total.shape
    best, of_right = np.empty((height, width), np.intp), np.empty((height, width + count), np.float32)
    padded = np.full((count, width + 2 * count), _LARGEST, np.int16)
    down, right = padded.strides
    seen = as_strided(padded, (count, width + count), (down + right, right), writeable=False)
    of_left, of_seen = _Places(count, width), _Places(count, width + count)
    for row, sums in enumerate(total):
        padded[:, count : count + width] = sums
        least, position = of_seen.of_least(seen)
        of_right[row] = np.where(least < _LARGEST, position, np.nan)
        _, best[row] = of_left.of_least(sums)
    first = np.arange(height)[:, None] * count * width + np.arange(width)
    beside = [first + width * np.clip(best + step, 0, count - 1) for step in (-1, 0, 1)]
    flat = total.reshape(-1)
    chosen = np.stack([flat[index] for index in beside])
    for indices in beside:
        flat[indices] = _LARGEST
    second = total.min(axis=1)
    return _Least(best, chosen, second, of_right)


class _Places:
    """Places of the least of each column of an array (count, n); NumPy's argmin along columns takes several times."""

    def __init__(self, count: int, width: int) -> None:
        self.count, positions = count, np.arange(count, 0, -1).astype(np.uint8 if count < 256 else np.uint16)
        self._before_end = np.ascontiguousarray(np.broadcast_to(positions[:, None], (count, width)))
        self._is_least, self._place = np.empty((count, width), bool), np.empty((count, width), positions.dtype)

    def of_least(self, costs: Costs) -> tuple[Costs, NDArray[np.intp]]:
        """Return the least (n,) of each column, and the first place (n,) that has it."""
        least = costs.min(axis=0)
        np.equal(costs, least, out=self._is_least)
        np.multiply(self._is_least.view(np.uint8), self._before_end, out=self._place)
        return least, self.count - self._place.max(axis=0).astype(np.intp)


def _best_disparities(least: _Least, count: int, uniqueness: int, fit: SubPixelFit) -> NDArray[np.float32]:
    """Return disparities (h, w), of a number of ``count``, NaN where another is nearly as good."""
    lower, middle, upper = least.sums.astype(np.float32)
    inside = (least.best > 0) & (least.best < count - 1)
    disparity = least.best + np.where(inside, offset_of_minimum(lower, middle, upper, fit), 0)
    unique = least.second * np.float32(100 - uniqueness) >= 100 * middle
    return np.where(unique, disparity, np.nan).astype(np.float32)
