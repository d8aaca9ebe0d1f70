"""Read ``statement.json``, the statement of uncertainty of one view, as far as reports and exports need it."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from scipy.stats import chi2

from characterisation.files.checked_files import read_json_object
from characterisation.files.documents import Document, validate
from characterisation.statements.size_dependence import SizeDependence
from characterisation.statements.statement import ANY_PART
from mitsim.study.maker_accuracy import below_the_maker

#: trials of the first round of a comparison; with as many, a standard uncertainty may be 1.4 times as large, and one of
#: fewer is called rough; chosen
FEW_TRIALS = 24


def roughness_in_words(trials: int) -> str:
    """Return how much larger standard uncertainties may be, if few trials stand behind them; otherwise empty.

    The factor is that of normal errors with 97.5 % confidence, from the chi-square distribution.
    """
    if not 2 <= trials < FEW_TRIALS:
        return ""
    factor = math.sqrt((trials - 1) / chi2.ppf(0.025, trials - 1))
    return f"{trials} virtual measurements only: standard uncertainties may be {factor:.1f} times as large"


class PartialDocument(Document, extra="ignore"):
    """A file written by mitsim, as far as its reader needs it: other keys are ignored."""


class BudgetEntry(PartialDocument):
    """One line of the budget."""

    group: str
    variance: float = Field(ge=0)
    low: float
    high: float
    share: float
    share_interval: tuple[float, float]
    settled: bool


class DecisionEntry(PartialDocument):
    """Result of the decision rule for a measurement, as far as a report needs it."""

    rule: str
    accepted: tuple[float | None, float] | None
    fits_corrected: bool
    needed: float | None
    false_accept: float | None
    false_reject: float | None
    consumer_risk: float | None
    producer_risk: float | None
    demand: float | None = None
    demand_interval: tuple[float | None, float | None] | None = None


class LossEntry(PartialDocument):
    """A kind of reason why trials had no value, and their number."""

    reason: str
    count: int = Field(ge=0)


class StatedMeasurement(PartialDocument):
    """One measurement of ``statement.json``."""

    unit: str
    trials: int
    without_value: float
    bias: float | None
    bias_uncertainty: float | None
    standard_uncertainty: float | None
    interval: tuple[float | None, float | None]
    interval_corrected: tuple[float | None, float | None]
    settled: bool
    repeatability: float | None
    budget: list[BudgetEntry]
    after_repeats: dict[str, float] = Field(default_factory=dict)
    tolerance: float | None
    share_of_tolerance: float | None
    decision: DecisionEntry | None = None
    verdict: str
    losses: list[LossEntry] = Field(default_factory=list)
    errors_of: str = ANY_PART
    maker_sigma: float | None = None
    size_depends_on: SizeDependence | None = None

    @property
    def expanded_uncertainty(self) -> float | None:
        """Return U, the larger end of the 95 % interval after correction: bias - U to bias + U has 95 % or more."""
        low, high = self.interval_corrected
        return None if low is None or high is None else max(-low, high)

    @property
    def coverage_factor(self) -> float | None:
        """Return k = U / u (JCGM 100:2008, 6.2.1); None without an interval."""
        whole, u = self.expanded_uncertainty, self.standard_uncertainty
        return None if whole is None or not u else whole / u


class InfluenceEntry(PartialDocument):
    """An influence, and whether the statement contains it; ``simulated`` if mitsim could vary it.

    Statements of older versions do not say so: their influences that are not included count as left out.
    """

    name: str
    included: bool
    how: str
    simulated: bool = False


class ExposureEntry(PartialDocument):
    """Exposures [s] of the captures behind a statement, and the share of the projector's power."""

    exposures_s: list[float] = Field(min_length=1)
    power: float


class StatementDocument(PartialDocument):
    """``statement.json``."""

    schema_version: Literal[1]
    measured_by: str
    view: int
    calibration: str
    unknowns: dict[str, dict[str, Any]] = Field(default_factory=dict)
    measurements: dict[str, StatedMeasurement]
    influences: list[InfluenceEntry]
    exposure: ExposureEntry | None = None
    sensor: str = ""

    @property
    def draws_lay(self) -> bool:
        """Return whether the virtual measurements draw the direction of marks that a scene does not give."""
        return self.measured_by == "render" and self.unknowns.get("finish", {}).get("lay", 0) > 0

    def doubts(self, left_out: str = "") -> list[str]:
        """Return a sentence on measurements that are stated far below the accuracy of the maker, if there are any.

        ``left_out`` are words for the influences that are not included; by default it names each of them.
        """
        rows = [
            (name, measurement.standard_uncertainty, measurement.maker_sigma)
            for name, measurement in self.measurements.items()
        ]
        names = "; ".join(influence.name for influence in self.influences if not influence.included)
        return below_the_maker(rows, left_out or names, self.sensor)


def read_statement(path: Path) -> StatementDocument | None:
    """Read ``statement.json``; return None if there is none. Raises InputError if the file is not a valid statement."""
    if not os.path.lexists(path):
        return None
    return validate(path, read_json_object(path), StatementDocument)
