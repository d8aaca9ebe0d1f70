"""Decide whether a fit is a feature of the part, from the fit and its nominal geometry, or a failure.

Signal chain: points that belong to the nominal surface, within a limit -> fit -> fitted surface over every place where
the sensor sees the feature, with or without a point -> its distance from nominal there, and the standard uncertainty of
that distance -> fit, or :class:`~characterisation.features.robust_fit.FitError`.

A fit uses points that lie within a limit of the nominal surface (:func:`~characterisation.features.fits.belonging`). So
the surface itself lies within this limit wherever it is seen. A fit is credible if

- :data:`~characterisation.features.fits.COVERAGE` standard uncertainties of its distance from nominal are within the
  limit at all these places, and those of a radius within half of it. Else the points do not determine the
  feature, and the next condition would select the fits that happen to be right;
- it lies within the limit over all these places, or beyond it by at most as many standard uncertainties. A sphere
  through a small cap can fit the cap, and miss the rest of the ball by many times the limit;
- it has no larger residuals than the nominal surface, which is one of the surfaces that it could have found.

The covariance of a fit holds for independent noise. Here it is multiplied by the number of points that count as one
(:func:`~characterisation.features.best_fit.counted_as_one`), from the residuals, and by their degrees of freedom. The
rule uses no property of the sensor, so it holds for measured and for virtual clouds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.best_fit import counted_as_one
from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.fits import COVERAGE, GATE, LEAST_GATE_MM, check_radius
from characterisation.features.fitted import CircleFit, ConeFit, CylinderFit, EdgePointFit, Fit, PlaneFit, SphereFit
from characterisation.features.robust_fit import CLIP, FitError, UndeterminedError, rays_from
from characterisation.features.surfaces import GRAZING_COSINE, Plane, Surface, distances
from characterisation.features.vectors import tangents

Array = NDArray[np.float64]

#: Largest number of places where a fit is compared with nominal.
PLACES = 500

#: Largest number of residuals from which their correlation is estimated.
_RESIDUALS = 1000

#: Share by which the residuals of a fit may exceed those of the nominal surface, and residuals [mm], by rounding.
_ROUNDING = 1e-6


def places_seen(nominal: Surface, rays: ArrayLike, viewpoint: ArrayLike, points: ArrayLike) -> Array:
    """Return the places (k, 3) [mm] where a sensor sees a surface.

    Rays that miss, or meet the surface at grazing incidence, are left out. Of many places, evenly chosen ones remain.

    Parameters
    ----------
    nominal
        The surface.
    rays
        (n, 3), from the viewpoint.
    viewpoint
        (3,) [mm].
    points
        (m, 3) [mm] on the surface, which tell whether rays meet it from outside, or from inside as in a bore.
    """
    eye, array = np.asarray(viewpoint, float), np.asarray(points, float).reshape(-1, 3)
    directions = np.asarray(rays, float).reshape(-1, 3)
    directions = directions[:: max(-(-len(directions) // PLACES), 1)]
    starts = np.broadcast_to(eye, directions.shape)
    several = len(array) and not isinstance(nominal, Plane)  # places on a ray
    if several and np.median(nominal.meet(array, rays_from(eye, array)).cosine) > 0:
        # a ray enters a bore in the air, and meets its wall where it leaves: the nearer place from beyond
        starts = eye + 2 * np.linalg.norm(array - eye, axis=1).max() * directions
    at = nominal.meet(starts, directions)
    met: Array = at.foot[(np.abs(at.cosine) > GRAZING_COSINE) & np.isfinite(at.foot).all(axis=1)]
    return met


def check_surface(
    fit: PlaneFit | CylinderFit | SphereFit | ConeFit,
    nominal: Surface,
    points: ArrayLike,
    positions: ArrayLike,
    viewpoint: ArrayLike | None = None,
) -> None:
    """Check that the fit of a surface is credible.

    Raises UndeterminedError if the points do not determine the surface over these positions. Raises FitError if the fit
    lies too far from nominal there, or its residuals exceed those of the nominal surface.

    Parameters
    ----------
    fit
        Fitted to ``points``.
    nominal
        Its nominal geometry and place, in the frame of the points.
    points
        (n, 3) [mm], those that can lie on the surface.
    positions
        (k, 3) [mm] on the nominal surface, where the sensor sees it (:func:`places_seen`).
    viewpoint
        (3,) [mm], optical centre of the sensor; None for points of several views.
    """
    array, where = np.asarray(points, float).reshape(-1, 3), np.asarray(positions, float).reshape(-1, 3)
    if not len(where):
        return
    rays = rays_from(viewpoint, array)
    residual, cosine = distances(fit, array, rays)
    used = (np.abs(cosine) > GRAZING_COSINE) & (np.abs(residual) <= CLIP * max(fit.residual_std, _ROUNDING))
    nominal_residual, _ = distances(nominal, array[used], None if rays is None else rays[used])
    if residual[used] @ residual[used] > (1 + _ROUNDING) * (nominal_residual @ nominal_residual) + _ROUNDING**2:
        sizes = [float(np.sqrt(np.mean(residuals**2))) for residuals in (residual[used], nominal_residual)]
        raise FitError(
            f"the fit has residuals of {sizes[0]:.2g} mm (root mean square), the nominal {nominal.kind} {sizes[1]:.2g}"
        )
    limit = surface_limit(fit.residual_std, nominal, array[used])
    factor = _variance_factor(array[used], residual[used], fit.parameter_count)
    check_radius(fit, fit.covariance, factor)
    _check(fit, where, limit, factor, f"nominal {nominal.kind} where the sensor sees it")


def surface_limit(noise: float, nominal: Surface, points: Array) -> float:
    """Return how far [mm] a surface may lie from nominal where it is seen, from its points (n, 3) [mm].

    That is the distance at which points belong to it, :data:`~characterisation.features.fits.GATE` standard deviations
    ``noise`` [mm] and at least :data:`~characterisation.features.fits.LEAST_GATE_MM`, from a surface that is displaced
    by the median distance of the points.
    """
    distance, _ = distances(nominal, points, None)
    return max(GATE * noise, LEAST_GATE_MM) + float(np.median(np.abs(distance)))


def most_uncertain(shape: Surface | Circle | EdgePoint, limit: float) -> float:
    """Return the largest standard uncertainty [mm] of a shape's distance from nominal with which it is determined.

    :data:`~characterisation.features.fits.COVERAGE` of them are within the ``limit`` [mm], and within half the radius
    of a round shape, from which fits converge.
    """
    return min(limit, getattr(shape, "radius", math.inf) / 2) / COVERAGE


def check_figure(fit: CircleFit | EdgePointFit, nominal: Circle | EdgePoint, reach: float) -> None:
    """Check that the fit of a circle, or of a point of an edge within its ``reach`` [mm], is credible.

    A circle is compared with nominal all round, and lies within half its radius; its edge is searched there. Raises
    UndeterminedError, FitError as :func:`check_surface`.
    """
    if isinstance(nominal, Circle):
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        around = np.column_stack([np.cos(angle), np.sin(angle)]) @ tangents(nominal.normal)
        _check(fit, nominal.centre + nominal.radius * around, nominal.radius / 2, 1.0, "nominal circle")
    else:
        _check(fit, nominal.point[None], reach, 1.0, "nominal point of the edge")


def _check(fit: Fit, positions: Array, limit: float, factor: float, reference: str) -> None:
    """Check the distance of a fit from positions (k, 3) [mm], and its uncertainty, against a limit [mm]."""
    distance, jacobian, _ = fit.linearised(np.zeros(fit.parameter_count), positions, None)
    variance = np.einsum("ij,jk,ik->i", jacobian, fit.covariance, jacobian)
    uncertainty = float(np.sqrt(factor * max(variance.max(), 0.0)))
    most = most_uncertain(fit, limit)
    if not uncertainty <= most:
        raise UndeterminedError(
            f"the points do not determine the {_words(fit)}: its distance from the {reference} has a standard "
            f"uncertainty up to {uncertainty:.2g} mm, at most {most:.2g} is allowed"
        )
    farthest = float(np.abs(distance).max())
    allowed = limit + COVERAGE * uncertainty
    if not farthest <= allowed:
        raise FitError(
            f"the fitted {_words(fit)} lies up to {farthest:.2g} mm from the {reference}, "
            f"at most {allowed:.2g} is allowed"
        )


def _words(fit: Fit) -> str:
    return fit.kind.replace("edge_point", "edge")


def _variance_factor(points: Array, residual: Array, parameter_count: int) -> float:
    """Return the factor on a fit's covariance by the correlation of its residuals (n,) [mm], at points (n, 3).

    With a points that count as one, the n residuals have n / a - p degrees of freedom. The factor is infinite where
    these are none.
    """
    # a fit without noise has residuals of rounding alone
    if float(np.abs(residual).max(initial=0.0)) < _ROUNDING:
        return 1.0
    thinning = 1 + len(points) // _RESIDUALS
    together = counted_as_one(points[::thinning], residual[::thinning], thinning, np.random.default_rng(0))
    independent = len(points) / together
    spare = independent - parameter_count
    return math.inf if spare <= 0 else together * independent / spare
