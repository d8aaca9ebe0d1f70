r"""The standard uncertainty of a measurement that a view is predicted to give, before anything is captured.

Signal chain: expected points of a feature (place, ray, F, sigma, noise area A, persistent p) -> those that a fit would
use -> derivatives g_i of the residuals along the rays by the feature's parameters -> covariance of the least-squares
fit -> propagated to the measurement (:mod:`characterisation.tasks.prediction`); points expected and their
scatter -> the chance that there are enough.

A fit weighs its points alike: with N = sum F_i g_i g_i^T its error is -N^-1 sum g_i eps_i over the points that came
back, and its covariance (GUM 5.1.2; the sandwich form of unweighted least squares)

    C = N^-1 [ sum_ij F_i s_i g_i rho_ij F_j s_j g_j^T + sum_ij F_i p_i g_i k_ij F_j p_j g_j^T ] N^-1

The first sum is noise that averages out, s^2 a = sigma^2 A with A the noise area
(:mod:`characterisation.coupon.offsets`), and rho = exp(-pi d^2 / a) over a distance of d pixels; a, the field's own
area, follows from A. For independent pixels A = 1 / F, and the usual sigma^2 N^-1 comes back. The second is what lasts,
of which only the size is known: it is taken as alike where pixels are near and the surface is turned alike,

    k_ij = exp(-d_ij^2 / (2 l^2)) exp(-|N_i - N_j|^2 / (2 t^2)),      l = 60 px, t = 10 deg

*assumed*, and as unlike in two features.

Some errors are shared by all points of a view, of all its features. One is a known displacement b_i in the mean, by
the map's bias or by light from elsewhere: a bias that is not corrected counts in full (GUM F.2.4.5). Others are what
one standard deviation of the calibration displaces each point by. Each changes a fit by -N^-1 sum F_i b_i g_i; kept as
vectors, they add up or cancel in a measurement of several features.

Left out: whatever a map of flat coupons does not know, that is edges and blocks that straddle them; and that a robust
fit throws away some of the points that lie far off.

Whether there are enough points: their number has the mean n = sum F and the variance A_n sum F (1 - F) + [sum u(F)]^2,
for losses come in patches (A_n is taken to be the mean noise area) and an error of the map is common to all points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from characterisation.coupon.offsets import own_area
from characterisation.features.fits import LEAST_BELONGING
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import GRAZING_COSINE, Plane, Sphere, Surface
from characterisation.maps.pooled_offsets import DISC_RADIUS
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE

Floats = NDArray[np.float64]

#: l [px] and t [rad] of the persistent noise's correlation; *assumed*
PERSISTENT_REACH_PX, PERSISTENT_TURN = 60.0, math.radians(10.0)

#: pixels of one cell share their persistent noise: a small part of its reach, and twice that for large faces, of whose
#: cells there would be more than this
CELL_PX, MOST_CELLS = 12, 500

#: a correlation that reaches less far than this many pixels of the grid is that of independent ones
SHORTEST_REACH = 0.45

#: a robust fit finds its surface from geometry that is off by this share of the radius (see
#: :mod:`characterisation.features.fits`); points that move it by more lead it away, and it is refused
HELD = 0.5

#: a measurement is called possible if it is with at least this chance
LEAST_CHANCE = 0.5

#: points of which a smaller share comes back are left out
LEAST_SHARE = 1e-6

#: a fit whose normal matrix, its columns scaled to unit length, is flatter than this determines nothing
SINGULAR = 1e-9


@dataclass(frozen=True)
class ExpectedPoints:
    """Predicted points of one feature: an element for each pixel that shows it, n in all.

    ``point`` (n, 3) [mm] and ``ray`` (n, 3), unit, in the frame of the feature's surface; ``pixel`` (n, 2) row and
    column; ``normal`` (n, 3) in the view frame; ``fraction`` F, ``fraction_error`` u(F); ``sigma`` [mm], ``area`` A
    [px^2], ``persistent`` p [mm], ``displaced`` b [mm]; ``distance`` |V| [mm].
    ``thinning`` is how many pixels of the sensor each stands for, ``angular_pitch`` [rad] between neighbours of these.
    ``shared`` (n, k) [mm] is what one standard deviation of each of k independent errors, which all features share,
    displaces points by.
    """

    point: Floats
    ray: Floats
    pixel: NDArray[np.int64]
    normal: Floats
    fraction: Floats
    fraction_error: Floats
    sigma: Floats
    area: Floats
    persistent: Floats
    displaced: Floats
    distance: Floats
    thinning: float = 1.0
    angular_pitch: float = math.nan
    shared: Floats | None = None

    @property
    def count(self) -> float:
        """Expected number of points."""
        return float(self.fraction.sum() * self.thinning)

    @property
    def mean_sigma(self) -> float:
        """Mean of sigma over the expected points [mm]; NaN where there are none."""
        return float(np.average(self.sigma, weights=self.fraction)) if len(self.sigma) else math.nan


@dataclass(frozen=True)
class ExpectedFit:
    """``own`` covariance (p, p) of the parameters of what is fitted, about its nominal place, by noise.

    ``shared`` (p, 1 + k) changes of them by the known displacement, and by each error that features share; ``count`` of
    expected points; ``chance`` that there are enough of them, and that they do not lead away from the nominal radius;
    ``middle`` (3,) [mm] of the points that are expected; ``noise`` [mm], so that the mean of all points would have the
    standard uncertainty noise / sqrt(n), were there no persistent noise.
    """

    own: Floats
    shared: Floats
    count: float
    chance: float
    middle: Floats
    noise: float

    @property
    def covariance(self) -> Floats:
        """Of all errors (p, p), the known displacement among them."""
        return np.asarray(self.own + self.shared @ self.shared.T)


@dataclass(frozen=True)
class Sums:
    """What one feature's points add to a fit: N ``normal`` and the bracket of C, (p, p) each, and the rest.

    The bracket is ``spread`` of what is noise; ``shared`` (p, 1 + k) are the sums over what is displaced.

    Features whose errors are independent add up (:func:`solved`).
    """

    normal: Floats
    spread: Floats
    shared: Floats
    count: float
    chance: float
    middle: Floats
    noise: float


def expected_fit(surface: Surface, seen: ExpectedPoints, minimum_points: float) -> ExpectedFit:
    """The predicted fit of a surface to its own points.

    Raises
    ------
    FitError
        If the points, were they all there, do not determine the surface, or lead away from it.
    """
    used = usable(surface, seen)
    jacobian = surface.linearised(np.zeros(surface.parameter_count), used.point, used.ray)[1]
    fit = solved([expected_sums(jacobian, used, minimum_points)], surface.kind)
    return replace(fit, chance=fit.chance * _held(surface, fit.covariance))


def _held(surface: Surface, covariance: Floats) -> float:
    """Chance that a fit does not lead away from its nominal radius, its change taken as normal with variance u^2."""
    if isinstance(surface, Plane):
        return 1.0
    number = 3 if isinstance(surface, Sphere) else 4  # of the parameters of a small change
    spread = math.sqrt(float(covariance[number, number]))
    return float(2 * ndtr(HELD * surface.radius / spread) - 1) if spread > 0 else 1.0


def usable(surface: Surface, seen: ExpectedPoints) -> ExpectedPoints:
    """The points that a fit would use, if they came back: not seen at grazing incidence, nor false.

    What is displaced by more than :data:`~characterisation.point_cloud.FALSE_SHARE_OF_DISTANCE` of its distance is
    false, and its feature does not get it.

    Raises
    ------
    FitError
        If there are none, or nearly all are false.
    """
    if len(seen.point):
        cosine = surface.meet(seen.point, seen.ray).cosine
        used = (np.abs(cosine) > GRAZING_COSINE) & np.isfinite(seen.sigma) & (seen.fraction > LEAST_SHARE)
        near = np.abs(seen.displaced) <= FALSE_SHARE_OF_DISTANCE * seen.distance
        if seen.fraction[near].sum() < LEAST_BELONGING * seen.fraction.sum():
            raise FitError(f"less than {100 * LEAST_BELONGING:.0f} % of the points lie near it")
        used &= near
        if used.any():
            rows: dict[str, Any] = {n: value[used] for n, value in vars(seen).items() if isinstance(value, np.ndarray)}
            return replace(seen, **rows)
    raise FitError("no points are expected")


def expected_sums(g: Floats, seen: ExpectedPoints, minimum_points: float) -> Sums:
    """The sums over the points of one feature, for derivatives ``g`` (n, p) of their residuals."""
    weight = seen.fraction * seen.thinning
    variance = seen.fraction * seen.sigma**2 * seen.area
    # what random losses add to the noise area is not correlation
    area = float(np.average(seen.area + 1 - 1 / seen.fraction, weights=weight))
    spread = _averaging(g, weight, variance, area, seen.pixel, seen.thinning)
    spread += _persistent(g * (weight * seen.persistent)[:, None], seen.pixel, seen.normal)
    fields = seen.displaced[:, None]
    if seen.shared is not None:
        fields = np.concatenate([fields, seen.shared], axis=1)
    count = float(weight.sum())
    return Sums(
        (g * weight[:, None]).T @ g,
        spread,
        g.T @ (weight[:, None] * fields),
        count,
        _chance(seen, minimum_points),
        weight @ seen.point / count,
        math.sqrt(float((weight * variance).sum() / count)),
    )


def solved(parts: Sequence[Sums], what: str) -> ExpectedFit:
    """The least-squares fit to the points of all features together.

    Raises
    ------
    FitError
        If they leave a parameter open.
    """
    normal = np.sum([p.normal for p in parts], axis=0)
    spread, shared = (np.sum([getattr(p, name) for p in parts], axis=0) for name in ("spread", "shared"))
    scale = np.sqrt(np.diag(normal))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = normal / np.outer(scale, scale)
    if not (scale > SINGULAR * scale.max()).all() or np.linalg.eigvalsh(scaled)[0] < SINGULAR:
        raise FitError(f"points that do not determine a {what}")
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
    """The first sum, ``variance`` (n,) being F sigma^2 A; all points have the reach of their mean noise ``area``."""
    alone = (g * (weight * variance)[:, None]).T @ g
    reach = math.sqrt(float(own_area(np.array(area), DISC_RADIUS)) / (2 * math.pi * thinning))
    if reach < SHORTEST_REACH:
        return np.asarray(alone)
    step = math.sqrt(thinning)
    place = np.rint((pixel - pixel.min(axis=0)) / step).astype(int)
    shape = place.max(axis=0) + 1
    # with weights w = F thinning: w^2 s^2 rho summed over a neighbour's pixels is w F sigma^2 A if all is even
    scaled = g * np.sqrt(weight * variance)[:, None]
    total = np.empty_like(alone)
    images = np.zeros((g.shape[1], *shape))
    images[:, place[:, 0], place[:, 1]] = scaled.T
    for row, image in enumerate(images):
        about = gaussian_filter(image, reach, mode="constant", truncate=4.0)
        total[row] = about[place[:, 0], place[:, 1]] @ scaled
    return (total + total.T) / 2


def _persistent(scaled: Floats, pixel: NDArray[np.int64], normal: Floats) -> Floats:
    """The second sum, over cells; ``scaled`` (n, p) is F p g times the pixels that each stands for."""
    cells, number = _cells(pixel, CELL_PX)
    if len(cells) > MOST_CELLS:
        cells, number = _cells(pixel, 2 * CELL_PX)
    share = np.bincount(number).astype(float)

    def summed(columns: Floats) -> Floats:
        return np.stack([np.bincount(number, column, len(cells)) for column in columns.T], axis=1)

    place = summed(pixel.astype(float)) / share[:, None]
    turned = summed(normal) / share[:, None]
    apart = _squares(place) / (2 * PERSISTENT_REACH_PX**2) + _squares(turned) / (2 * PERSISTENT_TURN**2)
    total = summed(scaled)
    return np.asarray(total.T @ np.exp(-apart) @ total)


def _cells(pixel: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells (c,) of ``size`` pixels in which there are some, and the number (n,) of each one's."""
    row, column = (pixel // size).T
    return np.unique(row * (column.max() + 1) + column, return_inverse=True)


def _squares(places: Floats) -> Floats:
    square = (places**2).sum(1)
    return np.asarray(np.maximum(square[:, None] + square - 2 * places @ places.T, 0.0))


def _chance(seen: ExpectedPoints, minimum: float) -> float:
    """That at least ``minimum`` points come back, their number taken as normal."""
    fraction, each = seen.fraction, seen.thinning
    count = float(fraction.sum() * each)
    losses = float((fraction * (1 - fraction) * np.maximum(seen.area, 1.0)).sum() * each)
    spread = math.sqrt(losses + float(np.nan_to_num(seen.fraction_error).sum() * each) ** 2)
    if spread == 0:
        return float(count >= minimum)
    return float(ndtr((count - minimum) / spread))
