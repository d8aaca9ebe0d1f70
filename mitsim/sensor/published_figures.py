"""Published figures of a sensor: by its manufacturer, and of noise also other people's models of their measurements."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator
from scipy.special import ndtri

from characterisation.files.documents import Document

Positive = Annotated[float, Field(gt=0)]


class PublishedNoise(Document):
    """Standard deviation of a point on a diffuse surface at normal incidence.

    ``source`` and what exactly it states; ``distance_mm`` and ``sigma_mm``: its figures, or its model evaluated at
    these distances. One pair for a single figure.
    """

    source: str = Field(min_length=1, max_length=200)
    distance_mm: list[Positive] = Field(min_length=1, max_length=50)
    sigma_mm: list[Positive] = Field(min_length=1, max_length=50)

    @model_validator(mode="after")
    def _paired(self) -> PublishedNoise:
        _check_paired(self.distance_mm, self.sigma_mm, "as many sigma_mm as distance_mm")
        return self

    def at(self, distance_mm: ArrayLike) -> NDArray[np.float64]:
        """Interpolate sigma [mm] at distances [mm], linearly in the logarithms; NaN outside its distances."""
        with np.errstate(divide="ignore"):
            x, knots = np.log(np.asarray(distance_mm, float)), np.log(self.distance_mm)
        inside = (x >= knots[0] - 1e-9) & (x <= knots[-1] + 1e-9)
        return np.asarray(np.where(inside, np.exp(np.interp(x, knots, np.log(self.sigma_mm))), np.nan))


class PublishedAccuracy(Document):
    """Accuracy of points or lengths that the maker states as one figure.

    ``source`` and what exactly it states; ``sigma_mm``: one standard deviation.
    """

    source: str = Field(min_length=1, max_length=200)
    sigma_mm: Positive


class PublishedLengths(Document):
    """Error of a length, relative to the length, that a share of all measurements does not exceed.

    ``source`` and what exactly it states; ``share`` of measurements; ``distance_mm`` and ``error``, a number such as
    0.002: its figures, or its model evaluated at these distances.
    """

    source: str = Field(min_length=1, max_length=200)
    share: Annotated[float, Field(gt=0, lt=1)]
    distance_mm: list[Positive] = Field(min_length=1, max_length=50)
    error: list[Positive] = Field(min_length=1, max_length=50)

    @model_validator(mode="after")
    def _paired(self) -> PublishedLengths:
        _check_paired(self.distance_mm, self.error, "as many values of error as of distance_mm")
        return self

    def one_sigma(self, distance_mm: float) -> float:
        """Return the standard deviation of a normal error with this share, at a distance; NaN outside its distances.

        Between distances it is linear.
        """
        inside = self.distance_mm[0] <= distance_mm <= self.distance_mm[-1]
        error = float(np.interp(distance_mm, self.distance_mm, self.error)) if inside else float("nan")
        return error / float(ndtri((1 + self.share) / 2))


def _check_paired(distances: list[float], values: list[float], allowed: str) -> None:
    """Check that a table has a value for each distance, and that the distances grow."""
    if len(distances) != len(values):
        raise ValueError(allowed)
    if any(a >= b for a, b in pairwise(distances)):
        raise ValueError("distance_mm that grow")
