"""From a capture to its cloud, whatever took it: choose the decoder's settings, merge its exposures, decode.

What a technology needs stands in :mod:`mitsim.reconstruction.decoder_registry`.

Where the settings of a capture name a region that was read out (``read_out``: camera -> left, top, width, height), only
that region is merged and decoded: the rest of the image is absent.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model

from characterisation.documents import Document, validate
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decode.device_maps import DeviceMapGeometry, DeviceMapSettings, roi_of_other_grid
from mitsim.decode.exposures import merge_exposures
from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.grid_cloud import unseen_cloud
from mitsim.errors import InputError
from mitsim.reconstruction.decoder_registry import (
    Geometry,
    Images,
    Pattern,
    Settings,
    Technology,
    technology_of,
)
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.preset import Sensor, presets
from mitsim.sensor.recorded_rig import load_recorded_rig
from mitsim.sensor.roi import Roi, checked_roi
from mitsim.sensor.sensor_file import ImagerTable
from mitsim.sensor.written_imager import imager_of

__all__ = [
    "Geometry",
    "Settings",
    "bracket_of",
    "capture_cloud",
    "capture_geometry",
    "capture_pattern",
    "decoder_settings",
    "in_range",
    "range_is_known",
    "read_out_of",
    "sensor_geometry",
    "settings_are_known",
    "with_options",
]


class _Coded(Document):
    """The part of a capture's settings that names its pattern."""

    pattern: Annotated[
        DotPattern | PhaseShift | GrayCode | GrayCodePhaseShift | ImageSequence | AmplitudeModulation,
        Field(discriminator="kind"),
    ]


class _Read(Document):
    """The part of a capture's settings that says what was read out of each camera: left, top, width, height [px]."""

    read_out: dict[str, tuple[int, int, int, int]] = Field(default_factory=dict)


class _Asked(Document):
    """The part of a capture's settings that says which depths its user asked for."""

    range_mm: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(le=1e6)]] | None = None


class _Imaged(Document):
    """The part of a capture's settings that describes the imager that took it."""

    imager: ImagerTable | None = None


def decoder_settings(
    capture: Capture, sensor: str | None = None, range_mm: tuple[float, float] | None = None
) -> tuple[Settings, Imager | None]:
    """Settings to decode a capture with, and the imager that took it.

    Of ``sensor`` if given, else those that the capture brings, else of the preset of its name, else the technology's
    with the capture's range, and an unknown imager. A pair that was taken several times, as with a shifted pattern, is
    then matched by correlation of all frames.
    ``range_mm``: nearest and farthest depth, in place of those; else what was asked for when the capture was imported,
    unless ``sensor`` is given.

    Raises
    ------
    InputError
        If the sensor is not known, or what the capture says of its range makes no sense.
    """
    where = f"capture of {capture.sensor}: settings.json"
    if range_mm is None and sensor is None:
        range_mm = validate(where, {"range_mm": capture.settings.get("range_mm")}, _Asked).range_mm
    settings, imager = _settings(capture, sensor)
    return in_range(settings, range_mm, where), imager


def in_range(settings: Settings, range_mm: tuple[float, float] | None, where: str) -> Settings:
    """Settings that search from the nearest to the farthest depth [mm] of ``range_mm``; as they are without one.

    Raises
    ------
    InputError
        If the range makes no sense; ``where`` it was given.
    """
    if range_mm is None:
        return settings
    near, far = range_mm
    if not 0 < near < far <= 1e6:
        raise InputError(where, "range_mm", f"{near:g} {far:g}", "near before far, over 0, in mm")
    return settings.model_copy(update={"near_mm": near, "far_mm": far})


def _settings(capture: Capture, sensor: str | None) -> tuple[Settings, Imager | None]:
    """Settings and imager of the sensor or of the capture, whatever range was asked for."""
    own = capture.settings.get("decoder") if sensor is None else None
    if own is not None:
        return _brought(capture, own)
    name = sensor or (capture.sensor if capture.sensor in presets() else None)
    if name is not None:
        eye = capture.rig.reference
        known = load_recorded_rig(name, (eye.width, eye.height))
        return known.settings, _of_bits(known.imager, capture.bits)
    technology = technology_of(capture.technology)
    near, far = technology.range_mm
    table = {"near_mm": capture.settings.get("near_mm", near), "far_mm": capture.settings.get("far_mm", far)}
    frames = max((len(stack) for stack in capture.images.values()), default=0)
    if technology.settings[0] is MatcherSettings and frames - bool(capture.settings.get("ambient_image")) > 1:
        table["method"] = "correlation"
    return validate(f"capture of {capture.sensor}: settings.json", table, technology.settings[0]), None


def _brought(capture: Capture, own: Any) -> tuple[Settings, Imager | None]:
    """Settings and imager that a capture was told by a simulation, or by an import from the file of its sensor."""
    kind = technology_of(capture.technology).settings[0]
    brought = validate(
        f"capture of {capture.sensor}: settings.json",
        {"decoder": own, "imager": capture.settings.get("imager")},
        create_model("Brought", __base__=_Imaged, decoder=(kind, ...)),
    )
    settings: Settings = getattr(brought, "decoder")  # noqa: B009 - a field of a model made just now
    return settings, None if brought.imager is None else _of_bits(imager_of(brought.imager), capture.bits)


def _of_bits(imager: Imager | None, bits: int) -> Imager | None:
    """The imager, if it makes images of so many bits."""
    return imager if imager is not None and imager.bits == bits else None


def settings_are_known(capture: Capture, sensor: str | None) -> bool:
    """Whether a user, the capture or a preset brings the settings; else those of the technology are taken."""
    return sensor is not None or "decoder" in capture.settings or capture.sensor in presets()


def range_is_known(capture: Capture, sensor: str | None, range_mm: tuple[float, float] | None) -> bool:
    """Whether a user, a sensor or the capture names the depths that are searched; else a matcher takes the usual ones.

    Arguments as of :func:`decoder_settings`. A decoder of light codes, and of a device's own map, takes all depths.
    """
    if capture.technology not in ("active_stereo", "reference_stereo") or sensor is not None or range_mm is not None:
        return True
    return capture.sensor in presets() or bool({"near_mm", "range_mm", "decoder"} & set(capture.settings))


def with_options(settings: Settings, block: int | None, contrast: float | None) -> Settings:
    """Settings of a decoder with another side of its blocks [px] or another least contrast [DN of 8 bits].

    Raises
    ------
    InputError
        If the decoder has no such setting, or does not allow the value.
    """
    asked = {"--block": ("block_size", block), "--contrast": ("minimum_contrast_dn", contrast)}
    if isinstance(settings, DecoderSettings):
        asked["--contrast"] = ("minimum_modulation_dn", contrast)
    table = {}
    for option, (key, value) in asked.items():
        if value is None:
            continue
        if key not in type(settings).model_fields:
            raise InputError(option, "", f"{value:g}", f"nothing: {type(settings).__name__} have none of it")
        table[key] = value
    return validate("mitsim decode", settings.model_dump() | table, type(settings)) if table else settings


def sensor_geometry(sensor: Sensor) -> Geometry:
    """What the captures of a sensor need prepared once."""
    technology = technology_of(sensor.technology)
    pattern = sensor.pattern if isinstance(sensor.pattern, technology.patterns) else None
    return technology.geometry(sensor.rig, sensor.settings, pattern)


def capture_geometry(capture: Capture, settings: Settings) -> Geometry:
    """What a capture needs prepared once, of its own rig and technology.

    Raises
    ------
    InputError
        If its technology, its pattern or its rig is not what it must be.
    """
    technology = technology_of(capture.technology)
    return technology.geometry(capture.rig, settings, capture_pattern(capture))


def capture_pattern(capture: Capture) -> Pattern | None:
    """Return the pattern that a capture names, if its technology asks for one.

    Raises
    ------
    InputError
        If its settings name none, or one of another technology.
    """
    technology = technology_of(capture.technology)
    if not technology.patterns:
        return None
    table = {"pattern": capture.settings.get("pattern")}
    pattern = validate(f"capture of {capture.sensor}: settings.json", table, _Coded).pattern
    if not isinstance(pattern, technology.patterns):
        raise InputError("capture", "settings.pattern.kind", pattern.kind, f"a kind that {capture.technology} has")
    return pattern


def capture_cloud(
    capture: Capture,
    settings: Settings,
    geometry: Geometry | None = None,
    roi: Roi | None = None,
    imager: Imager | MeasuredNoise | None = None,
) -> PointCloud:
    """Decode a capture.

    Parameters
    ----------
    geometry
        Saves preparing the capture's rig again. Of a device's own map, whose grid need not be that of its sensor, it
        only says which grid ``roi`` belongs to.
    roi
        Region of the cloud's grid: decode only this. Pixels outside are ``NO_SURFACE``, and so are those that the
        capture says were not read out.
    imager
        The imager that took the capture, or the noise measured in it. With it each point gets the standard deviation
        that this noise causes, where the decoder can propagate it; points of a bracket get none.

    Raises
    ------
    InputError
        If the settings are those of another technology, or the capture is not what it says.
    """
    technology = technology_of(capture.technology)
    if not isinstance(settings, technology.settings):
        allowed = f"one that {type(settings).__name__} decodes"
        raise InputError("capture", "technology", repr(capture.technology), allowed)
    pattern = capture_pattern(capture)
    if roi is not None and geometry is not None:
        roi = checked_roi(roi, geometry.grid.width, geometry.grid.height, "capture_cloud")
    if technology.measured:
        return _device_cloud(capture, technology, settings, geometry, roi)
    geometry = geometry or technology.geometry(capture.rig, settings, pattern)
    if roi is not None:
        roi = checked_roi(roi, geometry.grid.width, geometry.grid.height, "capture_cloud")
    exposures, read_out = bracket_of(capture), read_out_of(capture)
    images, full_scale = capture.images, 2.0**capture.bits - 1
    if exposures is not None and not isinstance(settings, DeviceMapSettings):
        images, full_scale = _merged(capture, exposures, read_out)
        # levels are those of the shortest exposure, and what can be told from noise is known from the longest
        settings, imager = settings.at_exposure(min(exposures) / max(exposures)), None
    return technology.decode(Images(capture, images, full_scale, imager, roi, read_out), geometry, settings, pattern)


def read_out_of(capture: Capture) -> dict[str, Roi]:
    """Return the region that was read out of each camera, by camera; cameras that were read out whole are left out.

    Raises
    ------
    InputError
        If the capture names a camera that it does not have, or a region that is not in the image.
    """
    where = f"capture of {capture.sensor}: settings.json"
    table = validate(where, {"read_out": capture.settings.get("read_out", {})}, _Read).read_out
    out: dict[str, Roi] = {}
    for name, numbers in table.items():
        if name not in capture.rig.cameras:
            raise InputError(where, "read_out", repr(name), ", ".join(capture.rig.cameras))
        camera = capture.rig.cameras[name]
        out[name] = Roi(*numbers)
        if not out[name].fits(camera.width, camera.height):
            allowed = f"[left, top, width, height] within {camera.width} x {camera.height} pixels"
            raise InputError(where, f"read_out.{name}", list(numbers), allowed)
    return out


def _device_cloud(
    capture: Capture, technology: Technology, settings: Settings, geometry: Geometry | None, roi: Roi | None
) -> PointCloud:
    """Return the cloud of a device's own map, on the map's own grid; ``roi`` is of the grid of ``geometry``, if any."""
    prepared = isinstance(geometry, DeviceMapGeometry)
    own = geometry if prepared and geometry else technology.geometry(capture.rig, settings, None)
    if roi is not None and geometry is not None and not prepared:
        roi = roi_of_other_grid(geometry.grid, own.grid, roi, settings.near_mm, settings.far_mm)
        if roi is None:
            return unseen_cloud(own, capture.sensor, capture.source)
    return technology.decode(Images(capture, {}, 1.0, None, roi, {}), own, settings, None)


def bracket_of(capture: Capture) -> list[float] | None:
    """Exposures [s] of a capture that was taken with several; None of one that was not."""
    exposures = capture.settings.get("exposure_s")
    return exposures if isinstance(exposures, list) and len(exposures) > 1 else None


def _merged(
    capture: Capture, exposures: list[float], read_out: dict[str, Roi]
) -> tuple[dict[str, NDArray[np.unsignedinteger[Any]]], float]:
    """Images of every camera, 0 where they were not read out, and their full scale [DN]."""
    full_scale = 2**capture.bits - 1
    merged: dict[str, NDArray[np.unsignedinteger[Any]]] = {}
    scale = 65535.0
    for name, stack in capture.images.items():
        if len(stack) % len(exposures):
            where = f"capture of {capture.sensor}"
            raise InputError(where, "images", f"{len(stack)} of {name}", f"a multiple of {len(exposures)} exposures")
        part = read_out.get(name, Roi.whole(stack.shape[2], stack.shape[1])).slices
        result = merge_exposures(
            stack.reshape(len(exposures), -1, *stack.shape[1:])[:, :, *part],
            exposures,
            float(capture.settings.get("black_level_dn", 0.0)),
            full_scale,
            float(capture.settings.get("gamma", 1.0)),
        )
        merged[name] = np.zeros((len(stack) // len(exposures), *stack.shape[1:]), result.levels.dtype)
        merged[name][:, *part], scale = result.levels, float(result.full_scale)
    return merged, scale
