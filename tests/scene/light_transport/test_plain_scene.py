"""Short ways through plain scenes lead to the same light as the long way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport import path_loop, transport
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.plain_scene import single_bsdf, single_plane
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns, independent
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.camera import Camera
from mitsim.sensor.light_code import PhaseShift, patterns
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform, look_at

pytestmark = pytest.mark.usefixtures("no_other_scenes")

POSE = look_at([90, -160, 420], [0, 0, 0], [0, 1, 0])
#: of the steps' sinusoids two dimensions each, and white
RANK_OF_THREE_PERIODS = 7


def pinhole(width, height, focal, place=None):
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height, place or Transform.identity())


@pytest.fixture(scope="module")
def light():
    optics = pinhole(200, 140, 220.0, Transform.from_degrees([0, 0, 0], [80.0, 0, 0]))
    ramps = np.stack([np.linspace(0, 1, 200)[None].repeat(140, 0), np.linspace(0, 1, 140)[:, None].repeat(200, 1)])
    return ProjectedPatterns(ramps, Projector(optics, 1.0, aperture_mm=6.0, focus_mm=450.0))


def metal(**more):
    return {"type": "machined_metal", "metal": "aluminium", "process": "turned", "Ra": 0.4, **more}


def shape(kind: str, *, x: float = 0.0, **bsdf):
    transform = mi.ScalarTransform4f().translate([x, 5, 0]).rotate([0.6, 0.8, 0], 25).scale([60, 40, 1])
    return {"type": kind, "to_world": transform, "bsdf": bsdf or metal()}


SCENES = {
    "rectangle": lambda: {"a": shape("rectangle")},
    "seen from behind": lambda: {"a": shape("rectangle", type="twosided", b=metal()) | {"flip_normals": True}},
    # the axis is no unit vector
    "askew rectangle": lambda: {
        "a": shape("rectangle") | {"to_world": mi.ScalarTransform4f().rotate([1, 1, 0], 25).scale([60, 40, 1])}
    },
    "white rectangle": lambda: {"a": shape("rectangle", type="matt_white")},
    "two shapes of one metal": lambda: {
        "finish": metal(),
        "a": shape("rectangle") | {"bsdf": {"type": "ref", "id": "finish"}},
        "b": shape("sphere", x=40.0)
        | {
            "bsdf": {"type": "ref", "id": "finish"},
            "to_world": mi.ScalarTransform4f().translate([30, 0, 20]).scale(15),
        },
    },
}


@pytest.mark.parametrize(
    ("kind", "depth"),
    [
        ("rectangle", 1),
        ("askew rectangle", 1),
        ("white rectangle", 1),
        ("seen from behind", 3),
        ("two shapes of one metal", 3),
    ],
)
def test_the_short_way_finds_the_light_of_the_long_way(kind, depth, light, monkeypatch):
    scene = scene_from_dict(SCENES[kind](), 460)
    assert (single_plane(scene) is not None) == (len(scene.names) == 1)
    assert single_bsdf(scene) is not None
    rays = CameraRays(pinhole(96, 64, 240.0), 4.0, 430.0)
    short = trace(scene, rays, light, POSE, LightPaths(samples=16, seed=1, depth=depth))
    for module in (path_loop, transport):
        monkeypatch.setattr(module, "single_plane", lambda scene: None)
    monkeypatch.setattr(path_loop, "single_bsdf", lambda scene: None)
    long = trace(scene, rays, light, POSE, LightPaths(samples=16, seed=1, depth=depth))
    assert (long > 0).mean() > 0.2
    # roundings in single precision; of interreflections now and then a ray takes the other side of an edge
    same = np.isclose(short, long, rtol=2e-5, atol=2e-6 * long.max())
    assert same.all() if depth == 1 or len(scene.names) == 1 else same.mean() > 0.99


def test_scenes_that_are_not_plain_take_the_long_way(scenes):
    assert single_plane(load_scene(scenes / "two_pillars/two_pillars.xml", 850)) is None
    lit = {"a": shape("rectangle"), "sky": {"type": "constant"}}
    assert single_plane(scene_from_dict(lit, 460)) is None
    assert single_plane(scene_from_dict({"a": {"type": "sphere", "bsdf": metal()}}, 460)) is None
    several = {"a": shape("rectangle"), "b": shape("rectangle", x=10.0, type="matt_white")}
    assert single_bsdf(scene_from_dict(several, 460)) is None


def test_an_instance_is_of_the_material_of_its_shape(light):
    ball = {"type": "sphere", "center": [0.0, 0.0, -20.0], "radius": 40.0, "bsdf": {"type": "matt_white"}}
    instance = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    rays = CameraRays(pinhole(24, 16, 60.0))
    one, other = (
        trace(scene_from_dict(description, 460), rays, light, POSE, LightPaths(samples=1, seed=1))
        for description in ({"a": ball}, {"group": {"type": "shapegroup", "one": ball}, "b": instance})
    )
    assert one.any()
    np.testing.assert_allclose(other, one, rtol=1e-3, atol=1e-5 * one.max())


def test_materials_of_other_scenes_are_not_compiled(light):
    """A second scene is there, with a material of its own: kernels grow by the digits of larger numbers alone."""
    two = {"a": shape("rectangle"), "b": shape("rectangle", x=140.0, type="matt_white")}
    rays, scene = CameraRays(pinhole(24, 16, 60.0)), scene_from_dict(two, 460)

    def compiled():
        dr.set_flag(dr.JitFlag.KernelHistory, True)
        try:
            dr.kernel_history_clear()
            image = trace(scene, rays, light, POSE, LightPaths(samples=1, seed=1, photons=100, depth=2))
            return image, [len(k["ir"].getvalue()) for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        finally:
            dr.set_flag(dr.JitFlag.KernelHistory, False)

    alone, before = compiled()
    other = scene_from_dict({"c": shape("rectangle", type="gloss_paint"), "d": shape("rectangle")}, 460)
    again, after = compiled()
    assert len(other.shapes) == 2 and len(before) > 1
    np.testing.assert_allclose(after, before, atol=20)
    np.testing.assert_array_equal(again, alone)


@pytest.mark.parametrize("steps", [3, 8])
def test_the_steps_of_sinusoids_are_sums_of_a_few(steps):
    stack = patterns(PhaseShift(periods_px=[200, 37, 15], steps=steps), 200, 140)
    chosen, weights = independent(stack)
    assert len(stack) == 3 * steps
    assert len(chosen) == RANK_OF_THREE_PERIODS
    assert np.abs(np.tensordot(weights, stack[chosen], axes=1) - stack).max() < 1e-6


@pytest.mark.parametrize(("axis", "along_row"), [("columns", True), ("rows", False)])
def test_an_image_of_many_does_not_differ_from_the_same_image_alone(axis, along_row, light):
    scene, rays = scene_from_dict(SCENES["rectangle"](), 460), CameraRays(pinhole(96, 64, 240.0))
    stack = patterns(PhaseShift(periods_px=[140, 15], steps=4, axis=axis), 200, 140)
    lit = ProjectedPatterns(stack, light.projector)
    assert (lit.count, lit.codes, lit.along_row) == (8, 5, along_row)
    together = trace(scene, rays, lit, POSE, LightPaths(samples=16, seed=1))
    for image, pattern in zip(together, stack, strict=True):
        alone = trace(
            scene, rays, ProjectedPatterns(pattern[None], light.projector), POSE, LightPaths(samples=16, seed=1)
        )[0]
        np.testing.assert_allclose(image, alone, rtol=1e-5, atol=2e-6 * together.max())


def test_a_lookup_along_the_row_is_that_in_both_directions(light):
    scene, rays = scene_from_dict(SCENES["rectangle"](), 460), CameraRays(pinhole(96, 64, 240.0))
    row = np.random.default_rng(3).random((1, 1, 200), dtype=np.float32).repeat(140, axis=1)
    speck = row.copy()
    speck[0, -1, -1] += 1e-3  # beside the plate
    for gap in (0.0, 0.2):
        projector = replace(light.projector, pixel_gap=gap)
        one, two = ProjectedPatterns(row, projector), ProjectedPatterns(speck, projector)
        assert (one.along_row, two.along_row) == (True, False)
        images = [trace(scene, rays, lit, POSE, LightPaths(samples=16, seed=1)) for lit in (one, two)]
        np.testing.assert_allclose(*images, rtol=1e-5, atol=1e-6 * images[0].max())


@given(
    st.integers(1, 5).flatmap(
        lambda rank: st.tuples(
            arrays(np.float32, (rank, 6, 9), elements=st.floats(0, 1, width=32)),
            arrays(np.float64, (4, rank), elements=st.floats(0, 1)),
        )
    )
)
def test_sums_of_patterns_are_found_again(drawn):
    basis, weights = drawn
    patterns = np.concatenate([basis, np.tensordot(weights / len(basis), basis, axes=1).astype(np.float32)])
    chosen, found = independent(patterns)
    assert len(chosen) <= max(len(basis), 1) or len(chosen) == len(patterns)
    assert found.shape == (len(patterns), len(chosen))
    assert np.abs(np.tensordot(found, patterns[chosen], axes=1) - patterns).max() <= 1e-6
