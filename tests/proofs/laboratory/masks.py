"""Make masks of random dots with the statistics of a preset, by a way of the laboratory's own.

Signal chain: random phases and amplitudes of a Gaussian spectrum -> inverse Fourier transform, which is Gaussian noise
with the autocorrelation exp(-tau^2 / 4 s^2) -> threshold -> blur in the Fourier domain by exp(-s^2 (1 - cos w)): that
of the discrete Gaussian in whose terms presets state their blur. The mean run length of such noise is pi sqrt(2) s
(Rice 1944).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.pattern import RandomDots


def another_mask(pattern: RandomDots, width: int, height: int, seed: int) -> NDArray[np.float32]:
    """Return the frames (F, height, width) of another realisation of a pattern of random dots, values 0..1."""
    shifts = pattern.shifts_px or [(0.0, 0.0)]
    rows, columns = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    squared = (2 * np.pi) ** 2 * (rows**2 + columns**2)
    sigma = pattern.run_length_px / (np.pi * np.sqrt(2))
    noise = np.fft.rfft2(np.random.default_rng([seed, 77]).standard_normal((height, width)))
    smooth = np.fft.irfft2(noise * np.exp(-0.5 * sigma**2 * squared), (height, width))
    spectrum = np.fft.rfft2((smooth > np.quantile(smooth, 1 - pattern.bright_share)).astype(float))
    spectrum *= np.exp(pattern.blur_px**2 * (np.cos(2 * np.pi * rows) + np.cos(2 * np.pi * columns) - 2))
    frames = [
        np.fft.irfft2(spectrum * np.exp(-2j * np.pi * (columns * right + rows * down)), (height, width))
        for right, down in shifts
    ]
    return np.clip(frames, 0, 1).astype(np.float32)
