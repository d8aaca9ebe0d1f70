"""N-step phase shifting: images to phase, modulation and offset; phases of several periods to a projector coordinate.

Signal chain: images I_k = A + B cos(phi - delta_k) [DN] -> least squares for (A, B cos phi, B sin phi) -> phi, B -> too
bright or too faint pixels are told -> temporal unwrapping -> coordinate [projector px] and its expected noise.

    sigma_phi = sqrt(2 / N) sigma_I / B        sigma_u = P / (2 pi) sigma_phi

for N equidistant steps (Surrel, Applied Optics 36, 271, 1997). sigma_I is taken at the level A: with shot
noise, the terms that change with the phase cancel for N >= 4, and for N = 3 they cancel in the mean over all phases.
For equidistant steps the least squares are the usual arctan of two sums; other shifts are allowed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status
from mitsim.decode.blocks import BLOCK, in_blocks
from mitsim.decode.grey_levels import MeasuredNoise, check_full_scale, grey_level_variance
from mitsim.decode.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decode.structured_light.projector_gamma import (
    correct_phase,
    equidistant_order,
    estimate_gamma,
    gamma_from_white,
)
from mitsim.decode.structured_light.unwrapping import unwrap, unwrapping_path
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import PhaseShift, check_stack, roles

#: blocks are filled up to a multiple of this: what does not fill a processor's vectors is rounded in another way, and a
#: pixel's phase must not depend on where in a window it lies
_VECTOR = 64


@dataclass(frozen=True)
class Phases:
    """What the images say of each period: ``phase`` (n, H, W) [rad], 0 to 2 pi, ``modulation`` B (n, H, W) [DN];

    ``offset`` A (H, W) [DN], the mean over all periods. float32.
    """

    phase: NDArray[np.float32]
    modulation: NDArray[np.float32]
    offset: NDArray[np.float32]


def fit_phases(stack: NDArray[np.generic], shifts: Sequence[NDArray[np.floating]]) -> Phases:
    """Fit A + B cos(phi - delta) to the images of each period.

    ``stack`` (P, H, W) [DN]; ``shifts`` delta [rad], one array for each period, of as many shifts as it has images,
    in the order of the stack.
    """
    shape = stack.shape[1:]
    flat = stack.reshape(len(stack), -1)
    phase = np.empty((len(shifts), flat.shape[1]), np.float32)
    modulation = np.empty_like(phase)
    offset = np.zeros(flat.shape[1], np.float32)
    first = np.cumsum([0, *map(len, shifts)])
    solve = [_least_squares(delta) for delta in shifts]
    most = max(map(len, shifts))

    def fit(blocks: list[slice]) -> None:
        room = np.empty((most, BLOCK), np.float32)  # one for all blocks: fresh pages cost more than the sums
        for block in blocks:
            for index, matrix in enumerate(solve):
                part = flat[first[index] : first[index + 1], block]
                size = part.shape[1]
                images = room[: len(part), : -(-size // _VECTOR) * _VECTOR]
                images[:, :size] = part
                images[:, size:] = 0
                mean, along, across = matrix @ images
                radius, angle = cv2.cartToPolar(along, across)
                # OpenCV's angle is good to 2e-4 rad; one step of Newton's method leaves the rounding of float32
                x, y = cv2.polarToCart(radius, angle)
                error = across[:, None] * x - along[:, None] * y
                error /= np.maximum(radius * radius, np.float32(1e-18))
                angle += error
                phase[index, block], modulation[index, block] = angle[:size, 0], radius[:size, 0]
                offset[block] += mean[:size]

    in_blocks(fit, flat.shape[1])
    offset /= len(shifts)
    return Phases(phase.reshape(-1, *shape), modulation.reshape(-1, *shape), offset.reshape(shape))


def phase_noise(steps: int, sigma_i: float, modulation: float) -> float:
    """Expected standard deviation of the phase [rad] of N steps, for noise sigma_I and modulation B [DN]."""
    return float(np.sqrt(2.0 / steps) * sigma_i / modulation)


def decode_phase_shift(
    stack: NDArray[np.generic],
    code: PhaseShift,
    extent: int,
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
) -> ProjectorCoordinate:
    """Decode the images of a phase-shift code.

    Parameters
    ----------
    stack
        (P, H, W) raw images [DN] of one camera, in the order of :func:`mitsim.sensor.light_code.roles`.
    extent
        Pixels of the projector along the code's axis.
    full_scale
        Value of a saturated pixel [DN]; a pixel that reaches it in any image is refused.
    imager
        Its gain and read noise, or measured noise, give the expected noise. Without it ``sigma`` is NaN, and phases of
        different periods are held against quantisation and ``systematic_rad`` alone.

    Raises
    ------
    InputError
        If the stack is not what the code says, the periods cannot be unwrapped over the extent, or gamma is to be
        corrected with fewer than five steps.
    """
    every = roles(code, extent, extent)
    check_stack(stack, every)
    check_full_scale(stack, full_scale)
    steps = code.steps_of_period
    shifts = [np.array([r.shift for r in every if r.index == index]) for index in range(len(steps))]
    fringes = Fringes(tuple(code.periods_px), tuple(shifts), code.mean, code.contrast)
    return decode_fringes(stack, fringes, extent, settings, full_scale=full_scale, imager=imager)


@dataclass(frozen=True)
class Fringes:
    """Fringes along one axis: ``periods`` [px], falling; ``shifts`` delta [rad] of each period's images.

    ``mean`` and ``contrast`` of the projected cosine [1].
    """

    periods: tuple[float, ...]
    shifts: tuple[NDArray[np.floating], ...]
    mean: float
    contrast: float

    @property
    def steps(self) -> tuple[int, ...]:
        """N of each period."""
        return tuple(map(len, self.shifts))


def decode_fringes(
    stack: NDArray[np.generic],
    fringes: Fringes,
    extent: int,
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
    white_black: tuple[NDArray[np.generic], NDArray[np.generic]] | None = None,
) -> ProjectorCoordinate:
    """Decode fringes with any shifts; ``stack`` (P, H, W) [DN] period after period, the rest as above.

    ``white_black``: images (H, W) of an all-white and a black frame, from which gamma can be estimated with fewer than
    five steps.
    """
    path = unwrapping_path(fringes.periods, fringes.steps, extent)
    phases = fit_phases(stack, fringes.shifts)
    phase = phases.phase
    weakest = phases.modulation.min(axis=0)
    if settings.correct_gamma:
        phase = without_gamma(phases, stack, fringes, _threshold(settings, full_scale), white_black)
    variance = grey_level_variance(phases.offset, imager)
    relative = variance / np.maximum(weakest, np.float32(1e-3)) ** 2
    value, inconsistent = unwrap(phase, path, extent, relative, settings.systematic_rad, settings.consistency_sigma)
    saturated = stack.max(axis=0) >= full_scale
    faint = weakest < _threshold(settings, full_scale)
    status = refusals(saturated, faint, inconsistent)
    sigma = fringe_sigma(fringes.periods[-1], fringes.steps[-1], variance, phases.modulation[-1], imager)
    value[status != Status.VALID] = np.nan
    return ProjectorCoordinate(value, sigma, weakest, status)


def without_gamma(
    phases: Phases,
    stack: NDArray[np.generic],
    fringes: Fringes,
    minimum_modulation: float,
    white_black: tuple[NDArray[np.generic], NDArray[np.generic]] | None = None,
) -> NDArray[np.float32]:
    """Phases (n, H, W) [rad] without the error of the projector's gamma, which is estimated from the images.

    From the second harmonic of the shortest period if that has five steps or more, else from white and black.

    Raises
    ------
    InputError
        If there is neither, or the steps of a period are not equidistant.
    """
    mean, contrast, steps = fringes.mean, fringes.contrast, fringes.steps
    orders = [equidistant_order(shifts) for shifts in fringes.shifts]
    if steps[-1] >= 5 or white_black is None:
        last = stack[len(stack) - steps[-1] :][orders[-1]]
        gamma = estimate_gamma(last, mean, contrast, minimum_modulation)
    else:
        used = phases.modulation.min(axis=0) > minimum_modulation
        gamma = gamma_from_white(phases.offset, *white_black, mean, contrast, used)
    return np.stack(
        [
            correct_phase(each - np.float32(shifts[0]), gamma, n, mean, contrast) + np.float32(shifts[0])
            for each, n, shifts in zip(phases.phase, steps, fringes.shifts, strict=True)
        ]
    )


def fringe_sigma(
    period: float,
    steps: int,
    variance: NDArray[np.float32],
    modulation: NDArray[np.float32],
    imager: Imager | MeasuredNoise | None,
) -> NDArray[np.float32]:
    """Expected standard deviation of the coordinate [projector px]; NaN without an imager."""
    if imager is None:
        return np.full(modulation.shape, np.nan, np.float32)
    scale = np.float32(period / (2 * np.pi) * np.sqrt(2.0 / steps))
    return np.asarray(np.sqrt(variance) * (scale / np.maximum(modulation, np.float32(1e-3))))


def refusals(
    saturated: NDArray[np.bool_], faint: NDArray[np.bool_], inconsistent: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Status per pixel, the first reason that holds: too bright, too faint, contradictory."""
    status = inconsistent * np.uint8(Status.PHASE_INCONSISTENT)
    status[faint] = Status.LOW_MODULATION
    status[saturated] = Status.SATURATED
    return status


def _threshold(settings: DecoderSettings, full_scale: float) -> float:
    return settings.minimum_modulation_dn * full_scale / 255


def _least_squares(delta: NDArray[np.floating]) -> NDArray[np.float32]:
    """Matrix (3, N) from the images to A, B cos(phi), B sin(phi)."""
    design = np.stack([np.ones(len(delta)), np.cos(delta), np.sin(delta)], axis=1)
    return np.linalg.pinv(design).astype(np.float32)
