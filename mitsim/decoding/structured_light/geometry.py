"""Compute the depth on a pixel's view ray from a projector coordinate, exactly for distorted lenses on both sides.

Signal chain: raw pixel -> its view ray -> projector coordinate u of points along the ray -> polynomial w(u) for each
pixel, with the inverse depth w = 1/Z.

On one view ray u is a smooth function of w. For pinholes it is (a + b w) / (c + d w), and nearly straight for nearly
parallel axes. The coordinate u is computed exactly, with the distortion of both lenses, at some w between near and far.
These are the Chebyshev points of the interval that the projector reaches. They are computed once for a rig.

The polynomial w(u) through these points is Newton's, with divided differences, so decoding needs no iteration. The
number of points is increased until the error between them is below :data:`TARGET_ERROR_PX`. If no number suffices, as
for strong distortion over a long range, the polynomial is only the start, and :func:`exact_inverse_depth` iterates.

A ray whose coordinate rises and falls with depth has no unique depth, and a pixel beyond the fold of the camera's
distortion has no ray. Both are ``undetermined``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from characterisation.point_cloud import ViewGrid
from mitsim.decoding.blocks import row_bands
from mitsim.decoding.structured_light.newton_polynomial import evaluate, monotony, polynomial
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.distortion_fold import inverse_fold_radii
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import LightCode, axes

#: intended error of the polynomial w(u) against the exact projection [projector px]
TARGET_ERROR_PX = 1e-5

#: largest permitted error of an iterated depth [projector px]: a tenth of the noise of a good phase
MAXIMUM_ERROR_PX = 1e-3

#: numbers of points of the polynomial, in the order of trial, until one reaches the intended error; chosen
_POINT_COUNTS = (6, 8, 10, 13, 16)

#: number of points of a polynomial that is only the start of an iteration; chosen
_START_COUNT = 10

#: largest number of iterations of an exact depth
_ITERATIONS = 12

#: depths on a ray at which the part in the projector's field is searched
_SEARCHED_DEPTHS = 64

#: margin around the projector's field within which a ray still counts as reached, as a share of the field
_FIELD_MARGIN = 0.03

#: least change of the coordinate from near to far [projector px]; a view ray with less does not determine depth
MINIMUM_CHANGE_PX = 0.5


@dataclass(frozen=True)
class StructuredLightGeometry:
    """Geometry of a camera and a projector, computed once."""

    #: ``camera_name``, ``camera``, ``projector``: the camera of the rig, and the projector
    camera_name: str
    camera: Camera
    projector: Camera
    axis: Axis  # axis of the coordinate
    #: ``near``, ``far``: range of depths along the camera's axis [mm]
    near: float
    far: float
    ray: Floats  # (H, W, 3) view ray of each raw pixel in the sensor frame, scaled to a depth of 1
    nodes: Floats  # (K, H, W) coordinates u_k [projector px], which include both ends of the range
    differences: Floats  # (K, H, W) divided differences of w(u) [1/mm/px^k]
    #: (H, W) whether the projector reaches the ray between near and far, and its coordinate determines the depth
    seen: NDArray[np.bool_]
    #: (H, W) whether the lens distortion gives the pixel no ray, or several depths for one coordinate
    undetermined: NDArray[np.bool_]
    exact: bool  # whether the polynomial is only the start of :func:`exact_inverse_depth`
    #: ``grid``, ``baseline``: pixels of the cloud, and unit vector (3,) from the camera to the projector
    grid: ViewGrid
    baseline: Floats


def structured_light_geometry(
    rig: Rig, camera_name: str, code: LightCode | Axis, near_mm: float, far_mm: float
) -> StructuredLightGeometry:
    """Prepare one camera of a rig and its projector for a code.

    If the code has both axes, points are triangulated along the axis with the larger separation of projector and
    camera.

    ``rig``, ``camera_name``: the rig, and the name of the camera in it. ``code``: the code, which determines the axis,
    or the axis itself. ``near_mm``, ``far_mm``: range of depths along the camera's axis [mm]. Raises InputError if the
    rig has no projector, or the code's coordinate changes with depth at no pixel.
    """
    if rig.projector is None:
        raise InputError("rig", "projector", "none", "a calibrated projector, for structured light of one camera")
    camera, projector = rig.cameras[camera_name], rig.projector
    axis = axis_across(camera, projector, (code,) if isinstance(code, str) else axes(code))
    return _prepared(camera_name, camera, projector, axis, near_mm, far_mm)


def offset_from_projector(camera: Camera, projector: Camera) -> Floats:
    """Return the centre (3,) of a camera in the projector's frame [mm]: x across columns, y across rows."""
    return projector.sensor_from_camera.inverse().directions(camera.centre - projector.centre)


def axis_across(camera: Camera, projector: Camera, coded: Sequence[Axis]) -> Axis:
    """Return the axis of the ``coded`` ones across which projector and camera are farther apart."""
    offset = np.abs(offset_from_projector(camera, projector))
    across: Axis = "columns" if offset[0] >= offset[1] else "rows"
    return across if across in coded else coded[0]


@lru_cache(maxsize=1)  # 1 to 2 s for two megapixels, and one study asks several times
def _prepared(
    camera_name: str, camera: Camera, projector: Camera, axis: Axis, near_mm: float, far_mm: float
) -> StructuredLightGeometry:
    """Return the geometry of a camera and a projector for coordinates along ``axis``."""
    component = 0 if axis == "columns" else 1
    rays = camera.rays(camera.pixel_grid())
    with np.errstate(divide="ignore", invalid="ignore"):
        local = rays / rays[..., 2:]
    ray = camera.sensor_from_camera.directions(local)
    finite = np.isfinite(local).all(axis=-1)
    low, high = _depth_limits(camera, projector, ray, near_mm, far_mm)
    seen = (high > low) & finite
    low, high = np.where(seen, low, 1 / far_mm), np.where(seen, high, 1 / near_mm)
    if inverse_fold_radii(projector.distortion, projector.model).any():
        _shorten(camera, projector, ray, low, high, seen)

    def coordinate(inverse_depth: Floats, rays: Floats) -> Floats:
        return _projected_component(projector, camera.centre + rays / inverse_depth[..., None], component)

    # every seventh pixel in both directions suffices to determine the number of points
    sample = np.s_[::7, ::7]
    for count in _POINT_COUNTS:
        nodes, differences = polynomial(coordinate, ray[sample], low[sample], high[sample], count)
        usable = seen[sample] & monotony(nodes, MINIMUM_CHANGE_PX)[0]
        tested = low[sample] + (high - low)[sample] * np.linspace(0.02, 0.98, 2 * count + 1)[:, None, None]
        exact = np.stack([coordinate(w, ray[sample]) for w in tested])
        with np.errstate(all="ignore"):  # pixels that are not usable
            fitted, slope = zip(*(evaluate(nodes, differences, u) for u in exact), strict=True)
            error = np.abs((np.stack(fitted) - tested) / np.stack(slope))[:, usable]
        iterated = not float(error.max(initial=0.0)) < TARGET_ERROR_PX
        if not iterated:
            break
    nodes, differences = polynomial(coordinate, ray, low, high, _START_COUNT if iterated else count)
    monotonic, changes = monotony(nodes, MINIMUM_CHANGE_PX)
    undetermined = ~finite | (seen & ~monotonic & changes)
    seen &= monotonic & changes
    if not seen.any():
        raise InputError(
            "pattern",
            "axis",
            repr(axis),
            "an axis along which the coordinate changes with depth",
            f"no pixel of {camera_name} sees it change by {MINIMUM_CHANGE_PX:g} px from {near_mm:g} to {far_mm:g} mm: "
            "the code changes across the baseline, or the projector lights nothing there",
        )
    baseline = projector.centre - camera.centre
    return StructuredLightGeometry(
        camera_name,
        camera,
        projector,
        axis,
        near_mm,
        far_mm,
        ray,
        nodes,
        differences,
        seen,
        undetermined,
        iterated,
        camera_grid(camera, local),
        baseline / np.linalg.norm(baseline),
    )


def camera_grid(camera: Camera, local: Floats | None = None) -> ViewGrid:
    """Return the grid of a camera's raw pixels.

    ``local`` (H, W, 3): rays of the pixels in the camera's frame, if they are known already.
    """
    pose, K = camera.sensor_from_camera, camera.matrix
    pinhole = ViewGrid(
        float(K[0, 0]),
        float(K[1, 1]),
        float(K[0, 2]),
        float(K[1, 2]),
        camera.width,
        camera.height,
        pose.rotation,
        pose.translation,
    )
    if camera.model == "perspective" and not camera.distortion.any():
        return pinhole
    if local is None:
        local = camera.rays(camera.pixel_grid())
    return replace(pinhole, normalised=(local[..., :2] / local[..., 2:]).astype(np.float32))  # NaN without a ray


def _depth_limits(camera: Camera, projector: Camera, ray: Floats, near: float, far: float) -> tuple[Floats, Floats]:
    """Return the inverse depths (H, W) between which each ray is in range and in the projector's field.

    A point at inverse depth w is along ray + w (camera - projector): each side of the field is linear in w.
    """
    columns = np.concatenate([np.linspace(-0.5, projector.width - 0.5, 33)] * 2 + [np.full(33, -0.5)] * 2)
    columns[-33:] = projector.width - 0.5
    rows = np.concatenate([np.full(33, -0.5)] * 2 + [np.linspace(-0.5, projector.height - 0.5, 33)] * 2)
    rows[33:66] = projector.height - 0.5
    boundary = projector.rays_to_fold(np.stack([columns, rows], axis=-1))
    boundary = boundary[:, :2] / boundary[:, 2:]
    margin = _FIELD_MARGIN * (boundary.max(axis=0) - boundary.min(axis=0))
    lowest, highest = boundary.min(axis=0) - margin, boundary.max(axis=0) + margin

    to_projector = projector.sensor_from_camera.inverse()
    direction, start = to_projector.directions(ray), to_projector.points(camera.centre)
    low, high = (np.full(ray.shape[:2], 1 / depth) for depth in (far, near))
    for side, bound, component in ((1, lowest[0], 0), (-1, highest[0], 0), (1, lowest[1], 1), (-1, highest[1], 1)):
        constant = side * (direction[..., component] - bound * direction[..., 2])
        slope = side * (start[component] - bound * start[2])
        if slope > 0:
            low = np.maximum(low, -constant / slope)
        elif slope < 0:
            high = np.minimum(high, -constant / slope)
        else:
            high = np.where(constant >= 0, high, -np.inf)
    return low, high


def _shorten(
    camera: Camera, projector: Camera, ray: Floats, low: Floats, high: Floats, seen: NDArray[np.bool_]
) -> None:
    """Shorten, in place, the inverse depths of rays that leave the field of a projector whose distortion folds over.

    Such rays pass a corner of the box around the field. They keep the longest part in the image and its margin.
    """
    leaves = np.zeros(seen.shape, bool)

    @np.errstate(invalid="ignore")
    def find(rows: slice) -> None:
        for end in (low, high):
            points = camera.centre + ray[rows] / end[rows][..., None]
            leaves[rows] |= np.isnan(projector.project(points)).any(axis=-1)

    in_threads(find, row_bands(*seen.shape))
    outside = np.nonzero(seen & leaves)
    if not outside[0].size:
        return
    share = np.linspace(0, 1, _SEARCHED_DEPTHS)[:, None]
    tried = low[outside] + (high - low)[outside] * share
    pixels = projector.project(camera.centre + ray[outside] / tried[..., None])
    size = np.array([projector.width, projector.height])
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels > -_FIELD_MARGIN * size) & (pixels < (1 + _FIELD_MARGIN) * size), axis=-1)
    run, longest = np.zeros(inside.shape[1], int), np.zeros(inside.shape[1], int)
    last = np.zeros(inside.shape[1], int)
    for index, row in enumerate(inside):
        run = np.where(row, run + 1, 0)
        last = np.where(run > longest, index, last)
        longest = np.maximum(run, longest)
    ray_number = np.arange(inside.shape[1])
    in_field = longest > 1
    first = np.where(in_field, last - longest + 1, 0)
    low[outside], high[outside] = (
        np.where(in_field, tried[first, ray_number], low[outside]),
        np.where(in_field, tried[last, ray_number], high[outside]),
    )
    seen[outside] = in_field


def exact_inverse_depth(
    geometry: StructuredLightGeometry, ray: Floats, start: Floats, u: Floats
) -> tuple[Floats, Floats]:
    """Return the inverse depth w and dw/du (n,) at which rays have given projector coordinates, by the secant method.

    NaN where the exact projection does not reach ``u`` to :data:`MAXIMUM_ERROR_PX`.

    ``geometry``: camera, projector and axis of the code. ``ray``: (n, 3) from the camera's centre, sensor frame; the
    point is ``ray / w`` from it. ``start``: (n,) first w [1/mm]. ``u``: (n,) coordinates [projector px].
    """
    component = 0 if geometry.axis == "columns" else 1

    def missed(inverse_depth: Floats, chosen: NDArray[np.intp]) -> Floats:
        points = geometry.camera.centre + ray[chosen] / inverse_depth[:, None]
        return _projected_component(geometry.projector, points, component) - u[chosen]

    everywhere = np.arange(len(u))
    with np.errstate(all="ignore"):
        before, w = start * (1 + 1e-5), start.copy()
        error_before, error = missed(before, everywhere), missed(w, everywhere)
        slope = (before - w) / (error_before - error)
        for _ in range(_ITERATIONS):
            active = np.flatnonzero(np.abs(error) > TARGET_ERROR_PX)
            if not active.size:
                break
            moved = w[active] - error[active] * slope[active]
            moved_error = missed(moved, active)
            slope[active] = (moved - w[active]) / (moved_error - error[active])
            w[active], error[active] = moved, moved_error
        exact = np.abs(error) <= MAXIMUM_ERROR_PX
    return np.where(exact, w, np.nan), np.where(exact, slope, np.nan)


def _projected_component(projector: Camera, points: Floats, component: int) -> Floats:
    """Return one coordinate (...) [projector px] of the projections of points (..., 3): 0 is the column, 1 the row."""
    if projector.model == "perspective" and not projector.distortion.any():
        # direct, since OpenCV takes a microsecond for each point even without distortion
        local = projector.sensor_from_camera.inverse().points(points)
        depth = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        return np.asarray(
            projector.matrix[component, component] * (local[..., component] / depth) + projector.matrix[component, 2]
        )
    return projector.project(points)[..., component]
