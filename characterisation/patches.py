"""Sub-point-clouds of a flat coupon, and the table of their metrics.

Signal chain: cloud of a coupon at a known pose -> discs of constant size in the image that lie wholly on the coupon
-> for each disc F, sigma, distance |V| and the normal N in the view frame -> one row of a table.

A disc that is constant in the image is, on the surface, the talk's ellipse whose long axis grows with tilt: projected
area, number of possible points and included angle stay what they are (slide *Data Collection*, step 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.metrics import ray_noise_std, recovered_fraction
from characterisation.point_cloud import PointCloud, ViewGrid

Floats = NDArray[np.float64]

#: a point farther than this share of |V| from the coupon, along its ray, is a false match: it counts neither as
#: recovered nor as noise. The talk does not say what it did with them; a sensor that invents points must not gain
#: by it. It is wide: 6 mm at 600 mm, where a pixel of disparity is worth 6 mm to an Ensenso N10.
FALSE_SHARE_OF_DISTANCE = 0.01


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
        """The four corners in order, (4, 3) [mm]."""
        along = np.cross(self.normal, self.across)
        half_w, half_h = self.across * self.width / 2, along * self.height / 2
        return np.stack([self.centre + a * half_w + b * half_h for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def view_frame(view: NDArray[np.floating], baseline: NDArray[np.floating]) -> Floats:
    """Axes in which a normal is expressed: z back toward the sensor, x along the baseline, y = z cross x.

    ``view`` (..., 3) directions from the sensor to the surface, ``baseline`` (3,). Returns (..., 3, 3), rows = axes.
    A sensor's two eyes lie on the baseline, so a surface tilted about it behaves unlike one tilted across it.
    """
    z = -np.asarray(view, float) / np.linalg.norm(view, axis=-1, keepdims=True)
    x = baseline - np.einsum("...k,k->...", z, baseline)[..., None] * z
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)


def in_view_frame(normals: Floats, view: Floats, baseline: Floats) -> Floats:
    """Normals (..., 3) of the sensor frame in the view frame; the last component is the cosine of incidence."""
    return np.asarray(np.einsum("...ij,...j->...i", view_frame(view, baseline), normals))


def disc_offsets(radius_px: float) -> NDArray[np.int64]:
    """Pixel offsets (n, 2) as (row, column) of a disc about a pixel."""
    reach = int(np.floor(radius_px))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = rows**2 + columns**2 <= radius_px**2
    return np.asarray(np.stack([rows[inside], columns[inside]], axis=-1))


def patch_centres(
    grid: ViewGrid, coupon: Coupon, radius_px: float, margin_px: float, step_px: float
) -> NDArray[np.int64]:
    """Pixels (p, 2) as (row, column) about which a disc lies on the coupon, ``margin_px`` from its edge.

    Centres stand on a hexagonal lattice with ``step_px`` between neighbours, anchored at the coupon's centre.
    """
    corners = grid.project(coupon.corners())
    middle = grid.project(coupon.centre)
    if not np.isfinite(corners).all():
        return np.empty((0, 2), np.int64)
    reach = np.abs(corners - middle).max()
    count = int(np.ceil(reach / step_px)) + 1
    j, i = np.mgrid[-count * 2 : count * 2 + 1, -count : count + 1]
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
    cloud: PointCloud, coupon: Coupon, radius_px: float = 6.0, margin_px: float = 5.0, step_px: float | None = None
) -> xr.Dataset:
    """Cut a coupon's cloud into discs and measure each.

    Parameters
    ----------
    radius_px
        Radius of the disc [px]; 6 px hold 113 possible points.
    margin_px
        Distance from the disc to the coupon's edge [px]: about one matching block, where the background leaks in.
    step_px
        Between neighbouring centres [px]; the default 2 x radius keeps patches apart and so independent.

    Returns
    -------
    xarray.Dataset
        One row per ``patch``: ``recovered_fraction``, ``points``, ``points_possible``, ``false_fraction`` (points that
        are not on the coupon, over possible ones), ``ray_noise_std`` [mm], its
        ``standard_error``, ``ray_noise_robust``, ``ray_noise_inliers``, ``outlier_share``, ``distance`` [mm],
        ``normal_x`` and ``normal_y``
        (N in the view frame), ``incidence`` [rad], ``off_axis`` [rad].
    """
    centres = patch_centres(cloud.grid, coupon, radius_px, margin_px, step_px or 2 * radius_px)
    offsets = disc_offsets(radius_px)
    rows, columns = (centres[:, None, :] + offsets[None]).transpose(2, 0, 1)
    points = cloud.points[rows, columns].astype(np.float64)
    true = _true_points(points, coupon, cloud.grid)
    false = np.isfinite(points[..., 2]).sum(-1) - true.sum(-1)
    noise = ray_noise_std(np.where(true[..., None], points - cloud.grid.origin, np.nan))

    columns_c, rows_c = centres[:, 1], centres[:, 0]
    grid = cloud.grid
    view = grid.rays_at(columns_c, rows_c)
    # where the ray through the disc's centre meets the coupon, by its known pose: the points may be missing
    distance = ((coupon.centre - grid.origin) @ coupon.normal) / (view @ coupon.normal)
    normal = in_view_frame(np.broadcast_to(coupon.normal, view.shape), view, cloud.baseline)
    possible = np.full(len(centres), len(offsets))
    fraction, low, high = recovered_fraction(noise.count, possible)
    return patch_table(
        recovered_fraction=fraction,
        fraction_low=low,
        fraction_high=high,
        points=noise.count,
        points_possible=possible,
        false_fraction=false / possible,
        ray_noise_std=noise.sigma,
        standard_error=noise.standard_error,
        ray_noise_robust=noise.robust,
        ray_noise_inliers=noise.inlier_sigma,
        outlier_share=noise.outlier_share,
        distance=distance,
        normal_x=normal[:, 0],
        normal_y=normal[:, 1],
        incidence=np.arccos(np.clip(normal[:, 2], -1, 1)),
        off_axis=np.arccos(np.clip(grid.cos_off_axis(view), -1, 1)),
    )


def _true_points(points: Floats, coupon: Coupon, grid: ViewGrid) -> NDArray[np.bool_]:
    """Which points (p, n) lie near the coupon's plane, along their own rays."""
    local = points - grid.origin
    reach = (coupon.centre - grid.origin) @ coupon.normal
    distance = np.linalg.norm(local, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = reach * distance / (local @ coupon.normal)
        return np.asarray(np.abs(distance - expected) <= FALSE_SHARE_OF_DISTANCE * expected)


_UNITS = {
    "ray_noise_std": "mm", "standard_error": "mm", "ray_noise_robust": "mm", "ray_noise_inliers": "mm",
    "distance": "mm", "incidence": "rad", "off_axis": "rad",
}  # fmt: skip


def patch_table(**columns: NDArray[np.generic]) -> xr.Dataset:
    """Assemble the table of patches, each column with its unit."""
    return xr.Dataset({name: ("patch", values, {"units": _UNITS.get(name, "1")}) for name, values in columns.items()})
