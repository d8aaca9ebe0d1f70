"""Is a view score right? What a score said of views, held against the true errors that were measured from them.

Signal chain: true error (views, repeats) of one measurement of one sample -> mean |error| of each view, and whether the
view could be measured -> by decile of the score: mean and standard deviation, the talk's plots; their rank correlation
and the views'; regret of the best decile; ROC area; separation within the best 30 % -> one row for each score.

The plots are those of the talk "Task Specific Viewpoint Optimisation" (Kinnell and Justham, Hamburg 2018, slides
"Example Result" and "View Score Accuracy"): views in bins at 10 % intervals of the score, "each decile of views by
their mean true measurement error and uncertainty". The talk does not say more, and is read like this:

- the true error of a view is the mean of |error| over the repeats in which it could be measured;
- a view is measurable if that was at least half of them; the others have no error, and rank as worst, tied;
- a decile's mean is that of its measurable views, each view counting once, and its standard deviation that of the
  signed errors of all their repeats, so both the spread between views and the noise are in it;
- deciles are ranked by their mean; one of which fewer than half of the views are measurable ranks after all the others,
  by the share that is;
- views that the score says to be impossible have a bin of their own, which has no rank.

So the deciles of two scores that call different views impossible hold different views, and the one that calls none so
has the easier task of telling good views from hopeless ones. The correlations over all views, and over the measurable
ones, are over the same views for every score.

Repeats are few and views many, so the best tenth by measured error is in part the luckiest: no score, however right,
need reach a regret of 1 or a correlation of 1. How near one can come is told by a row of its own, in which half of the
repeats foretell the other half (:func:`halved`). A score that knew the expected errors would do better than that row.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from characterisation.errors import InputError
from characterisation.scores.rank_agreement import (
    DECILES,
    agreement_ranks,
    deciles,
    roc_area,
    said_possible,
    spearman,
    spearman_interval,
)

Floats = NDArray[np.float64]

#: names of the score that must be beaten, of the predicted uncertainty as a score, and of the repeats as one
V_M, UNCERTAINTY, REPEATS = "V_m", "predicted uncertainty", "half of its repeats"

#: a view, and a decile of views, counts as measurable from this share on
LEAST_MEASURABLE = 0.5

#: the talk finds "less distinction between top 30 % of views"
TOP_DECILES = 3


@dataclass(frozen=True)
class CheckedViews:
    """One measurement of one sample, from views that were rendered or captured to check what was said of them.

    ``unit`` of the errors; ``scores`` by name, each (views,), higher is better, NaN or -inf where the view is said to
    be impossible; ``error`` (views, repeats) value minus nominal, NaN in repeats that could not be measured;
    ``predicted_uncertainty`` (views,) standard uncertainty, NaN where the view is said to be impossible;
    ``tolerance`` plus or minus, NaN where the task has none. Unless the scores hold it already, the predicted
    uncertainty becomes one of them under the name :data:`UNCERTAINTY`, the smaller the better.

    Raises
    ------
    InputError
        If the shapes do not fit, or a number cannot be what it should.
    """

    measurement: str
    sample: str
    unit: str
    scores: Mapping[str, Floats] = field(repr=False)
    error: Floats = field(repr=False)
    predicted_uncertainty: Floats = field(repr=False)
    tolerance: float = math.nan

    def __post_init__(self) -> None:
        place = f"{self.measurement}, {self.sample}"
        error = np.asarray(self.error, float)
        if error.ndim != 2 or not error.size:
            raise InputError(place, "error", f"shape {error.shape}", "(views, repeats), one of each or more")
        if np.isinf(error).any():
            raise InputError(place, "error", "inf", "numbers, and NaN where a repeat could not be measured")
        uncertainty = np.asarray(self.predicted_uncertainty, float)
        if uncertainty.shape != error.shape[:1]:
            raise InputError(place, "predicted_uncertainty", f"shape {uncertainty.shape}", f"({len(error)},)")
        if (np.isinf(uncertainty) | (uncertainty <= 0)).any():
            found = uncertainty[np.isinf(uncertainty) | (uncertainty <= 0)][0]
            raise InputError(place, "predicted_uncertainty", found, "a positive number, or NaN where impossible")
        if self.tolerance <= 0:
            raise InputError(place, "tolerance", self.tolerance, "a positive number, or NaN for none")
        scores = {name: np.asarray(score, float) for name, score in self.scores.items()}
        for name, score in scores.items():
            if score.shape != error.shape[:1]:
                raise InputError(place, f"scores[{name!r}]", f"shape {score.shape}", f"({len(error)},)")
            if (score == np.inf).any():
                raise InputError(place, f"scores[{name!r}]", "inf", "numbers, and NaN or -inf where impossible")
        if UNCERTAINTY not in scores:
            scores[UNCERTAINTY] = -uncertainty
        for name, value in (("scores", scores), ("error", error), ("predicted_uncertainty", uncertainty)):
            object.__setattr__(self, name, value)

    @property
    def seed(self) -> int:
        """What breaks ties among its scores: another stream for every measurement and sample, the same every time."""
        return zlib.crc32(f"{self.measurement}\n{self.sample}".encode())


@dataclass(frozen=True)
class DecileErrors:
    """True errors by decile of a score, best first, and last the views said to be impossible: arrays (11,).

    ``views``; ``measurable`` share of them; ``mean`` of |error| and ``std`` of the signed error [unit of the
    measurement]; ``rank`` (10,) by mean, 1 is least, all NaN where the score leaves fewer than ten views. NaN where a
    bin has nothing to say.
    """

    views: NDArray[np.int64]
    measurable: Floats
    mean: Floats
    std: Floats
    rank: Floats


@dataclass(frozen=True)
class ScoreRow:
    """How one score did at one measurement of one sample. NaN is a figure that is not defined there.

    ``views`` all, ``possible`` by the score, ``measurable`` in truth; ``decile_ranks`` (10,) as in
    :class:`DecileErrors`. Rank correlations with minus the true error, 1 is perfect: ``decile_spearman`` of the ten
    deciles; ``view_spearman`` of all views and its 95 % interval, ``view_spearman_low`` and ``_high``;
    ``measurable_spearman`` of the views that are measurable; ``top_spearman`` of the best 30 % by the score.
    ``regret`` mean true error in the score's best decile over that of as many best views in truth, 1 is perfect, inf
    where no view of that decile is measurable; ``lost`` share of that decile which is not, 0 is perfect; ``within``
    share of its repeats that were measured to within the tolerance. ``roc_area`` of measurable or not, 1 is perfect.
    ``top_ratio`` mean true error of the worst third of the best 30 % over that of its best third, over 1 where the
    score still tells them apart.
    """

    measurement: str
    sample: str
    score: str
    views: int
    possible: int
    measurable: int
    decile_spearman: float
    view_spearman: float
    view_spearman_low: float
    view_spearman_high: float
    measurable_spearman: float
    regret: float
    lost: float
    within: float
    roc_area: float
    top_spearman: float
    top_ratio: float
    decile_ranks: Floats = field(repr=False)


def view_errors(error: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Mean |error| (views,) over the repeats that could be measured, NaN if the view is not measurable; and if it is.

    ``error`` (views, repeats), NaN where a repeat could not be measured.
    """
    known = np.isfinite(error)
    measurable = known.mean(axis=1) >= LEAST_MEASURABLE
    total = np.where(known, np.abs(error), 0.0).sum(axis=1)
    mean = np.full(len(error), np.nan)
    np.divide(total, known.sum(axis=1), out=mean, where=measurable)
    return mean, measurable


def decile_errors(checked: CheckedViews, score: str) -> DecileErrors:
    """True errors by decile of one of the scores."""
    mean, measurable = view_errors(checked.error)
    bins = deciles(checked.scores[score], checked.seed)
    views = np.bincount(bins, minlength=DECILES + 1)
    share, means, stds = (np.full(DECILES + 1, np.nan) for _ in range(3))
    for number in np.flatnonzero(views):
        here = bins == number
        share[number] = measurable[here].mean()
        signed = checked.error[here & measurable]
        signed = signed[np.isfinite(signed)]
        if len(signed):
            means[number] = mean[here & measurable].mean()
        if len(signed) > 1:
            stds[number] = signed.std(ddof=1)
    return DecileErrors(views, share, means, stds, _decile_ranks(share[:DECILES], means[:DECILES]))


def judge(checked: CheckedViews, score: str) -> ScoreRow:
    """Hold one of the scores against the true errors."""
    mean, measurable = view_errors(checked.error)
    said, seed = checked.scores[score], checked.seed
    bins = deciles(said, seed)
    ranks = decile_errors(checked, score).rank
    x, y = agreement_ranks(said, mean)
    low, high = spearman_interval(x, y, seed)
    chosen, top = bins == 0, bins < TOP_DECILES
    return ScoreRow(
        checked.measurement, checked.sample, score,
        views=len(said), possible=int(said_possible(said).sum()), measurable=int(measurable.sum()),
        decile_spearman=spearman(np.arange(DECILES), ranks) if np.isfinite(ranks).all() else math.nan,
        view_spearman=spearman(x, y), view_spearman_low=low, view_spearman_high=high,
        measurable_spearman=spearman(x[measurable], y[measurable]),
        regret=_regret(mean, chosen),
        lost=1 - float(measurable[chosen].mean()) if chosen.any() else math.nan,
        within=_within(checked.error[chosen], checked.tolerance),
        roc_area=roc_area(said, measurable),
        top_spearman=spearman(x[top], y[top]),
        top_ratio=_ratio(mean[bins == TOP_DECILES - 1], mean[chosen]),
        decile_ranks=ranks,
    )  # fmt: skip


def halved(checked: CheckedViews) -> CheckedViews | None:
    """The odd repeats, foretold by the even ones: the score :data:`REPEATS` is minus their mean |error|.

    None where there is one repeat only.
    """
    if checked.error.shape[1] < 2:
        return None
    before, _ = view_errors(checked.error[:, ::2])
    return replace(checked, scores={REPEATS: -before}, error=checked.error[:, 1::2])


def score_rows(every: Sequence[CheckedViews]) -> list[ScoreRow]:
    """A row for each score of each measurement and sample, and for its repeats.

    Raises
    ------
    InputError
        If a measurement of a sample is there twice.
    """
    rows, seen = list[ScoreRow](), set[tuple[str, str]]()
    for checked in every:
        place = checked.measurement, checked.sample
        if place in seen:
            raise InputError("score_rows", "every", f"{', '.join(place)} twice", "each measurement of a sample once")
        seen.add(place)
        rows += [judge(checked, name) for name in checked.scores]
        half = halved(checked)
        rows += [judge(half, REPEATS)] if half else []
    return rows


def _decile_ranks(share: Floats, mean: Floats) -> Floats:
    """Rank of each decile (10,), 1 is best: by mean where enough is measurable, and the others after, by share."""
    if np.isnan(share).any():
        return np.full(DECILES, np.nan)
    good = share >= LEAST_MEASURABLE
    ranks = np.empty(DECILES)
    ranks[good] = rankdata(mean[good])
    ranks[~good] = good.sum() + rankdata(-share[~good])
    return ranks


def _regret(mean: Floats, chosen: NDArray[np.bool_]) -> float:
    """Mean true error of the chosen views over that of as many best ones; ``mean`` (views,), NaN if not measurable."""
    known = np.sort(mean[np.isfinite(mean)])
    picked = np.sort(mean[chosen & np.isfinite(mean)])  # summed in the same order as the best: 1 is exactly 1
    if not chosen.any() or not len(known):
        return math.nan
    if not len(picked):
        return math.inf
    best = float(known[: len(picked)].mean())
    if best == 0:
        return 1.0 if not picked.any() else math.inf
    return float(picked.mean()) / best


def _within(error: Floats, tolerance: float) -> float:
    """Share of the repeats that were measured, and to within the tolerance; NaN without either."""
    if math.isnan(tolerance) or not error.size:
        return math.nan
    return float((np.abs(error) <= tolerance).mean())  # NaN is not


def _ratio(worse: Floats, better: Floats) -> float:
    """Quotient of two means of true errors; NaN where one is 0 or has no measurable view."""
    worse, better = worse[np.isfinite(worse)], better[np.isfinite(better)]
    if not len(worse) or not len(better) or not worse.any() or not better.any():
        return math.nan
    return float(worse.mean() / better.mean())
