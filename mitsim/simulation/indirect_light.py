"""Light by way of other surfaces, smoothed: much of its noise taken out for a little of its sharpness.

Signal chain: direct light at many samples, which has no noise -> the same with later surfaces at a few samples, less
its direct light -> what came by way of other surfaces, noisy -> Gaussian over the pixels of one shape -> both added.

A phase is read from small differences of images, so that the noise of a few light paths moves it, and moves it one way:
of 18 fringe images at 4 paths a pixel, pillars of Ra 0.37 came out as wrong again by half as light paths beyond number
make them. Mean over a pixel and its neighbours is what light that two rough surfaces have scattered may bear; what a
surface mirrors sharply it would blur, so keep ``smoothing_px`` small.
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
    """How light by way of other surfaces is rendered: ``samples`` per pixel, ``smoothing_px`` standard deviation."""

    samples: int
    smoothing_px: float


def smoothed(light: Images, shape: NDArray[np.integer], sigma: float) -> Images:
    """Images (P, h, w) smoothed by ``sigma`` [px], each pixel with those that show the same shape (h, w), -1 nothing.

    Sums are not kept at edges, where a mean over fewer pixels is taken.
    """
    taps = point_spread(sigma)
    out = light.copy()
    for index in np.unique(shape[shape >= 0]):
        mask = shape == index
        weight = _blurred(mask.astype(np.float32), taps)
        for image, one in zip(out, light, strict=True):
            image[mask] = _blurred(np.where(mask, one, np.float32(0)), taps)[mask] / weight[mask]
    return out


def _blurred(image: Images, taps: NDArray[np.float64]) -> Images:
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_CONSTANT), np.float32)
