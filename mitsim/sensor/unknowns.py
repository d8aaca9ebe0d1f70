"""Define the ``[unknowns]`` tables of a study and of a sensor file: unknown properties of a measurement.

Each table is one group of unknowns, given by standard deviations. A virtual measurement draws all of them
(:mod:`mitsim.study.virtual.world`). A sensor file states the unknowns of the type of sensor, such as the stability of
its calibration and the width of its optical filter. A study states those of the part and the room; its keys override
the sensor's. Defaults are the assumptions of an engineer who knows the workshop but has not measured it.
docs/reference/unknowns.md grades each of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from characterisation.files.documents import Document, validate
from mitsim.sensor.drift import Drift
from mitsim.sensor.matcher import ContrastWindow, OddSum, odd

NotNegative = Annotated[float, Field(ge=0)]
Thickness = Annotated[float, Field(ge=0, le=1000)]
Percent = Annotated[float, Field(ge=0, le=100)]
_OverZero = Annotated[float, Field(gt=0, le=1000)]


def _in_order(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("the smaller number first")
    return ends


def _from_one(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] < 1:
        raise ValueError("factors from 1, since p2 is not under p1")
    return ends


#: a range of numbers over 0
Factors = Annotated[tuple[_OverZero, _OverZero], AfterValidator(_in_order)]

OddBlock = Annotated[int, Field(ge=3, le=31), AfterValidator(odd)]

#: illuminance [lx] of the named rooms: EN 12464-1 requires 500 lx at workplaces
ROOMS = {"office": 500.0, "dark cell": 0.0}


#: keys of the drift of sensors that triangulate, by their words in a list of influences
TRIANGULATION_DRIFT = {
    "row_mrad": "row error",
    "vergence_mrad": "vergence",
    "roll_mrad": "roll",
    "focal_relative": "focal length",
}

#: the same of one camera that measures time of flight
FLIGHT_DRIFT = {"focal_relative": "focal length", "path_offset_mm": "offset of the path"}


class CalibrationUnknowns(Document):
    """Deviation of the sensor's true geometry from the calibration that decodes its images.

    ``covariance`` is a file written by ``mitsim calibrate``, relative to the file that names it. By default it is the
    preset's own, or a virtual calibration of the sensor. The drift since that calibration is added, by the terms of
    :class:`mitsim.sensor.drift.Drift`; the baseline's expansion follows from ``temperature``. ``scale`` multiplies the
    errors of both: 0.5 is a calibration that is twice as accurate.
    """

    covariance: str | None = None
    vergence_mrad: NotNegative = Drift.vergence_mrad
    row_mrad: NotNegative = Drift.row_mrad
    roll_mrad: NotNegative = Drift.roll_mrad
    focal_relative: NotNegative = Drift.focal_relative
    path_offset_mm: NotNegative = Drift.path_offset_mm
    scale: Annotated[float, Field(ge=0, le=10)] = 1.0

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

    def of_kind(self, flight: bool) -> CalibrationUnknowns:
        """Return the same without the drift that a sensor cannot have, with or without time of flight."""
        own = FLIGHT_DRIFT if flight else TRIANGULATION_DRIFT
        return self.model_copy(update=dict.fromkeys((TRIANGULATION_DRIFT | FLIGHT_DRIFT).keys() - own.keys(), 0.0))

    def drifting(self, flight: bool) -> list[str]:
        """Return the keys of the drift that a sensor has, with or without time of flight, and that is not zero."""
        keys = FLIGHT_DRIFT if flight else TRIANGULATION_DRIFT
        return [key for key in keys if self.scale * getattr(self, key) > 0]


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
        measured = self.measured.get(finish, MeasuredFinish())
        names = MeasuredFinish.model_fields
        return {name: getattr(measured, name) or (0.0, float(getattr(self, name))) for name in names}

    def of_finishes(self, names: Iterable[str]) -> FinishUnknowns:
        """Return the same without what no finish of some names can have: a matt white has a reflectance alone."""
        if set(names) != {"matt_white"}:
            return self
        return self.model_copy(update=dict.fromkeys(MeasuredFinish.model_fields.keys() - {"reflectance"}, 0.0))

    @property
    def varies(self) -> bool:
        """Return whether any finish is drawn; a measured value is drawn even if it is exact."""
        return bool(self.measured) or any(getattr(self, name) > 0 for name in MeasuredFinish.model_fields)


class FormUnknowns(Document):
    """Form deviation of the real part about its least-squares features, a quarter of its zone [mm], by feature."""

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


class UnitUnknowns(Document):
    """The device at hand, of all devices of its type.

    ``mask`` of random dots: ``another`` for each device, since each has its own realisation of the pattern; ``own`` if
    the sensor file has the mask of this device, by its ``seed``. Images of the user's own are always those of this
    device. The fixed pattern of the imager is drawn in either case.
    """

    mask: Literal["another", "own"] = "another"


class DecoderUnknowns(Document):
    """What a maker does not say of its decoder. A virtual measurement draws a decoder for each day.

    A list holds choices of equal chance; an empty one keeps the setting of the sensor file. A pair of numbers is a
    range. ``known``: nothing is drawn, since the sensor file's settings are those that decode the captures.

    - ``methods`` of two cameras: several frames are not matched by ``sgbm``. One camera keeps its method.
    - ``blocks_px`` of ``sgbm``, ``sums_px`` of ``census``; ``block_factor`` of the sensor's own block for
      ``correlation``.
    - ``census_windows_px``, ``contrast_windows_px``, ``prefilter_caps``, ``modes``, ``p1``, ``p2_over_p1``,
      ``uniqueness_percent``, ``left_right_px``, ``sub_pixel``, ``medians_px``, ``speckles_px``,
      ``disparity_steps_px``: as in :class:`mitsim.sensor.matcher.MatcherSettings`. A method draws among the sub-pixel
      fits that it has.
    - ``thresholds``: factor of the sensor's least contrast or modulation, and of the uniqueness of ``correlation``.
    - ``smoothings_px`` of structured light.

    The logarithms of penalties and factors are uniform. docs/reference/unknowns.md states the source of each range.
    """

    known: bool = False
    methods: list[Literal["sgbm", "census", "correlation"]] = Field(
        default=["sgbm", "census", "correlation"], max_length=20
    )
    blocks_px: list[OddBlock] = Field(default=[5, 7, 9, 11], max_length=20)
    sums_px: list[OddSum] = Field(default=[1, 3, 5], max_length=20)
    block_factor: Factors = (0.6, 1.4)
    census_windows_px: list[Literal[3, 5, 7, 9]] = Field(default=[5, 7, 9], max_length=20)
    contrast_windows_px: list[ContrastWindow] = Field(default=[0, 11], max_length=20)
    prefilter_caps: list[Annotated[int, Field(ge=1, le=127)]] = Field(default=[15, 31, 63], max_length=20)
    modes: list[Literal["hh", "sgbm", "3way"]] = Field(default=["hh", "sgbm", "3way"], max_length=20)
    p1: Factors = (4.0, 16.0)
    p2_over_p1: Annotated[Factors, AfterValidator(_from_one)] = (2.0, 8.0)
    uniqueness_percent: Annotated[tuple[Percent, Percent], AfterValidator(_in_order)] = (5.0, 15.0)
    left_right_px: Annotated[tuple[NotNegative, NotNegative], AfterValidator(_in_order)] = (0.5, 2.0)
    sub_pixel: list[Literal["method", "parabola", "equiangular", "opencv"]] = Field(
        default=["method", "parabola", "equiangular", "opencv"], max_length=20
    )
    medians_px: list[Literal[0, 3, 5, 7]] = Field(default=[0, 3, 5], max_length=20)
    speckles_px: list[Annotated[int, Field(ge=0, le=100_000)]] = Field(default=[0, 100], max_length=20)
    disparity_steps_px: list[Annotated[float, Field(ge=0, le=1)]] = Field(default=[], max_length=20)
    thresholds: Factors = (0.5, 2.0)
    smoothings_px: list[Annotated[float, Field(ge=0, le=10)]] = Field(default=[], max_length=20)

    @model_validator(mode="after")
    def _check_penalties(self) -> DecoderUnknowns:
        if self.p1[1] * self.p2_over_p1[1] > 1000:
            raise ValueError("p1 times p2_over_p1 up to 1000, the largest p2")
        return self


class CoatUnknowns(Document):
    """Coat of the faces that are sprayed for the measurement: those in ``matt_white``.

    ``thickness_um``: range of the mean thickness on a part. ``spread``: standard deviation of the thickness over the
    part, relative to its mean. The thickness 0 is a part that is white itself.
    """

    thickness_um: Annotated[tuple[Thickness, Thickness], AfterValidator(_in_order)] = (5.0, 20.0)
    spread: Scale = 0.3


class UnknownsTable(Document):
    """All groups of unknowns."""

    calibration: CalibrationUnknowns = CalibrationUnknowns()
    finish: FinishUnknowns = FinishUnknowns()
    form: FormUnknowns = FormUnknowns()
    light: LightUnknowns = LightUnknowns()
    temperature: TemperatureUnknowns = TemperatureUnknowns()
    pose: PoseUnknowns = PoseUnknowns()
    unit: UnitUnknowns = UnitUnknowns()
    decoder: DecoderUnknowns = DecoderUnknowns()
    coat: CoatUnknowns = CoatUnknowns()


def unknowns_of(*tables: UnknownsTable) -> UnknownsTable:
    """Merge tables: a later table's keys override an earlier one's; keys in none have their defaults.

    Raises InputError if keys of two tables contradict one another.
    """
    merged: dict[str, dict[str, Any]] = {}
    for table in tables:
        for group in table.model_fields_set:
            section = getattr(table, group)
            merged.setdefault(group, {}).update({key: getattr(section, key) for key in section.model_fields_set})
    return validate("the unknowns of sensor and study together", merged, UnknownsTable)
