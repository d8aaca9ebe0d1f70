"""Represent a surface that was not characterised by the optically nearest sample of a map.

Signal chain: optical properties of a surface -> place in two coordinates that decide what a sensor receives: logarithms
of the brightness at wide angles and of the width of the lobe -> nearest sample -> a map of that sample under the
surface's own name, with the expected errors of F and sigma.

This serves screening alone, where virtual measurements of the surface itself follow. The expected errors come from the
maps that come with mitsim: each of their samples, predicted by the nearest other sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.maps.light import Light, light_variables
from characterisation.maps.performance_map import PerformanceMap

#: root mean square errors of F [1] and of ln sigma [1] of the nearest sample, over the distance in the two coordinates:
#: 45 samples of the nine maps, up to 60 deg of incidence. Command: python tests/benchmarks/nearest_finish.py
F_ERROR = 0.24
SIGMA_ERROR = 0.31

#: width of the lobe that counts for a surface without one
_MATT = 1.0


@dataclass(frozen=True)
class Nearest:
    """The nearest ``sample`` of a map, by number, and its ``distance`` in the two coordinates."""

    sample: int
    distance: float

    @property
    def fraction_error(self) -> float:
        """Return the expected error of F, at most 1."""
        return min(F_ERROR * self.distance, 1.0)

    @property
    def sigma_error(self) -> float:
        """Return the expected relative error of sigma."""
        return math.expm1(SIGMA_ERROR * self.distance)


def place_of(light: Light) -> NDArray[np.float64]:
    """Return the place (2,) of a surface: logarithms of its brightness at wide angles, and of its lobe's width.

    The width counts by the lobe's share of the reflected light, so that a white paint is near to matt white. A lay
    counts with the geometric mean of its two widths.
    """
    widths = [width for width in (light.alpha_u, light.alpha_v) if not math.isnan(width)]
    width = math.exp(sum(map(math.log, widths)) / len(widths)) if widths else _MATT
    brightness = max(light.reflectance * light.wide_angle, 1e-6)
    return np.array([math.log(brightness), (1 - light.wide_angle) * math.log(width)])


def nearest_sample(performance_map: PerformanceMap, light: Light) -> Nearest | None:
    """Return the sample of a map that is optically nearest to a surface; None if no sample has optical properties."""
    place, known = place_of(light), [(number, one) for number, one in enumerate(performance_map.lights) if one]
    all_nearest = [Nearest(number, float(np.linalg.norm(place_of(one) - place))) for number, one in known]
    return min(all_nearest, key=lambda nearest: nearest.distance, default=None)


def standing_for(
    performance_map: PerformanceMap, nearest: Nearest, finish: str, roughness: float, light: Light
) -> PerformanceMap:
    """Return a map of the nearest sample alone, under the name and the optical properties of another surface.

    A surface with a lay is treated as round.

    Parameters
    ----------
    performance_map, nearest
        The map, and its nearest sample.
    finish, roughness, light
        Name, Ra [um] and optical properties of the other surface.
    """
    data = performance_map.data.isel(sample=[nearest.sample])
    data = data.drop_vars([name for name in data.variables if "lay" in data[name].dims or str(name).startswith("lay")])
    named = data.assign_coords(
        finish=("sample", np.array([finish], dtype=str)),
        roughness=("sample", np.array([roughness], float), data["roughness"].attrs),
    )
    return PerformanceMap(named.assign(light_variables([light])))
