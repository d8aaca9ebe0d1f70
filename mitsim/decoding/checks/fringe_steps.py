"""Compare the images of one period with one another: whether their steps and their exposure are those of the pattern.

Signal chain: images of one period at some pixels -> A + B cos(phi - delta) of each pixel by least squares -> the part
of the images that no A, B and phi explains -> its regression on A, B cos(phi) and B sin(phi) over the pixels.

N steps of one period have N - 3 combinations that vanish for every pixel. If a step has another shift or exposure than
the pattern says, they do not vanish, but are sums of A, B cos(phi) and B sin(phi) with the same weights at all pixels.
Noise, and the harmonics of a projector's gamma, are no such sums, if all phases are seen. Three steps have no such
combination.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.decoding.checks.code_lines import CodeLines
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import GrayCode

#: weight of the sums that is reported: 4 % of the modulation. A lamp flickers by 1 %
_CONTRADICTION = 0.04

#: least number of pixels
_ENOUGH = 200

#: divisions of the circle of phases; chosen
_PHASES = 24

#: least number of pixels in each, over the mean: harmonics are told from the model over all phases only; chosen
_LEAST_OF_PHASE = 0.25


def copies_in_words(lines: CodeLines, axis: Axis) -> str:
    """Return a warning if two images of one period of an axis are the same, or ""."""
    for numbers, _, width, stack in _periods(lines, axis):
        copies = [(i, j) for j in range(len(stack)) for i in range(j) if np.array_equal(stack[i], stack[j])]
        if copies and stack.min() != stack.max():
            first, second = (numbers[index] + 1 for index in copies[0])
            return (
                f"images {first} and {second} of the sequence, fringes of the {axis} at {width:g} px, are the same: "
                "one is a copy"
            )
    return ""


def steps_in_words(lines: CodeLines, axis: Axis) -> str:
    """Return a warning if the images of one period of an axis contradict one another, or ""."""
    threshold = 4 * lines.settings.minimum_modulation_dn * lines.full_scale / 255
    for _, shifts, width, stack in _periods(lines, axis):
        lit = (stack.max(axis=0) < lines.full_scale) & (np.ptp(stack.astype(float), axis=0) > threshold)
        share = contradiction(stack[:, lit].astype(float), shifts)
        if share > _CONTRADICTION:
            return (
                f"the {len(shifts)} fringe images of the {axis} at {width:g} px contradict one another by "
                f"{100 * share:.0f} % of their contrast: check that none is missing or repeated, that the shifts are "
                "those of [pattern], and whether the exposure was automatic"
            )
    return ""


def _periods(lines: CodeLines, axis: Axis) -> Iterator[tuple[list[int], Floats, float, NDArray[Any]]]:
    """Yield numbers of the images, shifts (N,) [rad], period [px] and levels (N, n) of each period of an axis."""
    if isinstance(lines.code, GrayCode):
        return
    fringes = [(i, role) for i, role in enumerate(lines.image_roles) if role.kind == "phase" and role.axis == axis]
    for period in sorted({role.index for _, role in fringes}):
        chosen = [(i, role) for i, role in fringes if role.index == period]
        numbers = [i for i, _ in chosen]
        stack = np.concatenate([part[numbers].reshape(len(numbers), -1) for part in lines.lines], axis=1)
        yield numbers, np.array([role.shift for _, role in chosen]), chosen[0][1].period, stack


def contradiction(images: Floats, shifts: Floats) -> float:
    """Return how far images (N, n) [DN] of a period contradict their shifts (N,) [rad], over the modulation; 0 to 1."""
    model = np.stack([np.ones(len(shifts)), np.cos(shifts), np.sin(shifts)], axis=1)
    left, singular, _ = np.linalg.svd(model)
    rank = int((singular > 1e-6 * singular[0]).sum())
    if images.shape[1] < _ENOUGH or rank < 3 or len(shifts) < 4:
        return 0.0
    unexplained = left[:, 3:].T @ images
    explained = np.linalg.lstsq(model, images, rcond=None)[0]
    modulation = np.hypot(*explained[1:])
    # harmonics are orthogonal to A, B cos(phi) and B sin(phi) only over all phases alike
    bins = np.floor(np.arctan2(explained[2], explained[1]) / (2 * np.pi) * _PHASES).astype(int) % _PHASES
    counts = np.bincount(bins, minlength=_PHASES)
    if counts.min() < _LEAST_OF_PHASE * counts.mean():
        return 0.0
    equal = 1 / np.sqrt(counts[bins])
    weights, *_ = np.linalg.lstsq((explained * equal).T, (unexplained * equal).T, rcond=None)
    # A is larger than B: its weights count as those of the modulation
    weights[0] *= np.median(explained[0]) / np.median(modulation)
    return float(np.abs(weights).max())
