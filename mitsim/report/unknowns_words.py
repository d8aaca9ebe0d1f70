"""Write the sizes of the unknowns of a statement as a reader's words, for the sheet and the report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mitsim.sensor.unknowns import ROOMS

#: words of each key by group, in their order; ``x`` is the number, ``p`` per cent, ``m`` millionths, ``low`` and
#: ``high`` a range
_WORDS = {
    "calibration": {
        "vergence_mrad": "vergence {x:g} mrad",
        "row_mrad": "row error {x:g} mrad",
        "roll_mrad": "roll {x:g} mrad",
        "focal_relative": "focal length {p:g} %",
        "path_offset_mm": "offset of the path {x:g} mm",
        "scale": "{x:g} times all of these and the errors of the calibration itself",
    },
    "finish": {
        "alpha": "width of the lobe",
        "tail": "tail of the lobe",
        "wide_angle": "light at wide angles",
        "reflectance": "reflectance",
        "lay": "lay",
    },
    "light": {
        "room_factor": "known to a factor of {x:g}",
        "daylight": "{p:g} % of it daylight",
        "filter_nm": "optical filter {x:g} nm wide",
        "power_relative": "power of the projector {p:g} %",
        "exposure_relative": "exposure within ±{p:g} %",
    },
    "temperature": {
        "part_kelvin": "part {x:g} K about 20 °C",
        "sensor_kelvin": "sensor {x:g} K about that of its calibration",
        "expansion_per_kelvin": "expansion of the part {m:.3g} × 10⁻⁶ per K",
        "body_per_kelvin": "expansion of the sensor {m:.3g} × 10⁻⁶ per K",
        "focal_per_kelvin": "expansion of its focal lengths {m:.3g} × 10⁻⁶ per K",
    },
    "pose": {
        "placement_mm": "position of the part {x:g} mm",
        "placement_deg": "orientation of the part {x:g}°",
        "told_mm": "error of the assumed position {x:g} mm",
        "told_deg": "error of the assumed orientation {x:g}°",
    },
    "coat": {"thickness_um": "mean thickness {low:g} to {high:g} µm", "spread": "{p:g} % from place to place"},
}

#: heads of the groups, in order, where they are not the name
_HEADS = {
    "drift": "drift",
    "calibration": "drift since the calibration",
    "finish": "finish, each over the known spread of such surfaces",
    "form": "form deviation",
    "light": "light",
    "temperature": "temperature",
    "pose": "pose, for each axis",
    "coat": "coat",
}

#: keys of the light of a room that say nothing of a dark one
_OF_ROOM = ("room_factor", "daylight", "filter_nm")


def unknowns_in_words(unknowns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the drawn sizes, one standard deviation or a range: ``form deviation: plane 0.02 mm; coat: ...``."""
    groups = {head: list(_sizes(name, unknowns.get(name, {}))) for name, head in _HEADS.items()}
    if not unknowns.get("decoder", {}).get("known", True):
        groups["decoder"] = ["settings within the ranges in statement.json"]
    return "; ".join(f"{head}: {', '.join(sizes)}" for head, sizes in groups.items() if sizes)


def _sizes(group: str, table: Mapping[str, Any]) -> Iterator[str]:
    if group == "form":
        yield from (f"{name} {size:g} mm" for name, size in table.get("features", {}).items() if size)
    if group == "light" and "room" in table:
        yield _room(table["room"])
    dark = group == "light" and table.get("room") in (0, "dark cell")
    for key, words in _WORDS["calibration" if group == "drift" else group].items() if group != "form" else ():
        value = table.get(key)
        if isinstance(value, list | tuple):
            if value[1]:
                yield words.format(low=value[0], high=value[1])
        elif key == "scale":
            yield from [] if value in (None, 1) else [words.format(x=value)]
        elif value and not (dark and key in _OF_ROOM):
            share = "" if group != "finish" or value == 1 else f" ({value:g} of it)"
            yield words.format(x=value, p=100 * value, m=1e6 * value) + share
    yield from _measured(table.get("measured", {}))


def _room(room: str | float) -> str:
    """Return the light of a room: ``room of 500 lx (office)``."""
    lux = ROOMS[room] if isinstance(room, str) else room
    named = f" ({room})" if isinstance(room, str) else ""
    return f"room of {lux:g} lx{named}" if lux else f"no light of the room{named}"


def _measured(finishes: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the measured properties of finishes, in one-sigma ranges: ``width of the lobe of plate 1.4 ± 0.2 σ``."""
    for finish, properties in finishes.items():
        for key, pair in properties.items():
            if pair is not None:
                yield f"{_WORDS['finish'][key]} of {finish} {pair[0]:g} ± {pair[1]:g} σ"
