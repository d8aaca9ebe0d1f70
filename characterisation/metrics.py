r"""The two metrics of a sub-point-cloud: how many points there are, and how noisy they are along the view ray.

Signal chain: points of one patch -> plane fitted along the view rays -> residual of each point along its own ray
-> standard deviation sigma with n - 3 degrees of freedom; and points counted / points possible -> recovered
fraction F with a binomial interval.

Both come from the talk (slide *Point Cloud Processing*): rho = lambda^2 n |V|^2 / (A N.V), and P = P_eps + eps V^.

The fit is linear. A point at range t along the unit ray d lies on the plane n.x = c when 1/t = (n/c).d, so the three
unknowns a = n/c follow from weighted linear least squares on inverse range, the weights t^2 turning inverse range
back into mm along the ray. That is the direction in which a 3D camera errs: residuals along the normal would
understate the noise by the cosine of the incidence angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta

Floats = NDArray[np.float64]

#: lost to the plane: three parameters
PLANE_PARAMETERS = 3

#: a point is called an outlier when it lies farther from the plane than this many robust standard deviations;
#: a Gaussian puts 6e-7 of its points there
OUTLIER_SIGMAS = 5.0

_MAD_TO_SIGMA = 1.482602218505602


@dataclass(frozen=True)
class RayNoise:
    """Noise along the view ray of one or many patches; every field is an array over the patches (or a 0-d array).

    ``sigma`` [mm] standard deviation, NaN with fewer than 4 points; ``standard_error`` [mm] of it,
    sigma / sqrt(2 (n - 3)), for independent noise; ``robust`` [mm] from the median absolute deviation;
    ``outlier_share`` [1] beyond 5 robust sigmas; ``inlier_sigma`` [mm] of a second fit without them;
    ``count`` points; ``normal`` (..., 3) of the fitted plane toward the
    sensor; ``distance`` |V| [mm] from the sensor to the plane along the patch's mean ray.
    """

    sigma: Floats
    standard_error: Floats
    robust: Floats
    outlier_share: Floats
    inlier_sigma: Floats
    count: NDArray[np.int64]
    normal: Floats
    distance: Floats


def ray_noise_std(points: NDArray[np.floating]) -> RayNoise:
    """Noise along the view ray of patches of a flat surface.

    Parameters
    ----------
    points
        (..., n, 3) points [mm] seen from the origin (the sensor's optical centre); NaN points are skipped.
    """
    points = np.asarray(points, np.float64)
    present = np.isfinite(points).all(-1)
    count = present.sum(-1)
    filled = np.where(present[..., None], points, 0.0)
    distance = np.linalg.norm(filled, axis=-1)
    ray = filled / np.where(present, distance, 1.0)[..., None]

    inverse, residual, sigma = _fit_and_spread(ray, distance, present)
    enough = count > PLANE_PARAMETERS
    with np.errstate(divide="ignore", invalid="ignore"):
        robust = np.where(enough, _robust_sigma(residual, present), np.nan)
        far = present & (np.abs(residual) > OUTLIER_SIGMAS * robust[..., None])
        inlier_sigma = _fit_and_spread(ray, distance, present & ~far)[2] if far.any() else sigma
        mean_ray = ray.sum(-2) / np.where(count > 0, count, 1)[..., None]
        mean_ray /= np.linalg.norm(mean_ray, axis=-1, keepdims=True)
        normal = -inverse / np.linalg.norm(inverse, axis=-1, keepdims=True)
        return RayNoise(
            sigma=sigma,
            standard_error=sigma / np.sqrt(2.0 * np.where(enough, count - PLANE_PARAMETERS, np.nan)),
            robust=robust,
            outlier_share=np.where(enough, far.sum(-1) / np.maximum(count, 1), np.nan),
            inlier_sigma=inlier_sigma,
            count=count,
            normal=normal,
            distance=1.0 / np.einsum("...k,...k->...", mean_ray, inverse),
        )


def _fit_and_spread(ray: Floats, distance: Floats, present: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Plane, residuals along the rays (NaN where absent), and their standard deviation with n - 3 degrees."""
    inverse = _fit_inverse_plane(ray, distance, present)
    degrees = present.sum(-1) - PLANE_PARAMETERS
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.where(present, distance - 1.0 / np.einsum("...nk,...k->...n", ray, inverse), np.nan)
        total = np.where(present, residual**2, 0.0).sum(-1)
        return inverse, residual, np.sqrt(total / np.where(degrees > 0, degrees, np.nan))


def _fit_inverse_plane(ray: Floats, distance: Floats, present: NDArray[np.bool_]) -> Floats:
    """Plane as a = n/c with 1/t = a.d, (..., 3); NaN where the points do not span a plane."""
    weight = np.where(present, distance, 0.0) ** 2
    inverse_distance = np.where(present, 1.0 / np.where(present, distance, 1.0), 0.0)
    # in coordinates of the patch's own spread the normal equations are well conditioned: the rays of a patch are
    # almost parallel
    count = np.maximum(present.sum(-1), 1)
    centre = ray.sum(-2) / count[..., None]
    spread = np.where(present[..., None], ray - centre[..., None, :], 0.0)
    frame = np.linalg.svd(np.einsum("...ni,...nj->...ij", spread, spread))[2]
    local = np.einsum("...nk,...jk->...nj", ray, frame)
    scale = np.sqrt(np.einsum("...nj,...n->...j", local**2, present.astype(float)) / count[..., None])
    scale = np.where(scale > 0, scale, 1.0)
    design = local / scale[..., None, :] * weight[..., None]
    matrix = np.einsum("...ni,...nj->...ij", design, design)
    vector = np.einsum("...ni,...n->...i", design, inverse_distance * weight)
    solvable = (present.sum(-1) >= PLANE_PARAMETERS) & (np.linalg.cond(matrix) < 1e15)
    safe = np.where(solvable[..., None, None], matrix, np.eye(3))
    solution = np.linalg.solve(safe, vector[..., None])[..., 0] / scale
    out = np.einsum("...j,...jk->...k", solution, frame)
    return np.where(solvable[..., None], out, np.nan)


def _robust_sigma(residual: Floats, present: NDArray[np.bool_]) -> Floats:
    """1.4826 times the median absolute deviation over the last axis; NaN entries are skipped."""

    def masked_median(values: Floats) -> Floats:
        ordered = np.sort(np.where(present, values, np.inf), axis=-1)
        n = present.sum(-1)
        low, high = np.maximum((n - 1) // 2, 0), np.minimum(n // 2, values.shape[-1] - 1)
        pick = np.take_along_axis
        return np.asarray(0.5 * (pick(ordered, low[..., None], -1) + pick(ordered, high[..., None], -1))[..., 0])

    centred = np.abs(residual - masked_median(residual)[..., None])
    return np.asarray(_MAD_TO_SIGMA * masked_median(centred))


def recovered_fraction(
    count: ArrayLike, possible: ArrayLike, confidence: float = 0.95
) -> tuple[Floats, Floats, Floats]:
    """F = points recovered / points possible, with a Clopper-Pearson interval.

    Returns
    -------
    F, low, high
        Arrays in 0..1 (NaN where nothing was possible). The interval takes pixels as independent, which SGBM's
        neighbouring pixels are not: it is a lower bound of the spread.
    """
    n, m = np.asarray(count, float), np.asarray(possible, float)
    if np.any(n > m) or np.any(n < 0):
        raise ValueError("recovered_fraction: more points than are possible, or fewer than none")
    tail = (1.0 - confidence) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(m > 0, n / m, np.nan)
        low = np.where(n > 0, beta.ppf(tail, np.maximum(n, 1e-9), m - n + 1), 0.0)
        high = np.where(n < m, beta.ppf(1 - tail, n + 1, np.maximum(m - n, 1e-9)), 1.0)
    return fraction, np.where(m > 0, low, np.nan), np.where(m > 0, high, np.nan)


def density_fraction(
    count: ArrayLike, area: ArrayLike, distance: ArrayLike, cos_incidence: ArrayLike,
    angular_pitch: float, cos_off_axis: ArrayLike = 1.0,
) -> Floats:  # fmt: skip
    """Rho of the talk, F from density: lambda^2 n |V|^2 / (A N.V), times cos^3(phi).

    Parameters
    ----------
    count, area, distance, cos_incidence
        n [1], patch area A [mm^2], |V| [mm], N.V [1].
    angular_pitch
        lambda [rad], the angle between neighbouring pixels on the axis; lambda^2 is a solid angle per pixel.
    cos_off_axis
        cos(phi) of the patch. A flat imager's pixel covers lambda^2 cos^3(phi): without this factor an ideal sensor
        would score 1.21 at 20 deg off its axis.
    """
    count, area, distance = np.asarray(count, float), np.asarray(area, float), np.asarray(distance, float)
    solid_angle = angular_pitch**2 * np.asarray(cos_off_axis, float) ** 3
    return np.asarray(solid_angle * count * distance**2 / (area * np.asarray(cos_incidence, float)))
