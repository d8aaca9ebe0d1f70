"""Summarise verdicts in one line: the last line of a run, and the first sentence of its report.

Signal chain: verdict, standard uncertainty and needed uncertainty of every measurement -> reasons, each with the
measurements that it is of -> one line, of all reasons or of the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

#: least share of trials without a value that is mentioned
OFTEN = 0.05

#: number of measurements that a reason names if it is that of more
NAMED = 3


@dataclass(frozen=True)
class Judged:
    """A measurement and its verdict: standard ``uncertainty`` and ``needed`` one, in its unit; NaN if unknown.

    ``fits_corrected`` says whether it would fit with its ``bias`` subtracted; ``without_value`` is a share of the
    trials.
    ``trials`` is the number of virtual measurements: 0 if the verdict is by screening alone, None if it is not known.
    """

    name: str
    unit: str
    verdict: str
    uncertainty: float
    needed: float
    fits_corrected: bool = False
    without_value: float = 0.0
    trials: int | None = None
    bias: float = math.nan


@dataclass(frozen=True)
class Reason:
    """A clause of a result: the ``names`` of the measurements that it is of, then what it ``says``.

    A clause without names is a summary.
    """

    says: str
    names: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Return the clause with its first names, and the number of the others."""
        return named(self.names) + self.says

    @property
    def counted(self) -> str:
        """Return the clause with the number of its names, if it has several."""
        return f"{len(self.names)} measurements{self.says}" if len(self.names) > 1 else self.words

    @property
    def in_full(self) -> str:
        """Return the clause with all its names."""
        return ", ".join(self.names) + self.says


def result_reasons(judged: Sequence[Judged]) -> list[Reason]:
    """Return how many tolerances fit, and the reasons why the others do not, worst first.

    Without tolerances: that there are none, and the measurement that most often had no value.
    """
    asked = [measurement for measurement in judged if measurement.verdict != "no tolerance"]
    if not asked:
        text = f"Uncertainty given for {len(judged)} measurement{'' if len(judged) == 1 else 's'}. "
        text += "The task has no tolerances: nothing to accept or reject"
        return [Reason(". ".join([text, *filter(None, [losses_in_words(judged)])]))]
    fitting = [measurement for measurement in asked if measurement.verdict == "fits"]
    failing = sorted(
        (measurement for measurement in asked if measurement.verdict not in ("fits", "not decided")),
        key=_ratio,
        reverse=True,
    )
    unsure = [measurement for measurement in asked if measurement.verdict == "not decided"]
    reasons = [Reason(fits_in_words(len(fitting), len(unsure), len(asked), " tolerances")), *_reasons(failing)]
    valued = [measurement.name for measurement in unsure if math.isfinite(measurement.uncertainty)]
    single = [
        measurement.name
        for measurement in unsure
        if not math.isfinite(measurement.uncertainty) and measurement.without_value < 1
    ]
    none = [measurement.name for measurement in unsure if measurement.without_value == 1]
    for names, why in (
        (valued, "more virtual measurements are needed"),
        (single, "a single virtual measurement gave a value"),
        (none, "no value in the few virtual measurements"),
    ):
        reasons += [Reason(f": not decided, {why}", tuple(names))] if names else []
    reasons += [
        Reason(
            f" fits, but has no value in {_percent(measurement.without_value)} of the virtual measurements",
            (measurement.name,),
        )
        for measurement in fitting
        if measurement.without_value >= OFTEN
    ]
    return reasons


def fits_in_words(fitting: int, unsure: int, of: int, what: str = "") -> str:
    """Return how many tolerances fit, and how many are open: ``fits 3 of 7, 2 open``, or ``7 of 7 open`` of none known.

    Parameters
    ----------
    fitting, unsure, of
        Number of tolerances that fit, that are not decided, and of all.
    what
        Words after the number of all.
    """
    if unsure and unsure == of:
        return f"{unsure} of {of}{what} open"
    return f"fits {fitting} of {of}{what}" + f", {unsure} open" * bool(unsure)


def in_words(reasons: Sequence[Reason], kept: int | None = None) -> str:
    """Return reasons as one line: the summaries and the first ``kept`` of the others, and how many are left out.

    By default all are kept.
    """
    shown, left = divided(reasons, kept)
    told = {name for reason in shown for name in reason.names}
    more = {name for reason in left for name in reason.names} - told
    ending = f"and {len(more)} more, see the table" if told else "see the table"
    return "; ".join([reason.words for reason in shown] + [ending] * bool(more))


def divided(reasons: Sequence[Reason], kept: int | None) -> tuple[list[Reason], list[Reason]]:
    """Return the summaries and the first ``kept`` of the other reasons, in their order, and those left out."""
    left = [] if kept is None else [reason for reason in reasons if reason.names][kept:]
    return [reason for reason in reasons if reason not in left], left


def named(names: Sequence[str]) -> str:
    """Return the names of measurements: all of up to :data:`NAMED` + 1, else the first and the number of the others."""
    shown = list(names) if len(names) <= NAMED + 1 else list(names[:NAMED])
    return ", ".join(shown) + (f" and {len(names) - len(shown)} more" if len(shown) < len(names) else "")


def losses_in_words(judged: Sequence[Judged]) -> str:
    """Name the measurement that most often had no value, and count the others that often had none.

    Empty if each virtual measurement gave one.
    """
    worst = max(judged, key=lambda measurement: measurement.without_value)
    if worst.without_value == 0:
        return ""
    share = f"{_percent(worst.without_value)} of the virtual measurements"
    other_count = sum(measurement.without_value >= OFTEN for measurement in judged if measurement is not worst)
    if not other_count:
        return f"{worst.name} has no value in {share}"
    return f"{worst.name} and {other_count} other{'s' if other_count > 1 else ''} have no value in up to {share}"


def fits_all(judged: Sequence[Judged]) -> bool:
    """Return whether no tolerance is known not to fit."""
    return not any(measurement.verdict in ("does not fit", "undecidable") for measurement in judged)


def _ratio(judged: Judged) -> float:
    ratio = judged.uncertainty / judged.needed if judged.needed > 0 else math.inf
    return math.inf if math.isnan(ratio) else ratio


def _reasons(failing: Sequence[Judged]) -> list[Reason]:
    """Return why measurements do not fit, in their order; those without a value for the same reason in one line."""
    lost: dict[tuple[str, str], list[str]] = {}
    for measurement in failing:
        if not math.isfinite(measurement.uncertainty):
            by = "by screening, no view can make" if measurement.trials == 0 else "no virtual measurement gave a value"
            lost.setdefault((measurement.verdict, by), []).append(measurement.name)
    reasons = list[Reason]()
    for (verdict, by), names in lost.items():
        verb = "is" if len(names) == 1 else "are"
        words = f"{verb} undecidable" if verdict == "undecidable" else f"do{'es' * (len(names) == 1)} not fit"
        them = (" it" if len(names) == 1 else " them") if by.endswith("make") else ""
        reasons.append(Reason(f" {words}: {by}{them}", tuple(names)))
    return reasons + [
        Reason(_why(measurement), (measurement.name,))
        for measurement in failing
        if math.isfinite(measurement.uncertainty)
    ]


def _why(judged: Judged) -> str:
    words = "is undecidable" if judged.verdict == "undecidable" else "does not fit"
    if judged.fits_corrected:
        return f" {words} unless its bias is subtracted"
    biased = abs(judged.bias) > 2 * judged.uncertainty
    bias = f"bias {_two(judged.bias)} {judged.unit} and " if biased else ""
    needed = f", {_two(judged.needed)} {judged.unit} needed" if math.isfinite(judged.needed) else ""
    without = " without bias" if biased and needed else ""
    return f" {words}: {bias}standard uncertainty {_two(judged.uncertainty)} {judged.unit}{needed}{without}"


def _percent(share: float) -> str:
    if 0.995 < share < 1:
        return "more than 99 %"
    return f"{100 * share:.0f} %" if share >= 0.005 else "less than 1 %"


def _two(value: float) -> str:
    """Return a number as text with two significant digits."""
    if not math.isfinite(value) or value == 0:
        return f"{value:g}"
    return f"{float(f'{value:.1e}'):.{max(0, 1 - math.floor(math.log10(abs(value))))}f}"
