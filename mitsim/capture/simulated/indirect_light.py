"""Smooth rendered interreflections: much less noise for a little less sharpness.

Signal chain: direct light at many samples, free of noise; interreflections alone at few samples, noisy -> Gaussian
filter over the pixels of one shape -> sum of both.

A phase is computed from small differences of images, so the noise of a few light paths biases it. In 18 fringe images
at 4 paths per pixel, the error of pillars of Ra 0.37 um was 1.5 times the error with very many paths.

The filter suits light that two rough surfaces have scattered. It would blur sharp mirror images, so keep
``smoothing_px`` small.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.point_spread import point_spread

Images = NDArray[np.float32]


@dataclass(frozen=True)
class IndirectLight:
    """Settings for interreflections that are rendered separately.

    ``samples`` per pixel; ``smoothing_px``: standard deviation of the filter [px].
    """

    samples: int
    smoothing_px: float


def smoothed(light: Images, shape: NDArray[np.integer], sigma: float) -> Images:
    """Return images (P, h, w) smoothed by a Gaussian of ``sigma`` [px], each pixel with others of the same shape.

    ``shape`` (h, w) is an index, -1 for none; such pixels are not changed. At the edge of a shape the mean is over
    fewer pixels, so sums are not preserved.
    """
    taps = point_spread(sigma)
    out = light.copy()
    for index in np.unique(shape[shape >= 0]):
        mask = shape == index
        weight = _filtered(mask.astype(np.float32), taps)
        for image, source in zip(out, light, strict=True):
            image[mask] = _filtered(np.where(mask, source, np.float32(0)), taps)[mask] / weight[mask]
    return out


def _filtered(image: Images, taps: NDArray[np.float64]) -> Images:
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_CONSTANT), np.float32)
