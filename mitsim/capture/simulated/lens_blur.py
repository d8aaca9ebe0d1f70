"""Blur an image as a camera's lens does: evenly, or increasingly away from its axis.

Signal chain: image before the lens -> Gaussian blurs of a few widths -> at each pixel, linear interpolation in the
variance between the two nearest to its own.

Of the third-order aberrations, coma grows with the distance from the axis. Astigmatism and field curvature grow with
its square (Born and Wolf, Principles of Optics, section 5.3). The additional standard deviation is *assumed* to grow
like coma:

    s^2(rho) = s_0^2 + (s_c^2 - s_0^2) rho^2,     rho = distance from the principal point / of the farthest corner

s_0 is the standard deviation at the principal point, s_c that in the corner. Gaussian blurs of growing variance solve
the heat equation. Linear interpolation between blurs whose variances differ by d therefore has an error of second order
in d.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.vignetting import off_axis_squared

#: width of the blocks of columns that OpenCV filters
_BLOCK_PX = 64

#: number of intervals of the variance between the centre and the farthest corner
_STEPS = 6


def blur_by_lens(image: NDArray[np.float32], imager: Imager, camera: Camera, roi: Roi) -> NDArray[np.float32]:
    """Return the image (h, w) of a region, blurred by the point spread of a camera's lens.

    Parameters
    ----------
    image, imager
        (h, w) radiance of the region; the blur at the centre and in the corner of the image.
    camera, roi
        Camera whose image has the region, and region of the camera's image.
    """
    centre, corner = imager.blur_px, imager.corner_blur_px
    if corner is None or corner == centre:
        return gaussian_blur(image, centre) if centre > 0 else image
    position = off_axis_squared(camera)[roi.slices] * _STEPS
    variances = np.linspace(centre**2, corner**2, _STEPS + 1)
    first, last = int(np.floor(position.min())), min(int(np.ceil(position.max())), _STEPS)
    out = np.zeros(image.shape, np.float32)
    for step in range(first, last + 1):
        weight = np.maximum(1 - np.abs(position - step), 0).astype(np.float32)
        sigma = float(np.sqrt(variances[step]))
        out += weight * (gaussian_blur(image, sigma) if sigma > 0 else image)
    return out


def gaussian_blur(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Return an image (H, W) blurred by a Gaussian of ``sigma`` [px] on whole pixels; mirrored at its border."""
    kernel = point_spread(sigma)
    reach, width = len(kernel) // 2, image.shape[1]
    # whole blocks of columns, because OpenCV rounds an incomplete block differently and a region would differ
    columns = -(-(width + reach) // _BLOCK_PX) * _BLOCK_PX
    padded = cv2.copyMakeBorder(image, 0, 0, 0, columns - width, cv2.BORDER_REFLECT)
    cv2.sepFilter2D(padded, -1, kernel, kernel, dst=padded, borderType=cv2.BORDER_REFLECT)
    return np.asarray(padded[:, :width], np.float32)
