"""Count why measurements had no value, with reasons that differ in their numbers alone taken together.

Signal chain: one reason for each trial without a value -> the same texts with gaps for the numbers -> kinds of reasons,
most frequent first -> one text for each kind, with the smallest and the largest number in every gap -> the kinds of
every feature, with the measurements that need it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)", re.ASCII)


@dataclass(frozen=True)
class Loss:
    """A kind of ``reason`` why trials had no value, and their ``count``."""

    reason: str
    count: int


def losses(reasons: Iterable[str]) -> tuple[Loss, ...]:
    """Return the kinds of some reasons, most frequent first; empty reasons are left out.

    Examples
    --------
    >>> for one in losses(["pin: 12 points, at least 100 are required", "pin: 3 points, at least 100 are required"]):
    ...     print(one.count, one.reason)
    2 pin: 3 to 12 points, at least 100 are required
    """
    kinds: dict[tuple[str, ...], list[str]] = {}
    for reason in filter(None, reasons):
        kinds.setdefault(tuple(_NUMBER.split(reason)), []).append(reason)
    ordered = sorted(kinds.items(), key=lambda item: (-len(item[1]), item[0]))
    return tuple(Loss(_spanned(parts, texts), len(texts)) for parts, texts in ordered)


@dataclass(frozen=True)
class LostFeature:
    """A feature that had no credible fit in some trials, and the measurements that had no value for it.

    ``count`` is the largest number of trials that any one of the ``measurements`` lost, of ``trials``. ``reasons``,
    without the name of the feature, come with the number of such trials, most frequent first. ``feature`` is empty
    where the reason names none.
    """

    feature: str
    measurements: tuple[str, ...]
    count: int
    trials: int
    reasons: tuple[Loss, ...]

    def in_words(self) -> str:
        """Return the feature, its measurements and the most frequent reason as one line."""
        head = f"{self.count} of {self.trials}: {self.feature}" if self.feature else f"{self.count} of {self.trials}"
        first, other_count = self.reasons[0], len(self.reasons) - 1
        times = (
            f" ({first.count} times; {other_count} other {'reason' if other_count == 1 else 'reasons'})"
            if other_count
            else ""
        )
        return f"{head} ({', '.join(self.measurements)}): {first.reason}{times}"


def lost_features(measurements: Iterable[tuple[str, int, Iterable[Loss]]]) -> tuple[LostFeature, ...]:
    """Return the features for which measurements had no value, most trials first.

    A measurement names only the first of its features that failed. ``measurements`` are names, numbers of trials and
    losses; measurements of other numbers of trials have entries of their own.

    Examples
    --------
    >>> pin = [Loss("pin: 3 points", 5), Loss("pin: far from nominal", 1)]
    >>> for one in lost_features([("radius", 20, pin), ("angle", 20, pin)]):
    ...     print(one.in_words())
    6 of 20: pin (radius, angle): 3 points (5 times; 1 other reason)
    """
    counts: dict[tuple[str, int], dict[str, dict[str, int]]] = {}
    for name, trials, lost in measurements:
        for loss in lost:
            feature, colon, reason = loss.reason.partition(": ")
            if not colon:
                feature, reason = "", loss.reason
            by_reason = counts.setdefault((feature, trials), {}).setdefault(name, {})
            by_reason[reason] = by_reason.get(reason, 0) + loss.count
    features = []
    for (feature, trials), by_name in counts.items():
        most: dict[str, int] = {}
        for by_reason in by_name.values():
            for reason, count in by_reason.items():
                most[reason] = max(most.get(reason, 0), count)
        reasons = sorted((Loss(reason, count) for reason, count in most.items()), key=lambda entry: -entry.count)
        largest = max(sum(by_reason.values()) for by_reason in by_name.values())
        features.append(LostFeature(feature, tuple(by_name), largest, trials, tuple(reasons)))
    return tuple(sorted(features, key=lambda entry: -entry.count))


def _spanned(parts: Sequence[str], texts: Sequence[str]) -> str:
    """Return the parts of a text with the smallest and the largest of its numbers in every gap."""
    gaps = zip(*(_NUMBER.findall(text) for text in texts), strict=True)
    spans = []
    for numbers in gaps:
        low, high = min(numbers, key=float), max(numbers, key=float)
        spans.append(low if float(low) == float(high) else f"{low} to {high}")
    return "".join(text + span for text, span in zip(parts, [*spans, ""], strict=True))
