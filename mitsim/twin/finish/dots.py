"""Compare strength and sharpness of the dots of an unknown pattern with those of the sensor file.

Signal chain: pixels of a view, divided by the low-passed light of the projector -> minus the mean of their block ->
variance V, and mean square difference G of neighbours, both minus the imager's noise -> blur b and relative power. The
same quantities are computed for one frame of the file's pattern, blurred by a Gaussian of standard deviation b [px].

G / V decreases with the blur and does not depend on the brightness, so it gives b. Then the ratio of the two variances
V is the square of the relative power times the albedo. Uniform light of the room has no influence on it. But the
contrast of the file's pattern has: run length, bright share, black level, blur.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import fourier_gaussian
from scipy.optimize import brentq

from characterisation.files.arrays import Floats
from mitsim.twin.finish.observation import CouponView
from mitsim.twin.finish.white_coupon import WhiteCouponRenderer, coupon_roi

#: largest blur [px]
_LARGEST_BLUR = 4.0


@dataclass(frozen=True)
class Dots:
    """Recorded dots of one view against those of the sensor file; NaN ``blur_px`` and ``power`` without dots."""

    camera: str
    contrast: float  # recorded rms over the mean [1], in all light
    file_contrast: float  # that of the file's pattern alone
    blur_px: float  # blur [px] with which the file's dots are as sharp as the recorded ones, 0 if these are sharper
    power: float  # relative power times the albedo [1], from the strength of the dots


def compare_dots(view: CouponView, renderer: WhiteCouponRenderer) -> Dots:
    """Compare the dots of a ``level`` view, whose ``unit`` light has none, with the first frame of the sensor's own."""
    camera = renderer.sensor.rig.cameras[view.camera]
    roi = coupon_roi(camera, view.specimen)
    spectrum = np.fft.fft2(renderer.white(view.specimen, view.camera, roi, "first") * view.exposure_s)
    rows, columns = view.rows - roi.top, view.columns - roi.left
    pairs, none = _neighbours(view), np.zeros(len(view.unit))

    def own(blur: float) -> Floats:
        # in the frequency domain: a Gaussian sampled at whole pixels is too narrow below half a pixel
        image = np.fft.ifft2(fourier_gaussian(spectrum, blur)).real
        return np.asarray(image[rows, columns] / view.unit)

    recorded, sharpness = _strength(
        view, view.electrons / view.unit, view.noise.variance(view.electrons) / view.unit**2, pairs
    )
    sharp, level = _strength(view, own(0.0), none, pairs)[0], float(np.mean(own(0.0)))
    if recorded <= 0 or sharp <= 0:
        return Dots(view.camera, 0.0, float(np.sqrt(max(sharp, 0.0))) / level, float("nan"), float("nan"))

    def excess(blur: float) -> float:
        return _strength(view, own(blur), none, pairs)[1] - sharpness

    blur = 0.0
    if excess(0.0) > 0:
        blur = float(brentq(excess, 0.0, _LARGEST_BLUR, xtol=1e-3)) if excess(_LARGEST_BLUR) < 0 else _LARGEST_BLUR
    return Dots(
        view.camera,
        float(np.sqrt(recorded) / np.mean(view.electrons / view.unit)),
        float(np.sqrt(sharp)) / level,
        blur,
        float(np.sqrt(recorded / _strength(view, own(blur), none, pairs)[0])),
    )


def _strength(view: CouponView, values: Floats, noise: Floats, pairs: NDArray[np.int64]) -> tuple[float, float]:
    """Return the variance V inside the blocks, and G / V, both without ``noise``, the variance of each pixel (N,)."""
    off = values - view.means(values)[view.block]
    # the mean of a block uses one degree of freedom
    lost = 1.0 - view.size / len(values)
    variance = float(np.mean(off**2)) / lost - float(np.mean(noise))
    first, second = pairs
    difference = float(np.mean((off[first] - off[second]) ** 2 - noise[first] - noise[second]))
    return variance, difference / variance


def _neighbours(view: CouponView) -> NDArray[np.int64]:
    """Return the indices (2, K) of neighbouring pixels in one block."""
    low_row, low_column = view.rows.min(), view.columns.min()
    index = np.full((view.rows.max() - low_row + 2, view.columns.max() - low_column + 2), -1)
    index[view.rows - low_row, view.columns - low_column] = np.arange(len(view.rows))
    pairs = []
    for beside in (index[1:, :-1], index[:-1, 1:]):
        here = index[:-1, :-1]
        both = (here >= 0) & (beside >= 0)
        pairs.append(np.stack([here[both], beside[both]]))
    joined = np.concatenate(pairs, axis=1)
    return np.asarray(joined[:, view.block[joined[0]] == view.block[joined[1]]])
