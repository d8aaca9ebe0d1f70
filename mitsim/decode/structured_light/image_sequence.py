"""The images of somebody else's rig, in its own order, to projector coordinates.

Signal chain: images in the order of their sequence -> those of each axis, fringes by falling period -> the decoder of
Gray code, of fringes, or of both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.decode.grey_levels import MeasuredNoise, check_full_scale
from mitsim.decode.structured_light.gray_code import (
    CodedAxis,
    between_stripes,
    decode_gray_fringes,
    decode_stripes,
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
    between: bool = False,
) -> dict[Axis, ProjectorCoordinate]:
    """Coordinates along each axis of a sequence; ``size`` is the projector's, width and height, the rest as for codes.

    Raises
    ------
    InputError
        If the stack is not what the sequence says, or its code cannot be told apart over the projector.
    """
    every = sequence.roles(*size)
    check_stack(stack, every)
    check_full_scale(stack, full_scale)
    out: dict[Axis, ProjectorCoordinate] = {}
    for axis in sequence.axes:
        extent = size[0] if axis == "columns" else size[1]
        groups, gray = sequence.fringes(axis), sequence.gray(axis)
        # images of no other axis; the fringes last, from the longest period on
        own = [i for i, role in enumerate(every) if role.axis in (axis, None) and role.kind not in ("phase", "unused")]
        coded = len(own)
        for index in range(len(groups)):
            own += [i for i, role in enumerate(every) if (role.kind, role.axis, role.index) == ("phase", axis, index)]
        images, part = stack[own], [every[i] for i in own]
        fringes = Fringes(
            tuple(group.period_px for group in groups),
            tuple(np.array(group.shifts) for group in groups),
            sequence.mean,
            sequence.contrast,
        )
        if not gray:
            plain = {role.kind: image for role, image in zip(part, images, strict=True) if role.axis is None}
            out[axis] = decode_fringes(
                images[coded:],
                fringes,
                extent,
                settings,
                full_scale=full_scale,
                imager=imager,
                white_black=(plain["white"], plain["black"]) if len(plain) == 2 else None,
            )
            continue
        stripe = gray[0].stripes(extent)[1]
        if groups:
            along = CodedAxis(axis, extent, stripe)
            out[axis] = decode_gray_fringes(
                images, part, along, fringes, settings, full_scale=full_scale, imager=imager
            )
        else:
            found = decode_stripes(images, part, axis, settings.bit_share)
            out[axis] = stripe_coordinate(found, stripe, extent, images.max(axis=0) >= full_scale, settings, full_scale)
            if between and axis == "columns":
                out[axis] = between_stripes(out[axis], found, images, part, stripe)
    return out
