"""Measure the noise of a sensor on a matt-white plate: residuals along V as a picture, and their distribution.

Slide *Noise Distributions*: residuals are "predominantly gaussian, although some fringe projection sensors can be sums
of gaussians". Each sensor's residuals are described by one normal distribution, and by a sum of two with one mean. The
second has two parameters more; it is needed if Bayes's information criterion prefers it, with as many observations as
there are independent points, and if it also halves the distance of the distribution from the measured one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import stats

from characterisation.files.arrays import Floats
from characterisation.region_of_interest import Roi
from mitsim.maps.data_sheet import Residuals, SheetPiece, measure_piece
from mitsim.talk.talk_file import sensor_in

#: bins of the histogram: an odd number, so that one lies about 0; chosen
_BINS = 61

#: ends of the histogram, in standard deviations; chosen
_REACH = 4.5

#: largest side of the picture of residuals [px]
_SIDE_PX = 150

#: steps of the expectation maximisation; chosen
_STEPS = 200

#: about the largest number of points that it uses, which bounds its time; chosen
_MOST_POINTS = 40_000


@dataclass(frozen=True)
class TwoNormals:
    """Sum of two normal distributions about 0: standard deviations [mm], the smaller first, and the second's share."""

    narrow: float
    wide: float
    share: float

    def density(self, values: Floats) -> Floats:
        """Return the density [1/mm] at values [mm]."""
        return self._sum(stats.norm.pdf, values)

    def distribution(self, values: Floats) -> Floats:
        """Return the distribution function at values [mm]."""
        return self._sum(stats.norm.cdf, values)

    def _sum(self, of: Callable[..., Floats], values: Floats) -> Floats:
        return (1 - self.share) * of(values, 0, self.narrow) + self.share * of(values, 0, self.wide)


def two_normals(values: Floats) -> TwoNormals:
    """Return the sum of two normal distributions about 0 that fits values best, by expectation maximisation.

    (Dempster, Laird and Rubin, J. R. Stat. Soc. B 39 (1977) 1-38.)
    """
    square = values**2
    spread = math.sqrt(float(square.mean()))
    mixture = TwoNormals(0.7 * spread, 1.6 * spread, 0.3)
    for _ in range(_STEPS):
        wide = mixture.share * stats.norm.pdf(values, 0, mixture.wide)
        odds = wide / np.maximum(mixture.density(values), 1e-300)
        share = float(odds.mean())
        if not 1e-6 < share < 1 - 1e-6:
            break
        narrow = math.sqrt(float(((1 - odds) * square).sum() / (1 - odds).sum()))
        mixture = TwoNormals(narrow, math.sqrt(float((odds * square).sum() / odds.sum())), share)
    return mixture


def noise_of(folder: str, sensor: str, seed: int) -> xr.Dataset:
    """Return the residuals of a sensor on matt white at the middle of its range.

    ``image`` (row, column) [mm], thinned; ``histogram`` (edge to edge) as density [mm^-1]. Attributes: ``sigma`` [mm],
    ``kurtosis`` (excess), ``skewness``, ``independent`` points, ``narrow``, ``wide`` [mm] and ``share`` of the sum of
    two normals, ``distance_one`` and ``distance_two``, largest differences of the distribution functions, and ``two``,
    whether the sum is needed.
    """
    chosen = sensor_in(folder, sensor)
    near, far = chosen.working_range_mm
    residuals: Residuals = measure_piece(SheetPiece(chosen, seed, "residuals", (math.sqrt(near * far),)))
    values = residuals.values - residuals.values.mean()
    sigma = float(values.std())
    edges = np.linspace(-_REACH * sigma, _REACH * sigma, _BINS + 1)
    counts, _ = np.histogram(values, edges)
    two = two_normals(values[:: max(1, len(values) // _MOST_POINTS)])
    ordered = np.sort(values)
    measured = (np.arange(len(ordered)) + 0.5) / len(ordered)
    models = (stats.norm.cdf(ordered, 0, sigma), two.distribution(ordered))
    apart = [float(np.abs(measured - model).max()) for model in models]
    densities = (stats.norm.pdf(values, 0, sigma), two.density(values))
    likelihoods = [float(np.log(np.maximum(density, 1e-300)).mean()) for density in densities]
    gain = 2 * residuals.independent * (likelihoods[1] - likelihoods[0]) - 2 * math.log(max(residuals.independent, 1))
    region = Roi.around(np.isfinite(residuals.image))
    assert region is not None
    cut = residuals.image[region.slices]
    step = max(1, -(-max(cut.shape) // _SIDE_PX))
    width = edges[1] - edges[0]
    return xr.Dataset(
        {
            "image": (("row", "column"), cut[::step, ::step].astype(np.float32), {"units": "mm"}),
            "histogram": ("interval", counts / (len(values) * width), {"units": "1/mm"}),
            "middle": ("interval", (edges[1:] + edges[:-1]) / 2, {"units": "mm"}),
        },
        attrs={
            "distance_mm": residuals.distance,
            "sigma": sigma,
            "kurtosis": residuals.excess_kurtosis,
            "skewness": residuals.skewness,
            "correlation_px": residuals.correlation_px,
            "independent": residuals.independent,
            "narrow": two.narrow,
            "wide": two.wide,
            "share": two.share,
            "distance_one": apart[0],
            "distance_two": apart[1],
            "two": int(gain > 0 and apart[1] < apart[0] / 2),
        },
    )
