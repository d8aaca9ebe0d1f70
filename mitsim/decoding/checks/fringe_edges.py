"""Find the edges between neighbouring Gray stripes in lines of pixels, and the phases of the fringes there.

Signal chain: lines of pixels -> number of the stripe and phases in each pixel -> edges, where neighbouring pixels lie
in neighbouring stripes -> position of each on the projector, and the phases there; steps from edge to edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.decoding.checks.code_lines import CodeLines
from mitsim.decoding.structured_light.gray_code import decode_stripes
from mitsim.decoding.structured_light.phase_shift import fit_phases
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import GrayCode

#: least number of edges; chosen
ENOUGH = 30

#: least share of the changes of a stripe's number that are by one: along a surface one bit changes at a time, and of
#: bits in another order or exchanged with complements at most two thirds of the changes are; chosen between
_BY_ONE = 0.75


@dataclass(frozen=True)
class StripeEdges:
    """Fringes at the edges of Gray stripes along one axis."""

    by_one: float  # share of the changes of the stripe's number that are by one [1]; NaN if there are few
    position: Floats  # (n,) of the edges from the projector's edge [projector px]
    cycles: Floats  # (periods, n) phase there [cycles]
    rising: float  # share of the steps of the phases that rise with the stripe's number [1]
    #: (periods,) change of the phase from edge to edge, over that of the position, and their standard errors
    #: [cycles/px]; NaN if there are few edges
    rates: tuple[Floats, Floats]

    @property
    def bits_fit(self) -> bool:
        """Return whether the Gray bits are in the right order, whatever the fringes say."""
        return self.by_one >= _BY_ONE


def stripe_edges(images: CodeLines, axis: Axis) -> StripeEdges | None:
    """Return the fringes at the edges of Gray stripes; None if the axis has no Gray bits or no fringes."""
    code, image_roles, full_scale = images.code, images.image_roles, images.full_scale
    gray = [role for role in image_roles if role.kind == "gray" and role.axis == axis]
    phases = [i for i, role in enumerate(image_roles) if role.kind == "phase" and role.axis == axis]
    if isinstance(code, GrayCode) or not gray or not phases:
        return None
    finest = max(gray, key=lambda role: role.index)
    periods = sorted({image_roles[i].index for i in phases})
    numbers = [[i for i in phases if image_roles[i].index == index] for index in periods]
    shifts = [np.array([image_roles[i].shift for i in group]) for group in numbers]
    threshold = images.settings.minimum_modulation_dn * full_scale / 255
    edges: list[tuple[Floats, Floats, Floats, Floats]] = []
    between: list[Floats] = []
    for way, part in enumerate(images.lines):
        fitted = fit_phases(np.concatenate([part[group] for group in numbers]), shifts)
        white_minus_black = fitted.modulation[-1] / np.float32(code.contrast)
        middle = fitted.offset + np.float32(0.5 - code.mean) * white_minus_black
        decoded = decode_stripes(part, image_roles, axis, images.settings.bit_share, (middle, white_minus_black))
        clear = (decoded.number == decoded.neighbour) & (fitted.modulation.min(axis=0) > threshold)
        clear &= part[phases].max(axis=0) < full_scale
        number, turns = decoded.number.astype(float), fitted.phase.astype(float) / (2 * np.pi)
        if way == 1:
            number, clear, turns = number.T, clear.T, turns.transpose(0, 2, 1)
        change = np.where(clear[:, 1:] & clear[:, :-1], np.diff(number, axis=1), 0.0)
        at_edge = np.abs(change) == 1
        step = np.diff(turns, axis=2)
        step -= np.rint(step)
        position = np.maximum(number[:, 1:], number[:, :-1]) * finest.period - finest.offset
        # the edge lies anywhere between the two pixels, in the middle on average
        middle_cycles = turns[:, :, :-1] + step / 2
        edges.append((change[change != 0], position[at_edge], middle_cycles[:, at_edge], (step * change)[:, at_edge]))
        between.append(_moves(step, clear[:, 1:] & clear[:, :-1] & (np.abs(change) <= 1), at_edge, position))
    changes, positions, cycles, rises = (np.concatenate(arrays, axis=-1) for arrays in zip(*edges, strict=True))
    enough = len(changes) >= ENOUGH
    return StripeEdges(
        float(np.mean(np.abs(changes) == 1)) if enough else float("nan"),
        positions,
        cycles,
        float(np.mean(rises > 0)) if rises.size else float("nan"),
        _rates(np.concatenate(between, axis=1)),
    )


def _moves(step: Floats, clear: NDArray[np.bool_], at_edge: NDArray[np.bool_], position: Floats) -> Floats:
    """Return the changes of the position and of each phase from one edge to the next along lines, (1 + periods, k).

    ``step`` (periods, n, m) of the phases between neighbouring pixels [cycles]; ``clear``, ``at_edge`` and ``position``
    (n, m) of the edges there. Edges with an unclear pixel or a jump between them are not compared.
    """
    followed = np.cumsum(np.where(clear, step, 0.0), axis=2) - step / 2
    gaps = np.cumsum(~clear, axis=1)
    row, _ = np.nonzero(at_edge)
    together = (np.diff(row) == 0) & (np.diff(gaps[at_edge]) == 0) & (np.diff(position[at_edge]) != 0)
    moves = np.concatenate([position[at_edge][None], followed[:, at_edge]])
    return np.asarray(np.diff(moves, axis=1)[:, together])


def _rates(moves: Floats) -> tuple[Floats, Floats]:
    """Return the rates of moves (1 + periods, k), and their standard errors, (periods,) each; NaN if there are few.

    The mean without the outer tenths, not the median: a gamma moves the phase at one edge of a fringe forth, and at the
    next back.
    """
    if moves.shape[1] < ENOUGH:
        return (np.full(len(moves) - 1, np.nan),) * 2
    inner = np.sort(moves[1:] / moves[0], axis=1)[:, moves.shape[1] // 10 : -(moves.shape[1] // 10)]
    return inner.mean(axis=1), inner.std(axis=1) / np.sqrt(inner.shape[1])
