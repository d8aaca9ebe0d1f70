"""Check whether the images of one camera and the calibration of camera and projector belong together.

Signal chain: images, every few pixels -> projector coordinates -> view ray of the camera, and ray or plane of light of
the projector -> distance between them, and whether they meet in front of the camera. Two cameras that see one code are
checked in :mod:`mitsim.decoding.checks.pair_sanity`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from characterisation.files.arrays import Floats
from characterisation.point_cloud import Status
from mitsim.decoding.structured_light.geometry import offset_from_projector
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import LightCode, axes
from mitsim.sensor.transforms import Transform

#: least share of the baseline across the stripes; below, depth has half the sensitivity that another axis gives
LEAST_ACROSS = 0.5

#: largest median distance of view rays from their light [projector px], in addition to half a stripe
LARGEST_MISS_PX = 3.0

#: largest share of the decoded pixels that meet their light behind the camera, or not at all
_BEHIND = 0.3

#: approximate number of pixels along either side in a coarse check
COARSE = 160


def baseline_warning(rig: Rig, code: LightCode) -> str:
    """Return a warning if the baseline lies along the stripes of a code with one axis, or ""."""
    if rig.projector is None or len(axes(code)) != 1:
        return ""
    apart = offset_from_projector(rig.reference, rig.projector)
    axis = axes(code)[0]
    across, whole = abs(float(apart[0 if axis == "columns" else 1])), float(np.linalg.norm(apart))
    if across >= LEAST_ACROSS * whole:
        return ""
    other = "rows" if axis == "columns" else "columns"
    return (
        f"only {across:.0f} mm of the {whole:.0f} mm between camera and projector lie across the {axis} of the code: "
        f"only these determine depth. Project {other}, or check R and T of the calibration"
    )


def camera_warnings(decoded: Mapping[Axis, ProjectorCoordinate], rig: Rig, settings: DecoderSettings) -> list[str]:
    """Warn of rays that miss their light, or meet it behind the camera; ``decoded`` coordinates are (H, W)."""
    eye, projector = rig.reference, rig.projector
    if projector is None or not decoded:
        return []
    step = max(1, min(eye.width, eye.height) // COARSE)
    sample = np.s_[step // 2 :: step, step // 2 :: step]
    sampled = {axis: coordinate.part(sample) for axis, coordinate in decoded.items()}
    rays = eye.sensor_from_camera.directions(eye.rays(eye.pixel_grid()[sample]))
    valid = np.all([coordinate.status == Status.VALID for coordinate in sampled.values()], axis=0) & np.isfinite(
        rays
    ).all(axis=-1)
    if valid.mean() < 0.005:
        return []
    coordinates = {axis: coordinate.value[valid] for axis, coordinate in sampled.items()}
    depth, miss = meeting(eye, projector, rays[valid], coordinates)
    solved = depth[~np.isnan(depth)]  # without light beyond the fold of the projector's distortion
    behind = float(np.mean(~(solved > 0))) if solved.size else 0.0
    doubt = "check that the calibration belongs to these images, and that R and T are those of cv2.stereoCalibrate"
    out = []
    if behind > _BEHIND:
        doubt = _other_place(eye, projector, rays[valid], coordinates) or doubt
        return [f"{100 * behind:.0f} % of the decoded pixels meet their light behind the camera: {doubt}"]
    if len(sampled) == 2:
        allowed = max(LARGEST_MISS_PX, settings.epipolar_px) + max(
            half_stripe(coordinate) for coordinate in sampled.values()
        )
        error = float(np.nanmedian(np.abs(miss))) if np.isfinite(miss).any() else np.inf
        if error > allowed:
            names: tuple[Axis, Axis] = ("columns", "rows")
            turned = {axis: sampled[other].value[valid] for axis, other in (names, names[::-1])}
            other = float(np.nanmedian(np.abs(meeting(eye, projector, rays[valid], turned)[1])))
            if other < allowed:
                doubt = "they fit if columns and rows are exchanged in [pattern]"
            else:
                doubt = _other_place(eye, projector, rays[valid], coordinates) or doubt
            out.append(f"view rays miss the light that they decode by {error:.1f} projector px in the median: {doubt}")
    return out


def _other_place(eye: Camera, projector: Camera, rays: Floats, coordinates: dict[Axis, Floats]) -> str:
    """Return another R and T with which nearly all rays meet their light; only codes of both axes reveal it."""
    if len(coordinates) < 2:
        return ""
    camera_from_projector = eye.sensor_from_camera.inverse() @ projector.sensor_from_camera
    inverted, turn = camera_from_projector.inverse(), camera_from_projector.rotation
    readings = {
        "they fit if R and T go from the projector's frame to the camera's: invert them": inverted,
        "they fit if T has the opposite sign": Transform(turn, -camera_from_projector.translation),
    }
    for words, pose in readings.items():
        moved = replace(projector, sensor_from_camera=eye.sensor_from_camera @ pose)
        depth, miss = meeting(eye, moved, rays, coordinates)
        if np.mean(depth > 0) > 1 - _BEHIND / 3 and np.nanmedian(np.abs(miss)) < LARGEST_MISS_PX:
            return words
    return ""


def half_stripe(coordinate: ProjectorCoordinate) -> float:
    """Return half the width of a stripe of a Gray code without fringes [px], 0 if unknown."""
    sigma = coordinate.sigma[np.isfinite(coordinate.sigma)]
    return float(np.median(sigma)) * np.sqrt(3) if sigma.size else 0.0


def meeting(eye: Camera, projector: Camera, rays: Floats, coordinates: dict[Axis, Floats]) -> tuple[Floats, Floats]:
    """Return the distance (n,) [mm] along rays at which they meet their light, and the miss distance [projector px].

    The miss has a sign: across the epipolar line, to one side or the other. With one axis the light is the plane of a
    column or row, which a lens bends slightly; rays cannot miss it.

    Parameters
    ----------
    eye, projector
        Camera and projector of a rig.
    rays
        (n, 3) directions from the camera, in the sensor frame.
    coordinates
        (n,) columns, rows or both [projector px].

    See Also
    --------
    meet_light_planes : of one axis
    """
    start = eye.centre - projector.centre
    if len(coordinates) == 2:
        light = projector.sensor_from_camera.directions(
            projector.rays(np.stack([coordinates["columns"], coordinates["rows"]], axis=-1))
        )
        # closest points of two lines
        a, b, c = (
            np.einsum("ij,ij->i", vector, other) for vector, other in ((rays, rays), (rays, light), (light, light))
        )
        d, e = rays @ start, light @ start
        along = (b * e - c * d) / (a * c - b * b)
        projected = projector.project(eye.centre + along[:, None] * rays)
        # across the epipolar line: no depth explains it
        step = projector.project(eye.centre + 1.001 * along[:, None] * rays) - projected
        off = projected - np.stack([coordinates["columns"], coordinates["rows"]], axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return along, (off[:, 0] * step[:, 1] - off[:, 1] * step[:, 0]) / np.linalg.norm(step, axis=1)
    ((axis, value),) = coordinates.items()
    return meet_light_planes(eye, projector, rays, value, axis), np.zeros(len(rays))


def meet_light_planes(eye: Camera, projector: Camera, rays: Floats, value: Floats, axis: Axis) -> Floats:
    """Return the distance (n,) [mm] from the camera at which rays meet the planes of light of columns or rows.

    Negative behind the camera, infinite or NaN for a ray along its plane.

    ``eye``, ``projector``: camera and projector of a rig. ``rays``: (n, 3) unit directions from the camera, in the
    sensor frame. ``value``, ``axis``: (n,) columns or rows [projector px].
    """
    last = (projector.height if axis == "columns" else projector.width) - 1.0
    ends = [np.full_like(value, end) for end in (0.0, last)]
    pixels = [np.stack([value, end] if axis == "columns" else [end, value], axis=-1) for end in ends]
    first, second = (projector.sensor_from_camera.directions(projector.rays_to_fold(end)) for end in pixels)
    normal = np.cross(first, second)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(-(normal @ (eye.centre - projector.centre)) / np.einsum("ij,ij->i", normal, rays))
