"""Estimate the correlation between residuals of neighbouring pixels, and the degrees of freedom that it leaves.

Signal chain: residuals along the rays on the pixel grid, with gaps -> mean product of all pairs at each lag ->
autocorrelation rho(h), corrected for the plane fits -> correlation length and area -> effective degrees of freedom of a
patch's sigma.

*Length.* rho is averaged over all lags of equal length. The correlation length is the length at which this average
first falls below 1/e, by linear interpolation. For independent pixels the rule gives 1 - 1/e = 0.63 px.

*Area.* A is the sum of rho over lags. The sum ends at the first length at which the average is below two standard
errors of an uncorrelated field (truncation as by Geyer, Stat. Sci. 7 (1992) 473, *recalled*). The mean of n >> A pixels
has the variance sigma^2 A / n, so its effective number of pixels is n / A.

*Correction for the plane fit.* Residuals of a plane fitted to a disc of n pixels are r = M e, with M = I - H and the
hat matrix H. The products of pairs at lag h therefore have the mean

    sum over pairs r_i r_j = sum over h' of tr(K_h M K_h' M) c(h')

with K_h the matrix that is 1 for pairs at lag h, and c the covariance of the field. Without a correction, the field
looks nearly uncorrelated, because the fitted planes remove its long-range part. The equations are linear in c and are
solved for it. This requires c = 0 beyond the largest lag, the radius of the disc. A longer correlation is
underestimated (that of a field with a length of 2/3 radius by 8 %, see the tests).

*Degrees of freedom.* Let C be the correlation matrix of the pixels. The sum of squares r^T r = e^T M e has mean sigma^2
tr(M C) and variance 2 sigma^4 tr(M C M C). It is approximated by a scaled chi-square with the same two moments
(Satterthwaite, Biometrics Bull. 2 (1946) 110-114; Box, Ann. Math. Stat. 25 (1954) 290-302):

    sigma^2 = r^T r / tr(M C),     nu = tr(M C)^2 / tr(M C M C)

For independent pixels, tr(M C) and nu are both n - 3. If only a mean is subtracted, nu is the effective number of
observations of Bayley and Hammersley (J. R. Stat. Soc. Suppl. 8 (1946) 184-197; Zieba, Metrol. Meas. Syst. 17 (2010)
3-16).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from characterisation.coupon.discs import disc_offsets

Floats = NDArray[np.float64]

#: largest lag that is evaluated [px]; it is also at most the radius of the disc
LARGEST_LAG = 8

#: patches with a smaller share of their pixels are excluded from the correlation
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation of a field on the pixel grid.

    ``values`` (2 k + 1, 2 k + 1) is rho at the lags (row, column) from -k to k: 1 in the middle, NaN where unknown.
    ``pairs``, of the same shape, is the number of pairs of pixels at each lag.
    """

    values: Floats
    pairs: Floats

    @property
    def reach(self) -> int:
        """Return the largest lag k [px] along an axis."""
        return len(self.values) // 2

    def radial(self) -> tuple[Floats, Floats, Floats]:
        """Return lengths of lags [px], the mean of rho over the pairs of each length, and their number; (m,) each."""
        square = _squared_lags(self.reach)
        known = np.isfinite(self.values) & (square <= self.reach**2) & (self.pairs > 0)
        lengths, ring = np.unique(square[known], return_inverse=True)
        pairs = _by(ring, self.pairs[known], len(lengths))
        return np.sqrt(lengths), _by(ring, (self.pairs * self.values)[known], len(lengths)) / pairs, pairs

    def significant(self) -> Autocorrelation:
        """Return the significant part of the autocorrelation.

        It is zero from the first length at which the radial average is below two standard errors. The standard error is
        that of an uncorrelated field, one over the square root of the number of distinct pairs.
        """
        length, rho, pairs = self.radial()
        lost = np.flatnonzero(rho < 2.0 / np.sqrt(np.maximum(pairs / 2.0, 1.0)))
        limit = length[lost[0]] ** 2 if len(lost) else np.inf
        inside = (_squared_lags(self.reach) < limit - 0.5) & np.isfinite(self.values)
        return Autocorrelation(np.where(inside, self.values, 0.0), self.pairs)

    def length(self) -> float:
        """Return the correlation length [px]; NaN if the field is unknown or rho stays above 1/e to the largest lag."""
        distance, rho, _ = self.radial()
        return float(_efolding(distance, rho[None])[0]) if len(rho) > 1 else float("nan")

    def area(self) -> float:
        """Return the correlation area A [px^2], 1 for independent pixels; NaN if the field is unknown."""
        middle = self.values[self.reach, self.reach]
        return float(self.significant().values.sum()) if np.isfinite(middle) else float("nan")


def autocorrelation(field: NDArray[np.floating], reach: int = LARGEST_LAG) -> Autocorrelation:
    """Return the autocorrelation of a field (height, width) about its mean; NaN in the field marks missing values.

    It is normalised by the number of pairs of each lag, so that gaps and borders do not bias it. Subtracting the mean
    lowers it by about A over the number of pixels; for the residuals of small discs use :func:`disc_autocorrelation`.
    """
    field = np.asarray(field, float)
    present = np.isfinite(field)
    reach = min(reach, *(side - 1 for side in field.shape))
    filled = np.where(present, field - (np.mean(field[present]) if present.any() else 0.0), 0.0)
    shape = [scipy.fft.next_fast_len(side + reach, real=True) for side in field.shape]

    def sums(values: Floats) -> Floats:
        circular = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(values, shape)) ** 2, shape)
        lags = np.arange(-reach, reach + 1)
        return np.asarray(circular[np.ix_(lags, lags)])

    pairs = np.rint(sums(present.astype(float)))
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = np.where(pairs > 0, sums(filled) / pairs, np.nan)
        return Autocorrelation(covariance / covariance[reach, reach], pairs)


@dataclass(frozen=True)
class _Disc:
    """Quantities that depend only on the shape of a disc, for all sums over its pairs of pixels.

    - ``lag`` (n, n): number of each pair's lag, the same for a lag and its opposite; K beyond the largest lag.
    - ``lags`` (K, 2): lags in order of length.
    - ``pairs`` (K,): number of pairs at each lag.
    - ``lengths`` (R,): distinct lengths of lags; ``rings`` (R,): where each begins in ``lags``.
    - ``plane`` (n, 3): orthonormal columns that span a plane.
    - ``moments`` (K, K): mean product of the residuals at each lag, for unit covariance at each lag.
    - ``gap_moments`` (K, K): contribution of gaps to ``moments``, see :meth:`moments_with_gaps`.
    """

    lag: NDArray[np.intp]
    lags: NDArray[np.int64]
    pairs: Floats
    lengths: Floats
    rings: NDArray[np.intp]
    plane: Floats
    moments: Floats
    gap_moments: Floats

    def by_ring(self, values: Floats) -> Floats:
        """Return sums (..., R) of values (..., K) over the lags of equal length."""
        return np.asarray(np.add.reduceat(values, self.rings, axis=-1))

    def at_lags(self, rho: Autocorrelation) -> Floats:
        """Return the significant part of rho (K,) at each lag; that of independent pixels if rho is unknown."""
        values = rho.significant().values[tuple((self.lags + rho.reach).T)]
        values[0] = 1.0
        return np.asarray(values)

    def correlation(self, rho: Autocorrelation) -> Floats:
        """Return the correlation matrix (n, n) of the pixels of the disc."""
        return np.asarray(np.append(self.at_lags(rho), 0.0)[self.lag])

    def moments_with_gaps(self, inverse_share: float) -> Floats:
        """Return ``moments`` of discs with a share f = 1 / ``inverse_share`` of their pixels present at random.

        The hat matrix of the remaining pixels is about H / f. The pixels of a pair are present by definition, so they
        count in full, and the others count by f. To first order in H, this adds (1 / f - 1) times ``gap_moments``.
        """
        return np.asarray(self.moments + (inverse_share - 1.0) * self.gap_moments)


@lru_cache(maxsize=8)
def _disc(radius_px: float) -> _Disc:
    offsets = disc_offsets(radius_px)
    reach = min(int(radius_px), LARGEST_LAG)
    apart = offsets[None] - offsets[:, None]
    apart *= np.where((apart[..., 0] < 0) | ((apart[..., 0] == 0) & (apart[..., 1] < 0)), -1, 1)[..., None]
    square = (apart**2).sum(-1)
    row, column = np.mgrid[0 : reach + 1, -reach : reach + 1]
    half = (row**2 + column**2 <= reach**2) & ((row > 0) | (column >= 0))
    lags = np.stack([row[half], column[half]], axis=-1)
    lags = lags[np.argsort((lags**2).sum(-1), kind="stable")]
    lengths, rings = np.unique((lags**2).sum(-1), return_index=True)
    number = np.full((reach + 1, 2 * reach + 1), len(lags))
    number[lags[:, 0], lags[:, 1] + reach] = np.arange(len(lags))
    near = square <= reach**2
    lag = np.where(near, number[np.where(near, apart[..., 0], 0), np.where(near, apart[..., 1], 0) + reach], len(lags))

    plane = np.linalg.qr(np.column_stack([np.ones(len(offsets)), offsets]))[0]
    hat = plane @ plane.T
    own = np.diag(hat)
    both = _by(lag, np.ones(lag.shape), len(lags))  # pairs in either order
    moments, gap_moments = np.empty((2, len(lags), len(lags)))
    for k in range(len(lags)):
        at_lag = (lag == k).astype(float)
        part = (at_lag @ plane) @ plane.T
        shared = np.diag(part)
        gaps = own[:, None] * (part - at_lag) + own * (part.T - at_lag) + hat * (shared[:, None] + shared)
        moments[:, k] = _by(lag, _without_plane(at_lag, plane), len(lags)) / both
        gap_moments[:, k] = _by(lag, gaps, len(lags)) / both
    gap_moments[:, 0] = -_by(lag, hat, len(lags)) / both
    pairs = np.where((lags == 0).all(1), both, both / 2)
    return _Disc(lag, lags, pairs, np.sqrt(lengths), rings, plane, moments, gap_moments)


def _without_plane(covariance: Floats, plane: Floats) -> Floats:
    """Return M C M, the covariance (n, n) of the residuals of a plane fit to a field with covariance C."""
    half = plane @ (plane.T @ covariance)
    return np.asarray(covariance - half - half.T + plane @ (plane.T @ covariance @ plane) @ plane.T)


@dataclass(frozen=True)
class DiscResiduals:
    """Residuals of planes fitted to discs of pixels, and their products.

    ``radius_px`` is the radius of the discs; ``present`` (p, n) marks the pixels with a residual. ``products`` (p, K)
    is the sum of the products of pairs of residuals at each lag, and ``pairs`` (p, K) their number. A lag and its
    opposite are one.
    """

    radius_px: float
    present: NDArray[np.bool_]
    products: Floats
    pairs: Floats


def disc_residuals(residuals: NDArray[np.floating], radius_px: float) -> DiscResiduals:
    """Compute the products of all pairs of residuals in each disc.

    ``residuals`` (p, n) are those of p discs, with pixels in the order of
    :func:`characterisation.coupon.discs.disc_offsets`, NaN where missing.
    """
    disc = _disc(float(radius_px))
    present = np.isfinite(residuals)
    offsets = disc_offsets(radius_px)
    reach = int(np.abs(disc.lags).max())
    size = scipy.fft.next_fast_len(2 * int(radius_px) + 1 + reach, real=True)

    def sums(values: NDArray[np.bool_] | Floats) -> Floats:
        grid = np.zeros((len(values), size, size), np.float32)
        grid[:, offsets[:, 0] + int(radius_px), offsets[:, 1] + int(radius_px)] = values
        turned = scipy.fft.rfft2(grid)
        circular = scipy.fft.irfft2(turned.real**2 + turned.imag**2, (size, size))
        return np.asarray(circular[:, disc.lags[:, 0], disc.lags[:, 1]], float)

    pairs = np.broadcast_to(disc.pairs, (len(present), len(disc.lags))).copy()
    gaps = ~present.all(1)
    if gaps.any():
        pairs[gaps] = np.rint(sums(present[gaps]))
    products = sums(np.where(present, residuals, 0.0)) if len(present) else pairs
    return DiscResiduals(radius_px, present, products, pairs)


def disc_autocorrelation(field: DiscResiduals) -> Autocorrelation:
    """Return the autocorrelation of a field after planes were subtracted disc by disc, pooled over the discs.

    Discs with more than half of their pixels missing are excluded; gaps are assumed to be random. All values are NaN if
    no disc is left or there is no noise.
    """
    disc = _disc(float(field.radius_px))
    share = field.present.mean(1)
    used = share >= LEAST_SHARE
    share, pairs, products = share[used], field.pairs[used].sum(0), field.products[used].sum(0)
    reach = int(np.abs(disc.lags).max())
    values, counts = np.full((2 * reach + 1, 2 * reach + 1), np.nan), np.zeros((2 * reach + 1, 2 * reach + 1))
    if pairs.min() > 0 and products[0] > 0:
        moments = disc.moments_with_gaps(share.sum() / (share**2).sum())
        covariance = np.linalg.solve(moments, products / pairs)
        for sign in (1, -1) if covariance[0] > 0 else ():
            place = tuple((sign * disc.lags + reach).T)
            values[place], counts[place] = np.clip(covariance / covariance[0], -1.0, 1.0), pairs
    return Autocorrelation(values, counts)


def plane_degrees(field: DiscResiduals, rho: Autocorrelation) -> tuple[Floats, Floats]:
    """Return the effective degrees of freedom of the spread about a plane, for discs with gaps.

    Returns
    -------
    degrees
        (p,) nu; n - 3 if ``rho`` is unknown.
    kept
        (p,) tr(M C) / (n - 3): the share of sigma^2 that the usual estimate with n - 3 degrees of freedom gives. Both
        are NaN where a disc has fewer than 4 pixels, or all on a line.
    """
    disc = _disc(float(field.radius_px))
    at_lags, correlation = disc.at_lags(rho), disc.correlation(rho)
    gaps = ~field.present.all(1)
    if not at_lags[1:].any() and field.present.sum(1).min(initial=len(disc.plane)) > len(disc.plane) / 2:
        degrees = field.present.sum(1) - 3.0  # the result of the sums below without correlation
        return degrees, np.ones(len(degrees))
    # all discs without gaps give the same result, which is computed once
    which = np.where(gaps, np.cumsum(gaps), 0)
    mask = np.concatenate([np.ones((1, field.present.shape[1])), field.present[gaps]])
    pairs = np.concatenate([disc.pairs[None], field.pairs[gaps]])
    count = mask.sum(1)
    design = mask[:, None] * disc.plane.T * np.sqrt(mask.shape[1])
    gram = design @ design.swapaxes(1, 2)
    solvable = (count > 3) & (np.linalg.det(gram / np.maximum(count, 1)[:, None, None]) > 1e-9)
    inverse = np.linalg.inv(np.where(solvable[:, None, None], gram, np.eye(3)))
    turned = (design @ correlation) * mask[:, None]
    hat = inverse @ (turned @ design.swapaxes(1, 2))  # tr is that of H C
    trace = count - np.trace(hat, axis1=1, axis2=2)
    square = (pairs * (2.0 * at_lags**2)).sum(1) - count  # tr(C C); the lag 0 has each pixel once
    square -= 2.0 * (inverse * (turned @ turned.swapaxes(1, 2))).sum((1, 2))
    square += (hat * hat.swapaxes(1, 2)).sum((1, 2))
    good = solvable & (trace > 0) & (square > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # at least 1 for a true correlation matrix; the matrix of an estimated rho need not be one
        degrees = np.where(good, np.maximum(trace**2 / square, 1.0), np.nan)
        kept = np.where(good, trace / (count - 3), np.nan)
    return degrees[which], kept[which]


def disc_lengths(field: DiscResiduals, variance: Floats, rho: Autocorrelation) -> Floats:
    """Return the correlation length [px] (p,) of each disc by itself.

    One disc has few pairs, so these lengths scatter much more than the pooled length. The part that the plane fit
    removed is restored from the pooled ``rho``. ``variance`` (p,) [mm^2] is that of the field in each disc, as of
    :func:`plane_degrees`.
    """
    disc = _disc(float(field.radius_px))
    correlation = disc.correlation(rho)
    both = _by(disc.lag, np.ones(disc.lag.shape), len(disc.lags))
    taken = _by(disc.lag, correlation - _without_plane(correlation, disc.plane), len(disc.lags))
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = disc.by_ring(field.products) / disc.by_ring(field.pairs)
        covariance += variance[:, None] * (disc.by_ring(taken) / disc.by_ring(both))
        values = covariance / covariance[:, :1]
    known = (field.present.mean(1) >= LEAST_SHARE) & (variance > 0) & np.isfinite(values).all(1)
    return np.where(known, _efolding(disc.lengths, np.where(known[:, None], values, 0.0)), np.nan)


def _by(label: NDArray[np.intp], values: Floats, count: int) -> Floats:
    """Return the sums (count,) of ``values`` by their label; labels of ``count`` and above are left out."""
    return np.asarray(np.bincount(label.ravel(), values.ravel(), count + 1)[:count], float)


@lru_cache(maxsize=8)
def _squared_lags(reach: int) -> NDArray[np.int64]:
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(row**2 + column**2)


def _efolding(distance: Floats, rho: Floats) -> Floats:
    """Return where rho (p, m) over ``distance`` (m,) first falls below 1/e, NaN where it does not; rho starts at 1."""
    level = np.exp(-1.0)
    under = rho < level
    after = np.maximum(under.argmax(1), 1)
    row = np.arange(len(rho))
    high, low = rho[row, after - 1], rho[row, after]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = distance[after - 1] + (high - level) / (high - low) * (distance[after] - distance[after - 1])
    return np.where(under.any(1), crossing, np.nan)
