"""From a capture to its cloud, whatever took it: merge its exposures, choose the decoder and its settings, decode."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.documents import Document, validate
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decode.exposures import merge_exposures
from mitsim.decode.stereo import StereoGeometry, decode_stereo, stereo_geometry
from mitsim.decode.structured_light import decode_structured_light
from mitsim.decode.structured_light_geometry import StructuredLightGeometry, structured_light_geometry
from mitsim.errors import InputError
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, LightCode, PhaseShift, roles
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor, load_sensor, presets

#: searched where neither a preset nor the recording says how near and far the sensor looks [mm]
DEFAULT_RANGE_MM = (300.0, 2000.0)

Settings = MatcherSettings | DecoderSettings
Geometry = StereoGeometry | StructuredLightGeometry


class _Coded(Document):
    """The part of a capture's settings that names its light code."""

    pattern: Annotated[PhaseShift | GrayCode | GrayCodePhaseShift, Field(discriminator="kind")]


def decoder_settings(capture: Capture, sensor: str | None = None) -> tuple[Settings, Imager | None]:
    """Settings to decode a capture with, and the imager that took it.

    Of ``sensor`` if given, else of the preset of its name, else the capture's own range and an unknown imager.
    """
    name = sensor or (capture.sensor if capture.sensor in presets() else None)
    if name is not None:
        known = load_sensor(name)
        return known.settings, known.imager if known.imager.bits == capture.bits else None
    near, far = (capture.settings.get(key, default) for key, default in zip(
        ("near_mm", "far_mm"), DEFAULT_RANGE_MM, strict=True))  # fmt: skip
    kind = MatcherSettings if capture.technology == "active_stereo" else DecoderSettings
    return kind(near_mm=float(near), far_mm=float(far)), None


def sensor_geometry(sensor: Sensor) -> Geometry:
    """What the captures of a sensor need prepared once."""
    code = sensor.pattern if isinstance(sensor.pattern, LightCode) else None
    return _geometry(sensor.rig, sensor.technology, sensor.settings, code)


def capture_cloud(
    capture: Capture, settings: Settings, geometry: Geometry | None = None,
    window: tuple[int, int, int, int] | None = None, imager: Imager | None = None,
) -> PointCloud:  # fmt: skip
    """Decode a capture.

    Parameters
    ----------
    geometry
        Saves preparing the capture's rig again.
    window
        Lets stereo decode a part only.
    imager
        Which took the capture: with it each point of structured light is told the standard deviation that its noise
        makes. Of a bracket it is not told.

    Raises
    ------
    InputError
        If the settings are those of another technology, or the capture is not what it says.
    """
    code = None if capture.technology == "active_stereo" else _code(capture)
    geometry = geometry or _geometry(capture.rig, capture.technology, settings, code)
    exposures = _bracket(capture)
    images, full_scale = (capture.images, 2.0**capture.bits - 1) if exposures is None else _merged(capture, exposures)
    if exposures is not None:
        # levels are those of the shortest exposure, and what can be told from noise is known from the longest
        settings, imager = settings.at_exposure(min(exposures) / max(exposures)), None
    if isinstance(geometry, StereoGeometry) and isinstance(settings, MatcherSettings):
        left, right = (stack[0] for stack in list(images.values())[:2])
        return decode_stereo(
            left, right, geometry, settings, sensor=capture.sensor, source=capture.source, full_scale=full_scale,
            window=window,
        )  # fmt: skip
    if isinstance(geometry, StructuredLightGeometry) and isinstance(settings, DecoderSettings) and code is not None:
        name, stack = next(iter(images.items()))
        projector = geometry.projector
        count = len(roles(code, projector.width, projector.height))
        if len(stack) < count:
            raise InputError("capture", "images", f"{len(stack)} of {name}", f"{count}, as the pattern has")
        return decode_structured_light(
            stack[:count], geometry, name, code, settings, sensor=capture.sensor, source=capture.source,
            full_scale=full_scale, imager=imager,
        )  # fmt: skip
    raise InputError("capture", "technology", repr(capture.technology), f"one that {type(settings).__name__} decodes")


def _geometry(rig: Rig, technology: str, settings: Settings, code: LightCode | None) -> Geometry:
    if technology == "active_stereo":
        return stereo_geometry(rig)
    if technology == "structured_light" and code is not None:
        return structured_light_geometry(rig, next(iter(rig.cameras)), code, settings.near_mm, settings.far_mm)
    raise InputError("capture", "technology", repr(technology), "active_stereo, structured_light")


def _code(capture: Capture) -> LightCode:
    if capture.technology != "structured_light":
        raise InputError("capture", "technology", repr(capture.technology), "active_stereo, structured_light")
    table = {"pattern": capture.settings.get("pattern")}
    return validate(f"capture of {capture.sensor}: settings.json", table, _Coded).pattern


def _bracket(capture: Capture) -> list[float] | None:
    exposures = capture.settings.get("exposure_s")
    return exposures if isinstance(exposures, list) and len(exposures) > 1 else None


def _merged(capture: Capture, exposures: list[float]) -> tuple[dict[str, NDArray[np.unsignedinteger[Any]]], float]:
    """Images of every camera, and their full scale [DN]."""
    full_scale = 2**capture.bits - 1
    merged: dict[str, NDArray[np.unsignedinteger[Any]]] = {}
    scale = 65535.0
    for name, stack in capture.images.items():
        if len(stack) % len(exposures):
            where = f"capture of {capture.sensor}"
            raise InputError(where, "images", f"{len(stack)} of {name}", f"a multiple of {len(exposures)} exposures")
        result = merge_exposures(
            stack.reshape(len(exposures), -1, *stack.shape[1:]), exposures,
            float(capture.settings.get("black_level_dn", 0.0)), full_scale,
            float(capture.settings.get("gamma", 1.0)),
        )  # fmt: skip
        merged[name], scale = result.levels, float(result.full_scale)
    return merged, scale
