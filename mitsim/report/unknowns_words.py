"""Write the sizes of the unknowns of a statement as a reader's words, for the sheet and the report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

#: the end of a key of the unknowns, and its unit
_UNITS = {"mrad": "mrad", "mm": "mm", "um": "µm", "deg": "°", "kelvin": "K", "nm": "nm", "relative": "relative"}

#: what follows the number of a key without a unit, and the head of a group whose numbers are shares
_COUNTS = {"scale": "times all of these", "spread": "relative", "daylight": "of it"}
_HEADS = {"finish": "finish, shares of its range"}

#: keys of the light of a room that say nothing of a dark one
_OF_ROOM = ("room_factor", "daylight", "filter_nm")


def unknowns_in_words(unknowns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the sizes that the virtual measurements drew from: ``pose: placement 1 mm, ...; form: plane 0.02 mm``.

    One standard deviation each, or a range; a group without a size is left out.
    """
    groups = {name: list(_sizes(_lit(table))) for name, table in unknowns.items() if name != "decoder"}
    if not unknowns.get("decoder", {}).get("known", True):
        groups["decoder"] = ["drawn from the ranges in statement.json"]
    return "; ".join(f"{_HEADS.get(name, name)}: {', '.join(sizes)}" for name, sizes in groups.items() if sizes)


def _lit(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a group without the properties of the light of a room that has none."""
    dark = table.get("room") in (0, "dark cell")
    return {key: value for key, value in table.items() if not (dark and key in _OF_ROOM)}


def _sizes(table: Mapping[str, Any]) -> Iterator[str]:
    for key, value in table.items():
        if key == "measured":
            yield from _measured(value)
        elif isinstance(value, Mapping):
            yield from (f"{name} {size:g} mm" for name, size in value.items() if isinstance(size, int | float) and size)
        elif isinstance(value, str) and key != "covariance":
            yield f"{key} {value}"
        elif key == "scale":
            yield from [] if value == 1 else [_size(key, f"{value:g}")]
        elif isinstance(value, int | float) and not isinstance(value, bool) and value:
            yield _size(key, f"{value:g}")
        elif isinstance(value, list | tuple) and len(value) == 2 and value[1]:
            yield _size(key, f"{value[0]:g} to {value[1]:g}")


def _measured(finishes: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the measured properties of finishes: ``alpha of plate 1.4 ± 0.2``."""
    for finish, properties in finishes.items():
        for key, pair in properties.items():
            if pair is not None:
                yield f"{key.replace('_', ' ')} of {finish} {pair[0]:g} ± {pair[1]:g}"


def _size(key: str, number: str) -> str:
    """Return a key of the unknowns as its name, number and unit."""
    name, _, end = key.rpartition("_")
    unit = _UNITS.get(end, "")
    if name.endswith("_per"):
        name, unit = name.removesuffix("_per"), f"per {unit}"
    label = (name if unit else key).replace("_", " ").replace("told", "assumed pose")
    unit = unit or _COUNTS.get(key, "")
    return f"{label} {number}" + ("°" if unit == "°" else f" {unit}" if unit else "")
