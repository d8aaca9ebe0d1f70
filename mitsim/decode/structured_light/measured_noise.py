"""Noise of grey levels, measured in a code's own images where nobody describes the imager.

Signal chain: images of fringes [DN] -> least squares for one offset A, and B cos phi, B sin phi of each period -> what
remains of them, as numbers of the noise's own variance -> less what follows from the phases -> robust variance of
pixels of one level A -> variance as a function of the level.

Of P images of n periods, P - 1 - 2 n independent numbers a pixel remain: four steps of one period leave one, three
none.
What a projector's gamma, or a camera's response, leaves is a function of the phase, times the modulation; noise is not.
So a Fourier series in the phases, one for all pixels, is taken off first. What it does not follow counts as noise.

The variance is that of the mean level of a pixel, as in
:func:`mitsim.decode.grey_levels.grey_level_variance`: shot noise differs from image to image
of a fringe, and its mean is that of the level A.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.structured_light.phase_shift import fit_phases
from mitsim.sensor.image_role import Axis, Role

Floats = NDArray[np.float64]

#: pixels that are looked at, about
_PIXELS = 200_000

#: pixels without which nothing is told, and pixels of one level at least
_LEAST, _AT_A_LEVEL = 2000, 500

#: harmonics of a fringe that a response may leave
_HARMONICS = 8

#: from the median absolute deviation of a normal distribution to its standard deviation
_NORMAL = 1.4826

#: modulation [1/255 of full scale] of the pixels that are looked at, at least
_MODULATION = 8.0

#: share of the smallest squares whose mean is taken, and that of a normal distribution of variance 1. A median would be
#: told by single grey levels where noise is under one
_INNER, _INNER_VARIANCE = 0.9, 0.6230


def measured_noise(
    stacks: Sequence[NDArray[np.generic]], every: Sequence[Role], full_scale: float
) -> MeasuredNoise | None:
    """Measure the noise of cameras that took the images of one code; None where their fringes do not tell it.

    ``stacks`` (P, H, W) [DN] of each camera; ``every`` role of the P images; ``full_scale`` [DN].
    """
    told = [_residuals(stack, every, full_scale, axis) for stack in stacks for axis in ("columns", "rows")]
    levels = np.concatenate([each[0] for each in told])
    squares = np.concatenate([each[1] for each in told])
    if len(levels) < _LEAST:
        return None
    order = np.argsort(levels)
    groups = np.array_split(order, min(16, len(levels) // _AT_A_LEVEL))
    middle = np.array([np.median(levels[group]) for group in groups])
    found = np.array([max(_variance(squares[group]), 1 / 12) for group in groups])
    keep = np.append(True, np.diff(middle) > 0)
    return MeasuredNoise(middle[keep], found[keep])


def _residuals(
    stack: NDArray[np.generic], every: Sequence[Role], full_scale: float, axis: Axis
) -> tuple[Floats, Floats]:
    """Levels [DN] and squared residuals [DN^2] (n,) of the fringes along an axis; none where none remain."""
    nothing = np.empty(0), np.empty(0)
    own = [(role.index, place) for place, role in enumerate(every) if role.kind == "phase" and role.axis == axis]
    periods = sorted({index for index, _ in own})
    groups = [[place for index, place in own if index == period] for period in periods]
    shifts = [np.array([every[place].shift for place in group]) for group in groups]
    if sum(map(len, groups)) <= 1 + 2 * len(groups):
        return nothing
    step = max(1, int(np.sqrt(stack[0].size / _PIXELS)))
    images = stack[np.concatenate(groups).astype(int)][:, step // 2 :: step, step // 2 :: step]
    images = images.reshape(len(images), -1)
    lit = images.max(axis=0) < full_scale
    phases = fit_phases(images[:, None], shifts)
    lit &= phases.modulation[:, 0].min(axis=0) > _MODULATION * full_scale / 255
    if lit.sum() < _LEAST:
        return nothing
    # an orthonormal basis of all that the model cannot say
    design = np.zeros((len(images), 1 + 2 * len(groups)))
    design[:, 0], first = 1.0, 0
    for number, each in enumerate(shifts):
        rows = slice(first, first + len(each))
        design[rows, 1 + 2 * number], design[rows, 2 + 2 * number] = np.cos(each), np.sin(each)
        first += len(each)
    rest = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    left = rest.T @ images[:, lit].astype(float)
    level = phases.offset[0, lit].astype(float)
    phase, modulation = phases.phase[:, 0, lit].astype(float), phases.modulation[:, 0, lit].astype(float)
    left = _without_harmonics(left, phase, modulation)
    return np.tile(level, len(left)), left.ravel() ** 2


def _variance(squares: Floats) -> float:
    """Variance of a normal distribution, of whose squares a few may be others'."""
    return float(np.sort(squares)[: int(_INNER * len(squares))].mean()) / _INNER_VARIANCE


def _without_harmonics(left: Floats, phase: Floats, modulation: Floats) -> Floats:
    """Residuals (m, n) [DN] less their part that is a function of the phases (k, n) [rad], times the modulation."""
    order = np.arange(_HARMONICS + 1)
    terms = np.concatenate(
        [
            size * wave(order[:, None] * angle)
            for angle, size in zip(phase, modulation, strict=True)
            for wave in (np.cos, np.sin)
        ]
    )
    terms = terms[np.abs(terms).max(axis=1) > 0]  # sin(0 phi) is none
    used = np.ones(left.shape[1], bool)
    for _ in range(2):  # the second time without what lies far off
        own = terms[:, used]
        found = np.linalg.lstsq(own @ own.T, own @ left[:, used].T, rcond=1e-9)[0]
        off = left - found.T @ terms
        used = (np.abs(off) < 4 * _NORMAL * np.median(np.abs(off), axis=1, keepdims=True) + 1).all(axis=0)
        if used.sum() < _LEAST:
            break
    return np.asarray(off)
