"""OpenCV's semi-global matching over eight directions, band by band of rows: the same disparities in bounded memory.

Signal chain: row by row, Birchfield-Tomasi cost of clipped gradients and grey levels -> sums over blocks -> paths from
above, row by row, kept where each band begins -> bands from the last to the first: paths from above once more, paths
along the rows, paths from below -> sum of the eight -> best disparity, uniqueness, sub-pixel step, check against the
other image -> median of 3 x 3, as OpenCV's ``MODE_HH`` ends.

``MODE_HH`` holds costs and sums of all pixels at all disparities, 4 bytes each: 2.7 GB for 1280 x 1024 pixels and 512
disparities. Cutting the image is no way out: where the pattern is faint a path carries what happens at a cut across
the whole image (1 to 3 % of a real image's pixels change, 100 rows from the cut). A path needs no more than the row
before, so here the rows come in bands, and what a band needs of its neighbours is handed over exactly.

Costs, paths and choices are those of OpenCV 4's ``stereosgbm.cpp`` in whole numbers; the tests compare all pixels with
OpenCV's own. Not reproduced is the overflow of 16 bits, which blocks over 11 pixels can reach: :func:`fits` says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Costs = NDArray[np.int16]

#: largest cost of a pixel: 2 x 127 of the gradient, and a quarter of 255 grey levels
_LARGEST_PIXEL_COST = 2 * 127 + 63

_LARGEST = np.iinfo(np.int16).max

#: OpenCV's: a match that the other image contradicts by more than this is none, whatever ``disp12MaxDiff`` up to 0
_OTHER_IMAGE = 1


@dataclass(frozen=True)
class Penalties:
    """What a match costs: ``block`` [px], ``p1`` and ``p2``, ``cap`` of gradients, ``uniqueness`` [%], as OpenCV's."""

    block: int
    p1: int
    p2: int
    cap: int
    uniqueness: int


def fits(penalties: Penalties) -> bool:
    """Whether no sum can overflow 16 bits, so that this module's result is OpenCV's."""
    return penalties.block**2 * _LARGEST_PIXEL_COST + penalties.p2 + penalties.p1 <= _LARGEST


def bytes_by_opencv(rows: int, width: int, count: int) -> float:
    """Memory [bytes] of OpenCV's costs and sums."""
    return 4.0 * rows * width * count


def bytes_of_band(rows: int, height: int, width: int, count: int) -> float:
    """Memory [bytes] that :func:`match_in_bands` takes with bands of so many rows, to a tenth."""
    state = 2.0 * width * count
    bands = -(-height // rows)
    # costs and sums of a band; the paths at the beginning of each; the paths and what one row needs
    return state * (2 * rows + 3 * bands + 24)


def rows_within(budget: float, height: int, width: int, count: int) -> int:
    """Rows of a band that keep the memory within a budget [bytes], or those that need least."""
    rows = np.arange(1, height + 1)
    needed = np.array([bytes_of_band(int(each), height, width, count) for each in rows])
    within = np.flatnonzero(needed <= budget)
    return int(rows[within[-1]] if len(within) else rows[needed.argmin()])


def match_in_bands(
    reference: NDArray[np.uint8], other: NDArray[np.uint8], count: int, penalties: Penalties, band_rows: int
) -> NDArray[np.int16]:
    """Disparities (h, W) [1/16 px] of the reference, -16 where there is none, as ``cv2.StereoSGBM`` in ``MODE_HH``.

    The search runs over 0 to ``count`` - 1; the first ``count`` columns have no disparity.
    """
    height = len(reference)
    images = _Prepared(reference, other, count, penalties)
    begins = list(range(0, height, band_rows))
    kept = []
    above = images.no_paths()
    scratch = np.empty_like(above.paths[0, 1:-1])
    for begin in begins:
        kept.append(above.copied())
        if begin == begins[-1]:
            break
        for cost in images.costs(begin, begin + band_rows):
            above.step(cost, images.penalties, scratch)
    out = np.full(reference.shape, -16, np.int16)
    below = images.no_paths()
    for begin in reversed(begins):
        end = min(begin + band_rows, height)
        cost = np.stack(list(images.costs(begin, end)))
        total = _along_rows(cost, images.penalties)
        above = kept.pop()
        for row in range(end - begin):
            above.step(cost[row], images.penalties, scratch, total[row])
        del above
        for row in reversed(range(end - begin)):
            below.step(cost[row], images.penalties, scratch, total[row])
            out[begin + row, count:] = _chosen(total[row], count, images.penalties.uniqueness)
        del cost, total
    return np.asarray(cv2.medianBlur(out, 3))


class _Paths:
    """The paths of three directions that end in one row: ``paths`` (3, w + 2, count), their ``least`` (3, w + 2).

    The first comes from the column before, the second from the same, the third from the next; beyond the image they
    are 0, as OpenCV has them.
    """

    def __init__(self, paths: Costs, least: Costs) -> None:
        self.paths, self.least = paths, least

    def copied(self) -> _Paths:
        return _Paths(self.paths.copy(), self.least.copy())

    def step(self, cost: Costs, penalties: Penalties, scratch: Costs, total: Costs | None = None) -> None:
        """Go on to the next row, of cost (w, count), and add to a total (w, count)."""
        width = len(cost)
        for direction in range(3):
            before = slice(direction, direction + width)
            new = _extended(self.paths[direction, before], self.least[direction, before], cost, penalties, scratch)
            self.paths[direction, 1:-1] = new
            self.least[direction, 1:-1] = new.min(axis=1)
            if total is not None:
                _add(total, new)


def _extended(before: Costs, least: Costs, cost: Costs, penalties: Penalties, scratch: Costs) -> Costs:
    """Path costs (..., count) one pixel on, by formula 13 of Hirschmueller; ``least`` (...) of those before."""
    p1, limit = np.int16(penalties.p1), least[..., None] + np.int16(penalties.p2)
    new: Costs = np.minimum(before, limit)
    np.add(before, p1, out=scratch)
    np.minimum(new[..., 1:], scratch[..., :-1], out=new[..., 1:])
    np.minimum(new[..., :-1], scratch[..., 1:], out=new[..., :-1])
    new -= limit
    new += cost
    return new


def _add(total: Costs, more: Costs) -> None:
    """Add in place; sums end at the largest number of 16 bits."""
    np.minimum(total, np.int16(_LARGEST) - more, out=total)
    total += more


def _along_rows(cost: Costs, penalties: Penalties) -> Costs:
    """Sum (h, w, count) of the paths from the left and from the right."""
    total = np.zeros_like(cost)
    scratch = np.empty_like(cost[:, 0])
    for columns in (range(cost.shape[1]), reversed(range(cost.shape[1]))):
        path, least = np.zeros_like(cost[:, 0]), np.zeros(len(cost), np.int16)
        for column in columns:
            path = _extended(path, least, cost[:, column], penalties, scratch)
            least = path.min(axis=1)
            _add(total[:, column], path)
    return total


class _Prepared:
    """Both images as OpenCV compares them, and the costs of their rows."""

    def __init__(
        self, reference: NDArray[np.uint8], other: NDArray[np.uint8], count: int, penalties: Penalties
    ) -> None:
        cap = max(penalties.cap, 15) | 1
        p1 = penalties.p1 if penalties.p1 > 0 else 2
        p2 = max(penalties.p2 if penalties.p2 > 0 else 5, p1 + 1)
        self.penalties = Penalties(penalties.block, p1, p2, cap, penalties.uniqueness)
        self.count, self.width, self.last = count, reference.shape[1] - count, len(reference) - 1
        self.reference = _channels(reference, cap)
        # mirrored, so that the disparities of one column lie side by side
        self.mirrored = [[np.ascontiguousarray(each[:, ::-1]) for each in some] for some in _channels(other, cap)]

    def no_paths(self) -> _Paths:
        """Before the first row and after the last."""
        return _Paths(np.zeros((3, self.width + 2, self.count), np.int16), np.zeros((3, self.width + 2), np.int16))

    def costs(self, begin: int, end: int) -> Iterator[Costs]:
        """Cost (w, count) of each row of a band, sums over blocks, and P2 more."""
        reach, last = self.penalties.block // 2, self.last
        rows = [self._row_sums(min(max(begin + k, 0), last)) for k in range(-reach, reach + 1)]
        total: Costs = np.full_like(rows[0], self.penalties.p2)
        for one in rows:
            total += one
        for row in range(begin, end):
            yield total.copy()
            if row + 1 == end:
                return
            total -= rows.pop(0)
            rows.append(self._row_sums(row + 1 + reach) if row + 1 + reach <= last else rows[-1])
            total += rows[-1]

    def _row_sums(self, row: int) -> Costs:
        """Sums (w, count) of a row's pixel costs over the width of a block; beyond the edges they repeat."""
        cost = self._pixel_costs(row)
        reach = self.penalties.block // 2
        padded = np.pad(cost, ((reach, reach), (0, 0)), mode="edge")
        total = padded[: self.width].copy()
        for shift in range(1, 2 * reach + 1):
            total += padded[shift : shift + self.width]
        return total

    def _pixel_costs(self, row: int) -> Costs:
        """Birchfield-Tomasi costs (w, count) of a row: gradients, and a quarter of the grey levels."""
        total = np.zeros((self.width, self.count), np.int16)
        for channel, shift in ((0, 0), (1, 2)):
            u, u0, u1 = (each[row, self.count :, None] for each in self.reference[channel])
            # column x of the reference sees column x - d of the other image
            v, v0, v1 = (
                sliding_window_view(each[row], self.count)[: self.width][::-1] for each in self.mirrored[channel]
            )
            one = np.maximum(np.maximum(u, v1) - v1, np.maximum(v0, u) - u)
            back = np.maximum(np.maximum(v, u1) - u1, np.maximum(u0, v) - v)
            total += np.minimum(one, back) >> shift
        return total


def _channels(image: NDArray[np.uint8], cap: int) -> list[list[NDArray[np.uint8]]]:
    """Clipped gradient along the rows, and grey levels: each with its least and largest value half a pixel around."""
    rows = np.pad(image, ((1, 1), (0, 0)), mode="edge").astype(np.int16)
    across = rows[:, 2:] - rows[:, :-2]
    gradient, level = np.full(image.shape, cap, np.uint8), np.full(image.shape, cap, np.uint8)
    gradient[:, 1:-1] = np.clip(2 * across[1:-1] + across[:-2] + across[2:], -cap, cap) + cap
    level[:, 1:-1] = image[:, 1:-1]
    out: list[list[NDArray[np.uint8]]] = []
    for channel in (gradient, level):
        wide = np.pad(channel, ((0, 0), (1, 1)), mode="edge").astype(np.int16)
        before, after = ((wide[:, 1:-1] + beside) // 2 for beside in (wide[:, :-2], wide[:, 2:]))
        low, high = (extreme(extreme(before, after), channel) for extreme in (np.minimum, np.maximum))
        out.append([channel, np.asarray(low, np.uint8), np.asarray(high, np.uint8)])
    return out


def _chosen(total: Costs, count: int, uniqueness: int) -> NDArray[np.int16]:
    """Disparities (w,) [1/16 px] of a row's sums (w, count), -16 where none is unique or the other image objects."""
    width = len(total)
    column = np.arange(width)
    best = total.argmin(axis=1)
    least = total[column, best].astype(np.int32)
    beside = [total[column, np.clip(best + step, 0, count - 1)].astype(np.int32) for step in (-1, 1)]
    # what is nearly as good, two pixels or more from the best: S (100 - uniqueness) < 100 S_least
    if uniqueness < 100:
        rivals = total < -(-least * 100 // (100 - uniqueness))[:, None]
    else:
        rivals = np.broadcast_to((least > 0)[:, None], total.shape).copy()
    for step in (-1, 0, 1):
        rivals[column, np.clip(best + step, 0, count - 1)] = False
    unique = ~rivals.any(axis=1)

    curvature = np.maximum(beside[0] + beside[1] - 2 * least, 1)
    # division toward zero, as in C
    slope = (beside[0] - beside[1]) * 16 + curvature
    step = np.sign(slope) * (np.abs(slope) // (2 * curvature))
    out = best * 16 + np.where((best > 0) & (best < count - 1), step, 0)
    out = np.where(unique, out, -16)

    # whole disparity of the other image: of the matches that meet in a column that of the least cost, the last on a tie
    meets = column[unique] + count - best[unique]
    rank = least[unique].astype(np.int64) * width + (width - 1 - column[unique])
    first = np.full(width + count, np.iinfo(np.int64).max)
    np.minimum.at(first, meets, rank)
    known = first < np.iinfo(np.int64).max
    theirs = np.full(width + count, -16)
    theirs[known] = best[width - 1 - first[known] % width]
    contradicted = unique.copy()
    for whole in (out >> 4, (out + 15) >> 4):
        place = column + count - whole
        within = (place >= 0) & (place < width + count)
        seen = theirs[np.where(within, place, 0)]
        contradicted &= within & (seen >= 0) & (np.abs(seen - whole) > _OTHER_IMAGE)
    return np.where(contradicted, -16, out).astype(np.int16)
