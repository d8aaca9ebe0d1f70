"""Find the depth of one grey level that a file beside a depth image states, whose meaning differs between programs.

BOP states ``depth_scale`` in mm per level, RealSense in metres per level, nerfstudio as ``depth_unit_scale_factor``;
Open3D, ORB-SLAM as ``DepthMapFactor``, BundleFusion as ``depthShift`` and Replica as ``scale`` beside the focal length
in levels per metre. The number tells which is meant, but not surely, so that the user confirms it. Images of TUM's
RGB-D data have 5000 levels per metre, which their folder alone tells.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_numbers import vector

#: names of the scale, in small letters and without underscores
_NAMES = re.compile(
    r"(?:png)?depth(?:map|image|png)?(?:scal(?:e|ing)(?:factor)?|factor|divis(?:or|er)|shift|units?(?:scale)?(?:factor)?)"
)

#: lists of images beside the folder of an image of TUM's RGB-D data
_OF_TUM = ("depth.txt", "rgb.txt")

#: levels per metre of these images, by the definition of the format
_LEVELS_OF_TUM = 5000.0

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
            continue
        number, own = vector(value, 1), str(name).rpartition(".")[2].lower().replace("_", "")
        if number is None or number[0] <= 0:
            continue
        of_replica = own == "scale" and "fx" in table and number[0] >= _LEVELS_PER_METRE
        if of_replica or _NAMES.fullmatch(own):
            yield str(name), float(number[0])


def scale_by_folder(image: Path) -> dict[str, float]:
    """Return the scale that the folder of a depth image tells by its layout, under the name of a file; else nothing."""
    folder = image.resolve().parent.parent
    return {_OF_TUM[0]: _LEVELS_OF_TUM} if all((folder / name).is_file() for name in _OF_TUM) else {}


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
