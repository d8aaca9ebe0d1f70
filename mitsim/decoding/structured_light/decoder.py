"""Decode structured light: the images of one camera, a code and a calibration to an organised point cloud.

Signal chain: images [DN] -> projector column u (or row) seen by each raw pixel -> depth on the pixel's view ray whose
exact projection has that u (:mod:`mitsim.decoding.structured_light.geometry`) -> points in the sensor frame [mm], and
their expected noise along the ray.

The images are neither rectified nor undistorted before the phase is known, since interpolated images have blurred
phases. The cloud's grid therefore carries the rays of the raw pixels (``normalised`` of :class:`ViewGrid`).

Each pixel is decoded from its own grey levels. A region of interest therefore has the same points as in the whole
image, up to its edge. Only a gamma that is estimated from the images (``correct_gamma``) is then that of the region.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.decoding.blocks import in_blocks
from mitsim.decoding.grey_levels import MeasuredNoise, check_full_scale
from mitsim.decoding.grid_cloud import cloud_on_grid
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.structured_light.geometry import (
    StructuredLightGeometry,
    exact_inverse_depth,
)
from mitsim.decoding.structured_light.gray_code import (
    STRIPE_IMAGES,
    CodedAxis,
    decode_gray_code,
    decode_gray_fringes,
)
from mitsim.decoding.structured_light.newton_polynomial import evaluate
from mitsim.decoding.structured_light.phase_shift import Fringes, decode_fringes
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.camera import Camera
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, LightCode, axes, check_stack, roles


def decode_coordinates(  # noqa: PLR0913 - options, all by name
    stack: NDArray[np.generic],
    code: LightCode,
    size: tuple[int, int],
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
    interpolate: bool = False,
    only: Axis | None = None,
) -> dict[Axis, ProjectorCoordinate]:
    """Return the projector coordinates seen by each pixel, for each axis of any code.

    Along each axis, the images are those of Gray bits, of fringes, or of both; the roles of the images tell which.

    - ``stack``: (P, H, W) raw images [DN] of one camera, in the order of :func:`mitsim.sensor.light_code.roles`.
    - ``code``, ``settings``: the code, and the limits of the decoder.
    - ``size``, ``full_scale``: width and height of the projector [px], and value of a saturated pixel [DN].
    - ``imager``: the imager, or measured noise, from which the expected noise follows; None if neither is known.
    - ``interpolate``: for a Gray code without fringes: interpolate columns along rows between the edges of their
      stripes, instead of taking the stripes' centres.
    - ``only``: the axis to decode; None for all of the code.

    Raises InputError if the stack does not fit the code, or the code is ambiguous over the projector.
    """
    image_roles = roles(code, *size)
    check_stack(stack, image_roles)
    check_full_scale(stack, full_scale)
    coordinates: dict[Axis, ProjectorCoordinate] = {}
    for axis in axes(code):
        if only not in (None, axis):
            continue
        extent = size[0] if axis == "columns" else size[1]
        shared = [i for i, role in enumerate(image_roles) if role.axis in (axis, None) and role.kind in STRIPE_IMAGES]
        phases = [i for i, role in enumerate(image_roles) if role.axis == axis and role.kind == "phase"]
        phases.sort(key=lambda i: image_roles[i].index)  # stable: period after period, each in the order shown
        used = shared + phases
        images = stack if used == list(range(len(stack))) else stack[used]
        axis_roles = [image_roles[i] for i in used]
        gray = [role for role in axis_roles if role.kind == "gray"]
        coded_axis = CodedAxis(axis, extent, min(role.period for role in gray), gray[0].offset) if gray else None
        if isinstance(code, GrayCode) or not phases:
            assert coded_axis is not None
            saturated = (stack if isinstance(code, GrayCode) else images).max(axis=0) >= full_scale
            coordinates[axis] = decode_gray_code(
                images,
                axis_roles,
                coded_axis,
                settings,
                full_scale=full_scale,
                saturated=saturated,
                interpolate=interpolate,
            )
            continue
        fringes = Fringes.of([image_roles[i] for i in phases], code.mean, code.contrast)
        if coded_axis is not None:
            coordinates[axis] = decode_gray_fringes(
                images, axis_roles, coded_axis, fringes, settings, full_scale=full_scale, imager=imager
            )
            continue
        plain = {role.kind: image for role, image in zip(axis_roles, images, strict=True) if role.axis is None}
        white_black = (plain["white"], plain["black"]) if len(plain) == 2 else None
        coordinates[axis] = decode_fringes(
            images[len(shared) :],
            fringes,
            extent,
            settings,
            full_scale=full_scale,
            imager=imager,
            white_black=white_black,
        )
    return coordinates


def decode_structured_light(
    stack: NDArray[np.generic],
    geometry: StructuredLightGeometry,
    code: LightCode,
    settings: DecoderSettings,
    context: ImageContext,
    decoded_before: Mapping[Axis, ProjectorCoordinate] | None = None,
) -> PointCloud:
    """Decode the images of one camera to a cloud on its own pixels, sensor frame [mm].

    ``sigma`` [mm] along the view ray is known if the imager or the width of a stripe determines it. Status, in addition
    to that of the code:

    - ``OUT_OF_RANGE``: the pixel is decoded, but its depth is not between near and far.
    - ``NO_SURFACE``: the pixel shows no code, and the projector does not reach its ray.
    - ``LOW_MODULATION``: the pixel shows no code. Shadow cannot be distinguished from a dark surface.
    - ``UNCALIBRATED``: the lens distortion gives the pixel no unique ray, or no unique depth on it.

    ``stack``: (P, H, W) raw images [DN] in the order of :func:`mitsim.sensor.light_code.roles`. ``context``: its
    ``roi`` is a region of the image; ``read_out`` is not used. ``decoded_before``: (H, W) from
    :func:`decode_coordinates` with the same settings. Raises InputError if the images do not fit code and calibration,
    or the ``roi`` does not lie in them.
    """
    if geometry.axis not in axes(code):
        raise InputError("structured-light geometry", "", f"code along {', '.join(axes(code))}", geometry.axis)
    if not (geometry.near <= settings.near_mm and settings.far_mm <= geometry.far):
        requested = f"{settings.near_mm:g} to {settings.far_mm:g} mm"
        raise InputError("decoder settings", "near_mm, far_mm", requested, f"{geometry.near:g} to {geometry.far:g} mm")
    camera, projector = geometry.camera, geometry.projector
    if stack.shape[1:] != (camera.height, camera.width):
        allowed = f"(images, {camera.height}, {camera.width})"
        raise InputError(f"images of {geometry.camera_name}", "shape", stack.shape, allowed)
    roi = checked_roi(context.roi, camera.width, camera.height, "decode_structured_light")
    region = roi.slices
    if decoded_before is not None:
        coordinates = {axis: coordinate.part(region) for axis, coordinate in decoded_before.items()}
    else:
        coordinates = decode_coordinates(
            np.ascontiguousarray(stack[:, *region]),
            code,
            (projector.width, projector.height),
            settings,
            full_scale=context.full_scale,
            imager=context.imager,
        )
    points, sigma, status = _triangulated(
        coordinates[geometry.axis], geometry, (settings.near_mm, settings.far_mm), region
    )
    for axis, second in coordinates.items():
        if axis != geometry.axis:
            _reject_contradictions(points, status, second, projector, axis, settings.epipolar_px)
    return _cloud(points, sigma, status, roi, geometry, context)


def triangulate_coordinate(
    coordinate: ProjectorCoordinate, geometry: StructuredLightGeometry, context: ImageContext
) -> PointCloud:
    """Return the cloud of a whole camera from the projector coordinate of each pixel, whatever code gave it.

    Status and ``sigma`` are those of :func:`decode_structured_light`; the range is that of the geometry. ``context``
    names sensor and source.
    """
    whole = Roi.whole(geometry.camera.width, geometry.camera.height)
    triangulated = _triangulated(coordinate, geometry, (geometry.near, geometry.far), whole.slices)
    return _cloud(*triangulated, whole, geometry, context)


def _cloud(
    points: NDArray[np.float32],
    sigma: NDArray[np.float32],
    status: NDArray[np.uint8],
    roi: Roi,
    geometry: StructuredLightGeometry,
    context: ImageContext,
) -> PointCloud:
    """Return the cloud of a region; its points and sigma become NaN where the status is not valid."""
    missing = status != Status.VALID
    points[missing], sigma[missing] = np.nan, np.nan
    cloud_sigma = sigma if np.isfinite(sigma).any() else None
    return cloud_on_grid(points, status, cloud_sigma, roi, geometry, context.sensor, context.source)


def _triangulated(
    coordinate: ProjectorCoordinate,
    geometry: StructuredLightGeometry,
    range_mm: tuple[float, float],
    region: tuple[slice, slice],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Return points (h, w, 3), noise along the ray (h, w) [mm] and status (h, w) of a region."""
    points, sigma, in_range, unsolved = _points(coordinate, geometry, range_mm, region)
    status = coordinate.status.copy()
    decoded = status == Status.VALID
    status[decoded & ~in_range] = Status.OUT_OF_RANGE
    status[geometry.undetermined[region] | (decoded & unsolved)] = Status.UNCALIBRATED
    status[(status == Status.LOW_MODULATION) & ~geometry.seen[region]] = Status.NO_SURFACE
    return points, sigma, status


def _points(
    coordinate: ProjectorCoordinate,
    geometry: StructuredLightGeometry,
    range_mm: tuple[float, float],
    region: tuple[slice, slice],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return points (h, w, 3) and noise along the ray (h, w) [mm] of a region.

    Also return masks (h, w) of the points in range, and of coordinates in the ray's field for which no depth was found.
    """
    shape, count = coordinate.value.shape, len(geometry.nodes)
    points, sigma = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    in_range, unsolved = np.empty(shape, bool), np.zeros(shape, bool)
    value, value_sigma = coordinate.value.ravel(), coordinate.sigma.ravel()
    nodes, differences = (array[:, *region].reshape(count, -1) for array in (geometry.nodes, geometry.differences))
    rays, seen = geometry.ray[region].reshape(-1, 3), geometry.seen[region].ravel()
    nearest_w, farthest_w = 1 / range_mm[0], 1 / range_mm[1]

    @np.errstate(invalid="ignore", divide="ignore")
    def triangulate_blocks(blocks: list[slice]) -> None:
        for block in blocks:
            u = value[block]
            w, slope = evaluate(nodes[:, block], differences[:, block], u)
            # the polynomial holds one pixel beyond its ends; farther out it may turn back into the range
            lowest, highest = nodes[:, block].min(axis=0), nodes[:, block].max(axis=0)
            inside = (u > lowest - 1) & (u < highest + 1) & seen[block]
            if geometry.exact:
                chosen = np.flatnonzero(inside)
                w[chosen], slope[chosen] = exact_inverse_depth(geometry, rays[block][chosen], w[chosen], u[chosen])
                unsolved.reshape(-1)[block] = inside & np.isnan(w)
            depth = 1 / w
            in_range.reshape(-1)[block] = inside & (w >= farthest_w) & (w <= nearest_w)
            block_rays = rays[block]
            points.reshape(-1, 3)[block] = geometry.camera.centre + block_rays * depth[:, None]
            length = np.sqrt(np.einsum("ij,ij->i", block_rays, block_rays))
            sigma.reshape(-1)[block] = np.abs(slope) * depth * depth * length * value_sigma[block]

    in_blocks(triangulate_blocks, value.size)
    return points, sigma, in_range, unsolved


def _reject_contradictions(
    points: NDArray[np.float32],
    status: NDArray[np.uint8],
    second: ProjectorCoordinate,
    projector: Camera,
    axis: Axis,
    tolerance_px: float,
) -> None:
    """Reject points whose projection contradicts the coordinate decoded along the other axis.

    The tolerance grows with stripes wider than a pixel, whose centre may be off by half a stripe. Since sigma is stripe
    / sqrt(12), half a stripe is sqrt(3) sigma.
    """
    both = np.flatnonzero((status == Status.VALID) & (second.status == Status.VALID))
    flat_points, values, sigmas = points.reshape(-1, 3), second.value.ravel(), second.sigma.ravel()
    judged, component = status.reshape(-1), 0 if axis == "columns" else 1

    def compare(blocks: list[slice]) -> None:
        for block in blocks:
            pixels = both[block]
            projected = projector.project(flat_points[pixels].astype(np.float64))[:, component]
            stripe_margin = np.nan_to_num(np.maximum(np.sqrt(3.0) * sigmas[pixels] - 0.5, 0.0))
            contradicted = ~(np.abs(projected - values[pixels]) <= tolerance_px + stripe_margin)
            judged[pixels[contradicted]] = Status.PHASE_INCONSISTENT

    in_blocks(compare, len(both))
    undecoded = (status == Status.VALID) & (second.status != Status.VALID)
    status[undecoded] = second.status[undecoded]
