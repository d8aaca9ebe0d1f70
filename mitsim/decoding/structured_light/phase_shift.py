"""Decode N-step phase shifting: images to phase, modulation and offset; phases of several periods to a coordinate.

Signal chain: images I_k = A + B cos(phi - delta_k) [DN] -> least squares for (A, B cos phi, B sin phi) -> phi, B ->
rejection of saturated and faint pixels -> temporal unwrapping -> coordinate [projector px] and its expected noise.

    sigma_phi = sqrt(2 / N) sigma_I / B        sigma_u = P / (2 pi) sigma_phi

for N equidistant steps and a period P (Surrel, Applied Optics 36, 271, 1997). sigma_I is the noise at the level A. Shot
noise depends on the phase, but for N >= 4 these terms cancel, and for N = 3 they cancel in the mean over all phases.

For equidistant steps the least squares are the usual arctan of two sums; other shifts are allowed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status
from mitsim.decoding.blocks import BLOCK, in_blocks
from mitsim.decoding.grey_levels import MeasuredNoise, grey_level_variance
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decoding.structured_light.projector_gamma import (
    correct_phase,
    equidistant_order,
    estimate_gamma,
    gamma_from_white,
)
from mitsim.decoding.structured_light.unwrapping import unwrap, unwrapping_path
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Role
from mitsim.sensor.imager import Imager

#: blocks are padded to a multiple of this number of pixels. A processor rounds the elements that do not fill a vector
#: differently, and a pixel's phase must not depend on its position in a window
_VECTOR = 64


@dataclass(frozen=True)
class Phases:
    """Fitted parameters of the fringes, float32."""

    phase: NDArray[np.float32]  # (n, H, W) [rad] of each period, 0 to 2 pi
    modulation: NDArray[np.float32]  # (n, H, W) amplitude B [DN]
    offset: NDArray[np.float32]  # (H, W) level A [DN], the mean over all periods


def fit_phases(stack: NDArray[np.generic], shifts: Sequence[NDArray[np.floating]]) -> Phases:
    """Fit A + B cos(phi - delta) to the images of each period by least squares.

    ``stack`` (P, H, W) are images [DN], period after period; ``shifts`` has for each period the shift delta [rad] of
    each of its images.
    """
    shape = stack.shape[1:]
    flat = stack.reshape(len(stack), -1)
    phase = np.empty((len(shifts), flat.shape[1]), np.float32)
    modulation = np.empty_like(phase)
    offset = np.zeros(flat.shape[1], np.float32)
    starts = np.cumsum([0, *map(len, shifts)])
    solvers = [_least_squares(delta) for delta in shifts]
    largest = max(map(len, shifts))

    def fit(blocks: list[slice]) -> None:
        # one buffer for all blocks, since new memory costs more time than the sums
        buffer = np.empty((largest, BLOCK), np.float32)
        for block in blocks:
            for index, matrix in enumerate(solvers):
                raw = flat[starts[index] : starts[index + 1], block]
                size = raw.shape[1]
                images = buffer[: len(raw), : -(-size // _VECTOR) * _VECTOR]
                images[:, :size] = raw
                images[:, size:] = 0
                mean, cosine, sine = matrix @ images
                radius, angle = cv2.cartToPolar(cosine, sine)
                # OpenCV's angle has an error of 2e-4 rad; one step of Newton's method reduces it to the rounding of
                # float32
                x, y = cv2.polarToCart(radius, angle)
                error = sine[:, None] * x - cosine[:, None] * y
                error /= np.maximum(radius * radius, np.float32(1e-18))
                angle += error
                phase[index, block], modulation[index, block] = angle[:size, 0], radius[:size, 0]
                offset[block] += mean[:size]

    in_blocks(fit, flat.shape[1])
    offset /= len(shifts)
    return Phases(phase.reshape(-1, *shape), modulation.reshape(-1, *shape), offset.reshape(shape))


@dataclass(frozen=True)
class Fringes:
    """Fringes along one axis."""

    periods: tuple[float, ...]  # decreasing [px]
    shifts: tuple[NDArray[np.floating], ...]  # shifts delta [rad] of the images of each period
    #: ``mean``, ``contrast``: of the projected cosine [1]
    mean: float
    contrast: float

    @classmethod
    def of(cls, image_roles: Sequence[Role], mean: float, contrast: float) -> Fringes:
        """Return the fringes of the images of an axis, period after period; ``mean`` and ``contrast`` of its code."""
        periods = {role.index: role.period for role in image_roles}
        shifts = (np.array([role.shift for role in image_roles if role.index == index]) for index in periods)
        return cls(tuple(periods.values()), tuple(shifts), mean, contrast)

    @property
    def steps(self) -> tuple[int, ...]:
        """Number of steps N of each period."""
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
    """Decode fringes with any shifts.

    - ``stack``: (P, H, W) images [DN], period after period.
    - ``fringes``: periods and shifts.
    - ``extent``, ``settings``: number of projector pixels along the axis, and the limits of the decoder.
    - ``full_scale``: value of a saturated pixel [DN]; a pixel that has it in any image is rejected.
    - ``imager``: the imager, or measured noise, from which the expected noise follows. If it is None, ``sigma`` is NaN.
      Phases of different periods are then compared by quantisation and ``systematic_rad`` alone.
    - ``white_black``: images (H, W) of a white and a black frame, from which gamma can be estimated with fewer than
      five steps.

    Raises InputError if the fringes are ambiguous over the extent, or gamma has to be corrected from fewer than five
    steps.
    """
    path = unwrapping_path(fringes.periods, fringes.steps, extent)
    phases = fit_phases(stack, fringes.shifts)
    phase = phases.phase
    weakest = phases.modulation.min(axis=0)
    if settings.correct_gamma:
        phase = gamma_corrected(phases, stack, fringes, _threshold(settings, full_scale), full_scale, white_black)
    variance = grey_level_variance(phases.offset, imager)
    relative_variance = variance / np.maximum(weakest, np.float32(1e-3)) ** 2
    value, inconsistent = unwrap(
        phase, path, extent, relative_variance, settings.systematic_rad, settings.consistency_sigma
    )
    saturated = stack.max(axis=0) >= full_scale
    low_modulation = weakest < _threshold(settings, full_scale)
    status = rejection_status(saturated, low_modulation, inconsistent)
    sigma = fringe_sigma(fringes.periods[-1], fringes.steps[-1], variance, phases.modulation[-1], imager)
    value[status != Status.VALID] = np.nan
    return ProjectorCoordinate(value, sigma, weakest, status)


def gamma_corrected(
    phases: Phases,
    stack: NDArray[np.generic],
    fringes: Fringes,
    minimum_modulation: float,
    full_scale: float,
    white_black: tuple[NDArray[np.generic], NDArray[np.generic]] | None = None,
) -> NDArray[np.float32]:
    """Return phases (n, H, W) [rad] without the error of the projector's gamma, which is estimated from the images.

    The estimate uses the second harmonic of the shortest period if that has five steps or more, else white and black.

    - ``phases``: fitted fringes.
    - ``stack``: (P, H, W) images of the fringes [DN], period after period.
    - ``fringes``, ``minimum_modulation``: periods and shifts, and least modulation of the pixels that the estimate uses
      [DN].
    - ``full_scale``: value of a saturated pixel [DN]; the estimate uses none that has it in any image.
    - ``white_black``: (H, W) images of full light and of no light [DN].

    Raises InputError if both are missing, or the steps of a period are not equidistant.
    """
    mean, contrast, steps = fringes.mean, fringes.contrast, fringes.steps
    orders = [equidistant_order(shifts) for shifts in fringes.shifts]
    if steps[-1] >= 5 or white_black is None:
        last = stack[len(stack) - steps[-1] :][orders[-1]]
        gamma = estimate_gamma(last[:, last.max(axis=0) < full_scale], mean, contrast, minimum_modulation)
    else:
        used = (phases.modulation.min(axis=0) > minimum_modulation) & (stack.max(axis=0) < full_scale)
        used &= np.less(white_black[0], full_scale)
        gamma = gamma_from_white(phases.offset, *white_black, mean, contrast, used)
    return np.stack(
        [
            correct_phase(phase - np.float32(shifts[0]), gamma, n, mean, contrast) + np.float32(shifts[0])
            for phase, n, shifts in zip(phases.phase, steps, fringes.shifts, strict=True)
        ]
    )


def fringe_sigma(
    period: float,
    steps: int,
    variance: NDArray[np.float32],
    modulation: NDArray[np.float32],
    imager: Imager | MeasuredNoise | None,
) -> NDArray[np.float32]:
    """Return the expected standard deviation of the coordinate [projector px]; NaN without an imager.

    Parameters
    ----------
    period, steps
        Period of the finest fringe [projector px], and number of its images.
    variance
        (...) of the grey levels [DN^2].
    modulation
        (...) of the finest fringe [DN].
    imager
        Imager or measured noise; the value is NaN if it is None.

    See Also
    --------
    rejection_status : which pixels the decoder rejects
    """
    if imager is None:
        return np.full(modulation.shape, np.nan, np.float32)
    scale = np.float32(period / (2 * np.pi) * np.sqrt(2.0 / steps))
    return np.asarray(np.sqrt(variance) * (scale / np.maximum(modulation, np.float32(1e-3))))


def rejection_status(
    saturated: NDArray[np.bool_], low_modulation: NDArray[np.bool_], inconsistent: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return the status of each pixel by the first condition that holds: saturated, low modulation, inconsistent."""
    status = inconsistent * np.uint8(Status.PHASE_INCONSISTENT)
    status[low_modulation] = Status.LOW_MODULATION
    status[saturated] = Status.SATURATED
    return status


def _threshold(settings: DecoderSettings, full_scale: float) -> float:
    return settings.minimum_modulation_dn * full_scale / 255


def _least_squares(delta: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the matrix (3, N) from the images to A, B cos(phi) and B sin(phi), for shifts ``delta`` (N,) [rad]."""
    design = np.stack([np.ones(len(delta)), np.cos(delta), np.sin(delta)], axis=1)
    return np.linalg.pinv(design).astype(np.float32)
