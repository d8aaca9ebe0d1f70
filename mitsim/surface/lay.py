"""Say what a prediction leaves out of the direction of machining marks, the lay.

Signal chain: scattering of a face, and its process -> whether the marks have a direction, and whether it is known.

Marks in one direction reflect a line of light across them. A performance map has no axis for this direction: it answers
with the mean over directions. Where the author of a scene gives none, renderings are round, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from mitsim.surface.processes import PROCESSES
from mitsim.surface.scatter import Scatter

#: ``averaged``: the prediction has the mean over directions, virtual measurements the marks themselves. ``round``: the
#: process leaves marks, their direction is not given, and both treat the face as round
LayLeftOut = Literal["averaged", "round"]


def lay_left_out(finish: str, scatter: Scatter | None) -> LayLeftOut | None:
    """Return what is left out of the lay of a face with a finish such as ``aluminium/turned``; None if nothing is."""
    if scatter is None or math.isnan(scatter.alpha_u):
        return None
    if scatter.alpha_u != scatter.alpha_v:
        return "averaged"
    process = PROCESSES.get(finish.partition("/")[2])
    return None if process is None or process.lay_ratio == 1 else "round"


def lays_in_words(finishes: Mapping[str, tuple[str, Scatter | None]]) -> list[str]:
    """Return a sentence for each kind of omission, of the finishes of several faces by their names."""
    left_out: dict[LayLeftOut, list[str]] = {"averaged": [], "round": []}
    for face, (finish, scatter) in finishes.items():
        if one := lay_left_out(finish, scatter):
            left_out[one].append(f"{face} ({finish})")
    told = []
    if left_out["averaged"]:
        told.append(
            f"{', '.join(left_out['averaged'])}: the marks have a direction, over which the prediction averages; "
            "virtual measurements render it"
        )
    if left_out["round"]:
        told.append(
            f"{', '.join(left_out['round'])}: no direction of the marks is given, so prediction and virtual "
            'measurements leave out the line of light that marks reflect; lay = "u" or "v" in the scene renders it'
        )
    return told
