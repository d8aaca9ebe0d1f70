"""Describe where the sigma of the points of structured light comes from.

With a complete ``[imager]``, sigma follows from its gain and read noise. Without one, fringes show their noise
themselves (:mod:`mitsim.decoding.structured_light.measured_noise`). A Gray code has the error of a stripe's width.
"""

from __future__ import annotations

import numpy as np

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.decoding.grey_levels import MeasuredNoise
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode, axes, has_fringes


def sigma_source(capture: Capture, cloud: PointCloud, noise: Imager | MeasuredNoise | None) -> str:
    """Return a sentence on the source of a structured-light cloud's sigma, or why it has none; "" for others."""
    if capture.technology != "structured_light" or not cloud.valid.any():
        return ""
    code = capture.decoding.pattern
    fringes = isinstance(code, LightCode) and any(has_fringes(code, axis) for axis in axes(code))
    if cloud.sigma is None or not np.isfinite(cloud.sigma[cloud.valid]).any():
        if not fringes:
            reason = "the errors of a Gray code between two cameras are not independent between pixels"
        elif noise is not None and capture.decoding.bracket_s is None:
            reason = "neighbours share pixels, so that the noise of their mean is not that of independent ones"
        elif capture.decoding.bracket_s is not None:
            reason = "it is not propagated through merged exposures"
        else:
            reason = (
                "the imager is not described, and the fringes have too few images to measure its noise: decode with "
                "--sensor and a file with a complete [imager]"
            )
        return f"sigma of the points: not known, {reason}"
    if isinstance(noise, MeasuredNoise) and fringes:
        level, deviation = noise.at_median_level
        return (
            f"sigma of the points: from the contrast of the fringes and the residuals of their fit, "
            f"{deviation:.2g} DN at a level of {level:.0f}, since the imager is not described"
        )
    return "" if noise is not None else "sigma of the points: that of a uniform error over the width of a stripe"
