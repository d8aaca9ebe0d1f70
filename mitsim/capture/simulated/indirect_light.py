"""Smooth rendered interreflections: much less noise for a little less sharpness.

Signal chain: direct light at many samples, free of noise; interreflections alone at few samples, noisy -> Gaussian
filter over the pixels of one shape -> sum of both.

A phase is computed from small differences of images, so the noise of a few light paths biases it. In 18 fringe images
at 4 paths per pixel, the error of pillars of Ra 0.37 um was 1.5 times the error with very many paths.

The filter suits light that two rough surfaces have scattered. It would blur sharp mirror images, so keep
``smoothing_px`` small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from mitsim.sensor.point_spread import point_spread

Images = NDArray[np.float32]


@dataclass(frozen=True)
class IndirectLight:
    """Settings for interreflections that are rendered separately.

    ``samples`` per pixel; ``smoothing_px``: standard deviation of the filter [px].
    """

    samples: int
    smoothing_px: float


@dataclass(frozen=True)
class KeptSettings:
    """Number of paths of interreflected light that serve all finishes, for each pixel that sees the part.

    - ``samples``: camera paths, a square number.
    - ``photons``: for each of them.
    - ``kept``: paths that are evaluated for every finish.
    - ``smoothing_px``: standard deviation of the filter [px].
    - ``most_pixels``: of more pixels, each has fewer paths, at least one, and the filter is as much wider: the light
      has the same noise, and is as sharp relative to the part. None for no limit.
    """

    samples: int
    photons: float
    kept: int
    smoothing_px: float
    most_pixels: int | None = None

    def for_pixels(self, count: int) -> KeptSettings:
        """Return the settings for a number of pixels that see the part."""
        if self.most_pixels is None or count <= self.most_pixels:
            return self
        share = self.most_pixels / count
        samples, kept = math.isqrt(int(share * self.samples)) ** 2, round(share * self.kept)
        smoothing_px = self.smoothing_px / math.sqrt(share)
        return replace(self, samples=max(1, samples), kept=max(1, kept), smoothing_px=smoothing_px)


@dataclass(frozen=True)
class Smoothing:
    """Gaussian filter over the pixels of each shape of an image, prepared for any number of images.

    ``parts`` are the region of each shape with its mask and the filtered mask.
    """

    taps: NDArray[np.float64]
    parts: tuple[tuple[tuple[slice, slice], NDArray[np.bool_], Images], ...]

    @classmethod
    def of(cls, shape: NDArray[np.integer], sigma: float) -> Smoothing:
        """Return the filter of a standard deviation [px] for an index (h, w) of the shapes, -1 for none."""
        taps, parts = point_spread(sigma), []
        for index, box in enumerate(find_objects(np.asarray(shape) + 1)):
            if box is None:
                continue
            mask = shape[box] == index
            parts.append((box, mask, _filtered(mask.astype(np.float32), taps)[mask]))
        return cls(taps, tuple(parts))

    @property
    def bytes(self) -> int:
        """Memory that it needs."""
        return sum(mask.nbytes + weight.nbytes for _, mask, weight in self.parts)

    def apply(self, image: Images) -> None:
        """Smooth an image (h, w) in place; pixels outside the shapes are not changed."""
        for box, mask, weight in self.parts:
            part = image[box]
            part[mask] = _filtered(np.where(mask, part, np.float32(0)), self.taps)[mask] / weight


def smoothed(light: Images, shape: NDArray[np.integer], sigma: float) -> Images:
    """Return images (P, h, w) smoothed by a Gaussian of ``sigma`` [px], each pixel with others of the same shape.

    ``shape`` (h, w) is an index, -1 for none; such pixels are not changed. At the edge of a shape the mean is over
    fewer pixels, so sums are not preserved.
    """
    smoothing, out = Smoothing.of(shape, sigma), light.copy()
    for image in out:
        smoothing.apply(image)
    return out


def _filtered(image: Images, taps: NDArray[np.float64]) -> Images:
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_CONSTANT), np.float32)
