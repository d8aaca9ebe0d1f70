"""Gray code: images to bits, bits to stripes, and what an undecided bit means.

Signal chain: pattern against its inverse, or against the middle between white and black -> bits, most significant first
-> reflected binary code to stripe number -> centre of the stripe [projector px].

Between neighbouring stripes one bit changes. So a single undecided bit is no contradiction if both its values lead to
neighbours: the pixel looks at the edge between them, and the edge is its coordinate. Any other undecided bit makes the
pixel ``PHASE_INCONSISTENT``. A saturated pixel is refused only if it cannot be decoded: bits need an order of two grey
levels, not their size.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status
from mitsim.decode.phase_shift import fit_phases, fringe_sigma, refusals
from mitsim.decode.projector_coordinate import ProjectorCoordinate, check_full_scale, grey_level_variance
from mitsim.decode.projector_gamma import correct_phase, estimate_gamma
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import Axis, GrayCode, GrayCodePhaseShift, Role, axes, check_stack, roles, stripes


@dataclass(frozen=True)
class Stripes:
    """Decoded bits of one axis, (H, W) each.

    ``number`` of the stripe (uint16) and ``other``, that of the neighbour if the one undecided bit is turned, else the
    same; ``undecided``: bits that contradict one another; ``contrast`` float32 [DN], white minus black.
    """

    number: NDArray[np.uint16]
    other: NDArray[np.uint16]
    undecided: NDArray[np.bool_]
    contrast: NDArray[np.float32]


def binary_of_gray(gray: NDArray[np.unsignedinteger]) -> NDArray[np.uint16]:
    """Stripe numbers of reflected binary codes (...), up to 16 bits: the exclusive or of all bits from each one up."""
    out = gray.astype(np.uint16)
    for shift in (1, 2, 4, 8):
        out ^= out >> np.uint16(shift)
    return out


def decode_stripes(
    stack: NDArray[np.generic],
    every: list[Role],
    axis: Axis,
    bit_share: float,
    middle_contrast: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
) -> Stripes:
    """Read the Gray bits of one axis.

    Parameters
    ----------
    stack, every
        (P, H, W) images and their roles.
    bit_share
        A bit is undecided where its two levels differ by less than this share of white minus black.
    middle_contrast
        Threshold and white minus black (H, W) [DN] where the stack has neither inverse, nor white and black.
    """
    where = {(role.kind, role.axis, role.index): image for role, image in zip(every, stack, strict=True)}
    bits = [role.index for role in every if role.kind == "gray" and role.axis == axis]
    inverse = ("gray_inverse", axis, 0) in where
    if ("white", None, 0) in where:
        white, black = (where[kind, None, 0].astype(np.float32) for kind in ("white", "black"))
        middle, contrast = (white + black) / 2, white - black
    elif middle_contrast is not None:
        middle, contrast = middle_contrast
    else:
        pairs = [(where["gray", axis, bit], where["gray_inverse", axis, bit]) for bit in bits]
        contrast = np.mean([cv2.absdiff(a, b) for a, b in pairs], axis=0, dtype=np.float32)
        middle = contrast  # not used: there is an inverse
    gray: NDArray[np.uint16] = np.zeros(contrast.shape, np.uint16)
    doubtful: NDArray[np.uint16] = np.zeros(contrast.shape, np.uint16)
    least = bit_share * contrast
    if inverse and stack.dtype.kind == "u":  # comparing whole grey levels is several times faster
        least = np.ceil(np.maximum(least, 1)).astype(stack.dtype)
    for bit in bits:
        image = where["gray", axis, bit]
        if inverse:
            other = where["gray_inverse", axis, bit]
            lit, difference = image > other, cv2.absdiff(image, other)
        else:
            signed = image - middle
            signed += signed  # the inverse would lie as far on the other side of the middle
            lit, difference = signed > 0, np.abs(signed)
        gray += gray
        gray |= lit
        doubtful += doubtful
        doubtful |= difference < least
    number = binary_of_gray(gray)
    other_number = binary_of_gray(np.bitwise_xor(gray, doubtful))
    apart = number.astype(np.int32) - other_number
    several = (doubtful & (doubtful - np.uint16(1))) != 0
    return Stripes(number, other_number, several | (np.abs(apart) > 1), contrast)


def decode_gray_code(
    stack: NDArray[np.generic],
    code: GrayCode,
    width: int,
    height: int,
    settings: DecoderSettings,
    *,
    full_scale: float,
) -> dict[Axis, ProjectorCoordinate]:
    """Decode the images of a Gray code.

    Parameters
    ----------
    stack
        (P, H, W) raw images [DN] of one camera, in the order of :func:`mitsim.sensor.light_code.roles`.
    width, height
        Of the projector [px].
    full_scale
        Value of a saturated pixel [DN].

    Returns
    -------
    dict
        A coordinate for each axis of the code: the centre of the stripe, or the edge between two; ``sigma`` is
        stripe / sqrt(12), that of an even distribution over the stripe.

    Raises
    ------
    InputError
        If the stack is not what the code says.
    """
    every = roles(code, width, height)
    check_stack(stack, every)
    check_full_scale(stack, full_scale)
    saturated = stack.max(axis=0) >= full_scale
    out: dict[Axis, ProjectorCoordinate] = {}
    for axis in axes(code):
        extent = width if axis == "columns" else height
        stripe = stripes(code, extent)[1]
        found = decode_stripes(stack, every, axis, settings.bit_share)
        modulation = np.asarray(found.contrast / 2, np.float32)
        faint = modulation < settings.minimum_modulation_dn * full_scale / 255
        outside = found.number * stripe >= extent
        undecided = found.undecided | outside
        status = refusals(saturated & (faint | undecided), faint, undecided)
        value = _centre(found, stripe)
        value[status != Status.VALID] = np.nan
        sigma = np.full(value.shape, stripe / np.sqrt(12), np.float32)
        out[axis] = ProjectorCoordinate(value, sigma, modulation, status)
    return out


def decode_gray_code_phase_shift(
    stack: NDArray[np.generic],
    code: GrayCodePhaseShift,
    width: int,
    height: int,
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | None = None,
) -> ProjectorCoordinate:
    """Decode Gray code for the order of the fringe and phase shifting inside it; arguments as for the others.

    The order is the one that brings the phase nearest to the stripe's centre. With the complementary bit a stripe is
    half a fringe, so the true place is up to 1/4 period from its centre and the order flips at 1/2: farther than
    half-way between, 3/8, the phase contradicts the Gray code. Without it the two cannot contradict each other.

    Raises
    ------
    InputError
        If the stack is not what the code says, or gamma is to be corrected with fewer than five steps.
    """
    every = roles(code, width, height)
    check_stack(stack, every)
    check_full_scale(stack, full_scale)
    extent = width if code.axis == "columns" else height
    stripe = stripes(code, extent)[1]
    shift = np.array([role.shift for role in every if role.kind == "phase"])
    fringes = stack[-len(shift) :]
    fitted = fit_phases(fringes, [shift])
    phase, modulation = fitted.phase[0], fitted.modulation[0]
    threshold = settings.minimum_modulation_dn * full_scale / 255
    if settings.correct_gamma:
        gamma = estimate_gamma(fringes, code.mean, code.contrast, minimum_modulation=threshold)
        phase = correct_phase(phase, gamma, code.steps, code.mean, code.contrast)
    scale = np.float32(1 / code.contrast)  # from the amplitude of the fringes to white minus black
    middle = fitted.offset + np.float32(0.5 - code.mean) * scale * modulation
    found = decode_stripes(stack, every, code.axis, settings.bit_share, (middle, scale * modulation))

    cycles = phase * np.float32(1 / (2 * np.pi))
    expected = (_centre(found, stripe) + 0.5) / code.period_px - cycles
    order = np.rint(expected)
    place = (order + cycles) * code.period_px
    limit = (0.5 * stripe / code.period_px + 0.5) / 2
    inconsistent = (np.abs(expected - order) > limit) | found.undecided | (place < -1) | (place > extent + 1)
    saturated = stack.max(axis=0) >= full_scale
    status = refusals(saturated, modulation < threshold, inconsistent)
    value = place - 0.5
    value[status != Status.VALID] = np.nan
    variance = grey_level_variance(fitted.offset, imager)
    sigma = fringe_sigma(code.period_px, code.steps, variance, modulation, imager)
    return ProjectorCoordinate(value, sigma, modulation, status)


def _centre(found: Stripes, stripe: float) -> NDArray[np.float64]:
    """Middle of a stripe, or the edge to its neighbour [projector px]."""
    both = found.number.astype(np.float64) + found.other
    both += 1
    both *= stripe / 2
    both -= 0.5
    return both
