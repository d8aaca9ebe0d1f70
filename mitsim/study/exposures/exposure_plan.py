"""Find the fewest exposures that bring every feature of a view to its limits of points and uncertainty u.

Signal chain: single exposures, from the sensor's own to shorter and longer ones of the device -> greedy sets of several
exposures that together recover most points -> the best of these, decoded again with other noise -> limits of each
feature: its most points and its smallest u -> fewest exposures that reach all limits within a share, the shortest of
equally few -> result of the first exposure, of the first two, and so on, with new noise.

The projector keeps its full power, unless the shortest exposure of the device is too bright. A lower power would only
require a longer exposure, in which the room adds more light.

The predicted points of a set are those that at least one of its exposures recovers alone. Sets that could reach the
limits are decoded. The best of many noisy results is biased. So the search uses few noise samples, and the decision
more samples of independent noise. A set misses a limit of u only if the difference exceeds twice its standard error.

If time ends before the decision, the plan is the single exposure that comes closest to the limits of those tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mitsim.running.time_limit import OutOfTimeError
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study.exposures.exposure_sweep import ExposureResult, FeatureResult

#: ratio of neighbouring single exposures
STEP = math.sqrt(2.0)

#: largest ratio of a single exposure to the sensor's own
LARGEST_RATIO = 64.0

#: least power of a projector in a plan [1]; *assumed*, since no maker of the presets states one
LEAST_POWER = 0.1

#: a sweep ends after this number of useless exposures; chosen
STOP_STEPS = 3

#: an exposure is useless with, on every feature, at most this share of its best number of points; chosen
STOP_SHARE = 0.3

#: number of sets of one size that are decoded; chosen
TRIED = 8

#: how many of them take part in the decision; chosen
FINALISTS = 5

#: number of the independent noise of the search
SEARCH = 0

#: number of the noise of the decision
DECISION = 1

#: number of the noise of the reported results
REPORT = 2

#: number of noise samples of each
DRAWS = {SEARCH: 2, DECISION: 6, REPORT: 6}

#: returns the result of a set of exposures with the noise of a number and so many samples of it
Evaluate = Callable[[PlannedExposure, int, int], ExposureResult]


@dataclass(frozen=True)
class PlanRules:
    """Rules of a plan: at most ``most`` exposures; ``within`` is the share by which a limit may be missed [1]."""

    most: int = 3
    within: float = 0.1


@dataclass(frozen=True)
class ExposurePlan:
    """Planned exposures of one ``view``, and their results."""

    view: int
    exposure: PlannedExposure  # the planned exposures and power
    #: exposure [s], and the result of it with all before it, the most useful first; with new noise
    added: tuple[tuple[float, ExposureResult], ...]
    default: ExposureResult  # result of the sensor's own exposure rule, with the same noise
    limits: dict[str, FeatureResult]  # most points and smallest u of every feature that can be measured
    reached: bool  # whether the plan reached all limits when it was chosen
    unseen: tuple[str, ...]  # features with too few points at every exposure
    sets_tried: int  # number of decoded sets, single exposures included
    finished: bool = True  # whether time sufficed for sets of several exposures and for the decision among them


class _Results:
    """Results with one noise, each computed once: call it with a set of exposures. ``results`` has all of them.

    The first is computed even if time is over; after it, a call for a new one raises
    :class:`~mitsim.running.time_limit.OutOfTimeError`.
    """

    def __init__(self, evaluate: Evaluate, noise: int, over: Callable[[], bool]) -> None:
        self.evaluate, self.noise, self.over = evaluate, noise, over
        self.results = dict[PlannedExposure, ExposureResult]()

    def __call__(self, exposure: PlannedExposure) -> ExposureResult:
        if exposure not in self.results:
            if self.results and self.over():
                raise OutOfTimeError
            self.results[exposure] = self.evaluate(exposure, self.noise, DRAWS[self.noise])
        return self.results[exposure]


def plan_exposures(
    evaluate: Evaluate,
    default: PlannedExposure,
    limits_s: tuple[float, float],
    rules: PlanRules,
    dimmable: bool = True,
    view: int = 0,
    over: Callable[[], bool] = lambda: False,
) -> ExposurePlan:
    """Plan the exposures of one view, or take the best single exposure that was tried when time ends.

    - ``evaluate``: function of a set of exposures, the number of the noise and the number of its samples, which returns
      the result.
    - ``default``, ``limits_s``: the sensor's own exposures, from which the search starts; shortest and longest exposure
      of the device [s].
    - ``rules``: largest number of exposures, and the share by which a limit may be missed.
    - ``dimmable``, ``view``, ``over``: whether the power may be lowered if the shortest exposure is too bright; number
      of the view, for the plan; returns whether time is over.
    """
    search, decision, report = (_Results(evaluate, noise, over) for noise in (SEARCH, DECISION, REPORT))
    try:
        singles = _sweep(search, default, limits_s, dimmable)
        names = list(singles[0].features)
        full_power = [single for single in singles if single.exposure.power == 1.0]
        # with half of the exposures, the greedy search finds other sets
        sets = [_greedy_sets(search, subset, names, rules.most) for subset in (full_power, full_power[::2])]
        first_limits = _measurable(_limits(list(search.results.values()), names))
        for exposure in {default, *(result.exposure for result in _nearest(singles, first_limits)), *sets[0], *sets[1]}:
            decision(exposure)
        limits = _measurable(_limits(list(decision.results.values()), names))
        chosen, reached = (
            _fewest_exposures(search, decision, full_power, limits, rules) if limits else (decision(default), False)
        )
        added = []
        for prefix in _by_usefulness(decision, chosen.exposure, limits or _limits([chosen], names)):
            added.append((prefix[-1], report(PlannedExposure(tuple(sorted(prefix)), chosen.exposure.power))))
        unseen = tuple(name for name in names if name not in limits)
        tried = len(search.results | decision.results)
        return ExposurePlan(view, chosen.exposure, tuple(added), report(default), limits, reached, unseen, tried)
    except OutOfTimeError:
        return _best_single(search, search.results.get(default) or evaluate(default, SEARCH, DRAWS[SEARCH]), view)


def _best_single(search: _Results, default: ExposureResult, view: int) -> ExposurePlan:
    """Return the single exposure that comes closest to the limits of those tried, as a plan that is not finished."""
    singles = [result for exposure, result in search.results.items() if len(exposure.exposures_s) == 1]
    names = list(default.features)
    limits = _measurable(_limits(singles, names))
    best = min(singles, key=lambda result: (shortfall(result, limits), result.exposure.seconds))
    added = ((best.exposure.exposures_s[0], best),)
    unseen = tuple(name for name in names if name not in limits)
    return ExposurePlan(view, best.exposure, added, default, limits, False, unseen, len(search.results), False)


def shortfall(result: ExposureResult, limits: dict[str, FeatureResult]) -> float:
    """Return by which share a result misses its limits, 0 if it reaches them all.

    It is the largest value, over all features, of n_limit / n - 1 and of u / (u_limit (1 + 2 e)) - 1. Here n is the
    number of points, and e is the relative standard error of u / u_limit from the finite number of noise samples.
    """
    worst = 0.0
    for name, limit in limits.items():
        feature = result.features[name]
        missing_points = limit.points / feature.points - 1 if feature.points > 0 else math.inf
        allowance = 2 * math.hypot(feature.error, limit.error)
        worst = max(worst, missing_points, feature.u / limit.u / (1 + allowance) - 1)
    return worst


def _sweep(
    search: _Results, default: PlannedExposure, limits_s: tuple[float, float], dimmable: bool
) -> list[ExposureResult]:
    """Return the results of single exposures around the sensor's own, shortest first."""
    several = len(default.exposures_s) > 1
    middle = math.exp(np.mean(np.log(default.exposures_s))) if several else default.exposures_s[0]
    shortest, longest = limits_s
    best: dict[str, float] = {}
    results = [search(PlannedExposure((middle,)))]

    def is_useful(result: ExposureResult) -> bool:
        for name, feature in result.features.items():
            best[name] = max(best.get(name, 0.0), feature.points if math.isfinite(feature.u) else 0.0)
        return any(feature.points > STOP_SHARE * best[name] > 0 for name, feature in result.features.items())

    is_useful(results[0])
    steps = math.floor(math.log(LARGEST_RATIO) / math.log(STEP))
    for direction in (1, -1):
        useless_steps = 0
        for k in range(1, steps + 1):
            exposure = _feasible_exposure(middle * STEP ** (direction * k), shortest, longest, dimmable)
            if exposure is None:
                break
            result = search(exposure)
            results.append(result)
            useless_steps = 0 if is_useful(result) else useless_steps + 1
            if useless_steps >= STOP_STEPS and all(best.values()):
                break
            if exposure.exposures_s[0] >= longest:
                break
    unique = {result.exposure: result for result in results}
    return sorted(unique.values(), key=lambda result: result.exposure.seconds * result.exposure.power)


def _feasible_exposure(seconds: float, shortest: float, longest: float, dimmable: bool) -> PlannedExposure | None:
    """Return an exposure with this product of time [s] and power, or the longest; None if the product is too small."""
    if seconds >= longest:
        return PlannedExposure((longest,))
    if seconds >= shortest:
        return PlannedExposure((float(f"{seconds:.3g}"),))  # three digits, so that a user can type it in
    power = seconds / shortest
    return PlannedExposure((shortest,), float(f"{power:.2g}")) if dimmable and power >= LEAST_POWER else None


def _greedy_sets(
    search: _Results, singles: Sequence[ExposureResult], names: Sequence[str], most: int
) -> list[PlannedExposure]:
    """Decode and return sets of two to ``most`` exposures; each adds the one that helps the worst feature most."""
    chosen, sets = list[ExposureResult](), list[PlannedExposure]()
    possible = {name: float(_union(singles, name).sum()) for name in names}
    recovered = [name for name in names if possible[name] > 0]
    for size in range(1, min(most, len(singles)) + 1):

        def least_share(result: ExposureResult) -> float:
            shares = (_union([*chosen, result], name).sum() / possible[name] for name in recovered)
            return float(min(shares, default=0.0))

        chosen.append(max((single for single in singles if single not in chosen), key=least_share))
        if size > 1:
            sets.append(_merged_set(chosen))
            search(sets[-1])
    return sets


def _union(results: Sequence[ExposureResult], name: str) -> NDArray[np.bool_]:
    """Return the mask of the possible points of a feature that any of the results recovered."""
    return np.asarray(np.any([result.recovered[name] for result in results], axis=0))


def _merged_set(results: Sequence[ExposureResult]) -> PlannedExposure:
    """Return the set of several single exposures at full power."""
    return PlannedExposure(tuple(sorted(result.exposure.exposures_s[0] for result in results)))


def _limits(results: Sequence[ExposureResult], names: Sequence[str]) -> dict[str, FeatureResult]:
    """Return the most points and the smallest u of every feature, which may be of different results."""
    out = {}
    for name in names:
        rows = [result.features[name] for result in results]
        most = max(rows, key=lambda row: row.points)
        least = min(rows, key=lambda row: row.u)
        out[name] = FeatureResult(most.points, most.fraction, least.u, least.scatter, least.error)
    return out


def _measurable(limits: dict[str, FeatureResult]) -> dict[str, FeatureResult]:
    """Return the limits of those features that can be measured at some exposure."""
    return {name: limit for name, limit in limits.items() if math.isfinite(limit.u)}


def _nearest(results: Sequence[ExposureResult], limits: dict[str, FeatureResult]) -> list[ExposureResult]:
    """Return the :data:`FINALISTS` results with the smallest shortfall."""
    return sorted(results, key=lambda result: (shortfall(result, limits), result.exposure.seconds))[:FINALISTS]


def _fewest_exposures(
    search: _Results,
    decision: _Results,
    full_power: Sequence[ExposureResult],
    limits: dict[str, FeatureResult],
    rules: PlanRules,
) -> tuple[ExposureResult, bool]:
    """Return the result with the fewest exposures that reaches the limits, or comes closest, and whether it does."""
    for size in range(1, rules.most + 1):
        if size > 1:
            candidates = [search(exposure) for exposure in _candidate_sets(full_power, size, limits, rules.within)]
            for result in _nearest(candidates, limits):
                decision(result.exposure)
        sufficient = [
            result
            for result in decision.results.values()
            if len(result.exposure.exposures_s) == size and shortfall(result, limits) <= rules.within
        ]
        if sufficient:
            return min(sufficient, key=lambda result: result.exposure.seconds), True
    least = min(shortfall(result, limits) for result in decision.results.values())
    near = [result for result in decision.results.values() if shortfall(result, limits) <= least + rules.within]
    return min(near, key=lambda result: (len(result.exposure.exposures_s), result.exposure.seconds)), False


def _candidate_sets(
    full_power: Sequence[ExposureResult], size: int, limits: dict[str, FeatureResult], within: float
) -> list[PlannedExposure]:
    """Return sets of a size that are predicted to recover enough points, the shortest first; then the closest ones."""
    sets = list[tuple[float, float, PlannedExposure]]()
    for results in combinations(full_power, size):
        share = min(float(_union(results, name).sum()) / limit.points for name, limit in limits.items())
        sets.append((share, sum(result.exposure.seconds for result in results), _merged_set(results)))
    sufficient = sorted((row for row in sets if row[0] >= 1 / (1 + within)), key=lambda row: row[1])
    if len(sufficient) < TRIED:  # too few sets are predicted to: add those that come closest
        sufficient += sorted((row for row in sets if row[0] < 1 / (1 + within)), key=lambda row: -row[0])
    return [row[2] for row in sufficient[:TRIED]]


def _by_usefulness(
    search: _Results, exposure: PlannedExposure, limits: dict[str, FeatureResult]
) -> list[tuple[float, ...]]:
    """Return sets of one, two and more of a plan's exposures; each adds the exposure that helps most."""
    remaining, chosen, out = list(exposure.exposures_s), list[float](), list[tuple[float, ...]]()

    def shortage(seconds: float) -> tuple[float, float]:
        """Return the number of features without u, and minus the mean share of the points at the limits."""
        features = search(PlannedExposure(tuple(sorted([*chosen, seconds])), exposure.power)).features
        shares = [features[name].points / max(limits[name].points, 1.0) for name in limits]
        return float(sum(not math.isfinite(features[name].u) for name in limits)), -float(np.mean(shares))

    while remaining:
        chosen.append(remaining[0] if len(remaining) == 1 else min(remaining, key=shortage))
        remaining.remove(chosen[-1])
        out.append(tuple(chosen))
    return out
