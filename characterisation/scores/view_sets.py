r"""The fewest views that together measure everything to within its limits.

Signal chain: information P_vf of every view on every feature (the inverse of its expected covariance, 0 where it does
not see it) -> of a set of views C_f = (sum of P_vf)^-1, all in the part frame -> u_m^2 = sum over features of
tr(G_mf C_f) -> fewest views with u_m <= limit for all m, exactly and greedily.

Views are independent: each has noise, and an error of its pose, of its own. Where poses are not known exactly, "one
feature" is all of them together, with the joint information of :mod:`characterisation.scores.joining`. With a chosen
share x_v of every view, u_m^2(x) is a convex function (matrix-fractional; Boyd and Vandenberghe, Convex Optimization,
2004, example 3.4), so for any set x^0 that misses the limit l the plane

    u_m^2(x') + sum_v du_m^2/dx_v (x_v - x'_v) <= l^2,      du_m^2/dx_v = -sum_f tr(G_mf C_f P_vf C_f)

holds for every set that keeps it, and not for x^0; x' is on the way from x^0 to all views. Choosing the fewest views
under the planes found so far is a mixed-integer linear programme (HiGHS through :func:`scipy.optimize.milp`); a set
that is optimal under the planes and keeps all limits in truth is optimal (outer approximation: Duran and Grossmann,
Math. Program. 36 (1986) 307-339). Of sets of one size any may be the answer.

Views may be joined in a way that is not the best, or have errors in common, and then nothing is convex: ``told`` says
what a set really gives. The planes hold still, for no set gives less than u_m; one that keeps the planes and misses a
limit as told is excluded alone, by sum_(v in it) x_v - sum_(v not in it) x_v <= its size - 1.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp

Floats = NDArray[np.float64]

#: u_m (measurements,) of views chosen by 0 or 1, as they are really joined
Told = Callable[[Floats], Floats]

#: information that stands in where no chosen view has any, as a share of the largest of a single view: it makes an
#: unseen feature very uncertain instead of undefined
NOTHING = 1e-9

#: share of the excess over the limits by which a further view has to lower it
LEAST_GAIN = 1e-3

#: of the way from a set that misses a limit to all views, to find where the limit is met
_HALVINGS = 40


@dataclass(frozen=True)
class Feature:
    """``information`` (views, p, p) P_v of one feature; ``quadratic`` (measurements, p, p) G_m, 0 where not needed."""

    information: Floats
    quadratic: Floats


@dataclass(frozen=True)
class ViewSet:
    """``views`` chosen, ascending; ``uncertainty`` u_m (measurements,) of the set; ``exact`` if proven the fewest.

    ``feasible`` (measurements,): whether the limit can be kept. One that all views together miss, even if they were
    independent and joined as best one can, is left out; so is one that no set kept on the way of the greedy search.
    """

    views: tuple[int, ...]
    uncertainty: Floats
    feasible: NDArray[np.bool_]
    exact: bool


def set_uncertainty(features: Sequence[Feature], chosen: Floats) -> Floats:
    """u_m (measurements,) of views chosen by shares x (views,), 0 or 1; very large where a needed feature is unseen."""
    return np.asarray(np.sqrt(_total(features, [_covariance(feature, chosen) for feature in features])))


def greedy_views(features: Sequence[Feature], limits: Floats, told: Told | None = None) -> ViewSet:
    """Add the view that lowers the sum of ln(u_m / l_m) over unmet limits most, until all are met, or none helps.

    ``limits`` l_m (measurements,) [units of the measurement]; ``told`` what a set gives, if not
    :func:`set_uncertainty`. A limit that is met on no way is left out, and the search made again without it.
    """
    gives = told or (lambda chosen: set_uncertainty(features, chosen))
    wanted = set_uncertainty(features, np.ones(len(features[0].information))) <= limits
    while True:
        chosen, least = _grown(gives, len(features[0].information), limits, wanted)
        missed = wanted & (least > limits)
        if not missed.any():
            break
        wanted = wanted & ~missed
    for view in np.flatnonzero(chosen):  # one that later ones have made needless
        without = chosen.copy()
        without[view] = 0
        if ((gives(without) <= limits) | ~wanted).all():
            chosen = without
    return _answer(gives, chosen, wanted, exact=False)


def _grown(gives: Told, count: int, limits: Floats, wanted: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """A set to which views were added one by one, and the least u_m (measurements,) of all on the way."""
    chosen = np.zeros(count)
    at = gives(chosen)
    least, excess = at, _excess(at, limits, wanted)
    while excess > 0 and (free := np.flatnonzero(chosen == 0)).size:
        tried = []
        for view in free:
            more = chosen.copy()
            more[view] = 1
            tried.append(gives(more))
        after = [_excess(one, limits, wanted) for one in tried]
        best = int(np.argmin(after))
        if after[best] > (1 - LEAST_GAIN) * excess:
            break
        chosen[free[best]], excess = 1, after[best]
        least = np.minimum(least, tried[best])
    return chosen, least


def fewest_views(
    features: Sequence[Feature], limits: Floats, seconds: float = 60.0, told: Told | None = None
) -> ViewSet:
    """The fewest views that keep all limits; the greedy set, marked as not exact, if that is not proven in time."""
    began = time.monotonic()
    gives = told or (lambda chosen: set_uncertainty(features, chosen))
    greedy = greedy_views(features, limits, told)
    able = bool(((greedy.uncertainty <= limits) | ~greedy.feasible).all())
    if not greedy.feasible.any() or (able and len(greedy.views) <= 1):
        return ViewSet(greedy.views, greedy.uncertainty, greedy.feasible, exact=True)
    count = len(features[0].information)
    best, rows, bounds = _indicator(greedy.views, count), list[Floats](), list[float]()
    size = best.sum() if able else count + 1
    _cut(features, np.zeros(count), limits, greedy.feasible, rows, bounds)
    while (left := seconds - (time.monotonic() - began)) > 0:
        planes = LinearConstraint(np.array(rows), ub=np.array(bounds))
        found = milp(
            np.ones(count),
            integrality=np.ones(count),
            bounds=Bounds(0, 1),
            constraints=planes,
            options={"time_limit": left},
        )
        if found.x is None or found.status != 0:
            break
        chosen = np.round(found.x)
        if chosen.sum() >= size:
            return _answer(gives, best, greedy.feasible, exact=True)
        if ((gives(chosen) <= limits) | ~greedy.feasible).all():
            return _answer(gives, chosen, greedy.feasible, exact=True)
        if (_met(features, chosen, limits) | ~greedy.feasible).all():  # it would do, joined otherwise
            rows.append(2 * chosen - 1)
            bounds.append(float(chosen.sum()) - 1)
        else:
            _cut(features, chosen, limits, greedy.feasible, rows, bounds)
    return _answer(gives, best, greedy.feasible, exact=False)


def _cut(
    features: Sequence[Feature],
    at: Floats,
    limits: Floats,
    wanted: NDArray[np.bool_],
    rows: list[Floats],
    bounds: list[float],
) -> None:
    """Add a plane for each measurement that misses its limit at ``at``: where the way from there to all views meets it.

    A plane at ``at`` itself would hardly cut, if a feature is unseen there and its uncertainty all but infinite
    (supporting hyperplanes: Veinott, Oper. Res. 15 (1967) 147-152).
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


def _met(features: Sequence[Feature], chosen: Floats, limits: Floats) -> NDArray[np.bool_]:
    return np.asarray(set_uncertainty(features, chosen) <= limits)


def _covariance(feature: Feature, chosen: Floats) -> Floats:
    total = np.tensordot(chosen, feature.information, 1)
    scale = np.sqrt(np.einsum("vii->vi", feature.information).max(0))
    scale[scale == 0] = 1.0
    scaled = total / np.outer(scale, scale) + NOTHING * np.eye(len(scale))
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))


def _total(features: Sequence[Feature], covariances: Sequence[Floats]) -> Floats:
    """u_m^2 (measurements,)."""
    parts = [np.einsum("mij,ji->m", f.quadratic, c) for f, c in zip(features, covariances, strict=True)]
    return np.asarray(np.sum(parts, axis=0))


def _indicator(views: Sequence[int], count: int) -> Floats:
    chosen = np.zeros(count)
    chosen[list(views)] = 1
    return chosen


def _answer(gives: Told, chosen: Floats, feasible: NDArray[np.bool_], exact: bool) -> ViewSet:
    views = tuple(int(view) for view in np.flatnonzero(chosen))
    return ViewSet(views, gives(chosen), feasible, exact)
