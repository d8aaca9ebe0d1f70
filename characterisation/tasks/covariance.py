"""Predict the covariance of a feature's fit in one view, before anything is captured.

Signal chain: expected points of a feature (place, ray, F, sigma, noise area A, persistent p) -> those that a fit would
use -> derivatives g_i of the residuals along the rays by the feature's parameters -> covariance of the least-squares
fit -> propagated to the measurement (:mod:`characterisation.tasks.prediction`). In parallel: expected number of points
and its scatter -> probability that there are enough.

A fit weights its points equally. With N = sum F_i g_i g_i^T, its error is -N^-1 sum g_i eps_i over the recovered
points. Its covariance (GUM 5.1.2; the sandwich form of unweighted least squares) is

    C = N^-1 [ sum_ij F_i s_i g_i rho_ij F_j s_j g_j^T + sum_ij F_i p_i g_i k_ij F_j p_j g_j^T ] N^-1

The first sum is noise that averages out. It has s^2 a = sigma^2 A with the noise area A
(:mod:`characterisation.coupon.offsets`), and rho = exp(-pi d^2 / a) over a distance of d pixels. The area a of the
field itself follows from A. For independent pixels A = 1 / F, and the sum reduces to the usual sigma^2 N^-1.

The second sum is persistent noise, of which only the size is known. Its correlation is *assumed*: high where pixels are
near and the surface has nearly the same orientation, none between two features,

    k_ij = exp(-d_ij^2 / (2 l^2)) exp(-|N_i - N_j|^2 / (2 t^2)),      l = 60 px, t = 10 deg

All points of a view, of all its features, share some errors. One is a known mean displacement b_i, from the map's bias
or from indirect light. A bias that is not corrected counts in full (GUM F.2.4.5). The others are the displacements of
each point by one standard deviation of the calibration. Each changes a fit by -N^-1 sum F_i b_i g_i. They are kept as
vectors, so that they add up or cancel in a measurement of several features.

The prediction does not include the effects of edges and of blocks across them, which a map of flat coupons does not
contain. Nor does it include the rejection of distant points by a robust fit.

The number of points has the mean n = sum F and the variance sum A_n F (1 - F) + [sum u(F)]^2. Losses come in patches,
with A_n assumed equal to A + 1 - 1 / F, at least 1: 1 for independent pixels. An error of the map is common to all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import chdtr, ndtr

from characterisation.coupon.offsets import own_area
from characterisation.features.credibility import PLACES, most_uncertain
from characterisation.features.fits import COVERAGE, GATE, LEAST_BELONGING, LEAST_GATE_MM
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import GRAZING_COSINE, Cylinder, Sphere, Surface
from characterisation.files.arrays import Floats
from characterisation.maps.pooled_offsets import DISC_RADIUS
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE

#: l [px] of the correlation of persistent noise; *assumed*
PERSISTENT_REACH_PX = 60.0

#: t [rad] of the correlation of persistent noise; *assumed*
PERSISTENT_TURN = math.radians(10.0)

#: side of a cell, whose pixels share their persistent noise: a small part of the correlation length
CELL_PX = 12

#: the side is doubled for large faces with more cells
MOST_CELLS = 500

#: with a shorter correlation length [pixels of the grid], pixels count as independent
SHORTEST_REACH = 0.45

#: a measurement is called possible with at least this probability
LEAST_CHANCE = 0.5

#: directions of the errors of a fit that are averaged; chosen: chances are known to 0.02
DIRECTIONS = 200

#: points with a smaller F are excluded
LEAST_SHARE = 1e-6

#: least eigenvalue of a scaled normal matrix, with columns of unit length, for a fit to be determined
SINGULAR = 1e-9


@dataclass(frozen=True)
class ExpectedPoints:
    """Predicted points of one feature: an element for each pixel that shows it, n in all."""

    #: ``point`` (n, 3) [mm] and ``ray`` (n, 3), unit, in the frame of the feature's surface
    point: Floats
    ray: Floats
    pixel: NDArray[np.int64]  # (n, 2) row and column
    normal: Floats  # (n, 3) in the view frame
    #: ``fraction`` F, ``fraction_error`` u(F), never NaN
    fraction: Floats
    fraction_error: Floats
    #: ``sigma`` [mm], ``area`` A [px^2], ``persistent`` p [mm], ``displaced`` b [mm]; ``distance`` |V| [mm]
    sigma: Floats
    area: Floats
    persistent: Floats
    displaced: Floats
    distance: Floats
    thinning: float = 1.0  # number of sensor pixels that each element stands for
    angular_pitch: float = math.nan  # [rad] between neighbouring sensor pixels
    #: (n, k) [mm]: displacement of the points by one standard deviation of each of k independent errors, which all
    #: features share
    shared: Floats | None = None
    #: (m, 3) [mm]: all places of the surface that every eye sees, also next to its edges, where pixels belong to no
    #: feature; by default ``point``
    shown: Floats | None = None


@dataclass(frozen=True)
class ExpectedFit:
    """Predicted fit about the nominal geometry."""

    noise_covariance: Floats  # (p, p) covariance of the parameters due to noise
    #: (p, 1 + k) changes of the parameters by the known displacement, and by each error that features share
    shared: Floats
    count: float  # of expected points
    chance: float  # probability that there are enough points, and that the fit is credible
    middle: Floats  # (3,) [mm] of the expected points
    #: [mm]: without persistent noise, the mean of all n points would have the standard uncertainty noise / sqrt(n)
    noise: float

    @property
    def covariance(self) -> Floats:
        """Return the covariance (p, p) of all errors, including the known displacement."""
        return np.asarray(self.noise_covariance + self.shared @ self.shared.T)


@dataclass(frozen=True)
class Sums:
    """Contribution of one feature's points to a fit.

    ``normal`` is N and ``spread`` is the bracket of C for noise, (p, p) each; ``shared`` (p, 1 + k) are the sums over
    displacements. The other fields are those of :class:`ExpectedFit`. Features with independent errors add up
    (:func:`solved`).
    """

    normal: Floats
    spread: Floats
    shared: Floats
    count: float
    chance: float
    middle: Floats
    noise: float


def expected_fit(surface: Surface, expected: ExpectedPoints, minimum_points: float) -> ExpectedFit:
    """Predict the fit of a surface to its own points.

    Raises FitError if the points would not determine the surface even if all were recovered, or nearly all are false.
    """
    used = usable(surface, expected)
    jacobian = surface.linearised(np.zeros(surface.parameter_count), used.point, used.ray)[1]
    fit = solved([expected_sums(jacobian, used, minimum_points)], surface.kind)
    return replace(fit, chance=fit.chance * _credible_chance(surface, expected, used, fit))


def _credible_chance(surface: Surface, expected: ExpectedPoints, used: ExpectedPoints, fit: ExpectedFit) -> float:
    """Return the probability that a fit is credible (:mod:`characterisation.features.credibility`).

    It is 0 if the points do not determine the surface wherever it is seen. Else it is the probability that the largest
    normal error there exceeds the median error at the points, which moves the limit, by less than the limit. Both are
    proportional to the length r of the vector of standardised errors; the mean is over its directions.
    """
    at = surface.meet(expected.point, expected.ray)
    points = at.foot[np.abs(at.cosine) > GRAZING_COSINE]
    zero = np.zeros(surface.parameter_count)
    jacobian, of_used = surface.linearised(zero, points, None)[1], surface.linearised(zero, used.point, None)[1]
    weight = used.fraction
    noise = float(np.sqrt(np.average(used.sigma**2 + used.persistent**2, weights=weight)))
    limit = max(GATE * noise, LEAST_GATE_MM)
    displaced = float(np.average(np.abs(used.displaced), weights=weight))
    spread = math.sqrt(max(float(np.einsum("ij,jk,ik->i", jacobian, fit.noise_covariance, jacobian).max()), 0.0))
    if spread > most_uncertain(surface, limit + displaced):
        return 0.0
    values, vectors = np.linalg.eigh(fit.covariance)
    drawn = np.random.default_rng(0).standard_normal((len(values), DIRECTIONS))
    unit_errors = vectors @ (np.sqrt(np.clip(values, 0, None))[:, None] * drawn / np.linalg.norm(drawn, axis=0))
    largest, median = (
        reduce(np.abs(rows[:: -(-len(rows) // PLACES)] @ unit_errors), axis=0)
        for rows, reduce in ((jacobian, np.max), (of_used, np.median))
    )
    allowed = (limit + COVERAGE * spread) / np.maximum(largest - median, 1e-12)
    return min(float(chdtr(len(values), allowed**2).mean()), _chance_of_radius(surface, fit))


def _chance_of_radius(surface: Surface, fit: ExpectedFit) -> float:
    """Return the probability that the points determine the radius.

    The rule is :func:`~characterisation.features.fits.check_radius`. The curvature of an arc of sagitta h over a chord
    c is 8 h / c^2: its error is normal, and its uncertainty by noise u / r^2 for any radius r. It passes if it is at
    least 2 k u / r^2.
    """
    if not isinstance(surface, Cylinder | Sphere):
        return 1.0
    radius, all_errors = surface.radius, math.sqrt(max(float(fit.covariance[-1, -1]), 0.0))
    noise = math.sqrt(max(float(fit.noise_covariance[-1, -1]), 0.0))
    if min(noise, all_errors) < 1e-9 * radius:
        return 1.0
    return float(ndtr((radius - 2 * COVERAGE * noise) / all_errors))


def usable(surface: Surface, expected: ExpectedPoints) -> ExpectedPoints:
    """Return the points that a fit would use if they were recovered: neither at grazing incidence nor false.

    A point is false if it is displaced by more than :data:`~characterisation.point_cloud.FALSE_SHARE_OF_DISTANCE` of
    its distance. It is then not assigned to its feature. Raises FitError if there are none, or nearly all are false.
    """
    if len(expected.point):
        cosine = surface.meet(expected.point, expected.ray).cosine
        used = (np.abs(cosine) > GRAZING_COSINE) & np.isfinite(expected.sigma) & (expected.fraction > LEAST_SHARE)
        near = np.abs(expected.displaced) <= FALSE_SHARE_OF_DISTANCE * expected.distance
        if expected.fraction[near].sum() < LEAST_BELONGING * expected.fraction.sum():
            raise FitError(f"less than {100 * LEAST_BELONGING:.0f} % of the points lie near the nominal surface")
        used &= near
        if used.any():
            rows: dict[str, Any] = {
                n: value[used] for n, value in vars(expected).items() if isinstance(value, np.ndarray) and n != "shown"
            }
            return replace(expected, **rows)
    raise FitError("no points are expected")


def expected_sums(g: Floats, expected: ExpectedPoints, minimum_points: float) -> Sums:
    """Return the sums over the points of one feature, for derivatives ``g`` (n, p) of their residuals."""
    weight = expected.fraction * expected.thinning
    variance = expected.fraction * expected.sigma**2 * expected.area
    # the contribution of random losses to the noise area is not correlation
    area = float(np.average(expected.area + 1 - 1 / expected.fraction, weights=weight))
    spread = _averaging(g, weight, variance, area, expected.pixel, expected.thinning)
    spread += _persistent(g * (weight * expected.persistent)[:, None], expected.pixel, expected.normal)
    fields = expected.displaced[:, None]
    if expected.shared is not None:
        fields = np.concatenate([fields, expected.shared], axis=1)
    count = float(weight.sum())
    return Sums(
        (g * weight[:, None]).T @ g,
        spread,
        g.T @ (weight[:, None] * fields),
        count,
        _chance(expected, minimum_points),
        weight @ expected.point / count,
        math.sqrt(float((weight * variance).sum() / count)),
    )


def solved(parts: Sequence[Sums], kind: str) -> ExpectedFit:
    """Solve the least-squares fit to the points of all features together.

    Raises FitError if they leave a parameter undetermined.
    """
    normal = np.sum([p.normal for p in parts], axis=0)
    spread, shared = (np.sum([getattr(p, name) for p in parts], axis=0) for name in ("spread", "shared"))
    scale = np.sqrt(np.diag(normal))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = normal / np.outer(scale, scale)
    if not (scale > SINGULAR * scale.max()).all() or np.linalg.eigvalsh(scaled)[0] < SINGULAR:
        raise FitError(f"points that do not determine a {kind}")
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    count = sum(p.count for p in parts)
    middle = np.sum([p.count * p.middle for p in parts], axis=0) / count
    noise = math.sqrt(sum(p.count * p.noise**2 for p in parts) / count)
    return ExpectedFit(
        inverse @ spread @ inverse, -inverse @ shared, count, math.prod(p.chance for p in parts), middle, noise
    )


def _averaging(
    g: Floats, weight: Floats, variance: Floats, area: float, pixel: NDArray[np.int64], thinning: float
) -> Floats:
    """Return the first sum, for ``variance`` (n,) equal to F sigma^2 A, and the mean noise ``area`` of all points."""
    alone = (g * (weight * variance)[:, None]).T @ g
    reach = math.sqrt(float(own_area(np.array(area), DISC_RADIUS)) / (2 * math.pi * thinning))
    if reach < SHORTEST_REACH:
        return np.asarray(alone)
    step = math.sqrt(thinning)
    cell = np.rint((pixel - pixel.min(axis=0)) / step).astype(int)
    shape = cell.max(axis=0) + 1
    # with weights w = F thinning: w^2 s^2 rho summed over the neighbours is w F sigma^2 A on a uniform surface
    scaled = g * np.sqrt(weight * variance)[:, None]
    total = np.empty_like(alone)
    images = np.zeros((g.shape[1], *shape))
    images[:, cell[:, 0], cell[:, 1]] = scaled.T
    for row, image in enumerate(images):
        about = gaussian_filter(image, reach, mode="constant", truncate=4.0)
        total[row] = about[cell[:, 0], cell[:, 1]] @ scaled
    return (total + total.T) / 2


def _persistent(scaled: Floats, pixel: NDArray[np.int64], normal: Floats) -> Floats:
    """Return the second sum, over cells; ``scaled`` (n, p) is F p g times the sensor pixels of each element."""
    cells, number = _cells(pixel, CELL_PX)
    if len(cells) > MOST_CELLS:
        cells, number = _cells(pixel, 2 * CELL_PX)
    share = np.bincount(number).astype(float)

    def summed(columns: Floats) -> Floats:
        return np.stack([np.bincount(number, column, len(cells)) for column in columns.T], axis=1)

    # mean place and orientation of each cell, in units of their correlation lengths
    middle = summed(np.column_stack([pixel / PERSISTENT_REACH_PX, normal / PERSISTENT_TURN])) / share[:, None]
    half = (middle**2).sum(1) / 2
    product = middle @ middle.T
    product -= half[:, None]
    product -= half
    total = summed(scaled)
    return np.asarray(total.T @ np.exp(np.minimum(product, 0.0, out=product), out=product) @ total)


def _cells(pixel: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the occupied cells (c,) of ``size`` pixels, and the number (n,) of the cell of each element."""
    row, column = (pixel // size).T
    return np.unique(row * (column.max() + 1) + column, return_inverse=True)


def _chance(expected: ExpectedPoints, minimum: float) -> float:
    """Return the probability that at least ``minimum`` points are recovered, with a normal number of points."""
    fraction, thinning = expected.fraction, expected.thinning
    count = float(fraction.sum() * thinning)
    clumps = np.maximum(expected.area + 1 - 1 / fraction, 1.0)  # random losses alone make the noise area 1 / F
    losses = float((fraction * (1 - fraction) * clumps).sum() * thinning)
    spread = math.sqrt(losses + float(expected.fraction_error.sum() * thinning) ** 2)
    if spread == 0:
        return float(count >= minimum)
    return float(ndtr((count - minimum) / spread))
