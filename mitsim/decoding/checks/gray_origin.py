"""Try the usual origins of a Gray code: the projector's edge, and a code that is centred on the projector.

An offset moves all coordinates along an axis by the same number of pixels. An origin explains a lit pixel if light and
view ray can meet:

- the light comes from the projector, not from a column or row beyond it;
- the two meet in front of the camera, within the range of the decoder;
- with codes along both axes, the ray meets the light of both (the epipolar constraint).

If two origins explain the pixels equally well, depth depends on the one that the sensor file states. A plane does not
tell either: where the projector's image is parallel to the baseline, an offset turns planes into other planes.

With codes along both axes any other origin is measured: the same offset of both moves the light of every pixel to one
side of its view ray, as a code that counts from 1 does.

Signal chain: images, every few pixels -> coordinates with each origin -> share of the lit pixels that each explains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.checks.code_lines import CodeLines
from mitsim.decoding.checks.rig_sanity import LARGEST_MISS_PX, half_stripe, meet_light_planes, meeting
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.geometry import axis_across
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis, Offset
from mitsim.sensor.image_sequence import GrayImages, ImageSequence
from mitsim.sensor.light_code import GrayCode, LightCode, axes, roles

Origins = dict[Axis, Offset]

#: approximate number of pixels evaluated along either side of the image
_COARSE = 160

#: an origin fits better than the stated one if it leaves at most this share of the pixels that the latter leaves
#: unexplained; chosen
_FRACTION = 0.25

#: an origin also fits better if it explains more of the lit pixels by this share; chosen
_MANY = 0.5

#: least share of pixels that counts, of a difference and of decoded pixels; chosen
_LEAST = 0.02

#: an offset is measured if the median miss [projector px] is at least this; assumed
_LEAST_MISS_PX = 0.7

#: largest distance of a measured offset from a whole one [px], and largest excess of the median unsigned miss that it
#: leaves over that of a uniform error over a stripe; assumed
_WHOLE_PX = 0.2

#: least share of the lit pixels that an origin explains to be believed
_EXPLAINED = 0.3


def beyond_in_words(lines: CodeLines, axis: Axis) -> str:
    """Return a warning if another origin of a Gray code leaves far fewer pixels beyond the projector, or ""."""
    try:
        shares = {
            words: _share_rejected(replace(lines, code=with_origins(lines.code, origins)), axis)
            for words, origins in other_origins(lines.code, lines.size).items()
            if axis in origins
        }
        stated = _share_rejected(lines, axis) if shares else 0.0
    except InputError:
        return ""
    words = min(shares, key=lambda description: shares[description], default="")
    if not words or stated - shares[words] < _LEAST or shares[words] > _FRACTION * stated:
        return ""
    share = 100 * (stated - shares[words])
    return f"{share:.0f} % of the lit pixels decode to {axis} beyond the projector: they fit if {words}"


def gray_origin_warning(images: CodedImages, rig: Rig, others_may_be_meant: bool) -> str:
    """Return a warning if another origin of a Gray code fits the geometry of camera and projector better, or "".

    The images of the first camera count. ``others_may_be_meant``: also warn if another origin fits as well, or is
    measured, and the sensor file does not state ``offset_px``.
    """
    eye, projector, code, size = rig.reference, rig.projector, images.code, images.size
    if projector is None:
        return ""
    stack = next(iter(images.stacks.values()))
    step = max(1, min(stack.shape[1:]) // _COARSE)
    sample = np.s_[step // 2 :: step, step // 2 :: step]
    coarse = np.ascontiguousarray(stack[:, *sample])
    rays = eye.rays(eye.pixel_grid()[sample])

    def decoded(tried: LightCode) -> dict[Axis, ProjectorCoordinate]:
        return decode_coordinates(coarse, tried, size, images.settings, full_scale=images.full_scale)

    def seen_with(tried: LightCode) -> _Explained:
        return _Explained.of(eye, projector, rays, decoded(tried), images.settings)

    try:
        alternatives = {words: seen_with(with_origins(code, o)) for words, o in other_origins(code, size).items()}
        stated = seen_with(code) if alternatives else None
        words = "" if stated is None else _of_usual_origins(stated, alternatives, others_may_be_meant, code)
        if words or not others_may_be_meant or _states_origins(code):
            return words
        return _of_measured_origin(eye, projector, rays, decoded(code), code)
    except InputError:
        return ""


def _of_usual_origins(
    stated: _Explained, alternatives: dict[str, _Explained], others_may_be_meant: bool, code: LightCode
) -> str:
    """Return a warning if one of the usual origins explains more of the pixels, or as many, or ""."""
    words, best = max(alternatives.items(), key=lambda item: item[1].share)
    if best.share < _EXPLAINED:
        return ""
    gain = best.share - stated.share
    if gain > _MANY or (gain > _LEAST and 1 - best.share < _FRACTION * (1 - stated.share)):
        return (
            f"{100 * stated.share:.0f} % of the lit pixels meet their light, and {100 * best.share:.0f} % at "
            f"{best.depth:.0f} mm if {words}"
        )
    if not others_may_be_meant or abs(gain) > _LEAST or _states_origins(code):
        return ""
    return (
        f"the images do not tell where the Gray code begins: the points are at {stated.depth:.0f} mm if column or row "
        f"0 has code 0, and at {best.depth:.0f} mm if {words}, as in the programs of Lanman, Moreno and Taubin. "
        "State offset_px, 0 or as the program shows it"
    )


def _of_measured_origin(
    eye: Camera, projector: Camera, rays: Floats, coordinates: dict[Axis, ProjectorCoordinate], code: LightCode
) -> str:
    """Return a warning if one offset of columns and rows brings the light onto the view rays, or ""."""
    if len(coordinates) < 2 or any(role.kind == "phase" for role in roles(code, projector.width, projector.height)):
        return ""
    valid = np.all([coordinate.status == Status.VALID for coordinate in coordinates.values()], axis=0) & np.isfinite(
        rays
    ).all(axis=-1)
    if valid.mean() < _LEAST:
        return ""
    directions = eye.sensor_from_camera.directions(rays[valid])

    def miss(offset: float) -> Floats:
        values = {axis: coordinate.value[valid] - offset for axis, coordinate in coordinates.items()}
        misses = meeting(eye, projector, directions, values)[1]
        return misses[np.isfinite(misses)]

    at = [miss(offset) for offset in (0.0, 1.0)]
    if not all(misses.size for misses in at):
        return ""
    at_0, at_1 = (float(np.median(misses)) for misses in at)
    if abs(at_0) < _LEAST_MISS_PX or abs(at_1 - at_0) < _EXPLAINED:
        return ""
    exact = at_0 / (at_0 - at_1)
    offset = round(exact)
    if offset < 1 or abs(exact - offset) > _WHOLE_PX:
        return ""
    left, uniform = miss(float(offset)), max(half_stripe(coordinate) for coordinate in coordinates.values()) / 2
    if not left.size or float(np.median(np.abs(left))) > uniform + _WHOLE_PX:
        return ""
    fits = _in_words(dict.fromkeys(coordinates, float(offset)))
    return (
        f"view rays miss the light that they decode by {abs(at_0):.1f} projector px in the median, all to one side: "
        f"they fit if {fits}, as in a program that counts from another number; or the calibration is off by as much. "
        "State offset_px, 0 or as the program shows it"
    )


def with_origins(code: LightCode, origins: Origins) -> LightCode:
    """Return a code whose Gray bits have other offsets."""
    if isinstance(code, GrayCode):
        return code.model_copy(update={"offset_px": next(iter(origins.values()))})
    if not isinstance(code, ImageSequence):
        return code
    images = [
        group.model_copy(update={"offset_px": origins[group.axis]})
        if isinstance(group, GrayImages) and group.axis in origins
        else group
        for group in code.images
    ]
    return code.model_copy(update={"images": images})


def other_origins(code: LightCode, size: tuple[int, int]) -> dict[str, Origins]:
    """Return the usual origins that differ from those stated, by what to write in the sensor file.

    ``size`` (width, height) of the projector [px]. All axes have the same origin, as in a program. Fringes contradict
    another origin only if it is no whole number of their periods away.
    """
    stated = {role.axis: role.offset for role in roles(code, *size) if role.kind == "gray"}
    gray_axes: list[Axis] = [axis for axis in axes(code) if axis in stated]
    out: dict[str, Origins] = {}
    for offset in ("centred", 0.0):
        origins: Origins = dict.fromkeys(gray_axes, offset)  # type: ignore[arg-type]
        tried = {role.axis: role.offset for role in roles(with_origins(code, origins), *size) if role.kind == "gray"}
        origins = {axis: origin for axis, origin in origins.items() if tried[axis] != stated[axis]}
        if origins:
            out[_in_words(origins)] = origins
    return out


def _states_origins(code: LightCode) -> bool:
    """Return whether the sensor file states ``offset_px`` of every Gray code."""
    if isinstance(code, ImageSequence):
        groups = [code.gray(axis) for axis in code.axes]
        return all(group.offset_px is not None for axis_groups in groups for group in axis_groups)
    return not isinstance(code, GrayCode) or code.offset_px is not None


def _in_words(origins: Origins) -> str:
    """Return the key to write in the sensor file, in words."""
    offset = next(iter(origins.values()))
    value = f'"{offset}"' if isinstance(offset, str) else f"{offset:g}"
    return f"the Gray code of the {' and '.join(origins)} has offset_px = {value} in [pattern]"


def _share_rejected(lines: CodeLines, axis: Axis) -> float:
    """Return the share of the lit pixels that have no coordinate along an axis [1]."""
    parts = lines.decoded(axis)
    status, lit = (
        np.concatenate([array.ravel() for array in all_parts])
        for all_parts in ([part.status for part in parts], [part.lit for part in parts])
    )
    return float(np.mean(status[lit] != Status.VALID)) if lit.mean() > 0.02 else 0.0


@dataclass(frozen=True)
class _Explained:
    """Share of the lit pixels that an origin explains [1], and their median depth [mm]; NaN without one."""

    share: float
    depth: float

    @classmethod
    def of(
        cls,
        eye: Camera,
        projector: Camera,
        rays: Floats,
        coordinates: dict[Axis, ProjectorCoordinate],
        settings: DecoderSettings,
    ) -> _Explained:
        """Intersect unit ``rays`` (h, w, 3) of the camera with columns or rows, those across the baseline if coded."""
        lit = np.all([coordinate.lit for coordinate in coordinates.values()], axis=0)
        valid = np.all([coordinate.status == Status.VALID for coordinate in coordinates.values()], axis=0)
        if lit.mean() < _LEAST or not valid.any():
            return cls(0.0, float("nan"))
        axis = axis_across(eye, projector, tuple(coordinates))
        directions = eye.sensor_from_camera.directions(rays[valid])
        distance = meet_light_planes(eye, projector, directions, coordinates[axis].value[valid], axis)
        with np.errstate(invalid="ignore"):
            depth = distance * rays[valid][:, 2]
            explained = (depth >= settings.near_mm) & (depth <= settings.far_mm)
        points = eye.centre + directions[explained] * distance[explained][:, None]
        projected = projector.project(points)
        missed = np.zeros(len(projected), bool)
        for other, second in coordinates.items():
            if other != axis:
                allowed = LARGEST_MISS_PX + half_stripe(second)
                seen = second.value[valid][explained]
                missed |= ~(np.abs(projected[:, 0 if other == "columns" else 1] - seen) <= allowed)
        explained[explained] = ~missed
        share = float(explained.sum() / lit.sum())
        return cls(share, float(np.median(depth[explained])) if explained.any() else float("nan"))
