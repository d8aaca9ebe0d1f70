"""Figures of lobes, heights and patterns with which tests compare."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from mitsim.scene.surface.coherence import EVEN_FROM
from mitsim.scene.surface.microfacet import Distribution, slope_density


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


def half_width(alpha: float, distribution: Distribution) -> float:
    """Return the angle from the mean normal [rad] at which D(m) has fallen to half its value there.

    Raises
    ------
    ValueError
        For a lobe so wide that D never falls to half before it rises again towards grazing normals.
    """
    # D rises again towards grazing normals, so the first fall is bracketed on a grid
    angles = np.linspace(0, np.pi / 2 - 1e-3, 2000)
    density = slope_density((np.tan(angles) / alpha) ** 2, distribution) / np.cos(angles) ** 4
    below = np.flatnonzero(density < 0.5)
    if not len(below):
        raise ValueError(f"a {distribution} lobe of alpha {alpha:g} has no half width")

    def excess(angle: float) -> float:
        return float(slope_density((np.tan(angle) / alpha) ** 2, distribution) / np.cos(angle) ** 4 - 0.5)

    return float(brentq(excess, 0.0, angles[below[0]], xtol=1e-12))


def short_wave_height(sigma_um: float, correlation_um: float, nu: float, longest_um: float) -> float:
    """Return Rq [um] of a Matern surface from spatial wavelengths below ``longest_um`` only."""
    return float(sigma_um * (1 + (2 * np.pi * correlation_um / longest_um) ** 2) ** (-nu / 2))


def mean_run_length(image: NDArray[np.floating], threshold: NDArray[np.floating] | float) -> float:
    """Return the mean length [px] of bright and dark runs along the rows of an image (H, W)."""
    bright = np.asarray(image > threshold)
    changes = np.count_nonzero(bright[:, 1:] != bright[:, :-1])
    return float(bright.size / max(changes + bright.shape[0], 1))
