"""Report how a prediction simplifies the direction of machining marks, the lay.

Signal chain: scattering of a face, and its process -> whether the marks have a direction, and whether it is known.

Marks in one direction reflect a line of light across them. Where the author of a scene gives their direction, maps and
renderings have it (:mod:`characterisation.maps.lay`). Where it is not given, both are round.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.surface.scatter import Scatter

#: the process leaves marks, their direction is not given, and prediction and virtual measurements treat the face as
#: round
LayLeftOut = Literal["round"]


def lay_left_out(finish: str, scatter: Scatter | None) -> LayLeftOut | None:
    """Return what is left out of the lay of a face with a finish such as ``aluminium/turned``; None if nothing is."""
    if scatter is None or math.isnan(scatter.alpha_u) or scatter.alpha_u != scatter.alpha_v:
        return None
    process = PROCESSES.get(finish.partition("/")[2])
    return None if process is None or process.lay_ratio == 1 else "round"


def lays_in_words(finishes: Mapping[str, tuple[str, Scatter | None]]) -> list[str]:
    """Return a sentence about the omission, of the finishes of several faces by their names; empty without one."""
    left_out = [
        f"{face} ({finish})" for face, (finish, scatter) in finishes.items() if lay_left_out(finish, scatter) == "round"
    ]
    if not left_out:
        return []
    return [
        f"{', '.join(left_out)}: no direction of the marks is given, so prediction and virtual measurements leave out "
        'the line of light that marks reflect; lay = "u" or "v" in the scene renders it'
    ]
