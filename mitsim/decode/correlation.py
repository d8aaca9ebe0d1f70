"""Matching by correlation: all frames of both images of a rectified pair at once, or an image and its reference.

Signal chain: strips of both images, a stack of frames each -> correlation of a block over all frames, for every
disparity of the search range -> best and next best, from the left and from the right -> sub-pixel step ->
:class:`~mitsim.decode.sgbm.Matches`.

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
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsim.decode.sgbm import Matches, both_ways_disagreement, claimed_pixels
from mitsim.sensor.matcher import MatcherSettings

Floats = NDArray[np.float32]

#: bytes of the correlations that are held at once by each of two threads
_VOLUME_BYTES = 24e6

#: added to the variance of a block [DN^2 of 8 bit] for each frame, so that blank blocks correlate with nothing
_BLANK_VARIANCE = 0.02

#: least peak correlation by which noise is told apart
_LEAST_PEAK = 0.1


def correlate_both_ways(
    left: Floats, right: Floats, columns: tuple[int, int], first: int, count: int, settings: MatcherSettings,
    *, noisy_right: bool = True,
) -> Matches:  # fmt: skip
    """Match columns of the left strips against the right strips, and back.

    Parameters
    ----------
    left, right
        (F, h, W) rectified strips [DN of 8 bit], the same rows of both.
    columns
        First and one past the last left column to be matched.
    first, count
        The search range, from :func:`mitsim.decode.sgbm.search_range`.
    settings
        Block and uniqueness: 1 - rho must beat the next, a pixel away or more, by so much.
    noisy_right
        False where the right image is a reference without noise.
    """
    begin, end = columns
    # right pixels look for their partner left of `begin` and right of `end` too
    low, high = max(begin - count, 0), min(end + count, left.shape[2])
    height, reach = left.shape[1], settings.block_size // 2
    rows = max(int(_VOLUME_BYTES / (4 * count * (high - low))), 4)
    left, right = (image - image.mean(axis=(1, 2), keepdims=True) for image in (left, right))

    def part(start: int) -> tuple[Floats, Floats]:
        stop = min(start + rows, height)
        around = slice(max(start - reach, 0), min(stop + reach, height))
        inner = slice(start - around.start, stop - around.start)
        return _match(left[:, around, low:high], right[:, around], inner, low, first, count, settings, noisy_right)

    with ThreadPoolExecutor(2) as both:
        parts = list(both.map(part, range(0, height, rows)))
    found, back = (np.concatenate(each) for each in zip(*parts, strict=True))
    disagreement, claimed = both_ways_disagreement(found, back, count), claimed_pixels(back)[:, count:]
    asked = slice(begin - low, end - low)
    return Matches(found[:, asked] + np.float32(first), disagreement[:, asked], claimed[:, asked])


def _match(
    left: Floats, right: Floats, inner: slice, low: int, first: int, count: int, settings: MatcherSettings,
    noisy_right: bool,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Disparities less ``first`` of left columns (h, w) with their sub-pixel step, and whole ones of right columns.

    Column j of the right strips as laid out here is ``low - first - count + j`` of the image, so that left column x is
    seen at j = x + count - k for the disparity first + k.
    """
    frames, width, block = len(left), left.shape[2], settings.block_size
    place = low - first - count + np.arange(width + count + 1)
    exists = (place >= 0) & (place < right.shape[2])
    right = right[:, :, np.clip(place, 0, right.shape[2] - 1)]
    mean_left, mean_right = _means(left, block), _means(right, block)
    variance_left, variance_right = _covariance(left, left, block), _covariance(right, right, block)
    blank = np.float32(frames * _BLANK_VARIANCE)
    scale_left = 1 / np.sqrt(variance_left[inner] + blank)
    scale_right = np.where(exists, 1 / np.sqrt(variance_right[inner] + blank), np.float32(np.nan))

    score = np.empty((count, inner.stop - inner.start, width), np.float32)
    best_back = np.full(scale_right.shape, -1.0, np.float32)
    back = np.full(scale_right.shape, np.nan, np.float32)
    total = np.empty(left.shape[1:], np.float32)
    for k in range(count):
        seen = slice(count - k, count - k + width)
        total[:] = 0
        for one, other in zip(left, right, strict=True):
            cv2.accumulateProduct(one, other[:, seen], total)
        rho = _box(total, block)
        for one, other in zip(mean_left, mean_right, strict=True):
            rho -= one * other[:, seen]
        np.multiply(rho[inner], scale_left, out=score[k])
        score[k] *= scale_right[:, seen]
        np.copyto(score[k], -1.0, where=~exists[seen])
        better = score[k] > best_back[:, seen]
        np.copyto(best_back[:, seen], score[k], where=better)
        np.copyto(back[:, seen], np.float32(k), where=better)

    best = score.argmax(axis=0)
    beside = [np.clip(best + step, 0, count - 1)[None] for step in (-1, 0, 1)]
    lower, peak, upper = (np.take_along_axis(score, k, axis=0)[0] for k in beside)
    step = _sub_pixel(
        (lower, peak, upper), best, variance_right[inner], _lag(right, mean_right, block)[inner], count, noisy_right
    )
    for k in beside:
        np.put_along_axis(score, k, -1.0, axis=0)
    unique = (1 - peak) * 100 <= (1 - score.max(axis=0)) * (100 - settings.uniqueness_percent)
    return np.where(unique & (peak > 0), best + step, np.nan).astype(np.float32), back


def _sub_pixel(
    rho: tuple[Floats, Floats, Floats], best: NDArray[np.intp], variance: Floats, lag: Floats, count: int,
    noisy_right: bool,
) -> Floats:  # fmt: skip
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


def _box(image: Floats, block: int) -> Floats:
    return np.asarray(cv2.boxFilter(image, -1, (block, block), borderType=cv2.BORDER_REPLICATE))


def _means(images: Floats, block: int) -> list[Floats]:
    return [_box(image, block) for image in images]


def _covariance(one: Floats, other: Floats, block: int) -> Floats:
    """Sum over frames of the covariance of blocks (h, w)."""
    total = sum((_box(a * b, block) - _box(a, block) * _box(b, block) for a, b in zip(one, other, strict=True)),
                start=np.zeros(one.shape[1:], np.float32))  # fmt: skip
    return np.maximum(total, 0)


def _lag(images: Floats, means: list[Floats], block: int) -> Floats:
    """Sum over frames of the covariance of each block with that of the column before."""
    total = np.zeros(images.shape[1:], np.float32)
    for image, mean in zip(images, means, strict=True):
        before, mean_before = (np.concatenate([each[:, :1], each[:, :-1]], axis=1) for each in (image, mean))
        total += _box(image * before, block) - mean * mean_before
    return total
