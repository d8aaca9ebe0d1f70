"""Triangulate the projector coordinates that a decoder of the user's own gives, of a new code or of a known one."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from characterisation.files.errors import InputError, nearest
from characterisation.point_cloud import PointCloud, Status
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import decoder_settings
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.structured_light.decoder import triangulate_coordinate
from mitsim.decoding.structured_light.geometry import offset_from_projector, structured_light_geometry
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.camera import Camera
from mitsim.sensor.image_role import Axis

#: least share of the baseline across the coded axis: below, points have over ten times the noise of the other axis
_LEAST_ACROSS = 0.1


def triangulate(
    capture: Capture,
    coordinate: ArrayLike,
    *,
    camera: str | None = None,
    axis: Axis = "columns",
    sigma: ArrayLike | None = None,
    range_mm: tuple[float, float] | None = None,
) -> PointCloud:
    """Return the points at which the pixels of a camera see given columns, or rows, of the projector.

    Both lenses count with their distortion. Each point lies on the view ray of its pixel.

    Parameters
    ----------
    capture
        The capture; its calibration has camera and projector.
    coordinate
        (H, W) column, or row, of the projector that each pixel of the camera sees [projector px]. Pixel centres lie at
        integers; NaN where it is unknown.
    camera
        Name of the camera; by default the first.
    axis
        ``"columns"`` or ``"rows"``.
    sigma
        (H, W) standard deviation of the coordinate [projector px], from which that of the points follows.
    range_mm
        Nearest and farthest depth to accept [mm]; by default those of the sensor.

    Returns
    -------
    PointCloud
        Points (H, W, 3) float32 [mm] in the sensor frame, NaN where missing. Pixels without a coordinate are
        ``LOW_MODULATION``; where the projector does not reach their rays within the range, ``NO_SURFACE``.

    Raises
    ------
    InputError
        If there is no such camera, the coordinate has not the camera's size, the calibration has no projector, camera
        and projector do not lie apart across the axis, or the coordinate does not change with depth.

    Examples
    --------
    >>> import mitsim as ms
    >>> sensor = ms.load_sensor("small.toml")
    >>> scene = ms.load_scene("matt_white.xml", sensor)
    >>> pose = ms.look_at((0, -300, 400))
    >>> capture, truth = ms.render(scene, sensor, pose, samples=2, depth=1, check=False, truth=True)
    >>> seen = truth["left"]
    >>> cloud = ms.triangulate(capture, seen.projector[..., 0])
    >>> bool(abs(cloud.points[..., 2] - seen.depth)[cloud.valid].max() < 0.1)
    True
    """
    name = next(iter(capture.rig.cameras)) if camera is None else camera
    if name not in capture.rig.cameras:
        hint = nearest(name, list(capture.rig.cameras))
        raise InputError("triangulate", "camera", repr(name), ", ".join(capture.rig.cameras), hint)
    if axis not in ("columns", "rows"):
        raise InputError("triangulate", "axis", repr(axis), "columns, rows")
    size = capture.rig.cameras[name].height, capture.rig.cameras[name].width
    value = np.asarray(coordinate, np.float64)
    spread = np.full(size, np.nan) if sigma is None else np.asarray(sigma, np.float64)
    for words, array in (("coordinate", value), ("sigma", spread)):
        if array.shape != size:
            raise InputError("triangulate", words, f"shape {array.shape}", f"{size}, the pixels of camera {name}")
    if capture.rig.projector is not None:
        _check_baseline(capture.rig.cameras[name], capture.rig.projector, axis)
    settings, _ = decoder_settings(capture, None, range_mm)
    geometry = structured_light_geometry(capture.rig, name, axis, settings.near_mm, settings.far_mm)
    finite = np.isfinite(value)
    status = np.where(finite, Status.VALID, Status.LOW_MODULATION).astype(np.uint8)
    nothing = np.full(size, np.nan, np.float32)
    decoded = ProjectorCoordinate(np.where(finite, value, np.nan), spread.astype(np.float32), nothing, status)
    context = ImageContext(capture.sensor, capture.source, 2.0**capture.bits - 1)
    return triangulate_coordinate(decoded, geometry, context)


def _check_baseline(camera: Camera, projector: Camera, axis: Axis) -> None:
    """Raise an InputError if camera and projector do not lie apart across the columns or rows that are coded."""
    apart = offset_from_projector(camera, projector)
    across, whole = abs(float(apart[0 if axis == "columns" else 1])), float(np.linalg.norm(apart))
    if across < _LEAST_ACROSS * whole:
        other = "rows" if axis == "columns" else "columns"
        found = f"{axis!r}, across which camera and projector lie {across:.2g} of {whole:.3g} mm apart"
        hint = f"only this distance determines depth: give {other}, with axis = {other!r}"
        raise InputError("triangulate", "axis", found, f"{_LEAST_ACROSS * whole:.2g} mm or more", hint)
