"""A rig that took recordings: what importing and decoding them asks of a sensor file.

Signal chain: sensor file, in which all that only simulation needs may be missing -> the same checks as of any sensor
file -> cameras, projector, code and decoder's settings; the imager if it is described whole, else none.

Without an imager the noise of a phase is not known, so points of fringes have no sigma; points of a Gray code have that
of the width of a stripe.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from characterisation.documents import Document, Name, missing_keys, validate
from characterisation.errors import InputError
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.preset import Sensor, sensor_of, sensor_table, written_table
from mitsim.sensor.recorded_keys import for_recordings, lacking_keys
from mitsim.sensor.sensor_file import SensorFile


@dataclass(frozen=True)
class RecordedRig:
    """What is known of the rig that took a recording.

    ``rig``: its projector is None where nobody calibrated it; ``projector_size`` (width, height) [px] of what it shows;
    ``bits`` of the images, ``imager`` and ``exposure_s``: None where unknown; ``range_mm``: None where the file names
    none; ``lacking``: keys that simulation would need; ``notes``: what its user should know of the calibration.
    """

    name: str
    technology: str
    rig: Rig
    projector_size: tuple[int, int]
    pattern: DotPattern | LightCode | AmplitudeModulation
    settings: MatcherSettings | DecoderSettings | TimeOfFlightSettings
    bits: int | None
    black_level: float
    gamma: float
    imager: Imager | None
    exposure_s: float | None
    range_mm: tuple[float, float] | None
    ambient_image: bool = False
    images: dict[str, str | list[str]] | None = None
    lacking: tuple[str, ...] = field(default=(), repr=False)
    notes: tuple[str, ...] = field(default=(), repr=False)

    @classmethod
    def of(cls, sensor: Sensor) -> RecordedRig:
        """Of a sensor that is described whole."""
        optics, imager, exposure = sensor.projector.optics, sensor.imager, sensor.exposure
        return cls(
            name=sensor.name,
            technology=sensor.technology,
            rig=sensor.rig,
            projector_size=(optics.width, optics.height),
            pattern=sensor.pattern,
            settings=sensor.settings,
            bits=imager.bits,
            black_level=imager.black_level,
            gamma=imager.gamma,
            imager=imager,
            exposure_s=None if exposure.bracket else exposure.base_s,
            range_mm=sensor.working_range_mm,
            ambient_image=sensor.ambient_image,
            images=sensor.images,
        )


def load_recorded_rig(name: str | Path, size: tuple[int, int] | None = None) -> RecordedRig:
    """Read the rig of a preset by name, or of a sensor file by path, that need not be complete.

    ``size`` (width, height) [px] of the images, for cameras whose size nobody has written down: OpenCV's pair of
    ``intrinsics.yml`` and ``extrinsics.yml`` has none.

    Raises
    ------
    InputError
        For an unknown name, or a file that does not describe a rig; all that is missing is named.
    """
    path, table, notes = sensor_table(name)
    table = _sized(table, size)
    lacking = lacking_keys(table)
    if not lacking:
        return replace(RecordedRig.of(sensor_of(path, table)), notes=tuple(notes))
    sensor = sensor_of(path, for_recordings(table))
    return replace(
        RecordedRig.of(sensor),
        rig=replace(sensor.rig, projector=None) if _uncalibrated(lacking) else sensor.rig,
        bits=table.get("imager", {}).get("bits"),
        imager=None if any(key.startswith("imager.") for key in lacking) else sensor.imager,
        exposure_s=_exposure(table, sensor),
        range_mm=_range(table, lacking, sensor),
        lacking=tuple(lacking),
        notes=tuple(notes),
    )


def rig_named(name: str | Path) -> tuple[str, str]:
    """Name and technology that a preset or sensor file says, unchecked otherwise: its calibration is not read.

    Raises
    ------
    InputError
        For an unknown name, or a file that cannot be read or says neither.
    """
    path, table = written_table(name)
    if not {"name", "technology"} <= set(table):
        # the calibration is not read yet: what it may hold is not asked for
        held = ("cameras", "projector") if "calibration" in table else ()
        missing = [key for key in missing_keys(for_recordings(table), SensorFile) if not key.startswith(held or "\0")]
        raise InputError(path, ", ".join(missing), "nothing", "a value for each: these keys are required")
    told = validate(path, {key: table[key] for key in ("name", "technology") if key in table}, _Named)
    return told.name, told.technology


class _Named(Document):
    name: Name
    technology: str


def _sized(table: dict[str, Any], size: tuple[int, int] | None) -> dict[str, Any]:
    """The table with the size of the images for cameras that have none."""
    cameras = table.get("cameras")
    if size is None or not isinstance(cameras, dict):
        return table
    given = {"width": size[0], "height": size[1]}
    sized = {
        name: given | each if isinstance(each, dict) and not {"width", "height"} & set(each) else each
        for name, each in cameras.items()
    }
    return table | {"cameras": sized}


def _uncalibrated(lacking: list[str]) -> bool:
    """Whether the projector's own optics are missing: they were completed, and are nobody's."""
    return bool({"projector.focal_px", "projector.principal_px"} & set(lacking))


def _exposure(table: dict[str, Any], sensor: Sensor) -> float | None:
    """Exposure [s] of every image, if it is written down: one that follows from a rule needs all of the sensor."""
    written = table.get("exposure", {})
    return sensor.exposure.base_s if written.get("rule") == "fixed" and "bracket" not in written else None


def _range(table: dict[str, Any], lacking: list[str], sensor: Sensor) -> tuple[float, float] | None:
    """Depths [mm] that the file names: its working range, else those of its decoder."""
    if "working_range_mm" in table:
        return sensor.working_range_mm
    completed = any(key.endswith((".near_mm", ".far_mm")) for key in lacking)
    return None if completed else (sensor.settings.near_mm, sensor.settings.far_mm)
