"""Flatness and cylindricity: the zone of a low-order form, which noise does not widen without end.

Signal chain: points of a fitted plane or cylinder -> residuals along the rays -> least squares of smooth modes that no
small change of the surface can make -> coefficients, less what noise alone would make of them -> form over the points,
orthogonal to the surface [mm] -> its range.

ISO 1101 asks for the distance of two parallel planes (coaxial cylinders) that enclose the surface. The range of n noisy
points is no estimate of that: it grows as 2 sigma sqrt(2 ln n), 8.6 sigma for 10 000 points, and a sensor's sigma is
often larger than the form of a machined face. ISO 12781-2 and ISO 12180-2 filter the surface first; here a polynomial
of total degree :data:`DEGREE` over the points' own extent is the filter. So the value is

    the peak-to-valley deviation from the least-squares plane (cylinder) of the low-order part of the form

(FLTt of ISO 12781-1, CYLt of ISO 12180-1, each with the least-squares reference, of a low-passed surface). It does not
see anything finer than about a third of the face, nor a part of it that has no points. On a cylinder that is seen from
one side it hardly sees an oval section: over 140 deg of arc the least-squares cylinder follows nine tenths of it. It is
no minimum-zone value, which is smaller.

Modes are orthonormal along the rays, so white noise gives their coefficients c the covariance C = sigma^2 I; noise that
neighbours share adds form that is not there, which only the covariance Q^T S Q of the caller's own noise S can tell
(:func:`form_modes` gives Q). A zone cannot be negative, so noise would make a perfect face show one. Of |c|^2 the share
tr C is expected to be noise; the coefficients are shortened so that their square is without bias,

    c sqrt(max(0, 1 - tr C / |c|^2))

and the uncertainty is taken about these: of a face that shows no more form than its noise it is the root mean square
of the zone that the noise makes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike, NDArray

from characterisation.features.robust_fit import CHOICES, CLIP, FitError, rays_from, robust_std, usable
from characterisation.features.surfaces import GRAZING_COSINE, Cylinder, Plane, tangents

Array = NDArray[np.float64]

#: total degree of the polynomial: an oval cylinder of which less than half is seen differs from a round one at 4
DEGREE = 4

#: modes are left out if less than this share of them remains once a change of the surface is taken from them
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Form:
    """Deviation of a surface from its least-squares plane or cylinder.

    ``modes`` (n, k), orthogonal distance [mm] at n places for each coefficient of 1 mm; ``coefficients`` (k,) [mm];
    ``covariance`` (k, k) [mm^2]; ``residual_std`` [mm] along the rays, of ``count`` points.
    """

    modes: Array
    coefficients: Array
    covariance: Array
    residual_std: float
    count: int

    kind: ClassVar[str] = "form"

    @property
    def parameter_count(self) -> int:
        """Number k of modes."""
        return len(self.coefficients)

    def moved(self, parameters: Array) -> Form:
        """Change the coefficients by the parameters (k,)."""
        return replace(self, coefficients=self.coefficients + parameters)


def zone(form: Form) -> float:
    """Range [mm] of a form over its places."""
    return float(np.ptp(form.modes @ form.coefficients))


def form_modes(surface: Plane | Cylinder, points: Array, rays: Array | None, degree: int = DEGREE) -> Array:
    """Smooth deviations along the rays that no small change of a surface can make.

    Parameters
    ----------
    surface
        On which the points (n, 3) [mm] lie, but for their noise.
    rays
        (n, 3), or None for orthogonal deviations.
    degree
        Of the polynomial in the two coordinates of the surface: on a plane along its tangents, on a cylinder round it
        and along its axis, both scaled to -1..1 over the points.

    Returns
    -------
    (n, k)
        Orthonormal columns Q: coefficients are Q^T residuals, the form along the rays is Q Q^T residuals, and across
        the surface ``slope`` times that (:class:`~characterisation.features.surfaces.Meeting`).

    Raises
    ------
    FitError
        If the points are too few.
    """
    _, jacobian, _ = surface.linearised(np.zeros(surface.parameter_count), points, rays)
    at = surface.meet(points, rays)
    u, v = (_scaled(coordinate) for coordinate in _coordinates(surface, at.foot))
    products = legvander(u, degree)[:, :, None] * legvander(v, degree)[:, None, :]
    first, second = np.nonzero(np.add.outer(np.arange(degree + 1), np.arange(degree + 1)) <= degree)
    smooth = products[:, first, second] / at.slope[:, None]
    if len(points) <= jacobian.shape[1] + smooth.shape[1]:
        needed = jacobian.shape[1] + smooth.shape[1] + 1
        raise FitError(f"{len(points)} points, the form of a {surface.kind} needs at least {needed}")
    rigid, _ = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))
    smooth /= np.linalg.norm(smooth, axis=0)
    for _ in range(2):  # once more for what rounding left
        smooth = smooth - rigid @ (rigid.T @ smooth)
    squares, mixed = np.linalg.eigh(smooth.T @ smooth)
    kept = squares > LEAST_SHARE**2
    modes: Array = smooth @ (mixed[:, kept] / np.sqrt(squares[kept]))
    return modes


def fit_form(
    points: ArrayLike, surface: Plane | Cylinder, viewpoint: ArrayLike | None = None, degree: int = DEGREE
) -> Form:
    """Fit the low-order form of a surface to its points (n, 3) [mm], seen from ``viewpoint`` (3,) [mm] if given.

    ``surface`` is the least-squares surface of the same points (:func:`~characterisation.features.fits.fit_surface`).
    Points at grazing incidence, and outliers about the form, are left out.

    Raises
    ------
    FitError
        If the points are too few.
    """
    points = usable(points, surface.kind, surface.parameter_count)
    rays = rays_from(viewpoint, points)
    at = surface.meet(points, rays)
    facing = np.abs(at.cosine) > GRAZING_COSINE
    kept, deviation = facing, at.residual
    for _ in range(CHOICES):
        chosen = np.flatnonzero(kept)
        modes = form_modes(surface, points[chosen], None if rays is None else rays[chosen], degree)
        coefficients = modes.T @ at.residual[chosen]
        deviation = at.residual[chosen] - modes @ coefficients
        limit = CLIP * robust_std(deviation)
        near = kept.copy()
        near[chosen] = np.abs(deviation) <= limit
        if np.array_equal(near, kept):
            break
        kept = near
    freedom = len(chosen) - surface.parameter_count - modes.shape[1]
    variance = float(deviation @ deviation) / freedom
    square, noise = float(coefficients @ coefficients), variance * modes.shape[1]
    coefficients = coefficients * np.sqrt(max(0.0, 1.0 - noise / max(square, np.finfo(float).tiny)))
    return Form(
        modes * at.slope[chosen, None],
        coefficients,
        variance * np.eye(modes.shape[1]),
        float(np.sqrt(variance)),
        len(chosen),
    )


def _coordinates(surface: Plane | Cylinder, foot: Array) -> tuple[Array, Array]:
    """Places (n,), (n,) on a surface: [mm] on a plane, angle [rad] and [mm] on a cylinder."""
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
