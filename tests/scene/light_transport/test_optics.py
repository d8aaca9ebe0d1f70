"""Lenses, distortion and codes of camera and projector: closed forms, OpenCV's camera models and stock Mitsuba."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport import transport
from mitsim.scene.light_transport.aperture_samples import aperture_samples
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ModulatedLight, ProjectedPatterns
from mitsim.scene.light_transport.projector_light import ProjectorLight
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.camera import Camera
from mitsim.sensor.modulation import LIGHT_MM_S
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform, look_at
from tests.stock_mitsuba import mitsuba_to_world

pytestmark = pytest.mark.usefixtures("no_other_scenes")


def pinhole(width, height, focal, place=None):
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height, place or Transform.identity())


def plate(depth=0.0, size=2000, bsdf=None):
    to_world = mi.ScalarTransform4f().translate([0, 0, depth]).scale([size, size, 1])
    return scene_from_dict(
        {"plate": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or {"type": "matt_white"}}}, 850
    )


def facing(distance):
    return look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])


DISTORTED = {
    "five": ("perspective", [-0.43, 0.24, 1e-3, -2e-3, -0.09]),
    "rational": ("perspective", [0.2, -0.1, 1e-3, -1e-3, 0.02, 0.3, -0.05, 0.01, 0, 0, 0, 0, 0, 0]),
    "prism and tilt": (
        "perspective",
        [-0.2, 0.1, 1e-3, 5e-4, 0, 0.05, 0.02, 0, 2e-3, -1e-3, -2e-3, 1e-3, 0.03, -0.02],
    ),
    "fisheye": ("fisheye", [0.05, -0.02, 0.01, -0.003]),
}


@pytest.mark.parametrize("kind", sorted(DISTORTED))
def test_the_lamp_projects_as_opencv_does(kind):
    model, coefficients = DISTORTED[kind]
    place = Transform.from_degrees([3, -8, 2], [80, 5, -3])
    optics = replace(pinhole(800, 600, 700.0, place), distortion=np.array(coefficients), model=model)
    lamp = ProjectorLight(Transform.identity(), Projector(optics, 1.0))
    rng = np.random.default_rng(3)
    seen = optics.rays(rng.uniform([0, 0], [799, 599], (500, 2)))
    points = place.points(seen * rng.uniform(300, 900, (500, 1)))
    local = place.inverse().points(points)
    x, y = (mi.Float((local[:, i] / local[:, 2]).astype(np.float32)) for i in (0, 1))
    ours = np.stack([np.array(v) for v in lamp.distortion.pixel(x, y)], axis=-1)
    assert np.abs(ours - optics.project(points)).max() < 2e-3  # single precision of a coordinate up to 800


@pytest.mark.parametrize("kind", sorted(DISTORTED))
def test_the_camera_sees_as_opencv_does(kind):
    """Every pixel's mean projector coordinate on a tilted plate is that of the middle of the pixel, lens and all."""
    model, coefficients = DISTORTED[kind]
    camera = replace(pinhole(160, 120, 180.0), distortion=np.array(coefficients), model=model)
    optics = pinhole(800, 600, 500.0, Transform.from_degrees([0, -4, 0], [60, 5, -3]))
    columns, rows = np.meshgrid(np.arange(800) / 800.0, np.arange(600) / 600.0)
    ramps = ProjectedPatterns(np.stack([columns, rows, np.ones_like(rows)]), Projector(optics, 1.0))
    pose = look_at([100, -80, 500], [0, 0, 0], [0, 1, 0])
    u, v, white = trace(plate(), CameraRays(camera), ramps, pose, LightPaths(samples=64, seed=1))
    rays = camera.rays(camera.pixel_grid())
    normal, height = pose.inverse().directions(np.array([0, 0, 1.0])), pose.translation[2]
    points = rays * (-height / (rays @ normal))[..., None]
    true = optics.project(points)
    inner = (white > 0) & (np.abs(true - [399.5, 299.5]) < [380, 280]).all(axis=-1)
    found = np.stack([u / np.where(inner, white, 1) * 800, v / np.where(inner, white, 1) * 600], axis=-1)
    assert inner.sum() > 5000
    # a pixel is 3 projector pixels wide: its mean is off its middle by the map's curvature, and single precision
    assert np.abs(found - true)[inner].max() < 0.1
    assert np.abs(np.median((found - true)[inner], axis=0)).max() < 0.005


@pytest.mark.parametrize("kind", sorted(DISTORTED))
def test_stretch_is_the_derivative_of_the_lens(kind):
    model, coefficients = DISTORTED[kind]
    optics = replace(pinhole(800, 600, 700.0), distortion=np.array(coefficients), model=model)
    seen = optics.rays(np.random.default_rng(3).uniform([0, 0], [799, 599], (500, 2)))
    ideal, step = seen[:, :2] / seen[:, 2:], 1e-4 * np.eye(2)

    def pixels(points):
        return optics.project(np.concatenate([points, np.ones((500, 1))], axis=1))

    x, y = ((pixels(ideal + move) - pixels(ideal - move)) / (2e-4 * 700) for move in step)
    stretch = ProjectorLight(Transform.identity(), Projector(optics, 1.0)).distortion.stretch(
        *(mi.Float(one.astype(np.float32)) for one in ideal.T)
    )
    np.testing.assert_allclose(np.array(stretch), x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0], rtol=1e-5)
    assert np.ptp(np.array(stretch)) > 0.02


@pytest.mark.parametrize("kind", sorted(DISTORTED))
def test_a_white_frame_carries_the_flux_through_any_lens(kind):
    model, coefficients = DISTORTED[kind]
    optics = replace(pinhole(80, 60, 80.0), distortion=0.5 * np.array(coefficients), model=model)
    projector, camera = Projector(optics, 1.7), pinhole(400, 400, 120.0)  # the camera sees the whole frame
    image = trace(
        plate(size=8000, bsdf={"type": "diffuse", "reflectance": 1.0}),
        CameraRays(camera),
        ProjectedPatterns(np.ones((1, 60, 80)), projector),
        facing(500.0),
        LightPaths(samples=16, seed=1),
    )[0]
    assert not image[[0, -1]].any() and not image[:, [0, -1]].any()
    assert np.pi * image.sum() * (500.0 / 120.0) ** 2 == pytest.approx(1.7, rel=3e-3)
    steps = (np.arange(400) + 0.5) / 400
    u, v = (mi.Float(a.ravel().astype(np.float32)) for a in np.meshgrid(steps, steps))
    flux = ProjectorLight(Transform.identity(), projector).emit_photon(mi.Point2f(u, v), None)[2]
    assert np.array(flux).mean() == pytest.approx(1.7, rel=3e-3)


def test_a_drawn_calibration_keeps_the_light_of_a_lens_without_distortion(n10):
    plain = pinhole(80, 60, 40.0)
    assert not Projector(plain, 1.0).is_stretched and Projector(replace(plain, model="fisheye"), 1.0).is_stretched
    for coefficients in (np.zeros(5), np.array([0.02, 0, 0, 0, 0])):
        nominal = replace(n10.projector.optics, distortion=coefficients)
        drawn = replace(nominal, distortion=coefficients + 1e-3)
        sensor = replace(n10, projector=replace(n10.projector, optics=nominal))
        other = SimulatedSensor(sensor).recalibrated(replace(n10.rig, projector=drawn))
        assert other.sensor.projector is other.patterns.projector
        assert other.patterns.projector.is_stretched == coefficients.any()


def test_beyond_its_image_a_projector_sends_nothing():
    """Strong barrel distortion folds far directions back into the image; no light may come from there."""
    optics = replace(pinhole(300, 200, 200.0), distortion=np.array([-0.15, 0.0, 0, 0, 0]))
    camera = pinhole(120, 80, 20.0)  # looks far beyond
    image = trace(
        plate(),
        CameraRays(camera),
        ProjectedPatterns(np.ones((1, 200, 300)), Projector(optics, 1.0)),
        facing(300.0),
        LightPaths(samples=1, seed=1),
    )[0]
    pixels = optics.project(camera.rays(camera.pixel_grid()) * 300)
    radius = np.linalg.norm((camera.pixel_grid() - [59.5, 39.5]) / 20.0, axis=-1)
    corners = optics.rays(np.array([[-0.5, -0.5], [299.5, 199.5]]))
    farthest = (np.hypot(corners[:, 0], corners[:, 1]) / corners[:, 2]).max()
    in_image = np.all((pixels > -0.5) & (pixels < [299.5, 199.5]), axis=-1)
    assert (np.isnan(pixels[..., 0]) & (radius > 1.1 * farthest)).sum() > 20  # the fold is there
    assert not image[radius > 1.1 * farthest].any()
    assert image[in_image & (radius < farthest)].all()


@pytest.mark.parametrize("count", [1, 4, 16, 25, 64])
def test_lens_places_fill_their_discs_and_blur_as_much_as_discs_do(count):
    """Mean zero, <r^2> = 1/2, opposite places in opposite cells; sums have the second moments of what they stand for.

    z + c L + p P has the covariance (1/12 + c^2/4 + p^2/4) I [px^2], on either side of both planes of focus.
    """
    side = round(np.sqrt(count))
    middles = (np.stack([np.arange(count) % side, np.arange(count) // side]) + 0.5) / side - 0.5
    lenses = aperture_samples(count)
    for places in lenses:
        assert places.shape == (2, count)
        assert np.abs(places.mean(axis=1)).max() < 1e-6
        assert np.array_equal(places, -places[:, ::-1])
        # a uniform disc has <r^2> = 1/2; one place in the middle of an odd set takes 1/count of it
        assert np.isclose((places**2).sum(axis=0).mean(), 0.5 if count > 1 else 0.0, atol=1.0 / count)
    # an order of few places cannot be perfect; before the places were searched for it was 0.19, 0.17 and 0.08
    allowed, correlated = {16: (0.06, 0.06), 25: (0.04, 0.04), 64: (0.02, 0.015)}.get(count, (None, None))
    if allowed is None:
        return
    # light that changes over a lens moves the pattern by its correlation with the place in the pixel
    for one, other in ((middles, lenses[0]), (middles, lenses[1]), (lenses[0], lenses[1])):
        rows = [np.sqrt(count) * part / np.linalg.norm(part, axis=1, keepdims=True) for part in (one, other)]
        if other is lenses[1]:
            assert np.abs(rows[0] @ rows[1].T / count).max() < correlated
        else:  # turned by 90 deg: x with x and y with y
            assert np.abs(np.diag(rows[0] @ rows[1].T) / count).max() < 1e-6
    cells = middles / np.sqrt(1 - side**-2)
    for c, p in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (-0.5, 0.3), (1.0, 1.0)):
        sums = cells + c * lenses[0] + p * lenses[1]
        wanted = 1 / 12 + (c * c + p * p) / 4
        assert np.abs(sums @ sums.T / count / wanted - np.eye(2)).max() < allowed, (c, p)


def test_camera_defocus_is_that_of_a_thin_lens():
    """A sharp edge of light on a plate out of focus is spread as the chord integral of a disc.

    Disc diameter D f |1/z - 1/z_f| px; a uniform disc of radius r has the variance r^2 / 4 along any axis.
    """
    focal, diameter, focus, distance = 600.0, 20.0, 400.0, 700.0
    camera = pinhole(101, 31, focal)
    optics = pinhole(400, 300, 300.0)
    pattern = np.zeros((1, 300, 400), np.float32)
    pattern[:, :, 200:] = 1.0
    sharp, blurred = (
        trace(
            plate(),
            CameraRays(camera, aperture, focus),
            ProjectedPatterns(pattern, Projector(optics, 1.0)),
            facing(distance),
            LightPaths(samples=1024, seed=1),
        )[0, 15]
        for aperture in (0.0, diameter)
    )
    radius = 0.5 * diameter * focal * abs(1 / distance - 1 / focus)

    def variance(profile):
        spread = np.diff(profile)
        spread = spread / spread.sum()
        middle = (np.arange(100) * spread).sum()
        return middle, ((np.arange(100) - middle) ** 2 * spread).sum()

    (middle, width), (other, wide) = variance(sharp), variance(blurred)
    assert abs(other - middle) < 0.02
    assert np.isclose(wide - width, radius**2 / 4, rtol=0.03)


def test_camera_defocus_equals_stock_thinlens():
    """The same blur as Mitsuba's own ``thinlens``, on random dots, within the Monte Carlo error of both."""
    focal, diameter, focus, distance = 170.0, 30.0, 400.0, 520.0
    camera, optics = pinhole(96, 64, focal), pinhole(200, 140, 220.0)
    projector = Projector(optics, 1.0)
    rng = np.random.default_rng(5)
    pattern = np.kron(rng.integers(0, 2, (1, 14, 20)), np.ones((1, 10, 10)))
    pose, scene = facing(distance), plate()
    rays = CameraRays(camera, diameter, focus)
    ours = np.stack(
        [
            trace(
                scene, rays, ProjectedPatterns(pattern, projector), pose, LightPaths(samples=64, seed=s, jitter=True)
            )[0]
            for s in range(8)
        ]
    )

    def fov(eye):
        return float(np.degrees(2 * np.arctan(eye.width / 2 / eye.matrix[0, 0])))

    texture = mi.Bitmap((pattern[0] * projector.plane_irradiance)[..., None].astype(np.float32))
    stock = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "plate": scene.shapes[0],
            "sensor": {
                "type": "thinlens",
                "fov": fov(camera),
                "fov_axis": "x",
                "aperture_radius": diameter / 2,
                "focus_distance": focus,
                "to_world": mi.ScalarTransform4f(mitsuba_to_world(pose)),
                "film": {
                    "type": "hdrfilm",
                    "width": 96,
                    "height": 64,
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
        },
        optimize=False,
    )
    theirs = np.stack([np.array(mi.render(stock, spp=64, seed=100 + s))[..., 0] for s in range(8)]) / np.pi
    error = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / 8)
    noisy = error > 1e-4 * theirs.mean()
    z = ((ours.mean(0) - theirs.mean(0)) / np.where(noisy, error, 1))[noisy]
    assert len(z) > 1000
    # Student's t with 7 to 14 degrees of freedom: variance of at most 1.4; pixels are independent
    assert abs(z.mean()) < 4 * np.sqrt(1.4 / len(z))
    assert np.sqrt((z**2).mean()) < np.sqrt(1.4) * (1 + 4 / np.sqrt(2 * len(z)))


def test_projector_defocus_grows_with_the_distance_from_its_focus():
    """Diameter aperture * f * |1/z - 1/focus| projector px, seen by a camera with finer pixels; none in focus."""
    focal, aperture, focus = 300.0, 30.0, 500.0
    optics = pinhole(400, 300, focal)
    camera = pinhole(401, 21, 1200.0)
    edge = np.zeros((1, 300, 400), np.float32)
    edge[:, :, 200:] = 1.0
    pattern = ProjectedPatterns(edge, Projector(optics, 1.0, aperture_mm=aperture, focus_mm=focus))
    point = ProjectedPatterns(edge, Projector(optics, 1.0))

    def spread(lit, distance):
        profile = np.diff(
            trace(plate(), CameraRays(camera), lit, facing(distance), LightPaths(samples=1024, seed=1))[0, 10]
        )
        profile = profile / profile.sum()
        place = np.arange(400)
        middle = (place * profile).sum()
        return middle, ((place - middle) ** 2 * profile).sum()

    for distance in (350.0, 500.0, 800.0):
        (middle, width), (other, wide) = spread(point, distance), spread(pattern, distance)
        radius = 0.5 * aperture * focal * abs(1 / distance - 1 / focus) * 1200.0 / focal  # in camera pixels
        assert abs(other - middle) < 0.03
        assert np.isclose(wide - width, radius**2 / 4, rtol=0.04, atol=0.02)


def test_an_aperture_makes_a_penumbra():
    """Half-way up a screen's shadow on a plate: similar triangles."""
    screen = {
        "type": "rectangle",
        "bsdf": {"type": "twosided", "b": {"type": "matt_white"}},
        "to_world": mi.ScalarTransform4f().translate([-500, 0, 250]).scale([500, 500, 1]),
    }
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([2000, 2000, 1]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"floor": floor, "screen": screen}, 850)
    optics = pinhole(300, 200, 150.0)
    camera = pinhole(201, 41, 500.0, Transform.from_degrees([0, 0, 0], [60, 0, 0]))
    lit = ProjectedPatterns(np.ones((1, 200, 300)), Projector(optics, 1.0, aperture_mm=20.0, focus_mm=500.0))
    image = trace(scene, CameraRays(camera), lit, facing(500.0), LightPaths(samples=256, seed=1))[0, 20]
    white = trace(plate(), CameraRays(camera), lit, facing(500.0), LightPaths(samples=256, seed=1))[0, 20]
    # the screen ends at x = 0, half way down: light from the lens place x' reaches floor points x > -x'
    x = np.arange(201) - 100 + 60.0  # the camera stands at x = 60, one pixel is 1 mm
    side = np.clip(x / 10.0, -1, 1)
    share = 0.5 + (side * np.sqrt(1 - side**2) + np.arcsin(side)) / np.pi
    near = np.abs(x) < 40
    assert np.abs(image / white - share)[near].max() < 0.02


def test_vignetting_is_the_cosine_law_where_it_is_told_so():
    optics = pinhole(300, 200, 150.0)
    corner = np.cos(np.arctan(np.hypot(149.5, 99.5) / 150.0)) ** 4
    camera = pinhole(60, 40, 40.0)
    plain, dim = (
        trace(
            plate(),
            CameraRays(camera),
            ProjectedPatterns(np.ones((1, 200, 300)), Projector(optics, 1.0, corner_illumination=c)),
            facing(500.0),
            LightPaths(samples=1, seed=1),
        )[0]
        for c in (1.0, corner)
    )
    lit = plain > 0
    rays = camera.rays(camera.pixel_grid())
    assert np.allclose((dim / np.where(lit, plain, 1))[lit], rays[..., 2][lit] ** 4, rtol=1e-3)


def test_a_pixel_gap_is_dark_and_keeps_the_flux():
    optics = pinhole(30, 20, 30.0)
    camera = pinhole(600, 400, 600.0)
    solid, gapped = (
        trace(
            plate(),
            CameraRays(camera),
            ProjectedPatterns(np.ones((1, 20, 30)), Projector(optics, 1.0, pixel_gap=gap)),
            facing(500.0),
            LightPaths(samples=4, seed=1),
        )[0]
        for gap in (0.0, 0.1)
    )
    middle = (slice(100, 300), slice(100, 500))
    assert np.isclose(gapped[middle].mean(), solid[middle].mean(), rtol=0.01)
    assert np.isclose((gapped[middle] == 0).mean(), 1 - 0.9**2, atol=0.01)


def test_the_response_curve_is_a_power_above_the_black_level():
    projector = Projector(pinhole(30, 20, 20.0), flux=1.0, black_level=0.2, gamma=2.2)
    values = np.linspace(0, 1, 5)
    steps = np.full((5, 20, 30), values[:, None, None])
    images = trace(
        plate(),
        CameraRays(pinhole(12, 8, 12.0)),
        ProjectedPatterns(steps, projector),
        facing(500.0),
        LightPaths(samples=1, seed=1),
    )
    assert np.allclose(images[:, 4, 6] / images[-1, 4, 6], 0.2 + 0.8 * values**2.2, rtol=1e-5)


@pytest.mark.parametrize("distance", [700.0, 1900.0, 4300.0])
def test_time_of_flight_phase_is_the_path_length(distance):
    """Every pixel of a plate, at three phases and two frequencies: distance from the arctangent, mod half a wave."""
    frequencies = np.repeat([16e6, 80e6], 3)
    deltas = np.tile(2 * np.pi * np.arange(3) / 3, 2)
    optics = pinhole(300, 200, 120.0, Transform.from_degrees([0, 0, 0], [40.0, 0, 0]))
    camera = pinhole(60, 40, 50.0)
    light = ModulatedLight(Projector(optics, 1.0), frequencies, deltas, 0.8)
    images = trace(plate(size=2e4), CameraRays(camera), light, facing(distance), LightPaths(samples=1, seed=1)).astype(
        float
    )
    rays = camera.rays(camera.pixel_grid())
    points = rays * (distance / rays[..., 2:])
    length = np.linalg.norm(points, axis=-1) + np.linalg.norm(points - optics.centre, axis=-1)
    seen = images[0] > 0
    for k, frequency in enumerate((16e6, 80e6)):
        stack = images[3 * k : 3 * k + 3]
        c, s = np.tensordot(np.cos(deltas[:3]), stack, 1), np.tensordot(np.sin(deltas[:3]), stack, 1)
        wave = LIGHT_MM_S / frequency
        off = (np.arctan2(s, c) / (2 * np.pi) * wave - length + wave / 2) % wave - wave / 2
        assert np.abs(off[seen]).max() < 0.02  # mm of path; single precision
        offset = stack.mean(axis=0)
        assert np.allclose((2 / 3 * np.hypot(c, s) / offset)[seen], 0.8, rtol=1e-4)


def test_a_second_bounce_makes_the_path_longer():
    """A corner of two white walls: the mean length weighted by light lies beyond the direct one (multipath)."""
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 45).translate([0, 0, -300]).scale([800, 800, 1]),
        "bsdf": {"type": "matt_white"},
    }
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -45).translate([0, 0, -300]).scale([800, 800, 1]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"floor": floor, "wall": wall}, 850)
    camera = pinhole(60, 40, 60.0)
    light = ModulatedLight(Projector(pinhole(200, 150, 100.0), 1.0), [16e6] * 4, np.arange(4) * np.pi / 2, 1.0)

    def path(depth):
        images = trace(scene, CameraRays(camera), light, facing(1500.0), LightPaths(samples=64, seed=1, depth=depth))
        phase = np.arctan2(images[1] - images[3], images[0] - images[2])
        return np.mod(phase, 2 * np.pi) / (2 * np.pi) * LIGHT_MM_S / 16e6

    direct, all_light = path(1)[10:30, 15:45], path(3)[10:30, 15:45]
    assert np.median(all_light - direct) > 10.0
    assert (all_light > direct).mean() > 0.99


def test_wrong_time_of_flight_settings_are_told():
    with pytest.raises(InputError, match="one frequency over 0"):
        ModulatedLight(Projector(pinhole(30, 20, 20.0), 1.0), [16e6, 80e6], [0.0], 1.0)


def test_speckle_reads_the_code_beside_the_point():
    """A constant shift of 1 mrad moves a ramp as 0.5 mm on a plate at 500 mm does, on the axis."""
    optics, camera = pinhole(400, 300, 300.0), pinhole(60, 40, 60.0)
    ramp = np.broadcast_to(np.arange(400) / 400.0, (1, 300, 400))
    lit, scene = ProjectedPatterns(ramp, Projector(optics, 1.0)), plate()
    shift = np.zeros((2, 40, 60))
    shift[0] = 1e-3
    still, moved = (
        trace(scene, CameraRays(camera), lit, facing(500.0), LightPaths(samples=1, seed=1), shift=s)[0]
        for s in (None, shift)
    )
    white = trace(
        scene,
        CameraRays(camera),
        ProjectedPatterns(np.ones((1, 300, 400)), Projector(optics, 1.0)),
        facing(500.0),
        LightPaths(samples=1, seed=1),
    )[0]
    cosine = camera.rays(camera.pixel_grid())[..., 2]  # the angle is taken along the ray
    assert np.allclose((moved - still) / white * 400 * cosine, 0.5 * 300.0 / 500.0, rtol=2e-3)


@pytest.mark.parametrize("depth", [1, 3])
def test_bands_and_windows_change_nothing(n10, scenes, monkeypatch, depth):
    """Every pixel has a random stream of its own, whatever else is traced with it."""
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    rays, patterns = CameraRays(n10.rig.cameras["left"], 2.0, 500.0), ProjectedPatterns(n10.patterns(), n10.projector)
    pose = look_at([100, -350, 250], [0, 0, 30], [0, 0, 1])
    window = Roi(300, 200, 80, 60)

    def look(window):
        return trace(
            scene, rays, patterns, pose, LightPaths(samples=4, seed=1, depth=depth, with_ambient=True), roi=window
        )

    whole = look(window)
    part = look(Roi(310, 220, 30, 20))
    assert np.array_equal(part, whole[:, 20:40, 10:40])
    monkeypatch.setattr(transport, "LARGEST_LAUNCH", 80 * 2 * 7)  # seven rows at a time
    assert np.array_equal(look(window), whole)


def test_other_poses_seeds_and_numbers_of_samples_recompile_nothing(n10, scenes):
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    rays, patterns = CameraRays(n10.rig.cameras["left"], 2.0, 500.0), ProjectedPatterns(n10.patterns(), n10.projector)

    def look(turn, samples):
        pose = look_at([100 + turn, -350, 250], [0, 0, 30], [0, 0, 1])
        window = Roi(300 + turn, 200, 80 + turn, 60)
        trace(scene, rays, patterns, pose, LightPaths(samples=samples, seed=turn, depth=3), roi=window)

    look(0, 4)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        for turn, samples in enumerate((4, 1, 9, 4), start=1):
            look(turn, samples)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert len(kernels) >= 4
    assert all(k["cache_hit"] for k in kernels)
