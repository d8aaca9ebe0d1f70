"""Predict the cloud that a sensor would measure on a part, from its performance map alone.

Signal chain (slides *Simulating the Point Cloud*): rays of the view grid x part -> ideal points -> frustum, back face
and ray-traced occlusion toward every camera and the projector -> F and sigma of each point from the map, by distance,
normal in the view frame and material of its face (:mod:`~mitsim.maps.prediction.predictor`) -> eps = R_N sigma along
the view ray, kept if R_U < F.

Errors of neighbours are independent, as in the talk, or correlated as measured in the map
(:mod:`~mitsim.maps.prediction.noise_field`). :mod:`~mitsim.maps.prediction.point_statistics` predicts expectations
without a draw, and :mod:`~mitsim.maps.prediction.perturbation` adds effects that flat coupons do not show.

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
