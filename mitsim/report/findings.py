"""Derive results from the data of a run: the best views, why points are missing, the limits of the map.

Signal chain: predicted standard uncertainty u of every view -> ranked views of each measurement; predicted and decoded
clouds -> shares of the statuses; performance map -> its limits, in words. :mod:`mitsim.report.agreement` reports how
well u screens.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.lambert_projection import inverse_lambert_projection
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud, Status
from characterisation.words.numbers import finish_name, quantity, rounded, two_digits

#: incidence up to which the noise of a surface is summarised [deg]
NOISE_UP_TO_DEG = 45.0


def ranked_views(scores: xr.Dataset, measurement: str) -> NDArray[np.int64]:
    """Return the indices of views that can make a measurement, least risk u / sqrt(chance) first, as in the race."""
    here = scores.sel(measurement=measurement)
    order = np.argsort(here["uncertainty_rank"].values, kind="stable")
    return np.asarray(order[here["uncertainty_possible"].values.astype(bool)[order]])


def best_view(scores: xr.Dataset, measurement: str) -> int | None:
    """Return the number of the view with the least predicted risk; None if no view can make the measurement."""
    ranked = ranked_views(scores, measurement)
    return int(scores["view"].values[ranked[0]]) if len(ranked) else None


def reason_shares(pairs: Iterable[tuple[PointCloud, PointCloud]]) -> dict[Status, tuple[float, float]]:
    """Return the share of each status in predicted and in decoded clouds, most frequent first.

    ``pairs`` are (predicted, decoded) on one grid. The shares refer to the pixels that could show the part: those whose
    rays in the predicted cloud meet a surface inside every image.
    """
    counts = np.zeros((2, max(Status) + 1))
    for predicted, decoded in pairs:
        seen = predicted.status != Status.NO_SURFACE
        for row, cloud in enumerate((predicted, decoded)):
            counts[row] += np.bincount(cloud.status[seen], minlength=max(Status) + 1)
    if not counts.any():
        return {}
    shares = counts / counts.sum(axis=1, keepdims=True)
    order = np.argsort(-shares.max(axis=0), kind="stable")
    return {Status(i): (float(shares[0, i]), float(shares[1, i])) for i in order if shares[:, i].any()}


def incidence_of_nodes(performance_map: PerformanceMap) -> Floats:
    """Return the incidence angle of every node of a map, (b, a) [rad]."""
    b, a = np.meshgrid(performance_map.data["b"].values, performance_map.data["a"].values, indexing="ij")
    nodes = np.stack([a, b], axis=-1)
    return np.asarray(np.arccos(np.clip(inverse_lambert_projection(nodes)[..., 2], -1, 1)))


def half_recovery_incidence(performance_map: PerformanceMap, sample: int, distance: int) -> float:
    """Return the incidence at which the mean of F over all tilt directions falls below one half [rad]; NaN if never.

    The sensor can lose the bright centre of a shiny sample and recover beside it, so the last crossing counts.
    """
    incidence = incidence_of_nodes(performance_map)
    fraction = performance_map.data["recovered_fraction"].values[sample, distance]
    lows = np.radians(np.arange(0.0, 90.0, 2.5))
    means = np.full(len(lows), np.nan)
    for i, low in enumerate(lows):
        ring = fraction[(incidence >= low) & (incidence < low + np.radians(5.0)) & np.isfinite(fraction)]
        if len(ring):
            means[i] = ring.mean()
    rings = np.flatnonzero(np.isfinite(means))
    good = rings[means[rings] >= 0.5]
    if not len(good):
        return 0.0 if len(rings) else float("nan")
    return float("nan") if good[-1] == rings[-1] else float(lows[good[-1]] + np.radians(3.75))


def median_noise(performance_map: PerformanceMap, sample: int, distance: int) -> float:
    """Return the median of sigma [mm] up to :data:`NOISE_UP_TO_DEG`; NaN without a value."""
    sigma = performance_map.data["ray_noise_std"].values[sample, distance]
    near = sigma[(incidence_of_nodes(performance_map) <= np.radians(NOISE_UP_TO_DEG)) & np.isfinite(sigma)]
    return float(np.median(near)) if len(near) else float("nan")


def spread_in_words(performance_map: PerformanceMap) -> list[str]:
    """Describe the largest effect of unknown properties of a finish on F and sigma, a line for each such sample."""
    data, lines = performance_map.data, list[str]()
    incidence = np.degrees(incidence_of_nodes(performance_map))
    for i, sample in enumerate(performance_map.samples):
        fraction, sigma = (data[f"{name}_spread"].values[i] for name in ("recovered_fraction", "ray_noise_std"))
        if not (fraction > 0).any():  # NaN: not evaluated; 0: nothing is unknown
            continue
        j, b, a = np.unravel_index(np.nanargmax(fraction), fraction.shape)
        where = f"at {rounded(float(incidence[b, a]))} deg and {data['distance'].values[j]:g} mm"
        largest = quantity(float(np.nanmax(sigma)), "mm") if np.isfinite(sigma).any() else "an unknown amount"
        lines.append(
            f"{finish_name(*sample)}: unknown properties of the finish change F by up to "
            f"{two_digits(float(fraction[j, b, a]))} ({where}), and sigma by up to {largest} (one standard deviation)"
        )
    return lines
