"""Codes to clouds, on drawn images of planes and spheres seen by exact cameras and projectors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate1d

from characterisation.cloud_files import read_cloud, write_cloud
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.grey_levels import MeasuredNoise
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.decoding.structured_light.decoder import decode_structured_light
from mitsim.decoding.structured_light.geometry import structured_light_geometry
from mitsim.decoding.structured_light.two_cameras import decode_structured_light_stereo, find_coordinates
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift, roles, value
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.transforms import Transform
from tests.simulated_rigs import images_seen, surface_seen

WIDTH, HEIGHT = 188, 120
SETTINGS = DecoderSettings(near_mm=400, far_mm=900)
PHASE = PhaseShift(periods_px=[340, 60, 12], steps=8)
IMAGER = Imager(5, 0.5, 10000, 12, 0, 0, 12, 40, 4)


def camera(width, height, focal, distortion, place, model="perspective"):
    matrix = np.array([[focal, 0, width / 2 - 3.2], [0, 1.003 * focal, height / 2 + 2.1], [0, 0, 1]])
    return Camera(matrix, np.array(distortion, float), width, height, place, model)


TURNED = Transform.from_degrees([0.5, -14, 0.4], [170, 3, -5])


def ideal_rig():
    return Rig(
        {"eye": camera(WIDTH, HEIGHT, 212, [0] * 5, Transform.identity())}, camera(320, 200, 325, [0] * 5, TURNED)
    )


def distorted_rig():
    eye = camera(WIDTH, HEIGHT, 212, [-0.18, 0.12, 0.001, -0.0005, -0.02], Transform.from_degrees([1, 2, 3], [4, 5, 6]))
    return Rig({"eye": eye}, camera(320, 200, 325, [0.08, -0.1, -0.0005, 0.0007, 0.03], TURNED))


def fisheye_rig():
    eye = camera(WIDTH, HEIGHT, 200, [-0.03, 0.01, 0, 0], Transform.identity(), "fisheye")
    return Rig({"eye": eye}, camera(320, 200, 325, [0.08, -0.1, 0, 0, 0], TURNED))


RIGS = pytest.mark.parametrize("make_rig", [ideal_rig, distorted_rig, fisheye_rig])


def see_plane(rig, normal=(0.2, 0.1, -1.0), through=(0, 0, 600.0)):
    """Exact points (H, W, 3) of a plane, NaN where the projector's field ends."""
    eye, n = rig.cameras["eye"], np.array(normal)
    rays = eye.sensor_from_camera.directions(eye.rays(eye.pixel_grid()))
    points = eye.centre + rays * ((np.array(through) - eye.centre) @ n / (rays @ n))[..., None]
    return lit(rig, points)


def see_sphere(rig, centre=(30.0, -10.0, 650.0), radius=100.0):
    eye, projector = rig.cameras["eye"], rig.projector
    rays = eye.sensor_from_camera.directions(eye.rays(eye.pixel_grid()))
    toward = np.array(centre) - eye.centre
    along = rays @ toward
    under = along**2 - toward @ toward + radius**2
    points = eye.centre + rays * np.where(under > 0, along - np.sqrt(np.maximum(under, 0)), np.nan)[..., None]
    facing = np.einsum("...i,...i->...", points - centre, projector.centre - points) > 0
    return lit(rig, np.where(facing[..., None], points, np.nan))


def lit(rig, points):
    there, projector = rig.projector.project(points), rig.projector
    size = np.array([projector.width, projector.height])
    inside = ((there > -0.4) & (there < size - 0.6)).all(axis=-1)
    return np.where(inside[..., None], points, np.nan)


def draw(rig, points, code, bright=200.0):
    """Images [DN] without noise; where there is no point, only a little ambient light."""
    there, projector = rig.projector.project(points), rig.projector
    images = np.stack(
        [
            value(code, role, there[..., 1 if role.axis == "rows" else 0])
            for role in roles(code, projector.width, projector.height)
        ]
    )
    return 20 + bright * np.where(np.isfinite(points[..., 0]), images, 0)


def decode(stack, rig, code=PHASE, settings=SETTINGS, full_scale=255, **options):
    """Decode images of a rig, or of a geometry that was made from it."""
    geometry = geometry_of(rig, code, settings) if isinstance(rig, Rig) else rig
    return decode_structured_light(
        stack, geometry, code, settings, ImageContext("drawn", "simulated", full_scale, **options)
    )


def geometry_of(rig, code, settings):
    return structured_light_geometry(rig, "eye", code, settings.near_mm, settings.far_mm)


def sphere_through(points):
    """Centre and radius by linear least squares."""
    A = np.column_stack([2 * points, np.ones(len(points))])
    *centre, rest = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)[0]
    return np.array(centre), np.sqrt(rest + np.dot(centre, centre))


@RIGS
def test_a_plane_comes_back_where_it_is(make_rig):
    rig = make_rig()
    points = see_plane(rig)
    cloud = decode(draw(rig, points, PHASE), rig)
    assert (cloud.valid == np.isfinite(points[..., 0])).all()
    error = np.linalg.norm(cloud.points - points, axis=-1)[cloud.valid]
    assert error.max() < 5e-4  # 1e-5 px of a projector whose pixel is worth 6.5 mm of depth, and float32


@RIGS
def test_a_sphere_keeps_its_radius_and_place(make_rig):
    rig = make_rig()
    points = see_sphere(rig)
    cloud = decode(draw(rig, points, PHASE), rig)
    assert cloud.valid.sum() > 0.99 * np.isfinite(points[..., 0]).sum() > 2000
    centre, radius = sphere_through(cloud.points[cloud.valid].astype(float))
    assert abs(radius - 100) < 0.01
    assert np.linalg.norm(centre - [30, -10, 650]) < 0.01


@pytest.mark.parametrize(
    "code",
    [
        GrayCodePhaseShift(period_px=16, steps=4),
        GrayCodePhaseShift(period_px=16, steps=4, axis="rows"),
        PhaseShift(periods_px=[320 / 18, 320 / 19.5, 320 / 20], steps=5),
        PhaseShift(periods_px=[340, 60, 12], steps=[3, 4, 6], axis="rows"),
    ],
)
def test_any_code_gives_the_same_plane(code):
    rig = distorted_rig()
    if code.axis == "rows":  # a projector below the camera
        rig = replace(
            rig, projector=replace(rig.projector, sensor_from_camera=Transform.from_degrees([14, 0, 0], [3, 170, 0]))
        )
    points = see_plane(rig)
    cloud = decode(draw(rig, points, code), rig, code)
    wanted = np.isfinite(points[..., 0])
    assert cloud.valid.sum() > 0.99 * wanted.sum() > 3000
    assert np.nanmax(np.linalg.norm(cloud.points - points, axis=-1)) < 2e-3


def test_gray_code_is_as_coarse_as_its_stripes_and_says_so():
    rig, code = distorted_rig(), GrayCode(axis="both")
    points = see_plane(rig)
    cloud = decode(np.rint(draw(rig, points, code)).astype(np.uint8), rig, code)
    assert cloud.valid.sum() > 0.98 * np.isfinite(points[..., 0]).sum()
    eye = rig.cameras["eye"]
    error = np.linalg.norm(cloud.points - eye.centre, axis=-1) - np.linalg.norm(points - eye.centre, axis=-1)
    assert np.isclose(np.std((error / cloud.sigma)[cloud.valid]), 1, rtol=0.05)


def test_points_lie_on_the_rays_of_the_raw_pixels():
    rig = distorted_rig()
    cloud = decode(draw(rig, see_plane(rig), PHASE), rig)
    rows, columns = np.nonzero(cloud.valid)
    pixels, points = np.stack([columns, rows], axis=-1), cloud.points[cloud.valid].astype(float)
    np.testing.assert_allclose(rig.cameras["eye"].project(points), pixels, atol=1e-4)
    np.testing.assert_allclose(cloud.grid.project(points), pixels, atol=1e-4)
    away = points - cloud.grid.origin
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    np.testing.assert_allclose(cloud.grid.rays()[rows, columns], away, atol=1e-6)
    np.testing.assert_allclose(cloud.grid.rays_at(columns, rows), away, atol=1e-6)


def test_the_noise_is_the_one_predicted(rng):
    """Normalised by their own sigma, errors along the ray have unit variance; 12000 pixels: standard error 0.7 %."""
    rig = distorted_rig()
    points = see_plane(rig)
    electrons = rng.poisson(draw(rig, points, PHASE) * 30) + rng.normal(0, 12, (24, HEIGHT, WIDTH))
    images = np.rint(electrons * IMAGER.gain + IMAGER.black_level).astype(np.uint16)
    cloud = decode(images, rig, full_scale=4095, imager=IMAGER)
    origin = cloud.grid.origin
    error = np.linalg.norm(cloud.points - origin, axis=-1) - np.linalg.norm(points - origin, axis=-1)
    scaled = (error / cloud.sigma)[cloud.valid]
    assert len(scaled) > 10000
    assert np.isclose(scaled.std(), 1, rtol=0.05)
    assert abs(scaled.mean()) < 0.05


def test_each_pixel_without_a_point_has_its_reason():
    rig = distorted_rig()
    points = see_plane(rig)
    stack = draw(rig, points, PHASE)
    stack[:, 40:50, 60:70] = 20
    stack[0, 60:70, 60:70] = 255
    wanted = np.isfinite(points[..., 0])
    wanted[40:50, 60:70] = wanted[60:70, 60:70] = False
    cloud = decode(stack, rig)
    assert (cloud.status[40:50, 60:70] == Status.LOW_MODULATION).all()
    assert (cloud.status[60:70, 60:70] == Status.SATURATED).all()
    assert (cloud.status[wanted] == Status.VALID).all()
    np.testing.assert_array_equal(cloud.valid, cloud.status == Status.VALID)
    near = decode(stack, rig, settings=DecoderSettings(near_mm=620, far_mm=900))
    depth = rig.cameras["eye"].sensor_from_camera.inverse().points(points)[..., 2]
    assert (near.status[wanted & (depth < 619.9)] == Status.OUT_OF_RANGE).all()
    assert (near.status[wanted & (depth > 620.1)] == Status.VALID).all()


def test_where_the_projector_cannot_reach_there_is_no_surface():
    rig = distorted_rig()
    narrow = replace(rig.projector, matrix=rig.projector.matrix * [[3], [3], [1]] - [[0, 0, 320], [0, 0, 200], [0] * 3])
    rig = replace(rig, projector=narrow)
    points = see_plane(rig)
    cloud = decode(draw(rig, points, PHASE), rig)
    seen = structured_light_geometry(rig, "eye", PHASE, 400, 900).seen
    assert 0.05 < seen.mean() < 0.9
    assert (cloud.status[~seen] == Status.NO_SURFACE).all()
    assert np.linalg.norm(cloud.points - points, axis=-1)[cloud.valid].max() < 1e-3


def test_the_second_axis_refuses_light_that_came_another_way():
    rig, code = distorted_rig(), GrayCode(axis="both")
    points = see_plane(rig)
    stack = draw(rig, points, code)
    detour = draw(rig, points + np.array([0, 15, 0]), code)
    every = roles(code, 320, 200)
    for index, role in enumerate(every):
        if role.axis == "rows":
            stack[index, 50:70, 60:120] = detour[index, 50:70, 60:120]
    cloud = decode(stack, rig, code)
    assert (cloud.status[50:70, 60:120] == Status.PHASE_INCONSISTENT).all()
    assert (cloud.status[20:45, 60:120] == Status.VALID).mean() > 0.99


def test_a_geometry_made_once_gives_the_same_cloud():
    rig = distorted_rig()
    stack = draw(rig, see_plane(rig), PHASE)
    geometry = structured_light_geometry(rig, "eye", PHASE, 400, 900)
    np.testing.assert_array_equal(decode(stack, rig).points, decode(stack, geometry).points)


@pytest.mark.parametrize("make_rig", [ideal_rig, distorted_rig])
def test_a_cloud_on_bent_rays_survives_the_disk(make_rig, tmp_path):
    rig = make_rig()
    cloud = decode(draw(rig, see_plane(rig), PHASE), rig)
    assert (cloud.grid.normalised is None) == (make_rig is ideal_rig)
    write_cloud(cloud, tmp_path / "cloud.ply")
    again = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(again.points, cloud.points)
    np.testing.assert_array_equal(again.status, cloud.status)
    np.testing.assert_array_equal(again.grid.rays(), cloud.grid.rays())


@given(st.floats(0, WIDTH - 1), st.floats(0, HEIGHT - 1), st.floats(100, 3000))
def test_the_grid_projects_where_the_camera_does(column, row, distance):
    eye = distorted_rig().cameras["eye"]
    point = eye.centre + distance * eye.sensor_from_camera.directions(eye.rays(np.array([column, row])))
    np.testing.assert_allclose(DISTORTED_GRID.project(point), [column, row], atol=2e-3)


DISTORTED_GRID = structured_light_geometry(distorted_rig(), "eye", PHASE, 400, 900).grid


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stack": np.zeros((24, 5, 5), np.uint8)}, "images of eye"),
        ({"stack": np.zeros((23, HEIGHT, WIDTH), np.uint8)}, "image stack"),
        ({"context": ImageContext("drawn", "simulated", 0)}, "full_scale"),
        (
            {
                "settings": DecoderSettings(near_mm=300, far_mm=900),
                "geometry": structured_light_geometry(distorted_rig(), "eye", PHASE, 400, 900),
            },
            "near_mm",
        ),
        (
            {
                "code": PhaseShift(periods_px=[340, 60, 12], steps=8, axis="rows"),
                "geometry": structured_light_geometry(distorted_rig(), "eye", PHASE, 400, 900),
            },
            "code along rows",
        ),
        ({"code": PhaseShift(periods_px=[100, 20], steps=12)}, "periods_px"),
    ],
)
def test_what_does_not_fit_together_is_refused(change, message):
    given = {
        "stack": np.zeros((24, HEIGHT, WIDTH), np.uint8),
        "geometry": geometry_of(distorted_rig(), PHASE, SETTINGS),
        "code": PHASE,
        "settings": SETTINGS,
        "context": ImageContext("drawn", "simulated", 255),
    } | change
    with pytest.raises(InputError, match=message):
        decode_structured_light(**given)


def test_a_rig_without_a_projector_is_refused():
    with pytest.raises(InputError, match="projector"):
        structured_light_geometry(replace(distorted_rig(), projector=None), "eye", PHASE, 400, 900)


def test_a_code_that_runs_across_the_baseline_is_refused():
    rig = Rig(
        {"eye": ideal_rig().cameras["eye"]},
        camera(320, 200, 325, [0] * 5, Transform(np.eye(3), np.array([170.0, 0, 0]))),
    )
    with pytest.raises(InputError, match="across the baseline"):
        structured_light_geometry(rig, "eye", PHASE.model_copy(update={"axis": "rows"}), 400, 900)


def test_settings_refuse_a_range_that_ends_before_it_begins():
    with pytest.raises(ValueError, match="near_mm under far_mm"):
        DecoderSettings(near_mm=900, far_mm=400)


def two_cameras():
    rig = distorted_rig()
    left = replace(rig.cameras["eye"], sensor_from_camera=Transform.identity())
    right = replace(left, sensor_from_camera=Transform.from_degrees([0.5, -8, 0.3], [90, 1, -2]))
    middle = replace(rig.projector, sensor_from_camera=Transform.from_degrees([0, -5, 0], [45, 10, -3]))
    return Rig({"eye": left, "right": right}, middle)


def both_stacks(rig, see, code):
    """Images of both cameras, each of its own pixels' exact points."""
    left, right = rig.cameras.values()
    return [draw(rig, see(replace(rig, cameras={"eye": eye})), code) for eye in (left, right)]


@pytest.mark.parametrize("code", [PHASE, GrayCodePhaseShift(period_px=16, steps=4)])
def test_two_cameras_measure_without_the_projectors_calibration(code):
    rig = two_cameras()
    stacks = both_stacks(rig, see_plane, code)
    cloud = decode_structured_light_stereo(
        stacks,
        stereo_geometry(replace(rig, projector=None)),
        code,
        SETTINGS,
        (320, 200),
        ImageContext("drawn", "simulated", 255),
    )
    assert cloud.valid.mean() > 0.6
    points = cloud.points[cloud.valid].astype(float)
    n = np.array([0.2, 0.1, -1.0])
    away = (points - [0, 0, 600]) @ n / np.linalg.norm(n)
    assert np.abs(away).max() < 0.1  # 0.005 px of interpolated coordinates; a pixel is worth 19 mm
    assert np.sqrt(np.mean(away**2)) < 0.01
    columns_rows = np.stack(np.nonzero(cloud.valid)[::-1], axis=-1)
    np.testing.assert_allclose(cloud.grid.project(points), columns_rows, atol=1e-3)


def test_sigma_of_smoothed_points_of_two_cameras_is_not_told(rng):
    """Before, .023 mm for .033 mm: neighbours on the rectified grid share raw pixels, and counted as independent."""
    rig = replace(two_cameras(), projector=None)
    stacks = [
        np.rint(stack + rng.normal(0, 1, stack.shape)).clip(0, 255)
        for stack in both_stacks(two_cameras(), see_plane, PHASE)
    ]
    images = {name: stack.astype(np.uint8) for name, stack in zip(rig.cameras, stacks, strict=True)}
    decoding = Decoding(pattern=PHASE, projector_size_px=(320, 200))
    capture = Capture("drawn", "structured_light", "simulated", rig, images, 8, decoding)
    noise = MeasuredNoise(np.array([0.0, 255.0]), np.ones(2))
    plain, smooth = (
        capture_cloud(
            capture,
            SETTINGS.model_copy(update={"triangulate": "cameras", "smoothing_px": width}),
            imager=noise,
        )
        for width in (0.0, 1.5)
    )
    assert np.isfinite(plain.sigma[plain.valid]).all()
    assert smooth.sigma is None
    np.testing.assert_array_equal(smooth.valid, plain.valid)


@pytest.mark.parametrize("smoothing_px", [0.0, 0.5, 0.8])
def test_sigma_of_two_cameras_is_told_where_it_is_that_of_repeated_images(smoothing_px, rng):
    """Before, it was .89 and .79 of the scatter at .5 and .8 px of the imager's own smoothing."""
    rig, imager = replace(two_cameras(), projector=None), replace(IMAGER, smoothing_px=smoothing_px)
    decoding = Decoding(pattern=PHASE, projector_size_px=(320, 200))
    settings = SETTINGS.model_copy(update={"triangulate": "cameras"})
    clean = [16 * stack + imager.black_level for stack in both_stacks(two_cameras(), see_plane, PHASE)]
    clouds = []
    for _ in range(30):
        images = {}
        for name, stack in zip(rig.cameras, clean, strict=True):
            electrons = (stack - imager.black_level) / imager.gain
            noise = rng.normal(size=stack.shape) * np.sqrt(electrons + imager.read_noise**2) * imager.gain
            for axis in (1, 2) if smoothing_px else ():
                noise = correlate1d(noise, point_spread(smoothing_px), axis)
            images[name] = np.rint(stack + noise).clip(0, 4095).astype(np.uint16)
        capture = Capture("drawn", "structured_light", "simulated", rig, images, 12, decoding)
        clouds.append(capture_cloud(capture, settings, imager=imager))
    valid = np.all([cloud.valid for cloud in clouds], axis=0)
    depths = np.array([np.linalg.norm(cloud.points[valid], axis=1) for cloud in clouds], float)
    told = [cloud.sigma for cloud in clouds]
    if smoothing_px:
        assert told[0] is None
    else:
        ratio = np.sqrt(np.mean(told[0][valid] ** 2) / depths.var(axis=0, ddof=1).mean())
        assert ratio == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("turned", [False, True])
def test_coordinates_that_fall_along_a_row_are_found_as_those_that_rise(turned, rng):
    """Before, a projector that is turned by 180 degrees gave no point between two cameras."""
    row = np.cumsum(rng.uniform(0.5, 1.5, 200))
    row[60:70] = np.nan
    columns = rng.uniform(0, 199, 500)
    wanted = np.interp(columns, np.arange(200), row)
    sign = -1 if turned else 1
    found, ambiguous = find_coordinates(sign * wanted, sign * row)
    known = (columns < 59) | (columns > 70)
    np.testing.assert_allclose(found[known], columns[known], atol=1e-9)
    assert np.isnan(found[(columns > 59) & (columns < 70)]).all() and not ambiguous.any()


def finer(eye):
    """The same camera with pixels half as wide."""
    matrix = eye.matrix * [[2], [2], [1]] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    return replace(eye, matrix=matrix, width=2 * eye.width, height=2 * eye.height)


def test_two_cameras_measure_a_sphere_but_for_the_chords_of_linear_interpolation():
    """A chord lies inside the sphere by a height that goes with the square of its length: 1/4 with half the pixel."""
    rig, missing = two_cameras(), []
    for each in (rig, replace(rig, cameras={name: finer(eye) for name, eye in rig.cameras.items()})):
        cloud = decode_structured_light_stereo(
            both_stacks(each, see_sphere, PHASE),
            stereo_geometry(each),
            PHASE,
            SETTINGS,
            (320, 200),
            ImageContext("drawn", "simulated", 255),
        )
        points = cloud.points[cloud.valid].astype(float)
        # away from the limb, where the height of a chord has no bound
        points = points[np.linalg.norm(points[:, :2] - [30, -10], axis=1) < 60]
        assert len(points) > 700
        missing.append(100 - np.linalg.norm(points - [30, -10, 650], axis=1).mean())
    assert 0 < missing[0] < 0.15
    assert 3 < missing[0] / missing[1] < 5


def test_what_the_right_camera_does_not_see_is_hidden():
    rig = two_cameras()
    left, right = both_stacks(rig, see_plane, PHASE)
    right[:, 50:60] = 20
    cloud = decode_structured_light_stereo(
        (left, right),
        stereo_geometry(rig),
        PHASE,
        SETTINGS,
        (320, 200),
        ImageContext("drawn", "simulated", 255),
    )
    assert cloud.valid.sum() > 15000
    assert cloud.reasons()["hidden"] > 1000


def test_a_code_along_the_rows_is_no_use_to_cameras_side_by_side():
    rig, code = two_cameras(), PHASE.model_copy(update={"axis": "rows"})
    with pytest.raises(InputError, match="side by side"):
        decode_structured_light_stereo(
            (np.zeros((24, HEIGHT, WIDTH)), np.zeros((24, HEIGHT, WIDTH))),
            stereo_geometry(rig),
            code,
            SETTINGS,
            (320, 200),
            ImageContext("drawn", "simulated", 255),
        )


#: of a public calibration of a projector: its radius is not smooth, and folds at 0.565
UNEVEN = np.array([-0.0486, 1.4234, -0.0075, -0.0020, -7.3645])


@pytest.mark.parametrize("beamer", [UNEVEN, np.array([-0.05, 0, 0, 0, -60.0])])
@pytest.mark.parametrize("range_mm", [(50.0, 20000.0), (300.0, 800.0)])
def test_a_strongly_distorted_projector_is_decoded_where_its_rays_are_unique(beamer, range_mm):
    """It was refused: "a polynomial of 16 points follows to 0.14 px"."""
    K = np.array([[300.0, 0, 127.5], [0, 300, 95.5], [0, 0, 1]])
    eye = Camera(np.array([[240.0, 0, 109.5], [0, 240, 84.5], [0, 0, 1]]), np.zeros(5), 220, 170)
    lit = Camera(K, beamer, 256, 192, Transform.from_degrees((2.0, -20.0, 3.0), (160.0, 10.0, 40.0)))
    code, points = PhaseShift(periods_px=[260, 40, 8]), surface_seen(eye, depth=480.0)
    stack = images_seen(code, eye, lit, points, noise=0.3)
    settings = DecoderSettings(near_mm=range_mm[0], far_mm=range_mm[1])
    context = ImageContext(full_scale=255, sensor="rig", source="device", imager=None)
    cloud = decode_structured_light(stack, geometry_of(Rig({"eye": eye}, lit), code, settings), code, settings, context)
    off = np.linalg.norm(cloud.points - points, axis=-1)[cloud.valid]
    place = lit.project(points)
    with np.errstate(invalid="ignore"):
        inside = ((place > 2) & (place < [253, 189])).all(axis=-1)
    assert inside.mean() > 0.2
    assert cloud.valid[inside].mean() > 0.97
    assert np.quantile(off, 0.99) < 0.5


def test_pixels_beyond_the_fold_of_the_camera_are_left_out_with_their_reason():
    """r (1 - 0.9 r^2) ends at 0.4057: 97 of 110 px along a row."""
    eye = Camera(np.array([[240.0, 0, 109.5], [0, 240, 84.5], [0, 0, 1]]), np.array([-0.9, 0, 0, 0]), 220, 170)
    lit = Camera(
        np.array([[270.0, 0, 127.5], [0, 270, 95.5], [0, 0, 1]]),
        np.zeros(5),
        256,
        192,
        Transform.from_degrees((0.5, -11.0, 0.3), (100.0, 3.0, 5.0)),
    )
    radius = np.linalg.norm(eye.pixel_grid() - [109.5, 84.5], axis=-1)
    points = surface_seen(eye, ball=False)
    code = GrayCode()
    shown = np.where(np.isfinite(points), points, [0.0, 0.0, 500.0])  # such pixels show something, too
    stack = images_seen(code, eye, lit, shown, noise=0.3)
    context = ImageContext(full_scale=255, sensor="rig", source="device", imager=None)
    settings = DecoderSettings(near_mm=300, far_mm=800)
    cloud = decode_structured_light(stack, geometry_of(Rig({"eye": eye}, lit), code, settings), code, settings, context)
    assert (cloud.status[radius > 98] == Status.UNCALIBRATED).all()
    assert not (cloud.status[radius < 97] == Status.UNCALIBRATED).any()
    assert not cloud.valid[radius > 98].any()
    assert np.nanmedian(np.linalg.norm(cloud.points - points, axis=-1)) < 2.0
    back = cloud.grid.project(cloud.points[cloud.valid].astype(float))
    rows, columns = np.nonzero(cloud.valid)
    assert np.abs(back - np.stack([columns, rows], axis=-1))[radius[cloud.valid] < 80].max() < 0.01
