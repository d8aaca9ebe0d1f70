"""Measure F and sigma of one cloud of a flat coupon, from any source.

Signal chain: points (H, W, 3) -> grid of the pixels, given or fitted -> plane through the points, unless the coupon's
pose is known -> discs over the window that the coupon fills -> F and sigma of each disc
(:func:`characterisation.coupon.patches.measure_patches`).

A characterisation campaign knows each coupon's pose. Here the plane is fitted to the cloud itself, so offsets from the
true surface are unknown and the table leaves them out.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.pinhole_grid import PINHOLE_RMS_PX, pinhole_of
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi

#: approximate number of points used to fit the plane of the coupon
_FITTED = 50_000

#: relative enlargement of the fitted rectangle beyond the window, so that rounding loses no disc
_BEYOND = 0.02

#: columns that compare with a known surface, and have no meaning without one
_OF_A_KNOWN_POSE = ("ray_offset", "offset_product_touching", "offset_product_apart")


def patch_metrics(
    points: ArrayLike | PointCloud,
    viewpoint: ArrayLike = (0.0, 0.0, 0.0),
    *,
    grid: ViewGrid | None = None,
    window: tuple[int, int, int, int] | None = None,
    radius_px: float = 6.0,
) -> tuple[Floats, Floats]:
    """Measure coverage F and noise sigma of a flat coupon's cloud, disc by disc.

    :func:`measure_coupon` returns the same with errors, distances and angles of incidence.

    Parameters
    ----------
    points
        (H, W, 3) [mm], one point per sensor pixel, NaN where a pixel has no point; or a :class:`PointCloud`. Axes as in
        a camera: x right, y down, z forward.
    viewpoint
        (3,) [mm], optical centre of the sensor in the frame of the points. The points of a plane cannot reveal a wrong
        viewpoint; it changes sigma by the cosine between the true and the assumed rays.
    grid
        View rays of the pixels. By default, a pinhole at the viewpoint is fitted to the points.
    window
        (column, row, width, height) [px] of the part of the image that the coupon fills. By default, the whole image:
        every pixel without a point then counts as lost.
    radius_px
        Radius of the discs [px]; 6 px hold 113 pixels.

    Returns
    -------
    coverage : (n,) array
        Recovered points over pixels of each disc. A point farther from the plane than 1 % of its distance counts as
        lost.
    sigma : (n,) array
        Standard deviation [mm] along the view ray about a plane fitted to the disc's own points, without outliers. NaN
        where a disc has too few points.

    Raises
    ------
    InputError
        If the array is not (H, W, 3), has too few points for a plane, or matches no pinhole; or if no disc fits into
        the window.

    See Also
    --------
    measure_coupon : a table of all metrics

    Notes
    -----
    F and sigma are defined by Kinnell and Justham, "Task Specific Viewpoint Optimisation" (2018).

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("coupon.ply")
    >>> coverage, sigma = characterisation.patch_metrics(cloud.points, window=(90, 50, 140, 140))
    >>> bool(coverage.mean() > 0.9), bool(sigma.mean() < 2)
    (True, True)
    """
    patches = measure_coupon(points, viewpoint, grid=grid, window=window, radius_px=radius_px)
    return patches["recovered_fraction"].values.astype(float), patches["ray_noise_inliers"].values.astype(float)


def measure_coupon(
    points: ArrayLike | PointCloud,
    viewpoint: ArrayLike = (0.0, 0.0, 0.0),
    *,
    grid: ViewGrid | None = None,
    window: tuple[int, int, int, int] | None = None,
    coupon: Coupon | None = None,
    radius_px: float = 6.0,
    margin_px: float | None = None,
) -> xr.Dataset:
    """Measure a flat coupon's cloud in discs, and return a table of all metrics.

    Parameters
    ----------
    points, viewpoint, grid, window, radius_px
        As of :func:`patch_metrics`.
    coupon
        Known pose and size of the coupon in the frame of the points. By default, a plane is fitted to the points. With
        a known pose the table also has ``ray_offset``, the mean distance [mm] of the points from the known surface.
    margin_px
        Pixels between a disc and the coupon's edge. By default 5 px with ``coupon``, else 0 px, since the window is
        assumed to lie on the coupon.

    Returns
    -------
    xarray.Dataset
        One row per ``patch``: ``recovered_fraction`` F with ``fraction_low`` and ``fraction_high`` (95 %),
        ``ray_noise_inliers`` sigma [mm], ``false_fraction``, ``distance`` |V| [mm], ``incidence`` [rad], ``row`` and
        ``column`` [px], and the other columns of a campaign's ``samples.nc``. ``to_dataframe()`` converts it to a
        pandas table; :func:`overall` pools its rows.

    Raises
    ------
    InputError
        As :func:`patch_metrics`.

    See Also
    --------
    patch_metrics : F and sigma alone

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("coupon.ply")
    >>> patches = characterisation.measure_coupon(cloud, window=(90, 50, 140, 140))
    >>> pooled = characterisation.overall(patches)
    >>> bool(pooled.fraction > 0.9), pooled.sigma < 2
    (True, True)
    """
    cloud = _given(points, viewpoint, grid) if isinstance(points, PointCloud) else _cloud_of(points, viewpoint, grid)
    roi = _checked_window(window, cloud.grid)
    part = _cropped(cloud, roi)
    if margin_px is None:
        margin_px = 0.0 if coupon is None else 5.0
    patches = measure_patches(part, coupon or _coupon_seen(part), radius_px, margin_px)
    if not patches.sizes["patch"]:
        allowed = f"a part of the coupon that holds discs of radius {radius_px:g} px"
        raise InputError("patch_metrics", "window", f"{roi.width} x {roi.height} px, with no disc in it", allowed)
    patches = patches.assign(row=patches["row"] + roi.top, column=patches["column"] + roi.left)
    return patches if coupon is not None else patches.drop_vars(_OF_A_KNOWN_POSE)


def _given(cloud: PointCloud, viewpoint: ArrayLike, grid: ViewGrid | None) -> PointCloud:
    """Return a cloud, which has a viewpoint and a grid of its own."""
    if grid is not None or np.any(np.asarray(viewpoint) != 0):
        found = "a PointCloud, and a viewpoint or a grid"
        raise InputError(
            "patch_metrics", "viewpoint, grid", found, "a PointCloud alone: it has both", "or give its points"
        )
    return cloud


def _cloud_of(points: ArrayLike, viewpoint: ArrayLike, grid: ViewGrid | None) -> PointCloud:
    """Make a cloud of an array of points, on a given grid or on a fitted pinhole."""
    where = "patch_metrics"
    try:
        array, eye = np.asarray(points, float), np.asarray(viewpoint, float)
    except (TypeError, ValueError) as error:
        raise InputError(where, "points, viewpoint", str(error), "arrays of numbers") from None
    if array.ndim != 3 or array.shape[2] != 3:
        hint = "F is the share of pixels that have a point"
        raise InputError(where, "points", f"an array {array.shape}", "(H, W, 3): one point per sensor pixel", hint)
    if eye.shape != (3,) or not np.isfinite(eye).all():
        raise InputError(where, "viewpoint", eye.tolist(), "three numbers [mm]")
    finite = np.isfinite(array).all(axis=-1)
    array = np.where(finite[..., None], array, np.nan)
    if grid is not None and np.any(eye != 0) and not np.allclose(eye, grid.origin, rtol=0, atol=1e-3):
        allowed = f"{grid.origin.tolist()}, the origin of the grid, or none"
        raise InputError(where, "viewpoint", eye.tolist(), allowed)
    if grid is None:
        fitted = pinhole_of(array - eye)
        if fitted is None or fitted.rms > PINHOLE_RMS_PX:
            found = "points that match no pinhole"
            if fitted is not None:
                found = f"points that miss the best pinhole by {fitted.rms:.2g} px"
            raise InputError(
                where,
                "grid",
                found,
                f"points on the rays of a pinhole, within {PINHOLE_RMS_PX:g} px",
                "give the grid of the pixels' rays; or points in camera axes (x right, y down, z forward) "
                "with the camera's optical centre as viewpoint",
            )
        height, width = finite.shape
        grid = ViewGrid(fitted.fx, fitted.fy, fitted.cx, fitted.cy, width, height, origin=eye)
    status = np.where(finite, Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    try:
        return PointCloud(array.astype(np.float32), status, grid, "own", "device")
    except ValueError as error:
        raise InputError(where, "grid", str(error), "a grid of the same size as the points") from None


def _checked_window(window: tuple[int, int, int, int] | None, grid: ViewGrid) -> Roi:
    """Return the checked window, or the whole grid without one."""
    if window is None:
        return Roi.whole(grid.width, grid.height)
    numbers = np.asarray(window)
    if numbers.shape == (4,) and numbers.dtype.kind in "iu":
        roi = Roi(*numbers.tolist())
        if roi.fits(grid.width, grid.height):
            return roi
    allowed = f"(column, row, width, height), whole numbers, within {grid.width} x {grid.height} px"
    raise InputError("patch_metrics", "window", numbers.tolist(), allowed)


def _cropped(cloud: PointCloud, window: Roi) -> PointCloud:
    """Crop a cloud and its grid to a window."""
    points, status, part = cloud.points[window.slices], cloud.status[window.slices], cloud.grid.cropped(window)
    return PointCloud(points, status, part, cloud.sensor, cloud.source, cloud.baseline)


def _coupon_seen(cloud: PointCloud) -> Coupon:
    """Fit a plane to a cloud, and return it as a rectangle that fills the view of its grid.

    The width of the rectangle runs across the tilt, at constant depth, so that no corner lies behind the sensor.
    """
    grid, seen = cloud.grid, cloud.points[cloud.valid].astype(float)
    try:
        plane = fit_plane(seen[:: max(1, len(seen) // _FITTED)], grid.origin)
    except FitError as error:
        raise InputError("patch_metrics", "points", str(error), "points of a flat coupon") from None
    columns, rows = np.array([0, grid.width - 1, grid.width - 1, 0]), np.array([0, 0, grid.height - 1, grid.height - 1])
    rays = grid.rays_at(columns, rows)
    reach = (plane.point - grid.origin) @ plane.normal
    facing = rays @ plane.normal
    if not (facing * reach > 0).all():
        found = "pixels whose rays miss the plane of the points"
        raise InputError("patch_metrics", "window", found, "a window that the coupon fills")
    met = grid.origin + rays * (reach / facing)[:, None]
    axis = grid.rotation[:, 2]
    across = np.cross(plane.normal, axis)
    across = grid.rotation[:, 0] if np.linalg.norm(across) < 1e-6 else across / np.linalg.norm(across)
    across = across - (across @ plane.normal) * plane.normal
    across /= np.linalg.norm(across)
    along = np.cross(plane.normal, across)
    ends = np.array([[np.min(met @ direction), np.max(met @ direction)] for direction in (across, along)])
    middle = ends.mean(axis=1)
    centre = middle[0] * across + middle[1] * along + (plane.point @ plane.normal) * plane.normal
    size = np.ptp(ends, axis=1) * (1 + _BEYOND)
    return Coupon(centre, plane.normal, across, float(size[0]), float(size[1]))
