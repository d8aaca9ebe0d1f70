"""Advise on a folder with more or fewer images than its pattern.

First the file names are checked: a missing number, or files named differently from the rest. Then common changes of the
pattern are tried; those that give the number of images are suggested.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from characterisation.files.errors import InputError
from mitsim.sensor.light_code import LightCode, roles

#: numbers of fringe steps tried
_STEPS = range(3, 17)

#: largest number of suggested changes
_LISTED = 3


def advice(found: list[Path], camera: str, code: LightCode, size: tuple[int, int], count: int) -> str:
    """Return advice on a number of images that does not fit the code.

    Parameters
    ----------
    found
        Images of the camera.
    camera
        Name of the camera.
    code
        Code that the sensor file states.
    size
        (width, height) of the projector [px].
    count
        Number of images that the code needs, with the ambient image.
    """
    more = count - len(roles(code, *size))
    reason = _missing_number(found) or _strangers(found, camera, count)
    if reason:
        return reason
    changes = [words for words, table in _changes(code) if _count(code, table, size) == len(found) - more]
    changes = [f"{each} in [pattern]" for each in changes[:_LISTED]]
    if not more and len(found) == count + 1:
        changes.append("ambient_image = true, if the last image was taken without the projector")
    if changes:
        return f"the pattern has {len(found)} images with {'; or '.join(changes)}. Otherwise {_else(camera)}"
    return f"{_else(camera)}, or correct [pattern]"


def _else(camera: str) -> str:
    return f"name the files in [images] of the sensor file, or by --images {camera}='PATTERN'"


def _missing_number(found: list[Path]) -> str:
    """Return which number is missing, if the names differ by one number only."""
    matches = [re.search(r"(\d+)(?=\D*$)", path.name) for path in found]
    numbers = sorted(int(match.group(1)) for match in matches if match)
    if len(numbers) < 2 or len(numbers) != len(found) or len(set(numbers)) < len(numbers):
        return ""
    gaps = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
    return f"number {', '.join(map(str, gaps[:5]))} is missing" if gaps else ""


def _strangers(found: list[Path], camera: str, count: int) -> str:
    """Return advice on files named differently from a group of exactly ``count``."""
    shapes = Counter(re.sub(r"\d+", "*", path.name) for path in found)
    if len(shapes) < 2 or len(found) <= count:
        return ""
    for shape, number in shapes.items():
        if number == count and "*" in shape:
            others = [path.name for path in found if re.sub(r"\d+", "*", path.name) != shape]
            return (
                f"{', '.join(others[:4])} differs in name from the {count} images needed: write "
                f"{camera} = {shape!r} in [images] of the sensor file, or --images {camera}={shape!r}"
            )
    return ""


def _count(code: LightCode, table: dict[str, Any], size: tuple[int, int]) -> int:
    try:
        return len(roles(type(code).model_validate(table), *size))
    except (ValidationError, InputError):
        return -1


def _changes(code: LightCode) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield changed tables of a code with their descriptions, the most likely first."""
    whole = code.model_dump(mode="json")
    groups = whole.get("images")
    if groups is None:
        yield from _changed_keys(whole)
        return
    gray = [number for number, group in enumerate(groups) if group["show"] == "gray"]
    fringes = [number for number, group in enumerate(groups) if group["show"] == "fringes"]

    def changed(numbers: list[int], **keys: Any) -> dict[str, Any]:
        table = deepcopy(whole)
        for number in numbers:
            table["images"][number] |= keys
        return table

    for inverse in ("each", "none"):
        yield f'inverse = "{inverse}"', changed(gray, inverse=inverse)
    for number in gray if len(gray) > 1 else []:
        table = deepcopy(whole)
        axis = table["images"].pop(number)["axis"]
        yield f"no gray of the {axis}", table
    axes = {groups[number]["axis"] for number in gray}
    if len(axes) == 1:
        (axis,) = axes
        other = "rows" if axis == "columns" else "columns"
        more = groups[gray[0]] | {"axis": other, "bits": None, "stripe_px": None}
        yield f"gray of the {other} added", whole | {"images": [*groups, more]}
    for plain in ("white", "black"):
        if plain not in [group["show"] for group in groups]:
            yield f'{{ show = "{plain}" }} added', whole | {"images": [*groups, {"show": plain}]}
    shown = [group["show"] for group in groups]
    if "white" not in shown and "black" not in shown:
        yield "white and black added", whole | {"images": [*groups, {"show": "white"}, {"show": "black"}]}
    if "white" in shown and "black" in shown:
        yield "no white and black", whole | {"images": [g for g in groups if g["show"] not in ("white", "black")]}
    for bits in range(1, 16):
        yield f"bits = {bits}", changed(gray, bits=bits, stripe_px=None)
    for steps in _STEPS:
        yield f"steps = {steps}", changed(fringes, steps=steps, shifts_deg=None)


def _changed_keys(whole: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield changed tables of a code that is not a list of images."""
    for key in ("inverse", "white_black", "complementary"):
        if key in whole:
            yield f"{key} = {str(not whole[key]).lower()}", whole | {key: not whole[key]}
    if {"inverse", "white_black"} <= set(whole):
        both = {key: not whole[key] for key in ("inverse", "white_black")}
        yield " and ".join(f"{key} = {str(value).lower()}" for key, value in both.items()), whole | both
    if "bits" in whole:
        for bits in range(1, 16):
            yield f"bits = {bits}", whole | {"bits": bits}
    if "steps" in whole:
        for steps in _STEPS:
            yield f"steps = {steps}", whole | {"steps": steps}
