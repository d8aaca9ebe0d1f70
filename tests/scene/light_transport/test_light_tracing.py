"""Interreflections from the camera, from the projector, and from both: one mean, and the least noise from both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import mi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.light_tracing import Photons, add_photons
from mitsim.scene.light_transport.projected_codes import ModulatedLight, ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.camera import Camera
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform, look_at
from tests.render_threads import threads

pytestmark = pytest.mark.usefixtures("no_other_scenes")

BESIDE = Transform.from_degrees([0, -4.15, 0], [50.4, 0, 3.7])
POSE = look_at([60, -330, 240], [0, 10, 25], [0, 0, 1])
REPEATS = 12


def pinhole(width, height, focal, place=None):
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height, place or Transform.identity())


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """A metal floor, a white wall and a metal ball of few faces with vertex normals, in a corner."""
    ball = tmp_path_factory.mktemp("ball") / "ball.obj"
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 13)[:-1], indexing="ij")
    n = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    lines = [f"v {25 * x - 20:.9f} {25 * y + 10:.9f} {25 * z + 28:.9f}" for x, y, z in n]
    lines += [f"vn {x:.9f} {y:.9f} {z:.9f}" for x, y, z in n]
    for i in range(8):
        for j in range(12):
            a, b, c, d = (12 * p + q % 12 + 1 for p, q in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
            faces = [(a, b, c)] * (i < 7) + [(a, c, d)] * (i > 0)
            lines += ["f " + " ".join(f"{k}//{k}" for k in face) for face in faces]
    ball.write_text("\n".join(lines) + "\n")
    metal = {"type": "machined_metal", "Ra": 0.4, "alpha": 0.12}
    upright = mi.ScalarTransform4f().translate([0, 60, 40]).rotate([1, 0, 0], 90).scale([90, 40, 1])
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([90, 60, 1]), "bsdf": metal}
    return scene_from_dict(
        {
            "floor": floor,
            "wall": {"type": "rectangle", "bsdf": {"type": "matt_white"}, "to_world": upright},
            "ball": {"type": "obj", "filename": str(ball), "bsdf": metal},
        },
        850,
    )


def sharp_eyes():
    """Pinholes without distortion, and two patterns."""
    optics = pinhole(200, 140, 220.0, BESIDE)
    rng = np.random.default_rng(5)
    dots = np.kron(rng.integers(0, 2, (1, 7, 10)), np.ones((1, 20, 20)))
    ramp = np.broadcast_to(np.arange(200) / 200.0, (1, 140, 200))
    projector = Projector(optics, flux=1.0, black_level=0.1)
    return CameraRays(pinhole(96, 64, 170.0)), ProjectedPatterns(np.concatenate([dots, ramp]), projector)


def real_eyes():
    """Distortion and an aperture in both, a dim corner in the projector, and light that is modulated in time."""
    camera = replace(pinhole(96, 64, 150.0), distortion=np.array([-0.43, 0.24, 1e-3, -2e-3, -0.09]))
    optics = replace(
        pinhole(200, 140, 200.0, BESIDE), distortion=np.array([0.05, -0.02, 0.01, -0.003]), model="fisheye"
    )
    projector = Projector(optics, 1.0, aperture_mm=12.0, focus_mm=330.0, corner_illumination=0.5)
    # half a wave is 375 mm: the codes tell the lengths of paths apart
    light = ModulatedLight(projector, [200e6, 200e6], [0.0, np.pi / 2], 1.0)
    return CameraRays(camera, 14.0, 500.0), light


@pytest.mark.parametrize("eyes", [sharp_eyes, real_eyes])
def test_camera_lamp_and_both_have_one_mean(corner, eyes):
    """Two interreflections, of which the first is the most.

    Sums over blocks of pixels; the difference of two means over its standard error is a Student t.
    """
    rays, light = eyes()
    depth = 3

    def seen(seed, depth, photons, samples=36):
        return trace(
            corner, rays, light, POSE, LightPaths(samples=samples, seed=seed, depth=depth, jitter=True, photons=photons)
        )

    alone = []

    def lamp_alone(seed):
        images = seen(1000 + seed, 1, 0)
        alone.append(images.copy())
        add_photons(images[None], corner, rays, light, [POSE], Photons(375**2, depth, seed), rays.whole)
        return images

    def blocks(images):
        return np.stack(images).astype(float).reshape(REPEATS, 2, 8, 8, 12, 8).sum(axis=(3, 5))

    ways = {
        "camera": blocks([seen(s, depth, 0) for s in range(REPEATS)]),
        "lamp": blocks([lamp_alone(s) for s in range(REPEATS)]),
        "both": blocks([seen(100 + s, depth, 225**2) for s in range(REPEATS)]),
    }
    direct = blocks(alone).mean(axis=0)
    more = ways["camera"].mean(axis=0) - direct
    told = more > 0.02 * direct.max()
    assert told.sum() > 40  # of 192
    for one, other in (("camera", "lamp"), ("camera", "both"), ("lamp", "both")):
        a, b = ways[one][:, told], ways[other][:, told]
        z = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / REPEATS)
        # degrees of freedom 11 to 22: variance of at most 1.22; neighbouring images share their photons, so that
        # there are half as many independent blocks
        count = len(z) / 2
        assert abs(z.mean()) < 4 * np.sqrt(1.22 / count), (one, other)
        assert np.sqrt((z**2).mean()) < np.sqrt(1.22) * (1 + 4 / np.sqrt(2 * count)), (one, other)
    spread = {way: np.sqrt(values.var(0, ddof=1)[told].mean()) for way, values in ways.items()}
    # 0.43 to 0.63 of the camera's alone, with a quarter of its paths in photons
    assert spread["both"] < 0.75 * min(spread["camera"], spread["lamp"])


def test_photons_are_the_same_whatever_is_looked_at(corner):
    """Same seed, same bytes on any threads; a window and a band of rows get what they get in the whole image.

    The paths are those of the test before, so that no other kernel is compiled.
    """
    rays, light = real_eyes()

    def seen(seed, roi=None, depth=3, photons=225**2):
        paths = LightPaths(samples=36, seed=seed, depth=depth, jitter=True, photons=photons)
        return trace(corner, rays, light, POSE, paths, roi=roi)

    whole = seen(3)
    with threads(1):
        alone = seen(3)
    with threads(3):
        shared = seen(3)
    assert whole.tobytes() == alone.tobytes() == shared.tobytes()
    assert not np.array_equal(whole, seen(4))
    window = Roi(31, 17, 40, 21)
    assert np.array_equal(seen(3, window), whole[:, 17:38, 31:71])
    assert np.array_equal(seen(3, depth=1, photons=0), seen(3, depth=1))


def test_photons_calm_interreflections_on_metal(n10, scenes):
    """The two-pillar part, root mean square: one photon a pixel brings it down to 0.47 of what four paths leave."""
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    # the lens of other tests with this part, which share the kernels
    rays, light = CameraRays(n10.rig.reference, 2.0, 500.0), ProjectedPatterns(n10.patterns(), n10.projector)
    pose = look_at([0, -400, 300], [0, 0, 30], [0, 0, 1])

    def noise(photons):
        one, other = (
            trace(scene, rays, light, pose, LightPaths(samples=4, seed=s, depth=3, photons=photons))[0].astype(float)
            for s in (1, 2)
        )
        return np.sqrt(np.mean((one - other) ** 2) / 2)

    assert noise(None) < 0.6 * noise(0)
