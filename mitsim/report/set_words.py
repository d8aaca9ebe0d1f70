"""Say whether a set of views keeps its limits: on the first screen of a run, in its last line, in its exit code.

Signal chain: set of views of ``run.json``, with its limits and its virtual measurements -> reasons in words, and
whether every limit is kept.

The performance map predicts that a set keeps its limits; only virtual measurements of the whole set confirm it. Without
them the sentence says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from characterisation.statements.verdict_words import OFTEN, Reason, in_words
from characterisation.words.numbers import how_many, two_digits
from mitsim.study.run_document import ConfirmedEntry, ViewSetEntry

_OUT_OF_REACH = " is out of reach"


@dataclass(frozen=True)
class SetResult:
    """``reasons`` of the result of a set of views; ``good`` unless a limit is known to be missed."""

    reasons: tuple[Reason, ...]
    good: bool

    @property
    def words(self) -> str:
        """Return all reasons in one line."""
        return in_words(self.reasons)


def set_result(entry: ViewSetEntry) -> SetResult:
    """Compare every limit with the root mean square error of the virtual measurements of the set."""
    limits, reached = entry.limits, {name: entry.feasible.get(name, True) for name in entry.limits}
    out_of_reach = [Reason(_OUT_OF_REACH, (name,)) for name, able in reached.items() if not able]
    if not entry.views:
        return SetResult((Reason("no set of views keeps the limits"), *out_of_reach), False)
    which = f"the set of {views_in_words(entry.views)}"
    if not entry.confirmed:
        able = sum(reached.values())
        words = f"{which} is predicted to keep {able} of {len(limits)} limits, which no virtual measurement confirms"
        return SetResult((Reason(words), *out_of_reach), not out_of_reach)
    missed, often = list[Reason](), list[Reason]()
    for name, limit in limits.items():
        confirmed = entry.confirmed.get(name)
        error = _error(confirmed)
        if confirmed is None or not reached[name] or not error <= limit:
            missed.append(Reason(_missed(confirmed, error, limit, reached[name]), (name,)))
        elif confirmed.without_value >= OFTEN:
            share = f"{100 * confirmed.without_value:.0f} % of the virtual measurements"
            often.append(Reason(f": no value in {share}", (name,)))
    words = f"{which}, measured together, keeps {len(limits) - len(missed)} of {len(limits)} limits"
    return SetResult((Reason(words), *missed, *often), not missed)


def views_in_words(views: Sequence[int]) -> str:
    """Return the number of views, and which: ``2 views (3, 12)``."""
    return f"{how_many(len(views), 'view')} ({', '.join(map(str, views))})"


def with_sets(reasons: Sequence[Reason], good: bool, entries: Sequence[ViewSetEntry]) -> SetResult:
    """Return the result of a run, followed by that of its sets of views."""
    results = [set_result(entry) for entry in entries]
    every = (*reasons, *(reason for result in results for reason in result.reasons))
    return SetResult(every, good and all(result.good for result in results))


def _error(confirmed: ConfirmedEntry | None) -> float:
    """Root mean square error; NaN without values."""
    if confirmed is None or confirmed.bias is None or confirmed.standard_uncertainty is None:
        return math.nan
    return math.hypot(confirmed.bias, confirmed.standard_uncertainty)


def _missed(confirmed: ConfirmedEntry | None, error: float, limit: float, reached: bool) -> str:
    if not reached:
        return _OUT_OF_REACH
    if confirmed is None or not math.isfinite(error):
        return " has no value"
    return f" exceeds its limit: error {two_digits(error)} {confirmed.unit}, {limit:g} {confirmed.unit} allowed"
