"""Decode a capture from any source to a point cloud: choose the decoder's settings, merge its exposures, decode.

Signal chain: capture -> settings and imager -> merged exposures, if there are several -> decoder of its technology
(:mod:`mitsim.decode.decoder_registry`) -> point cloud.

The settings of a capture may name regions that were read out (``read_out``: camera -> left, top, width, height). Only
these regions are then merged and decoded, and the rest of the image is missing.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model

from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.capture.capture import Capture
from mitsim.decode.decoder_registry import Geometry, Images, Pattern, Settings, Technology, technology_of
from mitsim.decode.device_maps import DeviceMapGeometry, DeviceMapSettings, roi_of_other_grid
from mitsim.decode.exposures import merge_exposures
from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.grid_cloud import empty_cloud
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import DescribedImager, Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.preset import Sensor, load_sensor, presets

__all__ = [
    "Geometry",
    "Settings",
    "bracket_exposures",
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


class _PatternSettings(Document):
    """The part of a capture's settings with its pattern."""

    pattern: Annotated[
        DotPattern | PhaseShift | GrayCode | GrayCodePhaseShift | ImageSequence | AmplitudeModulation,
        Field(discriminator="kind"),
    ]


class _ReadOutSettings(Document):
    """The part of a capture's settings with each camera's region that was read out: left, top, width, height [px]."""

    read_out: dict[str, tuple[int, int, int, int]] = Field(default_factory=dict)


class _RangeSettings(Document):
    """The part of a capture's settings with the depths that its user requested."""

    range_mm: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(le=1e6)]] | None = None


class _ImagerSettings(Document):
    """The part of a capture's settings with its imager."""

    imager: DescribedImager | None = None


def decoder_settings(
    capture: Capture, sensor: str | None = None, range_mm: tuple[float, float] | None = None
) -> tuple[Settings, Imager | None]:
    """Return the settings to decode a capture with, and the imager that took it.

    The first of these that exists is used:

    1. the settings of ``sensor``
    2. the settings in the capture
    3. the settings of the preset with the capture's sensor name
    4. the technology's settings with the capture's range, and no imager. A stereo capture of several frames, as with a
       shifted pattern, is then matched by correlation.

    ``sensor``: preset or sensor file. ``range_mm``: nearest and farthest depth [mm], which replace those of the
    settings. Without both, the range that was requested at the import of the capture is used, if there is one.

    Raises
    ------
    InputError
        If the sensor is not known, or the capture's settings or range are invalid.
    """
    where = f"capture of {capture.sensor}: settings.json"
    if range_mm is None and sensor is None:
        range_mm = validate(where, {"range_mm": capture.settings.get("range_mm")}, _RangeSettings).range_mm
    settings, imager = _settings(capture, sensor)
    return in_range(settings, range_mm, where), imager


def in_range(settings: Settings, range_mm: tuple[float, float] | None, where: str) -> Settings:
    """Return settings with the depths [mm] of ``range_mm`` as search range; unchanged if it is None.

    Raises
    ------
    InputError
        If the range is invalid. ``where`` says in the message where it was given.
    """
    if range_mm is None:
        return settings
    near, far = range_mm
    if not 0 < near < far <= 1e6:
        raise InputError(where, "range_mm", f"{near:g} {far:g}", "near before far, over 0, in mm")
    return settings.model_copy(update={"near_mm": near, "far_mm": far})


def _settings(capture: Capture, sensor: str | None) -> tuple[Settings, Imager | None]:
    """Return settings and imager of the sensor or of the capture, without a requested range."""
    table = capture.settings.get("decoder") if sensor is None else None
    if table is not None:
        return _settings_of_capture(capture, table)
    name = sensor or (capture.sensor if capture.sensor in presets() else None)
    if name is not None:
        camera = capture.rig.reference
        other = load_sensor(name, "decoding", (camera.width, camera.height))
        return other.settings, _if_bits_match(other.described_imager, capture.bits)
    technology = technology_of(capture.technology)
    near, far = technology.range_mm
    defaults = {"near_mm": capture.settings.get("near_mm", near), "far_mm": capture.settings.get("far_mm", far)}
    frames = max((len(stack) for stack in capture.images.values()), default=0)
    if technology.settings[0] is MatcherSettings and frames - bool(capture.settings.get("ambient_image")) > 1:
        defaults["method"] = "correlation"
    return validate(f"capture of {capture.sensor}: settings.json", defaults, technology.settings[0]), None


def _settings_of_capture(capture: Capture, decoder: Any) -> tuple[Settings, Imager | None]:
    """Return settings and imager in the capture, which a simulation or an import with a sensor file has written."""
    model = technology_of(capture.technology).settings[0]
    validated = validate(
        f"capture of {capture.sensor}: settings.json",
        {"decoder": decoder, "imager": capture.settings.get("imager")},
        create_model("SettingsOfCapture", __base__=_ImagerSettings, decoder=(model, ...)),
    )
    settings: Settings = getattr(validated, "decoder")  # noqa: B009 - a field of a model made just now
    return settings, _if_bits_match(validated.imager, capture.bits)


def _if_bits_match(imager: Imager | None, bits: int) -> Imager | None:
    """Return the imager if its images have this number of bits, else None."""
    return imager if imager is not None and imager.bits == bits else None


def settings_are_known(capture: Capture, sensor: str | None) -> bool:
    """Return whether a user, the capture or a preset gives the settings; otherwise those of the technology are used."""
    return sensor is not None or "decoder" in capture.settings or capture.sensor in presets()


def range_is_known(capture: Capture, sensor: str | None, range_mm: tuple[float, float] | None) -> bool:
    """Return whether a user, a sensor or the capture gives the depths to search; else a matcher uses the default.

    Arguments as for :func:`decoder_settings`. Decoders of codes and of device maps accept all depths: always True.
    """
    if capture.technology not in ("active_stereo", "reference_stereo") or sensor is not None or range_mm is not None:
        return True
    return capture.sensor in presets() or bool({"near_mm", "range_mm", "decoder"} & set(capture.settings))


def with_options(settings: Settings, block: int | None, contrast: float | None) -> Settings:
    """Return settings of a decoder with another block size [px] or another least contrast [DN of 8 bit].

    Raises
    ------
    InputError
        If the decoder has no such setting, or does not allow the value.
    """
    requested = {"--block": ("block_size", block), "--contrast": ("minimum_contrast_dn", contrast)}
    if isinstance(settings, DecoderSettings):
        requested["--contrast"] = ("minimum_modulation_dn", contrast)
    table = {}
    for option, (key, value) in requested.items():
        if value is None:
            continue
        if key not in type(settings).model_fields:
            raise InputError(option, "", f"{value:g}", f"nothing: {type(settings).__name__} have no such setting")
        table[key] = value
    return validate("mitsim decode", settings.model_dump() | table, type(settings)) if table else settings


def sensor_geometry(sensor: Sensor) -> Geometry:
    """Return the geometry that is prepared once for all captures of a sensor."""
    technology = technology_of(sensor.technology)
    pattern = sensor.pattern if isinstance(sensor.pattern, technology.patterns) else None
    return technology.geometry(sensor.rig, sensor.settings, pattern)


def capture_geometry(capture: Capture, settings: Settings) -> Geometry:
    """Return the geometry for a capture, from its own rig and technology.

    Raises
    ------
    InputError
        If its technology, pattern or rig is invalid.
    """
    technology = technology_of(capture.technology)
    return technology.geometry(capture.rig, settings, capture_pattern(capture))


def capture_pattern(capture: Capture) -> Pattern | None:
    """Return the pattern of a capture, or None if its technology does not need one.

    Raises
    ------
    InputError
        If its settings have no pattern, or one of another technology.
    """
    technology = technology_of(capture.technology)
    if not technology.patterns:
        return None
    table = {"pattern": capture.settings.get("pattern")}
    pattern = validate(f"capture of {capture.sensor}: settings.json", table, _PatternSettings).pattern
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
    """Decode a capture to points in the sensor frame [mm].

    Parameters
    ----------
    capture, settings
        The capture, and settings of its technology.
    geometry
        Saves preparing the capture's rig again. For a device's own map, whose grid may differ from that of its sensor,
        it only defines the grid of ``roi``.
    roi
        Region of the cloud's grid to decode; None for all. Pixels outside it are ``NO_SURFACE``, and so are pixels that
        were not read out.
    imager
        The imager that took the capture, or the noise measured in it. Each point then gets the standard deviation by
        this noise, if the decoder can propagate it. Points of a bracket get none.

    Raises
    ------
    InputError
        If the settings belong to another technology, or the capture is inconsistent.
    """
    technology = technology_of(capture.technology)
    if not isinstance(settings, technology.settings):
        allowed = f"one that {type(settings).__name__} decodes"
        raise InputError("capture", "technology", repr(capture.technology), allowed)
    pattern = capture_pattern(capture)
    if roi is not None and geometry is not None:
        roi = checked_roi(roi, geometry.grid.width, geometry.grid.height, "capture_cloud")
    if technology.from_device:
        return _device_cloud(capture, technology, settings, geometry, roi)
    geometry = geometry or technology.geometry(capture.rig, settings, pattern)
    if roi is not None:
        roi = checked_roi(roi, geometry.grid.width, geometry.grid.height, "capture_cloud")
    exposures, read_out = bracket_exposures(capture), read_out_of(capture)
    images, full_scale = capture.images, 2.0**capture.bits - 1
    if exposures is not None and not isinstance(settings, DeviceMapSettings):
        images, full_scale = _merged_exposures(capture, exposures, read_out)
        # levels refer to the shortest exposure, and the noise limits of the settings to the longest
        settings, imager = settings.at_exposure(min(exposures) / max(exposures)), None
    return technology.decode(Images(capture, images, full_scale, imager, roi, read_out), geometry, settings, pattern)


def read_out_of(capture: Capture) -> dict[str, Roi]:
    """Return the region that was read out of each camera; cameras that were read out completely are omitted.

    Raises
    ------
    InputError
        If the capture names a camera that it does not have, or a region outside the image.
    """
    where = f"capture of {capture.sensor}: settings.json"
    table = validate(where, {"read_out": capture.settings.get("read_out", {})}, _ReadOutSettings).read_out
    regions: dict[str, Roi] = {}
    for name, numbers in table.items():
        if name not in capture.rig.cameras:
            raise InputError(where, "read_out", repr(name), ", ".join(capture.rig.cameras))
        camera = capture.rig.cameras[name]
        regions[name] = Roi(*numbers)
        if not regions[name].fits(camera.width, camera.height):
            allowed = f"[left, top, width, height] within {camera.width} x {camera.height} pixels"
            raise InputError(where, f"read_out.{name}", list(numbers), allowed)
    return regions


def _device_cloud(
    capture: Capture, technology: Technology, settings: Settings, geometry: Geometry | None, roi: Roi | None
) -> PointCloud:
    """Return the cloud of a device's own map, on the map's grid; ``roi`` is of the grid of ``geometry``, if any."""
    is_map_geometry = isinstance(geometry, DeviceMapGeometry)
    map_geometry = geometry if is_map_geometry and geometry else technology.geometry(capture.rig, settings, None)
    if roi is not None and geometry is not None and not is_map_geometry:
        roi = roi_of_other_grid(geometry.grid, map_geometry.grid, roi, settings.near_mm, settings.far_mm)
        if roi is None:
            return empty_cloud(map_geometry, capture.sensor, capture.source)
    return technology.decode(Images(capture, {}, 1.0, None, roi, {}), map_geometry, settings, None)


def bracket_exposures(capture: Capture) -> list[float] | None:
    """Return the exposures [s] of a capture with several; None for one exposure."""
    exposures = capture.settings.get("exposure_s")
    return exposures if isinstance(exposures, list) and len(exposures) > 1 else None


def _merged_exposures(
    capture: Capture, exposures: list[float], read_out: dict[str, Roi]
) -> tuple[dict[str, NDArray[np.unsignedinteger[Any]]], float]:
    """Return merged images of each camera, 0 where they were not read out, and their full scale [DN]."""
    full_scale = 2**capture.bits - 1
    merged: dict[str, NDArray[np.unsignedinteger[Any]]] = {}
    scale = 65535.0
    for name, stack in capture.images.items():
        if len(stack) % len(exposures):
            where = f"capture of {capture.sensor}"
            raise InputError(where, "images", f"{len(stack)} of {name}", f"a multiple of {len(exposures)} exposures")
        region = read_out.get(name, Roi.whole(stack.shape[2], stack.shape[1])).slices
        result = merge_exposures(
            stack.reshape(len(exposures), -1, *stack.shape[1:])[:, :, *region],
            exposures,
            float(capture.settings.get("black_level_dn", 0.0)),
            full_scale,
            float(capture.settings.get("gamma", 1.0)),
        )
        merged[name] = np.zeros((len(stack) // len(exposures), *stack.shape[1:]), result.levels.dtype)
        merged[name][:, *region], scale = result.levels, float(result.full_scale)
    return merged, scale
