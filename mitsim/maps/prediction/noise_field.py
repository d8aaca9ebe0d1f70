r"""Spatially correlated errors of neighbouring points, as measured in a map.

Signal chain: noise area A, persistent noise p / sigma and F of each point
(:mod:`characterisation.maps.noise_structure`) -> correlation area a and strength s / sigma of the field -> white noise
on the pixel grid, filtered to a few graded areas -> blend of two grades at each pixel for its own a -> times s / sigma,
plus the persistent part -> errors in units of the map's sigma.

*Noise that averages out* is a Gaussian field with the autocorrelation that the predicted uncertainty assumes
(:mod:`characterisation.tasks.covariance`),

    rho(d) = exp(-pi d^2 / a),      s^2 a = sigma^2 A',      A' = A + 1 - 1 / F

at a distance of d pixels. Random losses of points increase the noise area without any correlation, so A' excludes them.
The area a follows from A' (:func:`characterisation.coupon.offsets.own_area`). The strength s exceeds sigma by the part
of the noise that the plane fitted to a patch removes.

White noise is filtered by the square root of the spectrum of the sampled rho (Dietrich and Newsam, SIAM J. Sci. Comput.
18 (1997) 1088-1107, *recalled*), so that rho is exact on the grid, for areas 1 (white), 2, 4, ... [px^2]. All grades
are filtered from the same white noise. Neighbouring grades are therefore correlated (c = 0.94), and a weighted sum of
two has an area between theirs (process convolution: Higdon, in Quantitative Methods for Current Environmental Issues
(2002) 37-56, *recalled*). The ratio q of the weights follows from the noise area of the sum on the grid,

    a (1 + 2 c q + q^2) = (sqrt(a_1) + q sqrt(a_2))^2

so that a may vary slowly from pixel to pixel. Between two grades the autocorrelation of the sum differs from rho by at
most 0.015.

*Persistent noise* p is similar at near pixels with similar normals, and different on two features: k = exp(-d^2 / (2
l^2)) exp(-|N - N'|^2 / (2 t^2)), with l and t of :mod:`characterisation.tasks.covariance`. It is a sum of cosines with
random frequencies (Rahimi and Recht, NIPS 20 (2007)). Its covariance over seeds is k, and it is Gaussian except for an
excess kurtosis of -1.5 / 32.

Where the map has no noise area, errors are independent. The field ignores edges: neighbours on two faces have
correlated errors, as they do if a matching block covers both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from characterisation.coupon.offsets import own_area
from characterisation.files.arrays import Floats, Singles
from characterisation.files.threads import in_threads, thread_count
from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.pooled_offsets import DISC_RADIUS
from characterisation.tasks.covariance import PERSISTENT_REACH_PX, PERSISTENT_TURN
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.scene.ray_casting.mapped_scene import MappedView

#: number of cosines of the persistent part
COSINES = 32

#: border of the grid, in square roots of the largest area; rho is 3e-6 across it, so the periodic field does not wrap
_BORDER = 2.0

#: points per chunk of waves, which stay in the cache
_WAVE_POINTS = 2048

#: points per look-up in the map, each of which has a fixed cost
_LOOK_UP_POINTS = 32768


def correlated_noise(
    scene: Scene, performance_map: PerformanceMap, mapped: MappedView, rng: np.random.Generator
) -> Singles:
    """Return the errors (h, w) of the points of a view in units of the map's sigma; 0 where the map has none."""
    assert mapped.normal is not None
    predicted = np.isfinite(mapped.sigma)
    pixel, normal = np.argwhere(predicted), mapped.normal[:, predicted].T
    shape, distance, fraction = mapped.shape[predicted], mapped.distance[predicted], mapped.fraction[predicted]
    area, share = np.full((2, len(pixel)), np.nan)
    members = {index: np.flatnonzero(shape == index) for index in range(len(scene.names))}
    for index, finish in enumerate(scene.finishes):
        if finish is None:
            continue
        chosen = members[index]

        def ask(run: slice, chosen: NDArray[np.intp] = chosen, finish: Finish = finish) -> None:
            at = chosen[run]
            structure = noise_structure(
                performance_map, finish.name, finish.roughness, distance[at], normal[at].astype(float), finish.light
            )
            area[at] = structure.area
            share[at] = np.hypot(structure.persistent_share, np.nan_to_num(structure.bias_share))

        _run_in_threads(ask, len(chosen), _LOOK_UP_POINTS)
    field_area, strength = own_field(area, fraction)
    noise = averaging_field(field_area, pixel, rng) * strength
    for chosen in members.values():
        lasting = np.nan_to_num(share[chosen]).astype(np.float32)
        if lasting.any():
            noise[chosen] += lasting * persistent_field(pixel[chosen], normal[chosen], rng)
    out = np.zeros(mapped.sigma.shape, np.float32)
    out[predicted] = noise
    return out


def own_field(area: Floats, fraction: NDArray[np.floating]) -> tuple[Floats, Singles]:
    """Return the correlation area a [px^2], at least 1, and strength s / sigma of the field, from (n,) areas and F."""
    with np.errstate(divide="ignore"):
        correlated = np.nan_to_num(np.maximum(area + 1 - 1 / fraction, 1.0), nan=1.0, neginf=1.0)
    field_area = own_area(correlated, DISC_RADIUS)
    return field_area, np.sqrt(correlated / field_area).astype(np.float32)


def averaging_field(area: Floats, pixel: NDArray[np.int64], rng: np.random.Generator) -> Singles:
    """Return a Gaussian field of unit variance with the area (n,) [px^2], at least 1, at pixels (n, 2)."""
    if not len(pixel):
        return np.empty(0, np.float32)
    offset = pixel - pixel.min(axis=0)
    low = np.floor(np.log2(np.maximum(area, 1.0))).astype(np.int64)
    used = np.flatnonzero(np.bincount(low)).tolist()
    border = math.ceil(_BORDER * math.sqrt(2.0 ** (used[-1] + 1)))
    size = tuple(scipy.fft.next_fast_len(int(side) + 1 + border, real=True) for side in offset.max(axis=0))
    white = rng.standard_normal(size, dtype=np.float32)
    spectrum = scipy.fft.rfft2(white, workers=thread_count())
    at = offset @ np.array([size[1], 1])

    @lru_cache(maxsize=2)
    def graded(number: int) -> Singles:
        if number == 0:
            return white.ravel()
        rows, columns = _root_spectra(2.0**number, size)
        filtered = spectrum * rows[:, None].astype(np.float32) * columns[: size[1] // 2 + 1].astype(np.float32)
        return np.asarray(scipy.fft.irfft2(filtered, size, workers=thread_count(), overwrite_x=True)).ravel()

    out = np.empty(len(area), np.float32)
    for number in used:
        mask = np.flatnonzero(low == number)
        correlation = _grade_correlation(number, size)
        ratio = _ratio(area[mask], 2.0**number, 2.0 ** (number + 1), correlation)
        total = graded(number)[at[mask]] + ratio.astype(np.float32) * graded(number + 1)[at[mask]]
        out[mask] = total / np.sqrt(1 + 2 * correlation * ratio + ratio**2)
    return out


def _ratio(area: Floats, lower: float, upper: float, correlation: float) -> Floats:
    """Return the weight q of the grade with the larger area, relative to that with the smaller one."""
    a, b, c = upper - area, math.sqrt(lower * upper) - area * correlation, lower - area
    return np.asarray((-b + np.sqrt(np.maximum(b**2 - a * c, 0.0))) / a)


def _grade_correlation(number: int, size: tuple[int, ...]) -> float:
    """Return the correlation c between the fields of two neighbouring grades from the same white noise."""
    near, far = (_root_spectra(2.0**i, size) for i in (number, number + 1))
    return math.prod(float(np.mean(factor * other)) for factor, other in zip(near, far, strict=True))


def _root_spectra(area: float, size: tuple[int, ...]) -> list[Floats]:
    """Return the root of the spectrum of exp(-pi d^2 / area) along each axis of a periodic grid; 1 for area 1."""
    out = []
    for side in size:
        apart = np.minimum(np.arange(side), side - np.arange(side))
        rho = np.exp(-math.pi * apart**2 / area) if area > 1 else (apart == 0).astype(float)
        out.append(np.sqrt(np.maximum(np.fft.fft(rho).real, 0.0)))
    return out


def persistent_field(pixel: NDArray[np.int64], normal: NDArray[np.floating], rng: np.random.Generator) -> Singles:
    """Return a field of unit variance that is similar at near pixels (n, 2) with similar normals (n, 3)."""
    coordinates = np.concatenate([pixel.T / PERSISTENT_REACH_PX, normal.T / PERSISTENT_TURN]).astype(np.float32)
    frequency = rng.standard_normal((len(coordinates), COSINES, 1), np.float32)
    phase = rng.uniform(0, 2 * math.pi, (COSINES, 1)).astype(np.float32)
    total = np.empty(coordinates.shape[1], np.float32)

    def add(run: slice) -> None:
        waves = phase + frequency[0] * coordinates[0, run]  # no matrix product: BLAS threads would compete with ours
        for along, coordinate in zip(frequency[1:], coordinates[1:], strict=True):
            waves += along * coordinate[run]
        total[run] = np.cos(waves, out=waves).sum(axis=0)

    _run_in_threads(add, len(total), _WAVE_POINTS)
    return np.asarray(total * np.float32(math.sqrt(2 / COSINES)))


def _run_in_threads(work: Callable[[slice], None], count: int, length: int) -> None:
    """Process chunks of points in threads; numpy releases the interpreter lock in its loops."""
    in_threads(work, [slice(start, start + length) for start in range(0, count, length)])
