"""What a performance map does not know, as a line of the budget of measurements that are drawn from it.

Signal chain: rendered and drawn measurements of the open parts (:mod:`mitsim.validation.map_comparison`) -> sizes of
error over the predicted standard uncertainty, less what the map explains -> ``beyond_map.toml`` -> one draw for each
measurement and day.

A map is made of flat coupons. Edges, curved faces, blocks that straddle two faces and false points that cluster are not
in it. How large they are differs from part to part, and nothing but a comparison tells it; the sizes are those of other
parts before other sensors of the same kind, with a sign at random.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from characterisation.documents import Document, read_toml
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.preset import Sensor

#: kinds of sensors: matched images, codes, and times of flight
MATCHED, CODED, FLIGHT = "matched", "coded", "time_of_flight"


class Sizes(Document):
    """Sizes of what is beyond the map, in predicted standard uncertainties: their quantiles at ``levels``.

    ``low`` and ``high`` are the ends of the 95 % intervals of ``size``, by a bootstrap over cases.
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
        """Draw so many errors (count,) in predicted standard uncertainties; beyond the last level there are none."""
        return drawn_sizes(rng, count, self.levels, self.size)


def drawn_sizes(rng: np.random.Generator, count: int, levels: Sequence[float], size: ArrayLike) -> NDArray[np.float64]:
    """Draw so many errors (count,) of either sign whose sizes have the quantiles ``size`` at ``levels``."""
    quantiles = np.concatenate([[0.0], np.asarray(size, float)])
    found = np.interp(rng.uniform(0, 1, count), [0.0, *levels], quantiles)
    return np.asarray(found * rng.choice([-1.0, 1.0], count))


class BeyondMap(Document):
    """The data file: the ``command`` that made it, the ``cases`` it was read off, and sizes by kind of sensor."""

    command: str
    cases: list[str]
    matched: Sizes
    coded: Sizes
    time_of_flight: Sizes

    def of(self, sensor: Sensor) -> Sizes:
        """Those of a sensor's kind."""
        found: Sizes = getattr(self, kind_of(sensor))
        return found


def kind_of(sensor: Sensor) -> str:
    """Whether a sensor matches images, reads a code, or times light."""
    if isinstance(sensor.pattern, AmplitudeModulation):
        return FLIGHT
    return MATCHED if isinstance(sensor.settings, MatcherSettings) else CODED


@cache
def beyond_map() -> BeyondMap:
    """Sizes that come with mitsim."""
    return read_toml(str(files("mitsim.virtual") / "beyond_map.toml"), BeyondMap)
