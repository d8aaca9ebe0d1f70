"""Which points a robust fit keeps when some of them lie off by a known displacement, in the mean over all draws.

Signal chain: displacement, noise and weight of every point -> scale of the residuals' distribution -> Cauchy's loss ->
what lies within :data:`~characterisation.features.robust_fit.CLIP` robust standard deviations, until the same remains.

It goes the way of :func:`characterisation.features.robust_fit.robust_fit`, with expected residuals in place of drawn
ones and the surface linearised. Where two surfaces explain the points alike, draws go either way and this goes one.
"""

from __future__ import annotations

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

#: chances of all points that differ by less are the same choice
SAME = 1e-3

#: parameters that move no point by more than this share of what others do are left where they are
OPEN = 1e-9


def kept_share(g: Floats, displaced: Floats, sigma: Floats, weight: Floats) -> Floats:
    """Chance (n,) of each point to be one that the fit rests on; 1 for all where none lies off by more than its sigma.

    Parameters
    ----------
    g
        (n, p) derivatives of the residuals along the rays by the parameters.
    displaced, sigma
        (n,) [mm] how far points lie off in the mean, and their standard deviations.
    weight
        (n,) how many points each stands for.
    """
    if (np.abs(displaced - np.median(displaced)) <= sigma).all():
        return np.ones(len(displaced))

    def left(share: Floats) -> Floats:
        used = g * (weight * share)[:, None]
        return np.asarray(displaced - g @ np.linalg.lstsq(used.T @ g, used.T @ displaced, rcond=OPEN)[0])

    residual = displaced
    for _ in range(2):
        scale = _robust_std(residual, sigma, weight)
        for _ in range(CAUCHY_STEPS):
            residual = left(1 / (1 + (residual**2 + sigma**2) / scale**2))
    share = np.zeros(len(displaced))
    for _ in range(CHOICES):
        before, share = share, _inside(residual, sigma, CLIP * _robust_std(residual, sigma, weight))
        if np.abs(share - before).max() < SAME:
            break
        residual = left(share)
    return share


def near_share(displaced: Floats, sigma: Floats, distance: Floats) -> Floats:
    """Chance (n,) of each point to be no false match, which lies off by more than 1 % of its ``distance`` [mm].

    Along its ray: normal about ``displaced`` with ``sigma`` [mm]. As :func:`characterisation.features.fits.belonging`
    tells them.
    """
    return _inside(displaced, sigma, FALSE_SHARE_OF_DISTANCE * distance)


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

    def over(size: float) -> float:
        return float(np.average(_inside(residual, sigma, size), weights=weight)) - share

    most = float(np.abs(residual).max() + 10 * sigma.max())
    return float(brentq(over, 0.0, most, rtol=1e-3))


def _inside(middle: Floats, sigma: Floats, limit: float | Floats) -> Floats:
    """Chance (n,) that a normal residual lies within a limit of 0."""
    return np.asarray(ndtr((limit - middle) / sigma) - ndtr((-limit - middle) / sigma))
