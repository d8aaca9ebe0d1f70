"""Compute the two metrics of a patch: the recovered fraction F of its points, and their noise sigma along the view ray.

Signal chain for sigma: points of one patch -> plane fitted along the view rays -> residual of each point along its own
ray -> standard deviation sigma, with n - 3 degrees of freedom.

Signal chain for F: recovered points / possible points -> recovered fraction F -> binomial interval. The number of
possible points is counted in pixels, computed from the calibrated pitch lambda, or measured on a matt-white reference.

Both metrics come from the talk of Kinnell and Justham, "Task Specific Viewpoint Optimisation" (2018), slide *Point
Cloud Processing*: rho = lambda^2 n |V|^2 / (A N.V), and P = P_eps + eps V^.

The fit is linear. A point at range t along the unit ray d lies on the plane n.x = c if 1/t = (n/c).d. The three
unknowns a = n/c therefore follow from linear least squares on inverse range. The weights t^2 convert inverse range back
into mm along the ray. A 3D camera errs along the ray: residuals along the normal would understate the noise by the
cosine of the incidence angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from characterisation.files.arrays import MEDIAN_TO_STD, Floats

#: degrees of freedom that the fit of a plane takes
PLANE_PARAMETERS = 3

#: patches with fewer degrees of freedom are excluded from a pooled sigma
LEAST_DEGREES = 10

#: an outlier lies farther from the plane than this many robust standard deviations, as 6e-7 of Gaussian points do
OUTLIER_SIGMAS = 5.0

#: smallest 1 - r^2 for which a plane is fitted, r being the correlation of the coordinates; 0 for points on a line
_SMALLEST_DETERMINANT = 1e-10


@dataclass(frozen=True)
class RayNoise:
    """Noise along the view ray of one or many patches; every field is an array over the patches (or a 0-d array)."""

    sigma: Floats  # [mm]: standard deviation, NaN with fewer than 4 points
    standard_error: Floats  # [mm] of sigma, sigma / sqrt(2 (n - 3)), for independent noise
    robust: Floats  # [mm]: standard deviation from the median absolute deviation
    outlier_share: Floats  # [1]: share of points beyond 5 robust standard deviations, and 5 steps of depths in steps
    inlier_sigma: Floats  # [mm]: standard deviation of a second fit without outliers
    count: NDArray[np.int64]  # number of points
    normal: Floats  # (..., 3) normal of the fitted plane, toward the sensor
    distance: Floats  # |V| [mm] from the sensor to the plane along the mean ray of the patch
    #: (..., n) [mm] along the rays from the plane of the second fit, NaN for outliers and missing points
    inlier_residual: Floats


def ray_noise_std(points: NDArray[np.floating]) -> RayNoise:
    """Measure the noise along the view ray of patches of a flat surface.

    P = P_eps + eps V^ and sigma^2 = sum of eps^2 / (n - 3). P is a measured point, P_eps the point of the fitted plane
    on the same ray (talk of Kinnell and Justham, 2018, slide *Point Cloud Processing*). ``points`` (..., n, 3) [mm] are
    seen from the origin (the optical centre of the sensor); NaN points are skipped.
    """
    points = np.asarray(points, np.float64)
    shape = points.shape[:-2]
    # coordinates before points in memory, so that every sum runs along the last axis
    coordinates = np.ascontiguousarray(points.reshape(-1, *points.shape[-2:]).swapaxes(1, 2))
    present = np.asarray(np.isfinite(coordinates).all(1))
    coordinates[~np.broadcast_to(present[:, None], coordinates.shape)] = 0.0
    count = present.sum(-1)
    distance = np.sqrt((coordinates**2).sum(1))
    mean_ray = (coordinates / np.where(present, distance, 1.0)[:, None]).sum(-1)
    length = np.linalg.norm(mean_ray, axis=-1, keepdims=True)
    mean_ray = np.where(length > 0, mean_ray / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])

    inverse, residual, sigma = _fit_and_spread(coordinates, distance, present, mean_ray)
    enough = count > PLANE_PARAMETERS
    with np.errstate(divide="ignore", invalid="ignore"):
        robust = np.where(enough, _robust_sigma(residual, present), np.nan)
        scale = np.maximum(robust, _depth_step(coordinates[:, 2], present))
        far = present & (np.abs(residual) > OUTLIER_SIGMAS * scale[:, None])
        inlier_sigma, inlier_residual = sigma.copy(), residual
        again = far.any(-1)
        if again.any():
            near = (present & ~far)[again]
            inliers = np.where(near[:, None], coordinates[again], 0.0), np.where(near, distance[again], 0.0)
            inlier_residual = residual.copy()
            _, inlier_residual[again], inlier_sigma[again] = _fit_and_spread(*inliers, near, mean_ray[again])
        fields = RayNoise(
            sigma=sigma,
            standard_error=sigma / np.sqrt(2.0 * np.where(enough, count - PLANE_PARAMETERS, np.nan)),
            robust=robust,
            outlier_share=np.where(enough, far.sum(-1) / np.maximum(count, 1), np.nan),
            inlier_sigma=inlier_sigma,
            count=count,
            normal=-inverse / np.linalg.norm(inverse, axis=-1, keepdims=True),
            distance=1.0 / (mean_ray * inverse).sum(-1),
            inlier_residual=inlier_residual,
        )
    return RayNoise(**{name: values.reshape(shape + values.shape[1:]) for name, values in vars(fields).items()})


def _fit_and_spread(
    coordinates: Floats, distance: Floats, present: NDArray[np.bool_], mean_ray: Floats
) -> tuple[Floats, Floats, Floats]:
    """Fit planes a = n/c (p, 3) along the rays; return them, the residuals (p, n), and their standard deviations (p,).

    All are NaN where the points span no plane. ``coordinates`` (p, 3, n) and ``distance`` (p, n) are 0 where
    ``present`` is false.
    """
    # axes across and along the mean ray of the patch: its rays are almost parallel, so in other axes the normal
    # equations would be nearly singular. A row is t (d t) . a = t, which is 1/t = a.d with the weight t^2
    frame = _frame(mean_ray)
    local = frame @ coordinates
    rows = local * distance[:, None]
    matrix = rows @ rows.swapaxes(1, 2)
    vector = (rows * distance[:, None]).sum(-1)
    scale = np.sqrt(np.einsum("pkk->pk", matrix))
    scale = np.where(scale > 0, scale, 1.0)
    matrix /= scale[:, :, None] * scale[:, None, :]
    solvable = (present.sum(-1) >= PLANE_PARAMETERS) & (np.linalg.det(matrix) > _SMALLEST_DETERMINANT)
    matrix[~solvable] = np.eye(3)
    solution = np.linalg.solve(matrix, (vector / scale)[:, :, None])[..., 0] / scale
    solution[~solvable] = np.nan
    degrees = present.sum(-1) - PLANE_PARAMETERS
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = distance - distance / (solution[:, None] @ local)[:, 0]
        residual[~present] = np.nan
        total = np.where(present, residual**2, 0.0).sum(-1)
        return (solution[:, None] @ frame)[:, 0], residual, np.sqrt(total / np.where(degrees > 0, degrees, np.nan))


def _frame(axis: Floats) -> Floats:
    """Return right-handed frames (p, 3, 3), last row ``axis`` (Duff et al., J. Comput. Graph. Tech. 6 (2017) 1)."""
    x, y, z = axis.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x**2 * a, sign * b, -sign * x], axis=-1)
    return np.stack([first, np.stack([b, sign + y**2 * a, -y], axis=-1), axis], axis=1)


def _depth_step(depth: Floats, present: NDArray[np.bool_]) -> Floats:
    """Return the step (p,) of depths (p, n) of which most are equal to another, inf for a single depth, 0 for others.

    A median deviation of such depths is 0, or says nothing.
    """
    gaps = np.diff(np.sort(np.where(present, depth, np.inf), axis=-1))
    between = (gaps > 0) & np.isfinite(gaps)
    in_steps = 2 * (between.sum(-1) + 1) <= present.sum(-1)
    return np.where(in_steps, np.min(gaps, axis=-1, where=between, initial=np.inf), 0.0)


def _robust_sigma(residual: Floats, present: NDArray[np.bool_]) -> Floats:
    """Return 1.4826 times the median absolute deviation over the last axis; NaN entries are skipped."""

    def masked_median(values: Floats) -> Floats:
        ordered = np.sort(np.where(present, values, np.inf), axis=-1)
        n = present.sum(-1)
        low, high = np.maximum((n - 1) // 2, 0), np.minimum(n // 2, values.shape[-1] - 1)
        pick = np.take_along_axis
        return np.asarray(0.5 * (pick(ordered, low[..., None], -1) + pick(ordered, high[..., None], -1))[..., 0])

    centred = np.abs(residual - masked_median(residual)[..., None])
    return np.asarray(MEDIAN_TO_STD * masked_median(centred))


def recovered_fraction(
    count: ArrayLike, possible: ArrayLike, confidence: float = 0.95
) -> tuple[Floats, Floats, Floats]:
    """Return F = recovered points / possible points, and the ends of its Clopper-Pearson interval.

    F is that of the talk's slide *Point Cloud Processing*: density of recovered points over maximum possible density.
    ``possible`` need not be whole. All three are in 0..1, NaN where no point was possible. The interval assumes
    independent pixels; those of SGBM are not, so its width is a lower bound of the spread.
    """
    n, m = np.asarray(count, float), np.asarray(possible, float)
    if np.any(n > m) or np.any(n < 0):
        raise ValueError("recovered_fraction: count must lie between 0 and possible")
    tail = (1.0 - confidence) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(m > 0, n / m, np.nan)
        low = np.where(n > 0, betaincinv(np.maximum(n, 1e-9), m - n + 1, tail), 0.0)
        high = np.where(n < m, betaincinv(n + 1, np.maximum(m - n, 1e-9), 1 - tail), 1.0)
    return fraction, np.where(m > 0, low, np.nan), np.where(m > 0, high, np.nan)


def clipped(fraction: ArrayLike) -> tuple[Floats, Floats]:
    """Return F limited to at most 1, and the excess over 1.

    A density can exceed 1 by about 1 / sqrt(n) because whole pixels are counted on a given area. A larger excess means
    that lambda, the pose or the reference is wrong.
    """
    fraction = np.asarray(fraction, float)
    return np.minimum(fraction, 1.0), np.maximum(fraction - 1.0, 0.0)


def density_fraction(
    count: ArrayLike,
    area: ArrayLike,
    distance: ArrayLike,
    cos_incidence: ArrayLike,
    angular_pitch: float,
    cos_off_axis: ArrayLike = 1.0,
) -> Floats:
    """Return F from point density and calibrated lambda, the talk's rho: lambda^2 n |V|^2 / (A N.V), times cos^3(phi).

    It can exceed 1: see :func:`clipped`. n is ``count``, A ``area`` [mm^2], |V| ``distance`` [mm], N.V
    ``cos_incidence``; lambda [rad] is ``angular_pitch``, between neighbouring pixels on the axis. A pixel of a flat
    imager covers lambda^2 cos^3(phi): without this factor an ideal sensor would reach 1.21 at 20 deg off its axis.
    """
    count, area, distance = np.asarray(count, float), np.asarray(area, float), np.asarray(distance, float)
    solid_angle = angular_pitch**2 * np.asarray(cos_off_axis, float) ** 3
    return np.asarray(solid_angle * count * distance**2 / (area * np.asarray(cos_incidence, float)))


def reference_fraction(
    count: ArrayLike, reference_count: ArrayLike, possible: ArrayLike
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return F relative to the points of an ideal, matt-white surface at the same place (the talk's second definition).

    Also return the ends of its 95 % interval, limited to at most 1 as F is, and the excess of F over 1. All are NaN
    where the reference has no point. Both counts are random, each out of ``possible`` pixels. The interval of their
    ratio comes from the Clopper-Pearson intervals of both (Donner and Zou, Stat. Methods Med. Res. 21 (2012) 347-359,
    *recalled*; the tests check its coverage).
    """
    theta, low, high = recovered_fraction(count, possible)
    theta_0, low_0, high_0 = recovered_fraction(reference_count, possible)
    product = theta * theta_0
    with np.errstate(divide="ignore", invalid="ignore"):
        below = np.sqrt(np.maximum(product**2 - low * high_0 * (2 * theta - low) * (2 * theta_0 - high_0), 0.0))
        above = np.sqrt(np.maximum(product**2 - high * low_0 * (2 * theta - high) * (2 * theta_0 - low_0), 0.0))
        # the published quotient of (product - below), rearranged to avoid cancellation
        lower = np.where(theta > 0, low * (2 * theta - low) / (product + below), 0.0)
        upper = np.minimum((product + above) / (low_0 * (2 * theta_0 - low_0)), 1.0)
        covered = theta_0 > 0
        fraction, excess = clipped(np.where(covered, theta / theta_0, np.nan))
    return fraction, np.where(covered, np.minimum(lower, fraction), np.nan), np.where(covered, upper, np.nan), excess
