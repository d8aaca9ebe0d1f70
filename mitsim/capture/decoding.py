"""Describe what decoding a capture needs besides its images and calibration, as one checked type.

Of a ``settings.json``, :class:`Decoding` has the keys that decoding reads; the others are records, which no decoder
reads.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, InstanceOf, PlainSerializer, ValidationInfo, field_validator

from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.sensor.decoder_settings import DecoderSettings, DeviceMapSettings
from mitsim.sensor.imager import WrittenImager
from mitsim.sensor.light_code import LightCode
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.projector_images import ImagesDescription

Settings = MatcherSettings | DecoderSettings | TimeOfFlightSettings | DeviceMapSettings

#: type of the decoder's settings of each technology
SETTINGS_OF: dict[str, type[Settings]] = {
    "active_stereo": MatcherSettings,
    "reference_stereo": MatcherSettings,
    "structured_light": DecoderSettings,
    "time_of_flight": TimeOfFlightSettings,
    "depth_map": DeviceMapSettings,
    "disparity_map": DeviceMapSettings,
    "point_map": DeviceMapSettings,
}

Exposure = Annotated[float, Field(ge=0, le=1e6)]
Depth = Annotated[float, Field(gt=0, le=1e7)]
Side = Annotated[int, Field(ge=16, le=20000)]


def _roi(value: Any) -> Any:
    if isinstance(value, Roi):
        return value
    numbers = list(value) if isinstance(value, list | tuple) else []
    if len(numbers) != 4 or not all(type(number) is int for number in numbers):
        raise ValueError("[left, top, width, height], whole numbers of pixels")
    return Roi(*numbers)


WrittenRoi = Annotated[
    InstanceOf[Roi], BeforeValidator(_roi), PlainSerializer(lambda roi: [roi.left, roi.top, roi.width, roi.height])
]


class Decoding(Document):
    """What decoding needs besides images and calibration; None, or the default, where a capture does not state it.

    - ``decoder``: settings of the decoder, of the type that :data:`SETTINGS_OF` names for the technology.
    - ``imager`` that took the images; the noise of grey levels follows from it.
    - ``pattern``: projected dots, or the code of structured light or time of flight.
    - ``projector_size_px``: width and height of the pattern, if the calibration has no projector.
    - ``exposure_s``: exposure of every image, or the exposures of a bracket.
    - ``black_level_dn`` [DN] and ``gamma`` [1] of the images, with which a bracket is merged.
    - ``ambient_image``: whether the last image is without the projector's light.
    - ``read_out``: region that was read out of each camera; a camera that was read out completely is omitted.
    - ``near_mm``, ``far_mm``: depths that the device or its sensor file states.
    - ``range_mm``: nearest and farthest depth that a user requested; they replace those of ``decoder``.
    """

    decoder: Settings | None = None
    imager: WrittenImager | None = None
    pattern: (
        Annotated[DotPattern | LightCode | ImagesDescription | AmplitudeModulation, Field(discriminator="kind")] | None
    ) = None
    projector_size_px: tuple[Side, Side] | None = None
    exposure_s: Exposure | Annotated[tuple[Exposure, ...], Field(min_length=1, max_length=1000)] | None = None
    black_level_dn: Annotated[float, Field(ge=0, le=65535)] = 0.0
    gamma: Annotated[float, Field(gt=0, le=10)] = 1.0
    ambient_image: bool = False
    read_out: dict[str, WrittenRoi] = Field(default_factory=dict)
    near_mm: Depth | None = None
    far_mm: Depth | None = None
    range_mm: tuple[Depth, Depth] | None = None

    @field_validator("decoder", mode="before")
    @classmethod
    def _of_technology(cls, value: Any, info: ValidationInfo) -> Any:
        """Read a table as the settings of the technology that the context names."""
        if value is None or isinstance(value, Document):
            return value
        return SETTINGS_OF[str(info.context)].model_validate(value)

    @property
    def exposures_s(self) -> tuple[float, ...]:
        """Return the exposures [s]: several of a bracket, one otherwise, none if unknown."""
        if self.exposure_s is None:
            return ()
        return self.exposure_s if isinstance(self.exposure_s, tuple) else (self.exposure_s,)

    @property
    def bracket_s(self) -> tuple[float, ...] | None:
        """Return the exposures [s] of a bracket; None for one exposure."""
        return self.exposures_s if len(self.exposures_s) > 1 else None


def read_settings(where: str | Path, table: dict[str, Any], technology: str) -> tuple[Decoding, dict[str, Any]]:
    """Split the table of a ``settings.json`` into what decoding reads and the records.

    ``technology``, that of the capture, determines the type of ``decoder``.
    """
    if technology not in SETTINGS_OF:
        raise InputError("capture", "technology", repr(technology), ", ".join(SETTINGS_OF))
    read = {name: value for name, value in table.items() if name in Decoding.model_fields}
    records = {name: value for name, value in table.items() if name not in read}
    return validate(where, read, Decoding, technology), records


def settings_table(decoding: Decoding, records: dict[str, Any]) -> dict[str, Any]:
    """Return the table of ``settings.json``: all that decoding reads and that is not a default, then the records."""
    both = set(records) & set(Decoding.model_fields)
    if both:
        raise InputError("capture", "settings", ", ".join(sorted(both)), "records; Capture.decoding has these values")
    written, default = decoding.model_dump(mode="json", by_alias=True), Decoding().model_dump(mode="json")
    return {name: value for name, value in written.items() if value != default[name]} | records
