"""Measure the noise of grey levels in a code's own images, for imagers that are not described.

Signal chain: images of fringes [DN] -> least squares for one offset A, and B cos phi and B sin phi of each period ->
residuals in an orthonormal basis, each with the variance of the noise -> less their part that depends on the phases ->
robust variance of pixels of equal level A -> variance as a function of the level.

P images of n periods leave P - 1 - 2 n independent residuals for each pixel. Four steps of one period leave one
residual, and three steps none.

A projector's gamma and a camera's response also leave residuals. Unlike noise, these are a function of the phase times
the modulation. A Fourier series in the phases, common to all pixels, is therefore subtracted first. What it does not
describe counts as noise.

The result is the variance at the mean level of a pixel, as in :func:`mitsim.decoding.grey_levels.grey_level_variance`.
Shot noise varies between the images of a fringe, and its mean is that at the level A.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from characterisation.features.robust_fit import ROUNDED_MEDIAN_TO_STD
from characterisation.files.arrays import Floats
from mitsim.decoding.grey_levels import MeasuredNoise
from mitsim.decoding.structured_light.phase_shift import fit_phases
from mitsim.sensor.image_role import Axis, Role

#: approximate number of pixels that are used, in rows and columns at equal steps. From n squared residuals the standard
#: deviation follows to 0.82 / sqrt(n): to 1.5 % for one residual a pixel and 16 levels, to less for more residuals. A
#: harmonic has thousands of pixels for each of its coefficients
_SAMPLED_PIXELS = 50_000

#: least number of pixels for a result; chosen
_MINIMUM_PIXELS = 2000

#: least number of pixels of one level; chosen
_PIXELS_PER_LEVEL = 500

#: highest harmonic of a fringe that is subtracted
_HARMONICS = 8

#: least modulation of the pixels that are used [1/255 of full scale]
_MINIMUM_MODULATION = 8.0

#: share of the squares, the smallest ones, whose mean is used; chosen. A median would depend on single grey levels
#: where the noise is below one
_KEPT_SHARE = 0.9

#: mean of this share of the squares of a normal distribution of variance 1
_KEPT_VARIANCE = 0.6230


def measured_noise(
    stacks: Sequence[NDArray[np.generic]], image_roles: Sequence[Role], full_scale: float
) -> MeasuredNoise | None:
    """Return the noise of the cameras that took the images of one code; None if the fringes leave too few residuals.

    ``stacks`` are the (P, H, W) images [DN] of each camera, in the roles ``image_roles``; ``full_scale`` is the value
    of a saturated pixel [DN].
    """
    with threadpool_limits(1, user_api="blas"):  # threads wait longer for one another than these products take
        residuals = [
            _residuals(stack, image_roles, full_scale, axis) for stack in stacks for axis in ("columns", "rows")
        ]
    levels = np.concatenate([residual[0] for residual in residuals])
    squares = np.concatenate([residual[1] for residual in residuals])
    if len(levels) < _MINIMUM_PIXELS:
        return None
    order = np.argsort(levels)
    groups = np.array_split(order, min(16, len(levels) // _PIXELS_PER_LEVEL))
    median_levels = np.array([np.median(levels[group]) for group in groups])
    variances = np.array([max(_variance(squares[group]), 1 / 12) for group in groups])
    increasing = np.append(True, np.diff(median_levels) > 0)
    return MeasuredNoise(median_levels[increasing], variances[increasing])


def _residuals(
    stack: NDArray[np.generic], image_roles: Sequence[Role], full_scale: float, axis: Axis
) -> tuple[Floats, Floats]:
    """Return levels [DN] and squared residuals [DN^2], (n,) each, of the fringes along an axis; n may be 0."""
    empty = np.empty(0), np.empty(0)
    indices = [
        (role.index, position)
        for position, role in enumerate(image_roles)
        if role.kind == "phase" and role.axis == axis
    ]
    periods = sorted({index for index, _ in indices})
    groups = [[position for index, position in indices if index == period] for period in periods]
    shifts = [np.array([image_roles[position].shift for position in group]) for group in groups]
    if sum(map(len, groups)) <= 1 + 2 * len(groups):
        return empty
    step = max(1, int(np.sqrt(stack[0].size / _SAMPLED_PIXELS)))
    images = stack[:, step // 2 :: step, step // 2 :: step][np.concatenate(groups).astype(int)]
    images = images.reshape(len(images), -1)
    usable = images.max(axis=0) < full_scale
    phases = fit_phases(images[:, None], shifts)
    usable &= phases.modulation[:, 0].min(axis=0) > _MINIMUM_MODULATION * full_scale / 255
    if usable.sum() < _MINIMUM_PIXELS:
        return empty
    # orthonormal basis of everything that the model cannot describe
    design = np.zeros((len(images), 1 + 2 * len(groups)))
    design[:, 0], first = 1.0, 0
    for number, shift in enumerate(shifts):
        rows = slice(first, first + len(shift))
        design[rows, 1 + 2 * number], design[rows, 2 + 2 * number] = np.cos(shift), np.sin(shift)
        first += len(shift)
    complement = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    residuals = complement.T @ images[:, usable].astype(float)
    level = phases.offset[0, usable].astype(float)
    phase, modulation = phases.phase[:, 0, usable].astype(float), phases.modulation[:, 0, usable].astype(float)
    residuals = _without_harmonics(residuals, phase, modulation)
    return np.tile(level, len(residuals)), residuals.ravel() ** 2


def _variance(squares: Floats) -> float:
    """Return the variance of a normal distribution from squares (n,) that may include outliers."""
    return float(np.sort(squares)[: int(_KEPT_SHARE * len(squares))].mean()) / _KEPT_VARIANCE


def _without_harmonics(residuals: Floats, phase: Floats, modulation: Floats) -> Floats:
    """Return residuals (m, n) [DN] without functions of the phases (k, n) [rad] times their modulations (k, n) [DN]."""
    # the constant terms have one amplitude: shot noise changes an offset with the modulation of its own period, and a
    # difference of modulations would describe it
    common = modulation.mean(axis=0)
    order = np.arange(_HARMONICS + 1)
    terms = np.concatenate(
        [
            np.where(order[:, None] == 0, common, size) * wave(order[:, None] * angle)
            for angle, size in zip(phase, modulation, strict=True)
            for wave in (np.cos, np.sin)
        ]
    )
    terms = terms[np.abs(terms).max(axis=1) > 0]  # sin(0 phi) is 0
    used = np.ones(residuals.shape[1], bool)
    for _ in range(2):  # the second time without outliers
        used_terms = terms[:, used]
        coefficients = np.linalg.lstsq(used_terms @ used_terms.T, used_terms @ residuals[:, used].T, rcond=1e-9)[0]
        remainder = residuals - coefficients.T @ terms
        used = (
            np.abs(remainder) < 4 * ROUNDED_MEDIAN_TO_STD * np.median(np.abs(remainder), axis=1, keepdims=True) + 1
        ).all(axis=0)
        if used.sum() < _MINIMUM_PIXELS:
            break
    return np.asarray(remainder)
