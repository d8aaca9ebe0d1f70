"""Compute the figures in data sheets of depth cameras by the makers' definitions: RealSense, Luxonis, Zivid, Photoneo.

Signal chain: organised clouds of a flat target -> region of interest -> least-squares plane, without extreme points ->
fill rate, Z accuracy, spatial noise, sub-pixel noise, temporal noise, planarity.

They serve to compare a simulated sensor with a data sheet. Each is a number of one target at one distance, mostly white
and perpendicular to the optical axis. F and sigma are functions of distance, normal and finish. The figures differ from
sigma (:mod:`characterisation.coupon.metrics`) in three ways:

- A plane fit over a whole region counts the sensor's warp as noise.
- Distances are perpendicular to the plane or along z instead of along the ray.
- Extreme points are removed first.

Sources, and their reliability:

RealSense
    *Confirmed*: the program rs-depth-quality and its page in librealsense (tools/depth-quality, Apache-2.0). Points
    with the 0.5 % smallest and largest depths are excluded. The plane is one of total least squares (*assumed*).
Luxonis
    *Confirmed*: depth-test_z-acc_spatial-noise in luxonis/depthai-experiments: the same trimming, the cloud rotated so
    that the fitted plane is perpendicular to the axis, medians averaged over captures. The published accuracy tables
    (docs.luxonis.com, depth accuracy) trim 5 % at either end, use the median, and average 10 captures.
Photoneo
    *Confirmed*: temporal noise is the standard deviation of the noise on a diffuse surface of 80 % albedo. The data
    sheet does not say whether over time or over the surface. Its glossary adds "the average distance of the points from
    their average Z", which suggests the surface; sigma is then nearer to it than :func:`temporal_noise`.
Zivid
    *Confirmed* are the meanings (support.zivid.com, Specs Terminology). Point precision is the random noise of one
    point. Local planarity precision is the roughness within a small patch. Global planarity trueness is the systematic
    warp of a large surface. The statistics are *assumed*: see the functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from characterisation.acceptance.vdi_2634 import plane_distances
from characterisation.coupon.patches import Coupon
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud

#: share of the points excluded at either end of the depths (rs-depth-quality, depthai-experiments)
TRIMMED_SHARE = 0.005

#: distance of a least-squares plane over that of its points, below which false matches have turned it on edge; assumed
ON_EDGE = 0.1

#: percentile of |distance from the plane| used as planarity trueness; *assumed*
TRUENESS_PERCENTILE = 95.0

#: the same in the published accuracy tables of Luxonis
PUBLISHED_TRIMMED_SHARE = 0.05

#: side of the patches whose noise is the local planarity precision [px]; *assumed*
PATCH_PX = 9

#: share of the pixels with equal points in all captures from which depths are rounded; chosen: others are never equal
_ALL_EQUAL = 0.01


@dataclass(frozen=True)
class PlaneQuality:
    """Figures of a flat target by the tools of RealSense and Luxonis; NaN where undefined."""

    fill_rate: float  # [%]: pixels with depth over those of the region
    z_accuracy: float  # [% of the distance]: signed, positive when the plane is measured too far
    #: ``plane_fit_rms`` [mm] and ``plane_fit_rms_percent`` [% of the distance]: their spatial noise
    plane_fit_rms: float
    plane_fit_rms_percent: float
    subpixel_rms: float  # [px] of disparity, NaN without a baseline
    points: int  # used


def plane_quality(
    cloud: PointCloud,
    region: NDArray[np.bool_] | None = None,
    ground_truth: Coupon | None = None,
    baseline_mm: float | None = None,
    trimmed_share: float = TRIMMED_SHARE,
) -> PlaneQuality:
    """Return fill rate, Z accuracy and spatial noise of a flat target.

    Let D_i be the signed distance of a point P_i from the fitted plane, and Q_i its foot on the plane. GT and D are the
    distances of the true and the fitted plane from the sensor. b is the baseline and f the focal length [px]. Then

        Z accuracy     = 100 median(D - GT + D_i) / GT
        plane-fit RMS  = sqrt(mean D_i^2)
        sub-pixel RMS  = sqrt(mean (b f / |P_i| - b f / |Q_i|)^2)

    (rs-depth-quality as coded: it divides by the length of P_i where its page says depth. Luxonis' Z accuracy is the
    same, since the cloud is rotated perpendicular to the axis before z is read; its spatial noise is the plane-fit
    RMS.)

    Raises InputError if the region has another shape than the grid or is empty, or an argument is out of range.

    Parameters
    ----------
    cloud, region
        The cloud, and a (H, W) mask all of which must show the target; the whole grid if None.
    ground_truth, baseline_mm, trimmed_share
        True pose of the target; without it, Z accuracy is NaN. b of a stereo sensor. Share of the points excluded at
        either end of the depths.
    """
    where = "plane_quality"
    region = _region(where, cloud, region)
    if not 0 <= trimmed_share < 0.5:
        raise InputError(where, "trimmed_share", trimmed_share, "0 to 0.5")
    if baseline_mm is not None and not baseline_mm > 0:
        raise InputError(where, "baseline_mm", baseline_mm, "a positive length in mm")
    points = cloud.points[region & cloud.valid].astype(float) - cloud.grid.origin
    fill_rate = 100.0 * len(points) / int(region.sum())
    depth = points @ cloud.grid.rotation[:, 2]
    cut = int(trimmed_share * len(points))
    points = points[np.argsort(depth, kind="stable")[cut : len(points) - cut]]
    if len(points) < 4:
        return PlaneQuality(fill_rate, *(np.nan,) * 4, len(points))
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][-1]
    normal = normal if normal @ middle > 0 else -normal
    from_plane = (points - middle) @ normal
    rms = float(np.sqrt(np.mean(from_plane**2)))
    plane_distance = float(normal @ middle)
    if plane_distance < ON_EDGE * float(np.linalg.norm(middle)):
        return PlaneQuality(fill_rate, *(np.nan,) * 4, len(points))
    z_accuracy = subpixel = np.nan
    if ground_truth is not None:
        truth = abs(float((ground_truth.centre - cloud.grid.origin) @ ground_truth.normal))
        z_accuracy = 100.0 * (plane_distance - truth + float(np.median(from_plane))) / truth
    if baseline_mm is not None:
        foot = points - from_plane[:, None] * normal
        inverse = 1.0 / np.linalg.norm(points, axis=1) - 1.0 / np.linalg.norm(foot, axis=1)
        subpixel = baseline_mm * cloud.grid.fx * float(np.sqrt(np.mean(inverse**2)))
    return PlaneQuality(fill_rate, z_accuracy, rms, 100.0 * rms / plane_distance, subpixel, len(points))


def mean_depth_error(
    clouds: Sequence[PointCloud], ground_truth: Coupon, region: NDArray[np.bool_] | None = None
) -> float:
    """Return Luxonis' published depth error [% of the true depth]: medians of z - z_true, averaged over captures.

    5 % of the depths are excluded at either end, and 10 captures are used (docs.luxonis.com, depth accuracy). Their
    board is perpendicular to the axis, and the error is that of its depth. Here each point is compared with the true
    plane along its own ray, which is the same for such a board. ``region`` (H, W) masks the target; None is the whole
    grid. Raises InputError if there is no cloud, or a region does not match one.
    """
    where = "mean_depth_error"
    _check_clouds(where, clouds, 1, "Luxonis takes 10", alike=False)
    medians = []
    for cloud in clouds:
        points = cloud.points[_region(where, cloud, region) & cloud.valid].astype(float) - cloud.grid.origin
        reach = float((ground_truth.centre - cloud.grid.origin) @ ground_truth.normal)
        error = np.sort(100.0 * (points @ ground_truth.normal / reach - 1.0))
        cut = int(PUBLISHED_TRIMMED_SHARE * len(error))
        medians.append(float(np.median(error[cut : len(error) - cut])) if len(error) > 2 * cut else np.nan)
    return float(np.mean(medians))


def temporal_noise(clouds: Sequence[PointCloud]) -> Floats:
    """Return the standard deviation over captures of each pixel's distance along its ray (H, W) [mm].

    It is NaN with fewer than two values. With k captures of a pixel, the divisor is k - 1; rs-depth-quality divides by
    k, with 40 captures. Its figure is the median over the region, ``np.nanmedian(temporal_noise(clouds)[region])``, of
    depth: multiply by the cosine of the angle to the axis. Zivid's point precision is assumed to be this figure
    (*assumed*). Unlike sigma, it contains neither warp nor fixed pattern. Raises InputError if there are fewer than two
    clouds, or their grids differ in size.
    """
    _check_clouds("temporal_noise", clouds, 2, "rs-depth-quality takes 40")
    return _spread([np.linalg.norm(cloud.points - cloud.grid.origin, axis=-1) for cloud in clouds])


def _spread(distances: Sequence[Floats]) -> Floats:
    """Return the standard deviation over captures of distances (...) with NaN."""
    distance = np.stack(distances)
    seen = np.isfinite(distance)
    count = seen.sum(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(seen, distance, 0.0).sum(0) / count
        total = np.where(seen, distance - mean, 0.0) ** 2
        return np.where(count > 1, np.sqrt(total.sum(0) / (count - 1)), np.nan)


def typical_temporal_noise(clouds: Sequence[PointCloud], region: NDArray[np.bool_]) -> float:
    """Return the median of :func:`temporal_noise` [mm] over a region (H, W), unbiased for normal noise.

    The median of few values is lower: by a third for two captures, a ninth for four, under a hundredth for 40. If
    rounding, as to whole mm, made the depths of many pixels equal in all captures, the median may be 0 whatever the
    noise; then it is the root mean square. NaN if no pixel has two points.
    """
    _check_clouds("temporal_noise", clouds, 2, "rs-depth-quality takes 40")
    points = np.stack([cloud.points[region] for cloud in clouds])
    noise = _spread([np.linalg.norm(p - cloud.grid.origin, axis=-1) for p, cloud in zip(points, clouds, strict=True)])
    used = np.isfinite(noise)
    if not used.any():
        return float("nan")
    if np.mean((points == points[0]).all(axis=(0, -1))[used]) > _ALL_EQUAL:
        return float(np.sqrt(np.mean(noise[used] ** 2)))
    freedom = np.sum([cloud.valid[region] for cloud in clouds], axis=0)[used] - 1
    return float(np.median(noise[used] / np.sqrt(chi2.median(freedom) / freedom)))


def local_planarity_precision(cloud: PointCloud, region: NDArray[np.bool_] | None = None) -> float:
    """Return Zivid's local planarity precision [mm]: the median noise about planes fitted to small patches.

    Patches are squares of :data:`PATCH_PX` side that lie in the region and have all points. The noise of a patch is the
    standard deviation of orthogonal distances with n - 3 degrees of freedom. Size, statistic and median are *assumed*.
    The result is NaN if no patch has all points. Raises InputError if the region has another shape than the grid or is
    empty.
    """
    region = _region("local_planarity_precision", cloud, region)
    rows, columns = (side // PATCH_PX for side in region.shape)
    used = np.where((region & cloud.valid)[..., None], cloud.points, np.nan).astype(float)
    tiles = used[: rows * PATCH_PX, : columns * PATCH_PX].reshape(rows, PATCH_PX, columns, PATCH_PX, 3).swapaxes(1, 2)
    patches = tiles.reshape(rows * columns, PATCH_PX**2, 3)
    patches = patches[np.isfinite(patches).all(axis=(1, 2))]
    if not len(patches):
        return float("nan")
    centred = patches - patches.mean(axis=1, keepdims=True)
    # the smallest eigenvalue of the scatter matrix is the sum of squares about the orthogonal plane
    smallest = np.linalg.eigvalsh(centred.swapaxes(1, 2) @ centred)[:, 0]
    return float(np.median(np.sqrt(np.maximum(smallest, 0.0) / (PATCH_PX**2 - 3))))


def global_planarity_trueness(clouds: Sequence[PointCloud], region: NDArray[np.bool_] | None = None) -> float:
    """Return Zivid's global planarity trueness error [mm]: the systematic deviation of a flat target from a plane.

    The clouds of several captures are averaged pixel by pixel, which reduces noise by the square root of their number.
    The result is the :data:`TRUENESS_PERCENTILE` of the absolute distance from the plane through all points. Statistic
    and percentile are *assumed*. The remaining noise is included, so use enough captures. A pixel without a point in
    some capture is excluded. The result is NaN with fewer than 4 points. Raises InputError if there is no cloud, their
    grids differ in size, or the region does not match.
    """
    where = "global_planarity_trueness"
    _check_clouds(where, clouds, 1, "several reduce the noise")
    region = _region(where, clouds[0], region)
    points = sum((cloud.points[region].astype(float) for cloud in clouds), np.zeros(3)) / len(clouds)
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points) < 4:
        return float("nan")
    return float(np.percentile(np.abs(plane_distances(points)), TRUENESS_PERCENTILE))


def _check_clouds(where: str, clouds: Sequence[PointCloud], least: int, hint: str, alike: bool = True) -> None:
    if len(clouds) < least:
        raise InputError(where, "clouds", len(clouds), f"{least} or more", hint)
    if alike and len({cloud.points.shape for cloud in clouds}) > 1:
        raise InputError(where, "clouds", "grids of different sizes", "captures of one sensor with one setting")


def _region(where: str, cloud: PointCloud, region: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    if region is None:
        return np.ones(cloud.status.shape, bool)
    region = np.asarray(region, bool)
    if region.shape != cloud.status.shape:
        raise InputError(where, "region", f"shape {region.shape}", f"{cloud.status.shape}, that of the cloud's grid")
    if not region.any():
        raise InputError(where, "region", "no pixel", "a mask that shows the target")
    return region
