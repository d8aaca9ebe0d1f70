"""What is said of a view before it is measured: the scores of this project, and simpler ones that they must beat.

Signal chain: scored views (:mod:`mitsim.score`) and rays cast at the part -> for each measurement and view one number
of each score, higher is better, NaN where the score says that the view is hopeless.

- random: a number;
- along the normal: mean over the measurement's features of how squarely the view meets them: |d . n| for a plane and
  for what lies in one, |d x a| for a cylinder or a cone of axis a, 1 for a sphere; d is the direction of the view;
- points: expected points of the feature that has fewest, F from the map;
- cos/z^2: sum of cos(theta) / |V|^2 over the points of a feature that all eyes see, of the feature that has least; no
  material;
- V_m on matt white: the talk's score, as if the part were matt white;
- V_m: the talk's score;
- predicted uncertainty: the place that is to be expected of a view: with the chance that it can be measured its place
  by u, otherwise the last; and after all these, where the map has no answer or a feature no fit, by what is seen at
  all: cos/z^2. With light by way of other surfaces, and beside it with direct light only.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import rankdata

from characterisation.point_cloud import Status
from characterisation.scores.score_validation import UNCERTAINTY, V_M
from characterisation.scores.view_score import score_views, view_statistics
from characterisation.tasks.task_file import Feature, Task
from mitsim.predict import Predictor
from mitsim.progress import track
from mitsim.scene.load import Scene
from mitsim.score import RAYS
from mitsim.views import View

Floats = NDArray[np.float64]

RANDOM, NORMAL, POINTS, COSINE, WHITE = "random", "along the normal", "points", "cos/z²", "V_m on matt white"

#: chances under this are as good as none, and tell no view from another
LEAST_TOLD = 1e-3

#: the predicted uncertainty as it is without light by way of other surfaces
DIRECT_ONLY = "predicted uncertainty, direct light"


def said_of_views(
    scores: xr.Dataset, scene: Scene, task: Task, views: Sequence[View], predictor: Predictor, seed: int
) -> dict[str, Floats]:  # fmt: skip
    """Every score (measurement, view) of views that :func:`mitsim.score.score_candidates` scored."""
    names, measurements = list(task.shapes), list(task.measurements)
    needed = [[names.index(shape) for shape in task.shapes_for(name)] for name in measurements]
    minimum = float(scores.attrs["minimum_points"])

    def of_features(values: Floats, over: Callable[..., Any]) -> Floats:
        """(view, feature) to (measurement, view)."""
        return np.array([over(values[:, shapes], axis=1) for shapes in needed])

    n_white, sigma_white = scores["n_white"].values, scores["mean_sigma_white"].values
    white = view_statistics(names, n_white, sigma_white, n_white, sigma_white, scores["n_only_white"].values)
    on_white = score_views(white, task, minimum)
    visible = of_features(_cosine_over_square(scene, task, views, predictor), np.min)
    return {
        RANDOM: np.array([_random(name, len(views), seed) for name in measurements]),
        NORMAL: of_features(_squareness(task, views), np.mean),
        POINTS: of_features(scores["n"].values, np.min),
        COSINE: visible,
        WHITE: np.where(on_white["possible"].values, on_white["V_m"].values, np.nan),
        V_M: np.where(scores["possible"].values, scores["V_m"].values, np.nan),
        UNCERTAINTY: by_uncertainty(scores, visible),
    }


def _random(measurement: str, count: int, seed: int) -> Floats:
    return np.random.default_rng([seed, zlib.crc32(measurement.encode())]).random(count)


def _squareness(task: Task, views: Sequence[View]) -> Floats:
    """How squarely each view meets each shape, (view, feature)."""
    directions = np.stack([view.direction for view in views])

    def of(feature: Feature) -> Floats:
        if feature.kind == "sphere":
            return np.ones(len(views))
        axis = np.asarray(feature.direction, float)
        along = directions @ (axis / np.linalg.norm(axis))
        return np.asarray(np.abs(along) if feature.kind == "plane" else np.sqrt(np.clip(1 - along**2, 0, 1)))

    return np.stack([of(task.features[name]) for name in task.shapes], axis=1)


def _cosine_over_square(scene: Scene, task: Task, views: Sequence[View], predictor: Predictor) -> Floats:
    """Sum of cos(theta) / |V|^2 [1/mm^2] over what all eyes see of each shape, (view, feature)."""
    looking, step = predictor.thinned_to(RAYS)
    shapes = [scene.names.index(name) for name in task.shapes]
    sums = np.zeros((len(views), len(shapes)))
    for v, view in enumerate(track(views, "look at views")):
        surfaces = looking.surfaces(scene, view.world_from_sensor)
        ideal, labels = looking.ideal(surfaces), looking.labels(scene, view.world_from_sensor, surfaces)
        seen = ideal.status == Status.VALID
        worth = np.where(seen, np.abs(ideal.normal[:, 2]) / ideal.distance**2, 0.0)
        label = labels.reshape(-1)[ideal.pixel]
        sums[v] = [worth[label == shape].sum() * step**2 for shape in shapes]
    return sums


def by_uncertainty(scores: xr.Dataset, seen: Floats) -> Floats:
    """Minus the expected place, 0 to 1: by u with the chance that there is one, else 1; then views by what is ``seen``.

    ``seen`` (measurement, view), more is better; a view that sees nothing is hopeless, NaN.
    """
    uncertainty, chance = scores["predicted_uncertainty"].values, np.nan_to_num(scores["chance"].values)
    out = np.full(uncertainty.shape, np.nan)
    for m, u in enumerate(uncertainty):
        told = np.isfinite(u) & (chance[m] > LEAST_TOLD)
        rest = ~told & (seen[m] > 0)
        out[m, told] = -(chance[m, told] * rankdata(u[told]) / len(u) + 1 - chance[m, told])
        out[m, rest] = -1 - rankdata(-seen[m, rest]) / len(u)
    return out
