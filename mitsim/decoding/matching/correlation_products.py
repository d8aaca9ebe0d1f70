"""Correlate a rectified pair by matrix products, for many frames and small blocks.

Signal chain: strips of both images -> arrays in which possible matches are adjacent -> products of pixels, summed over
the frames -> sums over blocks -> correlation of each left column at each disparity.

Within one row, a matrix product gives the products of some left pixels with all right pixels that they may match. It
sums over the frames. Its diagonals are the disparities, and sums along diagonals and over rows are the blocks. The sums
of a block have the same order wherever the block lies. A correlation is therefore the same, to the last bit, for any
requested region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: number of left columns that are processed at once: with a few rows, their products stay in the processor's cache
_COLUMNS = 32

#: added to the variance of a block for each frame [DN^2 of 8 bit], so that blocks without texture correlate with
#: nothing
BLANK_VARIANCE = 0.02


@dataclass(frozen=True)
class PreparedPair:
    """Both strips, arranged for the matrix products, with r = block // 2.

    Left columns start at ``start``, in whole groups of ``_COLUMNS``. The right strips are mirrored: at disparity first
    + k, left column x sees index ``end`` - x + k + r + ``_COLUMNS``.

    Attributes
    ----------
    columns, count, block, width
        Requested left columns, number of disparities, side of a block [px] and width of the left strips [px].
    start
        First left column of the arrays.
    left
        (h + 2r, X + 2r, F), with r pixels beyond each side.
    left_mean
        (h, X, F) block means times the number of pixels of a block.
    left_scale
        (h, X) 1 / (standard deviation x number of pixels).
    right
        (h + 2r, F, Q), mirrored.
    right_mean, right_scale
        (h, F, Q) block means, and (h, Q) 1 / standard deviation, mirrored.
    exists
        (Q,) whether the right image has the column, mirrored.
    variance, lag
        (h, w + count + 1) variance of right blocks, and covariance with that of the column before; not mirrored. Left
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


def prepare_pair(
    left: Floats, right: Floats, columns: tuple[int, int], first: int, count: int, block: int
) -> PreparedPair:
    """Prepare strips of a rectified pair for a search, for some left columns.

    Parameters
    ----------
    left, right
        (F, h, W) strips of the images.
    columns
        First left column of the search, and the end after the last.
    first
        First disparity [px].
    count
        Number of disparities.
    block
        Side of a matching block [px].
    """
    begin, end = columns
    reach, blank = block // 2, np.float32(len(left) * BLANK_VARIANCE)
    # right pixels also search left of `begin` and right of `end`. The groups of columns are whole, so that each is
    # multiplied in the same way for any request
    start = (begin - count) // _COLUMNS * _COLUMNS
    stop = -(-(end + count) // _COLUMNS) * _COLUMNS
    left_padded = left[:, :, np.clip(np.arange(start - reach, stop + reach), 0, left.shape[2] - 1)]
    means = block_mean(left_padded, block)
    scale = 1 / np.sqrt(block_variance(left_padded, means, block) + blank)
    inner = slice(reach, reach + stop - start)

    margin = reach + _COLUMNS
    right_source = begin - count - first - margin + np.arange(end - begin + count + 1 + 2 * margin)
    exists = (right_source >= 0) & (right_source < right.shape[2])
    right_padded = right[:, :, np.clip(right_source, 0, right.shape[2] - 1)]
    means_right = block_mean(right_padded, block)
    variance = block_variance(right_padded, means_right, block)
    core = slice(margin, len(right_source) - margin)

    def rows(image: Floats) -> Floats:
        return np.pad(image, ((0, 0), (reach, reach), (0, 0)), mode="edge")

    return PreparedPair(
        columns,
        count,
        block,
        left.shape[2],
        start,
        left=np.ascontiguousarray(np.moveaxis(rows(left_padded), 0, -1)),
        left_mean=np.ascontiguousarray(np.moveaxis(means[:, :, inner], 0, -1)) * np.float32(block**2),
        left_scale=scale[:, inner] * np.float32(1 / block**2),
        right=np.ascontiguousarray(np.moveaxis(rows(right_padded)[:, :, ::-1], 0, 1)),
        right_mean=np.ascontiguousarray(np.moveaxis(means_right[:, :, ::-1], 0, 1)),
        right_scale=np.ascontiguousarray(1 / np.sqrt(variance[:, ::-1] + blank)),
        exists=np.ascontiguousarray(exists[::-1]),
        variance=variance[:, core],
        lag=lag_covariance(right_padded, means_right, block)[:, core],
    )


def right_correlations(pair: PreparedPair, score: Floats) -> Floats:
    """Return a view of the correlations (h, w + count - 1, count) of right pixels, the rightmost first."""
    begin, end = pair.columns
    height, step_x, step_k = score.strides
    from_last = score[:, end - 1 - pair.start :]
    shape = (len(score), end - begin + pair.count - 1, pair.count)
    return as_strided(from_last, shape, (height, -step_x, step_x + step_k), writeable=False)


def correlations(pair: PreparedPair, rows: slice) -> Floats:
    """Return correlations (h, X, count) of left columns from ``start`` on, -1 where none is requested."""
    (begin, end), count, reach = pair.columns, pair.count, pair.block // 2
    around = slice(rows.start, rows.stop + 2 * reach)
    score = np.full((rows.stop - rows.start, pair.left_scale.shape[1], count), -1.0, np.float32)
    for x in range(pair.start, pair.start + score.shape[1], _COLUMNS):
        # of columns that were not requested, only the part that right pixels of interest see
        low, high = max(0, x - end + 1), min(count, x + _COLUMNS - 1 - begin + count)
        if low >= high or x + _COLUMNS <= 0 or x >= pair.width:
            continue
        column, q, width = x - pair.start, end - x + low + 1, _COLUMNS + high - low - 1
        products = _products(
            pair.left[around, column : column + _COLUMNS + 2 * reach], pair.right[around, :, q : q + width + 2 * reach]
        )
        _replicate_edges(products, -(x - reach), x + _COLUMNS + reach - pair.width)
        total = _diagonal_sums(_sliding_sums(products, pair.block, len(score)), pair.block, _COLUMNS, width)
        total -= _products(
            pair.left_mean[rows, column : column + _COLUMNS], pair.right_mean[rows, :, q + reach : q + reach + width]
        )
        # column x + i at disparity first + low + k: the position decreases by one for each column
        centre, shape = q + reach + _COLUMNS - 1, (_COLUMNS, high - low)
        step_y, step_x, step_q = total.strides
        rho = as_strided(total[:, :, _COLUMNS - 1 :], (len(score), *shape), (step_y, step_x - step_q, step_q))
        right_scale = pair.right_scale[rows, centre:]
        scales = as_strided(
            right_scale, (len(score), *shape), (right_scale.strides[0], -right_scale.strides[1], right_scale.strides[1])
        )
        out = score[:, column : column + _COLUMNS, low:high]
        np.multiply(rho, scales, out=out)
        out *= pair.left_scale[rows, column : column + _COLUMNS, None]
        exists = as_strided(pair.exists[centre:], shape, (-1, 1))
        if not exists.all():
            np.copyto(out, -1.0, where=~exists)
    # columns of the groups that lie outside the image
    score[:, : max(0, -pair.start)] = -1.0
    score[:, max(0, pair.width - pair.start) :] = -1.0
    return score


def _products(left: Floats, right: Floats) -> Floats:
    """Return products (h, x, q) of left pixels (h, x, F) and right pixels (h, F, q), summed over the frames."""
    if left.shape[2] == 1:  # numpy's matrix product is slow for a sum of one term
        return left * right
    return np.asarray(left @ right)


def _replicate_edges(products: Floats, before: int, after: int) -> None:
    """Replace products (h, x, q) of left columns beyond the image by those of its edge at the same disparity.

    ``before`` and ``after`` are the numbers of such columns on each side.
    """
    for column in range(before):
        distance = before - column
        products[:, column, distance:] = products[:, before, :-distance]
    last = products.shape[1] - 1 - after
    for distance in range(1, after + 1):
        products[:, last + distance, :-distance] = products[:, last, distance:]


def _sliding_sums(values: Floats, count: int, length: int) -> Floats:
    """Return ``length`` sums of ``count`` neighbours along the first axis, from sums of 1, 2, 4, ... of them."""
    total, summed, power = None, 0, 1
    while True:
        if count & power:
            part = values[summed : summed + length]
            total = part if total is None else total + part
            summed += power
        if 2 * power > count:
            break
        values = values[:-power] + values[power:]
        power *= 2
    assert total is not None
    return total


def _diagonal_sums(values: Floats, count: int, columns: int, length: int) -> Floats:
    """Return sums (h, columns, length) of ``count`` neighbours along the diagonal (+1, -1) of ``values``.

    ``values`` has the shape (h, columns + count - 1, length + count - 1).
    """
    total, summed, power = None, 0, 1
    while True:
        if count & power:
            last = count - power - summed
            part = values[:, summed : summed + columns, last : last + length]
            total = part + 0 if total is None else total + part
            summed += power
        if 2 * power > count:
            break
        values = values[:, :-power, power:] + values[:, power:, :-power]
        power *= 2
    assert total is not None
    return total


def block_mean(images: Floats, block: int) -> Floats:
    """Return the mean (F, h, w) of a square block around each pixel; pixels beyond the edges repeat the edge."""
    reach = block // 2
    height, width = images.shape[1:]
    padded = np.pad(images, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    row_sums = _sliding_sums(np.moveaxis(padded, 1, 0), block, height)  # (h, F, w + 2r)
    sums = _sliding_sums(np.moveaxis(row_sums, 2, 0), block, width)  # (w, h, F)
    return np.ascontiguousarray(np.moveaxis(sums, (2, 1), (0, 1))) * np.float32(1 / block**2)


def block_variance(images: Floats, means: Floats, block: int) -> Floats:
    """Return the variance of each block (h, w), summed over the frames."""
    total = block_mean((images * images).sum(axis=0)[None], block)[0]
    return np.asarray(np.maximum(total - (means * means).sum(axis=0), 0))


def lag_covariance(images: Floats, means: Floats, block: int) -> Floats:
    """Return the covariance of each block with that of the column before (h, w), summed over the frames."""
    previous, mean_previous = (np.concatenate([each[:, :, :1], each[:, :, :-1]], axis=2) for each in (images, means))
    return np.asarray(block_mean((images * previous).sum(axis=0)[None], block)[0] - (means * mean_previous).sum(axis=0))
