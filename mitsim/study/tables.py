"""Define the tables and keys of a study's TOML file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from characterisation.files.documents import Document
from characterisation.scores.joining import POSE_KNOWN, Joining
from mitsim.sensor.unknowns import UnknownsTable
from mitsim.views import ViewsTable


class CharacterisationTable(Document):
    """Source of the performance map: a campaign to run, or an existing map.

    ``map`` is a file, or the name of a sensor whose map comes with mitsim. If both keys are missing, the map of the
    study's sensor is used.
    """

    campaign: str | None = None
    map: str | None = None

    @model_validator(mode="after")
    def _one(self) -> CharacterisationTable:
        if self.campaign is not None and self.map is not None:
            raise ValueError("either campaign or map, not both")
        return self


class CheckTable(Document):
    """Number of best views that are rendered once more for the report's pictures, unknowns at their best estimates."""

    views: int = Field(default=4, ge=0, le=10000)


class ScoreTable(Document):
    """Light with which views are screened: up to ``light_path_depth`` surfaces on a light path; 1 is direct light only.

    If no face of the part can see another, screening uses direct light for every value, since the part has no
    interreflections. Only the predicted uncertainty includes interreflections. V_m is as in the talk.
    """

    light_path_depth: int = Field(default=2, ge=1, le=16)


class MeasureTable(Document):
    """How virtual measurements are made.

    ``by`` is ``render``, or ``map`` for clouds that are drawn from the performance map; by default it follows from the
    source of the map. ``samples_per_pixel`` holds for direct light; by default it follows from the sensor
    (:func:`mitsim.study.virtual.plan.rendering_of`). ``light_path_depth`` is the largest number of
    surfaces on a light path: between two pillars of metal, two miss 10 % of the light, three 1.5 %, four 0.3 %
    (``tests/benchmarks/light_surfaces.py``).
    """

    by: Literal["render", "map"] | None = None
    samples_per_pixel: int | None = Field(default=None, ge=1, le=4096)
    light_path_depth: int = Field(default=4, ge=1, le=16)


class RaceTable(Document):
    """Views that are measured virtually, and the end of the race.

    The race measures the best ``shortlist`` views for all measurements together according to the map, with at most
    ``trials`` of each. It ends when the error of the leading view is expected to exceed the least by no more than the
    share ``loss``, or after ``minutes``. ``margin`` is that of the stated probability: a view within it is nearly the
    best. With ``each``, the best view of each measurement alone is asked for as well, which takes several times as many
    trials.
    """

    shortlist: int = Field(default=24, ge=1, le=1000)
    trials: int = Field(default=16, ge=4, le=100_000)
    margin: Annotated[float, Field(gt=0, le=1)] = 0.1
    loss: Annotated[float, Field(gt=0, le=1)] = 0.05
    each: bool = False
    minutes: Annotated[float, Field(gt=0, le=100_000)] | None = None


class StatementTable(Document):
    """How the uncertainty of the chosen view is stated.

    ``trials`` are made with draws that no race uses. A study that names no number goes on after the default, up to five
    times as many, until every standard uncertainty has at most the relative standard error ``known_to``, but on bare
    metal not before errors with tails as long as those of metal could have it. Within a time limit, ``known_to`` is not
    used.
    """

    trials: int = Field(default=200, ge=2, le=1_000_000)
    known_to: Annotated[float, Field(gt=0, le=1)] = 0.1


class ExposureTable(Document):
    """Exposures of the captures whose uncertainty is stated, in place of the sensor's own exposure rule.

    Several ``exposures_s`` [s] are merged; the projector has the relative ``power``. Without ``exposures_s``, mitsim
    plans at most ``most`` exposures for the view. The number of points and the uncertainty of every feature are then
    ``within`` this fraction of the best values that any exposures reach.
    """

    most: int = Field(default=3, ge=1, le=7)
    within: Annotated[float, Field(ge=0.01, le=1)] = 0.1
    exposures_s: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=1, max_length=7)] | None = None
    power: Annotated[float, Field(gt=0, le=1)] = 1.0

    @model_validator(mode="after")
    def _one(self) -> ExposureTable:
        if self.exposures_s is None and self.power != 1.0:
            raise ValueError("power only with exposures_s; without exposures_s mitsim plans it")
        return self


class RemediesTable(Document):
    """Search for changes that would make measurements fit their tolerances, after the statement.

    ``trials`` virtual measurements confirm a change: a quarter of them may exclude it, and four times as many may
    decide it. The search ends after ``minutes``, or in time for ``--minutes`` of the run; with 0 there is none.
    """

    trials: int = Field(default=40, ge=8, le=100_000)
    minutes: Annotated[float, Field(ge=0, le=100_000)] = 5.0


class SetTable(Document):
    """The fewest views that together keep limits of uncertainty.

    ``limits`` are standard uncertainties by measurement, in the unit of the measurement; all named limits must hold at
    once. Without ``limits``, every measurement with a tolerance gets the largest uncertainty that fits the tolerance by
    its decision rule. A view sees a feature if the feature has enough points with a probability of at least
    ``least_chance``. After ``seconds`` the search ends with the best set so far, which is then not proven to be the
    smallest.

    ``joining`` is the method that gives the poses of the views in a common frame. Their standard uncertainty is
    ``joining_mm`` along and ``joining_deg`` about each axis, at the middle of the part. Missing values are the usual
    ones of the method. ``trials`` virtual measurements of the whole set confirm it in ``mitsim run``.
    """

    limits: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    joining: Joining = "robot"
    joining_mm: Annotated[float, Field(ge=0, le=100)] | None = None
    joining_deg: Annotated[float, Field(ge=0, le=10)] | None = None
    trials: int = Field(default=40, ge=0, le=100_000)
    least_chance: Annotated[float, Field(gt=0, lt=1)] = 0.95
    seconds: Annotated[float, Field(gt=0, le=3600)] = 60.0

    @property
    def pose_known(self) -> tuple[float, float]:
        """Return the standard uncertainty of each view's pose: along [mm] and about [deg] each axis."""
        position, angle = POSE_KNOWN[self.joining]
        return (
            position if self.joining_mm is None else self.joining_mm,
            angle if self.joining_deg is None else self.joining_deg,
        )

    @model_validator(mode="after")
    def _joined(self) -> SetTable:
        if self.joining == "exact" and (self.joining_mm or self.joining_deg):
            raise ValueError('neither joining_mm nor joining_deg with joining = "exact"')
        if self.joining == "best_fit" and not all(self.pose_known):
            raise ValueError(
                'joining_mm and joining_deg above 0 with joining = "best_fit", which starts from inexact poses'
            )
        return self


class StudyFile(Document):
    """A study TOML file; its paths are relative to the file."""

    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)
    sprayed: bool = False
    task: str
    sensor: str
    seed: Annotated[int, Field(ge=0)] = 1
    characterisation: CharacterisationTable = CharacterisationTable()
    views: ViewsTable
    score: ScoreTable = ScoreTable()
    unknowns: UnknownsTable = UnknownsTable()
    measure: MeasureTable = MeasureTable()
    race: RaceTable = RaceTable()
    statement: StatementTable = StatementTable()
    exposure: ExposureTable | None = None
    set: SetTable | None = None
    remedies: RemediesTable = RemediesTable()
    check: CheckTable = CheckTable()
