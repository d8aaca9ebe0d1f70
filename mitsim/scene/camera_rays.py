"""A camera prepared for tracing: from a place in the image and in the lens to a ray.

Signal chain: pixel -> direction in the camera frame (OpenCV's model, exact at pixel corners) -> point on the plane of
sharp focus -> ray from a place in the aperture toward it.

The camera is any smooth map from pixels to rays: the kernel sees directions at pixel corners and interpolates inside
the pixel (error under 3e-4 px for the strongest distortion of our presets, in the corners of the image). A thin lens
in focus at depth z_f images a point at depth z as a disc of diameter D f |1/z - 1/z_f| px.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.errors import InputError
from mitsim.scene.backend import dr, mi
from mitsim.scene.distortion import Distortion
from mitsim.sensor.camera import Camera


@dataclass(frozen=True)
class Window:
    """Part of an image: columns ``column`` to ``column + width``, rows ``row`` to ``row + height`` [px]."""

    column: int
    row: int
    width: int
    height: int


class CameraRays:
    """A camera whose ray table lies on the device, and is laid there once.

    ``aperture_mm`` diameter of the entrance pupil, 0 for a pinhole; ``focus_mm`` depth of the plane of sharp focus.
    """

    def __init__(self, camera: Camera, aperture_mm: float = 0.0, focus_mm: float = np.inf) -> None:
        if aperture_mm < 0 or not focus_mm > 0:
            raise InputError("camera", "aperture_mm, focus_mm", (aperture_mm, focus_mm), "0 or more; over 0")
        columns, rows = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
        rays = camera.rays(np.stack([columns, rows], axis=-1))
        self.camera = camera
        self.bend = Distortion(camera)
        self.aperture_mm, self.focus_mm = float(aperture_mm), float(focus_mm)
        self.x = mi.Float(np.ravel(rays[..., 0] / rays[..., 2]).astype(np.float32))
        self.y = mi.Float(np.ravel(rays[..., 1] / rays[..., 2]).astype(np.float32))

    @property
    def whole(self) -> Window:
        """The whole image."""
        return Window(0, 0, self.camera.width, self.camera.height)

    def corners(self, column: Any, row: Any) -> tuple[list[Any], list[Any]]:
        """Ideal image points x/z and y/z at the four corners of pixels."""
        corner = row * (self.camera.width + 1) + column
        below = corner + self.camera.width + 1
        places = [corner, corner + 1, below, below + 1]
        return [dr.gather(mi.Float, self.x, p) for p in places], [dr.gather(mi.Float, self.y, p) for p in places]


def between(corners: list[Any], a: Any, b: Any) -> Any:
    """Bilinear between a pixel's four corners, (a, b) in the unit square from the upper left."""
    return dr.lerp(dr.lerp(corners[0], corners[1], a), dr.lerp(corners[2], corners[3], a), b)


def pixel_area(x: list[Any], y: list[Any]) -> Any:
    """Area of a pixel on the plane z = 1, from its four corners: half the cross product of its diagonals."""
    return 0.5 * dr.abs((x[3] - x[0]) * (y[2] - y[1]) - (x[2] - x[1]) * (y[3] - y[0]))


@lru_cache(maxsize=32)
def lens_places(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places (2, count) in the unit discs of camera and projector lens, one pair for each cell of a pixel's raster.

    Vogel's sunflower spiral (Math. Biosciences 44, 1979): equal areas for all. Opposite cells have opposite places, so
    that place in the pixel and places in the lenses together are symmetric about the middle: defocus blurs a pattern
    but does not shift it. Of many shuffles the one is taken in which the three are least correlated: what is left of
    the second moments would widen or narrow the blur.
    """
    half, side = count // 2, round(np.sqrt(count))
    i = np.arange(half)
    radius, angle = np.sqrt((i + 0.5) / max(half, 1)), i * np.pi * (3.0 - np.sqrt(5.0))
    spiral = radius * np.stack([np.cos(angle), np.sin(angle)])
    cells = (np.stack([i % side, i // side]) - 0.5 * (side - 1)) / (0.5 * side)
    rng = np.random.default_rng(count)

    def shuffles(number: int) -> NDArray[np.float64]:
        order = rng.permuted(np.broadcast_to(i, (number, half)), axis=1)
        signs = rng.choice([-1.0, 1.0], (number, half))
        return np.moveaxis(spiral[:, order] * signs, 0, 1)

    def correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((np.einsum("...ai,...bi->...ab", first, second) ** 2).sum(axis=(-2, -1)))

    number = max(256, 400_000 // max(half, 1))
    camera = shuffles(number)
    camera = camera[np.argsort(correlation(camera, cells))[: max(16, number // 100)]]
    projector = shuffles(number)
    projector = projector[np.argsort(correlation(projector, cells))[: max(16, number // 100)]]
    both = correlation(camera[:, None], projector[None])
    both += correlation(camera, cells)[:, None] + correlation(projector, cells)[None]
    one, other = np.unravel_index(np.argmin(both), both.shape)

    def whole(part: NDArray[np.float64]) -> NDArray[np.float32]:
        return np.concatenate([part, np.zeros((2, count % 2)), -part[:, ::-1]], axis=1).astype(np.float32)

    return whole(camera[one]), whole(projector[other])
