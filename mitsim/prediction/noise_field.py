r"""Errors of neighbouring points, correlated in space as a map measured them.

Signal chain: noise area A, persistent p / sigma and F of each point (:mod:`characterisation.maps.noise_structure`) ->
the field's own area a and strength s / sigma -> white noise on the pixel grid, filtered to a few graded areas ->
blended at each pixel to its own a -> times s / sigma, plus the persistent part -> errors in units of the map's sigma.

*What averages out* is a Gaussian field with the autocorrelation that the uncertainty to expect supposes
(:mod:`characterisation.tasks.covariance`),

    rho(d) = exp(-pi d^2 / a),      s^2 a = sigma^2 A',      A' = A + 1 - 1 / F

over a distance of d pixels. What random losses add to the noise area is no correlation, so it is taken off; a follows
from A' (:func:`characterisation.coupon.offsets.own_area`), and s is more than sigma by what the plane of a patch takes
away. White noise is filtered by the root of the sampled rho's spectrum (Dietrich and Newsam, SIAM J. Sci. Comput. 18
(1997) 1088-1107, *recalled*), which makes rho exact on the grid, for areas 1 (white), 2, 4, ... [px^2]. One white noise
feeds them all, so neighbouring ones are alike (correlation c = 0.94) and a weighted sum of two has an area between
theirs (process convolution: Higdon, in Quantitative Methods for Current Environmental Issues (2002) 37-56, *recalled*).
The ratio q of the weights follows from the noise area of the sum on the grid,

    a (1 + 2 c q + q^2) = (sqrt(a_1) + q sqrt(a_2))^2

so a may differ from pixel to pixel; it should do so slowly over a reach. Between two areas the sum departs from the
form of rho by 0.015 at most.

*What lasts*, p, is alike where pixels are near and the surface is turned alike, and unlike in two features:
k = exp(-d^2 / (2 l^2)) exp(-|N - N'|^2 / (2 t^2)) with the l and t of :mod:`characterisation.tasks.covariance`. It is
a sum of cosines with random frequencies (Rahimi and Recht, NIPS 20 (2007)), of which the covariance over seeds is k,
and which is Gaussian but for an excess kurtosis of -1.5 / 32.

Where the map knows no noise area errors are independent. The field knows nothing of edges: neighbours on two faces err
together, as they do where a block holds both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from characterisation.coupon.offsets import own_area
from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.pooled_offsets import DISC_RADIUS
from characterisation.tasks.covariance import PERSISTENT_REACH_PX, PERSISTENT_TURN
from characterisation.threads import in_threads, thread_count
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.scene.ray_casting.mapped_scene import MappedView

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

#: of the persistent part
COSINES = 32

#: of the grid's border, in roots of the largest area: rho is 3e-6 over it, and nothing comes around
_BORDER = 2.0

#: points that are worked on at a time: their waves stay in the cache, and look-ups have a cost of their own
_WAVES_AT_ONCE, _ASKED_AT_ONCE = 2048, 32768


def correlated_noise(
    scene: Scene, performance_map: PerformanceMap, seen: MappedView, rng: np.random.Generator
) -> Singles:
    """Errors (h, w) of the points of a view in units of the map's sigma; 0 where the map has none.

    ``seen`` holds normals as well.
    """
    assert seen.normal is not None
    predicted = np.isfinite(seen.sigma)
    pixel, normal = np.argwhere(predicted), seen.normal[:, predicted].T
    shape, distance, fraction = seen.shape[predicted], seen.distance[predicted], seen.fraction[predicted]
    area, share = np.full((2, len(pixel)), np.nan)
    members = {index: np.flatnonzero(shape == index) for index in range(len(scene.names))}
    for index, finish in enumerate(scene.finishes):
        if finish is None:
            continue
        chosen = members[index]

        def ask(run: slice, chosen: NDArray[np.intp] = chosen, finish: Finish = finish) -> None:
            at = chosen[run]
            found = noise_structure(
                performance_map, finish.name, finish.roughness, distance[at], normal[at].astype(float), finish.light
            )
            area[at], share[at] = found.area, np.hypot(found.persistent_share, np.nan_to_num(found.bias_share))

        _in_runs(ask, len(chosen), _ASKED_AT_ONCE)
    own, strength = own_field(area, fraction)
    noise = averaging_field(own, pixel, rng) * strength
    for chosen in members.values():
        lasting = np.nan_to_num(share[chosen]).astype(np.float32)
        if lasting.any():
            noise[chosen] += lasting * persistent_field(pixel[chosen], normal[chosen], rng)
    out = np.zeros(seen.sigma.shape, np.float32)
    out[predicted] = noise
    return out


def own_field(area: Floats, fraction: NDArray[np.floating]) -> tuple[Floats, Singles]:
    """The field's own area a [px^2], 1 at least, and its strength s / sigma, from noise areas A and F, (n,) each."""
    with np.errstate(divide="ignore"):
        correlated = np.nan_to_num(np.maximum(area + 1 - 1 / fraction, 1.0), nan=1.0, neginf=1.0)
    own = own_area(correlated, DISC_RADIUS)
    return own, np.sqrt(correlated / own).astype(np.float32)


def averaging_field(area: Floats, pixel: NDArray[np.int64], rng: np.random.Generator) -> Singles:
    """A Gaussian field of unit variance with the area (n,) [px^2], 1 at least, at pixels (n, 2)."""
    if not len(pixel):
        return np.empty(0, np.float32)
    place = pixel - pixel.min(axis=0)
    low = np.floor(np.log2(np.maximum(area, 1.0))).astype(np.int64)
    used = np.flatnonzero(np.bincount(low)).tolist()
    border = math.ceil(_BORDER * math.sqrt(2.0 ** (used[-1] + 1)))
    size = tuple(scipy.fft.next_fast_len(int(side) + 1 + border, real=True) for side in place.max(axis=0))
    white = rng.standard_normal(size, dtype=np.float32)
    spectrum = scipy.fft.rfft2(white, workers=thread_count())
    at = place @ np.array([size[1], 1])

    @lru_cache(maxsize=2)
    def graded(number: int) -> Singles:
        if number == 0:
            return white.ravel()
        rows, columns = _roots(2.0**number, size)
        filtered = spectrum * rows[:, None].astype(np.float32) * columns[: size[1] // 2 + 1].astype(np.float32)
        return np.asarray(scipy.fft.irfft2(filtered, size, workers=thread_count(), overwrite_x=True)).ravel()

    out = np.empty(len(area), np.float32)
    for number in used:
        mask = np.flatnonzero(low == number)
        alike = _alike(number, size)
        ratio = _ratio(area[mask], 2.0**number, 2.0 ** (number + 1), alike)
        total = graded(number)[at[mask]] + ratio.astype(np.float32) * graded(number + 1)[at[mask]]
        out[mask] = total / np.sqrt(1 + 2 * alike * ratio + ratio**2)
    return out


def _ratio(area: Floats, lower: float, upper: float, alike: float) -> Floats:
    """q: how much of the field of the upper area is added to that of the lower, for one between them."""
    a, b, c = upper - area, math.sqrt(lower * upper) - area * alike, lower - area
    return np.asarray((-b + np.sqrt(np.maximum(b**2 - a * c, 0.0))) / a)


def _alike(number: int, size: tuple[int, ...]) -> float:
    """Correlation c of the fields of two grades that are filtered of one white noise."""
    near, far = (_roots(2.0**i, size) for i in (number, number + 1))
    return math.prod(float(np.mean(one * other)) for one, other in zip(near, far, strict=True))


def _roots(area: float, size: tuple[int, ...]) -> list[Floats]:
    """Root of the spectrum of exp(-pi d^2 / area) along each axis of a grid that closes on itself; 1 for area 1."""
    out = []
    for side in size:
        apart = np.minimum(np.arange(side), side - np.arange(side))
        rho = np.exp(-math.pi * apart**2 / area) if area > 1 else (apart == 0).astype(float)
        out.append(np.sqrt(np.maximum(np.fft.fft(rho).real, 0.0)))
    return out


def persistent_field(pixel: NDArray[np.int64], normal: NDArray[np.floating], rng: np.random.Generator) -> Singles:
    """A field of unit variance that is alike where pixels (n, 2) are near and normals (n, 3) are turned alike."""
    place = np.concatenate([pixel.T / PERSISTENT_REACH_PX, normal.T / PERSISTENT_TURN]).astype(np.float32)
    frequency = rng.standard_normal((len(place), COSINES, 1), np.float32)
    phase = rng.uniform(0, 2 * math.pi, (COSINES, 1)).astype(np.float32)
    total = np.empty(place.shape[1], np.float32)

    def add(run: slice) -> None:
        waves = phase + frequency[0] * place[0, run]  # not a matrix product: BLAS's threads would wait for ours
        for along, one in zip(frequency[1:], place[1:], strict=True):
            waves += along * one[run]
        total[run] = np.cos(waves, out=waves).sum(axis=0)

    _in_runs(add, len(total), _WAVES_AT_ONCE)
    return np.asarray(total * np.float32(math.sqrt(2 / COSINES)))


def _in_runs(work: Callable[[slice], None], count: int, length: int) -> None:
    """Work on runs of points, in threads."""
    in_threads(work, [slice(start, start + length) for start in range(0, count, length)])
