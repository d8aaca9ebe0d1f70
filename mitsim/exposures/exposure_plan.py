"""The shortest set of exposures that brings every feature of a view to its limit.

Signal chain: single exposures from the sensor's own outward, within what the device can do -> greedy sets of several
that together bring most points -> the best points and u of every feature that any of these gives: its limit -> the
fewest exposures, and of as few the shortest, that reach all limits to within a share -> the same exposures one after
the other on fresh noise: what each adds.

The projector's power stays full as long as the shortest exposure is not too bright: less of it only asks for a longer
exposure, in which the room adds more light. Below the shortest exposure it is lowered.

Of several exposures the predicted points are those that any of them alone brings back; sets that so could reach the
limits are decoded. The best of many noisy figures flatters: so the search is done with few draws of noise, and what
decides with more draws of other noise. A set is worse than a limit only if it is so by more than twice the standard
error that these leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mitsim.exposures.exposure_sweep import FeatureLook, Look
from mitsim.sensor.exposure import PlannedExposure

#: ratio of single exposures that stand side by side, and the largest ratio to the sensor's own that is tried
STEP, REACH = math.sqrt(2.0), 64.0

#: least power of a projector that is asked for [1]; *assumed*: no maker of the presets states one
LEAST_POWER = 0.1

#: a sweep ends where so many exposures in a row bring less than this share of the best points of every feature
ENOUGH_STEPS, ENOUGH_SHARE = 3, 0.3

#: sets of one size that are decoded in search of one that reaches the limits, and how many are looked at again
TRIED, FINALISTS = 8, 5

#: numbers of the noise of the search, of the decision, and of what a plan is told from
SEARCH, DECISION, TOLD = 0, 1, 2

#: draws of noise of each
DRAWS = {SEARCH: 2, DECISION: 6, TOLD: 6}


@dataclass(frozen=True)
class PlanRules:
    """``most`` exposures of a set; ``within`` share of points and u by which a limit may be missed [1]."""

    most: int = 3
    within: float = 0.1


@dataclass(frozen=True)
class ExposurePlan:
    """Exposures of one view, and what they give.

    ``exposure`` chosen; ``added`` what its exposures give one after the other, the most useful first, each with those
    before it, on fresh noise; ``own`` what the sensor's own rule gives on the same noise; ``limits`` points and u of
    every feature that can be measured; ``reached`` whether the plan, as it was chosen, reached them all; ``unseen``
    features that no exposure brings enough points of.
    """

    view: int
    exposure: PlannedExposure
    added: tuple[tuple[float, Look], ...]
    own: Look
    limits: dict[str, FeatureLook]
    reached: bool
    unseen: tuple[str, ...]
    sets_tried: int


class _Looks:
    """Looks of one noise that were taken, each once."""

    def __init__(self, look: Callable[[PlannedExposure, int, int], Look], noise: int) -> None:
        self.take, self.noise, self.known = look, noise, dict[PlannedExposure, Look]()

    def __call__(self, exposure: PlannedExposure) -> Look:
        if exposure not in self.known:
            self.known[exposure] = self.take(exposure, self.noise, DRAWS[self.noise])
        return self.known[exposure]


def plan_exposures(
    look: Callable[[PlannedExposure, int, int], Look],
    own: PlannedExposure,
    limits_s: tuple[float, float],
    rules: PlanRules,
    dimmable: bool = True,
    view: int = 0,
) -> ExposurePlan:
    """Plan the exposures of one view.

    Parameters
    ----------
    look
        What a set of exposures gives, with the number of the noise and how often it is drawn.
    own
        The sensor's own exposures, from which the search starts.
    limits_s
        Shortest and longest exposure of the device [s].
    dimmable
        Whether the power may be lowered where the shortest exposure is too bright.
    """
    looks, again, told = (_Looks(look, noise) for noise in (SEARCH, DECISION, TOLD))
    singles = _swept(looks, own, limits_s, dimmable)
    names = list(singles[0].features)
    full = [one for one in singles if one.exposure.power == 1.0]
    sets = [_greedy(looks, start, names, rules.most) for start in (full, full[::2])]  # sets of neighbours differ
    rough = _needed(_limits(list(looks.known.values()), names))
    for exposure in {own, *(one.exposure for one in _nearest(singles, rough)), *(one for some in sets for one in some)}:
        again(exposure)
    limits = _needed(_limits(list(again.known.values()), names))
    chosen, reached = _fewest(looks, again, full, limits, rules) if limits else (again(own), False)
    added = []
    for prefix in _in_order(again, chosen.exposure, limits or _limits([chosen], names)):
        added.append((prefix[-1], told(PlannedExposure(tuple(sorted(prefix)), chosen.exposure.power))))
    unseen = tuple(name for name in names if name not in limits)
    return ExposurePlan(
        view, chosen.exposure, tuple(added), told(own), limits, reached, unseen, len(looks.known | again.known)
    )


def shortfall(one: Look, limits: dict[str, FeatureLook]) -> float:
    """How far a look is from all limits: the largest of n_limit / n - 1 and u / u_limit - 1 of the features.

    What the draws of noise leave open counts in favour of the look, by two standard errors of the difference.
    """
    worst = 0.0
    for name, limit in limits.items():
        known = one.features[name]
        few = limit.points / known.points - 1 if known.points > 0 else math.inf
        open_ = 2 * math.hypot(known.error, limit.error)
        worst = max(worst, few, known.u / limit.u / (1 + open_) - 1)
    return worst


def _swept(looks: _Looks, own: PlannedExposure, limits_s: tuple[float, float], dimmable: bool) -> list[Look]:
    """Single exposures, shortest first, from the sensor's own outward, until all is found and they bring nothing."""
    middle = math.exp(np.mean(np.log(own.exposures_s)))
    shortest, longest = limits_s
    best: dict[str, float] = {}
    found = [looks(PlannedExposure((middle,)))]

    def worth(one: Look) -> bool:
        for name, known in one.features.items():
            best[name] = max(best.get(name, 0.0), known.points if math.isfinite(known.u) else 0.0)
        return any(known.points > ENOUGH_SHARE * best[name] > 0 for name, known in one.features.items())

    worth(found[0])
    steps = math.floor(math.log(REACH) / math.log(STEP))
    for direction in (1, -1):
        barren = 0
        for k in range(1, steps + 1):
            exposure = _within(middle * STEP ** (direction * k), shortest, longest, dimmable)
            if exposure is None:
                break
            one = looks(exposure)
            found.append(one)
            barren = 0 if worth(one) else barren + 1
            if barren >= ENOUGH_STEPS and all(best.values()):
                break
            if exposure.exposures_s[0] >= longest:
                break
    unique = {one.exposure: one for one in found}
    return sorted(unique.values(), key=_product)


def _within(seconds: float, shortest: float, longest: float, dimmable: bool) -> PlannedExposure | None:
    """A single exposure of a device that gives this product of time and power; None where it cannot."""
    if seconds >= longest:
        return PlannedExposure((longest,))
    if seconds >= shortest:
        return PlannedExposure((_rounded(seconds),))
    power = seconds / shortest
    return PlannedExposure((shortest,), float(f"{power:.2g}")) if dimmable and power >= LEAST_POWER else None


def _rounded(seconds: float) -> float:
    """Two digits more than any device needs: what is planned can be typed in."""
    return float(f"{seconds:.3g}")


def _product(one: Look) -> float:
    return one.exposure.seconds * one.exposure.power


def _greedy(looks: _Looks, singles: Sequence[Look], names: Sequence[str], most: int) -> list[PlannedExposure]:
    """Decode sets of two and more of the single exposures that bring most points together, each one more."""
    chosen, sets = list[Look](), list[PlannedExposure]()
    possible = {name: float(_union(singles, name).sum()) for name in names}
    seen = [name for name in names if possible[name] > 0]
    for size in range(1, min(most, len(singles)) + 1):
        free = [one for one in singles if one not in chosen]
        chosen.append(
            max(
                free,
                key=lambda one: min(
                    (_union([*chosen, one], name).sum() / possible[name] for name in seen), default=0.0
                ),
            )
        )
        if size > 1:
            sets.append(_set_of(chosen))
            looks(sets[-1])
    return sets


def _union(some: Sequence[Look], name: str) -> NDArray[np.bool_]:
    return np.asarray(np.any([one.seen[name] for one in some], axis=0))


def _set_of(some: Sequence[Look]) -> PlannedExposure:
    return PlannedExposure(tuple(sorted(one.exposure.exposures_s[0] for one in some)))


def _limits(some: Sequence[Look], names: Sequence[str]) -> dict[str, FeatureLook]:
    """Most points and least u of every feature, each of any look."""
    out = {}
    for name in names:
        rows = [one.features[name] for one in some]
        most = max(rows, key=lambda row: row.points)
        least = min(rows, key=lambda row: row.u)
        out[name] = FeatureLook(most.points, most.fraction, least.u, least.scatter, least.error)
    return out


def _needed(limits: dict[str, FeatureLook]) -> dict[str, FeatureLook]:
    """Those of the features that can be measured at any exposure."""
    return {name: one for name, one in limits.items() if math.isfinite(one.u)}


def _nearest(some: Sequence[Look], limits: dict[str, FeatureLook]) -> list[Look]:
    """The few that come nearest to the limits."""
    return sorted(some, key=lambda one: (shortfall(one, limits), one.exposure.seconds))[:FINALISTS]


def _fewest(
    looks: _Looks, again: _Looks, full: Sequence[Look], limits: dict[str, FeatureLook], rules: PlanRules
) -> tuple[Look, bool]:
    """The fewest exposures that reach the limits, of as few the shortest; else of those that come about as near."""
    for size in range(1, rules.most + 1):
        if size > 1:
            wanted = [looks(exposure) for exposure in _promising(full, size, limits, rules.within)]
            for one in _nearest(wanted, limits):
                again(one.exposure)
        able = [
            one
            for one in again.known.values()
            if len(one.exposure.exposures_s) == size and shortfall(one, limits) <= rules.within
        ]
        if able:
            return min(able, key=lambda one: one.exposure.seconds), True
    least = min(shortfall(one, limits) for one in again.known.values())
    near = [one for one in again.known.values() if shortfall(one, limits) <= least + rules.within]
    return min(near, key=lambda one: (len(one.exposure.exposures_s), one.exposure.seconds)), False


def _promising(full: Sequence[Look], size: int, limits: dict[str, FeatureLook], within: float) -> list[PlannedExposure]:
    """Sets of a size that together may bring the points that are asked for, the shortest first."""
    sets = list[tuple[float, float, PlannedExposure]]()
    for some in combinations(full, size):
        share = min(float(_union(some, name).sum()) / limit.points for name, limit in limits.items())
        sets.append((share, sum(one.exposure.seconds for one in some), _set_of(some)))
    able = sorted((one for one in sets if one[0] >= 1 / (1 + within)), key=lambda one: one[1])
    if len(able) < TRIED:  # none is predicted to: those that come nearest
        able += sorted((one for one in sets if one[0] < 1 / (1 + within)), key=lambda one: -one[0])
    return [one[2] for one in able[:TRIED]]


def _in_order(looks: _Looks, exposure: PlannedExposure, limits: dict[str, FeatureLook]) -> list[tuple[float, ...]]:
    """Longer and longer sets of a plan's exposures, each with the one more that helps most."""
    left, chosen, out = list(exposure.exposures_s), list[float](), list[tuple[float, ...]]()
    while left:
        if len(left) == 1:
            best = left[0]
        else:
            best = min(
                left,
                key=lambda seconds: _missing(
                    looks(PlannedExposure(tuple(sorted([*chosen, seconds])), exposure.power)), limits
                ),
            )
        left.remove(best)
        chosen.append(best)
        out.append(tuple(chosen))
    return out


def _missing(one: Look, limits: dict[str, FeatureLook]) -> tuple[float, float]:
    """How many features have no u, and the mean share of points that is missing."""
    without = sum(not math.isfinite(one.features[name].u) for name in limits)
    shares = [one.features[name].points / max(limits[name].points, 1.0) for name in limits]
    return float(without), -float(np.mean(shares))
