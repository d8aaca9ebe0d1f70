"""Read the sensor file of a rig that took recordings, for importing and decoding them.

Signal chain: sensor file, possibly without the keys that only simulation needs -> the same checks as of any sensor file
-> cameras, projector, code and decoder's settings; the imager if its description is complete, else none.

Without an imager the noise of a phase is unknown, so points from fringes have no sigma. Points from a Gray code have
the sigma of the stripe's width.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from characterisation.files.documents import Document, Name, missing_keys, validate
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.preset import Sensor, sensor_of, sensor_table, written_table
from mitsim.sensor.projector_images import ProjectorImages
from mitsim.sensor.recorded_keys import for_recordings, lacking_keys
from mitsim.sensor.sensor_file import SensorFile


@dataclass(frozen=True)
class RecordedRig:
    """Known properties of the rig that took a recording.

    - ``rig``: its projector is None if it is not calibrated.
    - ``projector_size``: (width, height) [px] of the projected patterns.
    - ``bits`` of the images, ``imager`` and ``exposure_s``: None if unknown.
    - ``range_mm``: None if the file gives none.
    - ``lacking``: keys that simulation would need.
    - ``notes``: warnings about the calibration.
    """

    name: str
    technology: str
    rig: Rig
    projector_size: tuple[int, int]
    pattern: DotPattern | LightCode | ProjectorImages | AmplitudeModulation
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
        """Make the rig of a complete sensor."""
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
    """Read the rig of a preset by name, or of a possibly incomplete sensor file by path.

    ``size`` (width, height) [px] of the images is used for cameras without one: OpenCV's pair of ``intrinsics.yml``
    and ``extrinsics.yml`` has no size.

    Raises
    ------
    InputError
        For an unknown name, or a file that does not describe a rig; the error names all missing keys.
    """
    path, table, notes = sensor_table(name, size)
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
    """Return name and technology of a preset or sensor file. Nothing else is checked; its calibration is not read.

    Raises
    ------
    InputError
        For an unknown name, or a file that cannot be read or lacks one of the two.
    """
    path, table = written_table(name)
    if not {"name", "technology"} <= set(table):
        # the unread calibration may contain these keys
        held = ("cameras", "projector") if "calibration" in table else ()
        missing = [key for key in missing_keys(for_recordings(table), SensorFile) if not key.startswith(held or "\0")]
        raise InputError(path, ", ".join(missing), "nothing", "a value for each: these keys are required")
    named = validate(path, {key: table[key] for key in ("name", "technology") if key in table}, _Named)
    return named.name, named.technology


class _Named(Document):
    name: Name
    technology: str


def _sized(table: dict[str, Any], size: tuple[int, int] | None) -> dict[str, Any]:
    """Return the table with the image size given to cameras that have none."""
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
    """Return whether the projector's own optics are missing, so that its rig contains placeholders."""
    return bool({"projector.focal_px", "projector.principal_px"} & set(lacking))


def _exposure(table: dict[str, Any], sensor: Sensor) -> float | None:
    """Return the exposure [s] of every image if the file states it; other rules need a complete sensor."""
    written = table.get("exposure", {})
    return sensor.exposure.base_s if written.get("rule") == "fixed" and "bracket" not in written else None


def _range(table: dict[str, Any], lacking: list[str], sensor: Sensor) -> tuple[float, float] | None:
    """Return the depths [mm] that the file gives: its working range, else those of its decoder."""
    if "working_range_mm" in table:
        return sensor.working_range_mm
    completed = any(key.endswith((".near_mm", ".far_mm")) for key in lacking)
    return None if completed else (sensor.settings.near_mm, sensor.settings.far_mm)
