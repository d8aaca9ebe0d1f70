"""Judge the screening of views: the order that it puts candidates in, against errors measured in drawn worlds.

Signal chain: case (:mod:`mitsim.validation.part_cases`) -> scores of its candidates by the function of `mitsim run`,
with its defaults -> cost of every view by the tool's predicted risk, and by simpler scores -> errors of every candidate
in the worlds of the truth (:mod:`mitsim.validation.case_trials`), the same that choices are judged by.

The simpler scores, all of them higher for a better view:

- *V_m*: the talk's view score;
- *points*: the expected number of points on the feature that has fewest;
- *cos/z^2*: sum of cos(theta) / |V|^2 over the points of a feature that all eyes see, of the feature that has least: it
  knows nothing of the material.

All scores get the same treatment: views that the tool calls impossible are tied behind all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.point_cloud import Status
from characterisation.scores.screening import Screened
from mitsim.campaign.executor import Executor
from mitsim.capture.cloud import sensor_geometry
from mitsim.predict import Predictor
from mitsim.progress import say
from mitsim.score import RAYS
from mitsim.study import Study
from mitsim.validation.case_trials import benches, keep_trials, measured_truth
from mitsim.validation.part_cases import PartCase
from mitsim.virtual.race import screening_risk
from mitsim.virtual.screening import screen

Floats = NDArray[np.float64]

#: names of the scores: the one that the tool ranks by, and its rivals
PREDICTED, TALK, POINTS, COSINE = "predicted risk", "V_m", "points", "cos/z²"


@dataclass(frozen=True)
class JudgedScreening:
    """What was found of a case.

    ``costs`` (measurement, view) by score, lower is better, infinite where the tool calls the view impossible;
    ``worth`` (measurement, view) by score, higher for a view that is likelier to be measurable; ``chance``
    (measurement, view) that it is, as the tool says; ``errors`` (measurement, view, world), NaN without a value.
    """

    case: PartCase
    sensor: str
    measurements: tuple[str, ...]
    costs: dict[str, Floats]
    worth: dict[str, Floats]
    chance: Floats
    errors: Floats

    def cells(self, score: str) -> list[Screened]:
        """Cost and errors of each measurement."""
        return [Screened(cost, errors) for cost, errors in zip(self.costs[score], self.errors, strict=True)]

    def areas(self, score: str) -> list[Screened]:
        """The same with what the score says of being measurable in place of the cost."""
        return [Screened(-worth, errors) for worth, errors in zip(self.worth[score], self.errors, strict=True)]


def screen_cases(
    cases: Sequence[PartCase], folder: str | Path, workers: Executor | None = None
) -> list[JudgedScreening]:
    """Screen and measure all cases; what the folder, or the file of cases, holds of them is not measured again."""
    return [screen_case(case, Path(folder), workers) for case in cases]


def screen_case(case: PartCase, folder: Path, workers: Executor | None = None) -> JudgedScreening:
    """Screen and measure the candidates of one case."""
    say(f"case: {case.name}")
    study = case.open()
    bench = benches(case, study, folder, workers)
    predictor = Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor))
    assert study.performance_map is not None
    scores, _ = screen(study, predictor, study.performance_map)
    truth = measured_truth(case, bench["truth"])[:, :, : case.file.worlds]
    keep_trials(case, folder, bench)
    return judged(case, study, scores, seen_by_all(study, predictor), truth)


def judged(case: PartCase, study: Study, scores: xr.Dataset, visible: Floats, errors: Floats) -> JudgedScreening:
    """Costs of every score beside the errors; ``visible`` (view, feature) is the sum of cos(theta) / |V|^2."""
    risk = screening_risk(scores)
    able = np.isfinite(risk)
    talk = np.where(scores["possible"], scores["V_m"], np.nan)
    worth = {
        TALK: np.nan_to_num(talk), POINTS: _of_least(study, scores["n"].values), COSINE: _of_least(study, visible),
    }  # fmt: skip
    costs = {PREDICTED: risk} | {name: np.where(able, -values, np.inf) for name, values in worth.items()}
    chance = np.nan_to_num(scores["chance"].transpose("measurement", "view").values)
    return JudgedScreening(
        case, study.sensor.name, tuple(study.task.measurements), costs, {PREDICTED: chance} | worth, chance, errors
    )


def seen_by_all(study: Study, predictor: Predictor) -> Floats:
    """Sum of cos(theta) / |V|^2 [1/mm^2] over what all eyes see of each shape of the task, (view, feature)."""
    looking, step = predictor.thinned_to(RAYS)
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


def _of_least(study: Study, values: Floats) -> Floats:
    """Least over the features that each measurement needs: (view, feature) to (measurement, view)."""
    names = list(study.task.shapes)
    needed = [[names.index(shape) for shape in study.task.shapes_for(name)] for name in study.task.measurements]
    return np.array([values[:, shapes].min(axis=1) for shapes in needed])
