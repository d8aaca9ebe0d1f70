r"""Correlation between the residuals of neighbouring pixels, and what it leaves of the degrees of freedom.

Signal chain: residuals along the rays on the pixel grid, with gaps -> products of all pairs at each lag, over the
number of pairs -> autocorrelation rho(h), freed of what the plane fits took -> correlation length and area -> effective
degrees of freedom of a patch's sigma.

*Length.* rho is averaged over all lags of one length; the correlation length is where that first falls under 1/e,
interpolated linearly. Independent pixels have 1 - 1/e = 0.63 px by this rule.

*Area.* A = sum of rho over all lags, up to the first length at which its average is under two standard errors of an
uncorrelated field (truncation as by Geyer, Stat. Sci. 7 (1992) 473, *recalled*). The mean of n >> A pixels has the
variance sigma^2 A / n: there are n / A effective ones.

*What a plane fit does.* Residuals of a plane fitted to a disc of n pixels are r = M e, M = I - H with the hat matrix H,
and so the products of pairs at lag h have the mean

    sum over pairs r_i r_j = sum over h' of tr(K_h M K_h' M) c(h')

with K_h the matrix that is 1 for pairs at lag h, c the covariance of the field. Taken as they are they give a field
that looks nearly uncorrelated: fitted planes swallow whatever is long. The equations are linear in c and are solved for
it. That needs c = 0 beyond the largest lag, the disc's radius; fields that reach farther are seen too short (a field
with a length of 2/3 radius by 8 %, see the tests).

*Degrees of freedom.* The sum of squares r^T r = e^T M e has mean sigma^2 tr(M C) and variance 2 sigma^4 tr(M C M C),
C the correlation matrix of the pixels. It is taken as a scaled chi-square of the same two moments
(Satterthwaite, Biometrics Bull. 2 (1946) 110-114; Box, Ann. Math. Stat. 25 (1954) 290-302):

    sigma^2 = r^T r / tr(M C),     nu = tr(M C)^2 / tr(M C M C)

which are n - 3 and n - 3 for independent pixels. With only a mean taken away it is the effective number of observations
of Bayley and Hammersley (J. R. Stat. Soc. Suppl. 8 (1946) 184-197; Zieba, Metrol. Meas. Syst. 17 (2010) 3-16).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from characterisation.coupon.discs import disc_offsets

Floats = NDArray[np.float64]

#: lags are looked at up to the disc's radius, and no farther than this [px]
LARGEST_LAG = 8

#: patches with less than this share of their pixels do not speak about the correlation
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation of a field on the pixel grid.

    ``values`` (2 k + 1, 2 k + 1): rho at the lags (row, column) from -k to k, 1 in the middle, NaN where unknown;
    ``pairs``, of the same shape, of how many pairs of pixels.
    """

    values: Floats
    pairs: Floats

    @property
    def reach(self) -> int:
        """Largest lag k [px] along an axis."""
        return len(self.values) // 2

    def radial(self) -> tuple[Floats, Floats, Floats]:
        """Lengths of lags [px], rho averaged over all lags of that length by pairs, and their pairs; (m,) each."""
        square = _squared_lags(self.reach)
        known = np.isfinite(self.values) & (square <= self.reach**2) & (self.pairs > 0)
        lengths, ring = np.unique(square[known], return_inverse=True)
        pairs = _by(ring, self.pairs[known], len(lengths))
        return np.sqrt(lengths), _by(ring, (self.pairs * self.values)[known], len(lengths)) / pairs, pairs

    def significant(self) -> Autocorrelation:
        """The same, zero from the first length on at which the radial average is under two standard errors.

        The standard error is that of an uncorrelated field, one over the root of the distinct pairs.
        """
        length, rho, pairs = self.radial()
        lost = np.flatnonzero(rho < 2.0 / np.sqrt(np.maximum(pairs / 2.0, 1.0)))
        limit = length[lost[0]] ** 2 if len(lost) else np.inf
        inside = (_squared_lags(self.reach) < limit - 0.5) & np.isfinite(self.values)
        return Autocorrelation(np.where(inside, self.values, 0.0), self.pairs)

    def length(self) -> float:
        """Correlation length [px]; NaN if the field is unknown or rho stays above 1/e to the largest lag."""
        distance, rho, _ = self.radial()
        return float(_efolding(distance, rho[None])[0]) if len(rho) > 1 else float("nan")

    def area(self) -> float:
        """Correlation area A [px^2], 1 for independent pixels; NaN if the field is unknown."""
        middle = self.values[self.reach, self.reach]
        return float(self.significant().values.sum()) if np.isfinite(middle) else float("nan")


def autocorrelation(field: NDArray[np.floating], reach: int = LARGEST_LAG) -> Autocorrelation:
    """Autocorrelation of a field (height, width), NaN where missing, about its mean.

    Normalised by the pairs of each lag, so gaps and borders do not pull it down. The mean that is taken away does, by
    about A over the number of pixels: for the residuals of small discs take :func:`disc_autocorrelation`.
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
    """What follows from a disc's shape: everything that sums over its pairs of pixels.

    ``lag`` (n, n) number of each pair's lag up to its sign, K for beyond; ``lags`` (K, 2) in the order of their length;
    ``pairs`` (K,) of how many pairs; ``lengths`` (R,) of lags, and ``rings`` (R,) where each begins in ``lags``;
    ``plane`` (n, 3) orthonormal columns of a plane; ``moments`` (K, K) mean product of the residuals at each lag by the
    covariance at each; ``gap_moments`` (K, K) what gaps add to that, see :meth:`moments_with_gaps`.
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
        """Sums (..., R) of values (..., K) over the lags of one length."""
        return np.asarray(np.add.reduceat(values, self.rings, axis=-1))

    def at_lags(self, rho: Autocorrelation) -> Floats:
        """The significant part of rho (K,) at each lag; that of independent pixels if it is unknown."""
        values = rho.significant().values[tuple((self.lags + rho.reach).T)]
        values[0] = 1.0
        return np.asarray(values)

    def correlation(self, rho: Autocorrelation) -> Floats:
        """Correlation matrix (n, n) of the disc's pixels."""
        return np.asarray(np.append(self.at_lags(rho), 0.0)[self.lag])

    def moments_with_gaps(self, inverse_share: float) -> Floats:
        """``moments`` of discs of which a share f = 1 / ``inverse_share`` is there, at random.

        The hat matrix of what is left is about H / f. A pixel that is known to be there, being one of the pair, counts
        in full where the others count by f. To first order in H that adds (1 / f - 1) times ``gap_moments``.
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
    """M C M: covariance (n, n) of the residuals of a plane fit, of a field with covariance C."""
    half = plane @ (plane.T @ covariance)
    return np.asarray(covariance - half - half.T + plane @ (plane.T @ covariance @ plane) @ plane.T)


@dataclass(frozen=True)
class DiscResiduals:
    """Residuals of planes fitted to discs of pixels, and their products.

    ``radius_px`` of the discs; ``present`` (p, n) which pixels there are; ``products`` (p, K) sum over the pairs of
    residuals at each lag, and ``pairs`` (p, K) how many; a lag and its opposite are one.
    """

    radius_px: float
    present: NDArray[np.bool_]
    products: Floats
    pairs: Floats


def disc_residuals(residuals: NDArray[np.floating], radius_px: float) -> DiscResiduals:
    """Products of all pairs of residuals in each disc.

    ``residuals`` (p, n) of p discs, their pixels in the order of :func:`characterisation.coupon.discs.disc_offsets`,
    NaN where missing.
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
    """Autocorrelation of a field of which planes were taken away disc by disc, pooled over the discs.

    Discs of which more than half is missing are left out; gaps are taken to fall at random. NaN throughout if no disc
    is left or there is no noise.
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
    """Effective degrees of freedom of the spread about a plane, of discs with gaps.

    Returns
    -------
    degrees
        (p,) nu; n - 3 if ``rho`` is unknown.
    kept
        (p,) tr(M C) / (n - 3): the share of sigma^2 that the usual estimate with n - 3 degrees of freedom gives. Both
        NaN where a disc has fewer than 4 pixels or all on a line.
    """
    disc = _disc(float(field.radius_px))
    at_lags, correlation = disc.at_lags(rho), disc.correlation(rho)
    gaps = ~field.present.all(1)
    if not at_lags[1:].any() and field.present.sum(1).min(initial=len(disc.plane)) > len(disc.plane) / 2:
        degrees = field.present.sum(1) - 3.0  # what the sums below come to, for no correlation
        return degrees, np.ones(len(degrees))
    # whole discs are all alike: one is worked out for all
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
        # never under 1 for a true correlation matrix, which a rho that was found need not be
        degrees = np.where(good, np.maximum(trace**2 / square, 1.0), np.nan)
        kept = np.where(good, trace / (count - 3), np.nan)
    return degrees[which], kept[which]


def disc_lengths(field: DiscResiduals, variance: Floats, rho: Autocorrelation) -> Floats:
    """Correlation length [px] (p,) of each disc by itself.

    One disc has few pairs, so these scatter a good deal more than the pooled length. What the plane took is put back
    from the pooled ``rho``. ``variance`` (p,) [mm^2] of the field in each disc, as of :func:`plane_degrees`.
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
    """Sums (count,) of ``values`` by their label, labels beyond left out."""
    return np.asarray(np.bincount(label.ravel(), values.ravel(), count + 1)[:count], float)


@lru_cache(maxsize=8)
def _squared_lags(reach: int) -> NDArray[np.int64]:
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(row**2 + column**2)


def _efolding(distance: Floats, rho: Floats) -> Floats:
    """Where rho (p, m) over ``distance`` (m,), 1 at the first, falls under 1/e; NaN where it does not."""
    level = np.exp(-1.0)
    under = rho < level
    after = np.maximum(under.argmax(1), 1)
    row = np.arange(len(rho))
    high, low = rho[row, after - 1], rho[row, after]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = distance[after - 1] + (high - level) / (high - low) * (distance[after] - distance[after - 1])
    return np.where(under.any(1), crossing, np.nan)
