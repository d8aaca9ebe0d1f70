"""Compare a statement with the accuracy that the maker of the sensor states.

Signal chain: published figures of the sensor, size of a measurement, distance of the view -> standard deviation by the
maker -> measurements whose standard uncertainty is far below it, and why that can be.

A maker's figure holds for its whole volume, for every unit, warm-up and years of use. A statement holds for one view,
and contains what it lists. A statement far below the maker's figure is therefore possible, but it relies on the
influences that it leaves out being small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from characterisation.tasks.task_file import Measurement
from characterisation.words.numbers import listed, two_digits
from mitsim.sensor.sensor import Sensor

#: share of the maker's figure below which a statement says why
SHARE = 0.1


def maker_sigma(sensor: Sensor, measurement: Measurement, distance_mm: float) -> float | None:
    """Return the standard deviation [mm] of a measurement by the maker's figures; None if they say nothing of it.

    An error of lengths is relative to the nominal value; it says nothing of zones and angles. One figure of accuracy
    holds for every measurement in mm. The smaller of two applies.
    """
    if measurement.unit != "mm":
        return None
    sigmas = list[float]()
    if sensor.published_accuracy is not None:
        sigmas.append(sensor.published_accuracy.sigma_mm)
    if sensor.published_lengths is not None and measurement.nominal > 0:
        sigmas.append(sensor.published_lengths.one_sigma(distance_mm) * measurement.nominal)
    finite = [sigma for sigma in sigmas if math.isfinite(sigma)]
    return min(finite) if finite else None


def below_the_maker(rows: Sequence[tuple[str, float | None, float | None]], left_out: str, sensor: str) -> list[str]:
    """Return a sentence on measurements whose uncertainty is below a tenth of the maker's figure; none without any.

    ``rows``: name, standard uncertainty [mm] and figure of the maker [mm] of each measurement. ``left_out``: the
    influences that the statement does not contain, in words. ``sensor``: name of the sensor.
    """
    below = [(name, u, sigma) for name, u, sigma in rows if u is not None and sigma is not None and u < SHARE * sigma]
    if not below:
        return []
    entries = [f"{name} ({two_digits(u)} of {two_digits(sigma)} mm)" for name, u, sigma in below]
    verb = "is" if len(entries) == 1 else "are"
    return [
        f"{listed(entries)} {verb} stated below a tenth of the accuracy that the maker of {sensor} publishes. That "
        "figure holds for every place in the volume, every unit and day; this statement holds for one view, and leaves "
        f"out {left_out}. Compare it with captures of your unit before you rely on it"
    ]
