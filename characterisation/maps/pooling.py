"""Estimate F and sigma with their errors at the nodes of a map, from tables of patches.

Signal chain: patches of many captures at one nominal distance -> Delaunay triangles between the places of their
normals, which show where to interpolate and how far the data are -> a ladder of bandwidths at every node -> local lines
in the place and in ln(|V| / nominal) -> each capture predicted from the others, which shows the noise common to a
capture and the bend of the function -> mean over the ladder, weighted by estimated mean square error.

F is fitted to n / n_possible with n_possible as weight. Sigma is fitted to the variances on a log scale, with their
degrees of freedom as weight (:mod:`characterisation.maps.local_regression`). The place is that of the normal in the
equal-area plane. |V| varies by up to 10 % over a tilted coupon, and sigma is about proportional to its square.
Therefore ln(|V| / nominal) is a regressor of its own, and the value at a node is that at the nominal distance. The
quantity fitted for sigma is the noise along the normal, sigma N_z. Sigma itself increases toward the rim by about 1 /
N_z, which a parabola between distant normals does not follow.

**Nodes with a value.** A node has a value if it lies in the convex hull of the places of the patches. Its smallest
bandwidth follows from the Delaunay triangle that it lies in, its largest from the captures about it.

**Bandwidth.** A wide kernel averages out the noise, but also the bends of the function. Let theta_j be estimates with
radii r_0 < r_1 < ... and standard errors s_j. If a wider one differs from narrower ones by more than noise, the excess
is its bias (after Goldenshluger and Lepski, Ann. Stat. 39 (2011) 1608-1632; the rule for r_0 is Richardson's, for a
bias proportional to r^2):

    b_j^2 = max over i < j of [(theta_i - theta_j)^2 - 3 (s_i^2 - s_j^2)]_+
    b_0^2 = b_1^2 / ((r_1 / r_0)^2 - 1)^2

**Errors.** With scatter S^2 of one patch about the line, variance c^2 common to all patches of a capture, and weights
l_i of the fit,

    s^2 = S^2 sum_i l_i^2 + c^2 sum_captures (sum_i l_i)^2 + kappa g^2

g is the distance to the nearest patch: a line does not show the bend of the function in a gap. c^2 and kappa are chosen
so that they explain the differences between nearby captures and their predictions from the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree
from threadpoolctl import threadpool_limits

from characterisation.coupon.metrics import LEAST_DEGREES
from characterisation.files.arrays import Floats
from characterisation.lambert_projection import inverse_lambert_projection, lambert_projection
from characterisation.maps.local_regression import LocalFit, Observations, Slopes, local_fit

#: least effective number of patches in a kernel, except the widest
LEAST_ROWS = 10

#: smallest radius of the kernel in the equal-area plane, where 0.0175 is about 1 deg: patches are 1 to 2 deg wide
SMALLEST_RADIUS = 0.045

#: number of radii at every node
RUNGS = 4

#: number of captures about a node in the largest radius
CAPTURES = 6

#: c^2 over S^2 where there are too few captures to estimate it; *assumed*
COMMON_SHARE = 0.1

#: least number of captures predicted from others for an estimate of c and kappa
LEAST_CAPTURES = 6

#: number of such captures used for a place
NEIGHBOURS = 20

#: prior slopes per unit of the plane and of ln |V|: F level, within 5 and 1; variance as |V|^4, within 10 and 3; and
#: bends of 0, within 10 and 3. One patch scatters by 0.1 in F and by a factor 1.3 in variance. *Assumed*; the priors
#: matter only where there are too few captures to separate tilt, bend and distance
FRACTION_SLOPES = Slopes((0.0, 0.0, 0.0), (1 / 25, 1 / 25, 1.0), 1 / 100)
VARIANCE_SLOPES = Slopes((0.0, 0.0, 4.0), (0.1, 0.1, 1.0), 1.0)


@dataclass(frozen=True)
class Pooled:
    """F and sigma at q places, NaN outside the hull of the patches.

    ``fraction``, ``fraction_error`` [1]; ``sigma``, ``sigma_error`` [mm], NaN where no point was recovered;
    ``false_fraction`` [1]; ``patches``, the effective number in the mean. Errors are standard errors.
    """

    fraction: Floats
    sigma: Floats
    fraction_error: Floats
    sigma_error: Floats
    false_fraction: Floats
    patches: Floats


def pool(patches: xr.Dataset, nominal: float, positions: Floats) -> Pooled:
    """Estimate F and sigma at ``positions`` (q, 2) of the equal-area plane, from the patches of a sample at one
    distance.

    ``patches`` is a table of :func:`characterisation.coupon.patches.measure_patches` with the column ``orientation``,
    the number of the capture. ``nominal`` is |V| [mm] of the coupon's centre.
    """
    with threadpool_limits(1, user_api="blas"):  # threads slow down thousands of small fits
        return _pool(patches, nominal, positions)


def _pool(patches: xr.Dataset, nominal: float, positions: Floats) -> Pooled:
    rows = _rows(patches, nominal)
    inside, corner = _triangles(rows.position[:, :2], positions)
    if not inside.any():
        return Pooled(*np.full((6, len(positions)), np.nan))
    at = np.column_stack([positions, np.zeros(len(positions))])[inside]
    ladder = _ladder(rows, at[:, :2], corner[inside])
    gap = cKDTree(rows.position[:, :2]).query(at[:, :2])[0]

    count, possible = rows.value[:, 0], rows.weight
    shares = np.column_stack([count / possible, rows.value[:, 1]])
    fractions = replace(rows, value=shares, weight=possible * rows.share)
    fitted = local_fit(fractions, at, ladder, FRACTION_SLOPES)
    floor = _binomial(fitted, float(np.median(possible)))
    common, bend = _common(_predicted(fractions, FRACTION_SLOPES, "identity"), at[:, :2])
    fraction, fraction_error, mixed = _averaged(fitted, ladder, floor, common, bend * gap**2)
    fraction = np.clip(fraction, 0.0, 1.0)
    false = np.clip(np.einsum("qr,qr->q", mixed, np.nan_to_num(fitted.estimate[..., 1])), 0.0, 1.0)
    effective = 1.0 / np.einsum("qr,qr->q", mixed, fitted.independent)

    degrees = np.where(count - 3 >= LEAST_DEGREES, count - 3.0, 0.0) * np.isfinite(rows.value[:, 2])
    use = degrees > 0
    sigma, sigma_error = np.full((2, len(at)), np.nan)
    if use.any():
        along_normal = rows.value[use, 2:] * inverse_lambert_projection(rows.position[use, :2])[:, 2:]
        weight, share = (degrees * rows.share)[use], rows.share[use]
        cluster = np.unique(rows.cluster[use], return_inverse=True)[1].astype(np.int64)
        variances = Observations(rows.position[use], along_normal**2, weight, share, cluster, rows.within[use])
        fitted = local_fit(variances, at, ladder, VARIANCE_SLOPES, "log")
        floor = np.broadcast_to(2.0 / float(np.median(degrees[use])), ladder.shape)
        common, bend = _common(_predicted(variances, VARIANCE_SLOPES, "log"), at[:, :2])
        log_variance, error, _ = _averaged(fitted, ladder, floor, common, bend * gap**2)
        along_ray = np.exp(log_variance / 2) / inverse_lambert_projection(at[:, :2])[:, 2]
        sigma = np.where(fraction > 1e-6, along_ray, np.nan)
        sigma_error = sigma * error / 2
    out = np.full((6, len(positions)), np.nan)
    out[:, inside] = fraction, sigma, fraction_error, sigma_error, false, effective
    return Pooled(*out)


def patch_normals(patches: xr.Dataset) -> Floats:
    """Return N (n, 3) of the patches in the view frame."""
    n_x, n_y = (patches[name].values.astype(float) for name in ("normal_x", "normal_y"))
    return np.stack([n_x, n_y, np.sqrt(np.maximum(1 - n_x**2 - n_y**2, 0))], axis=-1)


def _rows(patches: xr.Dataset, nominal: float) -> Observations:
    """Return the table as observations of (points, false fraction, sigma), sorted by capture."""
    normals, ratio = patch_normals(patches), np.log(patches["distance"].values / nominal)
    capture, possible = patches["orientation"].values, patches["points_possible"].values.astype(float)
    used = np.flatnonzero((possible > 0) & np.isfinite(normals[:, 0]) & np.isfinite(ratio))
    used = used[np.argsort(capture[used], kind="stable")]
    number = np.unique(capture[used], return_inverse=True)[1].astype(np.int64)
    positions = np.column_stack([lambert_projection(normals), ratio])[used]
    columns = [patches[name].values[used].astype(float) for name in ("points", "false_fraction", "ray_noise_inliers")]
    share, within = patches["independent_share"].values[used], np.zeros(len(used))
    return Observations(positions, np.column_stack(columns), possible[used], share, number, within)


def _triangles(vertices: Floats, positions: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Return which positions lie in the hull of the vertices, and their distance from the corners of their triangle."""
    nothing = np.zeros(len(positions), bool), np.full(len(positions), np.nan)
    if len(vertices) < 3:
        return nothing
    try:
        mesh = Delaunay(vertices)
    except QhullError:  # all on a line: the hull has no interior
        return nothing
    triangle = mesh.find_simplex(positions, tol=1e-9)
    corners = vertices[mesh.simplices[np.maximum(triangle, 0)]]
    return triangle >= 0, np.linalg.norm(corners - positions[:, None], axis=-1).max(1)


def _centres(rows: Observations) -> Floats:
    """Return the mean places (c, 3) of the captures."""
    number = np.bincount(rows.cluster)
    return np.column_stack([np.bincount(rows.cluster, axis) / number for axis in rows.position.T])


def _ladder(rows: Observations, at: Floats, corner: Floats) -> Floats:
    """Return radii (q, RUNGS), from the corners of the triangle to the captures about a place."""
    centres = _centres(rows)[:, :2]
    wide = 1.3 * cKDTree(centres).query(at, k=[min(CAPTURES, len(centres))])[0][:, 0]
    # triangles along the hull are long and thin
    narrow = np.maximum(np.minimum(1.5 * corner, wide), SMALLEST_RADIUS)
    wide = np.maximum(wide, 1.5 * narrow)
    return np.asarray(narrow[:, None] * (wide / narrow)[:, None] ** (np.arange(RUNGS) / (RUNGS - 1)))


def _binomial(fitted: LocalFit, possible: float) -> Floats:
    """Return the least variance of one patch's F: binomial, with a point added each way so that F = 1 has an error."""
    share = (np.clip(fitted.estimate[..., 0], 0, 1) * fitted.weight + 1) / (fitted.weight + 2)
    return np.asarray(share * (1 - share) / possible)


@dataclass(frozen=True)
class _Predicted:
    """Errors of predicting captures from the others, one element per capture that lies among them."""

    position: Floats  # (c, 2)
    #: ``squared`` difference, and ``chance``, its expectation from independent patches
    squared: Floats
    chance: Floats
    clustered: Floats  # factor of the variance common to a capture
    gap: Floats  # from the centre of the capture to the nearest other patch


def _predicted(data: Observations, slopes: Slopes, link: Literal["identity", "log"]) -> _Predicted:
    centres = _centres(data)
    inner = np.setdiff1d(np.arange(len(centres)), _rim(centres[:, :2]))
    if len(inner) < LEAST_CAPTURES:
        return _Predicted(np.empty((0, 2)), *(np.empty(0) for _ in range(4)))
    radii = 1.5 * cKDTree(centres[:, :2]).query(centres[inner, :2], k=[CAPTURES])[0]
    other_fit = local_fit(data, centres[inner], radii, slopes, link, inner, "others")
    itself = local_fit(data, centres[inner], radii, slopes, link, inner, "own")
    gap = np.array([_gap(data, centres[c], c) for c in inner])
    squared = (other_fit.estimate[:, 0, 0] - itself.estimate[:, 0, 0]) ** 2
    chance = (other_fit.scatter * other_fit.independent + itself.scatter * itself.independent)[:, 0]
    clustered = (other_fit.clustered + itself.clustered)[:, 0]
    use = np.isfinite(squared) & np.isfinite(chance)
    return _Predicted(centres[inner[use], :2], squared[use], chance[use], clustered[use], gap[use])


def _gap(data: Observations, centre: Floats, cluster: int) -> float:
    """Return the distance from a centre (3,) to the nearest patch that is not of its capture."""
    squared = (data.position[:, 0] - centre[0]) ** 2 + (data.position[:, 1] - centre[1]) ** 2
    squared[data.cluster == cluster] = np.inf
    return math.sqrt(squared.min())


def _common(predicted: _Predicted, at: Floats) -> tuple[Floats, Floats]:
    """Return the variance common to a capture, and that of a bend over g^2, at places (q, 2), from nearby captures.

    Common noise and a bend cannot be distinguished where all gaps are alike. The excess at the smaller half of the gaps
    is attributed to noise. Where there is no larger half, half of the excess is attributed to a bend as well. The
    variance is NaN where there are too few captures.
    """
    number = min(NEIGHBOURS, len(predicted.gap))
    if number < LEAST_CAPTURES:
        return np.full(len(at), np.nan), np.zeros(len(at))
    near = cKDTree(predicted.position).query(at, k=number)[1].reshape(len(at), number)
    excess = (predicted.squared - predicted.chance)[near]
    clustered, gap = predicted.clustered[near], predicted.gap[near]
    middle = np.median(gap, axis=1, keepdims=True)
    small, large = gap <= middle, gap > 1.2 * middle
    common = np.maximum((small * excess).sum(1) / (small * clustered).sum(1), 0.0)
    bend_excess = np.where(large, excess - common[:, None] * clustered, 0.0).sum(1)
    bend_excess /= np.maximum((large * gap**2).sum(1), 1e-12)
    either = excess.sum(1) / np.maximum((gap**2).sum(1), 1e-12) / 2
    bend = np.where(large.sum(1) >= LEAST_CAPTURES, bend_excess, either)
    return common, np.maximum(bend, 0.0)


def _rim(positions: Floats) -> NDArray[np.int64]:
    """Return the captures on the convex hull, which the others can only extrapolate."""
    try:
        return np.asarray(ConvexHull(positions).vertices, np.int64)
    except QhullError:
        return np.arange(len(positions))


def _averaged(
    fitted: LocalFit, ladder: Floats, floor: Floats, common: Floats, bent: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the mean over the ladder (q,), its standard error (q,) and the weights (q, RUNGS)."""
    estimate = fitted.estimate[..., 0]
    # one scatter for all radii, that of the narrowest with enough rows: the weights must not depend on the estimates
    enough = np.where((fitted.rows >= 40).any(1), (fitted.rows >= 40).argmax(1), RUNGS - 1)[:, None]
    scatter = np.take_along_axis(np.maximum(fitted.scatter, floor), enough, axis=1)
    common = np.where(np.isfinite(common), common, COMMON_SHARE * scatter[:, 0])[:, None]
    variance = scatter * fitted.independent + common * fitted.clustered
    bias = np.zeros_like(variance)
    for wide in range(1, RUNGS):
        apart = (estimate[:, :wide] - estimate[:, wide, None]) ** 2
        chance = 3 * np.maximum(variance[:, :wide] - variance[:, wide, None], 0.0)
        bias[:, wide] = np.fmax.reduce(np.maximum(apart - chance, 0.0), axis=1)
    bias[:, 0] = bias[:, 1] / ((ladder[:, 1] / ladder[:, 0]) ** 2 - 1) ** 2
    error = variance + np.nan_to_num(bias)
    with np.errstate(divide="ignore", invalid="ignore"):
        # a line through fewer rows than coefficients depends on the prior more than on the rows
        usable = (fitted.rows >= LEAST_ROWS) | (np.arange(RUNGS) == RUNGS - 1)
        usable &= np.isfinite(error) & np.isfinite(estimate)
        weight = np.where(usable, 1.0 / np.maximum(error, 1e-12) ** 2, 0.0)
        weight /= weight.sum(1, keepdims=True)
        total = np.einsum("qr,qr->q", weight, np.nan_to_num(error)) + bent
        mean = np.einsum("qr,qr->q", weight, np.nan_to_num(estimate))
    return np.where(np.isfinite(weight[:, 0]), mean, np.nan), np.sqrt(total), np.nan_to_num(weight)
