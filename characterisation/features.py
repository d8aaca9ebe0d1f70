"""Planes, cylinders and spheres through measured points, with the uncertainty of the fit.

Signal chain: points -> robust fit of the orthogonal distance (Cauchy loss: false matches must not pull) -> points that
lie near the surface and are not seen at grazing incidence -> least squares of the distance along the view ray ->
covariance sigma^2 (J^T J)^-1.

A 3D sensor errs along the view ray V (slides, "Point standard deviation": P = P_eps + eps V), so with a viewpoint the
residual is eps, the distance from the point to the surface *along its ray*. To first order that is the orthogonal
distance divided by N.V; on a curved surface it is the exact root, because the first-order form is biased where N.V is
small. Without a viewpoint the residual is the orthogonal distance.

The covariance holds for noise that is independent from point to point. Decoders that match windows correlate their
neighbours; for their clouds it is a lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

#: Points whose ray meets the surface at more than 80 deg incidence are left out of a fit with a viewpoint: there eps
#: is an orthogonal distance magnified more than 5.8 times, the ray of a good point may miss a trial surface, and real
#: sensors give mixed (edge) pixels.
GRAZING_COSINE = float(np.cos(np.deg2rad(80.0)))

#: Residuals beyond this many robust standard deviations are outliers; of 10 000 Gaussian ones 0.6 are lost.
CLIP = 4.0

#: Smallest noise that is told from rounding [mm]; float32 points half a metre away are rounded to 3e-5 mm.
SMALLEST_SCALE = 1e-6


class FitError(ValueError):
    """A surface cannot be fitted to these points; the message says why in a few words."""


def tangents(direction: ArrayLike) -> Array:
    """Two unit vectors (2, 3) that complete a direction (3,) to a right-handed frame e1, e2, direction.

    The choice is a fixed rule (e1 is the coordinate axis least aligned with the direction, made perpendicular to it),
    since the covariance of a fit is expressed in it.
    """
    unit = _unit(direction)
    first = np.eye(3)[np.argmin(np.abs(unit))]
    first = _unit(first - (first @ unit) * unit)
    return np.stack([first, np.cross(unit, first)])


@dataclass(frozen=True)
class Plane:
    """Plane through ``point`` (3,) [mm] with unit ``normal`` (3,).

    Parameters of a small change: shift along the normal [mm], tilts [rad] of the normal toward e1 and e2 of
    :func:`tangents` about ``point``.
    """

    point: Array
    normal: Array

    parameter_count: ClassVar[int] = 3
    kind: ClassVar[str] = "plane"

    def moved(self, parameters: Array) -> Plane:
        """Change by the three parameters."""
        shift, *tilts = parameters
        return Plane(self.point + shift * self.normal, _unit(self.normal + np.asarray(tilts) @ tangents(self.normal)))

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Residuals (n,) [mm], their derivatives (n, 3) by the parameters, and N.V (n,) (1 without rays)."""
        shift, *tilts = parameters
        basis = tangents(self.normal)
        tilted = self.normal + np.asarray(tilts) @ basis
        length = float(np.linalg.norm(tilted))
        normal = tilted / length
        from_point = points - self.point - shift * self.normal
        distance = from_point @ normal
        cosine = np.ones(len(points)) if rays is None else rays @ normal
        slope = _guarded(cosine)
        residual = distance / slope
        foot = from_point - (distance[:, None] * normal if rays is None else residual[:, None] * rays)
        by_shift = np.full(len(points), -(self.normal @ normal))
        jacobian = np.column_stack([by_shift, foot @ basis.T / length]) / slope[:, None]
        return residual, jacobian, cosine


@dataclass(frozen=True)
class Cylinder:
    """Cylinder about the line through ``point`` (3,) [mm] along unit ``axis`` (3,), ``radius`` [mm].

    Parameters of a small change: shifts [mm] of the point along e1 and e2 of :func:`tangents`, tilts [rad] of the
    axis toward e1 and e2 about ``point``, change of radius [mm].
    """

    point: Array
    axis: Array
    radius: float

    parameter_count: ClassVar[int] = 5
    kind: ClassVar[str] = "cylinder"

    def moved(self, parameters: Array) -> Cylinder:
        """Change by the five parameters."""
        basis = tangents(self.axis)
        point = self.point + parameters[:2] @ basis
        return Cylinder(point, _unit(self.axis + parameters[2:4] @ basis), self.radius + float(parameters[4]))

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Residuals (n,) [mm], their derivatives (n, 5) by the parameters, and N.V (n,) (1 without rays)."""
        basis = tangents(self.axis)
        tilted = self.axis + parameters[2:4] @ basis
        length = float(np.linalg.norm(tilted))
        axis = tilted / length
        from_point = points - self.point - parameters[:2] @ basis
        along = from_point @ axis
        radial = from_point - along[:, None] * axis
        across = None if rays is None else rays - (rays @ axis)[:, None] * axis
        residual, normal, slope, cosine = _to_round_surface(radial, across, self.radius + parameters[4])
        if rays is not None:
            along = along - residual * (rays @ axis)  # of the foot of the ray
        sideways = normal @ basis.T
        jacobian = -np.column_stack([sideways, sideways * (along / length)[:, None], np.ones(len(points))])
        return residual, jacobian / slope[:, None], cosine

    def at_foot_of(self, point: Array) -> Cylinder:
        """Describe the same cylinder by the point of its axis nearest to ``point`` (3,)."""
        return Cylinder(self.point + ((point - self.point) @ self.axis) * self.axis, self.axis, self.radius)


@dataclass(frozen=True)
class Sphere:
    """Sphere about ``centre`` (3,) [mm], ``radius`` [mm].

    Parameters of a small change: shift of the centre along x, y, z [mm], change of radius [mm].
    """

    centre: Array
    radius: float

    parameter_count: ClassVar[int] = 4
    kind: ClassVar[str] = "sphere"

    def moved(self, parameters: Array) -> Sphere:
        """Change by the four parameters."""
        return Sphere(self.centre + parameters[:3], self.radius + float(parameters[3]))

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Residuals (n,) [mm], their derivatives (n, 4) by the parameters, and N.V (n,) (1 without rays)."""
        radial = points - self.centre - parameters[:3]
        residual, normal, slope, cosine = _to_round_surface(radial, rays, self.radius + parameters[3])
        return residual, -np.column_stack([normal, np.ones(len(points))]) / slope[:, None], cosine


# What the three fits have in common: `covariance` (p, p) of the parameters of their surface, `residual_std` [mm] with
# `count - p` degrees of freedom (along the rays where a viewpoint was given), and `count`, the number of points used.


@dataclass(frozen=True)
class PlaneFit(Plane):
    """Fitted plane; ``point`` is the foot of the used points' centroid, ``normal`` faces the viewpoint."""

    covariance: Array
    residual_std: float
    count: int


@dataclass(frozen=True)
class CylinderFit(Cylinder):
    """Fitted cylinder; ``point`` is the axis' point nearest the used points' centroid, ``axis`` runs as the initial."""

    covariance: Array
    residual_std: float
    count: int


@dataclass(frozen=True)
class SphereFit(Sphere):
    """Fitted sphere."""

    covariance: Array
    residual_std: float
    count: int


Fit = PlaneFit | CylinderFit | SphereFit


def fit_plane(points: ArrayLike, viewpoint: ArrayLike | None = None) -> PlaneFit:
    """Fit a plane to points (n, 3) [mm], seen from ``viewpoint`` (3,) [mm] if given; rows with NaN are left out.

    Without a viewpoint the largest component of the normal is positive.

    Raises
    ------
    FitError
        If there are fewer than 4 points, or they lie on a line, or all are seen at grazing incidence.
    """
    points = _usable(points, Plane)
    centroid = points.mean(axis=0)
    start = Plane(centroid, np.linalg.svd(points - centroid, full_matrices=False)[2][-1])
    plane, kept = _fit(start, points, viewpoint)
    centroid = points[kept].mean(axis=0)
    outward = plane.normal[np.argmax(np.abs(plane.normal))]
    if viewpoint is not None:
        outward = (np.asarray(viewpoint, float) - centroid) @ plane.normal
    normal = plane.normal if outward > 0 else -plane.normal
    plane = Plane(centroid - ((centroid - plane.point) @ normal) * normal, normal)
    return PlaneFit(plane.point, plane.normal, *_uncertainty(plane, points[kept], viewpoint))


def fit_cylinder(points: ArrayLike, initial: Cylinder, viewpoint: ArrayLike | None = None) -> CylinderFit:
    """Fit a cylinder to points (n, 3) [mm] from its nominal geometry; rows with NaN are left out.

    ``viewpoint`` (3,) [mm] is where the sensor looks from. The initial geometry may be off by some degrees and about
    half a radius.

    Raises
    ------
    FitError
        If there are fewer than 6 points, or they do not determine a cylinder, or all are seen at grazing incidence,
        or the fit leaves the nominal geometry (more than 45 deg of axis, or a factor 3 of radius).
    """
    points = _usable(points, Cylinder)
    initial = Cylinder(np.asarray(initial.point, float), _unit(initial.axis), float(initial.radius))
    cylinder, kept = _fit(initial.at_foot_of(points.mean(axis=0)), points, viewpoint)
    if not 1 / 3 < cylinder.radius / initial.radius < 3 or cylinder.axis @ initial.axis < np.cos(np.pi / 4):
        raise FitError(
            f"the points lead away from the nominal cylinder (radius {cylinder.radius:.4g} mm, "
            f"nominal {initial.radius:.4g} mm)"
        )
    cylinder = cylinder.at_foot_of(points[kept].mean(axis=0))
    covariance, residual_std, count = _uncertainty(cylinder, points[kept], viewpoint)
    return CylinderFit(cylinder.point, cylinder.axis, cylinder.radius, covariance, residual_std, count)


def fit_sphere(points: ArrayLike, viewpoint: ArrayLike | None = None) -> SphereFit:
    """Fit a sphere to points (n, 3) [mm], seen from ``viewpoint`` (3,) [mm] if given; rows with NaN are left out.

    Raises
    ------
    FitError
        If there are fewer than 5 points, or they do not curve enough to determine a sphere, or all are seen at
        grazing incidence.
    """
    points = _usable(points, Sphere)
    centroid = points.mean(axis=0)
    local = points - centroid
    # |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the unknowns: a start without iteration
    square = np.sum(local**2, axis=1)
    solution, *_ = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), square, rcond=None)
    start = Sphere(centroid + solution[:3], float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-12))))
    sphere, kept = _fit(start, points, viewpoint)
    extent = float(np.ptp(points[kept], axis=0).max())
    if not 0 < sphere.radius < 100 * extent:
        raise FitError(f"{len(points)} points that do not curve enough to determine a sphere")
    return SphereFit(sphere.centre, sphere.radius, *_uncertainty(sphere, points[kept], viewpoint))


Shape = TypeVar("Shape", Plane, Cylinder, Sphere)


def _fit(shape: Shape, points: Array, viewpoint: ArrayLike | None) -> tuple[Shape, NDArray[np.bool_]]:
    """Return the robust least-squares shape and the mask (n,) of the points it rests on."""
    zero = np.zeros(shape.parameter_count)
    rays = _rays(points, viewpoint)
    # the orthogonal distance converges from far; twice, since the first scale is that of the starting geometry
    some = points[:: 1 + len(points) // 4000]  # enough for a start
    for _ in range(2):
        residual, _, _ = shape.linearised(zero, some, None)
        shape = _solve(shape, some, None, "cauchy", _scale(residual))
    kept = np.zeros(len(points), bool)
    for _ in range(10):
        residual, _, cosine = shape.linearised(zero, points, rays)
        facing = np.abs(cosine) > GRAZING_COSINE
        if not facing.any():
            raise FitError(f"all {len(points)} points are seen at grazing incidence")
        near = facing & (np.abs(residual) <= CLIP * _scale(residual[facing]))
        if np.array_equal(near, kept):
            break
        kept = near
        if kept.sum() <= shape.parameter_count:
            raise FitError(f"only {kept.sum()} of {len(points)} points lie on one {shape.kind}")
        shape = _solve(shape, points[kept], None if rays is None else rays[kept], "linear", 1.0)
    return shape, kept


def _solve(shape: Shape, points: Array, rays: Array | None, loss: str, scale: float) -> Shape:
    zero = np.zeros(shape.parameter_count)
    _check_rank(shape, shape.linearised(zero, points, rays)[1])
    tolerance = 1e-12 if loss == "linear" else 1e-6  # the robust shape is only a start
    with np.errstate(divide="ignore", invalid="ignore"):  # a step toward a degenerate surface shows in the status
        solution = least_squares(
            lambda parameters: shape.linearised(parameters, points, rays)[0], zero,
            jac=lambda parameters: shape.linearised(parameters, points, rays)[1],
            loss=loss, f_scale=scale, x_scale="jac", xtol=tolerance, ftol=tolerance, gtol=None, max_nfev=100,
        )  # fmt: skip
    if solution.status <= 0 or not np.isfinite(solution.x).all():
        raise FitError(f"{len(points)} points that do not determine a {shape.kind} (no convergence)")
    return shape.moved(solution.x)


def _uncertainty(shape: Shape, points: Array, viewpoint: ArrayLike | None) -> tuple[Array, float, int]:
    """Covariance sigma^2 (J^T J)^-1, sigma with n - p degrees of freedom [mm], and n."""
    residual, jacobian, _ = shape.linearised(np.zeros(shape.parameter_count), points, _rays(points, viewpoint))
    _check_rank(shape, jacobian)
    variance = float(residual @ residual) / (len(points) - shape.parameter_count)
    norms = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.inv((jacobian / norms).T @ (jacobian / norms)) / np.outer(norms, norms)
    return variance * inverse, float(np.sqrt(variance)), len(points)


def _check_rank(shape: Plane | Cylinder | Sphere, jacobian: Array) -> None:
    norms = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / np.where(norms > 0, norms, 1.0), compute_uv=False)
    if not np.isfinite(singular).all() or singular[-1] < 1e-7 * singular[0]:
        raise FitError(f"{len(jacobian)} points that do not determine a {shape.kind}")


def _to_round_surface(radial: Array, across: Array | None, radius: float) -> tuple[Array, Array, Array, Array]:
    """Residual, unit normal at the foot, guarded N.V and N.V at the foot, of a cylinder or sphere.

    ``radial`` (n, 3) runs from the axis or centre to the point, ``across`` (n, 3) is the ray's part in that space;
    the foot radial - eps across lies on the surface, of the two roots the nearer one. N.V is taken at the foot, which
    depends on the ray only: points chosen by their own noisy N.V would bias the fit. It is 0 for a ray that misses.
    """
    reach = np.maximum(np.linalg.norm(radial, axis=1), 1e-12)
    if across is None:
        ones = np.ones(len(radial))
        return reach - radius, radial / reach[:, None], ones, ones
    b = reach * _guarded(np.sum(radial * across, axis=1) / reach)
    c = (reach - radius) * (reach + radius)
    square = b**2 - np.sum(across**2, axis=1) * c
    residual = c / (b + np.copysign(np.sqrt(np.maximum(square, 0.0)), b))
    foot = radial - residual[:, None] * across
    normal = foot / np.maximum(np.linalg.norm(foot, axis=1), 1e-12)[:, None]
    cosine = np.where(square > 0, np.sum(normal * across, axis=1), 0.0)
    return residual, normal, _guarded(cosine), cosine


def _guarded(cosine: Array) -> Array:
    """Keep N.V away from 0, well below :data:`GRAZING_COSINE` so that hardly a point that is used is touched."""
    return np.copysign(np.maximum(np.abs(cosine), GRAZING_COSINE / 4), cosine)


def _rays(points: Array, viewpoint: ArrayLike | None) -> Array | None:
    if viewpoint is None:
        return None
    rays: Array = points - np.asarray(viewpoint, float)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


def _scale(residual: Array) -> float:
    """Robust standard deviation of residuals about 0 [mm]: 1.4826 median |r|."""
    return max(1.4826 * float(np.median(np.abs(residual))), SMALLEST_SCALE)


def _usable(points: ArrayLike, shape: type[Plane | Cylinder | Sphere]) -> Array:
    array: Array = np.asarray(points, float).reshape(-1, 3)
    array = array[np.isfinite(array).all(axis=1)]
    if len(array) <= shape.parameter_count:
        raise FitError(f"{len(array)} points, a {shape.kind} needs at least {shape.parameter_count + 1}")
    return array


def _unit(vector: ArrayLike) -> Array:
    array: Array = np.asarray(vector, float)
    unit: Array = array / np.linalg.norm(array)
    return unit
