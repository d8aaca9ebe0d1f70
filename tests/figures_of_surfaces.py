"""Figures of lobes, heights and patterns with which tests compare."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsim.scene.surface.coherence import EVEN_FROM
from mitsim.scene.surface.microfacet import Distribution


def lobe_factor(numbers: tuple[float, float, float], mean_cosine: ArrayLike) -> NDArray[np.float64]:
    """Return h [1] of pairs of directions; ``mean_cosine`` is the mean of their cosines to the normal, any shape."""
    u = np.maximum(1 - np.asarray(mean_cosine, float) / EVEN_FROM, 0.0)
    return np.asarray(np.maximum(1 + u**2 * (numbers[0] + u * (numbers[1] + u * numbers[2])), 0.0))


def alpha_of_half_width(width: float, distribution: Distribution) -> float:
    """Return alpha [1] of the lobe whose D(m) falls to half at ``width`` [rad].

    D(width) = D(0) / 2 in closed form: with h = cos^-4(width), tan^2 = alpha^2 (sqrt(2 h) - 1) for GGX and
    alpha^2 ln(2 h) for Beckmann.
    """
    h = np.cos(width) ** -4.0
    q = np.sqrt(2 * h) - 1 if distribution == "ggx" else np.log(2 * h)
    return float(np.tan(width) / np.sqrt(q))


def short_wave_height(sigma_um: float, correlation_um: float, nu: float, longest_um: float) -> float:
    """Return Rq [um] of a Matern surface from spatial wavelengths below ``longest_um`` only."""
    return float(sigma_um * (1 + (2 * np.pi * correlation_um / longest_um) ** 2) ** (-nu / 2))


def mean_run_length(image: NDArray[np.floating], threshold: NDArray[np.floating] | float) -> float:
    """Return the mean length [px] of bright and dark runs along the rows of an image (H, W)."""
    bright = np.asarray(image > threshold)
    changes = np.count_nonzero(bright[:, 1:] != bright[:, :-1])
    return float(bright.size / max(changes + bright.shape[0], 1))
