"""Dots of an unknown pattern against those of the sensor file: how strong they are, and how sharp.

Signal chain: pixels of a view, over the low-passed light of the projector -> less the mean of their block -> variance
V and mean square difference G of neighbours, both less the imager's noise. The same of one frame of the file's
pattern, blurred by a Gaussian of width b on the image.

G / V falls as dots grow blurrier and knows nothing of how bright they are: it gives b. Then the ratio of the V's is the
square of the projector's relative power times the albedo. No light of the room is in it, as there is none in dots; but
all of the pattern's contrast is: run length, bright share, black level, blur.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import fourier_gaussian
from scipy.optimize import brentq

from mitsim.fit.observation import Floats, View
from mitsim.fit.white_coupon import Bench, coupon_roi

#: blurs [px] that are tried
_LARGEST_BLUR = 4.0


@dataclass(frozen=True)
class Dots:
    """The dots of one view, recorded against those of the sensor file.

    ``contrast`` rms over the local mean [1] as recorded, of all light; ``file_contrast`` of the file's pattern alone;
    ``blur_px`` by which these must be blurred to be as sharp as recorded, 0 if the recorded ones are sharper still;
    ``power`` relative, times the albedo, by the strength of the dots. The last two are NaN where there are none.
    """

    camera: str
    contrast: float
    file_contrast: float
    blur_px: float
    power: float


def compare_dots(view: View, bench: Bench) -> Dots:
    """Hold the dots of a view (its ``unit`` light low-passed) against the first frame of the sensor's own pattern."""
    camera = bench.sensor.rig.cameras[view.camera]
    roi = coupon_roi(camera, view.place)
    spectrum = np.fft.fft2(bench.white(view.place, view.camera, roi, "first") * view.exposure_s)
    rows, columns = view.rows - roi.top, view.columns - roi.left
    pairs, none = _neighbours(view), np.zeros(len(view.unit))

    def own(blur: float) -> Floats:
        # by its spectrum: a Gaussian that is sampled at whole pixels is too narrow under half a pixel
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


def _strength(view: View, values: Floats, noise: Floats, pairs: NDArray[np.int64]) -> tuple[float, float]:
    """Variance V inside the blocks, and G / V; ``noise`` the variance of each pixel, taken off."""
    off = values - view.means(values)[view.block]
    # a block's own mean takes one degree of freedom
    lost = 1.0 - view.size / len(values)
    variance = float(np.mean(off**2)) / lost - float(np.mean(noise))
    first, second = pairs
    difference = float(np.mean((off[first] - off[second]) ** 2 - noise[first] - noise[second]))
    return variance, difference / variance


def _neighbours(view: View) -> NDArray[np.int64]:
    """Pixels (2, K) that lie side by side in one block."""
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
