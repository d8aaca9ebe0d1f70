"""A camera's lens that blurs: evenly, or more and more away from its axis.

Signal chain: image before the lens -> Gaussian point spreads of a few widths -> of every pixel, what lies between the
two nearest to its own variance, linear in the variance.

Of the aberrations of third order coma grows with the distance from the axis, astigmatism and field curvature with its
square (Born & Wolf, Principles of Optics, section 5.3). The standard deviation that is added is taken to grow like
coma's:

    s^2(rho) = s_0^2 + (s_c^2 - s_0^2) rho^2,     rho = distance from the principal point / of the farthest corner

A Gaussian blur of a fine step in variance is that of the heat equation, so interpolating linearly between blurs whose
variances differ by d is exact to second order in d.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.roi import Roi
from mitsim.sensor.vignetting import off_axis_squared

#: columns that are filtered together
_BLOCK_PX = 64

#: steps of the variance between the middle and the farthest corner
_STEPS = 6


def through_point_spread(image: NDArray[np.float32], imager: Imager, camera: Camera, roi: Roi) -> NDArray[np.float32]:
    """Blur the image (h, w) of a region by the point spread of a camera's lens."""
    middle, corner = imager.blur_px, imager.corner_blur_px
    if corner is None or corner == middle:
        return blurred(image, middle) if middle > 0 else image
    along = off_axis_squared(camera)[roi.slices] * _STEPS
    variances = np.linspace(middle**2, corner**2, _STEPS + 1)
    first, last = int(np.floor(along.min())), min(int(np.ceil(along.max())), _STEPS)
    out = np.zeros(image.shape, np.float32)
    for step in range(first, last + 1):
        weight = np.maximum(1 - np.abs(along - step), 0).astype(np.float32)
        sigma = float(np.sqrt(variances[step]))
        out += weight * (blurred(image, sigma) if sigma > 0 else image)
    return out


def blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """An image (H, W) through a lens of a point spread of ``sigma`` [px]; mirrored at its rim."""
    kernel = point_spread(sigma)
    reach, width = len(kernel) // 2, image.shape[1]
    # whole blocks of columns: OpenCV rounds the last few otherwise, and a part would differ from the whole
    columns = -(-(width + reach) // _BLOCK_PX) * _BLOCK_PX
    wide = cv2.copyMakeBorder(image, 0, 0, 0, columns - width, cv2.BORDER_REFLECT)
    cv2.sepFilter2D(wide, -1, kernel, kernel, dst=wide, borderType=cv2.BORDER_REFLECT)
    return np.asarray(wide[:, :width], np.float32)
