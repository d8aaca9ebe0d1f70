"""Predict the cloud that a sensor would measure on a part, from its performance map alone.

The talk's slides *Simulating the Point Cloud*, in :mod:`~mitsim.maps.prediction.predictor`. Errors of neighbours are
independent, as there, or correlated as measured in the map (:mod:`~mitsim.maps.prediction.noise_field`).
:mod:`~mitsim.maps.prediction.point_statistics` predicts expectations without a draw, and
:mod:`~mitsim.maps.prediction.perturbation` adds effects that flat coupons do not show.

Not included: clusters of lost points, since the map has only their share F, and the behaviour of a matcher at edges.
"""

from mitsim.maps.prediction.characterised_scene import CharacterisedScene
from mitsim.maps.prediction.perturbation import Effect, Ideal, Perturbation, SceneView, together
from mitsim.maps.prediction.point_statistics import (
    ViewPoints,
    expected_points,
    feature_statistics,
    map_answers,
    performance,
)
from mitsim.maps.prediction.predictor import EDGE_MARGIN_PX, Predicted, Predictor, surfaces_of

__all__ = [
    "EDGE_MARGIN_PX",
    "CharacterisedScene",
    "Effect",
    "Ideal",
    "Perturbation",
    "Predicted",
    "Predictor",
    "SceneView",
    "ViewPoints",
    "expected_points",
    "feature_statistics",
    "map_answers",
    "performance",
    "surfaces_of",
    "together",
]
