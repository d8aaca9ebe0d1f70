"""A sensor as one TOML file: what it is made of, how it exposes, how it is decoded.

``load_sensor("ensenso-n10")`` takes a preset from this package, ``load_sensor("my.toml")`` a file of the user's. Every
field is documented in docs/formats.md; the presets say in a comment where each number comes from, and mark as
*assumed* what nobody has confirmed.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from characterisation.documents import Document, read_toml
from mitsim.errors import InputError, nearest
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.frames import Transform
from mitsim.sensor.imager import Imager, electrons_per_radiance
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.pattern import random_blobs
from mitsim.sensor.projector import Projector

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
    black_level: Share = 0.0


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
    f_number: Positive
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.0


class RandomDots(Document):
    """Static random pattern of an active-stereo projector, in projector pixels."""

    kind: Literal["random_dots"]
    run_length_px: Positive
    bright_share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    blur_px: Annotated[float, Field(ge=0)] = 0.0
    seed: int = 0


class MattWhiteExposure(Document):
    """Exposure fixed so that a matt white plate, faced squarely, shows the bright pattern at a level of full scale."""

    rule: Literal["matt_white"]
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.85
    distance_mm: Annotated[float, Field(ge=50, le=20000)]
    level: Annotated[float, Field(gt=0, le=1)]
    limits_s: tuple[Positive, Positive]


class FixedExposure(Document):
    """Exposure written down."""

    rule: Literal["fixed"]
    exposure_s: Positive


class SensorFile(Document):
    """A sensor TOML file."""

    name: str
    technology: Literal["active_stereo"]
    wavelength_nm: Annotated[float, Field(ge=400, le=945)]
    working_range_mm: tuple[Annotated[float, Field(ge=50)], Annotated[float, Field(le=20000)]]
    cameras: dict[str, OpticsTable] = Field(min_length=2, max_length=2)
    projector: ProjectorTable
    imager: ImagerTable
    pattern: RandomDots
    exposure: Annotated[MattWhiteExposure | FixedExposure, Field(discriminator="rule")]
    matcher: MatcherSettings


@dataclass(frozen=True)
class Sensor:
    """A sensor ready for use; ``exposure_s`` follows from its stated rule, told by ``exposure_rule``."""

    name: str
    technology: str
    wavelength_nm: float
    working_range_mm: Pair
    rig: Rig
    projector: Projector
    imager: Imager
    pattern: RandomDots
    exposure_s: float
    exposure_rule: str
    matcher: MatcherSettings

    def patterns(self) -> np.ndarray:
        """All patterns of one measurement, (P, H, W) of values 0..1 in projector pixels."""
        optics, dots = self.projector.optics, self.pattern
        pattern = random_blobs(
            optics.width, optics.height, dots.run_length_px, dots.bright_share, dots.blur_px, dots.seed
        )
        return pattern[None]

    def electrons(self) -> float:
        """Photo-electrons per unit of radiance at this sensor's exposure [e- / (W mm^-2 sr^-1)]."""
        return electrons_per_radiance(self.imager, self.wavelength_nm, self.exposure_s)


def presets() -> list[str]:
    """Names of the sensors that come with the package."""
    folder = files("mitsim.sensor") / "presets"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def load_sensor(name: str | Path) -> Sensor:
    """A preset by name, or a sensor TOML file by path.

    Raises
    ------
    InputError
        For an unknown name, or a file that does not describe a sensor.
    """
    path = Path(name)
    if path.suffix != ".toml":
        if str(name) not in presets():
            allowed = f"{', '.join(presets())}, or the path of a .toml file"
            raise InputError("--sensor", "", repr(str(name)), allowed, nearest(str(name), presets()))
        path = Path(str(files("mitsim.sensor") / "presets" / f"{name}.toml"))
    table = read_toml(path, SensorFile)
    near, far = table.working_range_mm
    if near >= far:
        raise InputError(path, "working_range_mm", f"[{near:g}, {far:g}]", "near before far")
    return _assemble(path, table)


def _assemble(path: Path, table: SensorFile) -> Sensor:
    cameras = {name: optics.camera() for name, optics in table.cameras.items()}
    projector = Projector(table.projector.camera(), table.projector.flux_w, table.projector.black_level)
    given = table.imager
    imager = Imager(
        pixel_um=given.pixel_um, quantum_efficiency=given.quantum_efficiency, full_well=given.full_well_e,
        read_noise=given.read_noise_e, dsnu=given.dsnu_e, prnu=given.prnu, bits=given.bits,
        black_level=given.black_level_dn, f_number=given.f_number, blur_px=given.blur_px,
    )  # fmt: skip
    exposure_s, rule = _exposure(path, table, projector, imager)
    return Sensor(
        name=table.name, technology=table.technology, wavelength_nm=table.wavelength_nm,
        working_range_mm=table.working_range_mm, rig=Rig(cameras, projector.optics), projector=projector,
        imager=imager, pattern=table.pattern, exposure_s=exposure_s, exposure_rule=rule, matcher=table.matcher,
    )  # fmt: skip


def _exposure(path: Path, table: SensorFile, projector: Projector, imager: Imager) -> tuple[float, str]:
    rule = table.exposure
    if isinstance(rule, FixedExposure):
        return rule.exposure_s, f"fixed at {rule.exposure_s:g} s"
    radiance = rule.reflectance / np.pi * projector.plane_irradiance / rule.distance_mm**2
    wanted = rule.level * imager.full_well
    exposure = wanted / (radiance * electrons_per_radiance(imager, table.wavelength_nm, 1.0))
    shortest, longest = rule.limits_s
    if not shortest <= exposure <= longest:
        hint = f"the rule asks for {exposure:.3g} s: change projector.flux_w, exposure.level or exposure.distance_mm"
        raise InputError(path, "exposure.limits_s", f"[{shortest:g}, {longest:g}] s", "limits that hold", hint)
    return float(exposure), (
        f"fixed at {exposure:.3g} s: matt white (reflectance {rule.reflectance:g}) at {rule.distance_mm:g} mm "
        f"shows the bright pattern at {100 * rule.level:g} % of full scale"
    )
