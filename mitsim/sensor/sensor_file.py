"""Define the sensor TOML file: every table and key, with its limits, and the keys that a purpose needs.

A file may describe only a rig whose images exist. What it leaves out is NaN, 0 px or None, and :func:`needed_keys` says
which purposes need it.

The fields are described in docs/reference/formats/sensor.md. Comments in the presets give the source of each number
and mark unconfirmed ones as *assumed*. :mod:`mitsim.sensor.preset` makes a sensor from the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from characterisation.files.documents import Document, Name
from characterisation.files.errors import InputError
from mitsim.sensor.calibration_qualifiers import check_intrinsics
from mitsim.sensor.calibration_table import CalibrationTable
from mitsim.sensor.camera import Camera
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.fitted_to import FittedCapture
from mitsim.sensor.imager import DESCRIPTION, Imager, Positive
from mitsim.sensor.light_code import LightCode
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.projector_images import ImageFolder
from mitsim.sensor.published_figures import PublishedAccuracy, PublishedLengths, PublishedNoise
from mitsim.sensor.transforms import Transform
from mitsim.sensor.unknowns import UnknownsTable

Pair = tuple[float, float]
Triple = tuple[float, float, float]
Share = Annotated[float, Field(ge=0, le=1)]
Slope = Annotated[float, Field(ge=-20, le=20)]
Bow = Annotated[float, Field(ge=-200, le=200)]


def _camera_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,49}", name):
        raise ValueError("a camera's name of at most 50 letters, digits, dots, dashes and underscores")
    return name


#: is part of the names of a capture's images
CameraName = Annotated[str, AfterValidator(_camera_name)]

#: largest number of pixels of a camera or projector; a capture of this size takes 2 GB of memory
MOST_PIXELS = 50_000_000


class OpticsTable(Document):
    """A camera's or projector's geometry: OpenCV's model, and its pose in the sensor frame."""

    width: int = Field(ge=16, le=20000)
    height: int = Field(ge=16, le=20000)
    focal_px: tuple[Positive, Positive]
    principal_px: Pair
    distortion: list[float] = Field(default=[], max_length=14)
    model: Literal["perspective", "fisheye"] = "perspective"
    position_mm: Triple = (0.0, 0.0, 0.0)
    rotation_deg: Triple = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _possible(self) -> OpticsTable:
        if self.width * self.height > MOST_PIXELS:
            raise ValueError(f"at most {MOST_PIXELS:,} pixels, not {self.width} x {self.height}")
        if self.model == "fisheye" and len(self.distortion) > 4:
            raise ValueError(
                f"at most four coefficients of distortion for the model fisheye, not {len(self.distortion)}"
            )
        if not np.isnan([*self.focal_px, *self.principal_px]).any() and self.width and self.height:
            check_intrinsics(self.focal_px, self.principal_px, self.width, self.height)
        if not all(abs(coordinate) <= 1e5 for coordinate in self.position_mm):
            raise ValueError("position_mm within 100 m of the sensor's frame")
        return self

    def camera(self) -> Camera:
        """Return the optics as a :class:`~mitsim.sensor.camera.Camera`."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_px
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        least = 4 if self.model == "fisheye" else 5
        distortion = np.array([*self.distortion, *[0.0] * max(0, least - len(self.distortion))])
        if len(distortion) > 5:  # OpenCV takes 4, 5, 8, 12 or 14 coefficients
            distortion = np.concatenate([distortion, np.zeros(14 - len(distortion))])
        pose = Transform.from_degrees(self.rotation_deg, self.position_mm)
        return Camera(matrix, distortion, self.width, self.height, pose, self.model)


class ProjectorTable(OpticsTable):
    """The projector: its optics, its light and its losses. Unknown numbers are NaN, an unknown size is 0."""

    width: int = Field(default=0, ge=16, le=20000)
    height: int = Field(default=0, ge=16, le=20000)
    focal_px: tuple[Positive, Positive] = (math.nan, math.nan)
    principal_px: Pair = (math.nan, math.nan)
    flux_w: Positive = math.nan
    linewidth_nm: Annotated[float, Field(gt=0, le=500)] | None = None
    black_level: Share = 0.0
    gamma: Annotated[float, Field(ge=0.2, le=5)] = 1.0
    aperture_mm: Annotated[float, Field(ge=0, le=200)] = 0.0
    focus_mm: Annotated[float, Field(ge=10)] = float("inf")
    corner_illumination: Annotated[float, Field(gt=0, le=1)] = 1.0
    pixel_gap: Annotated[float, Field(ge=0, le=0.5)] = 0.0


@dataclass(frozen=True)
class ImagerTable(Imager):
    """The imager of every camera of the sensor, and the depth of the plane of focus of its lens [mm]."""

    focus_mm: Annotated[float, Field(ge=10)] | None = None


class RoomTable(Document):
    """Ambient light of the room at this sensor's place; it is present in every image.

    - ``irradiance_w_mm2``: on any surface, from all sides, at the centre of the view.
    - ``gradient`` (x, y): relative change per unit of the view ray's x/z and y/z, in the sensor frame at the middle of
      the working range.
    - ``curvature`` (xx, xy, yy): relative change per product of two of them. The irradiance is never below 0.
    """

    irradiance_w_mm2: Annotated[float, Field(ge=0)]
    gradient: tuple[Slope, Slope] = (0.0, 0.0)
    curvature: tuple[Bow, Bow, Bow] = (0.0, 0.0, 0.0)


class MisalignmentTable(Document):
    """Rotation of the second camera of this unit relative to the calibration that decodes its images.

    ``row_mrad``: about its x axis, which shifts its rows by the focal length times the angle. ``roll_mrad``: about its
    view axis.
    """

    row_mrad: Annotated[float, Field(ge=-50, le=50)] = 0.0
    roll_mrad: Annotated[float, Field(ge=-50, le=50)] = 0.0


class Bracket(Document):
    """Several exposures of every image, merged into one of a wider range.

    ``count`` exposures, each ``factor`` times the one before; the rule's own exposure is in the middle.
    """

    count: int = Field(ge=2, le=7)
    factor: Annotated[float, Field(gt=1, le=64)]


class MattWhiteExposure(Document):
    """Exposure at which a matt white plate at normal incidence shows the bright pattern at a level of full scale."""

    rule: Literal["matt_white"]
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.85
    distance_mm: Annotated[float, Field(ge=50, le=20000)]
    level: Annotated[float, Field(gt=0, le=1)]
    limits_s: tuple[Positive, Positive]
    bracket: Bracket | None = None


class FixedExposure(Document):
    """Exposure given as a number."""

    rule: Literal["fixed"]
    exposure_s: Positive
    limits_s: tuple[Positive, Positive] = (1e-9, 1e3)
    bracket: Bracket | None = None


class AutomaticExposure(Document):
    """Exposure that follows the scene, as the device's own control does.

    It brings the ``percentile`` of the pixels of all cameras, in the brightest image, to ``level`` of full scale.
    """

    rule: Literal["automatic"]
    level: Annotated[float, Field(gt=0, le=1)] = 0.8
    percentile: Annotated[float, Field(gt=0, le=100)] = 99.0
    limits_s: tuple[Positive, Positive]
    bracket: Bracket | None = None


class SensorFile(Document):
    """A sensor TOML file."""

    name: Name
    technology: Literal["active_stereo", "reference_stereo", "structured_light", "time_of_flight"]
    wavelength_nm: Annotated[float, Field(ge=400, le=1000)] = math.nan
    working_range_mm: tuple[Annotated[float, Field(ge=50)], Annotated[float, Field(le=20000)]] = (math.nan, math.nan)
    calibration: CalibrationTable | None = None
    cameras: dict[CameraName, OpticsTable] = Field(min_length=1, max_length=2)
    projector: ProjectorTable = ProjectorTable()
    imager: ImagerTable = ImagerTable()
    pattern: (
        Annotated[DotPattern | LightCode | ImageFolder | AmplitudeModulation, Field(discriminator="kind")] | None
    ) = None
    exposure: Annotated[MattWhiteExposure | FixedExposure | AutomaticExposure, Field(discriminator="rule")] | None = (
        None
    )
    ambient_image: bool = False
    room: RoomTable | None = None
    misalignment: MisalignmentTable = MisalignmentTable()
    fitted_to: list[FittedCapture] = Field(default=[], max_length=10000)
    matcher: MatcherSettings | None = None
    decoder: DecoderSettings | None = None
    demodulation: TimeOfFlightSettings | None = None
    published_noise: list[PublishedNoise] = Field(default=[], max_length=20)
    published_lengths: PublishedLengths | None = None
    published_accuracy: PublishedAccuracy | None = None
    images: dict[str, str | Annotated[list[str], Field(min_length=1, max_length=1000)]] | None = None
    unknowns: UnknownsTable = UnknownsTable()

    @model_validator(mode="after")
    def _whole(self) -> SensorFile:
        if len(self.cameras) < 2 and self.misalignment != MisalignmentTable():
            raise ValueError("[misalignment] needs a second camera, and the file has one")
        if self.technology == "time_of_flight":
            _check_modulation(self)
            return self
        if self.demodulation is not None or isinstance(self.pattern, AmplitudeModulation):
            raise ValueError("[demodulation] and patterns of kind amplitude_modulation are for time_of_flight")
        bracket = self.exposure is not None and self.exposure.bracket is not None
        if self.imager.companding and (self.technology == "structured_light" or bracket):
            raise ValueError("imager.companding_dn is for stereo at one exposure: no structured_light, no bracket")
        if self.technology in ("active_stereo", "reference_stereo"):
            _check_dots(self)
        else:
            if self.decoder is None or self.matcher is not None:
                raise ValueError("structured_light needs [decoder], and has no [matcher]")
            _check_code(self, self.decoder)
        return self


def _check_code(file: SensorFile, decoder: DecoderSettings) -> None:
    """Raise an error if a structured-light sensor lacks what its decoder needs."""
    if isinstance(file.pattern, DotPattern):
        raise ValueError(
            "structured_light needs a pattern of kind phase_shift, gray_code, both, image_sequence or images"
        )
    if decoder.triangulate == "cameras" and len(file.cameras) != 2:
        raise ValueError('decoder.triangulate = "cameras" needs two cameras')
    unknown = sorted(set(file.images or {}) - set(file.cameras))
    if unknown:
        raise ValueError(f"images of {', '.join(unknown)}: the cameras are {', '.join(file.cameras)}")


def _check_modulation(file: SensorFile) -> None:
    """Raise an error if a time-of-flight sensor lacks a part, or has one that differences of taps do not allow."""
    if file.pattern is not None and not isinstance(file.pattern, AmplitudeModulation):
        raise ValueError(f"time_of_flight needs a pattern of kind amplitude_modulation, not {file.pattern.kind}")
    if len(file.cameras) != 1 or file.demodulation is None or file.matcher is not None or file.decoder is not None:
        raise ValueError("time_of_flight needs one camera and [demodulation], and has no [matcher] or [decoder]")
    if file.imager.smoothing_px > 0 or file.room is not None:
        raise ValueError("imager.smoothing_px and [room] are for images of light, not for time_of_flight")
    if file.imager.black_level <= 0:  # else negative differences would be cut off
        raise ValueError("time_of_flight needs imager.black_level_dn over 0, the level of a difference of 0")
    bent = file.imager.gamma != 1 or bool(file.imager.companding)
    bracket = file.exposure is not None and file.exposure.bracket is not None
    if file.ambient_image or bracket or bent:
        raise ValueError("time_of_flight takes differences of two taps: no ambient_image, bracket, gamma, companding")


def _check_dots(file: SensorFile) -> None:
    """Raise an error if a sensor of projected dots lacks what its technology needs."""
    cameras = {"active_stereo": 2, "reference_stereo": 1}[file.technology]
    if len(file.cameras) != cameras or file.matcher is None or file.decoder is not None:
        number = {1: "one camera", 2: "two cameras"}[cameras]
        raise ValueError(f"{file.technology} needs {number} and [matcher], and has no [decoder]")
    if file.pattern is not None and not isinstance(file.pattern, DotPattern | ImageFolder):
        kinds = "random_dots, diffraction_spots or images"
        raise ValueError(f"{file.technology} needs a pattern of kind {kinds}, not {file.pattern.kind}")
    if (
        isinstance(file.pattern, DotPattern)
        and file.pattern.frames > 1
        and (file.matcher.method == "sgbm" or file.technology != "active_stereo")
    ):
        raise ValueError(
            'pattern.shifts_px needs technology "active_stereo" and matcher.method "correlation" or "census"'
        )
    if (file.matcher.reference_mm is None) == (file.technology == "reference_stereo"):
        raise ValueError("matcher.reference_mm is for reference_stereo, which needs it")


#: purposes that need more than every sensor file has: simulation, decoding, the noise of images from the imager's
#: description, the bits of images
Purpose = Literal["simulation", "decoding", "noise", "bits"]

#: the table that describes a technology's decoder, and default depths [mm] of decoding recordings. A code is
#: unambiguous at every depth; a matcher searches all of them.
DECODERS = {"structured_light": ("decoder", (50.0, 20000.0)), "active_stereo": ("matcher", (300.0, 2000.0))}

_OPTICS = ("projector.focal_px", "projector.principal_px")
_SHOWN = ("pattern.kind", "projector.width", "projector.height")
_NOISE = tuple(f"imager.{key}" for key in DESCRIPTION)
_LIGHT = ("wavelength_nm", "working_range_mm", "projector.flux_w", "exposure.rule")


def needed_keys(table: dict[str, Any], purpose: Purpose) -> tuple[str, ...]:
    """Return the keys that a purpose needs in a sensor file beyond those of every file; InputError if unknown."""
    if purpose not in get_args(Purpose):
        raise InputError("sensor", "purpose", repr(purpose), ", ".join(get_args(Purpose)))
    technology, decoder = table.get("technology"), table.get("decoder")
    between_cameras = isinstance(decoder, dict) and decoder.get("triangulate") == "cameras"
    match purpose:
        case "bits":
            return ("imager.bits",)
        case "noise":
            return _NOISE
        case "decoding" if technology == "active_stereo":
            return ()
        case "decoding":
            return _SHOWN if between_cameras else (*_SHOWN, *_OPTICS)
    searched = [f"{DECODERS[technology][0]}.{end}" for end in ("near_mm", "far_mm")] if technology in DECODERS else []
    return (*_LIGHT[:2], *_SHOWN, *_OPTICS, *_LIGHT[2:], *_NOISE, *searched)


def absent_keys(table: dict[str, Any], keys: Iterable[str]) -> tuple[str, ...]:
    """Return those of some dotted keys that a table does not have."""
    return tuple(key for key in keys if not _has(table, key))


def _has(table: Any, key: str) -> bool:
    first, _, remainder = key.partition(".")
    if not isinstance(table, dict):
        return True  # a wrong type, which the model reports
    return first in table and (not remainder or _has(table[first], remainder))


def with_depths(table: dict[str, Any]) -> dict[str, Any]:
    """Return a sensor file's table whose decoder has a range of depths: its own, the working range, or a default."""
    name, depths = DECODERS.get(str(table.get("technology")), ("", (0.0, 0.0)))
    near_far, decoder = table.get("working_range_mm", depths), table.get(name, {})
    if not name or not isinstance(decoder, dict) or not isinstance(near_far, list | tuple) or len(near_far) != 2:
        return table
    return table | {name: {"near_mm": near_far[0], "far_mm": near_far[1]} | decoder}
