"""Find the fewest views that together keep all measurements within their limits.

Signal chain: information P_vf of every view on every feature (the inverse of its expected covariance, 0 for an unseen
feature) -> for a set of views C_f = (sum of P_vf)^-1, all in the part frame -> u_m^2 = sum over features of tr(G_mf
C_f) -> fewest views with u_m <= limit for all m, exactly and greedily.

Views are independent: each has its own noise, and its own pose error. Where poses are not known exactly, "one feature"
is all of them together, with the joint information of :mod:`characterisation.scores.joining`.

With a share x_v of every view, u_m^2(x) is a convex function (matrix-fractional; Boyd and Vandenberghe, Convex
Optimization, 2004, example 3.4). Let x^0 be a set that misses the limit l, and x' a point on the way from x^0 to all
views. The half-space

    u_m^2(x') + sum_v du_m^2/dx_v (x_v - x'_v) <= l^2,      du_m^2/dx_v = -sum_f tr(G_mf C_f P_vf C_f)

contains every set that keeps the limit, and excludes x^0. The fewest views within the half-spaces found so far are a
mixed-integer linear programme (HiGHS through :func:`scipy.optimize.milp`). A set that is optimal in this programme and
keeps all limits is optimal (outer approximation: Duran and Grossmann, Math. Program. 36 (1986) 307-339). Of several
optimal sets of one size, any may be returned.

If views are joined in another way, or have errors in common, u_m is larger and not convex. ``joined`` then gives the
actual uncertainty of a set. The half-spaces remain valid, since no set has less than u_m. A set within them whose
actual uncertainty misses a limit is excluded alone, by sum_(v in it) x_v - sum_(v not in it) x_v <= its size - 1.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp

from characterisation.files.arrays import Floats

#: returns the actual u_m (measurements,) of views chosen by 0 or 1, in the way that they are joined
Joined = Callable[[Floats], Floats]

#: information added everywhere, as a share of the largest of a single view, so that an unseen feature is very uncertain
#: instead of undefined
NOTHING = 1e-9

#: a further view must lower the excess over the limits by at least this share
LEAST_GAIN = 1e-3

#: bisections of the way from a set that misses a limit to all views, to find where the limit is met
_HALVINGS = 40


@dataclass(frozen=True)
class FeatureInformation:
    """Information P_v (views, p, p) on one feature, and its use: G_m (measurements, p, p), 0 where not needed."""

    information: Floats
    quadratic: Floats


@dataclass(frozen=True)
class ViewSet:
    """A set of views.

    ``views`` chosen, ascending; ``uncertainty`` u_m (measurements,) of the set; ``exact`` if proven to be the fewest.
    ``feasible`` (measurements,) says whether a limit can be kept. A limit is dropped if all views together miss it even
    when independent and joined in the best way. It is also dropped if no set of the greedy search kept it.
    """

    views: tuple[int, ...]
    uncertainty: Floats
    feasible: NDArray[np.bool_]
    exact: bool


def set_uncertainty(features: Sequence[FeatureInformation], chosen: Floats) -> Floats:
    """Return u_m (measurements,) of views chosen by shares x (views,), 0 or 1; very large for an unseen feature."""
    return np.asarray(np.sqrt(_total(features, [_covariance(feature, chosen) for feature in features])))


def greedy_views(features: Sequence[FeatureInformation], limits: Floats, joined: Joined | None = None) -> ViewSet:
    """Add views until all limits are met, or none helps; each lowers the sum of ln(u_m / l_m) over unmet limits most.

    ``limits`` l_m (measurements,) [units of the measurement]; ``joined`` returns the actual uncertainty of a set, by
    default :func:`set_uncertainty`. If a limit is never met, the search is repeated without it.
    """
    uncertainty_of = joined or (lambda chosen: set_uncertainty(features, chosen))
    wanted = set_uncertainty(features, np.ones(len(features[0].information))) <= limits
    while True:
        chosen, least = _grown(uncertainty_of, len(features[0].information), limits, wanted)
        missed = wanted & (least > limits)
        if not missed.any():
            break
        wanted = wanted & ~missed
    for view in np.flatnonzero(chosen):  # drop views that later ones have made redundant
        without = chosen.copy()
        without[view] = 0
        if ((uncertainty_of(without) <= limits) | ~wanted).all():
            chosen = without
    return _answer(uncertainty_of, chosen, wanted, exact=False)


def _grown(uncertainty_of: Joined, count: int, limits: Floats, wanted: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return a set to which views were added one by one, and the least u_m (measurements,) on the way."""
    chosen = np.zeros(count)
    at = uncertainty_of(chosen)
    least, excess = at, _excess(at, limits, wanted)
    while excess > 0 and (free := np.flatnonzero(chosen == 0)).size:
        tried = []
        for view in free:
            more = chosen.copy()
            more[view] = 1
            tried.append(uncertainty_of(more))
        after = [_excess(uncertainties, limits, wanted) for uncertainties in tried]
        best = int(np.argmin(after))
        if after[best] > (1 - LEAST_GAIN) * excess:
            break
        chosen[free[best]], excess = 1, after[best]
        least = np.minimum(least, tried[best])
    return chosen, least


def fewest_views(
    features: Sequence[FeatureInformation], limits: Floats, seconds: float = 60.0, joined: Joined | None = None
) -> ViewSet:
    """Return the fewest views that keep all limits.

    ``limits`` and ``joined`` are those of :func:`greedy_views`. After ``seconds``, the time limit of the proof, the
    greedy set is returned, marked as not exact.
    """
    began = time.monotonic()
    uncertainty_of = joined or (lambda chosen: set_uncertainty(features, chosen))
    greedy = greedy_views(features, limits, joined)
    complete = bool(((greedy.uncertainty <= limits) | ~greedy.feasible).all())
    if not greedy.feasible.any() or (complete and len(greedy.views) <= 1):
        return ViewSet(greedy.views, greedy.uncertainty, greedy.feasible, exact=True)
    count = len(features[0].information)
    best = np.isin(np.arange(count), greedy.views).astype(float)
    rows, bounds = list[Floats](), list[float]()
    size = best.sum() if complete else count + 1
    _cut(features, np.zeros(count), limits, greedy.feasible, rows, bounds)
    while (left := seconds - (time.monotonic() - began)) > 0:
        planes = LinearConstraint(np.array(rows), ub=np.array(bounds))
        ones, time_limit = np.ones(count), {"time_limit": left}
        solution = milp(ones, integrality=ones, bounds=Bounds(0, 1), constraints=planes, options=time_limit)
        if solution.x is None or solution.status != 0:
            break
        chosen = np.round(solution.x)
        if chosen.sum() >= size:
            return _answer(uncertainty_of, best, greedy.feasible, exact=True)
        if ((uncertainty_of(chosen) <= limits) | ~greedy.feasible).all():
            return _answer(uncertainty_of, chosen, greedy.feasible, exact=True)
        if (_met(features, chosen, limits) | ~greedy.feasible).all():  # joined in the best way, it keeps the limits
            rows.append(2 * chosen - 1)
            bounds.append(float(chosen.sum()) - 1)
        else:
            _cut(features, chosen, limits, greedy.feasible, rows, bounds)
    return _answer(uncertainty_of, best, greedy.feasible, exact=False)


def _cut(
    features: Sequence[FeatureInformation],
    at: Floats,
    limits: Floats,
    wanted: NDArray[np.bool_],
    rows: list[Floats],
    bounds: list[float],
) -> None:
    """Add a half-space for each measurement that misses its limit at ``at``.

    Its plane touches the boundary on the way from ``at`` to all views. A plane at ``at`` itself would exclude little if
    a feature is unseen there and its uncertainty nearly infinite (supporting hyperplanes: Veinott, Oper. Res. 15 (1967)
    147-152).
    """
    for m in np.flatnonzero(wanted & ~_met(features, at, limits)):
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if _met(features, at + middle * (1 - at), limits)[m] else (middle, high)
        edge = at + low * (1 - at)
        covariances = [_covariance(feature, edge) for feature in features]
        slope = np.zeros(len(at))
        for feature, c in zip(features, covariances, strict=True):
            slope -= np.einsum("ij,vji->v", c @ feature.quadratic[m] @ c, feature.information)
        scale = np.abs(slope).max()
        rows.append(slope / scale)
        bounds.append(float((limits[m] ** 2 - _total(features, covariances)[m] + slope @ edge) / scale))


def _excess(at: Floats, limits: Floats, wanted: NDArray[np.bool_]) -> float:
    return float(np.maximum(np.log(at / limits), 0)[wanted].sum())


def _met(features: Sequence[FeatureInformation], chosen: Floats, limits: Floats) -> NDArray[np.bool_]:
    return np.asarray(set_uncertainty(features, chosen) <= limits)


def _covariance(feature: FeatureInformation, chosen: Floats) -> Floats:
    total = np.tensordot(chosen, feature.information, 1)
    scale = np.sqrt(np.einsum("vii->vi", feature.information).max(0))
    scale[scale == 0] = 1.0
    scaled = total / np.outer(scale, scale) + NOTHING * np.eye(len(scale))
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))


def _total(features: Sequence[FeatureInformation], covariances: Sequence[Floats]) -> Floats:
    """Return u_m^2 (measurements,)."""
    parts = [squares(feature.quadratic, covariance) for feature, covariance in zip(features, covariances, strict=True)]
    return np.asarray(np.sum(parts, axis=0))


def squares(quadratic: Floats, covariance: Floats) -> Floats:
    """Return u_m^2 = tr(G_m C) (measurements,), at least the rounding error of the sum.

    Terms of unseen features are large and cancel in a measurement that does not need them. What is left may be below 0.
    """
    rounding = np.finfo(float).eps * len(covariance) * np.einsum("mij,ji->m", np.abs(quadratic), np.abs(covariance))
    return np.asarray(np.maximum(np.einsum("mij,ji->m", quadratic, covariance), rounding))


def _answer(uncertainty_of: Joined, chosen: Floats, feasible: NDArray[np.bool_], exact: bool) -> ViewSet:
    views = tuple(int(view) for view in np.flatnonzero(chosen))
    return ViewSet(views, uncertainty_of(chosen), feasible, exact)
