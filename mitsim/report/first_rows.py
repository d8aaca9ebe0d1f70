"""Format the rows of the short table on a first screen: one measurement each, as texts.

Signal chain: values of a measurement by a statement, its tolerance and rule -> texts with units. The share of the
tolerance is given with the largest share that fits and with its own 95 % interval, so that a reader can follow the
verdict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from characterisation.tasks.decision_table import BIAS_SUBTRACTED
from characterisation.tasks.task_file import effective_deviations
from characterisation.words.numbers import (
    MINUS,
    NONE,
    accepted_text,
    beside,
    count,
    listed,
    percent,
    quantity,
    unit_symbol,
)
from mitsim.report.placement_figure import VERDICTS

#: beginning of the names of rules whose demand is the share of the tolerance over the largest share that fits
_BY_SHARE = ("ISO 14253-1", "simple acceptance")

#: share above which the exact figure is of no use
_LARGEST_SHARE = 10.0

#: description of a kind of measurement by its features, in their order; other kinds: their name, "of" the features
_KINDS = {
    "intersection_distance": "distance between the points where the axes of {1} and {2} meet {0}",
    "axis_distance": "distance between the axes of {0} and {1}",
    "point_distance": "distance between {0} and {1}",
    "point_plane_distance": "distance of {0} from {1}",
    "plane_distance": "distance between {0} and {1}",
    "plane_axis_angle": "angle between the normal of {0} and the axis of {1}",
    "axis_angle": "angle between the axes of {0} and {1}",
    "plane_angle": "angle between {0} and {1}",
    "cone_angle": "full angle of {0}",
}


@dataclass(frozen=True)
class ResultRow:
    """One measurement in the short table, as texts; ``colour`` of its verdict.

    ``about`` describes the measurement. ``share`` of the tolerance with its ``share_interval`` and the largest
    ``share_limit`` that fits. ``limited`` is the limit of the view, ``points`` how many it expects there; ``source``
    is the largest line of the budget. Texts are empty where nothing is known; values without a number are a dash.
    """

    name: str
    about: str
    nominal: str
    tolerance: str
    bias: str
    uncertainty: str
    needed: str
    share: str
    share_interval: str
    share_limit: str
    accepted: str
    false_accept: str
    without_value: str
    limited: str
    points: str
    source: str
    verdict: str
    colour: str


@dataclass(frozen=True)
class RowValues:
    """Values of one measurement, in ``unit``; None where a value is not known or there is no tolerance.

    ``tolerance`` as in the task, or half the interval that conforms. ``share`` of the tolerance that the uncertainty
    takes; ``demand`` of the ``rule`` with its interval; ``accepted`` lowest and highest reading. ``limited`` is
    the limit of the view, with the expected ``points`` on that feature; ``source`` the largest line of the budget.
    Values by screening alone are not ``stated``: they accept no reading, and reject none.
    """

    name: str
    about: str
    unit: str
    verdict: str
    nominal: float
    tolerance: float | tuple[float, float] | None
    bias: float | None
    uncertainty: float | None
    without_value: float
    needed: float | None = None
    share: float | None = None
    rule: str = ""
    demand: float | None = None
    demand_interval: tuple[float | None, float | None] | None = None
    accepted: tuple[float | None, float] | None = None
    false_accept: float | None = None
    limited: str = ""
    points: float | None = None
    source: str = ""
    stated: bool = True

    @property
    def share_limit(self) -> float | None:
        """Return the largest share of the tolerance that fits; None if the rule does not limit the share."""
        if not self.rule.startswith(_BY_SHARE) or not self.share or not self.demand:
            return None
        return self.share / self.demand

    def texts(self) -> ResultRow:
        """Return the row of the table, as texts."""
        limit = self.share_limit
        size = (self.tolerance[1] - self.tolerance[0]) / 2 if isinstance(self.tolerance, tuple) else self.tolerance
        accepted = NONE
        unknown = self.verdict == "not decided" and self.demand is None  # fewer than two values: nothing is computed
        if self.rule and self.stated and not unknown:
            accepted = accepted_words(self.accepted, self.unit, size)
            accepted += ", bias subtracted" * (self.accepted is not None and self.rule.endswith(BIAS_SUBTRACTED))
        return ResultRow(
            name=self.name,
            about=self.about,
            nominal=exact(self.nominal, self.unit),
            tolerance=tolerance_words(self.tolerance, self.nominal, self.unit),
            bias=bias_words(self.bias, self.uncertainty, self.unit),
            uncertainty=quantity(self.uncertainty, self.unit),
            needed=quantity(self.needed, self.unit),
            share=NONE if self.share is None else share_words(self.share),
            share_interval="" if limit is None else _interval(self.demand_interval, limit),
            share_limit="" if limit is None else percent(limit),
            accepted=accepted,
            false_accept=percent(self.false_accept),
            without_value=percent(self.without_value),
            limited=self.limited,
            points="" if self.points is None or not math.isfinite(self.points) else count(round(self.points)),
            source=self.source,
            verdict=self.verdict,
            colour=VERDICTS.get(self.verdict, "#9a9fa8"),
        )


def measured_words(kind: str, features: Sequence[str]) -> str:
    """Describe a measurement by its kind and features: ``angle between the axes of a and b``, ``radius of a``."""
    try:
        return _KINDS[kind].format(*features)
    except (KeyError, IndexError):  # another kind, or a file of an older mitsim without kinds
        return f"{kind.replace('_', ' ')} of {listed(list(features))}" if kind else listed(list(features))


def breakable(name: str, after: str = "_") -> Markup:
    """Return a name as safe markup that a browser may break ``after`` some characters; of a path, ``_/``."""
    text = escape(name)
    for character in after:
        text = text.replace(character, Markup(f"{character}<wbr>"))
    return Markup(text)


def exact(value: float, unit: str) -> str:
    """Write a given value with its unit, with all its digits: ``70 mm``, ``0.5°``; a dash for NaN."""
    if math.isnan(value):
        return NONE
    return f"{value:g}".replace("-", MINUS) + _suffix(unit)


def tolerance_words(tolerance: float | tuple[float, float] | None, nominal: float, unit: str) -> str:
    """Write a tolerance: ``±0.4 mm``, ``+0.1 −0.2 mm``; ``up to 0.6°`` if no value is below; a dash for None."""
    deviations = effective_deviations(nominal, tolerance)
    if deviations is None:
        return NONE
    lower, upper = deviations
    if lower is None:
        text = f"up to {nominal + upper:g}"
    else:
        text = f"±{upper:g}" if lower == -upper else f"{upper:+g} {lower:+g}".replace("-", MINUS)
    return text + _suffix(unit)


def accepted_words(readings: tuple[float | None, float] | None, unit: str, tolerance: float | None) -> str:
    """Format accepted readings: ``19.82 to 20.18 mm``, ``up to 0.13 mm``, ``none``; a dash without tolerance."""
    if tolerance is None:
        return NONE
    if readings is None:
        return "none"
    low, high = readings
    return accepted_text(-math.inf if low is None else low, high, tolerance) + _suffix(unit)


def share_words(share: float) -> str:
    """Format a share of the tolerance: ``22 %``, or ``over 1000 %``."""
    return percent(share) if share < _LARGEST_SHARE else f"over {percent(_LARGEST_SHARE)}"


def _interval(ends: tuple[float | None, float | None] | None, limit: float) -> str:
    """Return the interval of a share from that of the demand: ``22 to 130 %``; few trials leave its upper end open.

    There is none if both ends are beyond the largest share that is written.
    """
    if ends is None or ends[0] is None:
        return ""
    low, high = share_words(ends[0] * limit), share_words(math.inf if ends[1] is None else ends[1] * limit)
    return "" if low == high and ends[0] * limit >= _LARGEST_SHARE else f"{low.removesuffix('%').rstrip()} to {high}"


def _suffix(unit: str) -> str:
    return unit_symbol(unit) if unit == "deg" else f"\N{NO-BREAK SPACE}{unit}"


def bias_words(bias: float | None, uncertainty: float | None, unit: str) -> str:
    """Write a bias with its sign, and as many decimal places as its standard uncertainty has (JCGM 100:2008, 7.2.6).

    Without an uncertainty two digits: ``+0.31 mm``, ``−0.02°``; a dash for None.
    """
    if bias is None:
        return NONE
    text = beside(bias, uncertainty)
    return ("+" if bias > 0 and text.strip("0.") else "") + text + _suffix(unit)
