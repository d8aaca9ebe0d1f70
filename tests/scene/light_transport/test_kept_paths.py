"""Paths kept once carry the light of any finish: that of a rendering in that finish, in every part of the image."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import mi
from mitsim.scene.light_transport import kept_tracing
from mitsim.scene.light_transport.kept_finishes import broad
from mitsim.scene.light_transport.kept_paths import CandidatePaths, KeptPaths, light_of, mattering
from mitsim.scene.light_transport.kept_tracing import camera_paths, photon_paths
from mitsim.scene.light_transport.kept_walks import Tracer, Tracing, Walk, split_walk
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.plain_scene import distinct_bsdfs
from mitsim.scene.light_transport.projected_codes import ModulatedLight, ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import bsdf_of, scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.surface.scatter import Deviation
from mitsim.scene.turned_lay import is_turned
from mitsim.sensor.camera import Camera
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform, look_at
from tests.render_threads import threads

pytestmark = pytest.mark.usefixtures("no_other_scenes")

BESIDE = Transform.from_degrees([0, -4.15, 0], [50.4, 0, 3.7])
POSE = look_at([60, -330, 240], [0, 10, 25], [0, 0, 1])
WIDTH, HEIGHT = 64, 48
#: finishes, and the largest standard error of the difference of all light
FINISHES = {
    "best estimate": (Deviation(), 0.01),
    "wide and bright": (Deviation(2.0, 2.0, 1.0), 0.01),
    "narrow and dark": (Deviation(-1.0, -1.0, -1.0), 0.03),
    "with marks": (Deviation(tail=-1.0, lay=0.5, lay_deg=35.0), 0.1),
}


def pinhole(width, height, focal, place=None):
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height, place or Transform.identity())


def two_faces():
    """A floor of ground metal, a wall of blasted metal in a V with it, and a stock block before them."""
    wall = mi.ScalarTransform4f().translate([0, 60, 40]).rotate([1, 0, 0], 70).scale([90, 45, 1])
    block = mi.ScalarTransform4f().translate([-30, 0, 15]).scale(15)
    return scene_from_dict(
        {
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([90, 60, 1]),
                "bsdf": {"type": "machined_metal", "Ra": 0.4},
            },
            "wall": {
                "type": "rectangle",
                "to_world": wall,
                "bsdf": {"type": "machined_metal", "process": "bead_blasted", "Ra": 1.6},
            },
            "block": {
                "type": "cube",
                "to_world": block,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.7}},
            },
        },
        850,
    )


@pytest.fixture(scope="module")
def corner():
    return two_faces()


def dots():
    """Pinholes and two patterns of dots, and their mean, which is not stored."""
    rng = np.random.default_rng(5)
    two = np.kron(rng.integers(0, 2, (2, 7, 10)), np.ones((1, 20, 20)))
    patterns = np.concatenate([two, two.mean(axis=0, keepdims=True)])
    projector = Projector(pinhole(200, 140, 220.0, BESIDE), flux=1.0)
    return CameraRays(pinhole(WIDTH, HEIGHT, 110.0)), ProjectedPatterns(patterns, projector)


def waves():
    """Apertures in both, and light that is modulated in time: half a wave is 375 mm."""
    projector = Projector(pinhole(200, 140, 220.0, BESIDE), 1.0, aperture_mm=12.0, focus_mm=330.0)
    light = ModulatedLight(projector, [200e6, 200e6], [0.0, np.pi / 2], 1.0)
    return CameraRays(pinhole(WIDTH, HEIGHT, 110.0), 14.0, 500.0), light


def candidates(scene, rays, light, seed, depth=3, samples=36):
    """All paths of the whole image, and its region."""
    turned = [is_turned(one) for one in distinct_bsdfs(deviating(scene, FINISHES["with marks"][0]))]
    bsdfs, roi = distinct_bsdfs(deviating(scene, Deviation())), Roi.whole(WIDTH, HEIGHT)
    known = {shape.bsdf().id(): one for shape, one in zip(scene.shapes, scene.finishes, strict=True) if one}
    drawn = [k if one.id() in known else -1 for k, one in enumerate(bsdfs)]
    sampled = [bsdf_of(broad(known[one.id()].description)) if one.id() in known else one for one in bsdfs]
    tracing = Tracing(samples, 240**2, depth, seed, drawn, sampled, turned)
    arguments = scene, rays, light.projector, POSE, roi
    tracer = Tracer(*arguments, tracing)
    found = [*camera_paths(tracer, np.arange(WIDTH * HEIGHT)), *photon_paths(tracer)]
    return CandidatePaths.joined(found, depth), roi


def deviating(scene, deviation):
    return scene.deviated(lambda _: deviation)


@pytest.mark.parametrize("eyes", [dots, waves])
def test_kept_paths_have_the_mean_of_a_rendering_in_every_finish(corner, eyes):
    """Light of two and three surfaces, a fifth of the paths kept.

    Sums over blocks of pixels; the difference of two means over its standard error is a Student t of 6 to 10 degrees of
    freedom, whose variance is at most 1.5. Images and neighbouring blocks share paths: there are half as many
    independent ones.
    """
    (rays, light), repeats = eyes(), 6

    def blocks(images):
        return np.asarray(images, float).reshape(repeats, light.count, 6, HEIGHT // 6, 8, WIDTH // 8).sum(axis=(3, 5))

    finishes = [distinct_bsdfs(deviating(corner, one)) for one, _ in FINISHES.values()]
    assert {is_turned(one) for one in finishes[-1]} == {True, False}
    images = [[] for _ in finishes]
    for seed in range(repeats):
        every, roi = candidates(corner, rays, light, seed)
        kept = mattering([every], finishes, roi, len(every) // 5, seed)
        assert abs(len(kept) - len(every) // 5) <= 1
        paths = KeptPaths.of(kept, roi)
        for found, bsdfs in zip(images, finishes, strict=True):
            found.append(light.images(list(paths.codes(bsdfs, light))))
    for name, found in zip(FINISHES, images, strict=True):
        deviation, largest = FINISHES[name]
        scene = deviating(corner, deviation)
        rendered = [
            trace(scene, rays, light, POSE, LightPaths(64, 50 + seed, 3, photons=400**2, indirect_only=True))
            for seed in range(repeats)
        ]
        one, other = blocks(found), blocks(rendered)
        told = other.mean(axis=0) > 0.02 * other.mean(axis=0).max()
        assert told.sum() > 10 * light.count
        a, b = one[:, told], other[:, told]
        z = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / repeats)
        count = len(z) / 2
        assert abs(z.mean()) < 4 * np.sqrt(1.5 / count), name
        assert np.sqrt((z**2).mean()) < np.sqrt(1.5) * (1 + 4 / np.sqrt(2 * count)), name
        # and all light together
        sums, others = a.sum(axis=1), b.sum(axis=1)
        error = np.sqrt((sums.var(ddof=1) + others.var(ddof=1)) / repeats)
        assert error < largest * others.mean(), name
        assert abs(sums.mean() - others.mean()) < 4 * error, name


def test_the_same_seed_keeps_the_same_light_on_any_threads(corner):
    rays, light = dots()

    def seen(seed):
        every, roi = candidates(corner, rays, light, seed)
        bsdfs = distinct_bsdfs(corner)
        return KeptPaths.of(mattering([every], [bsdfs], roi, 4000, seed), roi).codes(bsdfs, light)

    first = seen(3)
    with threads(1):
        alone = seen(3)
    with threads(3):
        shared = seen(3)
    assert first.tobytes() == alone.tobytes() == shared.tobytes()
    assert not np.array_equal(first, seen(4))


def test_paths_are_kept_in_proportion_to_their_light_and_weigh_what_was_left_out(corner):
    """The mean over choices is all light; those above the threshold are kept as they are."""
    rays, light = dots()
    every, roi = candidates(corner, rays, light, 1, depth=2)
    bsdfs = distinct_bsdfs(corner)
    (whole,) = light_of(every, [bsdfs])
    assert len(mattering([every], [bsdfs], roi, 10 * len(every), 1)) == (whole > 0).sum()
    count, sums = len(every) // 8, []
    for seed in range(20):
        kept = mattering([every], [bsdfs], roi, count, seed)
        (carried,) = light_of(kept, [bsdfs])
        sums.append(carried.sum())
        assert abs(len(kept) - count) <= 1
        assert np.isin(kept.pixel, every.pixel).all()
    # systematic in sizes that are the light itself: each sum is right within one path at the threshold
    assert np.abs(np.array(sums) / whole.sum() - 1).max() < 2 / count
    threshold = carried.min()
    assert (whole > 1.001 * threshold).sum() == (carried > 1.001 * threshold).sum()


def test_a_scene_that_does_not_light_itself_keeps_nothing():
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([90, 60, 1])}
    scene = scene_from_dict({"floor": floor | {"bsdf": {"type": "matt_white"}}}, 850)
    rays, light = dots()
    every, roi = candidates(scene, rays, light, 1)
    bsdfs = distinct_bsdfs(scene)
    kept = mattering([every], [bsdfs], roi, 100, 1)
    assert len(kept) == 0 and not KeptPaths.of(kept, roi).codes(bsdfs, light).any()


def test_a_batch_of_photons_that_all_pass_beside_the_image_of_the_projector_is_no_light(corner, monkeypatch):
    # the rectangle that photons pass through has a margin about the image: the last photon is in it
    rays, image = CameraRays(pinhole(WIDTH, HEIGHT, 110.0)), np.ones((1, 140, 200))
    light = ProjectedPatterns(image, Projector(pinhole(200, 140, 700.0, BESIDE), 1.0))
    started = []
    start = kept_tracing._photon_start

    def counted(one, first, count):
        walk = start(one, first, count)
        started.append(len(walk.lane))
        return walk

    monkeypatch.setattr(kept_tracing, "_photon_start", counted)
    whole, _ = candidates(corner, rays, light, 3, samples=4)
    monkeypatch.setattr(kept_tracing, "_AT_ONCE", 240 * 240 - 1)
    split, _ = candidates(corner, rays, light, 3, samples=4)
    assert started[-1] == 0
    assert len(split) == len(whole) and split.weight.sum() == pytest.approx(whole.weight.sum(), rel=1e-5)


def test_paths_keep_the_numbers_of_more_finishes_than_a_part_can_have():
    ones, lanes = mi.Float([1.0, 1.0, 1.0]), mi.UInt32([0, 1, 2])
    way, code = mi.Vector3f(0.0, 0.0, ones), mi.Point2f(ones, ones)
    walk = Walk(lanes, lanes, mi.Point3f(way), way, ones, ones, ones, code)
    record = ones, code, ones, mi.Int32([-1, 130, 300]), way, way
    _, candidates = split_walk(walk, ones > 0, record, ones > 0, None)
    assert candidates.material.ravel().tolist() == [-1, 130, 300]
