"""Decode the images of a foreign rig, in the rig's own order, to projector coordinates.

Signal chain: images in the order of their sequence -> images of each axis, with the fringes by decreasing period ->
decoder of Gray code, of fringes, or of both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.decode.grey_levels import MeasuredNoise, check_full_scale
from mitsim.decode.structured_light.gray_code import (
    CodedAxis,
    decode_gray_fringes,
    decode_stripes,
    interpolated_columns,
    stripe_coordinate,
)
from mitsim.decode.structured_light.phase_shift import Fringes, decode_fringes
from mitsim.decode.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import check_stack


def decode_image_sequence(
    stack: NDArray[np.generic],
    sequence: ImageSequence,
    size: tuple[int, int],
    settings: DecoderSettings,
    *,
    full_scale: float,
    imager: Imager | MeasuredNoise | None = None,
    interpolate: bool = False,
) -> dict[Axis, ProjectorCoordinate]:
    """Return the projector coordinates along each axis of a sequence.

    Parameters
    ----------
    stack
        (P, H, W) raw images [DN] of one camera, in the order of the sequence.
    sequence, settings
        The sequence, and the limits of the decoder.
    size
        Width and height of the projector [px].
    full_scale
        Value of a saturated pixel [DN].
    imager
        The imager, or measured noise, from which the expected noise follows; None if neither is known.
    interpolate
        For a Gray code without fringes: interpolate columns between the edges of their stripes.

    Raises
    ------
    InputError
        If the stack does not fit the sequence, or its code is ambiguous over the projector.
    """
    image_roles = sequence.roles(*size)
    check_stack(stack, image_roles)
    check_full_scale(stack, full_scale)
    out: dict[Axis, ProjectorCoordinate] = {}
    for axis in sequence.axes:
        extent = size[0] if axis == "columns" else size[1]
        groups, gray = sequence.fringes(axis), sequence.gray(axis)
        # without images of the other axis; the fringes last, from the longest period on
        indices = [
            i
            for i, role in enumerate(image_roles)
            if role.axis in (axis, None) and role.kind not in ("phase", "unused")
        ]
        fringe_start = len(indices)
        for index in range(len(groups)):
            indices += [
                i for i, role in enumerate(image_roles) if (role.kind, role.axis, role.index) == ("phase", axis, index)
            ]
        images, axis_roles = stack[indices], [image_roles[i] for i in indices]
        fringes = Fringes(
            tuple(group.period_px for group in groups),
            tuple(np.array(group.shifts) for group in groups),
            sequence.mean,
            sequence.contrast,
        )
        if not gray:
            white_black = {
                role.kind: image for role, image in zip(axis_roles, images, strict=True) if role.axis is None
            }
            out[axis] = decode_fringes(
                images[fringe_start:],
                fringes,
                extent,
                settings,
                full_scale=full_scale,
                imager=imager,
                white_black=(white_black["white"], white_black["black"]) if len(white_black) == 2 else None,
            )
            continue
        coded_axis = CodedAxis(axis, extent, gray[0].stripes(extent)[1], gray[0].offset(extent))
        if groups:
            out[axis] = decode_gray_fringes(
                images, axis_roles, coded_axis, fringes, settings, full_scale=full_scale, imager=imager
            )
        else:
            decoded = decode_stripes(images, axis_roles, axis, settings.bit_share)
            out[axis] = stripe_coordinate(decoded, coded_axis, images.max(axis=0) >= full_scale, settings, full_scale)
            if interpolate and axis == "columns":
                out[axis] = interpolated_columns(out[axis], decoded, images, axis_roles, coded_axis)
    return out
