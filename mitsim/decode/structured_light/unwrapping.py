"""Temporal phase unwrapping: which fringe a phase belongs to, from the phases of other periods at the same pixel.

Signal chain: phases phi_i of periods P_i -> beats, sums of phases with small whole numbers c_i, whose frequency is
sum c_i / P_i -> a path of beats, from one whose period covers the projector down to the shortest period -> along the
path, the nearest whole number of periods at each step -> coordinate.

Going from a beat a to a finer b, the order is k = round(f_b x_a - psi_b), psi in cycles; it is wrong where the noise of
f_b x_a - psi_b exceeds half a cycle. Of all paths the one is taken whose weakest step has the most room for noise, so
hierarchical sets (long periods first) and heterodyne sets (neighbouring periods, whose beat is long) need no different
treatment. The heterodyne principle is Reich, Ritter and Thesing, Optical Engineering 39(1), 2000; how noise grows
along the steps, and which periods are best, Towers, Towers and Jones, Optics Letters 28(11), 2003.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from characterisation.errors import InputError
from mitsim.decode.blocks import in_blocks

#: a residual beyond this many cycles is refused whatever the noise: half of what flips the order
LARGEST_RESIDUAL = 0.25


@dataclass(frozen=True)
class Beat:
    """A sum of phases: ``weights`` c_i, one per period; ``period`` [px] that it has itself."""

    weights: tuple[int, ...]
    period: float


@dataclass(frozen=True)
class UnwrappingPath:
    """Beats from the longest to the finest, and how each step between them spreads noise.

    ``noise`` (steps,): standard deviation of the residual f_b x_a - psi_b [cycles] per unit of sigma_I / B;
    ``systematic`` (steps,): the same per radian of an error that all phases have independently.
    """

    beats: tuple[Beat, ...]
    noise: tuple[float, ...]
    systematic: tuple[float, ...]


def unwrapping_path(periods: tuple[float, ...], steps: tuple[int, ...], extent: float) -> UnwrappingPath:
    """The most robust path for periods [px] with N ``steps`` each, over ``extent`` pixels of the projector.

    Raises
    ------
    InputError
        If no period, and no beat of two or three, is as long as the extent.
    """
    beats = _beats(periods)
    scale = np.sqrt(2.0 / np.array(steps))
    finest = next(beat for beat in beats if beat.weights == tuple(np.eye(len(periods), dtype=int)[-1]))
    # the widest path: beats fall in period, so each one's best way is known before any finer beat asks for it
    room: dict[Beat, float] = {}
    before: dict[Beat, Beat | None] = {}
    for beat in beats:
        if beat.period >= extent * (1 - 1e-9):
            room[beat], before[beat] = np.inf, None
        for coarse, its_room in list(room.items()):
            if coarse.period > beat.period:
                width = min(its_room, 0.5 / float(np.linalg.norm(_spread(coarse, beat) * scale)))
                if width > room.get(beat, 0.0):
                    room[beat], before[beat] = width, coarse
        if beat is finest:
            break
    if finest not in room:
        longest = max(beat.period for beat in beats)
        raise InputError(
            "pattern",
            "periods_px",
            list(periods),
            f"a period, or a beat of periods, of {extent:g} px or more",
            f"the longest here is {longest:.6g} px: add a period of {extent:g} px, or one nearer to the shortest",
        )
    chain = [finest]
    while (coarser := before[chain[0]]) is not None:
        chain.insert(0, coarser)
    spreads = [_spread(a, b) for a, b in pairwise(chain)]
    return UnwrappingPath(
        tuple(chain),
        tuple(float(np.linalg.norm(spread * scale)) for spread in spreads),
        tuple(float(np.linalg.norm(spread)) for spread in spreads),
    )


def failure_rate(path: UnwrappingPath, relative_noise: float) -> float:
    """Share of pixels that come out in a wrong fringe, for Gaussian noise sigma_I / B = ``relative_noise``.

    P = erfc(0.5 / (sqrt(2) sigma)) for each step, sigma the noise of its residual in cycles; summed over the steps,
    which is an upper bound and close to the truth while P is small. Refusals are not taken into account.
    """
    return float(min(1.0, sum(erfc(0.5 / (np.sqrt(2) * gain * relative_noise)) for gain in path.noise)))


def unwrap(
    phase: NDArray[np.float32],
    path: UnwrappingPath,
    extent: float,
    relative_variance: NDArray[np.float32],
    systematic_rad: float,
    k_sigma: float,
    order: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Coordinate from the phases of all periods.

    Parameters
    ----------
    phase
        (n, ...) [rad], one image for each period, any multiple of 2 pi.
    path
        From :func:`unwrapping_path`.
    extent
        Pixels of the projector along the code.
    relative_variance
        (...) sigma_I^2 / B^2 of each pixel.
    systematic_rad, k_sigma
        A step is believed if its residual is at most k sigma, sigma^2 the sum of noise and systematic error, and at
        most :data:`LARGEST_RESIDUAL`.
    order
        (...) whole turns of the path's first beat, where something else tells them, as a Gray code does; the beat then
        need not cover the projector.

    Returns
    -------
    coordinate
        (...) [projector px], pixel centres at integers.
    inconsistent
        (...) where the phases contradict each other, or point outside the projector by more than a pixel; and within
        a pixel of the projector's two ends, if no more than 2 px of the longest period lie beyond them.
    """
    flat = phase.reshape(len(phase), -1)
    variance = relative_variance.reshape(-1)
    coordinate = np.empty(flat.shape[1])
    inconsistent = np.empty(flat.shape[1], bool)
    first = path.beats[0]
    # a period longer than the projector has room for noise on both sides of it
    guard = np.float32(max(0.0, 1 - extent / first.period) / 2)

    def follow(blocks: list[slice]) -> None:
        for block in blocks:
            cycles = beat_cycles(flat[:, block], first)
            if order is None:
                cycles -= cycles > 1 - guard
                turns = np.zeros_like(cycles)
            else:
                turns = order.reshape(-1)[block]
            bad = np.zeros(cycles.shape, bool)
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
                bad |= expected > np.minimum(limit, np.float32(LARGEST_RESIDUAL**2))
            place = (turns.astype(np.float64) + cycles) * path.beats[-1].period
            bad |= (place < -1) | (place > extent + 1)
            if order is None:
                # one turn of the longest period away and on the projector as well: either could be meant
                bad |= (place + first.period <= extent + 1) | (place - first.period >= -1)
            coordinate[block] = place - 0.5
            inconsistent[block] = bad

    in_blocks(follow, flat.shape[1])
    return coordinate.reshape(phase.shape[1:]), inconsistent.reshape(phase.shape[1:])


def _beats(periods: tuple[float, ...]) -> list[Beat]:
    """Single phases, differences of two, and second differences of neighbours; from the longest period on."""
    frequency, single = 1 / np.array(periods), np.eye(len(periods), dtype=int)
    weights = [*single]
    weights += [single[fine] - single[coarse] for coarse, fine in combinations(range(len(periods)), 2)]
    weights += [single[i] - 2 * single[i + 1] + single[i + 2] for i in range(len(periods) - 2)]
    beats = []
    for each in weights:
        value = float(each @ frequency)
        if abs(value) > 1e-9:
            beats.append(Beat(tuple(int(c) for c in np.sign(value) * each), 1 / abs(value)))
    return sorted(beats, key=lambda beat: -beat.period)


def _spread(coarse: Beat, fine: Beat) -> NDArray[np.float64]:
    """How an error of each phase [rad] enters the residual of a step [cycles]."""
    ratio = coarse.period / fine.period
    return np.asarray((ratio * np.array(coarse.weights) - np.array(fine.weights)) / (2 * np.pi))


def beat_cycles(phase: NDArray[np.float32], beat: Beat) -> NDArray[np.float32]:
    """Phase of a beat, 0 to 1 cycles."""
    out = np.zeros(phase.shape[1:], np.float32)
    for each, weight in zip(phase, beat.weights, strict=True):
        if weight:
            out += each * np.float32(weight / (2 * np.pi))
    out -= np.floor(out)
    return out
