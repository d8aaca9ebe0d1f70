"""The transport against closed forms and against stock Mitsuba."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.features.fits import fit_sphere
from characterisation.region_of_interest import Roi
from mitsim.scene.backend import mi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.camera import Camera
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform, look_at
from tests.benchmarks.two_rays import triangulate
from tests.stock_mitsuba import FILM_OFFSET_PX, mitsuba_to_world

pytestmark = pytest.mark.usefixtures("no_other_scenes")

#: aperture and focus [mm] of all tests that trace four samples of the two pillars: they share the kernels
LENS = (2.0, 500.0)

BESIDE = Transform.from_degrees([0, -4.15, 0], [50.4, 0, 3.7])


def pinhole(width, height, focal, place=None):
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height, place or Transform.identity())


def plate(reflectance=0.85, size=2000):
    to_world = mi.ScalarTransform4f().scale([size, size, 1])
    bsdf = {"type": "matt_white", "reflectance": reflectance}
    return scene_from_dict({"plate": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}, 850)


@pytest.mark.parametrize("distance", [400.0, 800.0])
def test_lambertian_plate_has_its_closed_form_radiance(distance):
    """L = rho / pi E_1 / d^2 everywhere on a plate that faces a projector at the camera's place."""
    projector = Projector(pinhole(300, 200, 200.0), flux=2.0)
    image = trace(
        plate(),
        CameraRays(pinhole(60, 40, 60.0)),
        ProjectedPatterns(np.ones((1, 200, 300)), projector),
        look_at([0, 0, distance], [0, 0, 0], [0, 1, 0]),
        LightPaths(samples=4, seed=1),
    )[0]
    expected = 0.85 / np.pi * projector.plane_irradiance / distance**2
    assert np.allclose(image, expected, rtol=2e-5)


def test_flux_of_a_white_frame_is_the_flux():
    """Radiance of a white plate, times pi / rho, integrated over the lit area, is what the projector sends."""
    projector = Projector(pinhole(300, 200, 250.0), flux=1.7)
    camera = pinhole(160, 120, 100.0)
    image = trace(
        plate(),
        CameraRays(camera),
        ProjectedPatterns(np.ones((1, 200, 300)), projector),
        look_at([0, 0, 500], [0, 0, 0], [0, 1, 0]),
        LightPaths(samples=64, seed=1),
    )[0]
    pixel_area = (500 / 100.0) ** 2
    assert np.isclose(image.sum() * pixel_area * np.pi / 0.85, 1.7, rtol=2e-3)


def test_black_level_and_patterns_are_linear():
    projector = Projector(pinhole(30, 20, 20.0), flux=1.0, black_level=0.2)
    half = np.full((3, 20, 30), np.array([0.0, 0.5, 1.0])[:, None, None])
    images = trace(
        plate(),
        CameraRays(pinhole(12, 8, 12.0)),
        ProjectedPatterns(half, projector),
        look_at([0, 0, 500], [0, 0, 0], [0, 1, 0]),
        LightPaths(samples=1, seed=1),
    )
    assert np.allclose(images[0] / images[2], 0.2, rtol=1e-5)
    assert np.allclose(images[1] / images[2], 0.6, rtol=1e-5)


def test_a_window_shows_what_the_whole_image_shows_there(n10, scenes):
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    rays, patterns = CameraRays(n10.rig.cameras["left"], *LENS), ProjectedPatterns(n10.patterns(), n10.projector)
    pose = look_at([100, -350, 250], [0, 0, 30], [0, 0, 1])
    whole = trace(scene, rays, patterns, pose, LightPaths(samples=4, seed=1))[0]
    window = Roi(300, 200, 120, 80)
    part = trace(scene, rays, patterns, pose, LightPaths(samples=4, seed=2), roi=window)[0]
    same = whole[200:280, 300:420]
    assert part.shape == (80, 120)
    # direct light has no noise, so that another seed changes nothing
    np.testing.assert_array_equal(part, same)


@pytest.mark.parametrize(("depth", "jitter"), [(1, True), (3, False)])
def test_same_seed_same_bytes_and_other_seed_other_noise(n10, scenes, depth, jitter):
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    rays, patterns = CameraRays(n10.rig.cameras["left"], *LENS), ProjectedPatterns(n10.patterns(), n10.projector)
    pose = look_at([100, -350, 250], [0, 0, 30], [0, 0, 1])
    one, again, other = (
        trace(
            scene,
            rays,
            patterns,
            pose,
            LightPaths(samples=4, seed=s, depth=depth, jitter=jitter),
            roi=Roi(300, 200, 80, 60),
        )
        for s in (1, 1, 2)
    )
    assert one.tobytes() == again.tobytes()
    assert one.tobytes() != other.tobytes()


def test_direct_light_has_no_noise_and_a_small_quadrature_error(n10, scenes):
    """Sixteen midpoints against 1024 random places, on the N10's own pattern; the seed changes nothing."""
    scene = load_scene(scenes / "coupon/matt_white.xml", 850)
    rays, patterns = CameraRays(n10.rig.cameras["left"]), ProjectedPatterns(n10.patterns(), n10.projector)
    pose = look_at([100, -350, 450], [0, 0, 0], [0, 0, 1])
    window = Roi(340, 210, 60, 50)
    one, two = (trace(scene, rays, patterns, pose, LightPaths(samples=16, seed=s), roi=window)[0] for s in (1, 2))
    assert one.tobytes() == two.tobytes()
    reference = trace(scene, rays, patterns, pose, LightPaths(samples=1024, seed=1, jitter=True), roi=window)[0]
    # a full well of 20000 e- filled to a fifth has shot noise of 1.6 %: a fifth of that is 0.3 %
    assert (one - reference).std() < 0.003 * reference.mean()


def test_indirect_light_is_all_light_less_direct_light(n10, scenes):
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    rays, patterns = CameraRays(n10.rig.cameras["left"], *LENS), ProjectedPatterns(n10.patterns(), n10.projector)
    given = scene, rays, patterns, look_at([100, -350, 250], [0, 0, 30], [0, 0, 1])
    roi = Roi(300, 200, 120, 80)
    direct, both, later = (
        trace(*given, LightPaths(4, 4, depth, indirect_only=only), roi)
        for depth, only in ((1, False), (3, False), (3, True))
    )
    assert later.mean() > 0.01 * direct.mean()
    np.testing.assert_allclose(direct + later, both, atol=1e-5 * both.max())
    assert not trace(*given, LightPaths(4, 4, indirect_only=True), roi).any()


@pytest.mark.parametrize("depth", [1, 3])
def test_equal_to_stock_mitsuba(scenes, depth):
    """Within the Monte Carlo error of both, on a concave metal part, direct light and with two interreflections.

    The difference of two means over its own standard error must be a Student t. Interreflections have heavy tails, so
    the test is on sums over blocks of pixels, which are nearly Gaussian; the variance is measured over repeats.
    """
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    camera, optics = pinhole(96, 64, 170.0), pinhole(200, 140, 220.0, BESIDE)
    projector = Projector(optics, flux=1.0, black_level=0.1)
    rng = np.random.default_rng(5)
    pattern = np.kron(rng.integers(0, 2, (1, 14, 20)), np.ones((1, 10, 10)))
    pose = look_at([120, -330, 240], [0, 0, 25], [0, 0, 1])
    repeats, samples = 12, 36
    rays, lit = CameraRays(camera), ProjectedPatterns(pattern, projector)
    ours = np.stack(
        [
            trace(scene, rays, lit, pose, LightPaths(samples=samples, seed=s, depth=depth, jitter=True))[0]
            for s in range(repeats)
        ]
    )

    stock = _stock_scene(scene, camera, projector, pattern[0], pose, depth)
    theirs = (
        np.stack([np.array(mi.render(stock, spp=samples, seed=100 + s))[..., 0] for s in range(repeats)]) / np.pi
    )  # the plugin's own unit, see mitsim.sensor.projector

    def blocks(images):
        return images.reshape(repeats, 8, 8, 12, 8).sum(axis=(2, 4)).reshape(repeats, -1)

    a, b = blocks(ours), blocks(theirs)
    lit_blocks = b.mean(0) > 1e-3 * b.mean(0).max()
    a, b = a[:, lit_blocks], b[:, lit_blocks]
    z = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / repeats)
    # Student's t with about 11 to 22 degrees of freedom: variance n/(n-2) of at most 1.22
    assert len(z) > 30
    assert abs(z.mean()) < 4 * np.sqrt(1.22 / len(z))
    assert np.sqrt((z**2).mean()) < np.sqrt(1.22) * (1 + 4 / np.sqrt(2 * len(z)))
    assert np.isclose(a.mean(), b.mean(), rtol=0.01)


#: each is a tenth or more of the light of its corner
LAMPS = {
    "sky": {"type": "constant", "radiance": {"type": "uniform", "value": 2e-7}},
    "bulb": {"type": "point", "position": [150.0, -200.0, 300.0], "intensity": {"type": "uniform", "value": 0.2}},
    "panel": {
        "type": "rectangle",
        "to_world": ("panel",),
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 4e-5}},
    },
}


@pytest.mark.parametrize(
    ("bsdf", "reflectance"),
    [
        ({"type": "conductor", "material": "none", "specular_reflectance": 0.9}, 0.9),
        ({"type": "plastic", "int_ior": 1.5, "ext_ior": 1.0, "diffuse_reflectance": 0.0}, 0.04),
    ],
)
def test_a_lamp_is_seen_in_a_mirror_as_bright_as_the_mirror_reflects(bsdf, reflectance):
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 800]).rotate([1, 0, 0], 180).scale([900, 900, 1]),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 2.0}},
    }
    mirror = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([200, 200, 1]), "bsdf": bsdf}
    scene = scene_from_dict({"mirror": mirror, "lamp": lamp}, 850)
    dark = ProjectedPatterns(np.zeros((1, 8, 8)), Projector(pinhole(8, 8, 20.0), flux=1.0))
    paths, pose = LightPaths(samples=16, seed=1, depth=1), look_at([0, 0, 300], [0, 0, 0], [0, 1, 0])
    image = trace(scene, CameraRays(pinhole(8, 8, 40.0)), dark, pose, paths)[0]
    np.testing.assert_allclose(image / 2.0, reflectance, rtol=1e-3)


@pytest.mark.parametrize("depth", [1, 3])
def test_light_of_the_scene_is_that_of_stock_mitsuba(depth):
    """Sky, bulb and panel over a concave metal corner, with the projector on top; then the ambient image alone."""
    scene, chosen = _lit_corner(LAMPS, {"type": "machined_metal", "Ra": 0.4})
    camera, optics = pinhole(96, 64, 170.0), pinhole(200, 140, 220.0, BESIDE)
    projector = Projector(optics, flux=1e-2)
    pose = look_at([60, -330, 240], [0, 20, 25], [0, 0, 1])
    repeats, samples = 12, 36
    rays, lit = CameraRays(camera), ProjectedPatterns(np.ones((1, 140, 200)), projector)
    ours = np.stack(
        [
            trace(
                scene, rays, lit, pose, LightPaths(samples=samples, seed=s, depth=depth, jitter=True, with_ambient=True)
            )
            for s in range(repeats)
        ]
    )
    dark = ProjectedPatterns(np.zeros((1, 140, 200)), projector)
    alone = trace(
        scene, rays, dark, pose, LightPaths(samples=samples, seed=99, depth=depth, jitter=True, with_ambient=True)
    )
    stock = _stock_scene(scene, camera, projector, np.full((140, 200), np.pi**-1), pose, depth, chosen)
    theirs = np.stack([np.array(mi.render(stock, spp=samples, seed=100 + s))[..., 0] for s in range(repeats)])

    def blocks(images):
        return images.reshape(repeats, 8, 8, 12, 8).sum(axis=(2, 4)).reshape(repeats, -1)

    a, b = blocks(ours[:, 0]), blocks(theirs)
    lit_blocks = b.mean(0) > 1e-3 * b.mean(0).max()
    a, b = a[:, lit_blocks], b[:, lit_blocks]
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / repeats)
    noisy = error > 1e-6 * b.mean(0)
    assert np.allclose(a.mean(0)[~noisy], b.mean(0)[~noisy], rtol=1e-4)  # where neither has noise, they are equal
    z = ((a.mean(0) - b.mean(0))[noisy]) / error[noisy]
    assert len(z) > 20
    assert abs(z.mean()) < 4 * np.sqrt(1.22 / len(z))
    assert np.sqrt((z**2).mean()) < np.sqrt(1.22) * (1 + 4 / np.sqrt(2 * len(z)))
    assert np.array_equal(alone[0], alone[1])
    assert 0 < alone[1].mean() < ours[0, 0].mean()


@pytest.mark.parametrize("lamp", ["sky", "bulb", "panel"])
def test_indirect_light_of_emitters_is_all_of_it_less_its_direct_light(lamp):
    """With the projector off; each is random by itself, so that means over blocks of pixels are held together.

    Eight images of 128 samples have means as precise as those of sixteen of 64, at half the launches.
    """
    scene, _ = _lit_corner([lamp], {"type": "matt_white"})
    rays = CameraRays(pinhole(48, 32, 85.0))
    dark = ProjectedPatterns(np.zeros((1, 140, 200)), Projector(pinhole(200, 140, 220.0, BESIDE), flux=1e-2))
    pose = look_at([60, -330, 240], [0, 20, 25], [0, 0, 1])
    direct, both, later = (
        np.stack(
            [
                trace(
                    scene,
                    rays,
                    dark,
                    pose,
                    LightPaths(samples=128, seed=s, depth=depth, with_ambient=True, indirect_only=only),
                )[-1]
                .reshape(4, 8, 6, 8)
                .sum(axis=(1, 3))
                .ravel()
                for s in seeds
            ]
        )
        for depth, only, seeds in ((1, False, range(8)), (2, False, range(20, 28)), (2, True, range(40, 48)))
    )
    difference = direct.mean(0) + later.mean(0) - both.mean(0)
    error = np.sqrt((direct.var(0, ddof=1) + later.var(0, ddof=1) + both.var(0, ddof=1)) / 8)
    seen = both.mean(0) > 1e-3 * both.mean()
    assert seen.sum() > 10 and later.mean() > 0.01 * direct.mean()
    z = difference[seen] / np.maximum(error[seen], 1e-5 * both.mean(0)[seen])
    assert np.abs(z).max() < 4.5 and abs(z.mean()) < 4 / np.sqrt(len(z))


def _lit_corner(lamps, finish):
    """A floor of a finish, a white wall, and some of :data:`LAMPS`: the scene, and those lamps for another renderer."""
    to_world = mi.ScalarTransform4f().translate([-120, -150, 260]).rotate([1, 0, 0], 150).scale([60, 60, 1])
    chosen = {name: dict(LAMPS[name]) for name in lamps}
    if "panel" in chosen:
        chosen["panel"]["to_world"] = to_world
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([90, 60, 1]), "bsdf": finish}
    upright = mi.ScalarTransform4f().translate([0, 60, 40]).rotate([1, 0, 0], 90).scale([90, 40, 1])
    wall = {"type": "rectangle", "bsdf": {"type": "matt_white"}, "to_world": upright}
    return scene_from_dict({"floor": floor, "wall": wall, **chosen}, 850), chosen


def _stock_scene(scene, camera, projector, pattern, pose, depth, lamps=None):
    optics = projector.optics

    def fov(eye):
        return float(np.degrees(2 * np.arctan(eye.width / 2 / eye.matrix[0, 0])))

    assert camera.matrix[0, 2] + FILM_OFFSET_PX == camera.width / 2  # stock cameras have no principal point here
    texture = mi.Bitmap((projector.emit(pattern) * projector.plane_irradiance)[..., None].astype(np.float32))
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth + 1, "rr_depth": 1000},
        "sensor": {
            "type": "perspective",
            "fov": fov(camera),
            "fov_axis": "x",
            "near_clip": 1.0,
            "far_clip": 1e5,
            "to_world": mi.ScalarTransform4f(mitsuba_to_world(pose @ camera.sensor_from_camera)),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
        },
        "lamp": {
            "type": "projector",
            "fov": fov(optics),
            "to_world": mi.ScalarTransform4f(mitsuba_to_world(pose @ optics.sensor_from_camera)),
            "irradiance": {"type": "bitmap", "bitmap": texture, "raw": True, "wrap_mode": "clamp"},
        },
    }
    description |= {f"shape{i}": shape for i, shape in enumerate(scene.shapes)}
    description |= {name: lamp for name, lamp in (lamps or {}).items() if lamp["type"] != "rectangle"}
    return mi.load_dict(description, optimize=False)


def test_sphere_through_an_ideal_code(n10):
    """Radius 100 mm at 600 mm, through the N10's own distorted camera: geometry and half-pixels, before any noise.

    The code is ideal: two ramps over the projector's columns and rows, divided by white.
    """
    sphere = {"type": "sphere", "radius": 100.0, "bsdf": {"type": "matt_white"}}
    scene = scene_from_dict({"sphere": sphere}, 850)
    optics = n10.projector.optics
    columns, rows = np.meshgrid(np.arange(optics.width) / optics.width, np.arange(optics.height) / optics.height)
    ramps = np.stack([columns, rows, np.ones_like(columns)])
    projector = Projector(optics, n10.projector.flux)  # no black level
    camera = n10.rig.cameras["left"]
    pose = look_at([40, -590, 100], [0, 0, 0], [0, 0, 1])
    u, v, white = trace(
        scene, CameraRays(camera), ProjectedPatterns(ramps, projector), pose, LightPaths(samples=64, seed=1)
    )
    facing = white > 0.5 * white.max()  # away from the limb, where a pixel averages over a steep slope
    with np.errstate(invalid="ignore", divide="ignore"):
        projector_pixels = np.stack([u / white * optics.width, v / white * optics.height], axis=-1)[facing]
    points, gap = triangulate(camera, camera.pixel_grid()[facing], optics, projector_pixels)
    fit = fit_sphere(points, viewpoint=np.zeros(3))
    assert facing.sum() > 10000
    assert np.median(gap) < 0.02
    assert abs(fit.radius - 100.0) < 0.05
    assert np.linalg.norm(fit.centre - pose.inverse().points(np.zeros(3))) < 0.05
    assert fit.residual_std < 0.05
    print(f"sphere through an ideal code: radius error {1000 * (fit.radius - 100):.2f} um")
