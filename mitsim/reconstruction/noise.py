"""From where the points of a structured-light capture have their sigma, and why others have none.

Of a whole ``[imager]``, it is that of its gain and read noise. Where nobody describes the imager, fringes show their
noise themselves (:mod:`mitsim.decode.structured_light.measured_noise`); a Gray code has the error of a stripe's width.
"""

from __future__ import annotations

import numpy as np

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.structured_light.measured_noise import measured_noise
from mitsim.reconstruction.cloud import bracket_of, capture_pattern
from mitsim.reconstruction.decoder_registry import projector_size
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCodePhaseShift, LightCode, PhaseShift, axes, has_fringes, roles


def known_noise(capture: Capture, imager: Imager | None) -> Imager | MeasuredNoise | None:
    """Return the imager; where nobody describes it, the noise that the fringes of a structured-light capture show.

    None where neither tells it: of a Gray code alone, of three steps of one period, of a bracket of exposures.
    """
    if imager is not None or capture.technology != "structured_light" or bracket_of(capture) is not None:
        return imager
    code, size = capture_pattern(capture), projector_size(capture)
    if not isinstance(code, PhaseShift | GrayCodePhaseShift | ImageSequence):
        return None
    every = roles(code, *size)
    stacks = [stack[: len(every)] for stack in capture.images.values() if len(stack) >= len(every)]
    return measured_noise(stacks, every, 2.0**capture.bits - 1) if stacks else None


def noise_in_words(capture: Capture, cloud: PointCloud, noise: Imager | MeasuredNoise | None) -> str:
    """Return in words where the sigma of a structured-light cloud comes from, or why it has none; "" of others."""
    if capture.technology != "structured_light" or not cloud.valid.any():
        return ""
    code = capture_pattern(capture)
    fringes = isinstance(code, LightCode) and any(has_fringes(code, axis) for axis in axes(code))
    if cloud.sigma is None or not np.isfinite(cloud.sigma[cloud.valid]).any():
        if not fringes:
            why = "the error of a Gray code between two cameras is not another from pixel to pixel"
        elif bracket_of(capture) is not None:
            why = "it is not told of several exposures"
        else:
            why = (
                "nobody says what the imager's noise is, and the fringes leave nothing over to measure it from: decode "
                "with --sensor and a file whose [imager] is whole"
            )
        return f"sigma of the points: not known, {why}"
    if isinstance(noise, MeasuredNoise) and fringes:
        level, deviation = noise.middle
        return (
            f"sigma of the points: from the contrast of the fringes and the noise about their fit, "
            f"{deviation:.2g} DN at a level of {level:.0f}, since nobody describes the imager"
        )
    return "" if noise is not None else "sigma of the points: that of an even error over the width of a stripe"
