"""Write a sensor as text for the checksum of its maps, and prepare a sensor once.

The representation of a sensor leaves out values that came later, of which older maps know nothing, and numpy shortens
its numbers.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from characterisation.files.value_digest import value_digest
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import MisalignmentTable

Made = TypeVar("Made")

#: print options of numpy: its defaults with every digit of every value, whatever those of the caller are
_NUMPY_PRINTS: dict[str, Any] = {
    "precision": 17,
    "threshold": sys.maxsize,
    "linewidth": 75,
    "edgeitems": 3,
    "suppress": False,
    "sign": "-",
    "floatmode": "maxprec",
    "formatter": None,
    "nanstr": "nan",
    "infstr": "inf",
    "legacy": False,
}


def sensor_checksum(sensor: Sensor) -> str:
    """Return twelve hexadecimal digits of all values of a sensor file, which identify the sensor of a map."""
    return hashlib.sha256(written(sensor).encode()).hexdigest()[:12]


def written(sensor: Sensor) -> str:
    """Return all values of a sensor file that determine its captures and clouds, as text."""
    # values of a single unit; a file without them keeps its former checksum, which existing maps have
    additions = [sensor.room, sensor.misalignment, sensor.imager.smoothing_px]
    lens, settings = sensor.imager.corner_blur_px, sensor.settings
    # keys of a decoder that came later, which its text does not have
    later = {
        key: getattr(settings, key)
        for key, field in type(settings).model_fields.items()
        if not field.repr and getattr(settings, key) != field.default
    }
    with np.printoptions(**_NUMPY_PRINTS):
        said = repr(sensor) + (repr(additions) if additions != [None, MisalignmentTable(), 0.0] else "")
        return said + ("" if lens is None else f"corner_blur_px={lens!r}") + (repr(later) if later else "")


def once_for_sensor(make: Callable[[Sensor], Made]) -> Callable[[Sensor], Made]:
    """Return a function that keeps what ``make`` made of the last sensor, while the sensors that follow are equal."""
    kept: dict[str, Made] = {}

    @wraps(make, updated=())
    def once(sensor: Sensor) -> Made:
        key = value_digest(sensor)
        if key not in kept:
            kept.clear()
            kept[key] = make(sensor)
        return kept[key]

    return once
