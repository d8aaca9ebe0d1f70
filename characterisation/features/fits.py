"""Fit planes, cylinders, spheres and cones to measured points, with the covariance of the fit.

Signal chain: points -> robust fit of the orthogonal distance -> least squares of the distance along the view ray
(:mod:`characterisation.features.robust_fit`, :mod:`characterisation.features.surfaces`) -> surface, described at the
middle of its points -> covariance sigma^2 (J^T J)^-1 of the parameters of a small change of it.

With a viewpoint, the residual is the distance from the point to the surface *along its ray*, the direction in which a
3D sensor errs. Without one it is the orthogonal distance, as in ISO 10360-6 and in coordinate metrology software.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.fitted import ConeFit, CylinderFit, PlaneFit, SphereFit
from characterisation.features.robust_fit import (
    SMALLEST_SCALE,
    FitError,
    UndeterminedError,
    covariance_of,
    on_one_side,
    rays_from,
    robust_fit,
    usable,
)
from characterisation.features.starts import plane_start, rounding_scale, sphere_start
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere, Surface, distances
from characterisation.features.vectors import lengths, unit
from characterisation.files.errors import InputError
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE

Array = NDArray[np.float64]

#: largest distance of a point from its nominal surface, in standard deviations
GATE = 6.0

#: the same in mm, if that is more: parts lie that far from nominal
LEAST_GATE_MM = 1.0

#: least share of a surface's points that belong to it. With fewer, the nearest quarter, which gives the scatter, is
#: false, and a fit would use a few points that lie near the surface by chance
LEAST_BELONGING = 0.25

#: standard uncertainties of a fit that must lie within a limit; a normal error exceeds them in 0.3 % of cases
COVERAGE = 3.0

#: a quarter of normal residuals lie within this many standard deviations
QUARTER_TO_STD = 0.3186


def fit_plane(points: ArrayLike, viewpoint: ArrayLike | None = None) -> PlaneFit:
    """Fit a plane to points.

    Parameters
    ----------
    points
        (n, 3) [mm]; rows with NaN are ignored, outliers are rejected.
    viewpoint
        (3,) [mm], optical centre of the sensor. With it, residuals are along the view rays; without it, orthogonal.

    Returns
    -------
    PlaneFit
        ``point`` (3,) [mm], the foot of the points' centroid; unit ``normal`` (3,), toward the viewpoint, or else with
        a positive largest component; ``residual_std`` [mm] and ``covariance`` (3, 3).

    Raises
    ------
    FitError
        If there are fewer than 4 points, or they lie on a line, or all are at grazing incidence.

    Examples
    --------
    >>> import characterisation
    >>> corners = [[0, 0, 500], [90, 0, 500], [0, 90, 500], [90, 90, 500], [40, 40, 500]]
    >>> print(characterisation.fit_plane(corners, viewpoint=(0, 0, 0)).normal.round(6) + 0.0)
    [ 0.  0. -1.]
    """
    points = _usable(points, Plane)
    start, points = plane_start(points)
    plane, kept = _fit(start, points, viewpoint, rounding_scale(points, start))
    centroid = points[kept].mean(axis=0)
    outward = plane.normal[np.argmax(np.abs(plane.normal))]
    if viewpoint is not None:
        outward = (np.asarray(viewpoint, float) - centroid) @ plane.normal
    normal = plane.normal if outward > 0 else -plane.normal
    plane = Plane(plane.point, normal).at_foot_of(centroid)
    return PlaneFit(plane.point, plane.normal, *_uncertainty(plane, points[kept], viewpoint))


def fit_cylinder(points: ArrayLike, initial: Cylinder, viewpoint: ArrayLike | None = None) -> CylinderFit:
    """Fit a cylinder to points, starting from its nominal geometry.

    Parameters
    ----------
    points
        (n, 3) [mm]; rows with NaN are ignored, outliers are rejected.
    initial
        The nominal cylinder; it may differ by some degrees and about half a radius.
    viewpoint
        (3,) [mm], optical centre of the sensor. With it, residuals are along the view rays; without it, orthogonal.

    Returns
    -------
    CylinderFit
        ``point`` (3,) of the axis [mm], unit ``axis`` (3,), ``radius`` [mm]; ``residual_std`` [mm] and ``covariance``
        (5, 5).

    Raises
    ------
    FitError
        If there are fewer than 6 points, or they do not determine a cylinder, or all are at grazing incidence. Also if
        the fit departs from the nominal geometry by more than 45 deg of axis, or a factor 3 of radius, or the radius is
        undetermined (:func:`check_radius`).

    Examples
    --------
    >>> import numpy as np
    >>> import characterisation
    >>> angle, along = np.meshgrid(np.linspace(0, 3, 20), np.linspace(0, 50, 10))
    >>> points = np.stack([20 * np.cos(angle), 20 * np.sin(angle), along], axis=-1).reshape(-1, 3)
    >>> nominal = characterisation.Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), 22.0)
    >>> round(characterisation.fit_cylinder(points, nominal).radius, 6)
    20.0
    """
    points = _usable(points, Cylinder)
    initial = Cylinder(np.asarray(initial.point, float), _axis(initial), _radius(initial))
    cylinder, kept = _fit(initial.at_foot_of(points.mean(axis=0)), points, viewpoint)
    if not 1 / 3 < cylinder.radius / initial.radius < 3 or cylinder.axis @ initial.axis < np.cos(np.pi / 4):
        raise FitError(
            f"the fit departs from the nominal cylinder (radius {cylinder.radius:.4g} mm, "
            f"nominal {initial.radius:.4g} mm)"
        )
    cylinder = cylinder.at_foot_of(points[kept].mean(axis=0))
    covariance, residual_std, count = _uncertainty(cylinder, points[kept], viewpoint)
    check_radius(cylinder, covariance)
    return CylinderFit(cylinder.point, cylinder.axis, cylinder.radius, covariance, residual_std, count)


def fit_cone(points: ArrayLike, initial: Cone, viewpoint: ArrayLike | None = None) -> ConeFit:
    """Fit a cone to points (n, 3) [mm], starting from its nominal geometry; rows with NaN are ignored.

    ``viewpoint`` (3,) [mm] is the optical centre of the sensor. The initial geometry may differ by some degrees of axis
    and half-angle, and about a third of the radius. Raises FitError if there are fewer than 7 points, or they do not
    determine a cone, or all are at grazing incidence, or the fit departs from the nominal geometry. It departs with
    more than 45 deg of axis, with a half-angle below a third of the nominal one or above the middle between it and 90
    deg, or with points about the apex.
    """
    points = _usable(points, Cone)
    initial = Cone(np.asarray(initial.point, float), _axis(initial), _radius(initial), float(initial.half_angle))
    cone, kept = _fit(initial.at_foot_of(points.mean(axis=0)), points, viewpoint)
    angles = (initial.half_angle / 3, (initial.half_angle + np.pi / 2) / 2)
    if not angles[0] < cone.half_angle < angles[1] or cone.axis @ initial.axis < np.cos(np.pi / 4):
        raise FitError(
            f"the fit departs from the nominal cone (half-angle {np.rad2deg(cone.half_angle):.4g} deg, "
            f"nominal {np.rad2deg(initial.half_angle):.4g} deg)"
        )
    cone = cone.at_foot_of(points[kept].mean(axis=0))
    if not cone.radius > 0:
        raise FitError("the points lie about the apex of the cone or beyond it")
    covariance, residual_std, count = _uncertainty(cone, points[kept], viewpoint)
    return ConeFit(cone.point, cone.axis, cone.radius, cone.half_angle, covariance, residual_std, count)


def fit_sphere(points: ArrayLike, viewpoint: ArrayLike | None = None) -> SphereFit:
    """Fit a sphere to points.

    Parameters
    ----------
    points
        (n, 3) [mm]; rows with NaN are ignored, outliers are rejected.
    viewpoint
        (3,) [mm], optical centre of the sensor. With it, residuals are along the view rays; without it, orthogonal.

    Returns
    -------
    SphereFit
        ``centre`` (3,) [mm], ``radius`` [mm]; ``residual_std`` [mm] and ``covariance`` (4, 4).

    Raises
    ------
    FitError
        If there are fewer than 5 points, or they do not curve enough to determine a sphere (:func:`check_radius`), or
        all are at grazing incidence.

    Examples
    --------
    >>> import numpy as np
    >>> import characterisation
    >>> turn, rise = np.meshgrid(np.linspace(0, 6, 20), np.linspace(0.2, 1.2, 10))
    >>> way = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], axis=-1)
    >>> fitted = characterisation.fit_sphere((25 * way + [0, 0, 400]).reshape(-1, 3))
    >>> round(fitted.radius, 6), round(float(fitted.centre[2]), 6)
    (25.0, 400.0)
    """
    points = _usable(points, Sphere)
    sphere, kept = _fit(sphere_start(points), points, viewpoint)
    extent = float(np.ptp(points[kept], axis=0).max())
    if not 0 < sphere.radius < 100 * extent:
        raise FitError(f"{len(points)} points that do not curve enough to determine a sphere")
    covariance, residual_std, count = _uncertainty(sphere, points[kept], viewpoint)
    check_radius(sphere, covariance)
    return SphereFit(sphere.centre, sphere.radius, covariance, residual_std, count)


def fit_surface(
    points: ArrayLike, nominal: Surface, viewpoint: ArrayLike | None = None
) -> PlaneFit | CylinderFit | SphereFit | ConeFit:
    """Fit a surface of the kind of ``nominal``; cylinders and cones start from it.

    Raises FitError as the fit of that kind.
    """
    if isinstance(nominal, Plane):
        return fit_plane(points, viewpoint)
    if isinstance(nominal, Cylinder):
        return fit_cylinder(points, nominal, viewpoint)
    if isinstance(nominal, Cone):
        return fit_cone(points, nominal, viewpoint)
    return fit_sphere(points, viewpoint)


def check_radius(shape: Surface | Circle | EdgePoint, covariance: Array, factor: float = 1.0) -> None:
    """Check that points determine the radius of a fitted cylinder or sphere; other shapes always pass.

    Its curvature must differ from that of a plane: :data:`COVERAGE` standard uncertainties of the radius are at most
    half of it. ``factor`` multiplies the ``covariance`` (p, p) of the fit. Raises UndeterminedError if they are more.
    """
    if not isinstance(shape, Cylinder | Sphere):
        return
    last = shape.parameter_count - 1  # the radius is the last parameter of both
    uncertainty = float(np.sqrt(factor * max(covariance[last, last], 0.0)))
    if not COVERAGE * uncertainty <= shape.radius / 2:
        raise UndeterminedError(
            f"the points do not determine the {shape.kind}: a radius of {shape.radius:.3g} mm has a standard "
            f"uncertainty of {uncertainty:.2g} mm, at most {shape.radius / 2 / COVERAGE:.2g} is allowed"
        )


def belonging(points: ArrayLike, nominal: Surface, viewpoint: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Return which points (n, 3) [mm] can lie on a surface whose nominal geometry and place are known, (n,).

    False matches in the mirror image of another face lie far from the surface and close together. They may be more than
    half of all points, or all, so an estimator that uses only the points cannot recognise them. Seen from ``viewpoint``
    (3,) [mm], a point is false if its distance from the surface along its ray exceeds 1 % of the range. The
    characterisation of a sensor uses the same limit (:data:`~characterisation.point_cloud.FALSE_SHARE_OF_DISTANCE`).

    Of the rest, points within :data:`GATE` standard deviations of the nominal surface are kept, or within
    :data:`LEAST_GATE_MM` if that is more. The standard deviation is estimated from the nearest quarter of these points:
    a quarter of normal residuals lie within 0.3186 standard deviations. A displaced part increases it accordingly.
    Points on the far side of a round surface are left out, unless both were scanned
    (:func:`~characterisation.features.robust_fit.on_one_side`).
    """
    array = np.asarray(points, float).reshape(-1, 3)
    distance = np.abs(distances(nominal, array, None)[0])
    accepted, cosine = np.isfinite(distance), np.zeros(len(array))
    if viewpoint is not None:
        finite = accepted.copy()
        accepted[finite], cosine[finite] = _not_false(array[finite], nominal, np.asarray(viewpoint, float))
    if not accepted.any():
        return accepted
    scale = float(np.quantile(distance[accepted], 0.25)) / QUARTER_TO_STD
    with np.errstate(invalid="ignore"):
        near = accepted & np.asarray(distance <= max(GATE * scale, LEAST_GATE_MM))
    return near if isinstance(nominal, Plane) else near & on_one_side(cosine, near)


def _not_false(points: Array, nominal: Surface, viewpoint: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which points (n, 3) are near enough to a surface along their rays, and N.V (n,) there."""
    away = points - viewpoint
    distance = lengths(away)
    rays = np.divide(away, distance[:, None], out=np.zeros_like(away), where=distance[:, None] > 0)
    residual, cosine = distances(nominal, points, rays)
    return np.asarray(np.abs(residual) <= FALSE_SHARE_OF_DISTANCE * (distance - residual)), cosine


def _axis(initial: Cylinder | Cone) -> Array:
    """Return the checked axis of a nominal surface, as a unit vector."""
    axis = np.asarray(initial.axis, float)
    if axis.shape != (3,) or not 0 < np.linalg.norm(axis) < np.inf:
        raise InputError(f"fit_{initial.kind}", "initial.axis", axis.tolist(), "three numbers that are not all 0")
    return unit(axis)


def _radius(initial: Cylinder | Cone) -> float:
    """Return the checked radius of a nominal surface."""
    if not 0 < initial.radius < np.inf:
        raise InputError(f"fit_{initial.kind}", "initial.radius", initial.radius, "a number above 0 [mm]")
    return float(initial.radius)


Shape = TypeVar("Shape", Plane, Cylinder, Sphere, Cone)


def _fit(
    shape: Shape, points: Array, viewpoint: ArrayLike | None, least_scale: float = SMALLEST_SCALE
) -> tuple[Shape, NDArray[np.bool_]]:
    """Return the robust least-squares shape and the mask (n,) of the points used."""
    rays = rays_from(viewpoint, points)

    def linearised(
        shape: Shape, parameters: Array, chosen: NDArray[Any], along_rays: bool
    ) -> tuple[Array, Array, Array]:
        every = len(chosen) == len(points)  # all points in their order: no copy of half a million
        seen = None if rays is None or not along_rays else rays if every else rays[chosen]
        return shape.linearised(parameters, points if every else points[chosen], seen)

    return robust_fit(shape, linearised, len(points), least_scale)


def _uncertainty(shape: Surface, points: Array, viewpoint: ArrayLike | None) -> tuple[Array, float, int]:
    """Return the covariance sigma^2 (J^T J)^-1, sigma with n - p degrees of freedom [mm], and n."""
    residual, jacobian, _ = shape.linearised(np.zeros(shape.parameter_count), points, rays_from(viewpoint, points))
    return covariance_of(residual, jacobian, shape.kind)


def _usable(points: ArrayLike, shape: type[Surface]) -> Array:
    return usable(points, shape.kind, shape.parameter_count)
