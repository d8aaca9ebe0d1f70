"""Model the loss of light toward the corners of an image, of cameras and projectors alike.

Signal chain: illumination of the farthest corner, given or by the cos^4 law -> squared distance of every pixel from the
principal point -> relative illumination of every pixel.

A lens without vignetting follows the cos^4 law: with tan(theta) = r / f, its relative illumination is
cos^4(theta) = 1 / (1 + (r/f)^2)^2 (Born & Wolf, Principles of Optics, section 4.8). Real lenses lose more or, if
designed for it, less. Scaling the focal length in the law gives one parameter, the illumination c of the farthest
corner:

    I(rho) = 1 / (1 + q rho^2)^2,     q = c^(-1/2) - 1,     rho = distance from the principal point / of that corner

Theta is the angle behind the lens, between the axis and the light from the exit pupil to the pixel. r is measured in
the distorted image. The exit pupil is assumed one focal length in front of the imager. The angle in front of the lens
is not used: with distortion it belongs to another r, and the light on a pixel also depends on the local stretch of the
image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera


def cos4_corner(camera: Camera) -> float:
    """Return the illumination [1] of a camera's farthest corner by the cos^4 law."""
    fx, fy = camera.matrix.diagonal()[:2]
    return float((1.0 + _farthest_squared(camera) / (fx * fy)) ** -2)


def camera_illumination(corner: float | None, camera: Camera) -> NDArray[np.float32] | None:
    """Return the illumination (H, W) of a camera's pixels relative to the principal point [1], None for no loss.

    It is a factor on electrons or on a projector's light. ``corner`` is that of the farthest corner [1]; None, for an
    unknown lens, is the cos^4 law. Raises InputError for a corner outside 0 (excluded) to 1.
    """
    corner = cos4_corner(camera) if corner is None else corner
    if not 0 < corner <= 1:
        raise InputError("lens", "corner_illumination", corner, "over 0, up to 1")
    if corner == 1.0:
        return None
    q = (corner**-0.5 - 1.0) / _farthest_squared(camera)
    return np.asarray((1.0 + q * _radius_squared(camera)) ** -2, np.float32)


def off_axis_squared(camera: Camera) -> NDArray[np.float32]:
    """Return rho^2 (H, W) of a camera's pixels [1]: 0 at the principal point, 1 in the farthest corner."""
    return np.asarray(_radius_squared(camera) / _farthest_squared(camera), np.float32)


def _radius_squared(camera: Camera) -> NDArray[np.float64]:
    """Return the squared distances (H, W) [px^2] of a camera's pixels from the principal point."""
    cx, cy = camera.matrix[:2, 2]
    return np.asarray((np.arange(camera.width) - cx) ** 2 + ((np.arange(camera.height) - cy) ** 2)[:, None])


def _farthest_squared(camera: Camera) -> float:
    """Return the squared distance [px^2] of the farthest corner pixel from the principal point."""
    cx, cy = camera.matrix[:2, 2]
    return float(max(cx, camera.width - 1 - cx) ** 2 + max(cy, camera.height - 1 - cy) ** 2)
