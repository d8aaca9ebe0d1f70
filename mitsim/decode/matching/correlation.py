"""Matching by correlation: all frames of both images of a rectified pair at once, or an image and its reference.

Signal chain: strips of both images, a stack of frames each -> products of pixels, summed over the frames, and over a
block, at every disparity of the search range -> correlation -> best and next best, from the left and from the right ->
sub-pixel step -> :class:`~mitsim.decode.matching.sgbm.Matches`.

The score is the zero-mean normalised cross-correlation rho of a square block through all F frames (spatio-temporal
stereo: Davis, Nehab, Ramamoorthi and Rusinkiewicz, IEEE PAMI 27(2), 2005; Zhang, Curless and Seitz, CVPR 2003), with
the mean taken away frame by frame: it is indifferent to what makes one eye's image brighter than the other's. There is
no smoothness term: what a block does not tell is not told by its neighbours.

The sub-pixel step is the closed form of Psarakis and Evangelidis (ICCV 2005). The right block at a fraction tau
between two columns is (1 - tau) R0 + tau R1, and rho(tau) has its maximum where

    tau = (a p - u c) / (u p - a s),    u = b - a,  p = q - c,  s = c - 2 q + e

with a, b the covariances of the left block with R0 and R1, c, e the variances of R0 and R1, q their covariance.
Interpolation also averages the right image's noise, which draws tau toward 1/2, by 0.09 px where noise is a third of
the pattern's contrast. So the share of noise in c and e, 1 - rho at the peak if both images are equally noisy, is taken
away first; that is ours. A parabola through three values of rho would be drawn toward whole pixels, by 0.03 to 0.05
px, and has three times the error without noise.

Many frames are correlated by matrix products (:mod:`mitsim.decode.matching.correlation_products`), one or two disparity
by disparity, where a block costs the same whatever its size.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.threads import in_threads
from mitsim.decode.matching.correlation_products import (
    BLANK_VARIANCE,
    Floats,
    Pair,
    block_variance,
    box,
    lag_covariance,
    laid_out,
    scores,
    seen_from_right,
)
from mitsim.decode.matching.sgbm import Matches, both_ways_disagreement, claimed_pixels
from mitsim.sensor.matcher import MatcherSettings

#: bytes of the correlations that each thread holds at once, where they come disparity by disparity
_VOLUME_BYTES = 24e6

#: from this many frames on matrix products are faster, and rows that they treat at once
_MANY_FRAMES, _ROWS = 3, 8

#: least peak correlation by which noise is told apart
_LEAST_PEAK = 0.1


def correlate_both_ways(
    left: Floats,
    right: Floats,
    columns: tuple[int, int],
    first: int,
    count: int,
    settings: MatcherSettings,
    *,
    noisy_right: bool = True,
) -> Matches:
    """Match columns of the left strips against the right strips, and back.

    Parameters
    ----------
    left, right
        (F, h, W) rectified strips [DN of 8 bit], the same rows of both, each frame with a mean near zero: what is
        common to all pixels is lost in the rounding.
    columns
        First and one past the last left column to be matched.
    first, count
        The search range, from :func:`mitsim.decode.matching.sgbm.search_range`.
    settings
        Block and uniqueness: 1 - rho must beat the next, a pixel away or more, by so much.
    noisy_right
        False where the right image is a reference without noise.
    """
    height, uniqueness = left.shape[1], settings.uniqueness_percent
    width = columns[1] - columns[0]
    if len(left) >= _MANY_FRAMES:
        pair, rows = laid_out(left, right, columns, first, count, settings.block_size), _ROWS
    else:
        pair, rows = None, max(int(_VOLUME_BYTES / (4 * count * (width + 2 * count))), 4)

    def part(start: int) -> tuple[Floats, Floats]:
        chunk = slice(start, min(start + rows, height))
        if pair is not None:
            return _match_products(pair, chunk, uniqueness, noisy_right)
        reach = settings.block_size // 2
        around = slice(max(chunk.start - reach, 0), min(chunk.stop + reach, height))
        inner = slice(chunk.start - around.start, chunk.stop - around.start)
        search = _Search(columns, first, count)
        return _match_disparities(left[:, around], right[:, around], inner, search, settings, noisy_right)

    parts = in_threads(part, range(0, height, rows))
    found, back = (np.concatenate(each) for each in zip(*parts, strict=True))
    disagreement, claimed = both_ways_disagreement(found, back, count), claimed_pixels(back)
    return Matches(found + np.float32(first), disagreement, claimed[:, count : count + width])


def _match_products(pair: Pair, rows: slice, uniqueness_percent: int, noisy_right: bool) -> tuple[Floats, Floats]:
    """Disparities less ``first`` of left columns (h, w) with their sub-pixel step, and whole ones of right columns.

    Right column i + count - k, (h, w + 2 count) of them, is what left column begin + i sees at first + k.
    """
    (begin, end), count = pair.columns, pair.count
    score = scores(pair, rows)
    seen = seen_from_right(pair, score)
    best = seen.argmax(axis=2)
    known = np.take_along_axis(seen, best[..., None], axis=2)[..., 0] > -1
    back = np.full((len(score), end - begin + 2 * count), np.nan, np.float32)
    back[:, 1 : end - begin + count] = np.where(known, best, np.float32(np.nan))[:, ::-1]
    own = score[:, begin - pair.start : end - pair.start]
    return _best(own, 2, pair.variance[rows], pair.lag[rows], uniqueness_percent, noisy_right), back


@dataclass(frozen=True)
class _Search:
    """Left ``columns``, the first and one past the last, and the ``count`` disparities from ``first`` on to try."""

    columns: tuple[int, int]
    first: int
    count: int


def _match_disparities(
    left: Floats, right: Floats, inner: slice, search: _Search, settings: MatcherSettings, noisy_right: bool
) -> tuple[Floats, Floats]:
    """The same of strips (F, h, W), disparity by disparity, of their ``inner`` rows."""
    (begin, end), first, count = search.columns, search.first, search.count
    block, frames = settings.block_size, len(left)
    reach, blank = block // 2, np.float32(frames * BLANK_VARIANCE)
    # right pixels look for their partner left of `begin` and right of `end` too
    low, high = max(begin - count, 0), min(end + count, left.shape[2])
    left = left[:, :, low:high]
    place = low - first - count - reach + np.arange(left.shape[2] + count + 1 + 2 * reach)
    exists = ((place >= 0) & (place < right.shape[2]))[reach:-reach]
    right = right[:, :, np.clip(place, 0, right.shape[2] - 1)]
    mean_left, mean_right = box(left, block), box(right, block)
    variance_left, variance_right = block_variance(left, mean_left, block), block_variance(right, mean_right, block)
    lag = lag_covariance(right, mean_right, block)
    right, mean_right, variance_right, lag = (
        each[..., reach:-reach] for each in (right, mean_right, variance_right, lag)
    )
    scale_left = 1 / np.sqrt(variance_left[inner] + blank)
    scale_right = 1 / np.sqrt(variance_right[inner] + blank)

    score = np.full((count, inner.stop - inner.start, left.shape[2]), -1.0, np.float32)
    best_back = np.full(scale_right.shape, -1.0, np.float32)
    back = np.full(scale_right.shape, np.nan, np.float32)
    for k in range(count):
        # what the asked columns see, and what else sees the same right pixels
        x = slice(max(begin - count + 1 + k - reach - low, 0), min(end + k + reach - low, left.shape[2]))
        seen = slice(x.start + count - k, x.stop + count - k)
        total = np.zeros((left.shape[1], x.stop - x.start), np.float32)
        for one, other in zip(left, right, strict=True):
            cv2.accumulateProduct(one[:, x], other[:, seen], total)
        rho = np.asarray(cv2.boxFilter(total, -1, (block, block), borderType=cv2.BORDER_REPLICATE))[inner]
        for one, other in zip(mean_left, mean_right, strict=True):
            rho -= one[inner, x] * other[inner, seen]
        own = score[k][:, x]
        np.multiply(rho, scale_left[:, x], out=own)
        own *= scale_right[:, seen]
        np.copyto(own, -1.0, where=~exists[seen])
        better = own > best_back[:, seen]
        np.copyto(best_back[:, seen], own, where=better)
        np.copyto(back[:, seen], np.float32(k), where=better)

    asked, shift = slice(begin - low, end - low), begin - low
    back_asked = np.full((len(back), end - begin + 2 * count), np.nan, np.float32)
    some = min(back_asked.shape[1], back.shape[1] - shift)
    back_asked[:, :some] = back[:, shift : shift + some]
    own = (variance_right[inner, shift:], lag[inner, shift:])
    found = _best(score[:, :, asked], 0, *own, settings.uniqueness_percent, noisy_right)
    return found, back_asked


def _best(
    score: Floats, axis: int, variance: Floats, lag: Floats, uniqueness_percent: int, noisy_right: bool
) -> Floats:
    """Best disparities (h, w) less ``first``, NaN if not unique, of scores with all disparities along an axis.

    ``variance`` and ``lag`` as for the sub-pixel step, of right columns i + count - k. Writes into the scores.
    """
    count = score.shape[axis]
    best = score.argmax(axis=axis)
    beside = [np.expand_dims(np.clip(best + step, 0, count - 1), axis) for step in (-1, 0, 1)]
    lower, peak, upper = (np.take_along_axis(score, k, axis=axis).squeeze(axis) for k in beside)
    step = _sub_pixel((lower, peak, upper), best, variance, lag, count, noisy_right)
    for k in beside:
        np.put_along_axis(score, k, -1.0, axis=axis)
    unique = (1 - peak) * 100 <= (1 - score.max(axis=axis)) * (100 - uniqueness_percent)
    return np.where(unique & (peak > 0), best + step, np.nan).astype(np.float32)


def _sub_pixel(
    rho: tuple[Floats, Floats, Floats],
    best: NDArray[np.intp],
    variance: Floats,
    lag: Floats,
    count: int,
    noisy_right: bool,
) -> Floats:
    """Where between a best disparity and its neighbours the correlation is greatest, -1 to 1.

    ``rho`` one disparity less, at it, and one more; ``variance`` of right blocks, ``lag`` covariance of a right block
    with that of the column before.
    """
    lower, peak, upper = rho
    column = np.arange(best.shape[1]) + count - best

    def at(values: Floats, shift: int) -> Floats:
        return np.take_along_axis(values, np.clip(column + shift, 0, values.shape[1] - 1), axis=1)

    here = at(variance, 0)
    noise = 1 - _height_of_peak(lower, peak, upper) if noisy_right else np.float32(0.0)
    best_rho, step = np.full(best.shape, -np.inf, np.float32), np.zeros(best.shape, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        # one disparity more is one column less
        for sign, score, inside in ((1, upper, best < count - 1), (-1, lower, best > 0)):
            there, q = at(variance, -sign), at(lag, 0 if sign > 0 else 1)
            share = noise * (here + there) / 2
            c, e = here - share, there - share
            a = peak * np.sqrt(here)
            u, p, s = score * np.sqrt(there) - a, q - c, c - 2 * q + e
            tau = np.clip((a * p - u * c) / (u * p - a * s), 0, 1)
            reached = (a + tau * u) / np.sqrt(c + tau * (2 * p + tau * s))
            better = inside & (score > -1) & np.isfinite(reached) & (reached > best_rho)
            step = np.where(better, sign * tau, step)
            best_rho = np.where(better, reached, best_rho)
    return step.astype(np.float32)


def _height_of_peak(lower: Floats, peak: Floats, upper: Floats) -> Floats:
    """Height of the Gaussian through three neighbouring correlations, from 0.1 to 1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b, c = (np.log(np.maximum(each, np.float32(1e-3))) for each in (lower, peak, upper))
        height = np.exp(b - (a - c) ** 2 / (8 * (a - 2 * b + c)))
    return np.clip(np.where(np.isfinite(height), height, peak), _LEAST_PEAK, 1)
