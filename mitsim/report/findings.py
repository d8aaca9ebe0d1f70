"""What the numbers of a run say: the best views, how far the prediction held, and why points are missing.

Signal chain: scores and checks -> best view of each measurement, and one view for all -> predicted score and standard
uncertainty beside the true error of the checked views; predicted and decoded clouds -> shares of reasons.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import t

from characterisation.performance_map import PerformanceMap, from_equal_area
from characterisation.point_cloud import PointCloud, Status
from characterisation.rank_agreement import spearman
from mitsim.report.numbers import finish_name, quantity, rounded, two_digits

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """One measurement in the checked views, arrays (views,); errors in the measurement's unit.

    ``score`` V_m; ``uncertainty`` predicted standard uncertainty; ``error`` mean, ``least`` and ``most`` of |error|
    over the repeats that could be measured, NaN where none could; ``failed`` share of repeats that could not.
    ``spearman`` rank correlation of V_m and ``error`` over the ``count`` views that could be measured (NaN below 4);
    ``ratio`` median of ``error`` over ``uncertainty``.
    """

    views: NDArray[np.int64]
    possible: NDArray[np.bool_]
    score: Floats
    uncertainty: Floats
    error: Floats
    least: Floats
    most: Floats
    failed: Floats
    spearman: float
    count: int
    ratio: float


def agreement(scores: xr.Dataset, checks: xr.Dataset, measurement: str) -> Agreement:
    """Hold what was predicted of the checked views against what was measured in them."""
    here = scores.sel(measurement=measurement, view=checks["view"].values)
    errors = np.abs(checks["error"].sel(measurement=measurement).transpose("view", "repeat").values)
    known = np.isfinite(errors)
    some = known.any(axis=1)
    error = np.full(len(errors), np.nan)
    error[some] = np.nanmean(errors[some], axis=1)
    least, most = np.where(known, errors, np.inf).min(axis=1), np.where(known, errors, -np.inf).max(axis=1)
    score, uncertainty = here["V_m"].values, here["predicted_standard_uncertainty"].values
    both = some & (uncertainty > 0)
    return Agreement(
        checks["view"].values, here["possible"].values.astype(bool), score, uncertainty, error,
        np.where(some, least, np.nan), np.where(some, most, np.nan), 1 - known.mean(axis=1),
        spearman(score[some], error[some]), int(some.sum()),
        float(np.median(error[both] / uncertainty[both])) if both.any() else float("nan"),
    )  # fmt: skip


def chance_level(count: int) -> float:
    """Size that the rank correlation of unrelated pairs exceeds one time in twenty (Student's approximation)."""
    if count < 4:
        return float("nan")
    quantile = float(t.ppf(0.975, count - 2))
    return quantile / float(np.sqrt(count - 2 + quantile**2))


def best_view(scores: xr.Dataset, measurement: str) -> int | None:
    """Number of the view of rank 1; None where no view can make the measurement."""
    here = scores.sel(measurement=measurement)
    first = int(here["rank"].values.argmin())
    return int(scores["view"].values[first]) if here["possible"].values[first] else None


def view_for_all(scores: xr.Dataset) -> tuple[int, float] | None:
    """The view of least mean rank among those that can make every measurement, and that mean; None if there is none."""
    able = scores["possible"].transpose("measurement", "view").values.all(axis=0)
    if not able.any():
        return None
    mean_rank = np.where(able, scores["rank"].transpose("measurement", "view").values.mean(axis=0), np.inf)
    return int(scores["view"].values[mean_rank.argmin()]), float(mean_rank.min())


def reason_shares(pairs: Iterable[tuple[PointCloud, PointCloud]]) -> dict[Status, tuple[float, float]]:
    """Share of each status in predicted and in decoded clouds, most frequent first.

    ``pairs`` of (predicted, decoded) on one grid. Counted are the pixels in which the part could be seen: those where
    the predicted cloud's rays meet a surface inside every image.
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
    """Incidence angle of every node of a map, (b, a) [rad]."""
    b, a = np.meshgrid(performance_map.data["b"].values, performance_map.data["a"].values, indexing="ij")
    places = np.stack([a, b], axis=-1)
    return np.asarray(np.arccos(np.clip(from_equal_area(places)[..., 2], -1, 1)))


def half_recovery_incidence(performance_map: PerformanceMap, sample: int, distance: int) -> float:
    """Incidence at which the mean of F over all tilt directions falls below one half [rad]; NaN if it never does.

    The bright centre of a shiny sample may be lost and F recover beside it: the last crossing is told.
    """
    incidence = incidence_of_nodes(performance_map)
    fraction = performance_map.data["recovered_fraction"].values[sample, distance]
    lows = np.radians(np.arange(0.0, 90.0, 2.5))
    means = np.full(len(lows), np.nan)
    for i, low in enumerate(lows):
        ring = fraction[(incidence >= low) & (incidence < low + np.radians(5.0)) & np.isfinite(fraction)]
        if len(ring):
            means[i] = ring.mean()
    known = np.flatnonzero(np.isfinite(means))
    good = known[means[known] >= 0.5]
    if not len(good):
        return 0.0 if len(known) else float("nan")
    return float("nan") if good[-1] == known[-1] else float(lows[good[-1]] + np.radians(3.75))


def median_noise(performance_map: PerformanceMap, sample: int, distance: int, largest_incidence: float) -> float:
    """Median of sigma up to an incidence angle [rad], in mm; NaN where there is none."""
    sigma = performance_map.data["ray_noise_std"].values[sample, distance]
    near = sigma[(incidence_of_nodes(performance_map) <= largest_incidence) & np.isfinite(sigma)]
    return float(np.median(near)) if len(near) else float("nan")


def spread_in_words(performance_map: PerformanceMap) -> list[str]:
    """How far what is not known of a finish moves F and sigma at most: a line for each sample where it does."""
    data, lines = performance_map.data, list[str]()
    incidence = np.degrees(incidence_of_nodes(performance_map))
    for i, sample in enumerate(performance_map.samples):
        fraction, sigma = (data[f"{name}_spread"].values[i] for name in ("recovered_fraction", "ray_noise_std"))
        if not (fraction > 0).any():  # NaN: nobody asked; 0: all is known of it
            continue
        j, b, a = np.unravel_index(np.nanargmax(fraction), fraction.shape)
        where = f"at {rounded(float(incidence[b, a]))} deg and {data['distance'].values[j]:g} mm"
        largest = quantity(float(np.nanmax(sigma)), "mm") if np.isfinite(sigma).any() else "nothing known"
        lines.append(
            f"{finish_name(*sample)}: what is not known of the finish moves F by up to "
            f"{two_digits(float(fraction[j, b, a]))} ({where}), sigma by up to {largest}; one standard deviation"
        )
    return lines
