"""Find the first knee of an imager's response curve, from the noise of one image over its levels.

Signal chain: image -> the same without noise (:mod:`mitsim.twin.compare.denoise`) -> tiles of 32 px, and in them the
pixels whose finest detail is noise -> likelihood of the squared finest detail for a straight curve, and for curves with
a knee at K and the slope g beyond it -> K, and the uncertainty of K by a jackknife over the tiles. Its bias
by levels that still contain some noise is simulated and subtracted.

In the converter's levels u, noise has the variance s^2 = a + b (u - black). The curve takes u + z to

    x - (1 - g) max(x - K, 0),      x = u + z

With z normal, t = (u - K) / s, e1 = phi(t) + t Phi(t) and e2 = (1 + t^2) Phi(t) + t phi(t), a pixel has

    mean M(u) = u - (1 - g) s e1,      variance s^2 [1 - 2 (1 - g) Phi(t) + (1 - g)^2 (e2 - e1^2)] + 1/12

The chip rounds down behind its curve: with a knee of 80 DN in the sensor file, level 80 is the first that holds 1 / g
levels of the converter, from 79.5 on. So K is half a level under the file's knee. Finest detail is a sum over 25
pixels. Its variance is the mean of theirs by the squares of its weights: at an edge they differ.

Photon noise grows with the level. Bright pixels that are quieter than dark ones therefore show a curve that is flatter
there. Chips compand by steps of two (data sheets of the MT9V03x family: 12 bits to 10), so the first knee has g = 1/2;
other slopes are not tried. Levels beyond the brightest pixel are unknown; the curve is assumed to go on with g.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import ndtr

from characterisation.files.arrays import Floats
from mitsim.sensor.imager import Imager
from mitsim.twin.compare.denoise import denoised
from mitsim.twin.finish.fine_detail import FINEST, MEDIAN_SQUARE, finest_detail, noise_of_levels
from mitsim.twin.sensor.photon_transfer import independent_share

Mask = NDArray[np.bool_]

#: side of a tile [px]; chosen
_TILE_PX = 32

#: rim of a tile, which the five weights of finest detail reach [px]
_RIM_PX = 2

#: largest number of tiles, which bounds the time; chosen
_TILES = 120

#: least number of tiles with quiet pixels; chosen
_FEWEST = 8

#: slope beyond a knee; chips compand by steps of two
SLOPE = 0.5

#: coarse step of a knee's level [DN]; chosen
_COARSE_DN = 3.0

#: fine step of a knee's level [DN]; chosen
_STEP_DN = 0.5

#: fine steps to either side of a coarse level: more than half a coarse step; chosen
_AROUND = 4

#: fine steps to either side of a level that is known; chosen
_BESIDE_IT = 1

#: largest number of fine steps from where the search began; chosen
_FARTHEST = 20

#: how far a level's own share of the light begins under the knee of the file [DN]
_ROUNDED_DOWN_DN = 0.5

#: draws of noise that tell the bias of a knee
_DRAWS = 4

#: pixels nearer than this to a knee do not say whether it is there [DN]
_NEAR_DN = 4.0

#: share of the quiet pixels that lie on either side of a knee at least
_BESIDE = 0.01

#: -2 log likelihood that a knee must gain: two more numbers, by chance once in 10^4
_GAIN = 18.4

#: gain that a knee must have, in standard deviations over the tiles; chosen
_SURE = 3.0

#: largest finest detail of the print in a pixel, in standard deviations of noise; chosen
_QUIET = 0.5

#: finest detail beyond which a pixel is an outlier, in standard deviations of noise; chosen
_LARGEST = 4.0

#: squares of the weights of finest detail along an axis (32, 36): of the pixels of a tile and its rim, for those within
_WEIGHTS = sum(np.eye(_TILE_PX, _TILE_PX + 2 * _RIM_PX, at) * weight for at, weight in enumerate(FINEST**2))


@dataclass(frozen=True)
class Knee:
    """A curve's first knee at ``level`` [DN], its standard ``uncertainty``; beyond it the slope is :data:`SLOPE`."""

    level: float
    uncertainty: float

    def companding(self, bits: int) -> tuple[tuple[float, float], ...]:
        """Return the knees of the curve [DN]: straight to the knee, then with its slope to near full scale."""
        full = 2.0**bits
        near = full * (1 - 1 / 64)
        reached = self.level + (near - self.level) / SLOPE
        last = 2.0 ** np.ceil(np.log2(reached + (full - near)))
        return (self.level, self.level), (reached, near), (float(last), full)


def quiet_pixels(image: Floats, clean: Floats, mask: Mask) -> Mask:
    """Return the pixels of ``mask`` (H, W) whose finest detail is noise, by the noiseless ``clean``, not a print."""
    return _quiet(noise_of_levels(image, mask), clean, mask)


def _quiet(variance: Callable[[Floats], Floats], clean: Floats, mask: Mask) -> Mask:
    """Return the pixels of ``mask`` whose finest detail is noise of a known variance by level."""
    return mask & (finest_detail(clean) ** 2 < _QUIET**2 * np.maximum(variance(clean), 1e-12))


def first_knee(image: Floats, mask: Mask, imager: Imager) -> Knee | None:
    """Find the first knee [DN] in the pixels ``mask`` of an image (H, W); None if a straight curve explains it."""
    clean = denoised(image, mask)
    tiles = _Tiles.of(image, clean, quiet_pixels(image, clean, mask), imager.black_level)
    if tiles is None:
        return None
    low, high = np.quantile(tiles.clean[tiles.inside], [_BESIDE, 1 - _BESIDE])
    coarse = np.arange(low, high, _COARSE_DN)
    if not len(coarse):
        return None
    _, middle = min((tiles.best(k).sum(), k) for k in coarse)
    level = _least(tiles, middle, _AROUND)
    away = tiles.away_from(level)
    gain = away.best(np.inf) - away.best(level)
    if gain.sum() < max(_GAIN, _SURE * float(gain.std()) * np.sqrt(len(gain))) or not low < level < high:
        return None
    bias, spread = _bias(clean, mask, tiles, level)
    return Knee(level - bias, float(np.hypot(tiles.uncertainty(level), spread)))


def _bias(clean: Floats, mask: Mask, tiles: _Tiles, level: float) -> tuple[float, float]:
    """Return the bias of a knee whose levels come from a denoised image, from draws of noise, and its uncertainty."""
    numbers, knee_levels = tiles.fitted(level), []
    k = level - _ROUNDED_DOWN_DN
    every = np.linspace(0.0, k + (float(clean.max()) + 5 - k) / SLOPE, 1500)
    spread = tiles.spread(every, numbers)
    mean, _ = _through(every, level, spread)
    light = np.interp(clean, mean, every)
    for stream in np.random.default_rng(0).spawn(_DRAWS):
        drawn = light + np.interp(light, every, spread) * stream.normal(size=light.shape)
        drawn = np.rint(np.minimum(drawn, k) + SLOPE * np.maximum(drawn - k, 0.0))
        variance = noise_of_levels(drawn, mask)
        both = [
            _Tiles.of(drawn, levels, _quiet(variance, levels, mask), tiles.black)
            for levels in (denoised(drawn, mask), clean)
        ]
        knee_levels.append(
            [np.nan if drawn_tiles is None else _least(drawn_tiles, level, _BESIDE_IT) for drawn_tiles in both]
        )
    off = np.array(knee_levels) @ [1.0, -1.0]
    off = off[np.isfinite(off)]
    return (float(off.mean()), float(off.std(ddof=1) / np.sqrt(len(off)))) if len(off) > 1 else (0.0, float("inf"))


def _least(tiles: _Tiles, middle: float, around: int) -> float:
    """Return the most likely level of a knee, downhill from ``middle``, by a parabola through three levels."""
    total: dict[int, float] = {}

    def at(step: int) -> float:
        if step not in total:
            total[step] = float(tiles.best(middle + step * _STEP_DN).sum())
        return total[step]

    best = min(range(-around, around + 1), key=at)
    while abs(best) < _FARTHEST and at(beside := min(best - 1, best + 1, key=at)) < at(best):
        best = beside
    before, least, after = at(best - 1), at(best), at(best + 1)
    bend = before - 2 * least + after
    aside = (before - after) / (2 * bend) if bend > 0 else 0.0
    return float(middle + (best + float(np.clip(aside, -1, 1))) * _STEP_DN)


class _Tiles:
    """Tiles (n, 36, 36) of an image without noise, which pixels are used, their squared detail, and that of the print.

    ``rising`` (n * 36 * 36,) are the indices of the pixels by rising level, ``ranks`` (n, 36, 36) the ranks of the
    pixels in this order. ``used`` are indices of pixels among those of the tiles without their rims.
    """

    def __init__(self, clean: Floats, inside: Mask, square: Floats, print_square: Floats, black: float) -> None:
        self.clean, self.inside, self.square, self.print_square, self.black = clean, inside, square, print_square, black
        self.rising = np.argsort(clean, axis=None)
        self.rising_levels = clean.reshape(-1)[self.rising]
        ranks = np.empty(clean.size, np.intp)
        ranks[self.rising] = np.arange(clean.size)
        self.ranks = ranks.reshape(clean.shape)
        self.used = np.flatnonzero(inside[:, _RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX])

    @classmethod
    def of(cls, image: Floats, clean: Floats, quiet: Mask, black: float) -> _Tiles | None:
        side = _TILE_PX + 2 * _RIM_PX
        if min(image.shape) < side:
            return None
        rim = np.zeros((side, side), bool)
        rim[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX] = True
        inside = _cut(quiet, side).astype(bool) & rim
        indices = np.flatnonzero(inside.any(axis=(1, 2)))
        if len(indices) < _FEWEST:
            return None
        indices = indices[:: int(np.ceil(len(indices) / _TILES))]
        levels, square, print_detail = (
            _cut(values, side)[indices] for values in (clean, finest_detail(image), finest_detail(clean))
        )
        inside = inside[indices]
        return cls(levels, inside, square[inside] ** 2, print_detail[inside] ** 2, black)

    def away_from(self, level: float) -> _Tiles:
        """Return the tiles without pixels near a level: a curve that is flat there only is no knee."""
        far = np.abs(self.clean - level) > _NEAR_DN
        kept = far[self.inside]
        return _Tiles(self.clean, self.inside & far, self.square[kept], self.print_square[kept], self.black)

    def best(self, knee: float) -> Floats:
        """Return -2 log likelihood (n,) of the tiles with the best common a and b; an infinite knee is none."""
        return self.misfit(knee, self.fitted(knee))

    def fitted(self, knee: float) -> Floats:
        """Return a and b of all tiles, by weighted least squares."""
        middle = float(np.median(self.square)) / MEDIAN_SQUARE
        numbers = np.array([0.0, middle / max(float(np.median(self.clean)), 1.0)])
        variance, excess = np.full_like(self.square, middle), self.square - 1 / 12 - self.print_square
        for _ in range(3):
            shares = self._shares(knee, numbers)
            maps = np.stack([_of_neighbours(share).take(self.used) for share in shares])
            for _ in range(2):
                weight = (self.square < _LARGEST**2 * variance) / variance**2
                numbers = _nonnegative_pair(maps, excess, weight)
                variance = np.maximum(numbers @ maps, 1e-3) + 1 / 12 + self.print_square
        return numbers

    def misfit(self, knee: float, numbers: Floats) -> Floats:
        """Return -2 log likelihood (n,) of the tiles."""
        ratio, light = self._shares(knee, numbers)
        noise_variance = _of_neighbours(numbers[0] * ratio + numbers[1] * light).take(self.used)
        variance = np.maximum(noise_variance, 1e-3) + 1 / 12 + self.print_square
        terms = np.zeros((len(self.clean), _TILE_PX**2))
        terms.reshape(-1)[self.used] = np.log(variance) + np.minimum(self.square / variance, _LARGEST**2)
        return np.asarray(independent_share() * terms.sum(axis=1), float)

    def uncertainty(self, knee: float) -> float:
        """Return the standard uncertainty [DN] of the knee by a jackknife that leaves out one tile at a time.

        K, a and b without a tile follow by one Newton step, from the first and second derivatives of every tile's
        likelihood. Tiles are independent samples, whether the model fits or not.
        """
        numbers = self.fitted(knee)
        steps = np.diag([_STEP_DN, 0.1 * max(numbers[0], 0.1), 0.05 * max(numbers[1], 1e-4)])

        def at(step: Floats) -> Floats:
            return self.misfit(knee + float(step[0]), numbers + step[1:])

        middle, sides = at(np.zeros(3)), [(at(step), at(-step)) for step in steps]
        slopes, bend = np.stack([(up - down) / 2 for up, down in sides], axis=1), np.empty((len(middle), 3, 3))
        for i, (up, down) in enumerate(sides):
            bend[:, i, i] = up - 2 * middle + down
        for i, j in ((0, 1), (0, 2), (1, 2)):
            both = (
                at(steps[i] + steps[j]) - at(steps[i] - steps[j]) - at(steps[j] - steps[i]) + at(-steps[i] - steps[j])
            )
            bend[:, i, j] = bend[:, j, i] = both / 4
        without = bend.sum(axis=0) - bend
        moved = np.linalg.solve(without, (slopes - slopes.mean(axis=0))[..., None])[:, 0, 0] * _STEP_DN
        return float(np.sqrt((len(moved) - 1) * moved.var()))

    def _shares(self, knee: float, numbers: Floats) -> tuple[Floats, Floats]:
        """Return the factors (n, 36, 36) of a and b in every pixel alone."""
        light, ratio = self.clean, np.ones(self.clean.shape)
        if np.isfinite(knee):
            top = knee + (float(self.rising_levels[-1]) + 5 - knee) / SLOPE
            every = np.linspace(0.0, top, 1500)
            mean, share = _through(every, knee, self.spread(every, numbers))
            # both at once, and in the order of the levels, which finds the neighbours five times as fast
            values = np.interp(self.rising_levels, mean, every + 1j * share).take(self.ranks)
            light, ratio = values.real, values.imag.copy()
        return ratio, ratio * np.maximum(light - self.black, 0.0)

    def spread(self, level: Floats, numbers: Floats) -> Floats:
        """Return the standard deviation [DN] of the noise at levels (n,) of the converter, from a and b."""
        return np.asarray(np.sqrt(np.maximum(numbers[0] + numbers[1] * np.maximum(level - self.black, 0.0), 0.02)))


def _cut(values: NDArray[Any], side: int) -> Floats:
    """Return tiles (n, side, side) of an image, whose rims overlap."""
    tiles = sliding_window_view(values, (side, side))[::_TILE_PX, ::_TILE_PX]
    return np.asarray(tiles.reshape(-1, side, side), float)


def _through(level: Floats, knee: float, spread: Floats) -> tuple[Floats, Floats]:
    """Return the mean (n,) behind the curve of levels with normal noise, and the remaining share of the variance."""
    t, flat = (level - (knee - _ROUNDED_DOWN_DN)) / spread, 1 - SLOPE
    above, density = ndtr(t), np.exp(-(t**2) / 2.0) / np.sqrt(2 * np.pi)
    first, second = density + t * above, (1 + t**2) * above + t * density
    return level - flat * spread * first, 1 - 2 * flat * above + flat**2 * (second - first**2)


def _nonnegative_pair(design: Floats, values: Floats, weight: Floats) -> Floats:
    """Return two non-negative numbers by weighted least squares; the design is (2, N)."""
    weighted = design * weight
    normal, right = weighted @ design.T, weighted @ values
    numbers = np.linalg.solve(normal + 1e-12 * np.eye(2), right)
    if numbers[0] < 0:
        numbers = np.array([0.0, max(right[1] / normal[1, 1], 0.0)])
    elif numbers[1] < 0:
        numbers = np.array([max(right[0] / normal[0, 0], 0.0), 0.0])
    return np.asarray(numbers)


def _of_neighbours(values: Floats) -> Floats:
    """Return means (n, 32, 32) over neighbours in tiles (n, 36, 36), weighted by the squares of detail's weights."""
    return np.asarray(_WEIGHTS @ values @ _WEIGHTS.T)
