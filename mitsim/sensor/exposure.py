"""Compute exposures by the rule of a sensor: fixed, of a matt white plate or automatic, and brackets.

Signal chain: electrons per second in every pixel -> exposure [s], or several of them.

A rule that depends on the image, as :func:`automatic` does, makes a sensor's results depend on the whole scene. A map
measured with it predicts nothing for another scene. The rule is included because devices use it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.imager import Imager, electrons_per_radiance
from mitsim.sensor.projector import Projector
from mitsim.sensor.sensor_file import AutomaticExposure, Bracket, FixedExposure, MattWhiteExposure


@dataclass(frozen=True)
class PlannedExposure:
    """Exposure of a capture in place of the sensor's own rule.

    ``exposures_s`` [s]: several are merged into one image. ``power``: share of the projector's full power [1].
    """

    exposures_s: tuple[float, ...]
    power: float = 1.0

    @property
    def seconds(self) -> float:
        """Return the total exposure of each image of the pattern [s]."""
        return float(sum(self.exposures_s))


@dataclass(frozen=True)
class ExposurePolicy:
    """Exposure rule of a sensor."""

    rule: str  # in words
    base_s: float | None  # the exposure; None if it follows the scene by ``control``, or is unknown
    control: AutomaticExposure | None
    bracket: Bracket | None  # the exposures around it
    limits_s: tuple[float, float]  # the limits of the device

    def exposures(self, brightest: NDArray[np.floating] | None, full_well: float) -> tuple[float, ...]:
        """Return the exposures of one capture [s], shortest first.

        ``brightest``: electrons per second of the brightest image of all cameras; only automatic control needs it.
        """
        base = self.base_s
        if base is None:
            assert self.control is not None and brightest is not None
            control = self.control
            base = automatic(brightest, full_well, control.level, control.percentile, self.limits_s)
        if self.bracket is None:
            return (base,)
        return bracket(base, self.bracket.count, self.bracket.factor, self.limits_s)


def exposure_policy(
    path: Path,
    rule: MattWhiteExposure | FixedExposure | AutomaticExposure | None,
    projector: Projector,
    imager: Imager,
    wavelength_nm: float,
) -> ExposurePolicy:
    """Return the exposure policy of a sensor file.

    ``path``, ``rule``: the file, and its ``[exposure]``; None if it has none. ``projector``, ``imager``,
    ``wavelength_nm``: of the sensor, for a rule that refers to a matt white plate; NaN if unknown. Raises InputError if
    a rule that refers to a plate asks for an exposure beyond its limits. A stated exposure counts as it is: a recording
    may have another device's.
    """
    if rule is None:
        return ExposurePolicy("unknown", None, None, None, (math.nan, math.nan))
    shortest, longest = rule.limits_s
    if shortest > longest:
        raise InputError(path, "exposure.limits_s", f"[{shortest:g}, {longest:g}]", "shortest before longest")
    several = "" if rule.bracket is None else f"; {rule.bracket.count} exposures a factor {rule.bracket.factor:g} apart"
    if isinstance(rule, AutomaticExposure):
        words = f"automatic: {rule.percentile:g} % of the pixels under {100 * rule.level:g} % of full scale"
        return ExposurePolicy(words + several, None, rule, rule.bracket, rule.limits_s)
    if isinstance(rule, FixedExposure):
        return ExposurePolicy(
            f"fixed at {rule.exposure_s:g} s{several}", rule.exposure_s, None, rule.bracket, rule.limits_s
        )
    radiance = projector.plate_radiance(rule.reflectance, rule.distance_mm)
    wanted = rule.level * imager.full_well
    rate = float(radiance * electrons_per_radiance(imager, wavelength_nm, 1.0))  # of tiny factors it may be 0
    exposure = math.inf if rate == 0 else float(wanted / rate)
    if math.isnan(exposure):
        return ExposurePolicy("unknown", None, None, rule.bracket, rule.limits_s)
    if not shortest <= exposure <= longest:
        hint = f"the rule asks for {exposure:.3g} s: change projector.flux_w, exposure.level or exposure.distance_mm"
        raise InputError(path, "exposure.limits_s", f"[{shortest:g}, {longest:g}] s", "limits that hold", hint)
    words = (
        f"fixed at {exposure:.3g} s: matt white (reflectance {rule.reflectance:g}) at {rule.distance_mm:g} mm "
        f"shows the bright pattern at {100 * rule.level:g} % of full scale"
    )
    return ExposurePolicy(words + several, exposure, None, rule.bracket, rule.limits_s)


def automatic(
    levels: NDArray[np.floating], full_well: float, level: float, percentile: float, limits_s: tuple[float, float]
) -> float:
    """Return the exposure [s] that brings a percentile of the pixels to a level, as a device's auto-exposure does.

    - ``levels``: mean electrons per second in the pixels of the brightest image [e-/s], any shape; NaN is ignored.
    - ``full_well``, ``level``: full well [e-], and the target share of it [1].
    - ``percentile``: of the pixels, 0 to 100: at 99, 1 % of them are brighter than ``level``.
    - ``limits_s``: shortest and longest exposure of the device [s]; the result is clipped to them. A dark scene gets
      the longest.
    """
    rate = float(np.nanpercentile(levels, percentile))
    return float(np.clip(level * full_well / rate, *limits_s)) if rate > 0 else limits_s[1]


def bracket(base_s: float, count: int, factor: float, limits_s: tuple[float, float]) -> tuple[float, ...]:
    """Return exposures [s] in equal ratios around a base, shortest first.

    Exposure i of n is base factor^(i - (n-1)/2). An odd count includes the base; an even count lies half a step to
    either side. Exposures beyond the limits are clipped to them and equal exposures are merged, so fewer than
    ``count`` may be returned.

    Parameters
    ----------
    base_s
        Exposure in the middle [s].
    count, factor
        Number n of exposures, and ratio of each to the one before.
    limits_s
        Shortest and longest exposure of the device [s].

    See Also
    --------
    automatic : the base exposure
    """
    shortest, longest = limits_s
    middle = (count - 1) / 2
    # logarithms do not overflow, whatever the count and factor
    logarithms = np.log(base_s) + (np.arange(count) - middle) * np.log(factor)
    exposures = np.exp(np.clip(logarithms, np.log(shortest) - 1, np.log(longest) + 1))
    if count % 2:
        exposures[count // 2] = base_s
    return tuple(sorted({float(exposure) for exposure in np.clip(exposures, shortest, longest)}))
