"""Compute distances of points from planes, cylinders, spheres and cones along view rays, with derivatives.

Signal chain: a point and its ray V -> foot, where the ray meets the surface -> residual eps along the ray [mm], N.V at
the foot -> derivatives of eps by the parameters of a small change of the surface.

A 3D sensor errs along the view ray V (talk of Kinnell and Justham, 2018, "Point standard deviation": P = P_eps + eps
V). The residual is therefore eps, the distance from the surface to the point *along its ray*. To first order it is the
orthogonal distance divided by N.V. On a curved surface it is the exact root, because the first-order form is biased
where N.V is small. Without rays, the residual is the orthogonal distance.

All surfaces share one convention. Parameters are a small change of the given surface, at its given point, in the
directions e1 and e2 of :func:`characterisation.features.vectors.tangents`. Let g(q) be the signed orthogonal distance
of a fixed place q from the surface, N its gradient and q the foot. Implicit differentiation gives d eps / d p = (dg/dp)
/ (N.V).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.vectors import dots, lengths, moved_rigidly, tangents, unit

Array = NDArray[np.float64]

#: A fit with a viewpoint excludes points at more than 80 deg incidence. There eps is an orthogonal distance magnified
#: more than 5.8 times. The ray of a good point may miss a trial surface, and real sensors give mixed (edge) pixels.
GRAZING_COSINE = float(np.cos(np.deg2rad(80.0)))


class Meeting(NamedTuple):
    """Points where rays meet a surface; without rays, the feet of perpendiculars on it."""

    residual: Array  # (n,) [mm] from the foot to the point along the ray
    #: ``foot`` (n, 3), and ``normal`` (n, 3) there
    foot: Array
    normal: Array
    slope: Array  # (n,) N.V kept away from 0, and 1 without rays
    cosine: Array  # (n,) N.V itself, 0 for a ray that misses


@dataclass(frozen=True)
class Plane:
    """Plane through ``point`` (3,) [mm] with unit ``normal`` (3,).

    Parameters of a small change: shift along the normal [mm], tilts [rad] of the normal toward e1 and e2 of
    ``tangents`` about ``point``.
    """

    point: Array
    normal: Array

    parameter_count: ClassVar[int] = 3
    kind: ClassVar[str] = "plane"

    @cached_property
    def _basis(self) -> Array:
        """Return e1 and e2 of ``tangents``, (2, 3), of the normal."""
        return tangents(self.normal)

    def moved(self, parameters: Array) -> Plane:
        """Change the plane by the three parameters."""
        tilts = np.ascontiguousarray(parameters[1:], float)
        return Plane(self.point + parameters[0] * self.normal, unit(self.normal + tilts @ self._basis))

    def placed(self, motion: ArrayLike) -> Plane:
        """Move the plane rigidly by a (4, 4) matrix."""
        point, normal = moved_rigidly(motion, self.point, self.normal)
        return Plane(point, normal)

    def at_foot_of(self, point: Array) -> Plane:
        """Describe the same plane by its point nearest to ``point`` (3,)."""
        return Plane(point - ((point - self.point) @ self.normal) * self.normal, self.normal)

    def meet(self, points: Array, rays: Array | None) -> Meeting:
        """Intersect the rays (n, 3) of points (n, 3) [mm]."""
        distance = (points - self.point) @ self.normal
        cosine = np.ones(len(points)) if rays is None else rays @ self.normal
        slope = _guarded(cosine)
        residual = distance / slope
        normal = np.broadcast_to(self.normal, points.shape)
        return Meeting(residual, points - residual[:, None] * (normal if rays is None else rays), normal, slope, cosine)

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Return residuals (n,) [mm], their derivatives (n, 3) by the parameters, and N.V (n,) (1 without rays)."""
        moved, basis = self.moved(parameters), self._basis
        length = float(np.linalg.norm(self.normal + parameters[1:] @ basis))
        # by coordinate in the frame of normal, e1 and e2: rows of numbers, ten times faster than rows of points
        frame = np.array([moved.normal, *basis])
        distance, *coordinates = frame @ points.T - (frame @ moved.point)[:, None]
        along = np.broadcast_to(moved.normal, points.shape) if rays is None else rays
        cosine, *rising = frame @ along.T
        slope = _guarded(cosine)
        residual = distance / slope
        by_shift = np.full(len(points), -(self.normal @ moved.normal))
        by_tilts = [
            (coordinate - residual * rise) / length for coordinate, rise in zip(coordinates, rising, strict=True)
        ]
        jacobian = np.array([by_shift, *by_tilts]) / slope
        return residual, jacobian.T, cosine


@dataclass(frozen=True)
class Cylinder:
    """Cylinder about the line through ``point`` (3,) [mm] along unit ``axis`` (3,), ``radius`` [mm].

    Parameters of a small change: shifts [mm] of the point along e1 and e2 of ``tangents``, tilts [rad] of the axis
    toward e1 and e2 about ``point``, change of radius [mm].
    """

    point: Array
    axis: Array
    radius: float

    parameter_count: ClassVar[int] = 5
    kind: ClassVar[str] = "cylinder"

    @cached_property
    def _basis(self) -> Array:
        """Return e1 and e2 of ``tangents``, (2, 3), of the axis."""
        return tangents(self.axis)

    def moved(self, parameters: Array) -> Cylinder:
        """Change the cylinder by the five parameters."""
        basis = self._basis
        point = self.point + parameters[:2] @ basis
        return Cylinder(point, unit(self.axis + parameters[2:4] @ basis), self.radius + float(parameters[4]))

    def placed(self, motion: ArrayLike) -> Cylinder:
        """Move the cylinder rigidly by a (4, 4) matrix."""
        point, axis = moved_rigidly(motion, self.point, self.axis)
        return Cylinder(point, axis, self.radius)

    def meet(self, points: Array, rays: Array | None) -> Meeting:
        """Intersect the rays (n, 3) of points (n, 3) [mm]."""
        from_point = points - self.point
        radial = from_point - (from_point @ self.axis)[:, None] * self.axis
        across = None if rays is None else rays - (rays @ self.axis)[:, None] * self.axis
        return _met_round(points, rays, radial, across, self.radius)

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Return residuals (n,) [mm], their derivatives (n, 5) by the parameters, and N.V (n,) (1 without rays)."""
        moved = self.moved(parameters)
        at = moved.meet(points, rays)
        basis = self._basis
        length = float(np.linalg.norm(self.axis + parameters[2:4] @ basis))
        along = (at.foot - moved.point) @ moved.axis
        sideways = at.normal @ basis.T
        jacobian = -np.column_stack([sideways, sideways * (along / length)[:, None], np.ones(len(points))])
        return at.residual, jacobian / at.slope[:, None], at.cosine

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
        """Change the sphere by the four parameters."""
        return Sphere(self.centre + parameters[:3], self.radius + float(parameters[3]))

    def placed(self, motion: ArrayLike) -> Sphere:
        """Move the sphere rigidly by a (4, 4) matrix."""
        centre, _ = moved_rigidly(motion, self.centre, np.zeros(3))
        return Sphere(centre, self.radius)

    def meet(self, points: Array, rays: Array | None) -> Meeting:
        """Intersect the rays (n, 3) of points (n, 3) [mm]."""
        return _met_round(points, rays, points - self.centre, rays, self.radius)

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Return residuals (n,) [mm], their derivatives (n, 4) by the parameters, and N.V (n,) (1 without rays)."""
        at = self.moved(parameters).meet(points, rays)
        return at.residual, -np.column_stack([at.normal, np.ones(len(points))]) / at.slope[:, None], at.cosine


@dataclass(frozen=True)
class Cone:
    """Cone about the line through ``point`` (3,) [mm] along unit ``axis`` (3,), from the apex to the wide end.

    ``radius`` [mm] is that of the section through ``point``. ``half_angle`` [rad], between 0 and pi/2, is that between
    axis and surface (ISO 3040 gives a cone by its angle, twice that, and a diameter at a place). The apex itself would
    be a poor reference point: far from the visible surface, shift of the apex, half-angle and tilts are strongly
    correlated.

    Parameters of a small change: shifts [mm] of the point along e1 and e2 of ``tangents``, tilts [rad] of the axis
    toward e1 and e2 about ``point``, change of radius at the point [mm], change of the half-angle [rad].
    """

    point: Array
    axis: Array
    radius: float
    half_angle: float

    parameter_count: ClassVar[int] = 6
    kind: ClassVar[str] = "cone"

    @cached_property
    def _basis(self) -> Array:
        """Return e1 and e2 of ``tangents``, (2, 3), of the axis."""
        return tangents(self.axis)

    @property
    def apex(self) -> Array:
        """Return the apex (3,) [mm]."""
        tip: Array = self.point - self.radius / np.tan(self.half_angle) * self.axis
        return tip

    def moved(self, parameters: Array) -> Cone:
        """Change the cone by the six parameters."""
        basis = self._basis
        point, axis = self.point + parameters[:2] @ basis, unit(self.axis + parameters[2:4] @ basis)
        return Cone(point, axis, self.radius + float(parameters[4]), self.half_angle + float(parameters[5]))

    def placed(self, motion: ArrayLike) -> Cone:
        """Move the cone rigidly by a (4, 4) matrix."""
        point, axis = moved_rigidly(motion, self.point, self.axis)
        return Cone(point, axis, self.radius, self.half_angle)

    def meet(self, points: Array, rays: Array | None) -> Meeting:
        """Intersect the rays (n, 3) of points (n, 3) [mm].

        A ray that would meet the other half of the cone counts as a miss.
        """
        from_point = points - self.point
        along = from_point @ self.axis
        radial = from_point - along[:, None] * self.axis
        reach = np.maximum(lengths(radial), 1e-12)
        sine, cosine, slant = np.sin(self.half_angle), np.cos(self.half_angle), np.tan(self.half_angle)
        section = self.radius + along * slant
        if rays is None:
            outward = cosine * radial / reach[:, None] - sine * self.axis
            residual = (reach - section) * cosine
            ones = np.ones(len(points))
            return Meeting(residual, points - residual[:, None] * outward, outward, ones, ones)
        climb = rays @ self.axis
        across = rays - climb[:, None] * self.axis
        # |radial - eps across|^2 = (section - eps climb slant)^2: a eps^2 - 2 b eps + c = 0, the nearer root
        a = dots(across, across) - (slant * climb) ** 2
        b = dots(radial, across) - section * slant * climb
        b = reach * _guarded(b / reach * cosine) / cosine
        c = (reach - section) * (reach + section)
        square = b**2 - a * c
        residual = c / (b + np.copysign(np.sqrt(np.maximum(square, 0.0)), b))
        foot = radial - residual[:, None] * across
        foot /= np.maximum(lengths(foot), 1e-12)[:, None]
        normal = cosine * foot - sine * self.axis
        met = (square > 0) & (section - residual * climb * slant > 0)
        facing = np.where(met, dots(normal, rays), 0.0)
        return Meeting(residual, points - residual[:, None] * rays, normal, _guarded(facing), facing)

    def linearised(self, parameters: Array, points: Array, rays: Array | None) -> tuple[Array, Array, Array]:
        """Return residuals (n,) [mm], their derivatives (n, 6) by the parameters, and N.V (n,) (1 without rays)."""
        moved = self.moved(parameters)
        at = moved.meet(points, rays)
        basis = self._basis
        length = float(np.linalg.norm(self.axis + parameters[2:4] @ basis))
        sine, cosine = np.sin(moved.half_angle), np.cos(moved.half_angle)
        # g = (reach - radius) cos - along sin, at the foot with rays and at the point without
        offset = (points if rays is None else at.foot) - moved.point
        along = offset @ moved.axis
        radial = offset - along[:, None] * moved.axis
        reach = np.maximum(lengths(radial), 1e-12)
        sideways = radial / reach[:, None] @ basis.T
        lever = (cosine * along + sine * reach) / length
        by_radius = np.full(len(points), -cosine)
        by_angle = -(reach - moved.radius) * sine - along * cosine
        jacobian = np.column_stack([-(at.normal @ basis.T), -sideways * lever[:, None], by_radius, by_angle])
        return at.residual, jacobian / at.slope[:, None], at.cosine

    def at_foot_of(self, point: Array) -> Cone:
        """Describe the same cone by the point of its axis nearest to ``point`` (3,)."""
        along = float((point - self.point) @ self.axis)
        radius = self.radius + along * float(np.tan(self.half_angle))
        return Cone(self.point + along * self.axis, self.axis, radius, self.half_angle)


Surface = Plane | Cylinder | Sphere | Cone


def distances(surface: Surface, points: Array, rays: Array | None) -> tuple[Array, Array]:
    """Return the residual (n,) [mm] and N.V (n,) of points (n, 3), as a :class:`Meeting` has them."""
    if isinstance(surface, Plane):
        cosine = np.ones(len(points)) if rays is None else rays @ surface.normal
        return (points @ surface.normal - surface.point @ surface.normal) / _guarded(cosine), cosine
    at = surface.meet(points, rays)
    return at.residual, at.cosine


def _met_round(points: Array, rays: Array | None, radial: Array, across: Array | None, radius: float) -> Meeting:
    """Intersect rays with a cylinder or sphere.

    ``radial`` (n, 3) runs from the axis or centre to the point, ``across`` (n, 3) is the ray's component in that space.
    The foot radial - eps across lies on the surface, at the nearer of the two roots. N.V is taken at the foot, which
    depends on the ray only: selecting points by their own noisy N.V would bias the fit. It is 0 for a ray that misses.
    """
    reach = np.maximum(lengths(radial), 1e-12)
    if rays is None or across is None:
        ones, normal, residual = np.ones(len(radial)), radial / reach[:, None], reach - radius
        return Meeting(residual, points - residual[:, None] * normal, normal, ones, ones)
    b = reach * _guarded(dots(radial, across) / reach)
    c = (reach - radius) * (reach + radius)
    square = b**2 - dots(across, across) * c
    residual = c / (b + np.copysign(np.sqrt(np.maximum(square, 0.0)), b))
    foot = radial - residual[:, None] * across
    normal = foot / np.maximum(lengths(foot), 1e-12)[:, None]
    cosine = np.where(square > 0, dots(normal, across), 0.0)
    return Meeting(residual, points - residual[:, None] * rays, normal, _guarded(cosine), cosine)


def _guarded(cosine: Array) -> Array:
    """Keep N.V away from 0, by a limit well below :data:`GRAZING_COSINE`, which affects hardly any point used."""
    return np.copysign(np.maximum(np.abs(cosine), GRAZING_COSINE / 4), cosine)
