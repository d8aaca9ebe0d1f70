r"""Fit the share of points that survive interreflections, to renders of the open parts.

Signal chain: open cases of matchers and of codes -> some views of each, captured once with every unknown at its best
estimate, and decoded -> ideal points away from edges, with F of the map and rho, the ratio of interreflected to direct
light (:mod:`mitsim.maps.prediction.interreflections`) -> which points were found within 1 % of their distance -> r
and k of

    P(found) = F / (1 + (rho / r)^k)

by maximum likelihood -> their intervals, from a bootstrap over cases and over the views of each. Points of a view are
not independent, and parts, finishes and sensors differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, Status
from characterisation.words.progress import say, track
from mitsim.maps.prediction import Predictor, performance
from mitsim.maps.prediction.interreflections import InterreflectionEffect, LossCurve
from mitsim.study import Study
from mitsim.study.virtual.beyond_map import CODED, FLIGHT, MATCHED, kind_of
from mitsim.study.virtual.plan import measurements_of
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.views import View
from tests.proofs.part_cases import PartCase

Floats = NDArray[np.float64]

#: step between the cast rays of a row, and between rows
_STEP = 3

#: smallest F of a point that is used; points with a lower F carry little information
_LEAST_FRACTION = 0.5

#: resamples of the bootstrap
_RESAMPLES = 200

#: smallest rho of the power law; points with less count as unaffected
_LEAST_RHO = 0.02


@dataclass(frozen=True)
class SeenPoints:
    """Points of one view (n,): ``fraction`` F of the map, ``rho``, and whether each point was ``found``."""

    fraction: Floats
    rho: Floats
    found: NDArray[np.bool_]


def points_of_cases(cases: Sequence[PartCase], views: int) -> dict[str, dict[str, list[SeenPoints]]]:
    """Return points of ``views`` views of each open case, by kind of the sensor and name of the case.

    Sealed cases are skipped.
    """
    out: dict[str, dict[str, list[SeenPoints]]] = {MATCHED: {}, CODED: {}}
    for case in cases:
        if not case.usable_for_fitting:
            continue
        study = case.open()
        kind = kind_of(study.sensor)
        if kind == FLIGHT:  # its decoder predicts its losses
            continue
        renderer = measurements_of(study, study_unknowns(study, varied=()))
        if not isinstance(renderer, RenderedMeasurements):
            continue
        say(f"case: {case.name}")
        light, predictor = InterreflectionEffect(study.sensor), renderer.predictor.thinned(_STEP)
        out[kind][case.name] = [
            seen_points(study, view, renderer, light, predictor) for view in track(study.views[:views], "views", views)
        ]
    return out


def seen_points(
    study: Study,
    view: View,
    renderer: RenderedMeasurements,
    light: InterreflectionEffect,
    predictor: Predictor,
) -> SeenPoints:
    """Return which points of a view are found, with F and rho of each."""
    assert study.performance_map is not None
    scene, pose, step = study.scene, view.world_from_sensor, predictor.step
    cloud = renderer.at_best_estimates(view)[1]
    surfaces = predictor.surfaces(scene, pose)
    ideal, labels = predictor.ideal(surfaces), predictor.labels(scene, pose, surfaces)
    fraction = performance(ideal, scene, study.performance_map)[0]
    rho = light.render(scene, pose).at(ideal.point).rho
    decoded = cloud.points[step // 2 :: step, step // 2 :: step].reshape(-1, 3)[ideal.pixel]
    off = np.abs(np.linalg.norm(decoded - predictor.grid.origin, axis=1) - ideal.distance)
    found = off <= FALSE_SHARE_OF_DISTANCE * ideal.distance  # false where nothing was decoded
    used = (ideal.status == Status.VALID) & (labels.reshape(-1)[ideal.pixel] >= 0) & (fraction > _LEAST_FRACTION)
    used &= np.isfinite(rho)
    return SeenPoints(fraction[used], rho[used], found[used])


def fitted_loss(cases: Sequence[Sequence[SeenPoints]], seed: int = 0, resamples: int = _RESAMPLES) -> LossCurve:
    """Return the constants of g(rho) with the largest likelihood over the views of all cases, with 95 % intervals.

    Raises
    ------
    ValueError
        If no point has interreflections.
    """
    views = [view for case in cases for view in case]
    if not any((view.rho > _LEAST_RHO).any() for view in views):
        raise ValueError("no points with interreflections")
    rng, sizes = np.random.default_rng(seed), [len(case) for case in cases]
    with threadpool_limits(1, user_api="blas"):  # threads slow down fits of two parameters
        best = _most_likely(views, np.ones(len(views)))
        drawn = np.array([_most_likely(views, _drawn_again(sizes, rng)) for _ in range(resamples)])
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    half, steepness = (round(float(value), 3) for value in best)
    return LossCurve(
        half=half,
        half_interval=(round(float(low[0]), 3), round(float(high[0]), 3)),
        steepness=steepness,
        steepness_interval=(round(float(low[1]), 3), round(float(high[1]), 3)),
    )


def _drawn_again(sizes: Sequence[int], rng: np.random.Generator) -> NDArray[np.int64]:
    """Return how often each view occurs if cases, and views of each case, are drawn with replacement."""
    first = np.concatenate([[0], np.cumsum(sizes)])
    chosen = [
        first[case] + rng.integers(sizes[case], size=sizes[case]) for case in rng.integers(len(sizes), size=len(sizes))
    ]
    return np.bincount(np.concatenate(chosen), minlength=int(first[-1]))


def _most_likely(views: Sequence[SeenPoints], times: NDArray[Any]) -> Floats:
    """Return r and k of views that count ``times`` times each; F is limited to 0.01 to 0.995."""
    share = np.concatenate([np.clip(view.fraction, 0.01, 0.995) for view in views])
    rho = np.maximum(np.concatenate([view.rho for view in views]), _LEAST_RHO)
    found = np.concatenate([view.found for view in views])
    weight = np.concatenate([np.full(len(view.rho), count, float) for view, count in zip(views, times, strict=True)])

    def unlikely(logs: Floats) -> float:
        chance = share / (1 + (rho / math.exp(logs[0])) ** math.exp(logs[1]))
        chance = np.clip(chance, 1e-6, 1 - 1e-6)
        return -float((weight * np.where(found, np.log(chance), np.log1p(-chance))).sum() / weight.sum())

    bounds = [(math.log(0.05), math.log(100)), (math.log(0.2), math.log(10))]
    solution = minimize(unlikely, np.array([math.log(2.0), math.log(2.0)]), bounds=bounds, method="L-BFGS-B")
    return np.asarray(np.exp(solution.x))


def losses_document(command: str, cases: Sequence[str], losses: dict[str, LossCurve]) -> str:
    """Return the data file of :func:`mitsim.maps.prediction.interreflections.losses` as TOML."""
    lines = [
        "# Share of points g(rho) = 1 / (1 + (rho / half)^steepness) that are found if interreflected light is rho",
        "# times direct light: estimated from renders of open parts, with 95 % intervals from a bootstrap over cases",
        "# and views.",
        f'command = "{command}"',
        "cases = [",
        *(f'  "{name}",' for name in cases),
        "]",
    ]
    for kind, loss in losses.items():
        lines += [
            "",
            f"[{kind}]",
            f"half = {loss.half}",
            f"half_interval = {list(loss.half_interval)}",
            f"steepness = {loss.steepness}",
            f"steepness_interval = {list(loss.steepness_interval)}",
        ]
    return "\n".join(lines) + "\n"
