"""Count why measurements had no value, with reasons that differ in their numbers alone taken together.

Signal chain: one reason for each trial without a value -> the same texts with gaps for the numbers -> kinds of reasons,
most frequent first -> one text for each kind, with the smallest and the largest number in every gap.
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


def common_losses(measurements: Iterable[tuple[str, int, Iterable[Loss]]]) -> list[tuple[list[str], int, int, str]]:
    """Return names of measurements, count, number of trials and reason of each loss, in the order given.

    Measurements with a feature in common are lost together, and have one entry. ``measurements`` are names, numbers of
    trials and losses.
    """
    names: dict[tuple[int, int, str], list[str]] = {}
    for name, trials, lost in measurements:
        for loss in lost:
            names.setdefault((loss.count, trials, loss.reason), []).append(name)
    return [(some, *key) for key, some in names.items()]


def _spanned(parts: Sequence[str], texts: Sequence[str]) -> str:
    """Return the parts of a text with the smallest and the largest of its numbers in every gap."""
    gaps = zip(*(_NUMBER.findall(text) for text in texts), strict=True)
    spans = []
    for numbers in gaps:
        low, high = min(numbers, key=float), max(numbers, key=float)
        spans.append(low if float(low) == float(high) else f"{low} to {high}")
    return "".join(text + span for text, span in zip(parts, [*spans, ""], strict=True))
