"""Structured light: the images of one camera, a code and a calibration to an organised point cloud.

Signal chain: images [DN] -> projector column u (or row) seen by each raw pixel -> the depth on the pixel's own view ray
whose exact projection has that u (:mod:`mitsim.decode.structured_light.geometry`) -> points in the sensor frame [mm],
and the noise along the ray to expect.

Nothing is rectified or undistorted before the phase is known: interpolated images have blurred phases. The rays are
those of the camera as it is, so the cloud's grid carries them (:class:`ViewGrid`, ``normalised``).

Every pixel is decoded from its own grey levels, so a region of interest may be decoded alone, up to its very edge. Only
a gamma estimated from the images (``correct_gamma``) is then that of the region.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from mitsim.decode.blocks import in_blocks
from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.grid_cloud import placed_cloud
from mitsim.decode.image_context import ImageContext
from mitsim.decode.structured_light.geometry import StructuredLightGeometry, evaluate, structured_light_geometry
from mitsim.decode.structured_light.gray_code import decode_gray_code, decode_gray_code_phase_shift
from mitsim.decode.structured_light.image_sequence import decode_image_sequence
from mitsim.decode.structured_light.phase_shift import decode_phase_shift
from mitsim.decode.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, LightCode, PhaseShift, axes
from mitsim.sensor.roi import checked_roi


def decode_coordinates(
    stack: NDArray[np.generic],
    code: LightCode,
    size: tuple[int, int],
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
    between: bool = False,
) -> dict[Axis, ProjectorCoordinate]:
    """Projector coordinates seen by each pixel, for each axis of any code.

    ``size``: width and height of the projector [px]. ``between``: columns of a Gray code without fringes rise between
    the edges of their stripes, along rows, in place of the stripes' centres.

    Raises
    ------
    InputError
        If the stack is not what the code says, or the code cannot be told apart over the projector.
    """
    width, height = size
    if isinstance(code, GrayCode):
        return decode_gray_code(stack, code, width, height, settings, full_scale=full_scale, between=between)
    if isinstance(code, ImageSequence):
        return decode_image_sequence(stack, code, size, settings, full_scale=full_scale, imager=imager, between=between)
    if isinstance(code, PhaseShift):
        extent = width if code.axis == "columns" else height
        found = decode_phase_shift(stack, code, extent, settings, full_scale=full_scale, imager=imager)
    else:
        found = decode_gray_code_phase_shift(stack, code, width, height, settings, full_scale=full_scale, imager=imager)
    return {code.axis: found}


def decode_structured_light(
    stack: NDArray[np.generic],
    rig: Rig | StructuredLightGeometry,
    camera: str,
    code: LightCode,
    settings: DecoderSettings,
    context: ImageContext,
) -> PointCloud:
    """Decode the images of one camera.

    Parameters
    ----------
    stack
        (P, H, W) raw images [DN], uint8, uint16 or floats, in the order of :func:`mitsim.sensor.light_code.roles`.
    rig
        The calibration; or the :func:`structured_light_geometry` made of it, which saves preparing it every time.
    camera
        Name of the camera in the rig.
    settings
        Range and limits.
    context
        Of the images; its ``roi`` is one of the image. ``read_out`` is not used.

    Returns
    -------
    PointCloud
        On the camera's own pixels, points in the sensor frame [mm]; ``sigma`` [mm] along the view ray where the
        imager or the width of a stripe tells it. A pixel that decodes, but to a place where its ray is not between
        near and far, is ``OUT_OF_RANGE``; one that shows no code, and that the projector cannot reach there,
        ``NO_SURFACE``. Shadow cannot be told from a dark surface: both are ``LOW_MODULATION``.

    Raises
    ------
    InputError
        If the images are not what code and calibration say, or the region of interest does not lie in them.
    """
    if isinstance(rig, StructuredLightGeometry):
        geometry = rig
        if camera != geometry.camera_name or geometry.axis not in axes(code):
            asked = f"camera {camera!r}, code along {', '.join(axes(code))}"
            raise InputError("structured-light geometry", "", asked, f"{geometry.camera_name!r}, {geometry.axis}")
        if not (geometry.near <= settings.near_mm and settings.far_mm <= geometry.far):
            asked = f"{settings.near_mm:g} to {settings.far_mm:g} mm"
            raise InputError("decoder settings", "near_mm, far_mm", asked, f"{geometry.near:g} to {geometry.far:g} mm")
    else:
        geometry = structured_light_geometry(rig, camera, code, settings.near_mm, settings.far_mm)
    eye, projector = geometry.camera, geometry.projector
    if stack.shape[1:] != (eye.height, eye.width):
        raise InputError(f"images of {camera}", "shape", stack.shape, f"(images, {eye.height}, {eye.width})")
    roi = checked_roi(context.roi, eye.width, eye.height, "decode_structured_light")
    part = roi.slices
    found = decode_coordinates(
        np.ascontiguousarray(stack[:, *part]),
        code,
        (projector.width, projector.height),
        settings,
        full_scale=context.full_scale,
        imager=context.imager,
    )
    coordinate = found[geometry.axis]
    points, sigma, in_range = _points(coordinate, geometry, settings, part)
    status = coordinate.status.copy()
    decoded = status == Status.VALID
    status[decoded & ~in_range] = Status.OUT_OF_RANGE
    status[(status == Status.LOW_MODULATION) & ~geometry.seen[part]] = Status.NO_SURFACE
    for axis, other in found.items():
        if axis != geometry.axis:
            _check_other(points, status, other, projector, axis, settings.epipolar_px)
    missing = status != Status.VALID
    points[missing], sigma[missing] = np.nan, np.nan
    told = sigma if np.isfinite(sigma).any() else None
    return placed_cloud(points, status, told, roi, geometry, context.sensor, context.source)


def _points(
    coordinate: ProjectorCoordinate,
    geometry: StructuredLightGeometry,
    settings: DecoderSettings,
    part: tuple[slice, slice],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Points (h, w, 3) and their noise (h, w) along the ray [mm], and whether they lie within range, of a part."""
    shape, count = coordinate.value.shape, len(geometry.nodes)
    points, sigma = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    in_range = np.empty(shape, bool)
    value, spread = coordinate.value.ravel(), coordinate.sigma.ravel()
    nodes, differences = (each[:, *part].reshape(count, -1) for each in (geometry.nodes, geometry.differences))
    rays, seen = geometry.ray[part].reshape(-1, 3), geometry.seen[part].ravel()
    nearest_w, farthest_w = 1 / settings.near_mm, 1 / settings.far_mm

    @np.errstate(invalid="ignore", divide="ignore")
    def place(blocks: list[slice]) -> None:
        for block in blocks:
            u = value[block]
            w, slope = evaluate(nodes[:, block], differences[:, block], u)
            depth = 1 / w
            # a pixel beyond the ends the polynomial still holds; farther out it may turn back into the range
            least, most = nodes[:, block].min(axis=0), nodes[:, block].max(axis=0)
            within = (u > least - 1) & (u < most + 1) & seen[block]
            in_range.reshape(-1)[block] = within & (w >= farthest_w) & (w <= nearest_w)
            ray = rays[block]
            points.reshape(-1, 3)[block] = geometry.camera.centre + ray * depth[:, None]
            length = np.sqrt(np.einsum("ij,ij->i", ray, ray))
            sigma.reshape(-1)[block] = np.abs(slope) * depth * depth * length * spread[block]

    in_blocks(place, value.size)
    return points, sigma, in_range


def _check_other(
    points: NDArray[np.float32],
    status: NDArray[np.uint8],
    other: ProjectorCoordinate,
    projector: Camera,
    axis: Axis,
    tolerance_px: float,
) -> None:
    """Refuse points whose projection misses the coordinate that was decoded along the other axis.

    The centre of a stripe wider than a pixel may be missed by so much more: sigma is stripe / sqrt(12).
    """
    rows, columns = np.nonzero((status == Status.VALID) & (other.status == Status.VALID))
    there = projector.project(points[rows, columns].astype(np.float64))[:, 0 if axis == "columns" else 1]
    wider = np.nan_to_num(np.maximum(np.sqrt(3.0) * other.sigma[rows, columns] - 0.5, 0.0))
    missed = ~(np.abs(there - other.value[rows, columns]) <= tolerance_px + wider)
    status[rows[missed], columns[missed]] = Status.PHASE_INCONSISTENT
    unknown = (status == Status.VALID) & (other.status != Status.VALID)
    status[unknown] = other.status[unknown]
