"""Effects outside the performance map, as a line in the budget of measurements that are drawn from the map.

Signal chain: rendered and drawn measurements of the open parts (:mod:`tests.proofs.map_comparison`) -> errors over
the predicted standard uncertainty, less the part that the map explains -> ``beyond_map.toml`` -> one draw for each
measurement and day.

A map is made from flat coupons. It does not contain edges, curved faces, matching blocks that cover two faces, or
clusters of false points. The size of these effects differs between parts and can only be found by comparison. The sizes
used here are those of other parts and of other sensors of the same kind, with a random sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from characterisation.files.documents import Document, read_toml
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.sensor import Sensor

#: kind of a sensor that matches images
MATCHED = "matched"

#: kind of a sensor that decodes coded light
CODED = "coded"

#: kind of a sensor that measures time of flight
FLIGHT = "time_of_flight"


class Sizes(Document):
    """Sizes of effects outside the map, in predicted standard uncertainties: their quantiles at ``levels``.

    ``low`` and ``high`` are the ends of the 95 % intervals of ``size``, from a bootstrap over cases.
    """

    levels: Annotated[list[Annotated[float, Field(gt=0, lt=1)]], Field(min_length=2)]
    size: list[Annotated[float, Field(ge=0)]]
    low: list[float]
    high: list[float]

    @model_validator(mode="after")
    def _in_order(self) -> Sizes:
        if not len(self.levels) == len(self.size) == len(self.low) == len(self.high):
            raise ValueError("as many sizes and ends of intervals as levels")
        if (np.diff(self.levels) <= 0).any() or (np.diff(self.size) < 0).any():
            raise ValueError("levels and sizes in ascending order")
        return self

    def draw(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw ``count`` errors (count,) in predicted standard uncertainties, up to the size at the last level."""
        return drawn_sizes(rng, count, self.levels, self.size)


def drawn_sizes(rng: np.random.Generator, count: int, levels: Sequence[float], size: ArrayLike) -> NDArray[np.float64]:
    """Draw errors (count,) of random sign, sizes by quantiles ``size`` at ascending ``levels`` 0..1, in its unit."""
    quantiles = np.concatenate([[0.0], np.asarray(size, float)])
    magnitudes = np.interp(rng.uniform(0, 1, count), [0.0, *levels], quantiles)
    return np.asarray(magnitudes * rng.choice([-1.0, 1.0], count))


class BeyondMap(Document):
    """The data file: the ``command`` that wrote it, the ``cases`` it is based on, and sizes by kind of sensor."""

    command: str
    cases: list[str]
    matched: Sizes
    coded: Sizes
    time_of_flight: Sizes

    def of(self, sensor: Sensor) -> Sizes:
        """Return the sizes for a sensor's kind."""
        sizes: Sizes = getattr(self, kind_of(sensor))
        return sizes


def kind_of(sensor: Sensor) -> str:
    """Return whether a sensor matches images, decodes a code, or measures time of flight."""
    if isinstance(sensor.pattern, AmplitudeModulation):
        return FLIGHT
    return MATCHED if isinstance(sensor.settings, MatcherSettings) else CODED


@cache
def beyond_map() -> BeyondMap:
    """Return the sizes that come with mitsim."""
    return read_toml(str(files("mitsim.study.virtual") / "beyond_map.toml"), BeyondMap)
