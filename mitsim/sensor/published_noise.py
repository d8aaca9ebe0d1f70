"""Published noise of a sensor: the manufacturer's figures and other people's models of their measurements."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

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
        if len(self.distance_mm) != len(self.sigma_mm):
            raise ValueError("as many sigma_mm as distance_mm")
        if any(a >= b for a, b in zip(self.distance_mm, self.distance_mm[1:], strict=False)):
            raise ValueError("distance_mm that grow")
        return self

    def at(self, distance_mm: ArrayLike) -> NDArray[np.float64]:
        """Interpolate sigma [mm] at distances [mm], linearly in the logarithms; NaN outside its distances."""
        with np.errstate(divide="ignore"):
            x, knots = np.log(np.asarray(distance_mm, float)), np.log(self.distance_mm)
        inside = (x >= knots[0] - 1e-9) & (x <= knots[-1] + 1e-9)
        return np.asarray(np.where(inside, np.exp(np.interp(x, knots, np.log(self.sigma_mm))), np.nan))
