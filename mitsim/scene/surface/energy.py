"""Compensate the energy that a single-scattering lobe loses.

Light that bounces twice between facets is missing from ``roughconductor``: a wide lobe of a perfect mirror returns less
than it receives. The directional albedo E(theta, alpha) of that mirror is the share returned. The factor
1 + F0 (1 - E) / E on the lobe restores the rest with the metal's colour of two bounces (Turquin, "Practical multiple
scattering compensation for microfacet models", 2019; recalled, not re-read). The factor is one number for each lobe, at
a nominal incidence of 30 deg, because E falls slowly up to 60 deg.

    E(i) = integral of P(s) (i_z - i_x sx - i_y sy) / i_z  G1(i) G1(o) F ds,     o = i mirrored at the facet
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN, Distribution, fresnel, shadowing

#: incidence at which the compensation is exact [rad]
NOMINAL_INCIDENCE = float(np.radians(30))

#: facets of the quadrature: radii and azimuths of their slopes, and one azimuth of the light, since a round lobe has
#: the same albedo at all
_COUNTS = (300, 96, 1)

#: the same for an elongated lobe, whose albedo is averaged over azimuths of the light. Its error is 1e-4
_ELONGATED_COUNTS = (150, 48, 4)


@lru_cache(maxsize=4096)
def directional_albedo(
    incidence: float,
    alpha_u: float,
    alpha_v: float,
    distribution: Distribution,
    index: tuple[float, float] | None = None,
) -> float:
    """Return the share [1] of light that a lobe returns, averaged over the light's azimuth.

    The quadrature uses midpoints in the cumulative distribution of the slopes, so it covers the whole tail.

    ``incidence``: of the light [rad]. ``alpha_u``, ``alpha_v``, ``distribution``: of the lobe. ``index``: n and k of
    the material [1]; None for a perfect mirror.
    """
    counts = _COUNTS if alpha_u == alpha_v else _ELONGATED_COUNTS
    weights, _ = facets(incidence, alpha_u, alpha_v, distribution, counts, index)
    return float(weights.sum())


def facets(
    incidence: float,
    alpha_u: float,
    alpha_v: float,
    distribution: Distribution,
    counts: tuple[int, int, int],
    index: tuple[float, float] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each facet's share [1] of the light, and the cosine of its exit angle; (n,) each.

    The sum of the shares is the :func:`directional_albedo`.

    ``incidence``, ``alpha_u``, ``alpha_v``, ``distribution``, ``index``: as for :func:`directional_albedo`. ``counts``:
    numbers of the facets' radii and azimuths, and of azimuths of the light for an elongated lobe.
    """
    radii, azimuths, several = counts
    # an isotropic lobe needs one azimuth, and half of the facets, as the others are their mirror images; an elongated
    # one is symmetric in both its axes
    isotropic = alpha_u == alpha_v
    slope_u, slope_v = _unit_slopes(radii, azimuths, isotropic and azimuths % 2 == 0, distribution)
    sx, sy = alpha_u * slope_u, alpha_v * slope_v
    views = [0.0] if isotropic else np.pi / 2 * (np.arange(several) + 0.5) / several
    lobe = _Lobe(alpha_u, alpha_v, distribution, index)
    seen = [_facets_from(incidence, view, sx, sy, lobe) for view in views]
    weights, cosines = (np.concatenate([pair[k].ravel() for pair in seen]) for k in (0, 1))
    return weights / weights.size, cosines


@lru_cache(maxsize=16)
def _unit_slopes(
    radii: int, azimuths: int, half: bool, distribution: Distribution
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return slopes along u and v [1] of a lobe of width 1, each of equal weight; ``half``: of those with v > 0."""
    share = (np.arange(radii) + 0.5) / radii
    radius = np.sqrt(-np.log1p(-share)) if distribution == "beckmann" else np.sqrt(share / (1 - share))
    turn = 2 * np.pi * (np.arange(azimuths // 2 if half else azimuths) + 0.5) / azimuths
    slopes = radius[:, None] * np.cos(turn), radius[:, None] * np.sin(turn)
    for slope in slopes:
        slope.setflags(write=False)
    return slopes


@dataclass(frozen=True)
class _Lobe:
    """A microfacet lobe: widths along u and v, distribution of its slopes, (n, k) or None for a perfect mirror."""

    alpha_u: float
    alpha_v: float
    distribution: Distribution
    index: tuple[float, float] | None


def _facets_from(
    incidence: float, azimuth: float, sx: NDArray[np.float64], sy: NDArray[np.float64], lobe: _Lobe
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.sin(incidence) * np.cos(azimuth), np.sin(incidence) * np.sin(azimuth)
    z = np.cos(incidence)
    facing = z - x * sx - y * sy  # i.m / cos(theta_m), the facet's normal being (-sx, -sy, 1) cos(theta_m)
    steepness = 1 + sx * sx + sy * sy
    scale = 2 * facing / steepness
    out_x, out_y, out_z = -sx * scale - x, -sy * scale - y, scale - z
    seen = (facing > 0) & (out_z > 0)
    tangent_out = np.sqrt((lobe.alpha_u * out_x) ** 2 + (lobe.alpha_v * out_y) ** 2) / np.where(seen, out_z, 1.0)
    weight = np.where(seen, facing / z, 0.0) * shadowing(tangent_out, lobe.distribution)
    if lobe.index is not None:
        weight = weight * fresnel(np.clip(facing / np.sqrt(steepness), 0, 1), *lobe.index)
    weight = weight * shadowing(np.hypot(lobe.alpha_u * x, lobe.alpha_v * y) / z, lobe.distribution)
    return weight, np.where(seen, out_z, 0.0)


def compensation(alpha_u: float, alpha_v: float, distribution: Distribution, reflectance: float) -> float:
    """Return the factor [1] that restores a lobe's lost energy: 1 / E for a perfect mirror, 1 for a black surface.

    ``alpha_u``, ``alpha_v``, ``distribution``: of the lobe. ``reflectance``: F0 at normal incidence [1].
    """
    kept = directional_albedo(NOMINAL_INCIDENCE, alpha_u, alpha_v, distribution)
    return 1 + reflectance * (1 - kept) / kept


def energy_factors(alpha_u: float, alpha_v: float, reflectance: float) -> tuple[float, float]:
    """Return the compensation of the GGX and of the Beckmann lobe [1] of one surface; alphas in Beckmann's sense."""
    return (
        compensation(GGX_PER_BECKMANN * alpha_u, GGX_PER_BECKMANN * alpha_v, "ggx", reflectance),
        compensation(alpha_u, alpha_v, "beckmann", reflectance),
    )
