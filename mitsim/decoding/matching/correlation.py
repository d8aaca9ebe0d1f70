"""Match by correlation: all frames of both images of a rectified pair together, or an image and its reference.

Signal chain: strips of both images, a stack of frames each -> products of pixels, summed over the frames and over a
block, at each disparity of the search range -> correlation -> best and second best, from the left and from the right ->
sub-pixel step -> :class:`~mitsim.decoding.matching.sgbm.Matches`.

The score is the zero-mean normalised cross-correlation rho of a square block through all F frames. Sources for
spatio-temporal stereo: Davis, Nehab, Ramamoorthi and Rusinkiewicz, IEEE PAMI 27(2), 2005; Zhang, Curless and Seitz,
CVPR 2003. The mean is subtracted frame by frame, so the score is independent of a camera's brightness and contrast.
There is no smoothness term: a block without texture gets no disparity from its neighbours.

The sub-pixel step is the closed form of Psarakis and Evangelidis (ICCV 2005). At a fraction tau between two columns,
the right block is (1 - tau) R0 + tau R1. The maximum of rho(tau) is at

    tau = (a p - u c) / (u p - a s),    u = b - a,  p = q - c,  s = c - 2 q + e

with the covariances a, b of the left block with R0 and R1, the variances c, e of R0 and R1, and their covariance q.

Interpolation also averages the noise of the right image. This biases tau toward 1/2, by 0.09 px where the noise is a
third of the pattern's contrast. The share of noise in c and e is therefore subtracted first. It is 1 - rho at the peak
if both images are equally noisy. This correction is original to mitsim.

A parabola through three values of rho would be biased toward whole pixels by 0.03 to 0.05 px. Without noise its error
is three times as large.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Singles
from characterisation.files.threads import in_threads
from mitsim.decoding.matching.sgbm import Matches, both_ways_disagreement, pixels_matched_back
from mitsim.decoding.matching.sub_pixel import offset_of_minimum
from mitsim.sensor.matcher import MatcherSettings

#: bytes of the correlations that each thread holds at once
_VOLUME_BYTES = 24e6

#: added to the variance of a block for each frame [DN^2 of 8 bit], so that blocks without texture correlate with
#: nothing
_BLANK_VARIANCE = 0.02

#: least peak correlation that is assumed when the share of noise is estimated
_MINIMUM_PEAK = 0.1


def correlate_both_ways(
    left: Singles,
    right: Singles,
    columns: tuple[int, int],
    first: int,
    count: int,
    settings: MatcherSettings,
    *,
    noisy_right: bool = True,
) -> Matches:
    """Match columns of the left strips to the right strips, and in the reverse direction.

    Parameters
    ----------
    left, right
        (F, h, W) rectified strips [DN of 8 bit], the same rows of both. Each frame has a mean near zero, since a large
        mean would increase the rounding error.
    columns
        First left column to match, and one past the last.
    first, count
        Search range, from :func:`mitsim.decoding.matching.sgbm.search_range`.
    settings
        Block size and uniqueness. 1 - rho of the best disparity must be lower by this percentage than that of any other
        disparity more than one pixel away.
    noisy_right
        False if the right image is a reference without noise.
    """
    height = left.shape[1]
    width = columns[1] - columns[0]
    rows = max(int(_VOLUME_BYTES / (4 * count * (width + 2 * count))), 4)

    def match_rows(start: int) -> tuple[Singles, Singles]:
        chunk = slice(start, min(start + rows, height))
        reach = settings.block_size // 2
        around = slice(max(chunk.start - reach, 0), min(chunk.stop + reach, height))
        inner = slice(chunk.start - around.start, chunk.stop - around.start)
        search = _Search(columns, first, count)
        return _matched(left[:, around], right[:, around], inner, search, settings, noisy_right)

    results = in_threads(match_rows, range(0, height, rows))
    disparities, back = (np.concatenate(arrays) for arrays in zip(*results, strict=True))
    disagreement, matched_back = both_ways_disagreement(disparities, back, count), pixels_matched_back(back)
    return Matches(disparities + np.float32(first), disagreement, matched_back[:, count : count + width])


@dataclass(frozen=True)
class _Search:
    """Search range: left ``columns``, the first and one past the last; ``count`` disparities from ``first`` on."""

    columns: tuple[int, int]
    first: int
    count: int


def _matched(
    left: Singles, right: Singles, inner: slice, search: _Search, settings: MatcherSettings, noisy_right: bool
) -> tuple[Singles, Singles]:
    """Match the ``inner`` rows of strips (F, h, W), disparity by disparity.

    Returns
    -------
    disparities
        (h, w) of the left columns, less ``first``, with the sub-pixel step.
    back
        (h, w + 2 count) whole disparities of right columns. Left column begin + i sees right column i + count - k at
        disparity first + k.
    """
    (begin, end), first, count = search.columns, search.first, search.count
    block, frames = settings.block_size, len(left)
    reach, blank = block // 2, np.float32(frames * _BLANK_VARIANCE)
    # right pixels also search left of `begin` and right of `end`
    low, high = max(begin - count, 0), min(end + count, left.shape[2])
    left = left[:, :, low:high]
    right_source = low - first - count - reach + np.arange(left.shape[2] + count + 1 + 2 * reach)
    exists = ((right_source >= 0) & (right_source < right.shape[2]))[reach:-reach]
    right = right[:, :, np.clip(right_source, 0, right.shape[2] - 1)]
    mean_left, mean_right = _block_mean(left, block), _block_mean(right, block)
    variance_left, variance_right = _block_variance(left, mean_left, block), _block_variance(right, mean_right, block)
    lag = _lag_covariance(right, mean_right, block)
    right, mean_right, variance_right, lag = (
        array[..., reach:-reach] for array in (right, mean_right, variance_right, lag)
    )
    scale_left = 1 / np.sqrt(variance_left[inner] + blank)
    scale_right = 1 / np.sqrt(variance_right[inner] + blank)

    score = np.full((count, inner.stop - inner.start, left.shape[2]), -1.0, np.float32)
    best_back = np.full(scale_right.shape, -1.0, np.float32)
    back = np.full(scale_right.shape, np.nan, np.float32)
    for k in range(count):
        # the right pixels that the requested columns see, and all left pixels that see them
        left_columns = slice(max(begin - count + 1 + k - reach - low, 0), min(end + k + reach - low, left.shape[2]))
        right_columns = slice(left_columns.start + count - k, left_columns.stop + count - k)
        products = np.zeros((left.shape[1], left_columns.stop - left_columns.start), np.float32)
        for left_frame, right_frame in zip(left, right, strict=True):
            cv2.accumulateProduct(left_frame[:, left_columns], right_frame[:, right_columns], products)
        rho = np.asarray(cv2.boxFilter(products, -1, (block, block), borderType=cv2.BORDER_REPLICATE))[inner]
        for left_frame, right_frame in zip(mean_left, mean_right, strict=True):
            rho -= left_frame[inner, left_columns] * right_frame[inner, right_columns]
        rho_scaled = score[k][:, left_columns]
        np.multiply(rho, scale_left[:, left_columns], out=rho_scaled)
        rho_scaled *= scale_right[:, right_columns]
        np.copyto(rho_scaled, -1.0, where=~exists[right_columns])
        better = rho_scaled > best_back[:, right_columns]
        np.copyto(best_back[:, right_columns], rho_scaled, where=better)
        np.copyto(back[:, right_columns], np.float32(k), where=better)

    requested, shift = slice(begin - low, end - low), begin - low
    back_requested = np.full((len(back), end - begin + 2 * count), np.nan, np.float32)
    shared_width = min(back_requested.shape[1], back.shape[1] - shift)
    back_requested[:, :shared_width] = back[:, shift : shift + shared_width]
    right_statistics = (variance_right[inner, shift:], lag[inner, shift:])
    disparities = _best_disparities(score[:, :, requested], *right_statistics, settings, noisy_right)
    return disparities, back_requested


def _sliding_sums(values: Singles, count: int, length: int) -> Singles:
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


def _block_mean(images: Singles, block: int) -> Singles:
    """Return the mean (F, h, w) of a square block around each pixel; pixels beyond the edges repeat the edge."""
    reach = block // 2
    height, width = images.shape[1:]
    padded = np.pad(images, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    row_sums = _sliding_sums(np.moveaxis(padded, 1, 0), block, height)  # (h, F, w + 2r)
    sums = _sliding_sums(np.moveaxis(row_sums, 2, 0), block, width)  # (w, h, F)
    return np.ascontiguousarray(np.moveaxis(sums, (2, 1), (0, 1))) * np.float32(1 / block**2)


def _block_variance(images: Singles, means: Singles, block: int) -> Singles:
    """Return the variance of each block (h, w), summed over the frames."""
    total = _block_mean((images * images).sum(axis=0)[None], block)[0]
    return np.asarray(np.maximum(total - (means * means).sum(axis=0), 0))


def _lag_covariance(images: Singles, means: Singles, block: int) -> Singles:
    """Return the covariance of each block with that of the column before (h, w), summed over the frames."""
    previous, mean_previous = (np.concatenate([array[:, :, :1], array[:, :, :-1]], axis=2) for array in (images, means))
    total = _block_mean((images * previous).sum(axis=0)[None], block)[0]
    return np.asarray(total - (means * mean_previous).sum(axis=0))


def _best_disparities(
    score: Singles, variance: Singles, lag: Singles, settings: MatcherSettings, noisy_right: bool
) -> Singles:
    """Return the best disparities (h, w) less ``first``, NaN if not unique.

    ``score`` (count, h, w) holds the correlations of all disparities, and is overwritten. ``variance`` and ``lag`` are
    those of :func:`_sub_pixel`, for right columns i + count - k.
    """
    count = len(score)
    best = score.argmax(axis=0)
    beside = [np.clip(best + step, 0, count - 1)[None] for step in (-1, 0, 1)]
    lower, peak, upper = (np.take_along_axis(score, k, axis=0)[0] for k in beside)
    fit = settings.sub_pixel
    if fit == "method" or fit == "opencv":
        step = _sub_pixel((lower, peak, upper), best, variance, lag, count, noisy_right)
    else:
        inside = (best > 0) & (best < count - 1)
        step = np.where(inside, offset_of_minimum(-lower, -peak, -upper, fit), np.float32(0))
    for k in beside:
        np.put_along_axis(score, k, -1.0, axis=0)
    unique = (1 - peak) * 100 <= (1 - score.max(axis=0)) * (100 - settings.uniqueness_percent)
    return np.where(unique & (peak > 0), best + step, np.nan).astype(np.float32)


def _sub_pixel(
    rho: tuple[Singles, Singles, Singles],
    best: NDArray[np.intp],
    variance: Singles,
    lag: Singles,
    count: int,
    noisy_right: bool,
) -> Singles:
    """Return the position of the maximum of rho between the best disparity and its neighbours, -1 to 1.

    ``rho`` at one disparity less, at the best, and at one more; ``variance`` of right blocks; ``lag``, the covariance
    of each right block with that of the column before.
    """
    lower, peak, upper = rho
    column = np.arange(best.shape[1]) + count - best

    def at(values: Singles, shift: int) -> Singles:
        return np.take_along_axis(values, np.clip(column + shift, 0, values.shape[1] - 1), axis=1)

    variance_here = at(variance, 0)
    noise = 1 - _peak_height(lower, peak, upper) if noisy_right else np.float32(0.0)
    best_rho, step = np.full(best.shape, -np.inf, np.float32), np.zeros(best.shape, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        # one disparity more is one column less
        for sign, score, inside in ((1, upper, best < count - 1), (-1, lower, best > 0)):
            variance_there, q = at(variance, -sign), at(lag, 0 if sign > 0 else 1)
            noise_share = noise * (variance_here + variance_there) / 2
            c, e = variance_here - noise_share, variance_there - noise_share
            a = peak * np.sqrt(variance_here)
            u, p, s = score * np.sqrt(variance_there) - a, q - c, c - 2 * q + e
            tau = np.clip((a * p - u * c) / (u * p - a * s), 0, 1)
            rho_at_tau = (a + tau * u) / np.sqrt(c + tau * (2 * p + tau * s))
            better = inside & (score > -1) & np.isfinite(rho_at_tau) & (rho_at_tau > best_rho)
            step = np.where(better, sign * tau, step)
            best_rho = np.where(better, rho_at_tau, best_rho)
    return step.astype(np.float32)


def _peak_height(lower: Singles, peak: Singles, upper: Singles) -> Singles:
    """Return the height of the Gaussian through three neighbouring correlations, limited to 0.1 to 1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b, c = (np.log(np.maximum(array, np.float32(1e-3))) for array in (lower, peak, upper))
        height = np.exp(b - (a - c) ** 2 / (8 * (a - 2 * b + c)))
    return np.clip(np.where(np.isfinite(height), height, peak), _MINIMUM_PEAK, 1)
