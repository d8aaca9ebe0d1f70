"""The first knee of an imager's response curve, by the noise of one image over its levels.

Signal chain: image, printed or not -> the same without noise (:mod:`mitsim.validation.denoise`) -> pixels where the
print has no finest detail of its own -> variance of the finest detail by level, in bins of 2 DN -> a straight line,
against one that a companding curve bends at the level K. A pixel of level m has the variance

    v = a + b m + 1/12  below K,        v = g^2 (a + b (K + (m - K) / g)) + 1/12  above,        g = 1/2, 1/4 or 1/8

and finest detail that of its 25 pixels, each by the square of its weight: at the edge of a print they differ.

Photon noise grows with the level, so bright pixels that are quieter than dark ones show a curve that is flatter there.
Chips compand by steps of two ("hardware gamma": imagers of the MT9V03x family convert 12 bits to 10 so, data sheet; the
uEye manual says it of the cameras with them). Beyond the brightest level seen the curve is assumed to go on with g.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d
from scipy.optimize import nnls

from mitsim.fit.fine_detail import FINEST, finest_detail, noise_of_levels
from mitsim.sensor.imager import Imager
from mitsim.twin.photon_transfer import independent_share

Floats = NDArray[np.float64]

#: width of a bin [DN], pixels of one at least, bins on either side of a knee at least
_BIN_DN, _PIXELS, _BINS = 2.0, 40, 3

#: slopes beyond a knee, steps of its level [DN]; what a bin's variance may be off beside chance [1]
_SLOPES, _STEP_DN, _UNEVEN = (0.5, 0.25, 0.125), 0.5, 0.1

#: chi-square that a knee must gain: two more numbers, by chance once in 10^4
_GAIN = 18.4

#: the print's own finest detail that a pixel may have, in standard deviations of the noise
_QUIET = 0.5

#: median of chi-square with one degree of freedom, and the median's efficiency for a variance
_MEDIAN_SQUARE, _EFFICIENCY = 0.45493642311957283, 0.37


@dataclass(frozen=True)
class Knee:
    """A curve's first knee at ``level`` [DN], its standard ``uncertainty``, and the ``slope`` beyond it [1]."""

    level: float
    uncertainty: float
    slope: float

    def companding(self, bits: int) -> tuple[tuple[float, float], ...]:
        """Knees of the curve: straight to the knee, then with the slope to near full scale."""
        full = 2.0**bits
        near = full * (1 - 1 / 64)
        reached = self.level + (near - self.level) / self.slope
        last = 2.0 ** np.ceil(np.log2(reached + (full - near)))
        return (self.level, self.level), (reached, near), (float(last), full)


def quiet_pixels(image: Floats, clean: Floats, there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels ``there`` of an image (H, W) whose finest detail is noise and not the edge of a print.

    ``clean`` is the image without its noise.
    """
    own = finest_detail(clean) ** 2
    return there & (own < _QUIET**2 * np.maximum(noise_of_levels(image, there)(clean), 1e-12))


def first_knee(image: Floats, clean: Floats, quiet: NDArray[np.bool_], imager: Imager) -> Knee | None:
    """Find the first knee in the :func:`quiet_pixels` of an image [DN]; None if a straight curve explains its noise."""
    level, square = _of_neighbours(clean)[quiet], finest_detail(image)[quiet] ** 2
    number = np.floor(level / _BIN_DN).astype(int)
    counts = np.bincount(number.clip(0))
    used = np.flatnonzero(counts >= _PIXELS)
    if len(used) < 2 * _BINS + 1:
        return None
    variance = np.array([float(np.median(square[number == one])) / _MEDIAN_SQUARE for one in used])
    spread = 2 / (counts[used] * _EFFICIENCY * independent_share()) + _UNEVEN**2

    def chi_square(knee: float, slope: float) -> float:
        light = np.where(clean > knee, knee + (clean - knee) / slope, clean) - imager.black_level
        gain = np.where(clean > knee, slope**2, 1.0)
        maps = [_of_neighbours(gain)[quiet], _of_neighbours(gain * np.maximum(light, 0.0))[quiet]]
        design = np.stack([np.bincount(number.clip(0), values)[used] / counts[used] for values in maps], axis=1)
        return _chi_square(design, variance, spread)

    straight = chi_square(np.inf, 1.0)
    levels = np.arange(_BIN_DN * (used[_BINS] + 0.5), _BIN_DN * (used[-_BINS] + 0.5), _STEP_DN)
    tried = [(chi_square(float(level), slope), float(level), slope) for slope in _SLOPES for level in levels]
    if not tried or straight - min(tried)[0] < _GAIN:
        return None
    _, found, slope = min(tried)
    weight = np.array([np.exp((min(tried)[0] - one) / 2) if own == slope else 0.0 for one, _, own in tried])
    at = np.array([level for _, level, _ in tried])
    spread_of = float(np.sqrt((weight * (at - found) ** 2).sum() / weight.sum() + _STEP_DN**2 / 12))
    return Knee(found, spread_of, slope)


def _of_neighbours(values: Floats) -> Floats:
    """Mean (H, W) of the pixels about each by the squares of their weights in finest detail."""
    return np.asarray(correlate1d(correlate1d(values, FINEST**2, axis=0), FINEST**2, axis=1))


def _chi_square(design: Floats, variance: Floats, spread: Floats) -> float:
    """Chi-square of variances (n,) about the best a and b, none of them negative; ``spread`` relative variances."""
    expected = np.maximum(variance, 1 / 12)
    for _ in range(4):
        weight = 1 / (np.sqrt(spread) * expected)
        found = nnls(design * weight[:, None], (variance - 1 / 12) * weight)[0]
        expected = np.maximum(design @ found, 0.0) + 1 / 12
    return float(((variance / expected - 1) ** 2 / spread).sum())
