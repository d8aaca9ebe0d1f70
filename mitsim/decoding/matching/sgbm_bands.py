"""Match semi-globally over eight directions in bands of rows: OpenCV's disparities with bounded memory.

Signal chain: row by row, Birchfield-Tomasi cost of clipped gradients and grey levels -> sums over blocks -> paths from
above, row by row, saved where each band begins -> bands from the last to the first: paths from above again, paths along
the rows, paths from below -> sum of the eight -> best disparity, uniqueness, sub-pixel step, check against the other
image -> median of 3 x 3, with which OpenCV's ``MODE_HH`` ends.

``MODE_HH`` holds costs and sums of all pixels at all disparities, 4 bytes each: 2.7 GB for 1280 x 1024 pixels and 512
disparities. Independent tiles would change the result. Where the pattern is faint, a path carries the effect of a cut
across the whole image: 100 rows from the cut, 1 to 3 % of a real image's pixels change. A path needs only the row
before it. The rows are therefore processed in bands, and the state at the border of a band is passed on exactly.

Costs, paths and choices are those of ``stereosgbm.cpp`` in OpenCV 4, in integers. The tests compare all pixels with
OpenCV's. The overflow of 16 bits, possible for blocks over 11 pixels, is not reproduced; see :func:`fits_16_bits`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Costs = NDArray[np.int16]
Mode = Literal["hh", "sgbm", "3way"]

#: largest cost of a pixel: 2 x 127 from the gradient, and a quarter of 255 grey levels
_LARGEST_PIXEL_COST = 2 * 127 + 63

_LARGEST = np.iinfo(np.int16).max

#: largest disagreement with the other image [px], as in OpenCV: beyond it a match is rejected, for any
#: ``disp12MaxDiff`` up to 0
_LARGEST_DISAGREEMENT = 1


@dataclass(frozen=True)
class Penalties:
    """Parameters of the matching cost, as in OpenCV.

    ``block`` is the side of a block [px]; ``p1`` and ``p2`` are the smoothness penalties; ``cap`` limits the gradients;
    ``uniqueness`` is in [%].
    """

    block: int
    p1: int
    p2: int
    cap: int
    uniqueness: int


def fits_16_bits(penalties: Penalties) -> bool:
    """Return whether no sum can overflow 16 bits. Only then is this module's result equal to OpenCV's."""
    return penalties.block**2 * _LARGEST_PIXEL_COST + penalties.p2 + penalties.p1 <= _LARGEST


def bytes_by_opencv(rows: int, width: int, count: int) -> float:
    """Return the memory [bytes] of OpenCV's costs and sums."""
    return 4.0 * rows * width * count


def bytes_of_band(rows: int, height: int, width: int, count: int) -> float:
    """Return the memory [bytes] that :func:`match_in_bands` needs for bands of ``rows`` rows, to a tenth.

    Parameters
    ----------
    rows
        Number of rows of a band.
    height, width
        Size of the image [px].
    count
        Number of disparities.

    See Also
    --------
    rows_in_budget : the inverse
    """
    state = 2.0 * width * count
    bands = -(-height // rows)
    # costs and sums of a band; the saved paths of each band; the current paths and the arrays of one row
    return state * (2 * rows + 3 * bands + 24)


def rows_in_budget(budget: float, height: int, width: int, count: int) -> int:
    """Return the number of rows of a band that keeps the memory within a budget, or that needs the least.

    Parameters
    ----------
    budget
        Memory [bytes].
    height, width
        Size of the image [px].
    count
        Number of disparities.

    See Also
    --------
    bytes_of_band : the memory of a band
    """
    rows = np.arange(1, height + 1)
    needed = np.array([bytes_of_band(int(each), height, width, count) for each in rows])
    within = np.flatnonzero(needed <= budget)
    return int(rows[within[-1]] if len(within) else rows[needed.argmin()])


def match_in_bands(
    reference: NDArray[np.uint8], other: NDArray[np.uint8], count: int, penalties: Penalties, band_rows: int
) -> NDArray[np.int16]:
    """Return disparities (h, W) [1/16 px] of the reference as ``cv2.StereoSGBM`` in ``MODE_HH``, -16 for none.

    Parameters
    ----------
    reference, other
        (h, W) images [DN].
    count
        Number of disparities, 0 to ``count`` - 1. The first ``count`` columns have no disparity.
    penalties, band_rows
        Parameters of the cost, and rows of a band.

    See Also
    --------
    bytes_of_band : its memory
    """
    cap, p1, p2 = max(penalties.cap, 15) | 1, penalties.p1 or 2, penalties.p2 or 5
    used = Penalties(penalties.block, p1, max(p2, p1 + 1), cap, penalties.uniqueness)
    out = np.full(reference.shape, -16, np.int16)
    for row, total in summed_paths(BlockCosts(_GradientCosts(reference, other, count, cap), used), band_rows):
        out[row, count:] = _best_disparities(total, count, used.uniqueness)
        del total  # a view of a whole band, which would live on beside the next
    return np.asarray(cv2.medianBlur(out, 3))


class PixelCosts(Protocol):
    """Matching costs of single pixels: of ``width`` columns in ``height`` rows, at ``count`` disparities."""

    height: int
    width: int
    count: int

    def row(self, row: int) -> Costs:
        """Return the costs (w, count) of a row."""


def summed_paths(images: BlockCosts, band_rows: int, mode: Mode = "hh") -> Iterator[tuple[int, Costs]]:
    """Yield each row, in any order, with the sum (w, count) of its paths, in bands of rows.

    ``mode``: all eight paths for ``hh``. One pass over the image, as in hardware, has none from below: both along the
    row and the three from above for ``sgbm``, or the one straight from above for ``3way``.
    """
    height = images.pixels.height
    from_above, from_below = (1,) if mode == "3way" else (0, 1, 2), mode == "hh"
    begins = list(range(0, height, band_rows))
    saved = []
    above = images.zero_paths()
    scratch = np.empty_like(above.paths[0, 1:-1])
    for begin in begins:
        saved.append(above.copy())
        if begin == begins[-1]:
            break
        for cost in images.costs(begin, begin + band_rows):
            above.advance(cost, images.penalties, scratch, from_above)
    below = images.zero_paths()
    for begin in reversed(begins):
        end = min(begin + band_rows, height)
        cost = np.stack(list(images.costs(begin, end)))
        total = _horizontal_paths(cost, images.penalties)
        above = saved.pop()
        for row in range(end - begin):
            above.advance(cost[row], images.penalties, scratch, from_above, total[row])
        del above
        for row in reversed(range(end - begin)):
            if from_below:
                below.advance(cost[row], images.penalties, scratch, from_above, total[row])
            yield begin + row, total[row]
        del cost, total


class _Paths:
    """Costs of the paths from three directions that end in one row.

    ``paths`` (3, w + 2, count), and their minima ``least`` (3, w + 2). The paths come from the column before, the same
    and the next. Beyond the image they are 0, as in OpenCV.
    """

    def __init__(self, paths: Costs, least: Costs) -> None:
        self.paths, self.least = paths, least

    def copy(self) -> _Paths:
        return _Paths(self.paths.copy(), self.least.copy())

    def advance(
        self,
        cost: Costs,
        penalties: Penalties,
        scratch: Costs,
        directions: tuple[int, ...],
        total: Costs | None = None,
    ) -> None:
        """Advance to the next row with the given cost (w, count), and add the paths to a total (w, count)."""
        width = len(cost)
        for direction in directions:
            before = slice(direction, direction + width)
            path = _next_path_costs(
                self.paths[direction, before], self.least[direction, before], cost, penalties, scratch
            )
            self.paths[direction, 1:-1] = path
            self.least[direction, 1:-1] = path.min(axis=1)
            if total is not None:
                _add_saturated(total, path)


def _next_path_costs(previous: Costs, least: Costs, cost: Costs, penalties: Penalties, scratch: Costs) -> Costs:
    """Return the path costs (..., count) one pixel further, by formula 13 of Hirschmueller.

    ``previous`` (..., count) are the costs one pixel before, and ``least`` (...) their minima.
    """
    p1, limit = np.int16(penalties.p1), least[..., None] + np.int16(penalties.p2)
    path: Costs = np.minimum(previous, limit)
    np.add(previous, p1, out=scratch)
    np.minimum(path[..., 1:], scratch[..., :-1], out=path[..., 1:])
    np.minimum(path[..., :-1], scratch[..., 1:], out=path[..., :-1])
    path -= limit
    path += cost
    return path


def _add_saturated(total: Costs, term: Costs) -> None:
    """Add in place, limited to the largest 16-bit integer."""
    np.minimum(total, np.int16(_LARGEST) - term, out=total)
    total += term


def _horizontal_paths(cost: Costs, penalties: Penalties) -> Costs:
    """Return the sum (h, w, count) of the paths from the left and from the right."""
    total = np.zeros_like(cost)
    scratch = np.empty_like(cost[:, 0])
    for columns in (range(cost.shape[1]), reversed(range(cost.shape[1]))):
        path, least = np.zeros_like(cost[:, 0]), np.zeros(len(cost), np.int16)
        for column in columns:
            path = _next_path_costs(path, least, cost[:, column], penalties, scratch)
            least = path.min(axis=1)
            _add_saturated(total[:, column], path)
    return total


class BlockCosts:
    """Matching costs of rows: those of ``pixels``, summed over blocks."""

    def __init__(self, pixels: PixelCosts, penalties: Penalties) -> None:
        self.pixels, self.penalties = pixels, penalties
        self.count, self.width, self.last = pixels.count, pixels.width, pixels.height - 1

    def zero_paths(self) -> _Paths:
        """Return the paths before the first row and after the last."""
        return _Paths(np.zeros((3, self.width + 2, self.count), np.int16), np.zeros((3, self.width + 2), np.int16))

    def costs(self, begin: int, end: int) -> Iterator[Costs]:
        """Yield the cost (w, count) of each row of a band: the sum over blocks, plus P2."""
        reach, last = self.penalties.block // 2, self.last
        rows = [self._row_sums(min(max(begin + k, 0), last)) for k in range(-reach, reach + 1)]
        total: Costs = np.full_like(rows[0], self.penalties.p2)
        for row_sum in rows:
            total += row_sum
        for row in range(begin, end):
            yield total.copy()
            if row + 1 == end:
                return
            total -= rows.pop(0)
            rows.append(self._row_sums(row + 1 + reach) if row + 1 + reach <= last else rows[-1])
            total += rows[-1]

    def _row_sums(self, row: int) -> Costs:
        """Return sums (w, count) of a row's pixel costs over the width of a block, with repeated edges."""
        cost = self.pixels.row(row)
        reach = self.penalties.block // 2
        padded = np.pad(cost, ((reach, reach), (0, 0)), mode="edge")
        total = padded[: self.width].copy()
        for shift in range(1, 2 * reach + 1):
            total += padded[shift : shift + self.width]
        return total


class _GradientCosts:
    """Both images as OpenCV compares them, with gradients that are clipped to ``cap``."""

    def __init__(self, reference: NDArray[np.uint8], other: NDArray[np.uint8], count: int, cap: int) -> None:
        self.height, self.width, self.count = len(reference), reference.shape[1] - count, count
        self.reference = _channels(reference, cap)
        self.compared = [[beside_each_other(each, count) for each in channel] for channel in _channels(other, cap)]

    def row(self, row: int) -> Costs:
        """Return the Birchfield-Tomasi costs (w, count) of a row: gradients, and a quarter of the grey levels."""
        total = np.zeros((self.width, self.count), np.int16)
        for channel, shift in ((0, 0), (1, 2)):
            u, u0, u1 = (each[row, self.count :, None] for each in self.reference[channel])
            v, v0, v1 = (each[row] for each in self.compared[channel])
            forward = np.maximum(np.maximum(u, v1) - v1, np.maximum(v0, u) - u)
            backward = np.maximum(np.maximum(v, u1) - u1, np.maximum(u0, v) - v)
            total += np.minimum(forward, backward) >> shift
        return total


def beside_each_other(image: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the pixels (h, w, count) with which each column of a reference is compared: x - d for column x.

    The disparities of one column are adjacent in the mirrored image.
    """
    width = image.shape[1] - count
    return sliding_window_view(np.ascontiguousarray(image[:, ::-1]), count, axis=1)[:, :width][:, ::-1]


def _channels(image: NDArray[np.uint8], cap: int) -> list[list[NDArray[np.uint8]]]:
    """Return the clipped gradient along the rows, and the grey levels.

    Each has its smallest and largest value within half a pixel.
    """
    padded_rows = np.pad(image, ((1, 1), (0, 0)), mode="edge").astype(np.int16)
    across = padded_rows[:, 2:] - padded_rows[:, :-2]
    gradient, level = np.full(image.shape, cap, np.uint8), np.full(image.shape, cap, np.uint8)
    gradient[:, 1:-1] = np.clip(2 * across[1:-1] + across[:-2] + across[2:], -cap, cap) + cap
    level[:, 1:-1] = image[:, 1:-1]
    channels: list[list[NDArray[np.uint8]]] = []
    for channel in (gradient, level):
        padded = np.pad(channel, ((0, 0), (1, 1)), mode="edge").astype(np.int16)
        before, after = ((padded[:, 1:-1] + beside) // 2 for beside in (padded[:, :-2], padded[:, 2:]))
        low, high = (extreme(extreme(before, after), channel) for extreme in (np.minimum, np.maximum))
        channels.append([channel, np.asarray(low, np.uint8), np.asarray(high, np.uint8)])
    return channels


def _best_disparities(total: Costs, count: int, uniqueness: int) -> NDArray[np.int16]:
    """Return disparities (w,) [1/16 px] from a row's sums (w, count).

    -16 where none is unique, or the other image contradicts it.
    """
    width = len(total)
    column = np.arange(width)
    best = total.argmin(axis=1)
    least = total[column, best].astype(np.int32)
    neighbours = [total[column, np.clip(best + step, 0, count - 1)].astype(np.int32) for step in (-1, 1)]
    # competing disparities, two pixels or more from the best: S (100 - uniqueness) < 100 S_least
    if uniqueness < 100:
        competing = total < -(-least * 100 // (100 - uniqueness))[:, None]
    else:
        competing = np.broadcast_to((least > 0)[:, None], total.shape).copy()
    for step in (-1, 0, 1):
        competing[column, np.clip(best + step, 0, count - 1)] = False
    unique = ~competing.any(axis=1)

    curvature = np.maximum(neighbours[0] + neighbours[1] - 2 * least, 1)
    # division that rounds toward zero, as in C
    slope = (neighbours[0] - neighbours[1]) * 16 + curvature
    step = np.sign(slope) * (np.abs(slope) // (2 * curvature))
    out = best * 16 + np.where((best > 0) & (best < count - 1), step, 0)
    out = np.where(unique, out, -16)

    # whole disparity of the other image: of the matches in a column, the one of least cost, and the last of equal ones
    other_column = column[unique] + count - best[unique]
    rank = least[unique].astype(np.int64) * width + (width - 1 - column[unique])
    best_rank = np.full(width + count, np.iinfo(np.int64).max)
    np.minimum.at(best_rank, other_column, rank)
    matched = best_rank < np.iinfo(np.int64).max
    other_disparity = np.full(width + count, -16)
    other_disparity[matched] = best[width - 1 - best_rank[matched] % width]
    contradicted = unique.copy()
    for whole in (out >> 4, (out + 15) >> 4):
        position = column + count - whole
        inside = (position >= 0) & (position < width + count)
        disparity_there = other_disparity[np.where(inside, position, 0)]
        contradicted &= inside & (disparity_there >= 0) & (np.abs(disparity_there - whole) > _LARGEST_DISAGREEMENT)
    return np.where(contradicted, -16, out).astype(np.int16)
