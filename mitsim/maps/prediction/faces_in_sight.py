"""Find the faces of a view that see other faces: their F on a map of flat coupons is not their F in the scene.

Signal chain: view -> ideal points -> share of directions, by the cosine law and about the mirrored view ray, in which a
face lies (:func:`mitsim.scene.ray_casting.self_view.seen_faces`) -> larger mean of each feature -> words.

A diffuse face is lit by all of its hemisphere; a shiny one sends light to the camera from about the mirrored view ray.
A map is made from coupons that see neither. `mitsim study score` includes the light between faces
(:mod:`mitsim.maps.prediction.interreflections`); `mitsim map predict` does not.
"""

from __future__ import annotations

import numpy as np

from characterisation.words.numbers import percent
from mitsim.maps.prediction.predictor import Predictor
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.self_view import seen_faces
from mitsim.sensor.transforms import Transform

#: share of directions above which a face is named: less than this share of its light comes by way of others then
LEAST_SHARE = 0.05

#: approximate number of rays
_RAYS = 40_000


def faces_in_sight(predictor: Predictor, scene: Scene, world_from_sensor: Transform) -> dict[str, float]:
    """Return the features of a view that see other faces, with the share of directions in which these lie."""
    looking = predictor.thinned_to(_RAYS) if predictor.step == 1 else predictor
    surfaces = looking.surfaces(scene, world_from_sensor)
    ideal = looking.ideal(surfaces)
    normal = world_from_sensor.directions(surfaces.normal.reshape(-1, 3)[ideal.pixel].astype(float))
    seen = seen_faces(scene, world_from_sensor.points(ideal.point), normal, world_from_sensor.directions(ideal.ray))
    out = {}
    for number, name in enumerate(scene.names):
        shares = seen[(ideal.shape == number) & np.isfinite(seen[:, 0])]
        share = float(shares.mean(axis=0).max()) if len(shares) else 0.0
        if share >= LEAST_SHARE:
            out[name] = round(share, 3)
    return out


def in_words(shares: dict[str, float]) -> str:
    """Return a sentence about the faces that see others; empty without one."""
    if not shares:
        return ""
    named = ", ".join(f"{name} ({percent(share)} of the directions)" for name, share in shares.items())
    return f"these features see other faces, whose light a map of flat coupons excludes: {named}"
