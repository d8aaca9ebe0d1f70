"""Report how maps and virtual measurements treat the direction of machining marks, the lay.

Signal chain: scattering of a face, and its process -> whether the marks have a direction, and whether it is known.

Marks in one direction reflect a line of light across them. Where the author of a scene gives their direction, maps and
renderings have it (:mod:`characterisation.maps.lay`). Where it is not given, maps are round, and rendered virtual
measurements draw direction and strength (:mod:`mitsim.study.virtual.drawn_finish`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from mitsim.scene.surface.scatter import Scatter

#: the process leaves marks, their direction is not given, and maps treat the face as round
LayLeftOut = Literal["round"]


def lay_left_out(scatter: Scatter | None) -> LayLeftOut | None:
    """Return the simplification of a face's lay in a map; None if there is none."""
    return "round" if scatter is not None and scatter.lay_open and scatter.turn_deg is None else None


def lays_in_words(scatters: Mapping[str, Scatter | None]) -> list[str]:
    """Return one line about lays that are not given, of several faces by their names; or no line."""
    left_out = [face for face, scatter in scatters.items() if lay_left_out(scatter) == "round"]
    if not left_out:
        return []
    faces = left_out[0] if len(left_out) == 1 else f"{left_out[0]} and {len(left_out) - 1} more"
    words = "no lay, the direction of machining marks (u, v or none): virtual measurements draw it, maps omit it"
    return [f"{faces}: {words}"]
