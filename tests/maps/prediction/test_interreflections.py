"""Light by way of other surfaces, against a closed form and against the full render."""

import math
from dataclasses import replace

import numpy as np
import pytest

from characterisation.point_cloud import Status
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.maps.prediction.interreflections import InterreflectionEffect, LossCurve, found_share
from mitsim.maps.prediction.perturbation import SceneView
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.raycast import shapes_met
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform, look_at
from tests.smaller_sensors import binned

pytestmark = pytest.mark.usefixtures("no_other_scenes")

REFLECTANCE = 0.6


@pytest.fixture(scope="module")
def n10():
    return load_sensor("ensenso-n10")


def test_a_surface_that_faces_nothing_has_none(n10):
    plate = scene_from_dict(
        {"plate": {"type": "rectangle", "to_world": _scaled(200), "bsdf": {"type": "matt_white"}}}, n10.wavelength_nm
    )
    pose = look_at([0, 0, 600], [0, 0, 0], [0, 1, 0])
    places = pose.inverse().points(np.array([[0.0, 0, 0], [50, 20, 0], [-60, -40, 0]]))
    light = InterreflectionEffect(n10).render(plate, pose).at(places)
    np.testing.assert_array_equal(light.rho, 0)
    assert not light.displaced.any()


def _scaled(size):
    from mitsim.scene.backend import activate, mi

    activate()
    return mi.ScalarTransform4f().scale(size)


def test_in_a_sphere_the_second_surface_adds_the_same_everywhere(n10):
    """Every patch of a Lambertian sphere lights every other alike: L_2 - L_1 = (a / pi) a Phi / (4 pi R^2)."""
    radius = 700.0
    ball = {
        "type": "sphere",
        "radius": radius,
        "flip_normals": True,
        "bsdf": {"type": "matt_white", "reflectance": REFLECTANCE},
    }
    scene = scene_from_dict({"ball": ball}, n10.wavelength_nm)
    projector = replace(n10.projector, corner_illumination=1.0, black_level=0.0)
    assert not projector.optics.distortion.any()  # so that the flux of the frame is all that is sent
    sensor = replace(n10, rig=replace(n10.rig, projector=projector.optics), projector=projector)
    effect = InterreflectionEffect(sensor, paths=1_500_000)
    camera = n10.rig.reference
    column, row = np.meshgrid(np.arange(230, 530, 5.0), np.arange(120, 360, 5.0))
    rays = camera.rays(np.stack([column, row], axis=-1).reshape(-1, 2)) @ camera.sensor_from_camera.rotation.T
    origin = camera.centre
    along = rays @ origin
    points = origin + rays * (-along + np.sqrt(along**2 - origin @ origin + radius**2))[:, None]
    rho = effect.render(scene, Transform.identity()).at(points).rho
    toward = projector.optics.centre - points
    distance = np.linalg.norm(toward, axis=1)
    theta = projector.optics.sensor_from_camera.inverse().points(points)
    cosine = theta[:, 2] / np.linalg.norm(theta, axis=1)
    beta = -np.einsum("ij,ij->i", toward, points) / distance / radius
    direct = projector.plane_irradiance / cosine**3 * np.abs(beta) / distance**2
    expected = REFLECTANCE * projector.flux / (4 * math.pi * radius**2) / direct
    # 2900 points in pixels of 64 samples and more photons, each pixel read some 14 times
    assert np.isfinite(rho).all()
    assert (rho * direct).mean() == pytest.approx((expected * direct).mean(), rel=0.03)


def test_coarse_and_cheap_it_is_what_the_full_render_shows(n10, scenes):
    scene = load_scene(scenes / "two_pillars/matt_white.xml", n10.wavelength_nm)
    pose = look_at([0, -400, 350], [0, 0, 20], [0, 0, 1])
    sensor, camera = SimulatedSensor(n10), n10.rig.reference
    sensor.patterns = InterreflectionEffect(n10).light
    name = next(iter(n10.rig.cameras))
    direct, both = (
        sensor.radiance(scene, pose, name, Rendering(samples=16, depth=depth), seed=3)[0].astype(float)
        for depth in (1, 2)
    )
    x, y, z = np.random.default_rng(1).uniform([-80, -50, 0], [80, -25, 0], (400, 3)).T
    points = pose.inverse().points(np.stack([x, y, z], axis=-1))
    column, row = np.rint(camera.project(points)).astype(int).T
    known = [
        (both[r - 2 : r + 3, c - 2 : c + 3].sum() / direct[r - 2 : r + 3, c - 2 : c + 3].sum() - 1)
        for r, c in zip(row, column, strict=True)
    ]
    found = InterreflectionEffect(n10, paths=1_500_000).render(scene, pose).at(points).rho
    seen = np.isfinite(found) & np.isfinite(known)
    assert seen.mean() > 0.9
    assert 0.02 < np.median(np.array(known)[seen]) < 0.3
    assert np.median(found[seen] / np.array(known)[seen]) == pytest.approx(1.0, abs=0.05)


def test_points_are_lost_as_the_ratio_grows_and_none_without():
    loss = LossCurve(half=3.0, half_interval=(2, 4), steepness=2.0, steepness_interval=(1, 3))
    found = found_share(np.array([0.0, 0.1, 3.0, 9.0, math.inf]), loss)
    np.testing.assert_allclose(found, [1, 1 / (1 + (0.1 / 3) ** 2), 0.5, 0.1, 0])


@pytest.mark.parametrize("name", ["ensenso-n10", "david-sls-3", "kinect-v2"])
def test_beside_a_wall_points_are_noisier_and_fewer_and_codes_are_pulled(name):
    """A white plate and a wall on it: light from the wall fades along the plate, and with it all that it does."""
    sensor, thinned = load_sensor(name), 4
    if name == "david-sls-3":  # of two megapixels
        sensor, thinned = binned(sensor, 2), 2
    near = 1.2 * sensor.working_range_mm[0]
    scene, pose = white_corner(sensor), look_at([0, -0.7 * near, 0.7 * near], [0, 0, 0], [0, 0, 1])
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned(thinned)
    surfaces = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(surfaces)
    found = InterreflectionEffect(sensor)(SceneView(scene, pose, surfaces, ideal))
    world = pose.points(ideal.point)
    plate = (ideal.shape == 0) & (ideal.status == Status.VALID) & (np.abs(world[:, 0]) < 80)
    beside, far = plate & (world[:, 1] > 65) & (world[:, 1] < 95), plate & (world[:, 1] < -60)
    assert beside.sum() > 20 and far.sum() > 20
    near_wall, apart = found.noisier[beside].mean(), found.noisier[far].mean()
    # the light of the wall is modulated, too, and adds to the amplitude of time of flight
    assert near_wall < apart < 1.05 if name == "kinect-v2" else near_wall > apart > 1
    assert found.kept[beside].mean() <= found.kept[far].mean()
    assert found.kept[beside].mean() < 1 or name == "kinect-v2"
    moved = np.abs(found.displaced)
    if name == "kinect-v2":  # far from the wall there is less of it, and it has come a longer way
        assert (found.displaced[plate] > 1).all()
    else:
        assert (moved[beside].mean() > moved[far].mean()) == (name == "david-sls-3")
    assert found.shared.shape == (len(ideal.pixel), 0)


def white_corner(sensor):
    from mitsim.scene.backend import activate, mi

    activate()
    upright = mi.ScalarTransform4f().translate([0, 100, 100]).rotate([1, 0, 0], 90).scale([100, 100, 1])
    flat = mi.ScalarTransform4f().scale([100, 100, 1])
    return scene_from_dict(
        {
            "plate": {"type": "rectangle", "to_world": flat, "bsdf": {"type": "matt_white"}},
            "wall": {"type": "rectangle", "to_world": upright, "bsdf": {"type": "matt_white"}},
        },
        sensor.wavelength_nm,
    )


@pytest.mark.parametrize("name", ["ensenso-n10", "david-sls-3", "kinect-v2"])
def test_views_rendered_together_are_those_rendered_alone(name, monkeypatch):
    """Every pose of a launch has its own frame, streams and pixels; the images agree to the last bit.

    Views together, a view alone and the whole image have different regions, all of which show the whole scene.
    """
    sensor = load_sensor(name)
    near = 1.2 * sensor.working_range_mm[0]
    scene = white_corner(sensor)
    poses = [look_at([x, -0.7 * near, 0.7 * near], [0, 0, 0], [0, 0, 1]) for x in (-200, 0, 150)]
    effect = InterreflectionEffect(sensor, photons=100_000)
    alone, together = [effect.render(scene, pose) for pose in poses], effect.render_views(scene, poses)
    monkeypatch.setattr(InterreflectionEffect, "_region", lambda self, *_: self.rays.whole)
    for pose, whole, *parts in zip(poses, effect.render_views(scene, poses), alone, together, strict=True):
        shown = shapes_met(scene, effect.middles, pose) >= 0
        assert shown.any() and not shown.all()
        for part in parts:
            assert part.values.size < whole.values.size
            np.testing.assert_array_equal(part.values, whole.values[:, *part.region.slices])
            outside = shown.copy()
            outside[part.region.slices] = False
            assert not outside.any()
    assert not np.array_equal(together[0].values, together[1].values, equal_nan=True)


def test_views_named_ahead_are_rendered_once_and_in_any_order(n10):
    scene, near = white_corner(n10), 1.2 * n10.working_range_mm[0]
    poses = [look_at([x, -0.7 * near, 0.7 * near], [0, 0, 0], [0, 0, 1]) for x in (-200, 0, 150)]
    predictor = Predictor.of_sensor(n10, sensor_geometry(n10)).thinned(8)
    views = []
    for pose in poses:
        surfaces = predictor.surfaces(scene, pose)
        views.append(SceneView(scene, pose, surfaces, predictor.ideal(surfaces)))
    alone, ahead = InterreflectionEffect(n10, photons=50_000), InterreflectionEffect(n10, photons=50_000, poses=poses)
    for k in (0, 1, 2, 1):  # the last is asked for again, after its image was given away
        np.testing.assert_array_equal(ahead(views[k]).noisier, alone(views[k]).noisier)
    assert not np.array_equal(ahead(views[0]).noisier[:50], ahead(views[2]).noisier[:50])
