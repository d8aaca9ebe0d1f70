"""A slide of the talk as it was made again: its claim, its figure, the figures found, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from matplotlib.figure import Figure

Verdict = Literal["holds", "holds in part", "does not hold", "shown", "missing"]


@dataclass(frozen=True)
class Claim:
    """One claim of a slide, word for word, and what was found: the numbers, the verdict, and why where it differs."""

    words: str
    found: str
    verdict: Verdict
    why: str = ""


@dataclass(frozen=True)
class Slide:
    """A slide made again.

    ``pictures`` are figures by the stem of their files, each with its alternative text. ``missing`` names the results
    without which the slide could not be made.
    """

    title: str
    claims: list[Claim] = field(default_factory=list)
    pictures: dict[str, tuple[Figure, str]] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)


def verdict(holds: bool, in_part: bool = False) -> Verdict:
    """Return the verdict on a claim."""
    return "holds" if holds else "holds in part" if in_part else "does not hold"
