"""Estimate the standard uncertainty of a range: the flatness measurement error and the form error PF.

Signal chain: points of a plane or sphere -> deviations from the least-squares surface -> the form that was read, a
polynomial over the points -> the noise about that form, drawn again -> range of form and noise, a few per mille of the
worst rejected -> standard deviation of the ranges.

A range is never negative, and noise alone widens it. So its scatter depends on the form: the noise of a flat plate
decides at both ends, that of a bent one where the plate is highest and lowest. The uncertainty is conditional on the
form that was read. It is that of a repeat of the capture, with noise that is independent from point to point. The
rejection makes the range one of quantiles, for which drawing with replacement is consistent (Efron and Tibshirani
1993, 7.4).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike

from characterisation.acceptance.vdi_2634 import REJECTED_SHARE, plane_distances
from characterisation.features.form import DEGREE
from characterisation.files.arrays import Floats

#: number of ranges that are drawn; the standard deviation of 100 is known to 7 %
DRAWS = 100

#: fewest rejected points for which the range is one of quantiles
LEAST_REJECTED = 3

#: seed of the draws
_SEED = 26342


def flatness_uncertainty(points: ArrayLike) -> float:
    """Return the standard uncertainty [mm] of the flatness error of points (n, 3), conditional on the form read.

    It is NaN if fewer than :data:`LEAST_REJECTED` points are rejected.
    """
    finite = _finite(points)
    if _rejected(finite) < LEAST_REJECTED:
        return math.nan
    centred = finite - finite.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return _range_uncertainty(centred @ axes[:2].T, plane_distances(finite))


def form_error_uncertainty(points: ArrayLike, centre: ArrayLike) -> float:
    """Return the standard uncertainty [mm] of the form error PF of points (n, 3) of a sphere about its centre (3,).

    It is conditional on the form that was read, and NaN if fewer than :data:`LEAST_REJECTED` points are rejected.
    """
    away = _finite(points) - np.asarray(centre, float)
    if _rejected(away) < LEAST_REJECTED:
        return math.nan
    radii = np.linalg.norm(away, axis=1)
    directions = away / radii[:, None]
    axes = np.linalg.svd(directions - directions.mean(axis=0), full_matrices=False)[2]
    return _range_uncertainty(directions @ axes[:2].T, radii - radii.mean())


def _finite(points: ArrayLike) -> Floats:
    array = np.asarray(points, float)
    return np.asarray(array[np.isfinite(array).all(axis=1)])


def _rejected(points: Floats) -> int:
    return int(REJECTED_SHARE * len(points))


def _range_uncertainty(positions: Floats, deviations: Floats) -> float:
    """Return the standard deviation of the range of deviations (n,) at positions (n, 2) whose noise is drawn again."""
    stay = len(deviations) - _rejected(deviations)
    low, high = positions.min(axis=0), positions.max(axis=0)
    u, v = (2 * (positions - low) / np.maximum(high - low, 1e-12) - 1).T
    pairs = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    along, across = legvander(u, DEGREE), legvander(v, DEGREE)
    modes = np.column_stack([along[:, i] * across[:, j] for i, j in pairs])
    form = modes @ np.linalg.lstsq(modes, deviations, rcond=None)[0]
    noise, rng = deviations - form, np.random.default_rng(_SEED)
    drawn = (form + rng.choice(noise, len(noise)) for _ in range(DRAWS))
    ranges = [np.ptp(one[np.argpartition(np.abs(one), stay - 1)[:stay]]) for one in drawn]
    return float(np.std(ranges, ddof=1))
