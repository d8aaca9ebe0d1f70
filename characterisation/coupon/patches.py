"""Divide the cloud of a flat coupon into patches, and return the table of their metrics.

Signal chain: cloud of a coupon at a known pose -> discs of constant size in the image that lie wholly on the coupon ->
for each disc F, sigma, distance |V| and the normal N in the view frame -> one row of a table.

A disc of constant size in the image is an ellipse on the surface, which follows the tilt (talk of Kinnell and Justham,
2018, slide *Data Collection*, step 3). Across the tilt its radius is r lambda |V|; along the tilt it is r lambda |V| /
(N.V). Projected area and number of possible points do not change with the tilt.

The included angle is the widest angle between two view rays of the patch. Of all figures of one area, a disc has the
smallest diameter, so no patch with as many points has a smaller included angle. That of a round piece of the surface
with as many points is larger by the factor 1 / sqrt(N.V).

Discs may overlap (``step_px`` less than twice the radius). Each row therefore has an ``independent_share``, its weight
in a pooled mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.coupon import metrics
from characterisation.coupon.discs import disc_offsets, independent_share
from characterisation.coupon.metrics import ray_noise_std
from characterisation.coupon.offsets import known_offset, neighbour_products
from characterisation.coupon.patch_table import patch_table
from characterisation.coupon.view_frame import in_view_frame
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, PointCloud, ViewGrid

#: radius of a patch [px]: 113 possible points; chosen
RADIUS_PX = 6.0

#: distance of a patch from the edge of the coupon [px]: about one matching block; chosen
MARGIN_PX = 5.0


@dataclass(frozen=True)
class Coupon:
    """A flat rectangular sample in the sensor frame.

    ``centre`` (3,) [mm]; ``normal`` (3,) unit, toward the sensor; ``across`` (3,) unit, along the width; ``width`` and
    ``height`` [mm].
    """

    centre: Floats
    normal: Floats
    across: Floats
    width: float
    height: float

    def corners(self) -> Floats:
        """Return the four corners in order, (4, 3) [mm]."""
        along = np.cross(self.normal, self.across)
        half_w, half_h = self.across * self.width / 2, along * self.height / 2
        return np.stack([self.centre + a * half_w + b * half_h for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def outline(grid: ViewGrid, coupon: Coupon) -> Floats:
    """Return the corners (k, 2) [px], in order, of the part of a coupon in front of the sensor; none if all is behind.

    The part nearer than a thousandth of the farthest corner's depth is left out: it is outside any image.
    """
    corners = coupon.corners()
    depth = (corners - grid.origin) @ grid.rotation[:, 2]
    if (depth > 0).all():
        return grid.project(corners)
    before = depth - 1e-3 * max(float(depth.max()), 0.0)
    kept = []
    for here, there, a, b in zip(corners, np.roll(corners, -1, axis=0), before, np.roll(before, -1), strict=True):
        kept += [here] if a > 0 else []
        kept += [here + a / (a - b) * (there - here)] if a * b < 0 else []
    return grid.project(np.array(kept)) if kept else np.empty((0, 2))


def patch_centres(
    grid: ViewGrid, coupon: Coupon, radius_px: float, margin_px: float, step_px: float
) -> NDArray[np.int64]:
    """Return pixels (p, 2) as (row, column) about which a disc lies on the coupon, ``margin_px`` from its edge.

    The centres form a hexagonal lattice with ``step_px`` between neighbours, anchored at the centre of the coupon.
    """
    corners, middle = outline(grid, coupon), grid.project(coupon.centre)
    if not len(corners) or not (np.isfinite(corners).all() and np.isfinite(middle).all()):
        return np.empty((0, 2), np.int64)
    low, high = np.maximum(corners.min(axis=0), 0.0), np.minimum(corners.max(axis=0), [grid.width, grid.height])
    if (low > high).any():
        return np.empty((0, 2), np.int64)
    spacing = step_px * np.array([1.0, np.sqrt(3) / 2])
    first, last = np.floor((low - middle) / spacing) - 1, np.ceil((high - middle) / spacing) + 1
    i, j = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
    lattice = np.stack([(i + 0.5 * (j % 2)) * step_px, j * step_px * np.sqrt(3) / 2], axis=-1).reshape(-1, 2)
    centres = np.rint(middle + lattice).astype(np.int64)

    clearance = radius_px + margin_px
    edges = np.roll(corners, -1, axis=0) - corners
    outward = np.stack([edges[:, 1], -edges[:, 0]], axis=-1)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    outward *= np.sign(np.einsum("ek,ek->e", outward, corners - middle))[:, None]
    within = (centres >= clearance).all(1) & (centres[:, 0] < grid.width - clearance)
    within &= centres[:, 1] < grid.height - clearance
    depth_inside = -np.einsum("pek,ek->pe", centres[:, None, :] - corners[None], outward).max(axis=1)
    return np.asarray(centres[within & (depth_inside >= clearance)][:, ::-1])


def measure_patches(
    cloud: PointCloud,
    coupon: Coupon,
    radius_px: float = RADIUS_PX,
    margin_px: float = MARGIN_PX,
    step_px: float | None = None,
    angular_pitch: float | None = None,
    reference: PointCloud | None = None,
) -> xr.Dataset:
    """Divide the cloud of a coupon into discs, and measure each.

    Raises InputError if both ``angular_pitch`` and ``reference`` are given, ``reference`` has another grid, the coupon
    is no rectangle, or a size in pixels or the pitch is none.

    Parameters
    ----------
    cloud, coupon
        Organised cloud of the coupon; its pose and size, sensor frame.
    radius_px, margin_px, step_px
        Radius of the disc; 6 px hold 113 possible points. Distance from the disc to the edge of the coupon: about one
        matching block, within which the background affects the result. Distance between neighbouring centres; the
        default, 2 x radius, keeps patches apart and so independent.
    angular_pitch
        Lambda [rad] of the sensor, from its calibration. With it, the number of possible points follows from the area
        of the patch on the surface. Without it, that is the number of pixels of the disc, which is the same if the grid
        of the cloud is the sensor's own. Give it for a resampled cloud.
    reference
        Cloud of a matt-white coupon at the same pose, on the same grid. Its points are then the possible ones. Give
        either this or ``angular_pitch``.

    Returns
    -------
    xarray.Dataset
        One row per ``patch``. F: ``recovered_fraction`` with ``fraction_low`` and ``fraction_high`` (95 %, independent
        pixels), ``fraction_clipped`` (excess over 1 before F was limited to 1), ``points``, ``points_possible``,
        ``false_fraction`` (points that are not on the coupon, over the pixels of the disc).

        Sigma: ``ray_noise_std`` [mm], its ``standard_error`` for independent noise, ``ray_noise_robust``,
        ``ray_noise_inliers``, ``outlier_share``.

        Offsets: ``ray_offset`` [mm], mean distance of the inliers along their rays from the known surface, and its mean
        products with the offsets of neighbours, ``offset_product_touching`` and ``offset_product_apart`` [mm^2]
        (:mod:`characterisation.coupon.offsets`).

        Place: ``row``, ``column`` [px], ``distance`` [mm], ``normal_x`` and ``normal_y`` (N in the view frame),
        ``incidence`` [rad], ``off_axis`` [rad], ``included_angle`` [rad], ``semi_major`` and ``semi_minor`` [mm] of the
        ellipse on the surface, ``independent_share``.
    """
    _check_sizes(coupon, radius_px, margin_px, step_px)
    _check_possible(cloud, angular_pitch, reference)
    centres = patch_centres(cloud.grid, coupon, radius_px, margin_px, step_px or 2 * radius_px)
    offsets = disc_offsets(radius_px)
    pixels = _pixels(cloud, centres, radius_px)
    points, true = _points_of(cloud, coupon, pixels)
    false = np.isfinite(points[..., 2]).sum(-1) - true.sum(-1)
    noise = ray_noise_std(np.where(true[..., None], points, np.nan))

    grid = cloud.grid
    rows, columns = centres.T
    view = grid.rays_at(columns, rows)
    reach = float((coupon.centre - grid.origin) @ coupon.normal)
    offset = known_offset(points, np.isfinite(noise.inlier_residual), coupon.normal, reach)
    touching, apart = neighbour_products(offset, centres, radius_px)
    # distance to the coupon along the ray through the centre of the disc, from the known pose: points may be missing
    distance = reach / (view @ coupon.normal)
    normal = in_view_frame(np.broadcast_to(coupon.normal, view.shape), view, cloud.baseline)
    cos_off_axis = grid.cos_off_axis(view)
    ellipse = _ellipses(grid, coupon, rows, columns, radius_px)
    if reference is not None:
        possible = _points_of(reference, coupon, pixels)[1].sum(-1).astype(float)
        fraction, low, high, excess = metrics.reference_fraction(noise.count, possible, len(offsets))
    elif angular_pitch is not None:
        area = ellipse["area_per_pixel"] * len(offsets)
        full = metrics.density_fraction(len(offsets), area, distance, normal[:, 2], angular_pitch, cos_off_axis)
        possible = len(offsets) / full
        fraction, excess = metrics.clipped(noise.count / possible)
        _, low, high = metrics.recovered_fraction(np.minimum(noise.count, possible), possible)
    else:
        possible = np.full(len(centres), len(offsets))
        fraction, low, high = metrics.recovered_fraction(noise.count, possible)
        excess = np.zeros(len(centres))
    return patch_table(
        recovered_fraction=fraction,
        fraction_low=low,
        fraction_high=high,
        fraction_clipped=excess,
        points=noise.count,
        points_possible=possible,
        false_fraction=false / len(offsets),
        ray_noise_std=noise.sigma,
        standard_error=noise.standard_error,
        ray_noise_robust=noise.robust,
        ray_noise_inliers=noise.inlier_sigma,
        outlier_share=noise.outlier_share,
        ray_offset=offset,
        offset_product_touching=touching,
        offset_product_apart=apart,
        row=rows,
        column=columns,
        distance=distance,
        normal_x=normal[:, 0],
        normal_y=normal[:, 1],
        incidence=np.arccos(np.clip(normal[:, 2], -1, 1)),
        off_axis=np.arccos(np.clip(cos_off_axis, -1, 1)),
        included_angle=ellipse["included_angle"],
        semi_major=ellipse["semi_major"],
        semi_minor=ellipse["semi_minor"],
        independent_share=independent_share(centres, radius_px),
    )


def patch_residuals(cloud: PointCloud, coupon: Coupon) -> Floats:
    """Return the residuals [mm] along V of the points of each patch from its plane: (patches, pixels of a disc).

    They are NaN for outliers and pixels without a point. The patches are those of :func:`measure_patches` by default.
    """
    pixels = _pixels(cloud, patch_centres(cloud.grid, coupon, RADIUS_PX, MARGIN_PX, 2 * RADIUS_PX), RADIUS_PX)
    points, true = _points_of(cloud, coupon, pixels)
    return ray_noise_std(np.where(true[..., None], points, np.nan)).inlier_residual


#: largest radius, margin and step [px]; chosen: more than any image has
_MOST_PX = 10_000

#: what measures patches, in messages
_WHERE = "measure_patches"


def _check_sizes(coupon: Coupon, radius_px: float, margin_px: float, step_px: float | None) -> None:
    if not 1 <= radius_px <= _MOST_PX:
        raise InputError(_WHERE, "radius_px", radius_px, f"1 to {_MOST_PX} px", "6 px hold 113 points")
    if not 0 <= margin_px <= _MOST_PX:
        raise InputError(_WHERE, "margin_px", margin_px, f"0 to {_MOST_PX} px", "5 px keep the background out")
    if step_px is not None and not 1 <= step_px <= _MOST_PX:
        raise InputError(_WHERE, "step_px", step_px, f"1 to {_MOST_PX} px", "twice radius_px keeps patches apart")
    for name in ("width", "height"):
        if not 0 < (size := getattr(coupon, name)) < np.inf:
            raise InputError(_WHERE, f"coupon.{name}", size, "a length above 0 [mm]")
    axes = np.stack([coupon.normal, coupon.across])
    if not (np.abs(axes @ axes.T - np.eye(2)) < 1e-3).all():
        raise InputError(_WHERE, "coupon", f"normal and across {axes.tolist()}", "perpendicular vectors of length 1")
    if not np.isfinite(coupon.centre).all():
        raise InputError(_WHERE, "coupon.centre", coupon.centre.tolist(), "three numbers [mm]")


def _check_possible(cloud: PointCloud, angular_pitch: float | None, reference: PointCloud | None) -> None:
    if angular_pitch is not None and not 0 < angular_pitch < np.inf:
        raise InputError(_WHERE, "angular_pitch", angular_pitch, "a positive angle in rad")
    if reference is None:
        return
    if angular_pitch is not None:
        hint = "each gives the number of possible points"
        raise InputError(_WHERE, "reference", "angular_pitch and reference", "only one of them", hint)
    if not reference.grid.same_rays(cloud.grid):
        found, allowed = (f"{grid.width} x {grid.height} px" for grid in (reference.grid, cloud.grid))
        hint = "capture the reference with the same settings of the sensor"
        raise InputError(_WHERE, "reference", f"a grid of {found}", f"the grid of the cloud, {allowed}", hint)


def _pixels(cloud: PointCloud, centres: NDArray[np.int64], radius_px: float) -> NDArray[np.int64]:
    """Return the flat pixel numbers (p, n) of discs about pixels (p, 2)."""
    row_and_column = np.array([cloud.grid.width, 1])
    return np.asarray((centres @ row_and_column)[:, None] + disc_offsets(radius_px) @ row_and_column)


def _points_of(cloud: PointCloud, coupon: Coupon, pixels: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
    """Return points (p, n, 3) relative to the grid's origin at flat pixel numbers, and which lie near the coupon."""
    points = cloud.points.reshape(-1, 3)[pixels] - cloud.grid.origin
    reach = (coupon.centre - cloud.grid.origin) @ coupon.normal
    with np.errstate(invalid="ignore", divide="ignore"):
        # along one ray, distance is proportional to height above the sensor: expected / distance = reach / (p.n)
        expected_share = reach / (points @ coupon.normal)
        return points, np.abs(1.0 - expected_share) <= FALSE_SHARE_OF_DISTANCE * expected_share


def _ellipses(
    grid: ViewGrid, coupon: Coupon, rows: NDArray[np.int64], columns: NDArray[np.int64], radius_px: float
) -> dict[str, Floats]:
    """Return ellipses on the coupon, and included angles, from the steps of surface and rays about pixels (p,)."""
    reach = int(radius_px)
    aside, down = reach * np.array([[1], [-1], [0], [0]]), reach * np.array([[0], [0], [1], [-1]])
    rays = grid.rays_at(columns + aside, rows + down)
    surface = rays * ((coupon.centre - grid.origin) @ coupon.normal / (rays @ coupon.normal))[..., None]

    def semi_axes(projected: Floats) -> tuple[Floats, Floats]:
        right, down = (projected[0] - projected[1]) / (2 * reach), (projected[2] - projected[3]) / (2 * reach)
        a, b, c = (right**2).sum(-1), (right * down).sum(-1), (down**2).sum(-1)
        root = np.hypot((a - c) / 2, b)
        return radius_px * np.sqrt((a + c) / 2 + root), radius_px * np.sqrt(np.maximum((a + c) / 2 - root, 0.0))

    major, minor = semi_axes(surface)
    return {
        "semi_major": major,
        "semi_minor": minor,
        "area_per_pixel": major * minor / radius_px**2,
        "included_angle": 2.0 * semi_axes(rays)[0],
    }
