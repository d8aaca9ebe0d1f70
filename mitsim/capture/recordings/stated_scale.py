"""Find the depth of one grey level that a file beside a depth image states, whose meaning differs between programs.

BOP states ``depth_scale`` in mm per level, RealSense in metres per level; Open3D, and ORB-SLAM as ``DepthMapFactor``,
in levels per metre. The number tells which is meant, but not surely, so that the user confirms it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_numbers import vector

#: names of the scale, in small letters and without underscores
_NAMES = re.compile(r"(?:png)?depth(?:map)?(?:scale|factor|units?)")

#: smallest number of levels per metre; chosen: smaller ones are mm per level
_LEVELS_PER_METRE = 100.0

#: largest number of metres per level; chosen: larger ones are mm per level
_METRES_PER_LEVEL = 0.005

#: most maps around a number that are searched; chosen
_DEEPEST = 8


def stated_scales(table: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, float]]:
    """Yield the names and the numbers of scales of depths in a table and in the maps in it."""
    for name, value in table.items():
        if isinstance(value, Mapping) and depth < _DEEPEST:
            yield from stated_scales(value, depth + 1)
        elif _NAMES.fullmatch(str(name).rpartition(".")[2].lower().replace("_", "")):
            number = vector(value, 1)
            if number is not None and number[0] > 0:
                yield str(name), float(number[0])


def check_scale(stated: Mapping[str, float], where: str | Path) -> None:
    """Check that scales that a file states are 1 mm for one level, which an import assumes.

    Raises InputError if one is not; the error names what it probably means.
    """
    for name, number in stated.items():
        probable = number
        if number >= _LEVELS_PER_METRE:
            probable = 1000 / number
        elif number <= _METRES_PER_LEVEL:
            probable = 1000 * number
        if abs(probable - 1) > 1e-6:  # RealSense's 0.001 comes in single precision
            hint = f"name the depth of one level in mm: --scale {probable:.6g}, by the size of the number"
            raise InputError(where, name, f"{number:g}", "1 mm for each level of a depth image, or --scale", hint)
