"""Describe the grey levels of images: their noise, known from the imager or measured, and their full scale.

Signal chain: grey level [DN] -> its variance [DN^2].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.imager import Imager
from mitsim.sensor.point_spread import kept_variance


@dataclass(frozen=True)
class MeasuredNoise:
    """Variance of grey levels as a function of the level, measured in images."""

    levels: NDArray[np.float64]  # (n,) increasing [DN]
    variances: NDArray[np.float64]  # (n,) [DN^2]; linear between the levels, and constant beyond them

    def variance(self, level: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the variance [DN^2] at levels (...) [DN]."""
        return np.asarray(np.interp(level, self.levels, self.variances), np.float32)

    @property
    def at_median_level(self) -> tuple[float, float]:
        """Median of the measured levels, and the standard deviation there [DN]."""
        level = float(np.median(self.levels))
        return level, float(np.sqrt(self.variance(np.array([level]))[0]))


def with_dark_noise(
    imager: Imager | MeasuredNoise | None, exposures_s: tuple[float, ...]
) -> Imager | MeasuredNoise | None:
    """Return an imager with the shot noise of its dark current as read noise; unknown with several exposures [s]."""
    if not isinstance(imager, Imager) or len(exposures_s) != 1 or imager.dark_current == 0:
        return imager
    dark = imager.dark_current * exposures_s[0]
    return replace(imager, read_noise=float(np.sqrt(imager.read_noise**2 + dark)), dark_current=0.0)


def grey_level_variance(level: NDArray[np.float32], imager: Imager | MeasuredNoise | None) -> NDArray[np.float32]:
    """Return the variance (...) [DN^2] of grey levels (...) [DN].

    For an imager it follows from the linear camera model of EMVA Standard 1288:

        sigma^2 = s^2 K^2 sigma_read^2 + s K^2 sigma_row^2 + s^2 K (level - black level) + 1/12

    with the gain K [DN/e-], and s the sum of the squared weights by which the device smooths along each axis. A curved
    response multiplies all but 1/12 by the square of its slope. The shot noise of dark current must be part of the read
    noise (:func:`with_dark_noise`). Measured noise is interpolated. If ``imager`` is None the variance is that of
    quantisation, 1/12.
    """
    if imager is None:
        return np.full(level.shape, 1 / 12, np.float32)
    if isinstance(imager, MeasuredNoise):
        return imager.variance(level)
    kept = kept_variance(imager.smoothing_px)  # 1 without smoothing
    read, row = kept**2 * imager.read_noise**2, kept * imager.row_noise**2
    if imager.gamma != 1:
        span = imager.full_scale - imager.black_level
        share = np.clip((level - imager.black_level) / span, 1 / span, 1)  # from 1 DN on, where its slope is finite
        variance = imager.gain**2 * (read + row) + kept**2 * imager.gain * span * share**imager.gamma
        slope = share ** (1 - imager.gamma) / imager.gamma
        return np.asarray(variance * slope**2 + 1 / 12, np.float32)
    dark = np.float32(imager.gain**2 * (read + row) + 1 / 12)
    return np.asarray(np.maximum(level - np.float32(imager.black_level), 0) * np.float32(kept**2 * imager.gain) + dark)


def check_full_scale(stack: NDArray[np.generic], full_scale: float) -> None:
    """Reject a full scale [DN] not over 0, or above the largest value of the stack's type, by an InputError."""
    largest = 2.0 ** (8 * stack.dtype.itemsize) - 1 if stack.dtype.kind == "u" else np.inf
    if not 0 < full_scale <= largest or not np.isfinite(full_scale):
        raise InputError("image stack", "full_scale", full_scale, f"over 0, up to {largest:g} DN")
