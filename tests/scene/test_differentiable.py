"""The differentiable lobe against finite differences, a closed form and the renderer that captures come from."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.differentiable import Directions, SpecularLobe
from mitsim.scene.load import load_scene
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.metals import refractive_index
from mitsim.scene.surface.microfacet import fresnel, shadowing, slope_density
from mitsim.sensor.transforms import look_at
from mitsim.twin.finish.finish import metal_finish
from mitsim.twin.finish.specimen import known_specimen
from mitsim.twin.finish.white_coupon import WhiteCouponRenderer, coupon_roi
from tests.figures_of_surfaces import lobe_factor

INDEX = refractive_index("aluminium", 850.0)


@pytest.fixture(scope="module")
def lobe():
    return SpecularLobe(INDEX)


@pytest.fixture(scope="module")
def ground(scenes):
    finish = load_scene(scenes / "coupon" / "coupon.xml", 850.0).finishes[0]
    return metal_finish(finish, 850.0, "coupon")


def directions(rng, count, tilt):
    """Unit directions (count, 3) about the normal, slopes of standard deviation ``tilt``."""
    out = np.column_stack([rng.normal(0, tilt, (count, 2)), np.ones(count)])
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def closed_form(scatter, view, lamp):
    """pi f of the lobes, pi D G1 G1 F / (4 cos cos), by our own functions in double precision."""
    half = view + lamp
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    tangent = np.hypot(half[:, 0], half[:, 1]) / half[:, 2]

    def one(alpha, distribution):
        density = slope_density((tangent / alpha) ** 2, distribution) / (np.pi * alpha**2 * half[:, 2] ** 4)
        shadow = 1.0
        for direction in (view, lamp):
            shadow = shadow * shadowing(alpha * np.hypot(*direction.T[:2]) / direction[:, 2], distribution)
        reflected = fresnel((view * half).sum(axis=1), *INDEX)
        return np.pi * reflected * density * shadow / (4 * view[:, 2] * lamp[:, 2])

    ggx, beckmann = scatter.energy_factor
    incoherent = (1 - scatter.beckmann) * ggx * one(scatter.ggx_alpha[0], "ggx")
    incoherent += scatter.beckmann * beckmann * one(scatter.alpha_u, "beckmann")
    sigma_cos = scatter.height_um * (view[:, 2] + lamp[:, 2]) / 2
    coherent = np.exp(-((4 * np.pi * sigma_cos / 0.85) ** 2))
    incoherent = incoherent * lobe_factor(scatter.lobe_numbers, (view[:, 2] + lamp[:, 2]) / 2)
    return (1 - coherent) * incoherent + coherent * one(scatter.coherent_alpha[0], "beckmann")


@pytest.mark.parametrize("roughness", [0.09, 0.37, 0.74])
def test_the_lobe_is_the_closed_form(lobe, rng, roughness):
    view, lamp = directions(rng, 2000, 0.3), directions(rng, 2000, 0.3)
    scatter = machined(MachinedFace("aluminium", "ground", roughness), 850.0)
    expected = closed_form(scatter, view, lamp)
    # single precision of a tangent near 0, over alpha 0.005 of the coherent share
    np.testing.assert_allclose(lobe.reflectance(scatter, Directions(view, lamp)), expected, rtol=2e-4, atol=1e-5)


@pytest.mark.parametrize("alpha", [0.05, 0.13, 0.3, 0.5])
def test_the_derivative_is_that_of_finite_differences(lobe, ground, rng, alpha):
    """Relative to the largest: a central difference is off by h^2/6 f''' / f', 2e-5 times a number of order 10."""
    pair = Directions(directions(rng, 2000, 0.25), directions(rng, 2000, 0.25))
    x, step = math.log(alpha), 0.01
    value, slope = lobe.reflectance_and_slope(ground.scatter, x, pair)
    above, below = (lobe.reflectance(ground.scatter(x + h), pair) for h in (step, -step))
    difference = (above - below) / (2 * step)
    assert np.abs(difference).max() > 0.1
    assert np.abs(slope - difference).max() < 1e-3 * np.abs(difference).max()
    np.testing.assert_allclose(value, lobe.reflectance(ground.scatter(x), pair), rtol=1e-6)


def test_pairs_that_no_coefficient_of_h_concerns_are_the_same_beside_pairs_that_one_does(lobe, ground):
    """The coefficients are computed only if a pair needs them: its mean cosine is below that of 45 deg."""
    angles = np.radians([0.0, 30.0, 44.9, 45.1, 60.0, 75.0])
    slanted = np.column_stack([np.sin(angles), np.zeros(6), np.cos(angles)])
    back = slanted * [-1.0, 1.0, 1.0]
    few, all_of_them = Directions(slanted[:3], back[:3]), Directions(slanted, back)
    assert few.even
    assert not any(Directions(slanted[[at]], back[[at]]).even for at in (3, 4, 5))
    x = math.log(0.2)
    alone, among = (lobe.reflectance_and_slope(ground.scatter, x, pairs) for pairs in (few, all_of_them))
    assert (np.stack(alone) == np.stack(among)[:, :3]).all()
    expected = closed_form(ground.scatter(x), slanted, back)
    np.testing.assert_allclose(lobe.reflectance(ground.scatter(x), all_of_them), expected, rtol=2e-4)


@given(st.integers(0, 2**31), st.floats(0.02, 0.6))
def test_camera_and_lamp_may_change_places(lobe, ground, seed, alpha):
    """Helmholtz: f is symmetric. Single precision leaves a few parts in 10^5 of a steep flank."""
    rng = np.random.default_rng(seed)
    view, lamp = directions(rng, 20, 0.4), directions(rng, 20, 0.4)
    scatter = ground.scatter(math.log(alpha))
    there, back = lobe.reflectance(scatter, Directions(view, lamp)), lobe.reflectance(scatter, Directions(lamp, view))
    np.testing.assert_allclose(there, back, rtol=2e-4, atol=1e-6)


def test_nothing_is_seen_from_below(lobe, ground):
    up, down = np.array([[0.1, 0.0, 1.0]]), np.array([[0.1, 0.0, -1.0]])
    scatter = ground.scatter(math.log(0.2))
    for view, lamp in ((up, down), (down, up), (down, down)):
        assert lobe.reflectance(scatter, Directions(view, lamp)).tolist() == [0.0]


def test_directions_must_be_pairs_of_vectors():
    with pytest.raises(ValueError, match="must be"):
        Directions(np.zeros((3, 3)), np.zeros((2, 3)))


def test_white_light_times_the_lobe_is_what_the_renderer_gives(n10, lobe, scenes):
    """Of the radiance of a ground coupon, through pattern and lenses; what is left is f inside a pixel and a pupil."""
    scene = load_scene(scenes / "coupon" / "coupon.xml", n10.wavelength_nm, {"Ra": "0.37"})
    scatter = scene.finishes[0].scatter
    ground = metal_finish(scene.finishes[0], n10.wavelength_nm, "coupon")
    pose = look_at([60.0, -150.0, 580.0], [0, 0, 0], [0, 0, 1])
    specimen, camera = known_specimen(pose, 120.0, 120.0), n10.rig.cameras["left"]
    part = coupon_roi(camera, specimen)
    white = WhiteCouponRenderer(n10, samples=4).white(specimen, "left", part, "mean")
    rendered = SimulatedSensor(n10).radiance(scene, pose, "left", Rendering(samples=4, depth=1), seed=1, roi=part)[0]
    rendered = rendered * n10.electrons()
    columns, rows = np.meshgrid(np.arange(part.width) + part.left, np.arange(part.height) + part.top)
    rays = pose.directions(camera.rays(np.stack([columns, rows], axis=-1).astype(float)))
    points = pose.translation - rays * (pose.translation[2] / rays[..., 2:])
    inside = (np.abs(points[..., :2]) < 55).all(axis=-1)
    toward = [pose.points(centre) - points[inside] for centre in (camera.centre, n10.projector.optics.centre)]
    pair = Directions(*(d / np.linalg.norm(d, axis=1, keepdims=True) for d in toward))
    specular = lobe.reflectance(scatter, pair)
    predicted = white[inside] * ((1 - scatter.wide_angle) * specular + scatter.wide_angle * ground.normal_reflectance)
    ratio = predicted / rendered[inside]
    assert inside.sum() > 8000
    assert abs(ratio.mean() - 1) < 1e-3
    assert np.abs(ratio - 1).max() < 0.01
