"""Fit least squares robustly against false points: shared by the fits of surfaces, of figures in a face, and of a pose.

Signal chain: points -> fit of the orthogonal distance with Cauchy's loss, from the nominal geometry -> points within
:data:`CLIP` robust standard deviations and not at grazing incidence -> least squares of the distance along the view
ray, repeated until the selected points no longer change -> covariance sigma^2 (J^T J)^-1.

The covariance holds for independent noise. Decoders that match windows correlate neighbouring points; for their clouds
it is a lower bound.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from characterisation.features.surfaces import GRAZING_COSINE
from characterisation.features.vectors import lengths
from characterisation.files.arrays import MEDIAN_TO_STD

Array = NDArray[np.float64]

#: Residuals beyond this many robust standard deviations are outliers; 0.6 of 10 000 Gaussian ones are.
CLIP = 4.0

#: Standard deviation of normal residuals over the median of their size. More digits would change the bits of fits.
ROUNDED_MEDIAN_TO_STD = round(MEDIAN_TO_STD, 4)

#: Smallest noise that is distinguished from rounding [mm]; float32 rounds points half a metre away to 3e-5 mm.
SMALLEST_SCALE = 1e-6

#: Largest number of selections of the points used.
CHOICES = 10

#: Gauss-Newton steps that select the points and move the shape at once, before a slower and safer solver is used.
STEPS = 20

#: Least ratio of singular values whose squares are distinguished from rounding.
_PLAIN_RANK = 1e-5

#: Least share of the points of a surface that is on each of its sides if both were scanned; chosen.
LEAST_BOTH = 0.25

#: The steps end when the sum of squares decreases by less than this share.
SAME = 1e-12


class FitError(ValueError):
    """These points do not allow the fit; the message gives the reason in a few words."""


class UndeterminedError(FitError):
    """These points do not determine the feature on their own; they may still determine a pose with others."""


class Fitted(Protocol):
    """Shape of a few parameters that can be fitted and changed by them."""

    parameter_count: ClassVar[int]
    kind: ClassVar[str]

    def moved(self, parameters: Array) -> Any:
        """Change the shape by the parameters."""


Shape = TypeVar("Shape", bound=Fitted)

#: Residuals (m,), derivatives (m, p) and N.V (m,) of a shape at parameters (p,), of the chosen points (indices), along
#: their rays or, if False, orthogonal.
Linearised = Callable[[Shape, Array, NDArray[Any], bool], tuple[Array, Array, Array]]


def robust_fit(
    shape: Shape, linearised: Linearised[Shape], count: int, least_scale: float = SMALLEST_SCALE
) -> tuple[Shape, NDArray[np.bool_]]:
    """Return the robust least-squares shape through ``count`` points, and the mask (count,) of the points used.

    - ``shape``: nominal geometry, from which the fit starts.
    - ``linearised``: residuals and derivatives of a changed shape.
    - ``count``: number of points.
    - ``least_scale``: smallest expected standard deviation [mm] of the residuals. Where their distribution has one long
      tail, the median of their size is far below it.

    Raises FitError if all points are at grazing incidence, or they do not determine the shape.
    """
    zero = np.zeros(shape.parameter_count)
    # the orthogonal distance converges from far; two passes, since the first scale is that of the starting geometry
    sample = np.arange(0, count, 1 + count // 4000)  # enough points for a starting value
    for _ in range(2):
        residual, _, _ = linearised(shape, zero, sample, False)
        shape = _solve(shape, linearised, sample, False, "cauchy", max(robust_std(residual), least_scale))
    every = np.arange(count)
    solution = _stepwise(shape, linearised, every, least_scale)
    if solution is not None:
        return solution
    kept = np.zeros(count, bool)
    for _ in range(CHOICES):
        residual, _, cosine = linearised(shape, zero, every, True)
        near = _near(shape, residual, cosine, least_scale)
        if np.array_equal(near, kept):
            break
        kept = near
        shape = _solve(shape, linearised, np.flatnonzero(kept), True, "linear", 1.0)
    return shape, kept


def _near(shape: Fitted, residual: Array, cosine: Array, least_scale: float) -> NDArray[np.bool_]:
    """Return the points (n,) that are used: not at grazing incidence, and within the robust limit."""
    facing = np.abs(cosine) > GRAZING_COSINE
    if facing.sum() <= shape.parameter_count:
        which = f"{len(facing) - facing.sum()} of {len(facing)}" if facing.any() else f"all {len(facing)}"
        raise FitError(f"{which} points are seen at grazing incidence from the sensor, the origin of their frame")
    near = facing & (np.abs(residual) <= CLIP * max(robust_std(residual[facing]), least_scale))
    if near.sum() <= shape.parameter_count:
        raise FitError(f"only {near.sum()} of {len(residual)} points lie on one {shape.kind}")
    return near


def _stepwise(
    shape: Shape, linearised: Linearised[Shape], every: NDArray[Any], least_scale: float
) -> tuple[Shape, NDArray[np.bool_]] | None:
    """Fit least squares along the rays from a close start; return the shape and the points used.

    A Gauss-Newton step needs one pass over the points, and selects them for the next step. A general solver takes many
    times as long for half a million points. A point at the limit can enter and leave the selection in turn without end:
    a selection that returns is kept to the end, as is the last of :data:`STEPS`. Returns None where the steps do not
    converge.
    """
    zero = np.zeros(shape.parameter_count)
    kept, before = np.zeros(len(every), bool), np.inf
    selections, held = set[bytes](), False
    for number in range(STEPS + CHOICES):
        with np.errstate(divide="ignore", invalid="ignore"):  # a degenerate surface gives values that are not finite
            residual, jacobian, cosine = linearised(shape, zero, every, True)
        near = kept if held else _near(shape, residual, cosine, least_scale)
        beyond = np.flatnonzero(~near)
        residual[beyond], jacobian[beyond] = 0.0, 0.0
        square, normal = float(residual @ residual), jacobian.T @ jacobian
        if not np.isfinite(square) or not np.isfinite(normal).all():
            return None
        same = held or np.array_equal(near, kept)
        if same and square > before * (1 + SAME):
            return None
        _check_normal(normal, jacobian, int(near.sum()), shape.kind)
        gradient = jacobian.T @ residual
        norms = np.sqrt(np.diagonal(normal))
        step = -np.linalg.solve(normal / np.outer(norms, norms), gradient / norms) / norms
        shape = shape.moved(step)
        if same and -float(gradient @ step) <= SAME * square:  # the decrease of the sum of squares by this step
            return shape, near
        digest = hashlib.blake2b(np.packbits(near).tobytes(), digest_size=16).digest()
        held = held or (not same and (digest in selections or number >= STEPS))
        selections.add(digest)
        kept, before = near, square
    return None


def _solve(
    shape: Shape, linearised: Linearised[Shape], chosen: NDArray[Any], along_rays: bool, loss: str, scale: float
) -> Shape:
    zero = np.zeros(shape.parameter_count)

    @lru_cache(maxsize=1)  # the solver asks for residuals and derivatives one after the other
    def at(parameters: tuple[float, ...]) -> tuple[Array, Array, Array]:
        return linearised(shape, np.array(parameters), chosen, along_rays)

    check_rank(at(tuple(zero))[1], shape.kind)
    tolerance = 1e-12 if loss == "linear" else 1e-6  # the robust shape is only a starting value
    with np.errstate(divide="ignore", invalid="ignore"):  # a degenerate surface shows in the status
        solution = least_squares(
            lambda parameters: at(tuple(parameters))[0],
            zero,
            jac=lambda parameters: at(tuple(parameters))[1],
            loss=loss,
            f_scale=scale,
            x_scale="jac",
            xtol=tolerance,
            ftol=tolerance,
            gtol=None,
            max_nfev=100,
        )
    if solution.status <= 0 or not np.isfinite(solution.x).all():
        raise FitError(f"{len(chosen)} points that do not determine a {shape.kind} (no convergence)")
    moved: Shape = shape.moved(solution.x)
    return moved


def on_one_side(cosine: Array, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which points (n,) can be on the side of a surface that is seen: the front, or of a bore the back.

    ``cosine`` (n,) is N.V, and ``near`` (n,) tells which points lie on the surface. Outliers that lie on its other side
    would hold a radius. If :data:`LEAST_BOTH` of the points near are on either side, it was scanned all round.
    """
    on_it = cosine[near & (cosine != 0)]
    share = float(np.mean(on_it > 0)) if len(on_it) else 0.5
    if LEAST_BOTH <= share <= 1 - LEAST_BOTH:
        return np.ones(len(cosine), bool)
    return np.asarray((cosine == 0) | ((cosine > 0) == (share > 0.5)))


def covariance_of(residual: Array, jacobian: Array, kind: str) -> tuple[Array, float, int]:
    """Return the covariance sigma^2 (J^T J)^-1 (p, p), sigma with n - p degrees of freedom [mm], and n.

    Raises FitError if the derivatives (n, p) do not determine all parameters.
    """
    count, parameters = jacobian.shape
    normal = jacobian.T @ jacobian
    _check_normal(normal, jacobian, count, kind)
    variance = float(residual @ residual) / (count - parameters)
    norms = np.sqrt(np.diagonal(normal))
    scales = np.outer(norms, norms)
    inverse = np.linalg.inv(normal / scales) / scales
    return variance * inverse, float(np.sqrt(variance)), count


def check_rank(jacobian: Array, kind: str) -> None:
    """Reject derivatives (n, p) that leave a parameter, or a combination of parameters, undetermined."""
    _check_normal(jacobian.T @ jacobian, jacobian, len(jacobian), kind)


def _check_normal(normal: Array, jacobian: Array, count: int, kind: str) -> None:
    """Check the rank of derivatives (n, p) by their products (p, p), and by themselves where these do not tell."""
    norms = np.sqrt(np.diagonal(normal))
    norms = np.where(norms > 0, norms, 1.0)
    squares = np.linalg.eigvalsh(normal / np.outer(norms, norms)) if np.isfinite(norms).all() else norms
    if squares[0] > _PLAIN_RANK**2 * squares[-1]:
        return
    singular = np.linalg.svd(jacobian / norms, compute_uv=False)
    if not np.isfinite(singular).all() or singular[-1] < 1e-7 * singular[0]:
        raise FitError(f"{count} points that do not determine a {kind}")


def usable(points: ArrayLike, kind: str, parameter_count: int) -> Array:
    """Return the rows (n, 3) without NaN; raise FitError unless there are more rows than parameters."""
    array: Array = np.asarray(points, float).reshape(-1, 3)
    array = array[np.isfinite(array).all(axis=1)]
    if len(array) <= parameter_count:
        raise FitError(f"{len(array)} points, a {kind} needs at least {parameter_count + 1}")
    return array


def rays_from(viewpoint: ArrayLike | None, points: Array) -> Array | None:
    """Return unit directions (n, 3) from a viewpoint (3,) to points (n, 3); None without a viewpoint."""
    if viewpoint is None:
        return None
    rays: Array = points - np.asarray(viewpoint, float)
    rays /= lengths(rays)[:, None]
    return rays


def robust_std(residual: Array) -> float:
    """Return the robust standard deviation of residuals about 0 [mm].

    It is 1.4826 median |r|, and at least :data:`SMALLEST_SCALE`.
    """
    sizes, middle = np.abs(residual), len(residual) // 2
    sizes.partition(middle)  # np.median looks for three places
    median = sizes[middle] if len(sizes) % 2 else 0.5 * (sizes[middle] + sizes[:middle].max())
    return max(ROUNDED_MEDIAN_TO_STD * float(median), SMALLEST_SCALE)


def scatter_of(residual: Array, least_scale: float) -> float:
    """Return the robust standard deviation of residuals (n,) about 0 [mm].

    Where most are the same by rounding, it is the root mean square of those within :data:`CLIP` times ``least_scale``.
    """
    robust = robust_std(residual)
    if robust >= least_scale:
        return robust
    return float(np.sqrt(np.mean(residual[np.abs(residual) <= CLIP * least_scale] ** 2)))
