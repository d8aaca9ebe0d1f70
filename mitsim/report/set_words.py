"""Say whether a set of views keeps its limits: on the first screen of a run, in its last line, in its exit code.

Signal chain: set of views of ``run.json``, with its limits and its virtual measurements -> one sentence, and whether
every limit is kept.

The performance map predicts that a set keeps its limits; only virtual measurements of the whole set confirm it. Without
them the sentence says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from characterisation.statements.verdict_words import OFTEN
from mitsim.running.numbers import two_digits
from mitsim.study.run_folder import ConfirmedEntry, ViewSetEntry


@dataclass(frozen=True)
class SetResult:
    """``words`` of a set of views; ``good`` unless a limit is known to be missed."""

    words: str
    good: bool


def set_result(entry: ViewSetEntry) -> SetResult:
    """Compare every limit with the root mean square error of the virtual measurements of the set."""
    limits, reached = entry.limits, {name: entry.feasible.get(name, True) for name in entry.limits}
    out_of_reach = [f"{name} is out of reach" for name, able in reached.items() if not able]
    count = len(entry.views)
    if not count:
        return SetResult("; ".join(["no set of views keeps the limits", *out_of_reach]), False)
    which = f"the set of {count} view{'s' if count > 1 else ''} ({', '.join(map(str, entry.views))})"
    if not entry.confirmed:
        able = sum(reached.values())
        words = f"{which} is predicted to keep {able} of {len(limits)} limits, which no virtual measurement confirms"
        return SetResult("; ".join([words, *out_of_reach]), not out_of_reach)
    missed, often = dict[str, str](), list[str]()
    for name, limit in limits.items():
        one = entry.confirmed.get(name)
        error = _error(one)
        if one is None or not reached[name] or not error <= limit:
            missed[name] = _missed(name, one, error, limit, reached[name])
        elif one.without_value >= OFTEN:
            often.append(f"{name}: no value in {100 * one.without_value:.0f} % of the virtual measurements")
    kept = len(limits) - len(missed)
    words = f"{which}, measured together, keeps {kept} of {len(limits)} limits"
    return SetResult("; ".join([words, *missed.values(), *often]), not missed)


def with_sets(words: str, good: bool, entries: Sequence[ViewSetEntry]) -> SetResult:
    """The result of a run in words, followed by that of its sets of views."""
    results = [set_result(entry) for entry in entries]
    return SetResult(
        "; ".join([words, *(result.words for result in results)]), good and all(result.good for result in results)
    )


def _error(confirmed: ConfirmedEntry | None) -> float:
    """Root mean square error; NaN without values."""
    if confirmed is None or confirmed.bias is None or confirmed.standard_uncertainty is None:
        return math.nan
    return math.hypot(confirmed.bias, confirmed.standard_uncertainty)


def _missed(name: str, confirmed: ConfirmedEntry | None, error: float, limit: float, reached: bool) -> str:
    if not reached:
        return f"{name} is out of reach"
    if confirmed is None or not math.isfinite(error):
        return f"{name} has no value"
    return f"{name} exceeds its limit: error {two_digits(error)} {confirmed.unit}, {limit:g} {confirmed.unit} allowed"
