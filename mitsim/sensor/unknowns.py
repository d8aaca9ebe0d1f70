"""Define the ``[unknowns]`` tables of a study and of a sensor file: unknown properties of a measurement.

Each table is one group of unknowns, given by standard deviations. A virtual measurement draws all of them
(:mod:`mitsim.study.virtual.world`). A sensor file states the unknowns of the type of sensor, such as the stability of
its calibration and the width of its optical filter. A study states those of the part and the room; its keys override
the sensor's. Defaults are the assumptions of an engineer who knows the workshop but has not measured it.
docs/reference/unknowns.md grades each of them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from characterisation.files.documents import Document
from mitsim.sensor.drift import Drift

NotNegative = Annotated[float, Field(ge=0)]

#: illuminance [lx] of the named rooms: EN 12464-1 requires 500 lx at workplaces
ROOMS = {"office": 500.0, "dark cell": 0.0}


class CalibrationUnknowns(Document):
    """Deviation of the sensor's true geometry from the calibration that decodes its images.

    ``covariance`` is a file written by ``mitsim calibrate``, relative to the file that names it. By default it is the
    preset's own, or a virtual calibration of the sensor. The drift since that calibration is added, by the terms of
    :class:`mitsim.sensor.drift.Drift`; the baseline's expansion follows from ``temperature``.
    """

    covariance: str | None = None
    vergence_mrad: NotNegative = Drift.vergence_mrad
    row_mrad: NotNegative = Drift.row_mrad
    roll_mrad: NotNegative = Drift.roll_mrad
    focal_relative: NotNegative = Drift.focal_relative
    path_offset_mm: NotNegative = Drift.path_offset_mm

    def drift(self) -> Drift:
        """Return the drift since the calibration."""
        return Drift(
            self.vergence_mrad,
            self.row_mrad,
            self.roll_mrad,
            self.focal_relative,
            temperature_k=0.0,
            path_offset_mm=self.path_offset_mm,
        )


Scale = Annotated[float, Field(ge=0, le=1)]

#: centre and standard deviation of a measured property, in one-sigma ranges of its prior
Posterior = tuple[Annotated[float, Field(ge=-3, le=3)], Annotated[float, Field(ge=0, le=3)]]


class MeasuredFinish(Document):
    """What a measurement of one finish says of each property; a property without an entry keeps its prior."""

    alpha: Posterior | None = None
    wide_angle: Posterior | None = None
    reflectance: Posterior | None = None
    tail: Posterior | None = None
    lay: Posterior | None = None


class FinishUnknowns(Document):
    """Uncertainty of the surface finish.

    ``alpha``, ``wide_angle``, ``reflectance``, ``tail`` and ``lay`` scale the one-sigma ranges of every finish
    (:class:`mitsim.scene.surface.scatter.Deviation`): 1 is the whole range, 0 is a known finish. With ``lay`` 0, a face
    whose lay is not given is round. ``measured`` replaces the priors of single finishes, by the id of the BSDF.
    """

    alpha: Scale = 1.0
    wide_angle: Scale = 1.0
    reflectance: Scale = 1.0
    tail: Scale = 1.0
    lay: Scale = 1.0
    measured: dict[str, MeasuredFinish] = Field(default_factory=dict)

    def centres_and_sizes(self, finish: str) -> dict[str, tuple[float, float]]:
        """Return centre and standard deviation of each property of a finish, in one-sigma ranges of its prior."""
        given = self.measured.get(finish, MeasuredFinish())
        names = MeasuredFinish.model_fields
        return {name: getattr(given, name) or (0.0, float(getattr(self, name))) for name in names}

    @property
    def varies(self) -> bool:
        """Return whether any finish is drawn; a measured value is drawn even if it is exact."""
        return bool(self.measured) or any(getattr(self, name) > 0 for name in MeasuredFinish.model_fields)


class FormUnknowns(Document):
    """Form deviation of the real part, one sigma along the normal [mm], by feature."""

    features: dict[str, NotNegative] = Field(default_factory=dict)


class LightUnknowns(Document):
    """Light that nobody controls.

    - ``room``: ``office``, ``dark cell`` or an illuminance [lx], known within the factor ``room_factor``.
    - ``daylight``: share of it from the sky; the rest comes from white LED lamps.
    - ``filter_nm``: width of the sensor's optical filter, 0 for none.
    - ``power_relative`` of the projector.
    - ``exposure_relative``: half the step in which the exposure can be set.
    """

    room: Literal["office", "dark cell"] | NotNegative = "office"
    room_factor: Annotated[float, Field(ge=1, le=10)] = 1.6
    daylight: Annotated[float, Field(ge=0, le=1)] = 0.2
    filter_nm: Annotated[float, Field(ge=0, le=500)] = 0.0
    power_relative: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    exposure_relative: Annotated[float, Field(ge=0, le=0.5)] = 0.0

    @property
    def illuminance(self) -> float:
        """Return the illuminance of the room [lx]."""
        return ROOMS[self.room] if isinstance(self.room, str) else float(self.room)


class TemperatureUnknowns(Document):
    """Temperatures, as deviations from 20 C (ISO 1) and from that of the calibration, one sigma.

    ``expansion_per_kelvin`` of the part; by default that of the metal of its finish. ``body_per_kelvin`` is the
    expansion of the cameras' support, ``focal_per_kelvin`` that of the focal lengths.
    """

    part_kelvin: NotNegative = 1.0
    sensor_kelvin: NotNegative = 2.0
    expansion_per_kelvin: Annotated[float, Field(ge=0, le=1e-3)] | None = None
    body_per_kelvin: Annotated[float, Field(ge=0, le=1e-3)] = 23e-6
    focal_per_kelvin: Annotated[float, Field(ge=-1e-3, le=1e-3)] = 0.0


class PoseUnknowns(Document):
    """Pose of the part: standard deviations along and about each axis through its centre.

    ``placement_mm`` and ``placement_deg``: variation of the pose from part to part, which the measurement knows.
    ``told_mm`` and ``told_deg``: error of that knowledge.
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
    """Merge tables: a later table's keys override an earlier one's; keys in none have their defaults."""
    merged: dict[str, dict[str, Any]] = {}
    for table in tables:
        for group in table.model_fields_set:
            given = getattr(table, group)
            merged.setdefault(group, {}).update({key: getattr(given, key) for key in given.model_fields_set})
    return UnknownsTable.model_validate(merged)
