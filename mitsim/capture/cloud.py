"""From a capture to its cloud, whatever took it: merge its exposures, choose the decoder and its settings, decode.

What a technology needs is one entry of :data:`TECHNOLOGIES`: the settings of its decoder, what is prepared once from a
rig, and the way from images to a cloud.

Of a capture whose settings name a region that was read out (``read_out``: camera -> column, row, width, height), only
that is merged and decoded: the rest of its images is absent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.documents import Document, validate
from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decode.exposures import merge_exposures
from mitsim.decode.reference_matching import ReferenceGeometry, decode_reference, reference_geometry
from mitsim.decode.stereo import StereoGeometry, decode_stereo, stereo_geometry
from mitsim.decode.structured_light import decode_structured_light
from mitsim.decode.structured_light_geometry import StructuredLightGeometry, structured_light_geometry
from mitsim.decode.structured_light_stereo import decode_structured_light_stereo
from mitsim.decode.time_of_flight import TimeOfFlightGeometry, decode_time_of_flight, time_of_flight_geometry
from mitsim.decode.window import Window, checked_window, inside, overlap, unseen_cloud
from mitsim.errors import InputError
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, LightCode, PhaseShift, roles
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DiffractionSpots, DotPattern, RandomDots
from mitsim.sensor.preset import Sensor, load_sensor, presets

#: searched where neither a preset nor the recording says how near and far the sensor looks [mm]
DEFAULT_RANGE_MM = (300.0, 2000.0)

Settings = MatcherSettings | DecoderSettings | TimeOfFlightSettings
Geometry = StereoGeometry | ReferenceGeometry | StructuredLightGeometry | TimeOfFlightGeometry
Pattern = DotPattern | LightCode | AmplitudeModulation


class _Coded(Document):
    """The part of a capture's settings that names its pattern."""

    pattern: Annotated[
        DotPattern | PhaseShift | GrayCode | GrayCodePhaseShift | ImageSequence | AmplitudeModulation,
        Field(discriminator="kind"),
    ]


class _Read(Document):
    """The part of a capture's settings that says what was read out of each camera: column, row, width, height [px]."""

    read_out: dict[str, tuple[int, int, int, int]] = Field(default_factory=dict)


class _Decoded(Document):
    """The part of a capture's settings that its decoder is told, where the capture brings it."""

    decoder: DecoderSettings


@dataclass(frozen=True)
class Images:
    """What a decoder is given of a capture.

    ``stacks`` of every camera (images, H, W) [DN], the reference camera's first, a bracket's already merged;
    ``full_scale`` [DN]; ``imager`` that took them, None where nobody knows it; ``window`` (column, row, right, bottom)
    of the cloud's grid to which a decoder keeps, and ``read_out``, such a part of the image of each camera that was not
    read out whole.
    """

    capture: Capture
    stacks: dict[str, NDArray[np.unsignedinteger[Any]]]
    full_scale: float
    imager: Imager | None
    window: Window | None
    read_out: dict[str, Window]

    @property
    def first(self) -> tuple[str, NDArray[np.unsignedinteger[Any]]]:
        """Name and stack of the reference camera."""
        return next(iter(self.stacks.items()))

    @property
    def regions(self) -> tuple[Window | None, Window | None]:
        """What was read out of the first two cameras, None where all."""
        first, second = list(self.stacks)[:2]
        return self.read_out.get(first), self.read_out.get(second)

    def of_pixels(self) -> tuple[Window | None, bool]:
        """Window of a grid that is the raw image of the first camera, and whether anything of it was read out."""
        region = self.read_out.get(self.first[0])
        if region is None or self.window is None:
            return region or self.window, True
        shared = overlap(region, self.window)
        return shared, shared is not None

    def counted(self, count: int, camera: str | None = None) -> NDArray[np.unsignedinteger[Any]]:
        """The first ``count`` images of a camera, the reference if none is named; the scene's own light follows.

        Raises
        ------
        InputError
            If there are fewer.
        """
        name = camera or self.first[0]
        stack = self.stacks[name]
        if len(stack) < count:
            raise InputError("capture", "images", f"{len(stack)} of {name}", f"{count}, as the pattern has")
        return stack[:count]


@dataclass(frozen=True)
class Technology:
    """How the captures of one kind of sensor become clouds.

    ``settings``: type of what its decoder is told; ``patterns``: kinds of pattern that a capture must name, none where
    the decoder does not ask; ``geometry``: what is prepared once, of rig, settings and pattern; ``decode``: images,
    geometry, settings and pattern to a cloud.
    """

    settings: type[Settings]
    patterns: tuple[type[Pattern], ...]
    geometry: Callable[[Rig, Any, Any], Geometry]
    decode: Callable[[Images, Any, Any, Any], PointCloud]


def _stereo_geometry(rig: Rig, settings: MatcherSettings, pattern: None) -> StereoGeometry:
    return stereo_geometry(rig)


def _stereo(images: Images, geometry: StereoGeometry, settings: MatcherSettings, pattern: None) -> PointCloud:
    # the scene's own light comes last; SGBM takes one frame
    ambient = bool(images.capture.settings.get("ambient_image", False))
    left, right = (stack[: len(stack) - ambient] for stack in list(images.stacks.values())[:2])
    if settings.method == "sgbm":
        left, right = left[:1], right[:1]
    return decode_stereo(
        left, right, geometry, settings, sensor=images.capture.sensor, source=images.capture.source,
        full_scale=images.full_scale, window=images.window, read_out=images.regions,
    )  # fmt: skip


def _reference_geometry(rig: Rig, settings: MatcherSettings, pattern: DotPattern) -> ReferenceGeometry:
    if settings.reference_mm is None:
        raise InputError("matcher settings", "reference_mm", "none", "the depth of the reference plane",
                         "decode with the sensor's own file: --sensor")  # fmt: skip
    return reference_geometry(rig, pattern, settings.reference_mm)


def _reference(
    images: Images, geometry: ReferenceGeometry, settings: MatcherSettings, pattern: DotPattern
) -> PointCloud:
    return decode_reference(
        images.counted(1), geometry, settings, sensor=images.capture.sensor, source=images.capture.source,
        full_scale=images.full_scale, window=images.window, read_out=images.read_out.get(images.first[0]),
    )  # fmt: skip


def _structured_light_geometry(rig: Rig, settings: DecoderSettings, code: LightCode) -> Geometry:
    if settings.triangulate == "cameras":
        return stereo_geometry(rig)
    return structured_light_geometry(rig, next(iter(rig.cameras)), code, settings.near_mm, settings.far_mm)


def _structured_light(
    images: Images, geometry: StereoGeometry | StructuredLightGeometry, settings: DecoderSettings, code: LightCode
) -> PointCloud:
    projector = images.capture.rig.projector
    if projector is None:
        raise InputError("rig", "projector", "none", "a projector: at least the size of its pattern")
    if isinstance(geometry, StereoGeometry):
        count = len(roles(code, projector.width, projector.height))
        left, right = (images.counted(count, name) for name in list(images.stacks)[:2])
        return decode_structured_light_stereo(
            left, right, geometry, code, settings, projector_size=(projector.width, projector.height),
            sensor=images.capture.sensor, source=images.capture.source, full_scale=images.full_scale,
            imager=images.imager, window=images.window, read_out=images.regions,
        )  # fmt: skip
    stack = images.counted(len(roles(code, projector.width, projector.height)))
    window, anything = images.of_pixels()
    if not anything:
        return unseen_cloud(geometry.grid, images.capture.sensor, images.capture.source, geometry.baseline)
    return decode_structured_light(
        stack, geometry, images.first[0], code, settings, sensor=images.capture.sensor, source=images.capture.source,
        full_scale=images.full_scale, imager=images.imager, window=window,
    )  # fmt: skip


def _time_of_flight_geometry(
    rig: Rig, settings: TimeOfFlightSettings, code: AmplitudeModulation
) -> TimeOfFlightGeometry:
    return time_of_flight_geometry(rig, next(iter(rig.cameras)), settings.near_mm, settings.far_mm)


def _time_of_flight(
    images: Images, geometry: TimeOfFlightGeometry, settings: TimeOfFlightSettings, code: AmplitudeModulation
) -> PointCloud:
    stack = images.counted(code.count)
    window, anything = images.of_pixels()
    if not anything:
        return unseen_cloud(geometry.grid, images.capture.sensor, images.capture.source, geometry.baseline)
    return decode_time_of_flight(
        stack, geometry, code, settings, sensor=images.capture.sensor, source=images.capture.source,
        full_scale=images.full_scale, imager=images.imager, window=window,
    )  # fmt: skip


TECHNOLOGIES: dict[str, Technology] = {
    "active_stereo": Technology(MatcherSettings, (), _stereo_geometry, _stereo),
    "reference_stereo": Technology(MatcherSettings, (RandomDots, DiffractionSpots), _reference_geometry, _reference),
    "structured_light": Technology(
        DecoderSettings,
        (PhaseShift, GrayCode, GrayCodePhaseShift, ImageSequence),
        _structured_light_geometry,
        _structured_light,
    ),
    "time_of_flight": Technology(
        TimeOfFlightSettings, (AmplitudeModulation,), _time_of_flight_geometry, _time_of_flight
    ),
}


def decoder_settings(capture: Capture, sensor: str | None = None) -> tuple[Settings, Imager | None]:
    """Settings to decode a capture with, and the imager that took it.

    Of ``sensor`` if given, else of the preset of its name, else the capture's own settings or range and an unknown
    imager.
    """
    name = sensor or (capture.sensor if capture.sensor in presets() else None)
    if name is not None:
        known = load_sensor(name)
        return known.settings, known.imager if known.imager.bits == capture.bits else None
    own = capture.settings.get("decoder")
    if own is not None:  # written by an import, from the file of its sensor
        return validate(f"capture of {capture.sensor}: settings.json", {"decoder": own}, _Decoded).decoder, None
    near, far = (capture.settings.get(key, default) for key, default in zip(
        ("near_mm", "far_mm"), DEFAULT_RANGE_MM, strict=True))  # fmt: skip
    return _technology(capture.technology).settings(near_mm=float(near), far_mm=float(far)), None


def sensor_geometry(sensor: Sensor) -> Geometry:
    """What the captures of a sensor need prepared once."""
    technology = _technology(sensor.technology)
    pattern = sensor.pattern if isinstance(sensor.pattern, technology.patterns) else None
    return technology.geometry(sensor.rig, sensor.settings, pattern)


def capture_cloud(
    capture: Capture, settings: Settings, geometry: Geometry | None = None,
    window: Window | None = None, imager: Imager | None = None,
) -> PointCloud:  # fmt: skip
    """Decode a capture.

    Parameters
    ----------
    geometry
        Saves preparing the capture's rig again.
    window
        (column0, row0, column1, row1) of the cloud's grid, ends not included: decode only this part. Pixels outside
        are ``NO_SURFACE``, and so are those that the capture says were not read out.
    imager
        Which took the capture: with it each point is told the standard deviation that its noise makes, where the
        decoder knows how. Of a bracket it is not told.

    Raises
    ------
    InputError
        If the settings are those of another technology, or the capture is not what it says.
    """
    technology = _technology(capture.technology)
    if not isinstance(settings, technology.settings):
        allowed = f"one that {type(settings).__name__} decodes"
        raise InputError("capture", "technology", repr(capture.technology), allowed)
    pattern = _pattern(capture, technology)
    geometry = geometry or technology.geometry(capture.rig, settings, pattern)
    if window is not None:
        window = checked_window(window, geometry.grid.width, geometry.grid.height, "capture_cloud")
    exposures, read_out = _bracket(capture), read_out_of(capture)
    images, full_scale = capture.images, 2.0**capture.bits - 1
    if exposures is not None:
        images, full_scale = _merged(capture, exposures, read_out)
    if exposures is not None:
        # levels are those of the shortest exposure, and what can be told from noise is known from the longest
        settings, imager = settings.at_exposure(min(exposures) / max(exposures)), None
    return technology.decode(
        Images(capture, images, full_scale, imager, window, read_out), geometry, settings, pattern
    )  # fmt: skip


def read_out_of(capture: Capture) -> dict[str, Window]:
    """Part (column, row, right, bottom) of the image of each camera that was not read out whole, by camera.

    Raises
    ------
    InputError
        If the capture names a camera that it does not have, or a part that is not in the image.
    """
    where = f"capture of {capture.sensor}: settings.json"
    table = validate(where, {"read_out": capture.settings.get("read_out", {})}, _Read).read_out
    out: dict[str, Window] = {}
    for name, (column, row, width, height) in table.items():
        if name not in capture.rig.cameras:
            raise InputError(where, "read_out", repr(name), ", ".join(capture.rig.cameras))
        camera = capture.rig.cameras[name]
        part = (column, row, column + width, row + height)
        if overlap(part, (0, 0, camera.width, camera.height)) != part:
            allowed = f"[column, row, width, height] within {camera.width} x {camera.height} pixels"
            raise InputError(where, f"read_out.{name}", [column, row, width, height], allowed)
        out[name] = part
    return out


def _technology(name: str) -> Technology:
    if name not in TECHNOLOGIES:
        raise InputError("capture", "technology", repr(name), ", ".join(TECHNOLOGIES))
    return TECHNOLOGIES[name]


def _pattern(capture: Capture, technology: Technology) -> Pattern | None:
    """The pattern that a capture names, if its technology asks for one."""
    if not technology.patterns:
        return None
    table = {"pattern": capture.settings.get("pattern")}
    pattern = validate(f"capture of {capture.sensor}: settings.json", table, _Coded).pattern
    if not isinstance(pattern, technology.patterns):
        raise InputError("capture", "settings.pattern.kind", pattern.kind, f"a kind that {capture.technology} has")
    return pattern


def _bracket(capture: Capture) -> list[float] | None:
    exposures = capture.settings.get("exposure_s")
    return exposures if isinstance(exposures, list) and len(exposures) > 1 else None


def _merged(
    capture: Capture, exposures: list[float], read_out: dict[str, Window]
) -> tuple[dict[str, NDArray[np.unsignedinteger[Any]]], float]:
    """Images of every camera, 0 where they were not read out, and their full scale [DN]."""
    full_scale = 2**capture.bits - 1
    merged: dict[str, NDArray[np.unsignedinteger[Any]]] = {}
    scale = 65535.0
    for name, stack in capture.images.items():
        if len(stack) % len(exposures):
            where = f"capture of {capture.sensor}"
            raise InputError(where, "images", f"{len(stack)} of {name}", f"a multiple of {len(exposures)} exposures")
        part = inside(read_out.get(name, (0, 0, stack.shape[2], stack.shape[1])))
        result = merge_exposures(
            stack.reshape(len(exposures), -1, *stack.shape[1:])[:, :, *part], exposures,
            float(capture.settings.get("black_level_dn", 0.0)), full_scale,
            float(capture.settings.get("gamma", 1.0)),
        )  # fmt: skip
        merged[name] = np.zeros((len(stack) // len(exposures), *stack.shape[1:]), result.levels.dtype)
        merged[name][:, *part], scale = result.levels, float(result.full_scale)
    return merged, scale
