"""The random pattern of an active-stereo projector.

Signal chain: white noise -> Gaussian low pass -> threshold at the quantile that leaves the wanted share bright ->
blur of the projection lens. The result is smooth blobs, as in recordings of the makers' own projectors, not cells.

For Gaussian noise filtered with standard deviation s the autocorrelation is exp(-tau^2 / 4 s^2), and a threshold at
the median is crossed 1 / (pi s sqrt 2) times per pixel (Rice 1944), so the mean run length is pi sqrt(2) s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

#: mean run length of thresholded Gaussian noise per standard deviation of its filter
RUN_LENGTH_PER_SIGMA = np.pi * np.sqrt(2.0)


def random_blobs(
    width: int, height: int, run_length_px: float, bright_share: float, blur_px: float, seed: int
) -> NDArray[np.float32]:
    """One pattern (height, width) of values 0..1.

    ``run_length_px`` mean length of a bright or dark run along a row, in projector pixels, before the blur;
    ``blur_px`` standard deviation of the lens's point spread, in projector pixels.
    """
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    smooth = gaussian_filter(noise, run_length_px / RUN_LENGTH_PER_SIGMA, mode="wrap")
    binary = (smooth > np.quantile(smooth, 1.0 - bright_share)).astype(np.float32)
    return np.asarray(gaussian_filter(binary, blur_px, mode="wrap")) if blur_px > 0 else binary


def mean_run_length(image: NDArray[np.floating], threshold: NDArray[np.floating] | float) -> float:
    """Mean length [px] of bright and dark runs along the rows of an image (H, W)."""
    bright = np.asarray(image > threshold)
    changes = np.count_nonzero(bright[:, 1:] != bright[:, :-1])
    return float(bright.size / max(changes + bright.shape[0], 1))
