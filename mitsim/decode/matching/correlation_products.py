"""Correlations of a rectified pair by matrix products, for many frames and small blocks.

Signal chain: strips of both images -> laid out so that what may match lies together -> products of pixels, summed over
the frames -> sums over blocks -> correlation of every left column at every disparity.

Of one row, the products of some left pixels with all right ones that they may match, summed over the frames, are one
matrix product; its diagonals are the disparities, and sums along them and over rows the blocks. The sums of a block are
taken in the same order wherever it lies: a correlation does not depend on what else is asked for, to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: left columns that are treated at once: with a few rows their products stay in the processor's cache
_COLUMNS = 32

#: added to the variance of a block [DN^2 of 8 bit] for each frame, so that blank blocks correlate with nothing
BLANK_VARIANCE = 0.02


@dataclass(frozen=True)
class Pair:
    """Both strips as they are multiplied.

    Left columns run from ``start`` on, in whole blocks: ``left`` (h + 2r, X + 2r, F), r = block // 2 beyond on each
    side, ``left_mean`` (h, X, F) times the block's pixels, ``left_scale`` (h, X), 1 / (standard deviation x pixels).

    The right strips are mirrored: left column x sees, at disparity first + k, index ``end`` - x + k + r + ``_COLUMNS``.
    ``right`` (h + 2r, F, Q), ``right_mean`` (h, F, Q), ``right_scale`` (h, Q), ``exists`` (Q,). ``variance`` and
    ``lag`` (h, w + count + 1), of right blocks and of them with those of the column before, are not mirrored: left
    column begin + i sees index i + count - k.
    """

    columns: tuple[int, int]
    count: int
    block: int
    width: int
    start: int
    left: Floats
    left_mean: Floats
    left_scale: Floats
    right: Floats
    right_mean: Floats
    right_scale: Floats
    exists: NDArray[np.bool_]
    variance: Floats
    lag: Floats


def laid_out(left: Floats, right: Floats, columns: tuple[int, int], first: int, count: int, block: int) -> Pair:
    """Lay strips (F, h, W) out for a search of ``count`` disparities from ``first`` on, for some left columns."""
    begin, end = columns
    reach, blank = block // 2, np.float32(len(left) * BLANK_VARIANCE)
    # right pixels look for their partner left of `begin` and right of `end` too; whole blocks, so that each is
    # multiplied in the same way whatever is asked for
    start = (begin - count) // _COLUMNS * _COLUMNS
    stop = -(-(end + count) // _COLUMNS) * _COLUMNS
    wide = left[:, :, np.clip(np.arange(start - reach, stop + reach), 0, left.shape[2] - 1)]
    means = box(wide, block)
    scale = 1 / np.sqrt(block_variance(wide, means, block) + blank)
    inner = slice(reach, reach + stop - start)

    margin = reach + _COLUMNS
    place = begin - count - first - margin + np.arange(end - begin + count + 1 + 2 * margin)
    exists = (place >= 0) & (place < right.shape[2])
    seen = right[:, :, np.clip(place, 0, right.shape[2] - 1)]
    means_right = box(seen, block)
    variance = block_variance(seen, means_right, block)
    own = slice(margin, len(place) - margin)

    def rows(image: Floats) -> Floats:
        return np.pad(image, ((0, 0), (reach, reach), (0, 0)), mode="edge")

    return Pair(
        columns,
        count,
        block,
        left.shape[2],
        start,
        left=np.ascontiguousarray(np.moveaxis(rows(wide), 0, -1)),
        left_mean=np.ascontiguousarray(np.moveaxis(means[:, :, inner], 0, -1)) * np.float32(block**2),
        left_scale=scale[:, inner] * np.float32(1 / block**2),
        right=np.ascontiguousarray(np.moveaxis(rows(seen)[:, :, ::-1], 0, 1)),
        right_mean=np.ascontiguousarray(np.moveaxis(means_right[:, :, ::-1], 0, 1)),
        right_scale=np.ascontiguousarray(1 / np.sqrt(variance[:, ::-1] + blank)),
        exists=np.ascontiguousarray(exists[::-1]),
        variance=variance[:, own],
        lag=lag_covariance(seen, means_right, block)[:, own],
    )


def seen_from_right(pair: Pair, score: Floats) -> Floats:
    """The scores (h, w + count - 1, count) of right pixels, the rightmost that the columns can see first; a view."""
    begin, end = pair.columns
    height, step_x, step_k = score.strides
    from_last = score[:, end - 1 - pair.start :]
    shape = (len(score), end - begin + pair.count - 1, pair.count)
    return as_strided(from_last, shape, (height, -step_x, step_x + step_k), writeable=False)


def scores(pair: Pair, rows: slice) -> Floats:
    """Correlations (h, X, count) of left columns from ``start`` on at every disparity; -1 where nothing is asked."""
    (begin, end), count, reach = pair.columns, pair.count, pair.block // 2
    around = slice(rows.start, rows.stop + 2 * reach)
    score = np.full((rows.stop - rows.start, pair.left_scale.shape[1], count), -1.0, np.float32)
    for x in range(pair.start, pair.start + score.shape[1], _COLUMNS):
        # of columns that were not asked for, only what right pixels of interest see
        low, high = max(0, x - end + 1), min(count, x + _COLUMNS - 1 - begin + count)
        if low >= high or x + _COLUMNS <= 0 or x >= pair.width:
            continue
        here, q, length = x - pair.start, end - x + low + 1, _COLUMNS + high - low - 1
        products = _products(
            pair.left[around, here : here + _COLUMNS + 2 * reach], pair.right[around, :, q : q + length + 2 * reach]
        )
        _repeat_edges(products, -(x - reach), x + _COLUMNS + reach - pair.width)
        total = _along_diagonals(_summed(products, pair.block, len(score)), pair.block, _COLUMNS, length)
        total -= _products(
            pair.left_mean[rows, here : here + _COLUMNS], pair.right_mean[rows, :, q + reach : q + reach + length]
        )
        # column x + i at disparity first + low + k: one place less for each column
        centre, shape = q + reach + _COLUMNS - 1, (_COLUMNS, high - low)
        step_y, step_x, step_q = total.strides
        rho = as_strided(total[:, :, _COLUMNS - 1 :], (len(score), *shape), (step_y, step_x - step_q, step_q))
        scale = pair.right_scale[rows, centre:]
        scales = as_strided(scale, (len(score), *shape), (scale.strides[0], -scale.strides[1], scale.strides[1]))
        out = score[:, here : here + _COLUMNS, low:high]
        np.multiply(rho, scales, out=out)
        out *= pair.left_scale[rows, here : here + _COLUMNS, None]
        exists = as_strided(pair.exists[centre:], shape, (-1, 1))
        if not exists.all():
            np.copyto(out, -1.0, where=~exists)
    # columns of the blocks that the image does not have
    score[:, : max(0, -pair.start)] = -1.0
    score[:, max(0, pair.width - pair.start) :] = -1.0
    return score


def _products(left: Floats, right: Floats) -> Floats:
    """Products (h, x, q) of left pixels (h, x, F) and right ones (h, F, q), summed over the frames."""
    if left.shape[2] == 1:  # numpy has no fast way for a sum of one
        return left * right
    return np.asarray(left @ right)


def _repeat_edges(products: Floats, before: int, after: int) -> None:
    """Give products (h, x, q) of left columns beyond the image those of its edge at the same disparity."""
    for column in range(before):
        apart = before - column
        products[:, column, apart:] = products[:, before, :-apart]
    last = products.shape[1] - 1 - after
    for apart in range(1, after + 1):
        products[:, last + apart, :-apart] = products[:, last, apart:]


def _summed(values: Floats, count: int, length: int) -> Floats:
    """Sums of ``count`` neighbours along the first axis, ``length`` of them: by sums of 1, 2, 4, ... of them."""
    total, done, power = None, 0, 1
    while True:
        if count & power:
            part = values[done : done + length]
            total = part if total is None else total + part
            done += power
        if 2 * power > count:
            break
        values = values[:-power] + values[power:]
        power *= 2
    assert total is not None
    return total


def _along_diagonals(values: Floats, count: int, columns: int, length: int) -> Floats:
    """Sums (h, columns, length) of ``count`` neighbours (+1, -1) of values (h, columns + count - 1, length + ...)."""
    total, done, power = None, 0, 1
    while True:
        if count & power:
            last = count - power - done
            part = values[:, done : done + columns, last : last + length]
            total = part + 0 if total is None else total + part
            done += power
        if 2 * power > count:
            break
        values = values[:, :-power, power:] + values[:, power:, :-power]
        power *= 2
    assert total is not None
    return total


def box(images: Floats, block: int) -> Floats:
    """Mean (F, h, w) of a square block around each pixel; beyond the edges they repeat."""
    reach = block // 2
    height, width = images.shape[1:]
    padded = np.pad(images, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    rows = _summed(np.moveaxis(padded, 1, 0), block, height)  # (h, F, w + 2r)
    both = _summed(np.moveaxis(rows, 2, 0), block, width)  # (w, h, F)
    return np.ascontiguousarray(np.moveaxis(both, (2, 1), (0, 1))) * np.float32(1 / block**2)


def block_variance(images: Floats, means: Floats, block: int) -> Floats:
    """Sum over frames of the variance of blocks (h, w)."""
    total = box((images * images).sum(axis=0)[None], block)[0]
    return np.asarray(np.maximum(total - (means * means).sum(axis=0), 0))


def lag_covariance(images: Floats, means: Floats, block: int) -> Floats:
    """Sum over frames of the covariance of each block with that of the column before."""
    before, mean_before = (np.concatenate([each[:, :, :1], each[:, :, :-1]], axis=2) for each in (images, means))
    return np.asarray(box((images * before).sum(axis=0)[None], block)[0] - (means * mean_before).sum(axis=0))
