"""The sensor TOML file: every table and key, with its limits.

Field by field in docs/formats.md; the presets say in a comment where each number comes from, and mark as *assumed* what
nobody has confirmed. :mod:`mitsim.sensor.preset` makes a sensor of it.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from characterisation.documents import Document
from mitsim.sensor.camera import Camera
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.frames import Transform
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift
from mitsim.sensor.matcher import MatcherSettings

Pair = tuple[float, float]
Triple = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class OpticsTable(Document):
    """A camera's or projector's geometry: OpenCV's model, and its place in the sensor frame."""

    width: int = Field(ge=16, le=20000)
    height: int = Field(ge=16, le=20000)
    focal_px: tuple[Positive, Positive]
    principal_px: Pair
    distortion: list[float] = Field(default=[], max_length=14)
    model: Literal["perspective", "fisheye"] = "perspective"
    position_mm: Triple = (0.0, 0.0, 0.0)
    rotation_deg: Triple = (0.0, 0.0, 0.0)

    def camera(self) -> Camera:
        """The optics as a :class:`~mitsim.sensor.camera.Camera`."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_px
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        least = 4 if self.model == "fisheye" else 5
        distortion = np.array([*self.distortion, *[0.0] * max(0, least - len(self.distortion))])
        if len(distortion) > 5:  # OpenCV takes 4, 5, 8, 12 or 14 coefficients
            distortion = np.concatenate([distortion, np.zeros(14 - len(distortion))])
        place = Transform.from_degrees(self.rotation_deg, self.position_mm)
        return Camera(matrix, distortion, self.width, self.height, place, self.model)


class ProjectorTable(OpticsTable):
    """The projector: its optics, its light and its losses."""

    flux_w: Positive
    linewidth_nm: Annotated[float, Field(gt=0, le=500)] | None = None
    black_level: Share = 0.0
    gamma: Annotated[float, Field(ge=0.2, le=5)] = 1.0
    aperture_mm: Annotated[float, Field(ge=0, le=200)] = 0.0
    focus_mm: Annotated[float, Field(ge=10)] = float("inf")
    corner_illumination: Annotated[float, Field(gt=0, le=1)] = 1.0
    pixel_gap: Annotated[float, Field(ge=0, le=0.5)] = 0.0


class ImagerTable(Document):
    """The imager of every camera of the sensor, in EMVA 1288 terms, and its lens."""

    pixel_um: Positive
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)]
    full_well_e: Positive
    read_noise_e: Annotated[float, Field(ge=0)]
    dsnu_e: Annotated[float, Field(ge=0)] = 0.0
    prnu: Share = 0.0
    bits: int = Field(default=8, ge=1, le=16)
    black_level_dn: Annotated[float, Field(ge=0)] = 0.0
    gamma: Annotated[float, Field(ge=0.2, le=5)] = 1.0
    row_noise_e: Annotated[float, Field(ge=0)] = 0.0
    column_pattern_e: Annotated[float, Field(ge=0)] = 0.0
    dark_current_e_s: Annotated[float, Field(ge=0)] = 0.0
    f_number: Positive
    focus_mm: Annotated[float, Field(ge=10)] | None = None
    corner_illumination: Annotated[float, Field(gt=0, le=1)] = 1.0
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.0


class RandomDots(Document):
    """Static random pattern of an active-stereo projector, in projector pixels."""

    kind: Literal["random_dots"]
    run_length_px: Positive
    bright_share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    blur_px: Annotated[float, Field(ge=0)] = 0.0
    seed: int = 0


class Bracket(Document):
    """Several exposures of every image, merged into one of a wider range.

    ``count`` exposures, each ``factor`` times the one before, with the rule's own in the middle.
    """

    count: int = Field(ge=2, le=7)
    factor: Annotated[float, Field(gt=1, le=64)]


class MattWhiteExposure(Document):
    """Exposure fixed so that a matt white plate, faced squarely, shows the bright pattern at a level of full scale."""

    rule: Literal["matt_white"]
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.85
    distance_mm: Annotated[float, Field(ge=50, le=20000)]
    level: Annotated[float, Field(gt=0, le=1)]
    limits_s: tuple[Positive, Positive]
    bracket: Bracket | None = None


class FixedExposure(Document):
    """Exposure written down."""

    rule: Literal["fixed"]
    exposure_s: Positive
    limits_s: tuple[Positive, Positive] = (1e-9, 1e3)
    bracket: Bracket | None = None


class AutomaticExposure(Document):
    """Exposure that follows the scene, as the device's own control does.

    The ``percentile`` of the pixels of all cameras, in the brightest image, is brought to ``level`` of full scale.
    """

    rule: Literal["automatic"]
    level: Annotated[float, Field(gt=0, le=1)] = 0.8
    percentile: Annotated[float, Field(gt=0, le=100)] = 99.0
    limits_s: tuple[Positive, Positive]
    bracket: Bracket | None = None


class SensorFile(Document):
    """A sensor TOML file."""

    name: str
    technology: Literal["active_stereo", "structured_light"]
    wavelength_nm: Annotated[float, Field(ge=400, le=1000)]
    working_range_mm: tuple[Annotated[float, Field(ge=50)], Annotated[float, Field(le=20000)]]
    cameras: dict[str, OpticsTable] = Field(min_length=1, max_length=2)
    projector: ProjectorTable
    imager: ImagerTable
    pattern: Annotated[RandomDots | PhaseShift | GrayCode | GrayCodePhaseShift, Field(discriminator="kind")]
    exposure: Annotated[MattWhiteExposure | FixedExposure | AutomaticExposure, Field(discriminator="rule")]
    ambient_image: bool = False
    matcher: MatcherSettings | None = None
    decoder: DecoderSettings | None = None

    @model_validator(mode="after")
    def _whole(self) -> SensorFile:
        if self.technology == "active_stereo":
            if len(self.cameras) != 2 or self.matcher is None or self.decoder is not None:
                raise ValueError("active_stereo needs two cameras and [matcher], and has no [decoder]")
            if not isinstance(self.pattern, RandomDots):
                raise ValueError(f"active_stereo needs a pattern of kind random_dots, not {self.pattern.kind}")
        else:
            if self.decoder is None or self.matcher is not None:
                raise ValueError("structured_light needs [decoder], and has no [matcher]")
            if isinstance(self.pattern, RandomDots):
                raise ValueError("structured_light needs a pattern of kind phase_shift, gray_code or both")
        return self
