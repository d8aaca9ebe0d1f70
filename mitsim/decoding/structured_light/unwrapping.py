"""Unwrap phases temporally: find the fringe of a phase from the phases of other periods at the same pixel.

Signal chain: phases phi_i of periods P_i -> beats, sums of phases with small integers c_i and the frequency sum c_i /
P_i -> path of beats from one whose period covers the projector to the shortest period -> at each step of the path, the
nearest whole number of periods -> coordinate.

From a beat a with unwrapped coordinate x_a to a finer beat b of phase psi_b [cycles], the order is
k = round(f_b x_a - psi_b). It is wrong where the noise of f_b x_a - psi_b exceeds half a cycle. Of all paths, the one
is used whose weakest step has the largest margin for noise. The same rule thus serves hierarchical sets (long periods
first) and heterodyne sets (neighbouring periods with a long beat).

Sources: Reich, Ritter and Thesing, Optical Engineering 39(1), 2000, for the heterodyne principle. Towers, Towers and
Jones, Optics Letters 28(11), 2003, for the growth of noise along the steps and the best periods.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.decoding.blocks import in_blocks

#: largest residual [cycles] that is accepted whatever the noise: half of the residual that changes the order
LARGEST_RESIDUAL = 0.25


@dataclass(frozen=True)
class Beat:
    """A sum of phases with integer ``weights`` c_i, one for each period, and its own ``period`` [px]."""

    weights: tuple[int, ...]
    period: float


@dataclass(frozen=True)
class UnwrappingPath:
    """Beats from the longest to the finest, and the gain of noise at each step between them."""

    beats: tuple[Beat, ...]  # from the longest to the finest
    #: (steps,) standard deviation of the residual f_b x_a - psi_b [cycles] per unit of sigma_I / B
    noise: tuple[float, ...]
    systematic: tuple[float, ...]  # (steps,) the same per radian of an independent error of all phases


def unwrapping_path(periods: tuple[float, ...], steps: tuple[int, ...], extent: float) -> UnwrappingPath:
    """Return the most robust path.

    ``steps`` is the number N of steps of each of the ``periods`` [px], ``extent`` that of projector pixels along the
    code. Raises InputError if no period, and no beat of two or three, is as long as the extent.
    """
    beats = _beats(periods)
    scale = np.sqrt(2.0 / np.array(steps))
    finest = next(beat for beat in beats if beat.weights == tuple(np.eye(len(periods), dtype=int)[-1]))
    # widest path: beats are sorted by period, so the best path to a beat is known before any finer beat needs it
    margin: dict[Beat, float] = {}
    predecessor: dict[Beat, Beat | None] = {}
    for beat in beats:
        if beat.period >= extent * (1 - 1e-9):
            margin[beat], predecessor[beat] = np.inf, None
        for coarse, coarse_margin in list(margin.items()):
            if coarse.period > beat.period:
                step_margin = min(coarse_margin, 0.5 / float(np.linalg.norm(_residual_gain(coarse, beat) * scale)))
                if step_margin > margin.get(beat, 0.0):
                    margin[beat], predecessor[beat] = step_margin, coarse
        if beat is finest:
            break
    if finest not in margin:
        longest = max(beat.period for beat in beats)
        raise InputError(
            "pattern",
            "periods_px",
            list(periods),
            f"a period, or a beat of periods, of {extent:g} px or more",
            f"the longest is {longest:.6g} px: add a period of {extent:g} px, or one nearer to the shortest",
        )
    chain = [finest]
    while (coarser := predecessor[chain[0]]) is not None:
        chain.insert(0, coarser)
    gains = [_residual_gain(a, b) for a, b in pairwise(chain)]
    return UnwrappingPath(
        tuple(chain),
        tuple(float(np.linalg.norm(gain * scale)) for gain in gains),
        tuple(float(np.linalg.norm(gain)) for gain in gains),
    )


def unwrap(
    phase: NDArray[np.float32],
    path: UnwrappingPath,
    extent: float,
    relative_variance: NDArray[np.float32],
    systematic_rad: float,
    k_sigma: float,
    order: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the coordinate from the phases of all periods.

    - ``phase``: (n, ...) [rad], one image for each period, any multiple of 2 pi.
    - ``path``: from :func:`unwrapping_path`.
    - ``extent``: number of projector pixels along the code.
    - ``relative_variance``: (...) sigma_I^2 / B^2 of each pixel.
    - ``systematic_rad``, ``k_sigma``: a step is accepted if its residual is at most k sigma, and at most
      :data:`LARGEST_RESIDUAL`. sigma^2 is the sum of the variances of noise and systematic error.
    - ``order``: (...) whole turns of the path's first beat, if they are known from another source, for example a Gray
      code. The beat then need not cover the projector.

    Returns ``coordinate``: (...) [projector px], with pixel centres at integers; ``inconsistent``: (...) whether the
    phases contradict each other, or the coordinate is outside the projector by more than a pixel. If the longest period
    extends at most 2 px beyond the projector, pixels within a pixel of its two ends are inconsistent too.
    """
    flat = phase.reshape(len(phase), -1)
    variance = relative_variance.reshape(-1)
    coordinate = np.empty(flat.shape[1])
    inconsistent = np.empty(flat.shape[1], bool)
    first = path.beats[0]
    # a period longer than the projector has a margin for noise on both sides of it
    guard = np.float32(max(0.0, 1 - extent / first.period) / 2)

    def unwrap_blocks(blocks: list[slice]) -> None:
        for block in blocks:
            cycles = beat_cycles(flat[:, block], first)
            if order is None:
                cycles -= cycles > 1 - guard
                turns = np.zeros_like(cycles)
            else:
                turns = order.reshape(-1)[block]
            rejected = np.zeros(cycles.shape, bool)
            for coarse, beat, noise, systematic in zip(
                path.beats, path.beats[1:], path.noise, path.systematic, strict=False
            ):
                ratio = np.float32(coarse.period / beat.period)
                expected = (turns + cycles) * ratio
                cycles = beat_cycles(flat[:, block], beat)
                expected -= cycles
                turns = np.rint(expected)
                expected -= turns
                expected *= expected
                limit = variance[block] * np.float32((k_sigma * noise) ** 2)
                limit += np.float32((k_sigma * systematic * systematic_rad) ** 2)
                rejected |= expected > np.minimum(limit, np.float32(LARGEST_RESIDUAL**2))
            position = (turns.astype(np.float64) + cycles) * path.beats[-1].period
            rejected |= (position < -1) | (position > extent + 1)
            if order is None:
                # ambiguous if the position one turn of the longest period away is on the projector too
                rejected |= (position + first.period <= extent + 1) | (position - first.period >= -1)
            coordinate[block] = position - 0.5
            inconsistent[block] = rejected

    in_blocks(unwrap_blocks, flat.shape[1])
    return coordinate.reshape(phase.shape[1:]), inconsistent.reshape(phase.shape[1:])


def _beats(periods: tuple[float, ...]) -> list[Beat]:
    """Return single phases, differences of two, and second differences of neighbours, the longest period first."""
    frequency, single = 1 / np.array(periods), np.eye(len(periods), dtype=int)
    weights = [*single]
    weights += [single[fine] - single[coarse] for coarse, fine in combinations(range(len(periods)), 2)]
    weights += [single[i] - 2 * single[i + 1] + single[i + 2] for i in range(len(periods) - 2)]
    beats = []
    for weight in weights:
        value = float(weight @ frequency)
        if abs(value) > 1e-9:
            beats.append(Beat(tuple(int(c) for c in np.sign(value) * weight), 1 / abs(value)))
    return sorted(beats, key=lambda beat: -beat.period)


def _residual_gain(coarse: Beat, fine: Beat) -> NDArray[np.float64]:
    """Return the factor (n,) from an error of each phase [rad] to the residual of a step [cycles]."""
    ratio = coarse.period / fine.period
    return np.asarray((ratio * np.array(coarse.weights) - np.array(fine.weights)) / (2 * np.pi))


def beat_cycles(phase: NDArray[np.float32], beat: Beat) -> NDArray[np.float32]:
    """Return the phase (...) of a beat, 0 to 1 cycles, from phases (n, ...) [rad]."""
    out = np.zeros(phase.shape[1:], np.float32)
    for angle, weight in zip(phase, beat.weights, strict=True):
        if weight:
            out += angle * np.float32(weight / (2 * np.pi))
    out -= np.floor(out)
    return out
