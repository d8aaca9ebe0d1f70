"""What is not known of a measurement: the ``[unknowns]`` tables of a study and of a sensor file.

Each table is one group of unknowns, by its one-sigma figures. A virtual measurement draws all of them
(:mod:`mitsim.virtual.world`). A sensor file says what belongs to the type of sensor (how well it keeps its calibration,
how wide its optical filter is), a study what belongs to the part and the room; a key of the study overrules the
sensor's. Defaults are what an engineer would assume who knows the workshop but has not measured it; each is graded in
docs/reference/unknowns.md.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from characterisation.documents import Document

NotNegative = Annotated[float, Field(ge=0)]

#: illuminance [lx] of the rooms that have a name: EN 12464-1 asks for 500 lx where people work
ROOMS = {"office": 500.0, "dark cell": 0.0}


class CalibrationTable(Document):
    """How far the sensor's true geometry lies from the calibration that decodes its images.

    ``covariance`` is a file of :func:`mitsim.sensor.rig_covariance.write_rig_covariance`, relative to the file that
    names it; left out, the one that comes with the preset. To it is added the drift since that calibration: turns of
    the second eye about its axes, ``vergence_mrad`` (y), ``row_mrad`` (x: a row error) and ``roll_mrad`` (z);
    ``focal_relative`` of all eyes together; ``baseline_relative``. Of a time-of-flight sensor ``path_mm`` and
    ``path_relative``, errors of the distance along the ray.
    """

    covariance: str | None = None
    vergence_mrad: NotNegative = 0.05
    row_mrad: NotNegative = 0.05
    roll_mrad: NotNegative = 0.05
    focal_relative: NotNegative = 1e-4
    baseline_relative: NotNegative = 5e-5
    path_mm: NotNegative = 3.0
    path_relative: NotNegative = 0.0


class FinishTable(Document):
    """How well the surface is known.

    ``alpha`` and ``wide_angle`` scale the one-sigma ranges that every finish brings with it
    (:class:`mitsim.surface.scatter.Scatter`): 1 is the whole range, 0 says that the finish is known.
    """

    alpha: Annotated[float, Field(ge=0, le=1)] = 1.0
    wide_angle: Annotated[float, Field(ge=0, le=1)] = 1.0


class FormTable(Document):
    """Form deviation of the real part, one sigma along the normal [mm], for each feature that has one."""

    features: dict[str, NotNegative] = Field(default_factory=dict)


class LightTable(Document):
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


class TemperatureTable(Document):
    """Temperatures, as deviations from 20 C (ISO 1) and from that of the calibration, one sigma.

    ``expansion_per_kelvin`` of the part; left out, that of the metal of its finish. ``body_per_kelvin`` is the
    expansion of what holds the cameras, ``focal_per_kelvin`` that of the focal lengths.
    """

    part_kelvin: NotNegative = 1.0
    sensor_kelvin: NotNegative = 2.0
    expansion_per_kelvin: Annotated[float, Field(ge=0, le=1e-3)] | None = None
    body_per_kelvin: Annotated[float, Field(ge=0, le=1e-3)] = 23e-6
    focal_per_kelvin: Annotated[float, Field(ge=-1e-3, le=1e-3)] = 0.0


class PoseTable(Document):
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

    calibration: CalibrationTable = CalibrationTable()
    finish: FinishTable = FinishTable()
    form: FormTable = FormTable()
    light: LightTable = LightTable()
    temperature: TemperatureTable = TemperatureTable()
    pose: PoseTable = PoseTable()


class UnknownsOverrides(Document):
    """The keys of ``[unknowns]`` that a file gives, checked, and told apart from defaults."""

    given: dict[str, dict[str, Any]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _as_written(cls, written: Any) -> Any:
        UnknownsTable.model_validate(written)
        return {"given": written}


def unknowns_of(*tables: UnknownsOverrides | None) -> UnknownsTable:
    """One table of several: a key of a later one overrules that of an earlier one, and what none gives is default."""
    merged: dict[str, dict[str, Any]] = {}
    for table in tables:
        for group, keys in (table.given if table is not None else {}).items():
            merged.setdefault(group, {}).update(keys)
    return UnknownsTable.model_validate(merged)
