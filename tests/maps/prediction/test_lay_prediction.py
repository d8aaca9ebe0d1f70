"""The direction of a lay, from the coupon of a campaign and from the faces of a scene, to F and sigma."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from characterisation.coupon.patch_table import overall
from characterisation.maps.building import build_map
from characterisation.maps.joined import mean_over, with_directions, with_samples
from characterisation.maps.lay import lay_angle_deg, mirror_direction
from characterisation.maps.light import light_variables
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from characterisation.point_cloud import Status
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign import one_finish, run
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.one_finish import OneFinish, characterise_finish, one_finish_campaign, plan_of
from mitsim.maps.prediction import CharacterisedScene, Predictor, performance
from mitsim.scene.load import Scene, flat_coupon, scene_from_dict
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.smaller_sensors import narrow_search

DISTANCE = 504.0
TURNED = {"type": "machined_metal", "metal": "aluminium", "process": "turned", "Ra": 0.8}
POSES = (look_at([0, -300, 400], [0, 0, 0], [0, 0, 1]), look_at([120, 150, 450], [10, 0, 0], [0, 0, 1], 35))


@pytest.fixture(scope="module")
def n10():
    return load_sensor("ensenso-n10")


@pytest.fixture(scope="module")
def predictor(n10):
    return Predictor.of_sensor(n10, sensor_geometry(n10))


def face(**bsdf) -> dict:
    return {"type": "rectangle", "bsdf": {**TURNED, **bsdf}}


def finish_with_lay(sensor):
    return scene_from_dict({"one": face(lay="u")}, sensor.wavelength_nm).finishes[0]


def scene_of(sensor, **shapes) -> Scene:
    return scene_from_dict(shapes, sensor.wavelength_nm)


def with_a_lay(sensor, finish) -> PerformanceMap:
    """The shipped map and this finish, F and sigma of which depend on the normal and on the direction of u."""
    shipped = PerformanceMap.load(shipped_maps()[sensor.name])
    a, b = np.meshgrid(shipped.data["a"].values, shipped.data["b"].values)
    made = []
    for turn in np.radians(one_finish.TURNS_DEG):
        one = PerformanceMap(shipped.data.isel(sample=[0]).copy(deep=True))
        slope = a * math.cos(turn) + b * math.sin(turn)
        level = 0.2 + 0.7 * np.exp(-((slope / 0.2) ** 2)) + 0.05 * a
        known = np.isfinite(one.data["recovered_fraction"].values)
        one.data["recovered_fraction"].values[:] = np.where(known, level, np.nan)
        one.data["ray_noise_std"].values[:] = np.where(known, 0.1 * (1.5 - level), np.nan)
        made.append(one)
    whole = with_directions(mean_over(made), made, one_finish.mirror_mm(sensor)).data
    whole = whole.assign_coords(finish=("sample", [finish.name]), roughness=("sample", [finish.roughness]))
    return with_samples(shipped, [PerformanceMap(whole.assign(light_variables([finish.light])))])


@pytest.fixture(scope="module")
def predictors():
    """Of sensors whose baseline is along x, 28 deg off it, and against it."""
    sensors = [load_sensor(name) for name in ("ensenso-n10", "david-sls-3", "xema")]
    return {sensor.name: (sensor, Predictor.of_sensor(sensor, sensor_geometry(sensor))) for sensor in sensors}


@pytest.mark.parametrize("name", ["ensenso-n10", "david-sls-3", "xema"])
@pytest.mark.parametrize("lay_deg", [0.0, 30.0, 135.0])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.4, 0.2, 0.0), (-0.1, 0.6, 0.0), (-0.5, -0.5, 0.0)])
def test_the_coupon_of_a_campaign_has_the_lay_angle_that_prediction_finds(predictors, name, lay_deg, normal):
    sensor, predictor = predictors[name]
    finish = finish_with_lay(sensor)
    normal = np.array([*normal[:2], math.sqrt(1 - normal[0] ** 2 - normal[1] ** 2)])
    campaign = one_finish_campaign(OneFinish(finish, sensor, 80.0), DISTANCE, plan_of(80.0), lay_deg)
    pose = campaign.shot(campaign.series[0], normal).sensor_from_coupon.inverse()
    ideal = predictor.ideal(predictor.surfaces(flat_coupon(finish, 20.0), pose))
    middle = np.linalg.norm(ideal.point - ideal.point.mean(axis=0), axis=1).argmin()
    assert ideal.normal[middle] == pytest.approx(normal, abs=0.01)
    mirror = mirror_direction(ideal.distance[middle], one_finish.mirror_mm(sensor))
    angle = lay_angle_deg(ideal.normal[middle], ideal.along[middle], mirror)
    assert (angle - lay_deg + 90) % 180 - 90 == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("pose", POSES)
def test_a_scene_with_lays_from_one_kernel_is_that_of_the_reference(n10, predictor, pose):
    from mitsim.scene.backend import mi

    at = mi.ScalarTransform4f()
    scene = scene_of(
        n10,
        marked={**face(lay="u"), "to_world": at.scale([60, 60, 1])},
        turned={**face(lay="u"), "to_world": at.translate([0, 90, 20]).rotate([0, 0, 1], 65).scale([40, 30, 1])},
        pillar={
            "type": "cylinder",
            "p0": [-90, 0, 0],
            "p1": [-90, 0, 60],
            "radius": 20.0,
            "bsdf": {**TURNED, "lay": "u"},
        },
        white={
            "type": "rectangle",
            "bsdf": {"type": "matt_white"},
            "to_world": at.translate([90, 0, 0]).scale([25, 60, 1]),
        },
    )
    known = with_a_lay(n10, scene.finishes[0])
    surfaces = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(surfaces)
    reference = performance(ideal, scene, known)
    seen = predictor.look_up(CharacterisedScene(scene, known), pose).seen
    whole = np.full((2, *predictor.seen.shape), np.nan)
    whole[(slice(None), *seen.roi.slices)] = seen.fraction, seen.sigma
    valid = ideal.status == Status.VALID
    at_pixels = whole.reshape(2, -1)[:, ideal.pixel[valid]]
    for index in range(4):
        assert (ideal.shape[valid] == index).sum() > 200
    for got, expected in zip(at_pixels, reference, strict=True):
        near = np.isfinite(got) & np.isfinite(expected[valid])
        assert near.mean() > 0.99 * np.isfinite(expected[valid]).mean()
        assert np.abs(got - expected[valid])[near].max() < 2e-4


def test_turning_a_face_about_its_normal_swaps_what_the_score_sees_along_and_across(n10, predictor):
    from mitsim.scene.backend import mi

    fractions = []
    for turn in (0, 90, 180):
        to_world = mi.ScalarTransform4f().rotate([0, 0, 1], turn).scale([50, 50, 1])
        scene = scene_of(n10, face={**face(lay="u"), "to_world": to_world})
        known = with_a_lay(n10, scene.finishes[0])
        ideal = predictor.ideal(predictor.surfaces(scene, POSES[0]))
        fractions.append(float(np.nanmean(performance(ideal, scene, known)[0])))
    assert abs(fractions[1] - fractions[0]) > 0.3
    assert fractions[2] == pytest.approx(fractions[0], abs=1e-4)


def test_rendered_coupons_along_and_across_are_as_the_score_predicts_them(n10, predictor, monkeypatch, tmp_path):
    """A small campaign up to 30 deg; then rendered coupons at an angle between its directions, and at one of them."""
    monkeypatch.setattr(one_finish, "BANDS", ((30.0, 2),))
    monkeypatch.setattr(one_finish, "REFINED", None)
    monkeypatch.setattr(one_finish, "SAMPLES_PER_PIXEL", 4)
    monkeypatch.setattr(run, "build_map", partial(build_map, nodes=25))
    near = narrow_search(n10, DISTANCE - 50, DISTANCE + 55)
    finish, simulated = finish_with_lay(n10), SimulatedSensor(near)
    one = OneFinish(finish, near, 30.0)
    known = characterise_finish(one, simulated, DISTANCE, tmp_path)
    file, normal = plan_of(30.0), np.array([math.sin(0.35), 0.0, math.cos(0.35)])
    seen, predicted = [], []
    for lay_deg in (0.0, 75.0, 90.0):
        campaign = one_finish_campaign(one, DISTANCE, file, lay_deg)
        shot = campaign.shot(campaign.series[0], normal)
        (done,) = (done for _, done in in_turn(simulated_source(simulated, file.samples_per_pixel), campaign)([shot]))
        seen.append(overall(done.patches).sigma)
        scene, pose = flat_coupon(finish, 25.0), shot.sensor_from_coupon.inverse()
        ideal = predictor.ideal(predictor.surfaces(scene, pose))
        # the map has one distance, that of the coupon's middle
        answer = known.query(
            one.label, finish.roughness, np.full(len(ideal.pixel), DISTANCE), ideal.normal, finish.light, ideal.along
        )
        predicted.append(float(np.sqrt(np.nanmean(answer.sigma**2))))
    assert seen[0] > 1.15 * seen[2]
    assert predicted == pytest.approx(seen, rel=0.1)
