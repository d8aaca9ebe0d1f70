"""Fit the shape of mitsim's BSDF to measured surfaces, and the priors of that shape to the fitted surfaces.

Signal chain: BRDF in the plane of incidence -> wide-angle share, tail, alpha and lay of each surface -> spread of the
surfaces about mitsim's best estimates for their processes -> one-sigma factors, with intervals.

    f = R [ (1 - w) (1 - A) s lobe(alpha, b) + w / pi ]

R is the reflected share, A the mirror-like share, w the wide-angle share, b the Beckmann share of the lobe. Angles
within 3 deg of the mirror direction are left out: there the instrument and the mirror-like part decide. The factor s is
1 for a round lobe, whose missing light is then A. A lay across the plane concentrates the light in the plane by
s = alpha across / alpha along. Measurements in one plane cannot tell s from w well, so s has the prior of the process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import expit, logit
from scipy.stats import chi2

from mitsim.scene.surface.machined import FACTORS, machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN, Distribution, shadowing, slope_density
from mitsim.scene.surface.processes import LARGEST_WIDE_ANGLE, PROCESSES
from mitsim.scene.surface.roughness import ALPHA_LARGEST, stylus_slope
from mitsim.scene.surface.scatter import LARGEST_DEVIATION, Deviation
from tests.proofs.finishes.measured_surfaces import EXIT_DEG, LARGEST_INCIDENCE_DEG, MeasuredSurface

Floats = NDArray[np.float64]

#: angles from the mirror direction that are left out [rad]
_MIRROR = float(np.radians(3.0))

#: incidence below which the goniometer's BRDF falls to a third and less within 1 deg [rad]: the instrument shades the
#: light there, so these samples are not used
_LEAST_INCIDENCE = float(np.radians(4.0))

#: least share of light at wide angles that counts [1]; less cannot be told from none
LEAST_SHARE = 1e-3

#: one-sigma factor of s in a fit, about that of the process
_LAY_FACTOR = 1.8


@dataclass(frozen=True)
class FittedShape:
    """Shape of one surface: shares [1], ``alpha`` [1], ``lay``: alpha along over alpha across [1].

    ``least``, ``most``: wide-angle share of the fits to small and to large exit angles alone. ``bound``: largest
    wide-angle share, as no direction is darker than the matt part. ``misfit``: rms of the logarithm of the BRDF.
    ``kept``: share of the other light that is in the lobe, not in the mirror-like part.
    """

    surface: MeasuredSurface
    wide_angle: float
    least: float
    most: float
    bound: float
    tail: float
    alpha: float
    lay: float
    misfit: float
    kept: float

    @property
    def determined(self) -> bool:
        """Return whether the plane determines the wide-angle share of a process: it lies below the largest share."""
        return self.surface.process is not None and self.bound < LARGEST_WIDE_ANGLE


@dataclass(frozen=True)
class Factor:
    """A one-sigma factor with its 95 % interval, from ``count`` surfaces."""

    value: float
    low: float
    high: float
    count: int

    def __str__(self) -> str:
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f}, {self.count} surfaces)"


def lobe(incidence: Floats, leaving: Floats, alpha: float, distribution: Distribution) -> Floats:
    """Return D G / (4 cos i cos o) [1/sr] of a round lobe in the plane of incidence, without Fresnel's factor."""
    half = (leaving - incidence) / 2
    density = slope_density((np.tan(half) / alpha) ** 2, distribution) / (np.pi * alpha**2 * np.cos(half) ** 4)
    shadow = shadowing(alpha * np.tan(incidence), distribution) * shadowing(alpha * np.tan(leaving), distribution)
    return np.asarray(density * shadow / (4 * np.cos(incidence) * np.cos(leaving)))


def model(numbers: Floats, incidence: Floats, leaving: Floats) -> Floats:
    """Return f / R [1/sr] for (logit w, logit of the light in the lobe, logit b, log alpha, log s)."""
    wide, kept, tail = expit(numbers[:3])
    alpha, concentrated = np.exp(numbers[3:])
    shape = _mixed(tail, alpha, incidence, leaving)
    return np.asarray((1 - wide) * kept * concentrated * shape + wide / np.pi)


def _mixed(tail: float, alpha: float, incidence: Floats, leaving: Floats) -> Floats:
    beckmann = lobe(incidence, leaving, alpha, "beckmann")
    return np.asarray(tail * beckmann + (1 - tail) * lobe(incidence, leaving, GGX_PER_BECKMANN * alpha, "ggx"))


def fit_shape(surface: MeasuredSurface) -> FittedShape:
    """Fit the shape of a surface."""
    used = np.isclose(np.degrees(surface.exit)[:, None], EXIT_DEG).any(axis=1)
    used &= (surface.incidence <= np.radians(LARGEST_INCIDENCE_DEG)) & (surface.incidence >= _LEAST_INCIDENCE)
    bound = float(np.min(np.pi * surface.brdf[used] / surface.reflected[used]))
    used &= np.abs(surface.incidence - surface.exit) > _MIRROR
    numbers = _fit(surface, used, bound)
    steep = surface.exit > np.radians(35)
    parts = sorted(float(expit(_fit(surface, used & side, bound)[0])) for side in (steep, ~steep))
    predicted = model(numbers, surface.incidence[used], surface.exit[used]) * surface.reflected[used]
    return FittedShape(
        surface,
        float(expit(numbers[0])),
        parts[0],
        parts[1],
        min(bound, 1.0),
        float(expit(numbers[2])),
        float(np.exp(numbers[3])),
        float(np.exp(-numbers[4])),
        float(np.sqrt(np.mean(np.log(predicted / surface.brdf[used]) ** 2))),
        float(expit(numbers[1])),
    )


def _fit(surface: MeasuredSurface, used: NDArray[np.bool_], most: float) -> Floats:
    """Return the numbers of :func:`model` for the samples of ``used``; ``most`` bounds the wide-angle share."""
    incidence, leaving = surface.incidence[used], surface.exit[used]
    wanted = np.log(surface.brdf[used] / surface.reflected[used])
    ratio = PROCESSES[surface.process].lay_ratio if surface.process and surface.across_lay else 1.0
    numbers = np.array([0.0, 30.0, 0.0, 0.0, -np.log(ratio)])
    # a lay hides the mirror-like share, and a blasted face has none: all the light is then in the lobe
    free = [0, 2, 3] + ([4] if ratio < 1 else [] if surface.process == "grit_blasted" else [1])
    low = np.array([logit(LEAST_SHARE), -9.0, -6.0, np.log(0.005), 0.0])
    high = np.array([logit(min(most, 0.99)) + 1e-6, 9.0, 6.0, np.log(ALPHA_LARGEST), np.log(30.0)])
    weight = _RESIDUAL * np.sqrt(used.sum()) / np.log(_LAY_FACTOR)

    def residual(values: Floats) -> Floats:
        numbers[free] = values
        off = np.log(model(numbers, incidence, leaving)) - wanted
        return np.append(off, weight * (numbers[4] + np.log(ratio)) * (ratio < 1))

    starts = ((-4.0, -2.0, 0.05), (-1.0, -2.0, 0.2), (-2.0, 2.0, 0.2))
    found = []
    for share, tail, alpha in starts:
        start = np.clip([share, 0.0, tail, np.log(alpha), -np.log(ratio)], low + 1e-3, high - 1e-3)[free]
        bounds = (low[free], high[free])
        found.append(least_squares(residual, start, bounds=bounds, loss="soft_l1", f_scale=_RESIDUAL, max_nfev=200))
    numbers[free] = min(found, key=lambda one: float(one.cost)).x
    return numbers.copy()


#: residual of the logarithm of a BRDF beyond which a point counts less
_RESIDUAL = 0.3


def spread_of_shares(shapes: Sequence[FittedShape], more: Sequence[tuple[str, float]]) -> Factor:
    """Return the one-sigma factor of the wide-angle share about the best estimate of its process.

    The factor is that of the odds w / (0.6 - w). The Ra of the surfaces is unknown: the best estimate is the geometric
    mean over the usual Ra, and its change over that range counts as spread.

    Parameters
    ----------
    shapes
        Fitted surfaces; those whose share is not determined are left out.
    more
        Process and wide-angle share of further surfaces.
    """
    pairs = [(one.surface.process, one.wide_angle) for one in shapes if one.determined] + list(more)
    return factor_of([_log_odds(max(share, LEAST_SHARE)) - _log_odds(usual_share(name)) for name, share in pairs])


def spread_of_lays(shapes: Sequence[FittedShape], more: Sequence[tuple[str, float]]) -> Factor:
    """Return the one-sigma factor of the ratio of alphas about that of its process."""
    pairs = [(str(one.surface.process), one.lay) for one in shapes if one.surface.across_lay] + list(more)
    return factor_of([float(np.log(ratio / PROCESSES[name].lay_ratio)) for name, ratio in pairs])


def _log_odds(share: float) -> float:
    return float(np.log(share / (LARGEST_WIDE_ANGLE - share)))


def usual_share(process: str) -> float:
    """Return the best estimate of the wide-angle share [1] in the middle of the usual Ra of a process."""
    return PROCESSES[process].wide_angle.share(float(np.sqrt(np.prod(PROCESSES[process].usual))))


def factor_of(logs: Sequence[float]) -> Factor:
    """Return exp of the rms of some logarithms, whose mean is known to be 0, with its 95 % interval by chi-square."""
    square, count = float(np.sum(np.square(logs))), len(logs)
    rms = (np.sqrt(square / k) for k in (count, chi2.ppf(0.975, count), chi2.ppf(0.025, count)))
    return Factor(*(float(np.exp(one)) for one in rms), count)


def process_factor(roughness_um: float, wavelength_nm: float = 850.0) -> float:
    """Return the one-sigma factor of alpha at one Ra over the processes that usually give it."""
    logs = [
        np.log(machined(MachinedFace(process=name, Ra=roughness_um), wavelength_nm).alpha_u)
        for name, process in PROCESSES.items()
        if process.usual[0] <= roughness_um <= process.usual[1]
    ]
    return float(np.exp(np.std(logs, ddof=1)))


def roughness_factor(large: Floats, small: Floats) -> tuple[float, Factor, float]:
    """Return the exponent of small-scale roughness in Ra, the one-sigma factor of the rest, and half its central 68 %.

    Parameters
    ----------
    large, small
        Sa of all wavelengths and of those that scatter light, (n,) [um].
    """
    x, y = np.log(large), np.log(small)
    slope, offset = np.polyfit(x, y, 1)
    rest = y - slope * x - offset
    low, high = np.quantile(rest, [0.16, 0.84])
    return float(slope), factor_of(rest.tolist()), float(np.exp((high - low) / 2))


def energy_found(shape: FittedShape) -> float:
    """Return the light of a round surface as a share of the reflected light [1]: measured spike and fitted rest.

    The spike is the measured light within 3 deg of the mirror direction at an exit angle of 30 deg, less the fitted
    lobe and matt part, as if it were the same in all planes. A closed balance gives 1.
    """
    surface = shape.surface
    row = np.isclose(surface.exit, np.radians(30.0)) & (np.abs(surface.incidence - surface.exit) <= _MIRROR + 1e-6)
    away = np.abs(surface.incidence[row] - surface.exit[row])
    rest = (
        shape.kept * (1 - shape.wide_angle) * _mixed(shape.tail, shape.alpha, surface.incidence[row], surface.exit[row])
    )
    rest += shape.wide_angle / np.pi
    spike = surface.brdf[row] / surface.reflected[row] - rest
    order = np.argsort(away)
    ring = np.pi * np.cos(surface.incidence[row]) * np.abs(spike)[order] * np.sin(away)[order]
    inner = float(np.trapezoid(2 * ring, away[order]))
    return inner + shape.kept * (1 - shape.wide_angle) + shape.wide_angle


def peak_deg(shape: FittedShape, exit_deg: float) -> tuple[float, float]:
    """Return the incidence [deg], up to 80, at which the BRDF is largest: measured, and of the fitted model."""
    surface = shape.surface
    row = np.isclose(surface.exit, np.radians(exit_deg)) & (surface.incidence <= np.radians(80.0))
    incidence = surface.incidence[row]
    fitted = shape.kept * (1 - shape.wide_angle) * _mixed(shape.tail, shape.alpha, incidence, surface.exit[row])
    measured, modelled = (float(np.degrees(incidence[np.argmax(one)])) for one in (surface.brdf[row], fitted))
    return measured, modelled


#: angles off the mirror direction at which the prior is compared with a surface [deg], at an exit angle of 45 deg
OFF_MIRROR_DEG = (10.0, 20.0, 40.0)


def places_in_prior(surface: MeasuredSurface, draws: int = 2000, seed: int = 1) -> list[float]:
    """Return the share of drawn shapes that are darker than a surface, at each of :data:`OFF_MIRROR_DEG` [1].

    Ra is drawn evenly in its logarithm over the usual range of the process, as the surface's is unknown. Alpha is that
    of the slopes, without diffraction; no light is in a mirror-like part.
    """
    assert surface.process is not None
    process, rng = PROCESSES[surface.process], np.random.default_rng(seed)
    at_45 = np.isclose(surface.exit, np.radians(45.0))
    incidences = np.radians(45.0 - np.array(OFF_MIRROR_DEG))
    measured = [
        float((surface.brdf / surface.reflected)[at_45][np.argmin(np.abs(surface.incidence[at_45] - one))])
        for one in incidences
    ]
    numbers = np.clip(rng.standard_normal((draws, 4)), -LARGEST_DEVIATION, LARGEST_DEVIATION)
    heights = np.exp(rng.uniform(*np.log(process.usual), draws))
    darker = np.zeros(len(measured))
    for (alpha, wide, tail, lay), ra in zip(numbers.tolist(), heights.tolist(), strict=True):
        deviation = Deviation(alpha=alpha, wide_angle=wide, tail=tail, lay=lay)
        share = process.wide_angle.share(ra)
        width = min(stylus_slope(ra, surface.process) * FACTORS["process"] ** alpha, ALPHA_LARGEST)
        ratio = deviation.along(process.lay_ratio, 1.0) if surface.across_lay else 1.0
        share = deviation.share(share, process.wide_angle.range(ra))
        beckmann = np.clip(deviation.beckmann(process.beckmann, process.tail_range), 1e-9, 1 - 1e-9)
        drawn = np.array([logit(share), 30.0, logit(beckmann), np.log(width), -np.log(ratio)])
        darker += model(drawn, incidences, np.full(len(measured), np.radians(45.0))) < measured
    return (darker / draws).tolist()
