"""Predict the cloud that a sensor would make of a part, from its performance map alone.

Signal chain (slides *Simulating the Point Cloud*): rays of the view grid x part -> ideal points -> frustum, back face
and ray-traced occlusion toward every camera and the projector -> F and sigma of each point from the map, by distance,
normal in the view frame and the material of its face (:mod:`~mitsim.prediction.predictor`) -> eps = R_N sigma along the
view ray, kept if R_U < F. Errors of neighbours are independent, as in the talk, or correlated as the map measured them
(:mod:`~mitsim.prediction.noise_field`). What a view gives without a draw is :mod:`~mitsim.prediction.point_statistics`,
and what a map of flat coupons does not know of it :mod:`~mitsim.prediction.perturbation`.

What it leaves out: losses that come in clusters, for the map has only their share F; the matcher's behaviour at edges.
"""

from mitsim.prediction.perturbation import Effect, LookedAt, Perturbation, together
from mitsim.prediction.point_statistics import ViewPoints, expected_points, feature_statistics, performance
from mitsim.prediction.predictor import EDGE_MARGIN_PX, CharacterisedScene, Ideal, Predicted, Predictor

__all__ = [
    "EDGE_MARGIN_PX",
    "CharacterisedScene",
    "Effect",
    "Ideal",
    "LookedAt",
    "Perturbation",
    "Predicted",
    "Predictor",
    "ViewPoints",
    "expected_points",
    "feature_statistics",
    "performance",
    "together",
]
