"""``run.json``: its entries as a report reads them; other keys are ignored."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mitsim.scene.surface.lay import LayLeftOut
from mitsim.study.remedies.entries import RemediesEntry
from mitsim.study.statement_file import PartialDocument
from mitsim.study.virtual.race import ALL


class MeasurementEntry(PartialDocument):
    """A measurement in ``run.json``, as in the task; its points lie on ``shapes``, not an edge's ``features``."""

    nominal: float
    unit: str
    features: list[str]
    kind: str = ""
    tolerance: float | tuple[float, float] | None = None
    shapes: list[str]


class ResidualEntry(PartialDocument):
    """Quality of the renders in ``run.json``, in units of the sensor's noise [1]; ``outliers`` is a share of pixels."""

    noise: float
    quadrature: float
    outliers: float


class ConfirmedEntry(PartialDocument):
    """Result of one measurement from virtual measurements of a whole set of views."""

    unit: str
    trials: int
    without_value: float
    bias: float | None
    standard_uncertainty: float | None


class TriedEntry(PartialDocument):
    """A set of views that was measured, and its largest ratio of error to limit; None without a value."""

    views: list[int]
    excess: float | None = None


class ViewSetEntry(PartialDocument):
    """Set of views that together keep limits, given for each measurement in its unit.

    ``exact`` is true if no smaller set keeps the limits. ``feasible`` is false for a limit that even all views together
    miss. ``joined`` describes how the views are combined. ``confirmed`` holds the virtual measurements of the whole
    set, ``tried`` all sets that were measured.
    """

    limits: dict[str, float]
    views: list[int]
    uncertainty: dict[str, float | None] = Field(default_factory=dict)
    feasible: dict[str, bool] = Field(default_factory=dict)
    exact: bool = False
    joined: str = "joined as if their poses were exact"
    confirmed: dict[str, ConfirmedEntry] = Field(default_factory=dict)
    tried: list[TriedEntry] = Field(default_factory=list)


class RunnerUp(PartialDocument):
    """A view that comes next for all measurements: its risk over the leader's, by the race and by statements.

    ``near`` is the probability of being the best or within the margin of it.
    """

    view: int
    ratio: float
    near: float
    trials: int
    stated_ratio: float | None = None


class RunDocument(PartialDocument):
    """The whole file."""

    schema_version: Literal[1]
    mitsim: str
    date: str = ""
    study: str
    scene: str
    sensor: str
    source: str
    map_source: str = ""
    exposure_rule: str
    seed: int
    checked_views: list[int]
    raced_views: int = 0
    race_trials: int = 0
    race_margin: float = 0.1
    finished: bool = True
    lacks: list[str] = Field(default_factory=list)
    losses: dict[str, float] = Field(default_factory=dict)
    runners_up: list[RunnerUp] = Field(default_factory=list)
    leaders: dict[str, int] = Field(default_factory=dict)
    confidence: dict[str, float] = Field(default_factory=dict)
    light_path_depth: int
    score_light_path_depth: int = 1
    render_residual: ResidualEntry | None = None
    features: dict[str, str]
    lay: dict[str, LayLeftOut] = Field(default_factory=dict)
    faces_in_sight: dict[str, float] = Field(default_factory=dict)
    measurements: dict[str, MeasurementEntry]
    view_sets: list[ViewSetEntry] = Field(default_factory=list)
    remedies: RemediesEntry | None = None
    seconds: dict[str, float] = Field(default_factory=dict)
    python: str = ""
    machine: str = ""
    cores: int | None = None
    files: dict[str, str] = Field(default_factory=dict)

    @property
    def leader(self) -> int | None:
        """Return the number of the best view for all measurements together; None if no view was raced."""
        return self.leaders.get(ALL)
