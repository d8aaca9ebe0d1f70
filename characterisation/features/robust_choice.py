"""What points are to a robust fit that lie off by a known displacement, and are not alike noisy, over all draws.

Signal chain: displacement, noise and weight of every point -> scale of the residuals' distribution -> Cauchy's loss ->
what lies within :data:`~characterisation.features.robust_fit.CLIP` robust standard deviations, until the same remains
-> by how much each point pulls the fit, and how firmly it holds it.

It goes the way of :func:`characterisation.features.robust_fit.robust_fit`, with expected residuals in place of drawn
ones and the surface linearised. Where two surfaces explain the points alike, draws go either way and this goes one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from characterisation.features.fits import GATE, LEAST_GATE_MM, QUARTER_TO_STD
from characterisation.features.robust_fit import CHOICES, CLIP, MEDIAN_TO_STD
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE

Floats = NDArray[np.float64]

#: steps of reweighted least squares from one scale to the next
CAUCHY_STEPS = 6

#: chances of all points that differ by less are the same choice, and a smaller one is none
SAME = 1e-3

#: standard deviations within which so many normal residuals lie that the border has nothing to do with them
SURELY = 3.5

#: least E psi': a point that lies beyond the border would push the fit away, if by nothing much, and is let be
LEAST_RESPONSE = 0.01

#: points of which the scale of the residuals is read
ENOUGH = 500

#: parameters that move no point by more than this share of what others do are left where they are
OPEN = 1e-9


@dataclass(frozen=True)
class Kept:
    """What n points are to a robust fit, in the mean over all draws.

    ``share`` (n,) of the draws in which it rests on a point. It moves as least squares would with the weights
    ``response`` (n,), of points that are ``displaced`` (n,) [mm] and have the standard deviation ``sigma`` (n,) [mm].
    """

    share: Floats
    response: Floats
    displaced: Floats
    sigma: Floats


def kept(g: Floats, displaced: Floats, sigma: Floats, weight: Floats) -> Kept:
    """What the points are to the fit; all as they are where none is much noisier than most, nor lies off.

    Of a point that lies about the border only the near draws are kept, so it pulls less than its mean displacement;
    and if it moves, other draws come and go at the border, so it holds the fit less than others do. At the fixed point,
    where sum g psi(r) = 0 with psi(r) = r within the border L and 0 beyond, the fit has the covariance

        (sum g g^T E psi')^-1  (sum g g^T Var psi)  (sum g g^T E psi')^-1,    E psi' = P(|r| < L) - L (p(L) + p(-L))

    p being the density of the residual r: Huber, Robust Statistics, section 6.3.

    Parameters
    ----------
    g
        (n, p) derivatives of the residuals along the rays by the parameters.
    displaced, sigma
        (n,) [mm] how far points lie off in the mean, and their standard deviations.
    weight
        (n,) how many points each stands for.
    """
    if (np.abs(displaced - np.median(displaced)) + SURELY * sigma <= CLIP * np.median(sigma)).all():
        return Kept(np.ones(len(displaced)), np.ones(len(displaced)), displaced, sigma)

    def fitted(share: Floats, places: Floats) -> Floats:
        used = g * (weight * share)[:, None]
        return np.asarray(g @ np.linalg.lstsq(used.T @ g, used.T @ places, rcond=OPEN)[0])

    surface = np.zeros(len(displaced))
    for _ in range(2):
        scale = _robust_std(displaced - surface, sigma, weight)
        for _ in range(CAUCHY_STEPS):
            surface = fitted(1 / (1 + ((displaced - surface) ** 2 + sigma**2) / scale**2), displaced)
    share = np.zeros(len(displaced))
    for _ in range(CHOICES):
        residual, before = displaced - surface, share
        limit = CLIP * _robust_std(residual, sigma, weight)
        share, mean, spread = _truncated(residual, sigma, limit)
        surface = fitted(share, surface + mean)
        if np.abs(share - before).max() < SAME:
            break
    at_border = _density((limit - residual) / sigma) + _density((limit + residual) / sigma)
    response = np.maximum(share - limit * at_border / sigma, LEAST_RESPONSE)
    variance = share * spread**2 + share * (1 - share) * mean**2
    return Kept(share, response, surface, np.sqrt(variance / response))


def _truncated(middle: Floats, sigma: Floats, limit: float | Floats) -> tuple[Floats, Floats, Floats]:
    """Share (n,) of normal residuals within a limit of 0, and mean and standard deviation of those.

    Of a truncated normal distribution: Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions 1, 13.10.1.
    """
    low, high = (-limit - middle) / sigma, (limit - middle) / sigma
    share, density = _inside(middle, sigma, limit), (_density(low), _density(high))
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = (density[0] - density[1]) / share
        shrunk = 1 + (low * density[0] - high * density[1]) / share - shift**2
    known = share > SAME
    mean = np.where(known, middle + sigma * shift, np.clip(middle, -limit, limit))
    return share, mean, sigma * np.sqrt(np.maximum(np.where(known, shrunk, 0.0), SAME))  # a width of 0 has no density


def _density(deviate: Floats) -> Floats:
    return np.asarray(np.exp(-(deviate**2) / 2) / math.sqrt(2 * math.pi))


def near(displaced: Floats, sigma: Floats, distance: Floats) -> tuple[Floats, Floats, Floats]:
    """Chance (n,) of each point to be no false match, and where it lies then: in the mean, and standard deviation [mm].

    A false match lies off by more than 1 % of its ``distance`` [mm] along its ray, normal about ``displaced`` with
    ``sigma`` [mm]. As :func:`characterisation.features.fits.belonging` tells them.
    """
    return _truncated(displaced, sigma, FALSE_SHARE_OF_DISTANCE * distance)


def belonging_share(displaced: Floats, sigma: Floats, weight: Floats) -> Floats:
    """Chance (n,) of each point to lie near enough to the nominal surface to belong to it.

    As :func:`characterisation.features.fits.belonging` chooses, of orthogonal distances: normal about ``displaced``
    with ``sigma`` [mm]; ``weight`` (n,) is how many points each stands for.
    """
    if (np.abs(displaced) <= sigma).all():
        return np.ones(len(displaced))
    quarter = _size_of(0.25, displaced, sigma, weight)
    return _inside(displaced, sigma, max(GATE * quarter / QUARTER_TO_STD, LEAST_GATE_MM))


def _robust_std(residual: Floats, sigma: Floats, weight: Floats) -> float:
    """As :func:`characterisation.features.robust_fit.robust_std`, of normal residuals about ``residual``."""
    return MEDIAN_TO_STD * _size_of(0.5, residual, sigma, weight)


def _size_of(share: float, residual: Floats, sigma: Floats, weight: Floats) -> float:
    """Quantile of the size of residuals."""
    some = slice(None, None, 1 + len(residual) // ENOUGH)
    residual, sigma, part = residual[some], sigma[some], weight[some] / weight[some].sum()

    def over(size: float) -> float:
        return float(part @ _inside(residual, sigma, size)) - share

    most = float(np.abs(residual).max() + 10 * sigma.max())
    return float(brentq(over, 0.0, most, rtol=1e-3))


def _inside(middle: Floats, sigma: Floats, limit: float | Floats) -> Floats:
    """Chance (n,) that a normal residual lies within a limit of 0."""
    return np.asarray(ndtr((limit - middle) / sigma) - ndtr((-limit - middle) / sigma))
