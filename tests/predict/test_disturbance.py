"""What of a view's other light reaches the map's answers, with the parts put together by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.capture.cloud import sensor_geometry
from mitsim.predict import Predictor
from mitsim.predict.disturbance import Indirect, disturbed, of_both_eyes
from mitsim.predict.glint import CARRIED_SPREAD, LampImage
from mitsim.predict.interreflection import (
    LOST_BLURRED,
    LOST_FLAT,
    LOST_NEAR,
    LOST_OF_CODES,
    PULL_LEFT,
    PULL_OF_CODES,
    OtherLightImage,
    kept_share,
)
from mitsim.predict.mirrored_code import FOUND, LEAST_SCATTERED, SCATTERED, Mirrored
from mitsim.predict.predictor import Ideal
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.camera import Rig
from mitsim.sensor.frames import look_at
from mitsim.sensor.preset import load_sensor


def test_of_a_code_in_phase_the_stronger_light_says_where_a_point_lies():
    rho = np.array([0.0, 0.5, 8.0, np.nan])
    mirrored, pull, average = np.array([-20.0, -20, -20, np.nan]), np.array([0.0, 0.3, 0.4, 0.0]), np.full(4, 0.01)
    none = np.zeros((4, 3))
    ideal = Ideal(np.arange(4), none, none, np.full(4, 500.0), none, np.zeros(4, np.int16), np.zeros(4, np.uint8))
    indirect = Indirect(rho, np.zeros(4), None, Mirrored(mirrored, np.ones(4)), pull, np.array([0, 0.3, 0, 0.2]))
    found = disturbed(indirect, average, np.full(4, 0.9), None, ideal, (2, 2), 1e-3, 4)
    own = kept_share(rho, *LOST_OF_CODES)
    assert own[2] < 0.3 < own[1]
    assert found.kept == pytest.approx([1, own[1], 0, 1])
    assert found.blinded == pytest.approx([0, 0, FOUND * (1 - own[2]), 0])
    assert found.displaced == pytest.approx([0.01, 0.31, -19.99, 0.01])
    assert found.noisier == pytest.approx([1, np.sqrt(1.5), 3, 1])
    assert found.lasting == pytest.approx([0, 0.5 * PULL_OF_CODES, 7 * PULL_OF_CODES, 0])
    assert found.scattered == pytest.approx([0, 0.3, np.hypot(20 * SCATTERED, LEAST_SCATTERED), 0.2])
    # where the own code is read, half of its pull is not known
    assert found.uneven == pytest.approx([0, 0.3 * PULL_LEFT, 0, 0])


SPREAD = math.log(2.0) / 20  # of ln rho, a pixel of the image


def test_a_matcher_has_the_mean_of_what_its_two_eyes_see():
    """Other light grows exponentially along the rows: its geometric mean is that half of a disparity aside."""
    n10 = load_sensor("ensenso-n10")
    predictor = Predictor.of_sensor(n10, sensor_geometry(n10)).thinned_to(2_000)[0]
    from mitsim.scene.backend import activate, mi

    activate()
    plate = mi.ScalarTransform4f().scale(300)
    scene = scene_from_dict(
        {"plate": {"type": "rectangle", "to_world": plate, "bsdf": {"type": "matt_white"}}}, n10.wavelength_nm
    )
    ideal = predictor.ideal(predictor.surfaces(scene, look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])))
    first, second = n10.rig.cameras.values()
    camera = replace(first, distortion=np.zeros(5))
    row = np.exp(SPREAD * np.arange(camera.width))
    image = OtherLightImage(camera, np.stack([np.broadcast_to(row, (camera.height, camera.width))] * 4))
    rho, place = image.at(ideal.point).rho, camera.project(ideal.point)
    inside = (np.abs(place / [camera.width, camera.height] - 0.5) < 0.4).all(axis=1) & (ideal.status == 0)
    assert inside.sum() > 500
    for depth, step in ((10.0, 10.0), (500.0, 0.0)):  # what stands far behind the face is no image of it
        found = of_both_eyes(image, rho, np.full(len(rho), depth), predictor, ideal)
        moved = camera.project(ideal.point - (step / ideal.distance)[:, None] * (second.centre - first.centre))
        expected = rho * np.exp(SPREAD * (moved - place)[:, 0] / 2)
        np.testing.assert_allclose(found[inside], expected[inside], rtol=0.04)  # whole pixels
    alone = Predictor(
        Rig({"one": first}, n10.projector.optics), predictor.grid, predictor.seen, "one", footprint=predictor.footprint
    )
    assert of_both_eyes(image, rho, np.full(len(rho), 10.0), alone, ideal) is rho  # a projector sees nothing


def test_a_matcher_loses_points_by_what_the_face_makes_of_the_other_light():
    """A plane, a pillar across the baseline, one along it, and a face without a lobe."""
    depth, across = np.array([500.0, 10, 500, 10]), np.array([500.0, 500, 10, 10])
    smooth = SimpleNamespace(alpha_u=0.15, alpha_v=0.15)
    scene = SimpleNamespace(finishes=[SimpleNamespace(scatter=smooth), SimpleNamespace(scatter=None)])
    shape = np.array([0, 0, 0, 1])
    ideal = SimpleNamespace(distance=np.full(4, 500.0), shape=shape, pixel=np.arange(4))
    for rho in (0.5, 3.0):
        given = Indirect(np.full(4, rho), np.zeros(4), LampImage(depth, across), None, np.zeros(4), np.zeros(4))
        found = disturbed(given, np.zeros(4), np.ones(4), scene, ideal, (2, 2), 2e-3, 3)
        for kept, lost in zip(found.kept, (LOST_FLAT, LOST_NEAR, LOST_BLURRED, LOST_BLURRED), strict=True):
            assert kept == pytest.approx(1 / (1 + (rho / lost[0]) ** lost[1]))
        assert (found.displaced > 0).tolist() == [False, True, False, False]
        np.testing.assert_allclose(found.uneven, CARRIED_SPREAD * found.displaced)
        assert not found.blinded.any() and (found.noisier > 1).all()
