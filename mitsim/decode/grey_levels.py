"""Grey levels of images: their noise, as an imager or the images themselves tell it, and their full scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from mitsim.sensor.imager import Imager


@dataclass(frozen=True)
class MeasuredNoise:
    """Variance [DN^2] of grey levels, at some rising ``levels`` [DN]; linear between, and constant beyond."""

    levels: NDArray[np.float64]
    variances: NDArray[np.float64]

    def variance(self, level: NDArray[np.floating]) -> NDArray[np.float32]:
        """Variance [DN^2] at levels (...) [DN]."""
        return np.asarray(np.interp(level, self.levels, self.variances), np.float32)

    @property
    def middle(self) -> tuple[float, float]:
        """Median level of those that were measured, and the standard deviation there [DN]."""
        level = float(np.median(self.levels))
        return level, float(np.sqrt(self.variance(np.array([level]))[0]))


def grey_level_variance(level: NDArray[np.float32], imager: Imager | MeasuredNoise | None) -> NDArray[np.float32]:
    """Variance [DN^2] of grey levels ``level`` (...) [DN]: EMVA 1288, as measured, or of quantisation alone.

    sigma^2 = K^2 (sigma_read^2 + sigma_row^2) + K (level - black level) + 1/12, with K the gain [DN/e-], for a straight
    response (gamma 1) and without the shot noise of dark current.
    """
    if imager is None:
        return np.full(level.shape, 1 / 12, np.float32)
    if isinstance(imager, MeasuredNoise):
        return imager.variance(level)
    dark = np.float32(imager.gain**2 * (imager.read_noise**2 + imager.row_noise**2) + 1 / 12)
    return np.asarray(np.maximum(level - np.float32(imager.black_level), 0) * np.float32(imager.gain) + dark)


def check_full_scale(stack: NDArray[np.generic], full_scale: float) -> None:
    """Refuse a full scale that the stack's type cannot show.

    Raises
    ------
    InputError
        If it is not over zero, or over the largest value of the type.
    """
    most = 2.0 ** (8 * stack.dtype.itemsize) - 1 if stack.dtype.kind == "u" else np.inf
    if not 0 < full_scale <= most or not np.isfinite(full_scale):
        raise InputError("image stack", "full_scale", full_scale, f"over 0, up to {most:g} DN")
