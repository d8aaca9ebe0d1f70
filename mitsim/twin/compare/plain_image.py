"""Select the image of a capture that shows its specimen under full projector light, for any light code.

Signal chain: pattern of the capture -> role of every image -> the white image; for a code without one, the largest grey
level of every pixel over all images of the code; for time of flight, the light of all correlations. A dot pattern has
neither. Its first frame is used with its dots, since a matcher works on the grey levels of the dots.

A single image of a Gray code is not suitable: the specimen may be in a dark stripe, whose grey level is independent of
the projector's power.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import capture_pattern
from mitsim.decoding.decoder_registry import projector_size
from mitsim.sensor.light_code import LightCode, roles
from mitsim.sensor.modulation import AmplitudeModulation, correlated_light

_CODED = ("gray", "gray_inverse", "phase")


@dataclass(frozen=True)
class PlainImage:
    """Indices of the ``images`` over which the largest level of every pixel is taken; ``name`` of the result.

    ``has_dots``: the image shows the pattern of a matcher, which determines local contrast and run length.
    ``full_scale`` [DN] of correlations, of which one may be dark in much light: their range is taken, and full scale
    where one is saturated. None: images of light.
    """

    images: tuple[int, ...]
    name: str
    has_dots: bool
    full_scale: int | None = None

    def of(self, stack: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.unsignedinteger[Any]]:
        """Return the plain image (H, W) [DN] of a camera's stack (n, H, W)."""
        return self.merged(stack[list(self.images)])

    def merged(self, images: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.unsignedinteger[Any]]:
        """Return the plain image (H, W) [DN] of its images alone."""
        brightest = np.asarray(images.max(axis=0))
        if self.full_scale is None:
            return brightest
        light = np.minimum(np.rint(correlated_light(images)), self.full_scale)
        return np.where(brightest < self.full_scale, light, self.full_scale).astype(images.dtype)


def plain_image(capture: Capture) -> PlainImage:
    """Select the plain image of a capture; InputError without a pattern that its technology needs."""
    code = capture_pattern(capture)
    if isinstance(code, AmplitudeModulation):
        return PlainImage(tuple(range(code.count)), "the light of the correlations", False, 2**capture.bits - 1)
    if not isinstance(code, LightCode):
        return PlainImage((0,), "the first frame", True)
    kinds = [role.kind for role in roles(code, *projector_size(capture))]
    if "white" in kinds:
        return PlainImage((kinds.index("white"),), "the white image", False)
    coded = tuple(number for number, kind in enumerate(kinds) if kind in _CODED)
    return PlainImage(coded, "the brightest levels of the code's images", False)


def median_level(counts: NDArray[Any]) -> float:
    """Return the median [DN] of a histogram, with the pixels of each level spread evenly over the level."""
    total = np.cumsum(counts)
    level = int(np.searchsorted(total, total[-1] / 2))
    below = total[level - 1] if level else 0
    return float(level - 0.5 + (total[-1] / 2 - below) / counts[level])
