"""Judge the screening of views: compare its order of the candidates with errors measured in random worlds.

Signal chain: case (:mod:`tests.proofs.part_cases`) -> scores of its candidates by the function of `mitsim run`,
with its defaults -> cost of every view by the predicted risk, and by simpler scores -> the same after the first round
of the race, one virtual measurement of every view on the shortlist -> errors of every candidate in the worlds of the
truth (:mod:`tests.proofs.case_trials`), which also judge choices.

Screening ends with the race's first round, from whose order the race continues. Each score is therefore judged twice:
alone (*map*), and combined with one virtual measurement (*measured once*).

The simpler scores, all higher for a better view, are:

- *V_m*: the talk's view score;
- *points*: the expected number of points on the feature with the fewest;
- *cos/z^2*: sum of cos(theta) / |V|^2 over the points of a feature that all eyes see, for the feature with the least
  sum; it ignores the material;
- *measurement alone*: only one virtual measurement of every view.

All scores are treated alike. Views that the tool rates as impossible are tied behind all others. The shortlist of a
score has as many views as the tool's. A simpler score is combined with its measurements like the tool's u. Since it has
no unit, its best view gets the least u, its second the second least, and so on. Views off the shortlist stay behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.point_cloud import Status
from characterisation.statements.selection import chance_after, posterior
from characterisation.words.progress import say
from mitsim.maps.prediction import Predictor
from mitsim.running.executor import Executor
from mitsim.study import Study
from mitsim.study.virtual.race import FIRST
from mitsim.study.virtual.risks import combined_cost, first_of_each, prior_risk
from mitsim.views.view_scores import RAYS, screening_risk
from tests.proofs.case_trials import days, keep_trials, measure_worlds, measured_truth, trials_by_kind
from tests.proofs.part_cases import PartCase
from tests.proofs.screening_figures import Screened

Floats = NDArray[np.float64]

#: names of the scores: the tool's own score, and the others
PREDICTED, TALK, POINTS, COSINE, ALONE = "predicted risk", "V_m", "points", "cos/z²", "measurement alone"


@dataclass(frozen=True, eq=False)
class JudgedScreening:
    """Results of a case.

    ``costs`` (measurement, view) are by score, lower is better, infinite if the tool rates the view as impossible.
    ``measured`` are the same after one virtual measurement. ``worth`` (measurement, view) is by score, higher for a
    view that is more likely to give a value. ``chance`` (measurement, view) is its predicted probability, and
    ``likelier`` that after one measurement. ``errors`` (measurement, view, world) are NaN without a value.
    """

    case: PartCase
    sensor: str
    measurements: tuple[str, ...]
    costs: dict[str, Floats]
    measured: dict[str, Floats]
    worth: dict[str, Floats]
    chance: Floats
    likelier: Floats
    errors: Floats

    def cells(self, score: str, measured: bool = False) -> list[Screened]:
        """Return cost and errors of each measurement."""
        costs = (self.measured if measured else self.costs)[score]
        return [Screened(cost, errors) for cost, errors in zip(costs, self.errors, strict=True)]

    def areas(self, score: str, measured: bool = False) -> list[Screened]:
        """Return the same, with the score's rating of getting a value in place of the cost."""
        worth = self.likelier if measured else self.worth[score]
        return [Screened(-each, errors) for each, errors in zip(worth, self.errors, strict=True)]


def screen_cases(
    cases: Sequence[PartCase], folder: str | Path, workers: Executor | None = None
) -> list[JudgedScreening]:
    """Screen and measure all cases; reuse trials in the folder or in the cases file."""
    return [screen_case(case, Path(folder), workers) for case in cases]


def screen_case(case: PartCase, folder: Path, workers: Executor | None = None) -> JudgedScreening:
    """Screen and measure the candidates of one case."""
    say(f"case: {case.name}")
    study = case.open()
    trials_of_kind = trials_by_kind(case, study, folder, workers)
    tool, numbers = trials_of_kind["tool"], [view.number for view in study.views]
    scores, _ = tool.screen()
    truth = measured_truth(case, trials_of_kind["truth"])[:, :, : case.file.worlds]
    measure_worlds(case, "tool", tool, study.views, dict.fromkeys(numbers, days(FIRST)))
    once = np.stack([tool.trials.errors(number, days(FIRST)) for number in numbers], axis=1)
    keep_trials(case, folder, trials_of_kind)
    return judged(case, study, scores, seen_by_all(study, tool.predictor), truth, once)


def judged(
    case: PartCase, study: Study, scores: xr.Dataset, visible: Floats, errors: Floats, once: Floats
) -> JudgedScreening:
    """Return the costs of every score together with the errors.

    ``visible`` (view, feature) is the sum of cos(theta) / |V|^2. ``once`` (measurement, view, world) are the errors of
    the race's first round.
    """
    risk = screening_risk(scores)
    able = np.isfinite(risk)
    talk = np.where(scores["possible"], scores["V_m"], np.nan)
    worth = {
        TALK: np.nan_to_num(talk),
        POINTS: _least_needed(study, scores["n"].values),
        COSINE: _least_needed(study, visible),
    }
    costs = {PREDICTED: risk} | {name: np.where(able, -values, np.inf) for name, values in worth.items()}
    chance = np.nan_to_num(scores["chance"].transpose("measurement", "view").values)
    u = scores["predicted_uncertainty"].transpose("measurement", "view").values
    count = study.file.race.shortlist
    measured = {
        name: measured_cost(cost, u if name == PREDICTED else in_order_of(cost, u), chance, once, count)
        for name, cost in costs.items()
    }
    costs[ALONE] = np.where(able, 0.0, np.inf)
    medians = [np.median(one[ok]) if ok.any() else np.nan for one, ok in zip(u, able, strict=True)]
    flat = np.ones_like(u) * np.array(medians)[:, None]
    measured[ALONE] = measured_cost(costs[ALONE], flat, np.full_like(chance, 0.5), once, len(study.views))
    worth = {PREDICTED: chance} | worth | {ALONE: able.astype(float)}
    likelier = chance_after(chance, once)
    return JudgedScreening(
        case, study.sensor.name, tuple(study.task.measurements), costs, measured, worth, chance, likelier, errors
    )


def in_order_of(cost: Floats, u: Floats) -> Floats:
    """Return the values of u (measurement, view) in the order of a cost; NaN for infinite cost.

    The view of least cost gets the least u.
    """
    out = np.full_like(u, np.nan)
    for row, values, given in zip(out, u, cost, strict=True):
        able = np.flatnonzero(np.isfinite(given))
        row[able[np.argsort(given[able], kind="stable")]] = np.sort(values[able])
    return out


def measured_cost(cost: Floats, u: Floats, chance: Floats, once: Floats, count: int) -> Floats:
    """Return the cost (measurement, view) after the race's first round: the logarithm of the posterior risk.

    ``cost``, ``u`` and ``chance`` (measurement, view) are known before; ``once`` (measurement, view, world) are the
    errors of the round; ``count`` is the length of the shortlist. Views off the list stay behind those on it.
    """
    together = combined_cost(cost, np.full(len(cost), np.nan))
    listed = np.array(sorted(first_of_each(np.vstack([cost, together]), count)), int)
    out = np.where(np.isfinite(cost), 0.0, np.inf)
    if not len(listed):
        return out
    for m in range(len(cost)):
        behind = np.argsort(np.argsort(cost[m], kind="stable"))
        mean, _ = posterior(once[m, listed], prior_risk(u[m, listed]), chance[m, listed])
        out[m] += mean.max() + 1 + behind
        out[m, listed] = mean
    return out


def seen_by_all(study: Study, predictor: Predictor) -> Floats:
    """Return the sum of cos(theta) / |V|^2 [1/mm^2] over the points that all eyes see, (view, feature)."""
    looking = predictor.thinned_to(RAYS)
    step = looking.step
    scene = study.scene
    shapes = [scene.names.index(name) for name in study.task.shapes]
    sums = np.zeros((len(study.views), len(shapes)))
    for v, view in enumerate(study.views):
        surfaces = looking.surfaces(scene, view.world_from_sensor)
        ideal, labels = looking.ideal(surfaces), looking.labels(scene, view.world_from_sensor, surfaces)
        share = np.where(ideal.status == Status.VALID, np.abs(ideal.normal[:, 2]) / ideal.distance**2, 0.0)
        label = labels.reshape(-1)[ideal.pixel]
        sums[v] = [share[label == shape].sum() * step**2 for shape in shapes]
    return sums


def _least_needed(study: Study, values: Floats) -> Floats:
    """Return the least value over the features that each measurement needs: (view, feature) to (measurement, view)."""
    names = list(study.task.shapes)
    needed = [[names.index(shape) for shape in study.task.shapes_for(name)] for name in study.task.measurements]
    return np.array([values[:, shapes].min(axis=1) for shapes in needed])
