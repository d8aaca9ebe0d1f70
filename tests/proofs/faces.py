"""Compare F of every feature: on the map, as a score predicts it in the scene, and found in a rendered capture.

Signal chain: some views of each case, each captured once with every unknown at its best estimate, and decoded -> ideal
points away from edges, with F of the map and the change by interreflections that scores include -> which points were
found within 1 % of their distance -> means over each feature, beside the share of directions in which it sees faces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, Status
from characterisation.words.progress import say, track
from mitsim.maps.prediction import Predictor, SceneView, performance
from mitsim.maps.prediction.faces_in_sight import faces_in_sight
from mitsim.maps.prediction.interreflections import InterreflectionEffect
from mitsim.study import Study
from mitsim.study.virtual.plan import measurements_of
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.views import View
from tests.proofs.part_cases import PartCase
from tests.proofs.tables import markdown

#: step between the cast rays of a row, and between rows
_STEP = 3

#: least number of cast rays of a feature in a view
_LEAST_RAYS = 50


@dataclass(frozen=True)
class FeatureFraction:
    """F of one feature in a view of a case: on the map, as scored and found; the share in which it sees faces."""

    case: str
    view: int
    feature: str
    in_sight: float
    mapped: float
    scored: float
    found: float


def fractions_of_cases(cases: Sequence[PartCase], views: int) -> list[FeatureFraction]:
    """Return F of all features in ``views`` views of each case."""
    out = []
    for case in cases:
        study = case.open()
        renderer = measurements_of(study, study_unknowns(study, varied=()))
        if isinstance(renderer, RenderedMeasurements):
            say(f"case: {case.name}")
            for view in track(study.views[:views], "views", views):
                out += list(fractions_of_view(case.name, study, view, renderer))
    return out


def fractions_of_view(case: str, study: Study, view: View, renderer: RenderedMeasurements) -> Iterator[FeatureFraction]:
    """Yield F of every feature of a view that enough rays show."""
    assert study.performance_map is not None
    scene, pose = study.scene, view.world_from_sensor
    predictor: Predictor = renderer.predictor.thinned(_STEP)
    cloud = renderer.at_best_estimates(view)[1]
    surfaces = predictor.surfaces(scene, pose)
    ideal, labels = predictor.ideal(surfaces), predictor.labels(scene, pose, surfaces)
    mapped = np.nan_to_num(performance(ideal, scene, study.performance_map)[0])
    scored = mapped * InterreflectionEffect(study.sensor)(SceneView(scene, pose, surfaces, ideal)).kept
    decoded = cloud.points[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP].reshape(-1, 3)[ideal.pixel]
    off = np.abs(np.linalg.norm(decoded - predictor.grid.origin, axis=1) - ideal.distance)
    found = off <= FALSE_SHARE_OF_DISTANCE * ideal.distance  # false where nothing was decoded
    in_sight = faces_in_sight(predictor, scene, pose)
    own = labels.reshape(-1)[ideal.pixel]
    for name in study.task.shapes:
        used = (own == scene.names.index(name)) & (ideal.status == Status.VALID)
        if used.sum() >= _LEAST_RAYS:
            means = (float(one[used].mean()) for one in (mapped, scored, found))
            yield FeatureFraction(case, view.number, name, in_sight.get(name, 0.0), *means)


def fractions_table(rows: Sequence[FeatureFraction]) -> str:
    """Return all rows, and the root mean square of both predictions less the found F, by whether faces are in sight."""
    body = [
        [one.case, str(one.view), one.feature, f"{100 * one.in_sight:.0f} %"]
        + [f"{value:.2f}" for value in (one.mapped, one.scored, one.found)]
        for one in rows
    ]
    heads = ["case", "view", "feature", "sees faces", "F on the map", "F of the score", "F found"]
    summary = []
    for words, chosen in (("see faces", True), ("see none", False)):
        some = np.array([[one.mapped, one.scored, one.found] for one in rows if (one.in_sight > 0) == chosen])
        if len(some):
            errors = np.sqrt(np.mean((some[:, :2] - some[:, 2:]) ** 2, axis=0))
            summary.append([words, str(len(some)), *(f"{value:.3f}" for value in errors)])
    return markdown(heads, body) + "\n" + markdown(["features that", "number", "rms of map", "rms of score"], summary)
