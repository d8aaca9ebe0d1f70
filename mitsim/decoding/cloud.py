"""Decode a capture from any source to a point cloud: choose the decoder's settings, merge its exposures, decode.

Signal chain: capture -> settings and imager -> merged exposures, if there are several -> decoder of its technology
(:mod:`mitsim.decoding.decoder_registry`) -> point cloud.

A capture may name regions that were read out (``read_out``: camera -> left, top, width, height). Only
these regions are then merged and decoded, and the rest of the image is missing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import SETTINGS_OF, Settings
from mitsim.decoding.decoder_registry import (
    Coordinates,
    Geometry,
    Images,
    Pattern,
    Technology,
    accepted_settings,
    technology_of,
)
from mitsim.decoding.device_maps import DeviceMapGeometry, roi_of_other_grid
from mitsim.decoding.exposures import MERGED_FULL_SCALE, companded, merge_exposures
from mitsim.decoding.grey_levels import MeasuredNoise, with_dark_noise
from mitsim.decoding.grid_cloud import empty_cloud
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.sensor.decoder_settings import DecoderSettings, DeviceMapSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.projector_images import ImagesDescription, ProjectorImages
from mitsim.sensor.sensor import Sensor

__all__ = [
    "Geometry",
    "Settings",
    "capture_cloud",
    "capture_geometry",
    "capture_pattern",
    "decoder_settings",
    "in_range",
    "sensor_geometry",
    "settings_in_words",
    "with_options",
]


#: said of a range that nobody has stated
ASSUMED_RANGE = " (assumed: the capture has no range; set --range)"


def decoder_settings(
    capture: Capture, sensor: Sensor | str | Path | None = None, range_mm: tuple[float, float] | None = None
) -> tuple[Settings, Imager | None]:
    """Return the settings to decode a capture with, and the imager that took it.

    The first of these that exists is used:

    1. the settings of ``sensor``
    2. the settings in the capture
    3. the settings of the preset with the capture's sensor name
    4. the technology's settings with the capture's range, and no imager. A stereo capture of several frames, as with a
       shifted pattern, is then matched by correlation.

    ``sensor``: loaded, or a preset or sensor file. ``range_mm``: nearest and farthest depth [mm], which replace those
    of the settings. Without both, the range that was requested at the import of the capture is used, if there is one.
    Raises InputError if the sensor is not known, or the capture's settings or range are invalid.
    """
    if range_mm is None and sensor is None:
        range_mm = capture.decoding.range_mm
    settings, imager = _settings(capture, sensor)
    return in_range(settings, range_mm, _where(capture)), imager_of_bits(capture, imager)


def imager_of_bits(capture: Capture, imager: Imager | None) -> Imager | None:
    """Return the imager whose noise a capture has, None if its grey levels have other bits."""
    return imager if imager is not None and imager.bits == capture.bits else None


def _where(capture: Capture) -> str:
    return f"capture of {capture.sensor}: settings.json"


def in_range(settings: Settings, range_mm: tuple[float, float] | None, where: str) -> Settings:
    """Return settings that search the depths ``range_mm``, if given; InputError names ``where`` it was given."""
    if range_mm is None:
        return settings
    near, far = range_mm
    if not 0 < near < far <= 1e6:
        raise InputError(where, "range_mm", f"{near:g} {far:g}", "near before far, over 0, in mm")
    return settings.model_copy(update={"near_mm": near, "far_mm": far})


def _settings(capture: Capture, sensor: Sensor | str | Path | None) -> tuple[Settings, Imager | None]:
    """Return settings and imager of the sensor or of the capture, without a requested range."""
    if isinstance(sensor, Sensor):
        return sensor.settings, sensor.described_imager
    stored, technology = capture.decoding, technology_of(capture.technology)
    model = SETTINGS_OF[capture.technology]
    if sensor is None and stored.decoder is not None:
        if not isinstance(stored.decoder, model):
            found, allowed = type(stored.decoder).__name__, f"{model.__name__}, which decode {capture.technology}"
            raise InputError(_where(capture), "decoder", found, allowed)
        return stored.decoder, stored.imager
    name = sensor or (capture.sensor if capture.sensor in presets() else None)
    if name is not None:
        camera = capture.rig.reference
        other = load_sensor(name, "decoding", (camera.width, camera.height))
        return other.settings, other.described_imager
    near, far = technology.range_mm
    defaults: dict[str, Any] = {
        "near_mm": near if stored.near_mm is None else stored.near_mm,
        "far_mm": far if stored.far_mm is None else stored.far_mm,
    }
    frames = max((len(stack) for stack in capture.images.values()), default=0)
    if model is MatcherSettings and frames - stored.ambient_image > 1:
        defaults["method"] = "correlation"
    return validate(_where(capture), defaults, model), None


def settings_in_words(
    capture: Capture, settings: Settings, sensor: str | None = None, range_mm: tuple[float, float] | None = None
) -> str:
    """Describe the depths that are decoded, and whose settings are used.

    Decoders of codes and of device maps accept all depths; a matcher without a range searches the default.

    Parameters
    ----------
    capture, settings
        Capture to decode, and settings of its decoder.
    sensor
        Sensor that the user names, as for :func:`decoder_settings`.
    range_mm
        Nearest and farthest depth that the user requests [mm].

    See Also
    --------
    decoder_settings : the settings
    """
    stored, preset = capture.decoding, capture.sensor in presets()
    stated = preset or any((sensor, range_mm, stored.near_mm, stored.range_mm, stored.decoder))
    assumed = "" if stated or not isinstance(settings, MatcherSettings) else ASSUMED_RANGE
    by = f"settings of {sensor or capture.sensor}"
    if capture.source == "simulated" and not (sensor or stored.decoder or preset):
        by = "default settings, since settings.json has none (add --sensor FILE for those of its sensor)"
    return f"{settings.near_mm:g} to {settings.far_mm:g} mm{assumed}; {by}"


def with_options(settings: Settings, block: int | None, contrast: float | None) -> Settings:
    """Return settings of a decoder with another block size [px] or another least contrast [DN of 8 bit].

    Raises InputError if the decoder has no such setting, or does not allow the value.
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
    unknown = technology.patterns and not issubclass(ProjectorImages, technology.patterns)
    if unknown and isinstance(sensor.pattern, ProjectorImages):
        raise unknown_code(f"sensor {sensor.name}", sensor.pattern.count)
    pattern = sensor.pattern if isinstance(sensor.pattern, technology.patterns) else None
    return technology.geometry(sensor.rig, sensor.settings, pattern)


def capture_geometry(capture: Capture, settings: Settings) -> Geometry:
    """Return the geometry for a capture, from its own rig and technology.

    Raises InputError if its technology, pattern or rig is invalid.
    """
    technology = technology_of(capture.technology)
    return technology.geometry(capture.rig, settings, capture_pattern(capture))


def stored_geometry(capture: Capture, settings: Settings, sensor: Sensor | str | Path | None) -> Geometry | None:
    """Return the geometry of a capture of one camera whose sensor file has the image of its mask; None for another."""
    if capture.technology != "reference_stereo" or not isinstance(capture.decoding.pattern, ImagesDescription):
        return None
    loaded = load_sensor(sensor, "decoding") if isinstance(sensor, str | Path) else sensor
    pattern = None if loaded is None else loaded.pattern
    same_pattern = isinstance(pattern, ProjectorImages) and pattern.description == capture.decoding.pattern
    return technology_of(capture.technology).geometry(capture.rig, settings, pattern) if same_pattern else None


def unknown_code(where: str, count: int) -> InputError:
    """Return the error that mitsim cannot decode images of the user's own, and what to do."""
    return InputError(
        where,
        "pattern",
        f"{count} images of your own, whose code mitsim does not know",
        "a code of mitsim, to decode",
        "decode capture.images[camera], one image (H, W) for each of yours, to the projector column that each pixel "
        "sees; ms.triangulate(capture, columns) makes the cloud. render(..., truth=True) gives the true columns",
    )


def capture_pattern(capture: Capture) -> Pattern | None:
    """Return the pattern of a capture, or None if its technology does not need one.

    Raises InputError if it has no pattern, one of another technology, or images of the user's own in place of a code.
    """
    technology, pattern = technology_of(capture.technology), capture.decoding.pattern
    if not technology.patterns:
        return None
    if pattern is None:
        raise InputError(_where(capture), "pattern", "nothing", "a value: this key is required")
    if isinstance(pattern, ImagesDescription) and not issubclass(ImagesDescription, technology.patterns):
        raise unknown_code(f"capture of {capture.sensor}", pattern.count)
    if not isinstance(pattern, technology.patterns):
        raise InputError("capture", "settings.pattern.kind", pattern.kind, f"a kind that {capture.technology} has")
    return pattern


def capture_cloud(
    capture: Capture,
    settings: Settings,
    geometry: Geometry | None = None,
    roi: Roi | None = None,
    imager: Imager | MeasuredNoise | None = None,
    coordinates: Coordinates | None = None,
) -> PointCloud:
    """Decode a capture to points in the sensor frame [mm].

    Raises InputError if the settings belong to another technology, or the capture is inconsistent.

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
    coordinates
        Projector coordinates of structured light, if the images are decoded already
        (:class:`mitsim.decoding.coded_images.CodedImages`).
    """
    technology = technology_of(capture.technology)
    if not isinstance(settings, accepted_settings(capture.technology)):
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
    exposures, read_out = capture.decoding.bracket_s, capture.decoding.read_out
    imager = with_dark_noise(imager, capture.decoding.exposures_s)
    images, full_scale, linear_share = capture.images, 2.0**capture.bits - 1, 1.0
    if exposures is not None and not isinstance(settings, DeviceMapSettings):
        images, full_scale = _merged_exposures(capture, exposures, read_out)
        share, imager = min(exposures) / max(exposures), None
        of_8_bits = isinstance(settings, MatcherSettings) and settings.method != "correlation"
        if isinstance(geometry, StereoGeometry) or of_8_bits:  # correlation with a reference keeps linear levels
            black = capture.decoding.black_level_dn * full_scale / (2.0**capture.bits - 1)
            images = {name: companded(stack, black, share) for name, stack in images.items()}
        else:  # levels refer to the shortest exposure, and the noise limits of the settings to the longest
            settings, linear_share = settings.at_exposure(share), share
    shown = Images(capture, images, full_scale, imager, roi, read_out, coordinates, linear_share)
    return technology.decode(shown, geometry, settings, pattern)


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


def _merged_exposures(
    capture: Capture, exposures: tuple[float, ...], read_out: dict[str, Roi]
) -> tuple[dict[str, NDArray[np.uint16]], float]:
    """Return merged images of each camera, 0 where they were not read out, and their full scale [DN]."""
    full_scale = 2**capture.bits - 1
    merged: dict[str, NDArray[np.uint16]] = {}
    for name, stack in capture.images.items():
        if len(stack) % len(exposures):
            where = f"capture of {capture.sensor}"
            raise InputError(where, "images", f"{len(stack)} of {name}", f"a multiple of {len(exposures)} exposures")
        region = read_out.get(name, Roi.whole(stack.shape[2], stack.shape[1])).slices
        levels = merge_exposures(
            stack.reshape(len(exposures), -1, *stack.shape[1:])[:, :, *region],
            exposures,
            capture.decoding.black_level_dn,
            full_scale,
            capture.decoding.gamma,
        )
        merged[name] = np.zeros((len(stack) // len(exposures), *stack.shape[1:]), levels.dtype)
        merged[name][:, *region] = levels
    return merged, float(MERGED_FULL_SCALE)
