"""Estimate flatness and cylindricity as the zone of a low-order form, which noise does not widen without limit.

Signal chain: points of a fitted plane or cylinder -> residuals along the rays -> least squares of smooth modes that no
small change of the surface can produce -> coefficients, corrected for noise -> form over the points, orthogonal to the
surface [mm] -> its range.

ISO 1101 defines the distance of two parallel planes (coaxial cylinders) that enclose the surface. The range of n noisy
points does not estimate it, because it grows as 2 sigma sqrt(2 ln n): 8.6 sigma for 10 000 points. A sensor's sigma is
often larger than the form deviation of a machined face. ISO 12781-2 and ISO 12180-2 filter the surface first. Here the
filter is a polynomial of total degree :data:`DEGREE` over the extent of the points. The value is therefore

    the peak-to-valley deviation from the least-squares plane (cylinder) of the low-order part of the form

(FLTt of ISO 12781-1, CYLt of ISO 12180-1, each with the least-squares reference, of a low-pass filtered surface).
Limits of the method:

- It does not resolve deviations finer than about a third of the face, nor any part of the face without points. Of a
  labelled cloud that is the margin at its edges, where points mix two surfaces: without 1.2 mm of 60 mm x 80 mm, zones
  of random forms are 6 % too small.
- On a cylinder seen from one side it hardly detects an oval section: over 140 deg of arc, the least-squares cylinder
  follows nine tenths of it.
- It is not a minimum-zone value, which would be smaller.

Modes are orthonormal along the rays, so white noise gives their coefficients c the covariance C = sigma^2 I. Correlated
noise adds apparent form, which requires the covariance Q^T S Q from the caller's noise covariance S (:func:`form_modes`
returns Q).

A zone cannot be negative, so noise would give a perfect face a zone greater than 0. Of |c|^2, the expected contribution
of noise is tr C. The coefficients are shortened so that their square is unbiased,

    c sqrt(max(0, 1 - tr C / |c|^2))

and the uncertainty is the scatter of zones from the shortened coefficients of simulated noise about these
(:func:`zone_uncertainty`). Without the shortening, u of a face with no more form than noise would be twice the error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike, NDArray

from characterisation.features.robust_fit import CHOICES, CLIP, FitError, rays_from, robust_std, usable
from characterisation.features.starts import rounding_scale
from characterisation.features.surfaces import GRAZING_COSINE, Cylinder, Meeting, Plane
from characterisation.features.vectors import tangents

Array = NDArray[np.float64]

#: total degree of the polynomial: an oval cylinder with less than half visible differs from a round one from degree 4
DEGREE = 4

#: nodes in each coordinate at which the heights of a form are kept: a polynomial of degree 4 turns 3 times at most
NODES = 7

#: share (49,) of the points that each node stands for, in any unit: a node at the edge stands for half a cell
NODE_SHARES = np.kron(np.r_[0.5, np.ones(NODES - 2), 0.5], np.r_[0.5, np.ones(NODES - 2), 0.5])

#: points whose extent has shrunk by less than this share keep their polynomials: of 300,000 noisy points of a cylinder,
#: the zone changes by 3e-8 mm; chosen
SAME_EXTENT = 0.01

#: draws of the noise of a form; chosen: they determine u to 4 %
DRAWS = 400

#: places whose range is that of a zone, in each draw; chosen: a form turns 3 times at most
PLACES_OF_ZONE = 10_000

#: modes are excluded if less than this share of them remains after projection off the changes of the surface
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Form:
    """Deviation of a surface from its least-squares plane or cylinder."""

    modes: Array  # (n, k) orthogonal distance [mm] at n positions for each coefficient of 1 mm
    coefficients: Array  # (k,) [mm] and their ``covariance`` (k, k) [mm^2]
    covariance: Array
    residual_std: float  # [mm] along the rays, of ``count`` points
    count: int
    #: ``positions`` (n, 2): coordinates on the surface, -1 to 1 over the points. ``heights`` (n,) [mm] of the form
    #: there before its coefficients are shortened, and ``noise`` [mm], the root mean square of the heights that noise
    #: alone gives. None and NaN for a predicted form
    positions: Array | None = None
    heights: Array | None = None
    noise: float = np.nan

    kind: ClassVar[str] = "form"

    @property
    def parameter_count(self) -> int:
        """Return the number k of modes."""
        return len(self.coefficients)

    def moved(self, parameters: Array) -> Form:
        """Change the coefficients by the parameters (k,)."""
        return replace(self, coefficients=self.coefficients + parameters)


def zone(form: Form) -> float:
    """Return the range [mm] of a form over its places."""
    return float(np.ptp(form.modes @ form.coefficients))


def zone_uncertainty(form: Form) -> float:
    """Return the standard uncertainty [mm] of the zone of a fitted form, by noise of its covariance (JCGM 101)."""
    rng, noise = np.random.default_rng(0), float(np.trace(form.covariance))
    drawn = form.coefficients + rng.multivariate_normal(np.zeros(form.parameter_count), form.covariance, DRAWS)
    modes = form.modes[:: 1 + len(form.modes) // PLACES_OF_ZONE]
    zones = [np.ptp(modes @ _shortened(coefficients, noise)) for coefficients in drawn]
    return float(np.sqrt(np.mean((np.array(zones) - np.ptp(modes @ form.coefficients)) ** 2)))


def _shortened(coefficients: Array, noise: float) -> Array:
    """Return coefficients whose square is unbiased, for a ``noise`` of the trace of their covariance."""
    square = float(coefficients @ coefficients)
    return np.asarray(coefficients * np.sqrt(max(0.0, 1.0 - noise / max(square, np.finfo(float).tiny))))


def node_heights(form: Form) -> Array:
    """Return heights (49, 1) [mm] of a fitted form at the nodes of a grid over its points, then its noise: (50, 1).

    The grid has :data:`NODES` nodes in each coordinate. A node takes the height of the nearest point in its cell, and
    is NaN if there is none.
    """
    assert form.positions is not None and form.heights is not None
    cell = np.clip(np.rint((form.positions + 1) * (NODES - 1) / 2), 0, NODES - 1)
    distance = ((form.positions + 1) * (NODES - 1) / 2 - cell) ** 2 @ np.ones(2)
    nearest = np.argsort(distance, kind="stable")
    number = (cell[nearest] @ [NODES, 1]).astype(int)
    number, first = np.unique(number, return_index=True)
    heights = np.full((NODES**2 + 1, 1), np.nan)
    heights[number, 0] = form.heights[nearest[first]]
    heights[-1] = form.noise
    return heights


def node_modes(kind: str) -> Array:
    """Return forms (49, k) at the nodes that no small change of a ``plane`` or ``cylinder`` produces.

    They are polynomials of total degree :data:`DEGREE`, orthogonal over the area of the face and of equal mean square
    there. Over the nodes, of which most lie at the edge, forms would be flatter at the corners. Changes of a cylinder
    are taken to second order in the angle about its axis.
    """
    nodes = np.linspace(-1, 1, NODES)
    u, v = (grid.ravel() for grid in np.meshgrid(nodes, nodes, indexing="ij"))
    rigid = [(0, 0), (1, 0), (0, 1)] + ([(2, 0), (1, 1)] if kind == "cylinder" else [])
    smooth_degrees = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if (i, j) not in rigid]
    first, second = np.array(smooth_degrees).T
    modes = legvander(u, DEGREE)[:, first] * legvander(v, DEGREE)[:, second]
    return np.asarray(modes * np.sqrt((2 * first + 1) * (2 * second + 1)) / NODES)


def form_modes(surface: Plane | Cylinder, points: Array, rays: Array | None) -> Array:
    """Return the smooth deviations along the rays that no small change of a surface can produce.

    They are polynomials of total degree :data:`DEGREE` in the two coordinates of the surface, both scaled to -1..1 over
    the points: along the tangents of a plane, or round a cylinder and along its axis.

    ``surface``: on which the points (n, 3) [mm] lie, except for their noise. ``points``: (n, 3) [mm]. ``rays``: (n, 3),
    or None for orthogonal deviations. Returns: orthonormal columns Q. Coefficients are Q^T residuals; the form along
    the rays is Q Q^T residuals, and orthogonal to the surface ``slope`` times that
    (:class:`~characterisation.features.surfaces.Meeting`). Raises FitError if there are too few points.
    """
    rows, rigid = _rows(surface, _Points.of(surface, points, rays, surface.meet(points, rays), slice(None)))
    modes: Array = (_combined(rows @ rows.T, rigid).T @ rows).T
    return modes


@dataclass(frozen=True)
class _Points:
    """Points (n, 3) [mm] and their ``rays`` (n, 3), with where these meet a surface.

    ``coordinates`` are (2, n) on the surface, by :func:`_coordinates`; residual and slope (n,) those of
    :class:`~characterisation.features.surfaces.Meeting`.
    """

    points: Array
    rays: Array | None
    residual: Array
    slope: Array
    coordinates: Array

    @classmethod
    def of(cls, surface: Plane | Cylinder, points: Array, rays: Array | None, at: Meeting, selection: Any) -> _Points:
        """Return some of the points (n, 3), chosen by mask or slice, of which all meet a surface."""
        rays, coordinates = None if rays is None else rays[selection], _coordinates(surface, at.foot[selection])
        return cls(points[selection], rays, at.residual[selection], at.slope[selection], np.array(coordinates))

    def among(self, selection: NDArray[np.bool_]) -> _Points:
        """Return the chosen points."""
        rays = None if self.rays is None else self.rays[selection]
        return _Points(
            self.points[selection],
            rays,
            self.residual[selection],
            self.slope[selection],
            self.coordinates[:, selection],
        )

    def are_wider(self, selection: NDArray[np.bool_]) -> bool:
        """Return whether the points extend farther than a selection of them."""
        extent, less = (np.ptp(values, axis=1) for values in (self.coordinates, self.coordinates[:, selection]))
        return bool((less < (1 - SAME_EXTENT) * extent).any())


def _rows(surface: Plane | Cylinder, at: _Points) -> tuple[Array, int]:
    """Return deviations (k, n) along the rays: those of small changes of a surface, then smooth ones.

    The number of the former comes second. They are orthonormal, and the smooth ones have norm 1.
    """
    _check_count(surface, len(at.points))
    _, jacobian, _ = surface.linearised(np.zeros(surface.parameter_count), at.points, at.rays)
    along_u, along_v = (np.ascontiguousarray(legvander(_scaled(values), DEGREE).T) for values in at.coordinates)
    rigid, _ = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))
    first, second = np.nonzero(np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= DEGREE)
    rows = np.empty((rigid.shape[1] + len(first), len(at.points)))
    rows[: rigid.shape[1]] = rigid.T
    for row, i, j in zip(rows[rigid.shape[1] :], first, second, strict=True):
        np.multiply(along_u[i], along_v[j], out=row)
        row /= at.slope
        row /= np.linalg.norm(row)
    return rows, rigid.shape[1]


def _combined(products: Array, rigid: int) -> Array:
    """Return the combinations (k, m) of rows that are orthonormal modes, of which no rigid row is a part.

    ``products`` (k, k) are the scalar products of the rows over the points; the first ``rigid`` rows are those of small
    changes of the surface. So modes over fewer points need no other rows.
    """
    projected = np.linalg.lstsq(products[:rigid, :rigid], products[:rigid, rigid:], rcond=None)[0]
    scale = np.sqrt(np.diag(products)[rigid:])
    left = (products[rigid:, rigid:] - products[rigid:, :rigid] @ projected) / np.outer(scale, scale)
    squares, mixed = np.linalg.eigh(left)
    kept = squares > LEAST_SHARE**2
    smooth = mixed[:, kept] / np.sqrt(squares[kept]) / scale[:, None]
    return np.concatenate([-projected @ smooth, smooth])


def _check_count(surface: Plane | Cylinder, count: int) -> None:
    """Raise FitError if points are too few for the form of a surface."""
    needed = surface.parameter_count + (DEGREE + 1) * (DEGREE + 2) // 2 + 1
    if count < needed:
        raise FitError(f"{count} points, the form of a {surface.kind} needs at least {needed}")


def fit_form(points: ArrayLike, surface: Plane | Cylinder, viewpoint: ArrayLike | None = None) -> Form:
    """Fit the low-order form of a surface.

    Points at grazing incidence, and outliers about the form, are excluded.

    ``points``: (n, 3) [mm] of the surface. ``surface``: least-squares surface of the same points
    (:func:`~characterisation.features.fits.fit_surface`). ``viewpoint``: (3,) [mm]; without it, residuals are
    orthogonal. Raises FitError if there are too few points.
    """
    points = usable(points, surface.kind, surface.parameter_count)
    rays = rays_from(viewpoint, points)
    at = surface.meet(points, rays)
    facing = np.abs(at.cosine) > GRAZING_COSINE
    if facing.sum() <= surface.parameter_count:
        raise FitError(f"only {facing.sum()} of {len(points)} points are not seen at grazing incidence")
    among = _Points.of(surface, points, rays, at, facing)
    near, rows = np.ones(len(among.points), bool), np.empty((0, 0))
    least_scale = rounding_scale(points, surface)
    for _ in range(CHOICES):
        if not rows.size or among.are_wider(near):
            among, near = among.among(near), np.ones(int(near.sum()), bool)
            rows, rigid = _rows(surface, among)
            products, right = rows @ rows.T, rows @ among.residual
        chosen, gone = near, rows[:, ~near]
        _check_count(surface, int(chosen.sum()))
        combined = _combined(products - gone @ gone.T, rigid)
        coefficients = combined.T @ (right - gone @ among.residual[~chosen])
        deviation = among.residual - (combined @ coefficients) @ rows
        near = chosen & (np.abs(deviation) <= CLIP * max(robust_std(deviation[chosen]), least_scale))
        if np.array_equal(near, chosen):
            break
    deviation, slope = deviation[chosen], among.slope[chosen]
    modes = slope[:, None] * (combined.T @ rows[:, chosen]).T
    count = modes.shape[1]
    variance = float(deviation @ deviation) / (len(deviation) - surface.parameter_count - count)
    noise = variance * count
    return Form(
        modes,
        _shortened(coefficients, noise),
        variance * np.eye(count),
        float(np.sqrt(variance)),
        len(deviation),
        np.column_stack([_scaled(values) for values in among.coordinates[:, chosen]]),
        modes @ coefficients,
        float(np.sqrt(noise / len(deviation) * np.mean(slope**2))),
    )


def _coordinates(surface: Plane | Cylinder, foot: Array) -> tuple[Array, Array]:
    """Return coordinates (n,), (n,) on a surface: [mm] on a plane, angle [rad] and [mm] on a cylinder."""
    if isinstance(surface, Plane):
        first, second = ((foot - surface.point) @ tangents(surface.normal).T).T
        return first, second
    local = foot - surface.point
    first, second = (local @ tangents(surface.axis).T).T
    # about the middle of the points, so that the seam lies opposite
    middle = np.arctan2(second.mean(), first.mean())
    angle = (np.arctan2(second, first) - middle + np.pi) % (2 * np.pi) - np.pi
    return angle, local @ surface.axis


def _scaled(coordinate: Array) -> Array:
    low, high = coordinate.min(), coordinate.max()
    scaled: Array = 2 * (coordinate - low) / max(high - low, 1e-12) - 1
    return scaled
