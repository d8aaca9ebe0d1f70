"""Gray code: images to bits, bits to stripes, and what an undecided bit means.

Signal chain: pattern against its inverse, or against the middle between white and black -> bits, most significant first
-> reflected binary code to stripe number -> centre of the stripe [projector px].

Between neighbouring stripes one bit changes. So a single undecided bit is no contradiction if both its values lead to
neighbours: the pixel looks at the edge between them, and the edge is its coordinate. Any other undecided bit makes the
pixel ``PHASE_INCONSISTENT``. A saturated pixel is refused only if it cannot be decoded: bits need an order of two grey
levels, not their size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decode.grey_levels import MeasuredNoise, check_full_scale, grey_level_variance
from mitsim.decode.structured_light.phase_shift import Fringes, fit_phases, fringe_sigma, refusals, without_gamma
from mitsim.decode.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decode.structured_light.stripe_edges import between_edges, refused_without_edge
from mitsim.decode.structured_light.unwrapping import UnwrappingPath, beat_cycles, unwrap, unwrapping_path
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis, Role
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, axes, check_stack, roles, stripes

#: images by which a stripe is told
_BITS = ("white", "black", "gray", "gray_inverse")


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
    bits = sorted(role.index for role in every if role.kind == "gray" and role.axis == axis)
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
    between: bool = False,
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
    between
        Columns rise between the edges of their stripes (:mod:`mitsim.decode.structured_light.stripe_edges`).

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
        found, stripe = decode_stripes(stack, every, axis, settings.bit_share), stripes(code, extent)[1]
        out[axis] = stripe_coordinate(found, stripe, extent, saturated, settings, full_scale)
        if between and axis == "columns":
            out[axis] = between_stripes(out[axis], found, stack, every, stripe)
    return out


def between_stripes(
    coordinate: ProjectorCoordinate, found: Stripes, stack: NDArray[np.generic], every: list[Role], stripe: float
) -> ProjectorCoordinate:
    """Columns of a projector that rise between the edges of their stripes, in place of the stripes' centres."""
    where = {(role.kind, role.axis, role.index): image for role, image in zip(every, stack, strict=True)}
    bits = sorted((role.index for role in every if role.kind == "gray" and role.axis == "columns"), reverse=True)

    def signed(bit: int) -> NDArray[np.floating]:
        image: NDArray[np.floating] = where["gray", "columns", bits[bit]].astype(np.float32)
        if ("gray_inverse", "columns", bits[bit]) in where:
            return np.asarray(image - where["gray_inverse", "columns", bits[bit]].astype(np.float32))
        white, black = (where[kind, None, 0].astype(np.float32) for kind in ("white", "black"))
        return np.asarray(image - (white + black) / 2)

    value, placed = between_edges(found.number, coordinate.status == Status.VALID, signed, stripe)
    return replace(coordinate, value=value, status=refused_without_edge(coordinate.status, placed))


def stripe_coordinate(
    found: Stripes,
    stripe: float,
    extent: int,
    saturated: NDArray[np.bool_],
    settings: DecoderSettings,
    full_scale: float,
) -> ProjectorCoordinate:
    """Coordinate of stripes ``stripe`` px wide over ``extent`` px; ``saturated`` (H, W) in any image of the code."""
    modulation = np.asarray(found.contrast / 2, np.float32)
    faint = modulation < settings.minimum_modulation_dn * full_scale / 255
    outside = found.number * stripe >= extent
    undecided = found.undecided | outside
    status = refusals(saturated & (faint | undecided), faint, undecided)
    value = _centre(found, stripe)
    value[status != Status.VALID] = np.nan
    sigma = np.full(value.shape, stripe / np.sqrt(12), np.float32)
    return ProjectorCoordinate(value, sigma, modulation, status)


def decode_gray_code_phase_shift(
    stack: NDArray[np.generic],
    code: GrayCodePhaseShift,
    width: int,
    height: int,
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
) -> ProjectorCoordinate:
    """Decode Gray code for the order of the fringe and phase shifting inside it; arguments as for the others.

    Raises
    ------
    InputError
        If the stack is not what the code says, or gamma is to be corrected with fewer than five steps and without a
        white and a black image.
    """
    every = roles(code, width, height)
    check_stack(stack, every)
    check_full_scale(stack, full_scale)
    extent = width if code.axis == "columns" else height
    shift = np.array([role.shift for role in every if role.kind == "phase"])
    fringes = Fringes((code.period_px,), (shift,), code.mean, code.contrast)
    return decode_gray_fringes(
        stack,
        every,
        CodedAxis(code.axis, extent, stripes(code, extent)[1]),
        fringes,
        settings,
        full_scale=full_scale,
        imager=imager,
    )


@dataclass(frozen=True)
class CodedAxis:
    """An axis of the projector: ``extent`` pixels along it, ``stripe`` width of the finest stripe [projector px]."""

    axis: Axis
    extent: int
    stripe: float


def decode_gray_fringes(
    stack: NDArray[np.generic],
    every: list[Role],
    along: CodedAxis,
    fringes: Fringes,
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
) -> ProjectorCoordinate:
    """Decode Gray code for the order of the fringe and the phases of one period or several inside it.

    The longest beat of the fringes that is at least two stripes long takes its order from the Gray code (if there is
    none, one of at least a stripe); finer ones follow as in :mod:`mitsim.decode.structured_light.unwrapping`. The order
    is the one that brings the phase nearest to the stripe's centre. Where a stripe is half a fringe (the complementary
    bit) the true place is up to 1/4 period from its centre and the order flips at 1/2: farther than half-way between,
    3/8, the phase contradicts the Gray code. Where it is as wide as a fringe the two cannot contradict each other.

    Parameters
    ----------
    stack, every
        (P, H, W) raw images [DN] of one camera and their roles; those of the other axis are left out of account, and
        the fringes come period after period, the longest first.
    """
    axis, extent, stripe = along.axis, along.extent, along.stripe
    own = [index for index, role in enumerate(every) if role.kind == "phase" and role.axis == axis]
    images = stack[own[0] : own[-1] + 1] if own == list(range(own[0], own[-1] + 1)) else stack[own]
    phases = fit_phases(images, fringes.shifts)
    phase, modulation = phases.phase, phases.modulation[-1]
    weakest = phases.modulation.min(axis=0)
    threshold = settings.minimum_modulation_dn * full_scale / 255
    plain = {role.kind: image for role, image in zip(every, stack, strict=True) if role.kind in ("white", "black")}
    if settings.correct_gamma:
        levels = (plain["white"], plain["black"]) if len(plain) == 2 else None
        phase = without_gamma(phases, images, fringes, threshold, levels)
    scale = np.float32(1 / fringes.contrast)  # from the amplitude of the fringes to white minus black
    middle = phases.offset + np.float32(0.5 - fringes.mean) * scale * modulation
    found = decode_stripes(stack, every, axis, settings.bit_share, (middle, scale * modulation))

    path = _path(fringes, stripe)
    period = path.beats[0].period
    variance = grey_level_variance(phases.offset, imager)
    relative = variance / np.maximum(weakest, np.float32(1e-3)) ** 2
    expected = (_centre(found, stripe) + 0.5) / period - beat_cycles(phase, path.beats[0])
    order = np.rint(expected)
    limit = (0.5 * stripe / period + 0.5) / 2
    contradicted = np.abs(expected - order) > limit
    value, inconsistent = unwrap(
        phase, path, extent, relative, settings.systematic_rad, settings.consistency_sigma, order.astype(np.float32)
    )
    undecided = found.undecided | contradicted | inconsistent
    saturated = images.max(axis=0) >= full_scale
    coded = [
        image for image, role in zip(stack, every, strict=True) if role.axis in (axis, None) and role.kind in _BITS
    ]
    for image in coded:
        saturated |= (image >= full_scale) & undecided
    status = refusals(saturated, weakest < threshold, undecided)
    value[status != Status.VALID] = np.nan
    sigma = fringe_sigma(fringes.periods[-1], fringes.steps[-1], variance, modulation, imager)
    return ProjectorCoordinate(value, sigma, weakest, status)


def _path(fringes: Fringes, stripe: float) -> UnwrappingPath:
    """From a beat that the Gray code can count, two stripes long if there is one, to the finest fringe."""
    try:
        return unwrapping_path(fringes.periods, fringes.steps, 2 * stripe)
    except InputError:
        return unwrapping_path(fringes.periods, fringes.steps, stripe)


def _centre(found: Stripes, stripe: float) -> NDArray[np.float64]:
    """Middle of a stripe, or the edge to its neighbour [projector px]."""
    both = found.number.astype(np.float64) + found.other
    both += 1
    both *= stripe / 2
    both -= 0.5
    return both
