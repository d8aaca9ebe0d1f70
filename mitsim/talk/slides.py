"""Hold a slide of the talk as it was made again: claims, each with the figures of the results and a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from mitsim.talk.results import Results

_Key = TypeVar("_Key")
Verdict = Literal["holds", "holds in part", "does not hold", "shown", "missing"]


@dataclass(frozen=True)
class Claim:
    """One claim of a slide, word for word, and the results that decide on it.

    ``found`` has the numbers in sentences, ``figure`` those that decide. ``why`` explains a claim that does not hold.
    ``picture`` names the picture of the slide that shows it; by default all do.
    """

    words: str
    found: str
    figure: str
    verdict: Verdict
    why: str = ""
    picture: str = ""


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


def collected(results: Results, names: Mapping[_Key, str], slide: Slide) -> dict[_Key, xr.Dataset]:
    """Return the results of pieces by the keys of ``names``; missing ones are noted in the slide."""
    datasets = {key: results.get(name) for key, name in names.items()}
    slide.missing.extend(names[key] for key, dataset in datasets.items() if dataset is None)
    return {key: dataset for key, dataset in datasets.items() if dataset is not None}


def finite(values: ArrayLike) -> NDArray[np.float64]:
    """Return the finite values (n,); NaN alone without any."""
    numbers = np.asarray(values, float)
    numbers = numbers[np.isfinite(numbers)]
    return numbers if len(numbers) else np.array([math.nan])


def mean_of(values: ArrayLike) -> float:
    """Return the mean of the finite values, NaN without any."""
    return float(finite(values).mean())


def median_of(values: ArrayLike) -> float:
    """Return the median of the finite values, NaN without any."""
    return float(np.median(finite(values)))


def largest_of(values: ArrayLike) -> float:
    """Return the largest of the finite values, NaN without any."""
    return float(finite(values).max())
