"""Light by way of other surfaces, against a closed form and against the full render."""

import math
from dataclasses import replace

import numpy as np
import pytest
from mitsim.predict.interreflection import (
    LOST_BLURRED,
    LOST_FLAT,
    LOST_NEAR,
    LOST_OF_CODES,
    MOST_PULLED,
    NOISIEST,
    PULL,
    PULL_OF_CODES,
    Interreflections,
    kept_share,
    lasting_factor,
    noise_factor,
)

from mitsim.capture.simulate import SimulatedSensor
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.sensor.frames import Transform, look_at
from mitsim.sensor.preset import load_sensor

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
    light = Interreflections(n10).look(plate, pose).at(places)
    np.testing.assert_array_equal(light.rho, 0)
    assert (light.direct < 1).all() and not light.phase.any()


def _scaled(size):
    from mitsim.scene.backend import activate, mi

    activate()
    return mi.ScalarTransform4f().scale(size)


def test_in_a_sphere_the_second_surface_adds_the_same_everywhere(n10):
    """Every patch of a Lambertian sphere lights every other alike: L_2 - L_1 = (a / pi) a Phi / (4 pi R^2)."""
    radius = 700.0
    ball = {"type": "sphere", "radius": radius, "flip_normals": True,
            "bsdf": {"type": "matt_white", "reflectance": REFLECTANCE}}  # fmt: skip
    scene = scene_from_dict({"ball": ball}, n10.wavelength_nm)
    projector = replace(n10.projector, corner_illumination=1.0, black_level=0.0)
    assert not projector.optics.distortion.any()  # so that the flux of the frame is all that is sent
    sensor = replace(n10, rig=replace(n10.rig, projector=projector.optics), projector=projector)
    interreflections = Interreflections(sensor, paths=1_500_000)
    camera = n10.rig.reference
    column, row = np.meshgrid(np.arange(230, 530, 5.0), np.arange(120, 360, 5.0))
    rays = camera.rays(np.stack([column, row], axis=-1).reshape(-1, 2)) @ camera.sensor_from_camera.rotation.T
    origin = camera.centre
    along = rays @ origin
    points = origin + rays * (-along + np.sqrt(along**2 - origin @ origin + radius**2))[:, None]
    rho = interreflections.look(scene, Transform.identity()).at(points).rho
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
    sensor.patterns = Interreflections(n10).light
    name = next(iter(n10.rig.cameras))
    direct, both = (
        sensor.radiance(scene, pose, name, seed=3, samples=16, depth=depth)[0].astype(float) for depth in (1, 2)
    )
    x, y, z = np.random.default_rng(1).uniform([-80, -50, 0], [80, -25, 0], (400, 3)).T
    points = pose.inverse().points(np.stack([x, y, z], axis=-1))
    column, row = np.rint(camera.project(points)).astype(int).T
    known = [
        (both[r - 2 : r + 3, c - 2 : c + 3].sum() / direct[r - 2 : r + 3, c - 2 : c + 3].sum() - 1)
        for r, c in zip(row, column, strict=True)
    ]
    found = Interreflections(n10, paths=1_500_000).look(scene, pose).at(points).rho
    seen = np.isfinite(found) & np.isfinite(known)
    assert seen.mean() > 0.9
    assert 0.02 < np.median(np.array(known)[seen]) < 0.3
    assert np.median(found[seen] / np.array(known)[seen]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("lost", [LOST_FLAT, LOST_NEAR, LOST_BLURRED, LOST_OF_CODES])
def test_points_are_lost_as_the_ratio_grows_and_none_without(lost):
    rho = np.array([0.0, 0.1, lost[0], 10.0, math.inf, math.nan])
    kept = kept_share(rho, *lost)
    assert kept[0] == kept[-1] == 1 and kept[2] == pytest.approx(0.5) and kept[4] == 0
    assert (np.diff(kept[:5]) < 0).all()


@pytest.mark.parametrize(("matched", "pull"), [(True, PULL), (False, PULL_OF_CODES)])
def test_noise_and_pull_grow_with_the_ratio_and_are_nothing_without(matched, pull):
    rho = np.array([0.0, 0.01, 2.0, 1e6, math.inf, math.nan])
    noisier = noise_factor(rho, matched)
    assert noisier[0] == noisier[-1] == noisier[-2] == 1
    if matched:  # 1 + rho at first, and no more than the most in the end
        np.testing.assert_allclose(noisier[1:4], [1.01, 1 + 2 / (1 + 2 / (NOISIEST - 1)), NOISIEST], rtol=1e-4)
    else:
        np.testing.assert_allclose(noisier[1:4], np.sqrt(1 + rho[1:4]))
    most = MOST_PULLED * pull
    np.testing.assert_allclose(lasting_factor(rho, matched), [0, 0.01 * pull, 2 * pull, most, 0, 0])


def test_a_mirror_toward_the_lamp_fills_the_imager(n10):
    """A plate so smooth that a camera sees the projector itself in it, and the same plate turned away."""
    finish = {"type": "machined_metal", "metal": "aluminium", "process": "ground", "Ra": 0.09}
    plate = scene_from_dict(
        {"plate": {"type": "rectangle", "to_world": _scaled(200), "bsdf": finish}}, n10.wavelength_nm
    )
    towards = (n10.rig.reference.centre + n10.projector.optics.centre) / 2
    for turn, expected in ((0.0, True), (0.6, False)):
        pose = look_at([0, 600 * math.sin(turn), 600 * math.cos(turn)], [0, 0, 0], [0, 1, 0])
        place = np.array([[towards[0], towards[1], 600 / math.cos(turn) if turn else 600.0]])
        assert (Interreflections(n10).look(plate, pose).at(place).direct > 1).any() == expected
