"""Least squares that false points cannot pull: what the fits of surfaces, of figures in a face and of a pose share.

Signal chain: points -> fit of the orthogonal distance with Cauchy's loss, from the nominal geometry -> points within
:data:`CLIP` robust standard deviations that are not seen at grazing incidence -> least squares of the distance along
the view ray, until the same points remain -> covariance sigma^2 (J^T J)^-1.

The covariance holds for noise that is independent from point to point. Decoders that match windows correlate their
neighbours; for their clouds it is a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from characterisation.features.surfaces import GRAZING_COSINE

Array = NDArray[np.float64]

#: Residuals beyond this many robust standard deviations are outliers; of 10 000 Gaussian ones 0.6 are lost.
CLIP = 4.0

#: Standard deviation of normal residuals over the median of their size.
MEDIAN_TO_STD = 1.4826

#: Smallest noise that is told from rounding [mm]; float32 points half a metre away are rounded to 3e-5 mm.
SMALLEST_SCALE = 1e-6

#: Times that the points which are used are chosen anew.
CHOICES = 10

#: Gauss-Newton steps from a start that is near, before the trust region of scipy's solver takes over.
STEPS = 8

#: A descent of the sum of squares by less than this share is its end.
SAME = 1e-12


class FitError(ValueError):
    """Something cannot be fitted to these points; the message says why in a few words."""


class Fitted(Protocol):
    """What can be fitted: a shape of a few parameters, changed by them."""

    parameter_count: ClassVar[int]
    kind: ClassVar[str]

    def moved(self, parameters: Array) -> Any:
        """Change by the parameters."""


Shape = TypeVar("Shape", bound=Fitted)

#: Residuals (m,), derivatives (m, p) and N.V (m,) of a shape at parameters (p,), of the chosen points (indices), along
#: their rays or, if False, orthogonal.
Linearised = Callable[[Shape, Array, NDArray[Any], bool], tuple[Array, Array, Array]]


def robust_fit(
    shape: Shape, linearised: Linearised[Shape], count: int, least_scale: float = SMALLEST_SCALE
) -> tuple[Shape, NDArray[np.bool_]]:
    """Return the robust least-squares shape through ``count`` points and the mask (count,) of those it rests on.

    ``least_scale`` [mm] is the smallest standard deviation that the residuals are expected to have; where their
    distribution has one long tail, the median of their size is far below it.

    Raises
    ------
    FitError
        If all points are seen at grazing incidence, or they do not determine the shape.
    """
    zero = np.zeros(shape.parameter_count)
    # the orthogonal distance converges from far; twice, since the first scale is that of the starting geometry
    some = np.arange(0, count, 1 + count // 4000)  # enough for a start
    for _ in range(2):
        residual, _, _ = linearised(shape, zero, some, False)
        shape = _solve(shape, linearised, some, False, "cauchy", max(robust_std(residual), least_scale))
    every = np.arange(count)
    kept = np.zeros(count, bool)
    for _ in range(CHOICES):
        residual, jacobian, cosine = linearised(shape, zero, every, True)
        facing = np.abs(cosine) > GRAZING_COSINE
        if not facing.any():
            raise FitError(f"all {count} points are seen at grazing incidence")
        near = facing & (np.abs(residual) <= CLIP * max(robust_std(residual[facing]), least_scale))
        if np.array_equal(near, kept):
            break
        kept = near
        if kept.sum() <= shape.parameter_count:
            raise FitError(f"only {kept.sum()} of {count} points lie on one {shape.kind}")
        shape = _descended(shape, linearised, np.flatnonzero(kept), residual[kept], jacobian[kept])
    return shape, kept


def _descended(
    shape: Shape, linearised: Linearised[Shape], chosen: NDArray[Any], residual: Array, jacobian: Array
) -> Shape:  # fmt: skip
    """Least squares along the rays from a start that is near, with its residuals and derivatives of the chosen points.

    A Gauss-Newton step costs one pass over the points; a solver that must be ready for anything takes ten times as
    long over half a million. Where the steps do not descend, that solver it is.
    """
    check_rank(jacobian, shape.kind)
    start, square = shape, float(residual @ residual)
    for _ in range(STEPS):
        norms = np.linalg.norm(jacobian, axis=0)
        triangle: Array = np.asarray(np.linalg.qr(np.column_stack([jacobian / norms, residual]), mode="r"))
        count = len(norms)
        step = -solve_triangular(triangle[:count, :count], triangle[:count, count]) / norms
        moved = shape.moved(step)
        with np.errstate(divide="ignore", invalid="ignore"):  # a step toward a degenerate surface is not a descent
            residual, jacobian, _ = linearised(moved, np.zeros(count), chosen, True)
        before, square = square, float(residual @ residual)
        if not square <= before * (1 + SAME) or not np.isfinite(jacobian).all():
            break
        shape = moved
        if before - square <= SAME * before:
            return shape
    return _solve(start, linearised, chosen, True, "linear", 1.0)


def _solve(
    shape: Shape, linearised: Linearised[Shape], chosen: NDArray[Any], along_rays: bool, loss: str, scale: float
) -> Shape:  # fmt: skip
    zero = np.zeros(shape.parameter_count)
    check_rank(linearised(shape, zero, chosen, along_rays)[1], shape.kind)
    tolerance = 1e-12 if loss == "linear" else 1e-6  # the robust shape is only a start
    with np.errstate(divide="ignore", invalid="ignore"):  # a step toward a degenerate surface shows in the status
        solution = least_squares(
            lambda parameters: linearised(shape, parameters, chosen, along_rays)[0], zero,
            jac=lambda parameters: linearised(shape, parameters, chosen, along_rays)[1],
            loss=loss, f_scale=scale, x_scale="jac", xtol=tolerance, ftol=tolerance, gtol=None, max_nfev=100,
        )  # fmt: skip
    if solution.status <= 0 or not np.isfinite(solution.x).all():
        raise FitError(f"{len(chosen)} points that do not determine a {shape.kind} (no convergence)")
    moved: Shape = shape.moved(solution.x)
    return moved


def covariance_of(residual: Array, jacobian: Array, kind: str) -> tuple[Array, float, int]:
    """Covariance sigma^2 (J^T J)^-1 (p, p), sigma with n - p degrees of freedom [mm], and n.

    Raises
    ------
    FitError
        If the derivatives (n, p) do not determine all parameters.
    """
    check_rank(jacobian, kind)
    count, parameters = jacobian.shape
    variance = float(residual @ residual) / (count - parameters)
    norms = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.inv((jacobian / norms).T @ (jacobian / norms)) / np.outer(norms, norms)
    return variance * inverse, float(np.sqrt(variance)), count


def check_rank(jacobian: Array, kind: str) -> None:
    """Refuse derivatives (n, p) that leave a parameter, or a combination of some, undetermined."""
    norms = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / np.where(norms > 0, norms, 1.0), compute_uv=False)
    if not np.isfinite(singular).all() or singular[-1] < 1e-7 * singular[0]:
        raise FitError(f"{len(jacobian)} points that do not determine a {kind}")


def usable(points: ArrayLike, kind: str, parameter_count: int) -> Array:
    """Rows (n, 3) without NaN; at least one more than the parameters."""
    array: Array = np.asarray(points, float).reshape(-1, 3)
    array = array[np.isfinite(array).all(axis=1)]
    if len(array) <= parameter_count:
        raise FitError(f"{len(array)} points, a {kind} needs at least {parameter_count + 1}")
    return array


def rays_from(viewpoint: ArrayLike | None, points: Array) -> Array | None:
    """Unit directions (n, 3) from a viewpoint (3,) to points (n, 3); None without one."""
    if viewpoint is None:
        return None
    rays: Array = points - np.asarray(viewpoint, float)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


def robust_std(residual: Array) -> float:
    """Robust standard deviation of residuals about 0 [mm]: 1.4826 median |r|, at least :data:`SMALLEST_SCALE`."""
    return max(MEDIAN_TO_STD * float(np.median(np.abs(residual))), SMALLEST_SCALE)
