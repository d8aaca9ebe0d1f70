"""Score candidate views: the predicted uncertainty of every measurement of a task from each view.

Signal chain: view -> thinned rays x part, more rays on small features -> F, sigma, noise area and persistent noise of
every point from the map -> expected fits and measurements with their uncertainty
(:mod:`characterisation.tasks.prediction`), and the points and noise of the talk's score V_m -> ranks by each, and the
limiting factor of each view -> sets of views.

Scores are expectations; nothing is drawn at random.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from characterisation.features.robust_fit import FitError
from characterisation.files.arrays import Floats
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import Status
from characterisation.scores.view_score import rank_views, score_views, view_statistics
from characterisation.tasks.covariance import LEAST_CHANCE, ExpectedPoints
from characterisation.tasks.measurement_model import InputQuantity
from characterisation.tasks.prediction import ExpectedMeasurement, expected_inputs, expected_measurement
from characterisation.tasks.task_file import Task
from characterisation.words.progress import track
from mitsim.maps.campaign.acquire import one_ahead
from mitsim.maps.prediction import CharacterisedScene, Effect, Perturbation, Predictor, SceneView, ViewPoints
from mitsim.maps.prediction.perturbation import together
from mitsim.maps.prediction.point_statistics import expected_points, feature_statistics, map_answers
from mitsim.maps.prediction.predictor import surfaces_of
from mitsim.running.time_limit import TimeLimit, in_time
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.sensor.transforms import Transform
from mitsim.views import View
from mitsim.views.limiting_factor import limiting_factors
from mitsim.views.scoring_time import FEWEST_VIEWS, TIMED_VIEWS, say_expected, scoring_order

__all__ = ["LEAST_CHANCE", "MATT_WHITE", "score_candidates", "with_poses"]

MATT_WHITE = Finish("matt_white", float("nan"))

#: approximate number of rays per view; with fewer, expectations over a feature change by one per cent
RAYS = 40_000

#: a feature that fewer rays of a view show is cast again, by up to :data:`RAYS` rays of the region that can show it
#: (chosen: u of a ball of 300 rays differs by up to 5 % from that of all pixels, of a ball of 4 rays a hundredfold)
LEAST_RAYS = 300

#: statistics of V_m in :class:`_ViewScore`, in the order of :func:`view_statistics`
_STATISTICS = ("n", "sigma", "n_white", "sigma_white", "n_only")


@dataclass(frozen=True)
class _Cast:
    """Rays of one view that show some ``features``, by number: their ``points``, perturbed by all effects.

    ``n_only`` are the sensor pixels that return from each of these features in matt white if the rest of the part is
    removed.
    """

    features: list[int]
    points: ViewPoints
    n_only: Floats
    perturbation: Perturbation


@dataclass(frozen=True)
class _ViewScore:
    """Results of one view: a row of each statistic of V_m by feature, and the expected inputs and measurements."""

    n: Floats
    sigma: Floats
    n_white: Floats
    sigma_white: Floats
    n_only: Floats
    inputs: dict[InputQuantity, Any]
    measurements: list[ExpectedMeasurement]


def score_candidates(  # noqa: PLR0913 - the parts of a study, which lies above this module
    scene: Scene,
    task: Task,
    views: Sequence[View],
    predictor: Predictor,
    performance_map: PerformanceMap,
    minimum_points: float,
    effects: Sequence[Effect] = (),
    limit: TimeLimit | None = None,
) -> tuple[xr.Dataset, list[dict[InputQuantity, Any]]]:
    """Score and rank views.

    Parameters
    ----------
    scene, task, views
        Scene with the part; features and measurements; candidate views.
    predictor, performance_map, minimum_points
        Casts the rays of the sensor's full grid; map of the sensor; least number of points of a shape.
    effects
        Effects beyond the map that the predicted uncertainty includes. V_m includes none.
    limit
        Time of the scoring, after at least :data:`FEWEST_VIEWS` views; by default all views are scored.

    Returns
    -------
    Dataset
        That of :func:`characterisation.scores.view_score.score_views`, with ``predicted_uncertainty`` [mm or deg],
        ``chance``, ``uncertainty_possible``, ``uncertainty_rank``, ``limit`` and ``limiting_feature`` (measurement,
        view); ``overall_rank`` (view); ``mean_sigma``, ``n_white``, ``mean_sigma_white`` and ``n_only_white`` (view,
        feature); the poses; and ``nominal``, ``tolerance`` and ``unit`` of the measurements. The attribute
        ``views_scored`` counts the views that were scored.
    list of dict
        For every view, the input quantities of its measurements, from which sets of views are chosen.
    """
    looking = predictor.thinned_to(RAYS)
    names = list(task.shapes)
    shapes = [scene.names.index(name) for name in names]
    alone = [CharacterisedScene(scene.only(name), performance_map, MATT_WHITE) for name in names]

    def rays_of(casters: dict[Predictor, list[int]], view: View) -> list[tuple[SceneView, ViewPoints]]:
        """Return the rays of predictors that show some features each, from one launch."""
        pose, out = view.world_from_sensor, []
        for whole, (caster, features) in zip(surfaces_of([*casters], scene, pose), casters.items(), strict=True):
            thinning, pitch = caster.step**2, caster.grid.angular_pitch / caster.step
            measured = np.isin(whole.shape, [shapes[k] for k in features])
            ideal = caster.ideal(replace(whole, shape=np.where(measured, whole.shape, np.int16(-1))))
            labels = caster.labels(scene, pose, whole)
            out.append((SceneView(scene, pose, whole, ideal), ViewPoints(ideal, labels, pose, thinning, pitch)))
        return out

    def cast_by(caster: Predictor, rays: tuple[SceneView, ViewPoints], features: list[int]) -> _Cast:
        seen, points = rays
        perturbation = together((effect(seen) for effect in effects), len(seen.ideal.pixel))
        n_only = [_white_points(caster, alone[k], seen.world_from_sensor) * points.thinning for k in features]
        return _Cast(features, points, np.array(n_only), perturbation)

    def closer_to(feature: int, view: View, count: int) -> Predictor | None:
        """Return a predictor that shows a feature by more rays than ``count``, None if it is enough, or hidden."""
        if count >= LEAST_RAYS:
            return None
        closer = predictor.closer(alone[feature].scene.bounds, view.world_from_sensor, RAYS)
        in_region = closer.grid.width * closer.grid.height * (closer.step / looking.step) ** 2
        hidden = not count and in_region > LEAST_RAYS
        return None if hidden or closer.step >= looking.step else closer

    def cast(view: View) -> list[_Cast]:
        (first,) = rays_of({looking: list(range(len(names)))}, view)
        ideal = first[1].ideal
        shown = first[1].labels.reshape(-1)[ideal.pixel][ideal.status == Status.VALID]
        counts = [int((shown == shape).sum()) for shape in shapes]
        closer = {caster: [k] for k, count in enumerate(counts) if (caster := closer_to(k, view, count)) is not None}
        whole = [k for k in range(len(names)) if [k] not in closer.values()]
        again = rays_of(closer, view) if closer else []
        return [
            cast_by(looking, first, whole),
            *(cast_by(caster, rays, of) for rays, (caster, of) in zip(again, closer.items(), strict=True)),
        ]

    def score(casts: list[_Cast], view: View) -> _ViewScore:
        return _score_view(casts, scene, task, performance_map, minimum_points)

    # the rays of the next view are cast while this view is evaluated
    order = scoring_order(views, limit)
    by_index = dict[int, _ViewScore]()
    # the tracked scores come first, so that the last line of progress is printed when they end
    limit = TimeLimit() if limit is None else limit
    began = time.monotonic()
    in_limit = in_time([views[i] for i in order], limit.over, FEWEST_VIEWS)
    scoring = track(one_ahead(in_limit, cast, score), "score views", len(views))
    for (_, view_score), index in zip(scoring, order, strict=False):
        by_index[index] = view_score
        if len(by_index) == TIMED_VIEWS:
            say_expected((time.monotonic() - began) / TIMED_VIEWS, limit, len(views))
    scored = [by_index.get(index) or _not_scored(by_index[order[0]]) for index in range(len(views))]
    columns = (np.array([getattr(view_score, key) for view_score in scored]) for key in _STATISTICS)
    statistics = view_statistics(names, *columns)
    scores = score_views(statistics, task, minimum_points)
    scores.attrs["views_scored"] = len(by_index)
    for name in ("mean_sigma", "n_white", "mean_sigma_white", "n_only_white"):
        scores[name] = statistics[name]
    rows = [[(one.uncertainty, one.chance) for one in view_score.measurements] for view_score in scored]
    uncertainty, chance = np.array(rows, float).T
    possible = np.isfinite(uncertainty) & (chance >= LEAST_CHANCE)

    def add(name: str, dims: tuple[str, ...], values: Any, long_name: str, units: str = "1") -> None:
        scores[name] = (dims, values, {"long_name": long_name, "units": units})

    by = ("measurement", "view")
    add("predicted_uncertainty", by, uncertainty, "predicted standard uncertainty", "mm or deg")
    add("chance", by, chance, "chance that there are enough points")
    long_name = "whether the measurement is possible, by uncertainty and chance"
    add("uncertainty_possible", by, possible, long_name)
    risk = screening_risk(scores)
    long_name = "rank by predicted risk, uncertainty over the square root of chance; 1 is best"
    add("uncertainty_rank", by, rank_views(-risk, possible), long_name)
    overall = rank_views(-risk.mean(axis=0), np.asarray(possible.all(axis=0)))
    long_name = "rank by the mean logarithm of the predicted risk over all measurements, 1 is best"
    add("overall_rank", ("view",), overall, long_name)
    measured, inputs = [score.measurements for score in scored], [score.inputs for score in scored]
    factor, feature = limiting_factors(task, measured, inputs, scores["R_f"], possible)
    add("limit", by, factor, "limiting factor of the view, against the best view")
    add("limiting_feature", by, feature, "the feature that contributes most")
    measurements = task.measurements.values()
    scores["nominal"] = ("measurement", [m.nominal for m in measurements], {"units": "mm or deg"})
    tolerances = [math.nan if m.tolerance_size is None else m.tolerance_size for m in measurements]
    scores["tolerance"] = ("measurement", tolerances, {"units": "mm or deg"})
    scores["unit"] = ("measurement", [m.unit for m in measurements])
    return with_poses(scores, views), inputs


def _not_scored(like: _ViewScore) -> _ViewScore:
    """Return the results of a view that was not scored: no points, and no measurement."""
    none, unknown = np.zeros_like(like.n), np.full_like(like.sigma, np.nan)
    missing = FitError("not scored, for lack of time")
    measurements = [
        replace(one, uncertainty=math.nan, chance=0.0, reason=str(missing), contributions=(math.nan,) * len(one.inputs))
        for one in like.measurements
    ]
    return _ViewScore(none, unknown, none, unknown, none, dict.fromkeys(like.inputs, missing), measurements)


def screening_risk(scores: xr.Dataset) -> Floats:
    """Return the logarithm of the predicted risk u / sqrt(chance) (measurement, view).

    It is infinite where the map excludes the view. It orders the views for the race. Tables have the same order, but
    for views with a chance under one half, which come last.
    """
    u = scores["predicted_uncertainty"].transpose("measurement", "view").values
    chance = scores["chance"].transpose("measurement", "view").values
    able = np.isfinite(u) & (u > 0) & (chance > 0)
    return np.where(able, np.log(np.where(able, u, 1.0)) - 0.5 * np.log(np.where(able, chance, 1.0)), np.inf)


def _score_view(
    casts: list[_Cast], scene: Scene, task: Task, performance_map: PerformanceMap, minimum_points: float
) -> _ViewScore:
    """Return the results of a view from its rays; each feature is of one cast."""
    names = list(task.shapes)
    shapes = [scene.names.index(name) for name in names]
    n, sigma, n_white, sigma_white, n_only = np.full((5, len(names)), np.nan)
    points: dict[str, ExpectedPoints] = {}
    for cast in casts:
        ideal, labels, features = cast.points.ideal, cast.points.labels, cast.features
        of_cast = [shapes[k] for k in features]
        own = map_answers(ideal, scene, performance_map)
        white = map_answers(ideal, scene, performance_map, MATT_WHITE, own)
        for answers, counts, sigmas in ((own, n, sigma), (white, n_white, sigma_white)):
            rays, sigmas[features] = feature_statistics(ideal, labels, answers.fraction, answers.sigma, of_cast)
            counts[features] = rays * cast.points.thinning
        n_only[features] = cast.n_only
        for k in features:
            points[names[k]] = expected_points(cast.points, scene, shapes[k], performance_map, cast.perturbation, own)
    inputs = expected_inputs(task, points, minimum_points)
    measurements = [expected_measurement(task, name, inputs) for name in task.measurements]
    return _ViewScore(n, sigma, n_white, sigma_white, n_only, dict(inputs), measurements)


def _white_points(predictor: Predictor, alone: CharacterisedScene, world_from_sensor: Transform) -> float:
    """Return the expected number of points of one feature in matt white, without the rest of the part."""
    predicted = predictor.look_up(alone, world_from_sensor)
    counted = (predicted.labels[predicted.seen.roi.slices] == 0) & np.isfinite(predicted.seen.sigma)
    return float(predicted.seen.fraction[counted].sum(dtype=float))


def with_poses(scores: xr.Dataset, views: Sequence[View]) -> xr.Dataset:
    """Add the poses of the views to their scores."""
    poses = np.stack([view.world_from_sensor.matrix() for view in views])
    scores["world_from_sensor"] = (("view", "i", "j"), poses, {"units": "mm", "long_name": "pose of the sensor"})
    scores["direction"] = (("view", "xyz"), np.stack([view.direction for view in views]), {"units": "1"})
    for name in ("roll_deg", "elevation_deg", "azimuth_deg"):
        scores[name] = (("view",), [getattr(view, name) for view in views], {"units": "deg"})
    scores["standoff_mm"] = (("view",), [view.standoff for view in views], {"units": "mm"})
    return scores
