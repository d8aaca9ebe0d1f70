"""Decode Gray codes: images to bits, bits to stripes, and stripes to projector coordinates.

Signal chain: pattern compared with its inverse, or with the middle between white and black -> bits, most significant
first -> reflected binary code to stripe number (Gray, US patent 2632058, 1953) -> centre of the stripe [projector px].

One bit changes between neighbouring stripes. A single undecided bit is therefore no contradiction if its two values
lead to neighbouring stripes. The pixel then sees the edge between them, and the edge is its coordinate. With any other
undecided bit the pixel is ``PHASE_INCONSISTENT``.

A saturated pixel is rejected only if its bits cannot be decided, since a bit needs only the order of two grey levels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.grey_levels import MeasuredNoise, grey_level_variance
from mitsim.decoding.structured_light.phase_shift import (
    Fringes,
    fit_phases,
    fringe_sigma,
    gamma_corrected,
    rejection_status,
)
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.decoding.structured_light.stripe_edges import interpolate_between_edges, status_without_edges
from mitsim.decoding.structured_light.unwrapping import UnwrappingPath, beat_cycles, unwrap, unwrapping_path
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis, Role
from mitsim.sensor.imager import Imager

#: kinds of images that determine the stripe
STRIPE_IMAGES = ("white", "black", "gray", "gray_inverse")


@dataclass(frozen=True)
class DecodedStripes:
    """Decoded bits of one axis, (H, W) each.

    ``number`` of the stripe, uint16. ``neighbour``: number with the undecided bit inverted, else the same number.
    ``undecided``: whether bits are undecided and do not lead to neighbouring stripes. ``contrast``: white minus black
    [DN], float32.
    """

    number: NDArray[np.uint16]
    neighbour: NDArray[np.uint16]
    undecided: NDArray[np.bool_]
    contrast: NDArray[np.float32]


@dataclass(frozen=True)
class CodedAxis:
    """An axis of the projector with a Gray code.

    ``extent``: number of pixels. ``stripe``: width of the finest stripe [projector px]. ``offset``: column c has the
    code of c + offset [projector px].
    """

    axis: Axis
    extent: int
    stripe: float
    offset: float = 0.0


def binary_of_gray(gray: NDArray[np.unsignedinteger]) -> NDArray[np.uint16]:
    """Return the numbers (...) of reflected binary codes of up to 16 bits: bit k is the exclusive or of bits >= k."""
    out = gray.astype(np.uint16)
    for shift in (1, 2, 4, 8):
        out ^= out >> np.uint16(shift)
    return out


def decode_stripes(
    stack: NDArray[np.generic],
    image_roles: list[Role],
    axis: Axis,
    bit_share: float,
    middle_contrast: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
) -> DecodedStripes:
    """Decode the Gray bits of one axis.

    ``stack``, ``image_roles``: (P, H, W) images [DN] and their roles. ``axis``: axis of the bits. ``bit_share``: a bit
    is undecided if its two levels differ by less than this share of white minus black. ``middle_contrast``: threshold,
    and white minus black, (H, W) [DN]; needed if the stack has neither inverse nor white and black.
    """
    image_of = {(role.kind, role.axis, role.index): image for role, image in zip(image_roles, stack, strict=True)}
    bits = sorted(role.index for role in image_roles if role.kind == "gray" and role.axis == axis)
    has_inverse = ("gray_inverse", axis, 0) in image_of
    if ("white", None, 0) in image_of:
        white, black = (image_of[kind, None, 0].astype(np.float32) for kind in ("white", "black"))
        middle, contrast = (white + black) / 2, white - black
    elif middle_contrast is not None:
        middle, contrast = middle_contrast
    else:
        pairs = [(image_of["gray", axis, bit], image_of["gray_inverse", axis, bit]) for bit in bits]
        contrast = np.mean([cv2.absdiff(a, b) for a, b in pairs], axis=0, dtype=np.float32)
        middle = contrast  # not used, since there is an inverse
    gray: NDArray[np.uint16] = np.zeros(contrast.shape, np.uint16)
    weak_bits: NDArray[np.uint16] = np.zeros(contrast.shape, np.uint16)
    threshold = bit_share * contrast
    if has_inverse and stack.dtype.kind == "u":  # comparing integers is several times faster
        threshold = np.ceil(np.maximum(threshold, 1)).astype(stack.dtype)
    for bit in bits:
        image = image_of["gray", axis, bit]
        if has_inverse:
            complement = image_of["gray_inverse", axis, bit]
            lit, difference = image > complement, cv2.absdiff(image, complement)
        else:
            level = image - middle
            level += level  # the inverse would differ from the middle by as much in the other direction
            lit, difference = level > 0, np.abs(level)
        gray += gray
        gray |= lit
        weak_bits += weak_bits
        weak_bits |= difference < threshold
    number = binary_of_gray(gray)
    neighbour = binary_of_gray(np.bitwise_xor(gray, weak_bits))
    number_change = number.astype(np.int32) - neighbour
    multiple = (weak_bits & (weak_bits - np.uint16(1))) != 0
    return DecodedStripes(number, neighbour, multiple | (np.abs(number_change) > 1), contrast)


def decode_gray_code(
    images: NDArray[np.generic],
    image_roles: list[Role],
    coded: CodedAxis,
    settings: DecoderSettings,
    *,
    full_scale: float,
    saturated: NDArray[np.bool_],
    interpolate: bool,
) -> ProjectorCoordinate:
    """Return the projector coordinate of a Gray code of one axis. Stripes beyond the projector are rejected.

    - ``images``, ``image_roles``: (P, H, W) images [DN] and their roles.
    - ``coded``, ``settings``: the code, and limits of the decoder.
    - ``full_scale``, ``saturated``: value of a saturated pixel [DN], and (H, W) whether the pixel is saturated in any
      image of the code.
    - ``interpolate``: whether columns are interpolated between the edges of their stripes, instead of the stripes'
      centres.
    """
    decoded = decode_stripes(images, image_roles, coded.axis, settings.bit_share)
    coordinate = _stripe_coordinate(decoded, coded, saturated, settings.minimum_modulation_dn * full_scale / 255)
    if not interpolate or coded.axis != "columns":
        return coordinate
    image_of = {(role.kind, role.axis, role.index): image for role, image in zip(image_roles, images, strict=True)}
    bits = sorted((role.index for role in image_roles if role.kind == "gray" and role.axis == "columns"), reverse=True)

    def signed(bit: int) -> NDArray[np.floating]:
        image: NDArray[np.floating] = image_of["gray", "columns", bits[bit]].astype(np.float32)
        if ("gray_inverse", "columns", bits[bit]) in image_of:
            return np.asarray(image - image_of["gray_inverse", "columns", bits[bit]].astype(np.float32))
        white, black = (image_of[kind, None, 0].astype(np.float32) for kind in ("white", "black"))
        return np.asarray(image - (white + black) / 2)

    valid = coordinate.status == Status.VALID
    value, located = interpolate_between_edges(decoded.number, valid, signed, coded.stripe)
    return replace(coordinate, value=value - coded.offset, status=status_without_edges(coordinate.status, located))


def _stripe_coordinate(
    decoded: DecodedStripes, coded: CodedAxis, saturated: NDArray[np.bool_], least_modulation: float
) -> ProjectorCoordinate:
    """Return the projector coordinate of the centres of stripes, with a least modulation [DN]."""
    modulation = np.asarray(decoded.contrast / 2, np.float32)
    low_modulation = modulation < least_modulation
    outside = _stripes_outside(decoded.number, coded)
    rejected = decoded.undecided | outside
    status = rejection_status(saturated & (low_modulation | rejected), low_modulation, rejected)
    # less what a stripe that is cut has beyond the projector's edges; edges between stripes lie inside
    start = decoded.number * float(coded.stripe) - coded.offset
    beyond = np.maximum(start + coded.stripe - coded.extent, 0) - np.maximum(-start, 0)
    value = _centre(decoded, coded) - np.where(decoded.neighbour == decoded.number, beyond / 2, 0)
    value[status != Status.VALID] = np.nan
    sigma = np.full(value.shape, coded.stripe / np.sqrt(12), np.float32)
    return ProjectorCoordinate(value, sigma, modulation, status)


def _stripes_outside(number: NDArray[np.unsignedinteger], coded: CodedAxis) -> NDArray[np.bool_]:
    """Return whether stripes (...), by their numbers, lie beyond the projector's first or last pixel."""
    start = number * coded.stripe - coded.offset  # from the projector's edge
    return np.asarray((start >= coded.extent) | (start + coded.stripe <= 0))


def decode_gray_fringes(
    stack: NDArray[np.generic],
    image_roles: list[Role],
    coded_axis: CodedAxis,
    fringes: Fringes,
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
) -> ProjectorCoordinate:
    """Decode a Gray code for the order of the fringe, and the phases of one or more periods for the position in it.

    The Gray code gives the order of the longest beat of the fringes that is at least two stripes long. Without such a
    beat, one of at least one stripe is used. :mod:`mitsim.decoding.structured_light.unwrapping` leads to the finer
    beats.

    The order is the one that brings the phase nearest to the stripe's centre. Where a stripe is half a fringe (with the
    complementary bit), the true position is up to 1/4 period from its centre. The order changes at 1/2 period. Beyond
    half-way between them, 3/8 period, the phase contradicts the Gray code. Where a stripe is as wide as a fringe, they
    cannot contradict each other.

    - ``stack``, ``image_roles``: (P, H, W) raw images [DN] of one camera and their roles. Images of the other axis are
      ignored. The fringes come period after period, the longest first.
    - ``coded_axis``, ``fringes``: axis and stripes of the Gray code, and periods and shifts of the fringes.
    - ``settings``, ``full_scale``: limits of the decoder, and value of a saturated pixel [DN].
    - ``imager``: as for :func:`mitsim.decoding.structured_light.phase_shift.decode_phase_shift`.
    """
    axis, extent, stripe = coded_axis.axis, coded_axis.extent, coded_axis.stripe
    used = [index for index, role in enumerate(image_roles) if role.kind == "phase" and role.axis == axis]
    images = stack[used[0] : used[-1] + 1] if used == list(range(used[0], used[-1] + 1)) else stack[used]
    phases = fit_phases(images, fringes.shifts)
    phase, modulation = phases.phase, phases.modulation[-1]
    weakest = phases.modulation.min(axis=0)
    threshold = settings.minimum_modulation_dn * full_scale / 255
    plain = {
        role.kind: image for role, image in zip(image_roles, stack, strict=True) if role.kind in ("white", "black")
    }
    if settings.correct_gamma:
        levels = (plain["white"], plain["black"]) if len(plain) == 2 else None
        phase = gamma_corrected(phases, images, fringes, threshold, full_scale, levels)
    scale = np.float32(1 / fringes.contrast)  # ratio of white minus black to the amplitude of the fringes
    middle = phases.offset + np.float32(0.5 - fringes.mean) * scale * modulation
    decoded = decode_stripes(stack, image_roles, axis, settings.bit_share, (middle, scale * modulation))

    path = _unwrapping_of_fringes(fringes, stripe)
    period = path.beats[0].period
    variance = grey_level_variance(phases.offset, imager)
    relative = variance / np.maximum(weakest, np.float32(1e-3)) ** 2
    turns = (_centre(decoded, coded_axis) + 0.5) / period - beat_cycles(phase, path.beats[0])
    order = np.rint(turns)
    limit = (0.5 * stripe / period + 0.5) / 2
    contradicted = np.abs(turns - order) > limit
    value, inconsistent = unwrap(
        phase, path, extent, relative, settings.systematic_rad, settings.consistency_sigma, order.astype(np.float32)
    )
    undecided = decoded.undecided | contradicted | inconsistent
    saturated = images.max(axis=0) >= full_scale
    coded = [
        image
        for image, role in zip(stack, image_roles, strict=True)
        if role.axis in (axis, None) and role.kind in STRIPE_IMAGES
    ]
    for image in coded:
        saturated |= (image >= full_scale) & undecided
    status = rejection_status(saturated, weakest < threshold, undecided)
    value[status != Status.VALID] = np.nan
    sigma = fringe_sigma(fringes.periods[-1], fringes.steps[-1], variance, modulation, imager)
    return ProjectorCoordinate(value, sigma, weakest, status)


def _unwrapping_of_fringes(fringes: Fringes, stripe: float) -> UnwrappingPath:
    """Return the path from a beat that the Gray code can count, two stripes long if possible, to the finest fringe."""
    try:
        return unwrapping_path(fringes.periods, fringes.steps, 2 * stripe)
    except InputError:
        return unwrapping_path(fringes.periods, fringes.steps, stripe)


def _centre(decoded: DecodedStripes, coded: CodedAxis) -> NDArray[np.float64]:
    """Return the centre of the stripe, or the edge to its neighbour [projector px]."""
    centre = decoded.number.astype(np.float64) + decoded.neighbour
    centre += 1
    centre *= coded.stripe / 2
    centre -= 0.5 + coded.offset
    return centre
