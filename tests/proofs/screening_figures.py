"""Test whether a score ranks the best views first, with the true risks of the views.

Signal chain: cost of every view by a score, lower is better, infinite for a view predicted to be impossible; errors of
the view in many worlds -> true risk (:func:`tests.proofs.judgement.true_risk`) -> recall of the first
views, rank correlation with the ceiling that the number of worlds sets, ROC area of *can be measured*.

Every score is treated equally: views that it predicts to be impossible are tied behind all others, and are never among
the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.scores.deciles import spearman
from tests.proofs.judgement import true_risk

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

#: least share of the worlds in which a measurable view gives a value
LEAST_MEASURABLE = 0.5

#: a view with a risk larger than the least by at most this share is as good as the best
WITHIN = 0.1

#: number of random halves of the worlds for a ceiling, and of resamples of the views for an interval
_HALVES, _RESAMPLES = 100, 400

#: edges of the bins of a reliability diagram
CHANCE_EDGES = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])


@dataclass(frozen=True)
class Screened:
    """One measurement of one case: ``cost`` (v,) of a score, ``errors`` (v, w), NaN in worlds without a value."""

    cost: Floats
    errors: Floats

    @property
    def risk(self) -> Floats:
        """Return the true risk (v,) of the views, infinite where no world gave a value."""
        return true_risk(self.errors)

    @property
    def measurable(self) -> NDArray[np.bool_]:
        """Return which views (v,) can be measured from."""
        return np.asarray(np.isfinite(self.errors).mean(axis=1) >= LEAST_MEASURABLE)

    def of(self, places: Places) -> Screened:
        """Return the same with some of the views; views may occur more than once."""
        return Screened(self.cost[places], self.errors[places])


def recall(one: Screened, first: int) -> float:
    """Return 1 if a view as good as the best is among the ``first`` of the score's order, else 0.

    It is NaN if no view can be measured from. Of views of equal cost, the earlier in the list comes first.
    """
    if not one.measurable.any():
        return math.nan
    risk = np.where(one.measurable, one.risk, np.inf)
    ahead = [i for i in np.argsort(one.cost, kind="stable")[:first] if np.isfinite(one.cost[i])]
    return float(any(risk[i] <= (1 + WITHIN) * risk.min() for i in ahead))


def rank_correlation(one: Screened) -> float:
    """Return Spearman's correlation of cost and true risk over the measurable views; NaN for fewer than 4 of them."""
    able = one.measurable
    return spearman(_finite(one.cost)[able], one.risk[able])


def ceiling(errors: ArrayLike, seed: int = 0) -> float:
    """Return the rank correlation that the best possible score would have with risks from the given number of worlds.

    Let r be the correlation of risks from two halves of the worlds. Risks from all worlds would correlate with others
    like them by 2 r / (1 + r) (Spearman and Brown, 1910), and with their expectation by the square root of this
    (attenuation: Spearman 1904). Only measurable views are used; NaN for fewer than 4 of them. For ranks these
    relations are approximate: with 6 worlds the ceiling is too high by 0.03, with 12 or more it is right within 0.02.
    """
    one = Screened(np.zeros(len(np.asarray(errors))), np.asarray(errors, float))
    known = one.errors[one.measurable]
    if len(known) < 4:
        return math.nan
    rng, worlds, found = np.random.default_rng(seed), known.shape[1], []
    for _ in range(_HALVES):
        order = rng.permutation(worlds)
        first, second = (true_risk(known[:, half]) for half in np.array_split(order, 2))
        found.append(spearman(_finite(first), _finite(second)))
    r = float(np.nanmean(found)) if np.isfinite(found).any() else math.nan
    return math.sqrt(2 * r / (1 + r)) if r > 0 else math.nan if math.isnan(r) else 0.0


def measurable_area(one: Screened) -> float:
    """Return the area under the ROC curve by which the score separates measurable views from the others.

    It is NaN if all views are of one kind.
    """
    return roc_area(-one.cost, one.measurable)


def roc_area(score: Floats, measurable: NDArray[np.bool_]) -> float:
    """Return the area under the ROC curve of a score that separates measurable views from the others.

    It is the probability that a measurable view scores higher than another, a tie counting as half (Mann and Whitney's
    U over its greatest value; Hanley and McNeil, Radiology 143 (1982) 29-36). Views predicted to be impossible, NaN or
    -inf, score lowest. The area is NaN, not defined, where all views are of one kind.
    """
    known = np.where(score > -np.inf, score, -np.inf)
    yes, no = known[measurable, None], known[~measurable]
    if not yes.size or not no.size:
        return math.nan
    return float((np.count_nonzero(yes > no) + np.count_nonzero(yes == no) / 2) / (yes.size * no.size))


def attainable_recall(one: Screened, first: int, seed: int = 0) -> float:
    """Return the recall of an order by the risks of one half of the worlds, tested in the other half.

    It is NaN as :func:`recall`. It is the recall that the noise of the true risks allows. It is slightly too low,
    because only half of the worlds are used for the test.
    """
    if not one.measurable.any():
        return math.nan
    rng, worlds, found = np.random.default_rng(seed), one.errors.shape[1], []
    for _ in range(_HALVES):
        ordered, judging = np.array_split(rng.permutation(worlds), 2)
        found.append(recall(Screened(true_risk(one.errors[:, ordered]), one.errors[:, judging]), first))
    return float(np.nanmean(found)) if np.isfinite(found).any() else math.nan


def interval(
    groups: Sequence[Sequence[Screened]], figure: Callable[[Screened], float], seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of a figure over measurements, by a bootstrap over views (Efron 1979).

    The measurements of one group have the same views, which are drawn together.
    """
    rng, found = np.random.default_rng(seed), []
    for _ in range(_RESAMPLES):
        values = []
        for cells in groups:
            places = rng.integers(len(cells[0].cost), size=len(cells[0].cost))
            values += [figure(cell.of(places)) for cell in cells]
        known = [value for value in values if not math.isnan(value)]
        if known:
            found.append(float(np.mean(known)))
    if not found:
        return math.nan, math.nan
    low, high = np.quantile(found, [0.025, 0.975])
    return float(low), float(high)


@dataclass(frozen=True)
class Reliability:
    """Predicted chances and measured shares by bin of :data:`CHANCE_EDGES`, NaN in an empty bin.

    ``predicted`` is the mean chance, ``found`` the share of worlds with a value, and ``views`` their number in the bin.
    """

    predicted: Floats
    found: Floats
    views: Places


def reliability(chance: ArrayLike, errors: ArrayLike) -> Reliability:
    """Compare chances (n,) of views with the share of worlds (n, w) that gave a value."""
    predicted, known = np.asarray(chance, float), np.isfinite(np.asarray(errors, float)).mean(axis=1)
    bins = np.clip(np.digitize(predicted, CHANCE_EDGES[1:-1]), 0, len(CHANCE_EDGES) - 2)
    count = np.bincount(bins, minlength=len(CHANCE_EDGES) - 1)
    with np.errstate(invalid="ignore"):
        mean = [np.bincount(bins, weights=values, minlength=len(count)) / count for values in (predicted, known)]
    return Reliability(mean[0], mean[1], count)


def _finite(values: Floats) -> Floats:
    """Replace infinite values by one that is larger than all others, so that they are tied."""
    known = values[np.isfinite(values)]
    return np.where(np.isfinite(values), values, known.max() + 1 if len(known) else 0.0)
