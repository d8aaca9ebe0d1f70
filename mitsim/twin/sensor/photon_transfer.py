"""Measure gain, read noise and fixed pattern of an imager by photon transfer (EMVA Standard 1288, 4.0, section 6).

Signal chain, repeats of one pose: grey levels -> electrons of the sensor file, its response curve inverted -> mean and
variance of every pixel over the images -> bins of similar mean -> weighted line. If the file states a full well W and
the imager has W', file electrons are kappa = W / W' of the true ones, and

    v = kappa mu + kappa^2 r^2 + q^2 / 12,        q the grey level's width in file electrons

so the slope gives the full well, and the intercept the read noise r, including row noise. If the bins lie on a parabola
instead, as with light that differs between the images, its slope and intercept at mu = 0 do.

Fixed pattern: mean of the images -> finest detail (:mod:`mitsim.twin.finish.fine_detail`), which uniform light and
lenses do not produce -> its variance less v / n -> dsnu^2 + (prnu mu)^2. A single image gives the sum of both: its
finest detail by level is the same line, including the fixed pattern.

The variance of a bin's v from N pixels and n images is 2 v^2 / (N (n - 1)). For finest detail, N counts a third because
its weights extend over neighbours, and the median of squares has an efficiency of 0.37.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from characterisation.files.arrays import Floats
from mitsim.sensor.imager import Imager
from mitsim.sensor.point_spread import kept_variance, point_spread
from mitsim.twin.finish.electrons import linearised
from mitsim.twin.finish.fine_detail import FINEST, level_variances

#: number of bins by local mean; chosen
_BINS = 24

#: least distance of a pixel of repeated images from either end of the grey levels [standard deviations]; chosen
_CLEAR_SIGMAS = 4.0

#: least distance of the level of a bin of one image from either end of the grey levels [DN]; chosen
_CLEAR_DN = 4.0

#: side [px] of the local mean around a pixel
_AROUND_PX = 3

#: least number of bins for a line; chosen
_FEWEST = 3

#: least ratio of their largest and smallest means, which tells the slope from the offset; chosen
_SPAN = 1.3

#: standard uncertainties under 0 that an offset may lie by chance, and a slope over 0
_BY_CHANCE = 3.0

#: standard uncertainties of a square term from which the line is a parabola, whose slope at 0 counts; chosen
_CURVED_SIGMAS = 4.0

#: least variance of a pixel's levels over the repeats [DN^2], 1/12 of it by rounding: with less noise than 0.29 DN,
#: rounding is mostly a fixed pattern
_LEAST_TEMPORAL = 1 / 6

#: least variance of all levels of a bin [DN^2], 1/12 of it by rounding: from a spread of 0.5 DN on, rounding adds 1/12
#: to 3 % of the rest, wherever between two grey levels the mean lies
LEAST_SPREAD = 1 / 3

#: least range of the levels of a bin [DN] beside that: it holds all places between two grey levels
_LEAST_RANGE = 1.0

#: efficiency of the median of squares against their mean (chi-square of one degree of freedom, recalled)
_MEDIAN_EFFICIENCY = 0.37


@dataclass(frozen=True)
class TransferLine:
    """Variance of the noise v = ``offset`` + ``slope`` mu in file electrons, about mu = 0; ``covariance`` (2, 2)."""

    offset: float
    slope: float
    covariance: Floats

    def full_well(self, imager: Imager) -> tuple[float, float]:
        """Return the full well [e-] and its standard uncertainty."""
        value = imager.full_well / self.slope
        return value, value * float(np.sqrt(self.covariance[1, 1])) / self.slope

    def over(self, factor: float) -> TransferLine:
        """The line of variances that are smaller by a factor."""
        return TransferLine(self.offset / factor, self.slope / factor, self.covariance / factor**2)

    def not_negative(self) -> TransferLine:
        """The line through 0 where its offset is negative by chance: the slope that is expected given an offset of 0.

        An offset further under 0 than three standard uncertainties stays: the line does not fit.
        """
        spread = float(np.sqrt(self.covariance[0, 0]))
        if not -_BY_CHANCE * spread < self.offset < 0:
            return self
        share = self.covariance[0, 1] / self.covariance[0, 0]
        slope, variance = self.slope - share * self.offset, self.covariance[1, 1] - share * self.covariance[0, 1]
        return replace(self, offset=0.0, slope=float(slope), covariance=np.diag([spread**2, float(variance)]))

    def read_noise(self) -> tuple[float, float]:
        """Return the read noise [true e-] and its standard uncertainty; 0 for a negative intercept."""
        variance = max(self.offset, 0.0) / self.slope**2
        gradient = np.array([1 / self.slope**2, -2 * self.offset / self.slope**3])
        spread = float(np.sqrt(gradient @ self.covariance @ gradient))
        value = float(np.sqrt(variance))
        return value, spread / (2 * value) if value > 0 else float(np.sqrt(spread))


def widths(levels: Floats, chip: Imager) -> Floats:
    """Return the width of a grey level in electrons at levels (...) [DN]."""
    below, above = linearised(np.asarray(levels - 0.5), chip), linearised(np.asarray(levels + 0.5), chip)
    return np.asarray(above - below)


@dataclass(frozen=True)
class Repeats:
    """Grey levels (n, N) of N pixels in n images of one light, and the local mean ``around`` (N,) used for binning.

    Binning by a pixel's own mean would bias the variance: pixels of few images that are equal by chance have none.
    """

    levels: NDArray[np.unsignedinteger[Any]]
    around: Floats

    @classmethod
    def of(cls, images: NDArray[np.unsignedinteger[Any]], mask: NDArray[np.bool_], pixels: int) -> Repeats:
        """Take up to ``pixels`` of the pixels ``mask`` of images (n, H, W)."""
        around = uniform_filter(images.mean(axis=0), _AROUND_PX)
        step = max(1, int(mask.sum()) // pixels)
        rows, columns = (axis[::step] for axis in np.nonzero(mask))
        return cls(images[:, rows, columns], around[rows, columns])


def repeated_line(repeats: list[Repeats], chip: Imager) -> TransferLine | None:
    """Return the photon-transfer line from repeats of one or more lights; None with too few levels.

    Smoothing by the device, with weights w along each axis, multiplies the variance by (sum w^2)^2, which is undone. It
    correlates neighbours by rho: n pixels tell as much of a variance as n / (sum rho^2)^2 independent ones.
    """
    weights, rows = point_spread(chip.smoothing_px), []
    kept = kept_variance(chip.smoothing_px)
    dependent = float(((np.convolve(weights, weights[::-1]) / kept) ** 2).sum()) ** 2
    for group in repeats:
        clear = _CLEAR_SIGMAS * float(np.sqrt(group.levels.var(axis=0, ddof=1).mean()))
        inside = (group.around > clear) & (group.around < chip.full_scale - clear)
        bins = _bins(Repeats(group.levels[:, inside], group.around[inside]), chip)
        rows += [(level, noise, dependent * spread) for level, noise, spread in bins]
    line = _line(rows)
    return None if line is None else line.over(kept**2)


def one_image_line(
    image: NDArray[np.unsignedinteger[Any]], mask: NDArray[np.bool_], chip: Imager
) -> TransferLine | None:
    """Return the line of the finest detail of one image (H, W), or of a mean, in pixels ``mask`` without a pattern.

    The fixed pattern counts as noise, and a smoothed image has too little noise. None for a single level.
    """
    electrons = linearised(image, chip)
    levels, variances, counts = level_variances(electrons, mask)
    rows, every = [], np.arange(chip.full_scale + 1.0)
    for level, variance, count in zip(levels, variances, counts, strict=True):
        shown = float(np.interp(level, linearised(every, chip), every))
        if not _CLEAR_DN < shown < chip.full_scale - _CLEAR_DN:
            continue
        step = float(widths(np.array(shown), chip)) ** 2
        if variance < LEAST_SPREAD * step:
            continue
        rounding = step / 12
        spread = 2 * variance**2 / (count * _MEDIAN_EFFICIENCY * independent_share())
        rows.append((level, variance - rounding, spread))
    return _line(rows)


def dithered(levels: NDArray[np.unsignedinteger[Any]], around: Floats) -> bool:
    """Return whether rounding is noise of 1/12 DN^2 in the levels (n, N) of n repeats, with local means (N,) [DN].

    It is not where noise and range are small against a grey level: most images are then equal.
    """
    over_repeats, every = float(levels.var(axis=0, ddof=1).mean()), float(levels.var())
    return over_repeats >= _LEAST_TEMPORAL and (every >= LEAST_SPREAD or float(np.ptp(around)) >= _LEAST_RANGE)


def independent_share() -> float:
    """Return the share of the pixels of finest detail that count as independent for its variance: 1 / sum of rho^2."""
    along = np.correlate(FINEST, FINEST, "full")
    return float(1 / (along**2).sum() ** 2)


def fixed_variance(
    images: NDArray[np.unsignedinteger[Any]], mask: NDArray[np.bool_], chip: Imager, gain: float = 1.0
) -> tuple[float, float, float]:
    """Return mean level [e-], variance [e-^2] of the fixed pattern in uniform light, and its uncertainty.

    ``images`` are (n, H, W) repeats [DN]. The smoothing of the imager is undone, by the ``gain`` of the variance of the
    finest detail, after it over before it.
    """
    electrons = linearised(images, chip)
    mean = electrons.mean(axis=0)
    temporal = float(electrons.var(axis=0, ddof=1)[mask].mean()) / kept_variance(chip.smoothing_px) ** 2
    levels, variances, counts = level_variances(mean, mask)
    # weights by estimated variances would favour bins that are small by chance
    level, total = (float((counts * values).sum() / counts.sum()) for values in (levels, variances / gain))
    spread = np.sqrt(2 / (counts.sum() * _MEDIAN_EFFICIENCY * independent_share())) * total
    left = 2 / (mask.sum() * (len(images) - 1)) * temporal**2 / len(images) ** 2
    return level, total - temporal / len(images), float(np.sqrt(spread**2 + left))


def _bins(repeats: Repeats, chip: Imager) -> list[tuple[float, float, float]]:
    """Return mean, variance without rounding, and the variance of that, for bins of similar local mean."""
    level, freedom = repeats.around, len(repeats.levels) - 1
    if len(level) < _BINS:
        return []
    edges = np.quantile(level, np.linspace(0, 1, _BINS + 1))
    where = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, _BINS - 1)
    rows = []
    for index in range(_BINS):
        members = where == index
        levels, around = repeats.levels[:, members], level[members]
        if members.sum() < 2 or not dithered(levels, around):
            continue
        electrons = linearised(levels, chip)
        cut = float((widths(around, chip) ** 2).mean()) / 12
        variance = float(electrons.var(axis=0, ddof=1).mean())
        rows.append((float(electrons.mean()), variance - cut, 2 * variance**2 / (freedom * float(members.sum()))))
    return rows


def _line(rows: list[tuple[float, float, float]]) -> TransferLine | None:
    if len(rows) < _FEWEST:
        return None
    mu, v, spread = (np.array(column) for column in zip(*rows, strict=True))
    if mu.max() < _SPAN * max(mu.min(), 1e-9):
        return None
    (offset, slope), covariance = _weighted(mu, v, spread, 2)
    if len(rows) > _FEWEST:  # light that differs between repeats (speckle, flicker) adds a share of mu^2
        (at_0, slope_at_0, square), wider = _weighted(mu, v, spread, 3)
        if abs(square) > _CURVED_SIGMAS * np.sqrt(wider[2, 2]):
            offset, slope, covariance = at_0, slope_at_0, wider
    spread_0, slope_spread = np.sqrt(np.diag(covariance)[:2])
    if not slope > _BY_CHANCE * slope_spread or offset < -_BY_CHANCE * spread_0:
        return None
    return TransferLine(float(offset), float(slope), covariance[:2, :2])


def _weighted(mu: Floats, v: Floats, spread: Floats, terms: int) -> tuple[Floats, Floats]:
    """Return the coefficients (terms,) of v = c_0 + c_1 mu + ..., and their covariance; ``spread``: variances of v."""
    design = mu[:, None] ** np.arange(terms)
    expected = np.maximum(v, 1e-12)
    for _ in range(3):  # the variance of a bin follows from the line, not from its own random value
        weight = design / spread[:, None]
        scale = 1 / np.sqrt(np.einsum("ij,ij->j", weight, design))
        covariance = np.linalg.inv((weight.T @ design) * np.outer(scale, scale)) * np.outer(scale, scale)
        found = covariance @ (weight.T @ v)
        before, expected = expected, np.maximum(design @ found, 1e-12)
        spread = spread * (expected / before) ** 2
    return np.asarray(found), np.asarray(covariance)
