"""Published accuracy of a sensor, by its manufacturer: error of lengths over distance, or one figure."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy.special import ndtri

from characterisation.files.documents import Document

Positive = Annotated[float, Field(gt=0)]


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
        if len(self.distance_mm) != len(self.error):
            raise ValueError("as many values of error as of distance_mm")
        if any(a >= b for a, b in zip(self.distance_mm, self.distance_mm[1:], strict=False)):
            raise ValueError("distance_mm that grow")
        return self

    def one_sigma(self, distance_mm: float) -> float:
        """Return the standard deviation of a normal error with this share, at a distance; NaN outside its distances.

        Between distances it is linear.
        """
        inside = self.distance_mm[0] <= distance_mm <= self.distance_mm[-1]
        error = float(np.interp(distance_mm, self.distance_mm, self.error)) if inside else float("nan")
        return error / float(ndtri((1 + self.share) / 2))
