"""What is not known of a measurement: the ``[unknowns]`` tables of a study and of a sensor file.

Each table is one group of unknowns, by its one-sigma figures. A virtual measurement draws all of them
(:mod:`mitsim.virtual.world`). A sensor file says what belongs to the type of sensor (how well it keeps its calibration,
how wide its optical filter is), a study what belongs to the part and the room; a key of the study overrules the
sensor's. Defaults are what an engineer would assume who knows the workshop but has not measured it; each is graded in
docs/reference/unknowns.md.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from characterisation.documents import Document
from mitsim.sensor.drift import Drift

NotNegative = Annotated[float, Field(ge=0)]

#: illuminance [lx] of the rooms that have a name: EN 12464-1 asks for 500 lx where people work
ROOMS = {"office": 500.0, "dark cell": 0.0}


class CalibrationUnknowns(Document):
    """How far the sensor's true geometry lies from the calibration that decodes its images.

    ``covariance`` is a file that ``mitsim calibrate`` wrote, relative to the file that names it; left out, the one that
    comes with the preset, or a virtual calibration of the sensor. To it is added the drift since that calibration, by
    the terms of :class:`mitsim.sensor.drift.Drift`; the baseline's own expansion follows from ``temperature``.
    """

    covariance: str | None = None
    vergence_mrad: NotNegative = Drift.vergence_mrad
    row_mrad: NotNegative = Drift.row_mrad
    roll_mrad: NotNegative = Drift.roll_mrad
    focal_relative: NotNegative = Drift.focal_relative
    path_offset_mm: NotNegative = Drift.path_offset_mm

    def drift(self) -> Drift:
        """The drift since the calibration."""
        return Drift(
            self.vergence_mrad,
            self.row_mrad,
            self.roll_mrad,
            self.focal_relative,
            temperature_k=0.0,
            path_offset_mm=self.path_offset_mm,
        )


class FinishUnknowns(Document):
    """How well the surface is known.

    ``alpha``, ``wide_angle`` and ``reflectance`` scale the one-sigma ranges that every finish brings with it
    (:class:`mitsim.surface.scatter.Deviation`): 1 is the whole range, 0 says that the finish is known.
    """

    alpha: Annotated[float, Field(ge=0, le=1)] = 1.0
    wide_angle: Annotated[float, Field(ge=0, le=1)] = 1.0
    reflectance: Annotated[float, Field(ge=0, le=1)] = 1.0


class FormUnknowns(Document):
    """Form deviation of the real part, one sigma along the normal [mm], for each feature that has one."""

    features: dict[str, NotNegative] = Field(default_factory=dict)


class LightUnknowns(Document):
    """Light that nobody controls.

    ``room`` is ``office``, ``dark cell`` or an illuminance [lx]; it is known within the factor ``room_factor``, and
    ``daylight`` of it comes from the sky, the rest from white LED lamps. ``filter_nm`` is the width of the sensor's
    optical filter, 0 for none. ``power_relative`` of the projector; ``exposure_relative`` is half the step in which
    the exposure can be set.
    """

    room: Literal["office", "dark cell"] | NotNegative = "office"
    room_factor: Annotated[float, Field(ge=1, le=10)] = 1.6
    daylight: Annotated[float, Field(ge=0, le=1)] = 0.2
    filter_nm: Annotated[float, Field(ge=0, le=500)] = 0.0
    power_relative: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    exposure_relative: Annotated[float, Field(ge=0, le=0.5)] = 0.0

    @property
    def illuminance(self) -> float:
        """Of the room [lx]."""
        return ROOMS[self.room] if isinstance(self.room, str) else float(self.room)


class TemperatureUnknowns(Document):
    """Temperatures, as deviations from 20 C (ISO 1) and from that of the calibration, one sigma.

    ``expansion_per_kelvin`` of the part; left out, that of the metal of its finish. ``body_per_kelvin`` is the
    expansion of what holds the cameras, ``focal_per_kelvin`` that of the focal lengths.
    """

    part_kelvin: NotNegative = 1.0
    sensor_kelvin: NotNegative = 2.0
    expansion_per_kelvin: Annotated[float, Field(ge=0, le=1e-3)] | None = None
    body_per_kelvin: Annotated[float, Field(ge=0, le=1e-3)] = 23e-6
    focal_per_kelvin: Annotated[float, Field(ge=-1e-3, le=1e-3)] = 0.0


class PoseUnknowns(Document):
    """Where the part lies, standard deviations along and about each axis through its middle.

    ``placement_mm`` and ``placement_deg``: by how much it comes to lie elsewhere each time, which the measurement is
    told; ``told_mm`` and ``told_deg``: by how much that is wrong.
    """

    placement_mm: Annotated[float, Field(ge=0, le=100)] = 1.0
    placement_deg: Annotated[float, Field(ge=0, le=5)] = 0.3
    told_mm: Annotated[float, Field(ge=0, le=20)] = 0.2
    told_deg: Annotated[float, Field(ge=0, le=2)] = 0.05


class UnknownsTable(Document):
    """All groups of unknowns."""

    calibration: CalibrationUnknowns = CalibrationUnknowns()
    finish: FinishUnknowns = FinishUnknowns()
    form: FormUnknowns = FormUnknowns()
    light: LightUnknowns = LightUnknowns()
    temperature: TemperatureUnknowns = TemperatureUnknowns()
    pose: PoseUnknowns = PoseUnknowns()


def unknowns_of(*tables: UnknownsTable) -> UnknownsTable:
    """One table of several: a key that a later one gives overrules an earlier one; what none gives is the default."""
    merged: dict[str, dict[str, Any]] = {}
    for table in tables:
        for group in table.model_fields_set:
            given = getattr(table, group)
            merged.setdefault(group, {}).update({key: getattr(given, key) for key in given.model_fields_set})
    return UnknownsTable.model_validate(merged)
