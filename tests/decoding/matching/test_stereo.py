"""Stereo decoding against planes drawn by ray casting, which knows nothing of rectification."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.ndimage import map_coordinates

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.sgbm import match_both_ways, search_range
from mitsim.decoding.matching.stereo import decode_stereo
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT, FOCAL, BASELINE = 320, 240, 420.0, 80.0
SETTINGS = MatcherSettings(near_mm=380, far_mm=600)
NOISE = np.random.default_rng(7).normal(size=(256, 256))


def camera(cx: float, distortion: list[float], place: Transform, model: str = "perspective") -> Camera:
    K = np.array([[FOCAL, 0, cx], [0, FOCAL, HEIGHT / 2 - 3.2], [0, 0, 1]])
    return Camera(K, np.array(distortion), WIDTH, HEIGHT, place, model)


def ideal_rig() -> Rig:
    """A pair that needs no rectifying: a rectified pixel is a raw pixel."""
    left = camera(150, [], Transform.identity())
    right = camera(180, [], Transform(np.eye(3), np.array([BASELINE, 0, 0])))
    as_it_is = Rectification(left.matrix, right.matrix, np.eye(3), np.eye(3), BASELINE, WIDTH, HEIGHT)
    return Rig({"left": left, "right": right}, rectification=as_it_is)


def real_rig() -> Rig:
    """Distorted lenses, converging axes, and a vertical offset, as real rigs have."""
    right = Transform.from_degrees([0.3, -7.0, 0.5], [BASELINE, 1.0, 4.0])
    return Rig(
        {
            "left": camera(155, [-0.25, 0.08, 3e-4, -2e-4, -0.01], Transform.identity()),
            "right": camera(163, [-0.24, 0.07, -2e-4, 1e-4, -0.01], right),
        }
    )


def folding_rig() -> Rig:
    """Strong barrel distortion, whose polynomial turns back within the rectified image."""
    rig = ideal_rig()
    return replace(rig, cameras={n: replace(c, distortion=np.array([-2.5, 0, 0, 0])) for n, c in rig.cameras.items()})


def fisheye_rig() -> Rig:
    right = Transform(np.eye(3), np.array([BASELINE, 0, 0]))
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Rig(
        {
            "left": camera(155, [-0.03, 0.01, 0, 0], Transform.identity(), "fisheye"),
            "right": camera(130, [-0.04, 0.012, 0, 0], right, "fisheye"),
        },
        rectification=Rectification(K, K, np.eye(3), np.eye(3), BASELINE, WIDTH, HEIGHT),
    )


def texture(points: np.ndarray) -> np.ndarray:
    """Smooth random pattern with features of about 4 px at half a metre, 20 to 230 DN."""
    values = map_coordinates(NOISE, [points[..., 1] / 2.5 + 50, points[..., 0] / 2.5 + 50], order=3, mode="grid-wrap")
    return np.clip(125 + 55 * values, 20, 230)


def plane(normal: list[float], distance: float) -> tuple[np.ndarray, float]:
    n = np.array(normal) / np.linalg.norm(normal)
    return n, n[2] * distance  # through (0, 0, distance)


def draw(eye: Camera, surface: tuple[np.ndarray, float], paint=texture) -> np.ndarray:
    """Cast a ray through every raw pixel centre onto a plane n . x = c of the sensor frame."""
    place = eye.sensor_from_camera
    rays = place.directions(eye.rays(eye.pixel_grid()))
    n, c = surface
    range_mm = (c - place.translation @ n) / (rays @ n)
    return np.rint(paint(place.translation + range_mm[..., None] * rays)).astype(np.uint8)


def pair(rig: Rig, surface: tuple[np.ndarray, float], paint=texture) -> tuple[np.ndarray, np.ndarray]:
    return draw(rig.cameras["left"], surface, paint), draw(rig.cameras["right"], surface, paint)


def decode(rig, images, settings=SETTINGS, **options):
    geometry = stereo_geometry(rig) if isinstance(rig, Rig) else rig
    return decode_stereo(*images, geometry, settings, ImageContext("drawn", "simulated", 255, **options))


def disparity_error(cloud, rig: Rig, surface: tuple[np.ndarray, float]) -> np.ndarray:
    """Error of each point along its own view ray, as disparity [px]."""
    n, c = surface
    points = cloud.points[cloud.valid].astype(float)
    depth = points @ cloud.grid.rotation[:, 2]
    true_depth = depth * c / (points @ n)
    pair_ = stereo_geometry(rig).rectification
    return pair_.disparity(depth) - pair_.disparity(true_depth)


@pytest.mark.parametrize("make_rig", [ideal_rig, real_rig, fisheye_rig])
@pytest.mark.parametrize("normal", [[0, 0, 1], [0.45, 0.1, 1], [-0.2, 0.5, 1]], ids=["facing", "turned", "tilted"])
def test_plane_comes_back_where_it_is(make_rig, normal):
    rig, surface = make_rig(), plane(normal, 487.3)
    cloud = decode(rig, pair(rig, surface))
    error = disparity_error(cloud, rig, surface)
    assert cloud.valid.mean() > 0.6  # the second camera does not see the rest
    assert np.abs(error).mean() < 0.1
    assert abs(error.mean()) < 0.05


@pytest.mark.parametrize("shift", [(BASELINE, 0, 0), (0, BASELINE, 0), (0, -BASELINE, 0)], ids=str)
@pytest.mark.parametrize("roll", [0, 90, 180])
def test_a_pair_one_above_the_other_or_upside_down_is_matched(roll, shift):
    """Before, a roll of 180 deg or a vertical baseline was refused as a second camera that is not to the right."""
    rig, surface = real_rig(), plane([0.2, 0.1, 1], 487.3)
    place = Transform.from_degrees([0, 0, roll], shift)
    rig = replace(rig, cameras=rig.cameras | {"right": replace(rig.cameras["right"], sensor_from_camera=place)})
    cloud = decode(rig, pair(rig, surface))
    error = disparity_error(cloud, rig, surface)
    assert cloud.valid.mean() > 0.5
    assert np.abs(error).mean() < 0.1 and abs(error.mean()) < 0.05


def test_a_second_camera_to_the_left_is_refused():
    rig = real_rig()
    with pytest.raises(InputError, match="name the left camera first"):
        stereo_geometry(replace(rig, cameras=dict(reversed(rig.cameras.items()))))


@pytest.mark.parametrize("mode", ["hh", "sgbm", "3way"])
def test_no_part_of_a_pixel_is_lost(mode):
    """The matcher draws disparities toward whole pixels; over all fractions of a pixel that must cancel."""
    rig, settings = ideal_rig(), SETTINGS.model_copy(update={"mode": mode})
    bias = []
    for fraction in np.arange(8) / 8:
        surface = plane([0, 0, 1], FOCAL * BASELINE / (70 + fraction))
        bias.append(disparity_error(decode(rig, pair(rig, surface), settings), rig, surface).mean())
    assert abs(np.mean(bias)) < 0.01
    assert np.abs(bias).max() < 0.15


def test_settings_of_opencvs_sample_give_the_disparities_that_opencv_writes():
    rig, surface = ideal_rig(), plane([0.1, 0.5, 1], 470)
    images = pair(rig, surface)
    as_sample = {"mode": "sgbm", "prefilter_cap": 15, "uniqueness_percent": 10, "sub_pixel": "opencv"}
    settings = SETTINGS.model_copy(update=as_sample)
    cloud, geometry = decode(rig, images, settings), stereo_geometry(rig)
    first, count = search_range(geometry.rectification, settings)
    matcher = cv2.StereoSGBM.create(first, count, 5, 200, 800, uniquenessRatio=10)
    wide = [np.pad(image, ((0, 0), (count, count)), mode="edge") for image in images]
    written = matcher.compute(*wide)[:, count:-count] / 16
    found = geometry.rectification.disparity(cloud.points[..., 2].astype(float))
    both = cloud.valid & (written >= first)
    both[:, :20] = both[:, -20:] = False  # beyond the edges the two repeat other columns
    assert both.mean() > 0.5
    assert np.mean(np.abs(found - written)[both] < 1e-3) > 0.999


def test_points_lie_on_the_view_rays_of_their_pixels():
    rig, surface = real_rig(), plane([0.2, 0.1, 1], 470)
    cloud = decode(rig, pair(rig, surface))
    rows, columns = np.nonzero(cloud.valid)
    points = cloud.points[cloud.valid].astype(float)
    np.testing.assert_allclose(cloud.grid.project(points), np.stack([columns, rows], axis=-1), atol=2e-4)
    raw = stereo_geometry(rig).map_left[:, cloud.valid].T
    np.testing.assert_allclose(rig.reference.project(points), raw, atol=2e-3)


def test_points_are_in_the_sensor_frame_even_if_that_is_not_the_left_camera():
    rig, surface = real_rig(), plane([0.2, 0.1, 1], 470)
    images = pair(rig, surface)
    moved_by = Transform.from_degrees([10, 20, 30], [5, -7, 11])
    moved = Rig(
        {name: replace(eye, sensor_from_camera=moved_by @ eye.sensor_from_camera) for name, eye in rig.cameras.items()}
    )
    here, there = decode(rig, images), decode(moved, images)
    both = here.valid & there.valid
    assert both.sum() > 0.99 * here.valid.sum()
    np.testing.assert_allclose(there.points[both], moved_by.points(here.points[both]), atol=0.02)
    np.testing.assert_allclose(there.baseline, moved_by.directions(here.baseline), atol=1e-12)
    np.testing.assert_allclose(there.grid.origin, [5, -7, 11])


def test_a_geometry_made_once_gives_the_same_cloud():
    rig, surface = real_rig(), plane([0, 0, 1], 470)
    images = pair(rig, surface)
    np.testing.assert_array_equal(decode(rig, images).points, decode(stereo_geometry(rig), images).points)


def test_twelve_bits_give_the_same_disparity_as_eight():
    rig, surface = ideal_rig(), plane([0.3, 0, 1], 470)
    images = pair(rig, surface)
    deep = [np.rint(image * (4095 / 255)).astype(np.uint16) for image in images]
    a = decode(rig, images)
    b = decode_stereo(*deep, stereo_geometry(rig), SETTINGS, ImageContext("drawn", "simulated", 4095))
    both = a.valid & b.valid
    assert both.sum() > 0.99 * a.valid.sum()
    assert np.mean(a.points[both] == b.points[both]) > 0.99


def test_window_gives_what_the_whole_image_gives():
    rig, surface = real_rig(), plane([0.3, 0.2, 1], 470)
    images = pair(rig, surface)
    roi = Roi(170, 60, 100, 90)
    whole, part = decode(rig, images), decode(rig, images, roi=roi)
    inside = np.zeros(part.status.shape, bool)
    inside[roi.slices] = True
    assert whole.valid[inside].mean() > 0.99
    assert np.mean(whole.status[inside] == part.status[inside]) > 0.999
    both = whole.valid & part.valid
    assert np.mean(whole.points[both] == part.points[both]) > 0.995
    assert (part.status[~inside] == Status.NO_SURFACE).all()
    assert not part.valid[~inside].any()


@pytest.mark.parametrize("roi", [Roi(0, 0, 40, 40), Roi(WIDTH - 40, HEIGHT - 40, 40, 40), Roi(200, 100, 1, 1)])
def test_window_may_touch_the_edge_or_be_one_pixel(roi):
    rig, surface = ideal_rig(), plane([0, 0, 1], 470)
    cloud = decode(rig, pair(rig, surface), roi=roi)
    if roi.left == 0:  # x - d lies outside the right image
        assert (cloud.status[roi.slices] == Status.NO_SURFACE).all()
    else:
        assert cloud.valid[roi.slices].mean() > 0.99


@pytest.mark.parametrize("roi", [Roi(-1, 0, 11, 10), Roi(0, 0, 0, 10), Roi(5, 5, WIDTH - 4, 5), Roi(30, 9, -10, 10)])
def test_window_outside_the_grid_is_refused(roi):
    rig, surface = ideal_rig(), plane([0, 0, 1], 470)
    with pytest.raises(InputError, match="region of interest"):
        decode(rig, pair(rig, surface), roi=roi)


# Why a pixel has no point, each reason provoked on its own. The ideal rig sees a plane at depth 480 with 70 px between
# the eyes, less the 30 px between the principal points: left column x is right column x - 40 (disparity 70 - 30).
FACING = plane([0, 0, 1], 480)
SHIFT = 40
PATCH = np.s_[100:130, 160:190]
CORE = np.s_[104:126, 164:186]  # a block inside, and the matcher's margin


def share(cloud, area, status: Status) -> float:
    return float(np.mean(cloud.status[area] == status))


def test_the_right_camera_does_not_see_the_left_edge():
    rig = ideal_rig()
    cloud = decode(rig, pair(rig, FACING))
    assert share(cloud, np.s_[:, : SHIFT - 3], Status.NO_SURFACE) == 1
    assert share(cloud, np.s_[5:-5, SHIFT + 5 : -5], Status.VALID) > 0.999


def test_outside_the_raw_image_there_is_no_surface():
    rig = ideal_rig()
    pincushion = replace(rig.cameras["left"], distortion=np.array([0.3, 0, 0, 0]))
    rig = replace(rig, cameras={"left": pincushion, "right": rig.cameras["right"]})
    seen = stereo_geometry(rig).seen_left
    cloud = decode(rig, pair(rig, FACING))
    assert 0.5 < seen.mean() < 1
    assert (cloud.status[~seen] == Status.NO_SURFACE).all()


def test_where_the_distortion_folds_back_nothing_is_seen():
    rig = folding_rig()
    geometry = stereo_geometry(rig)
    folded = 1 / np.sqrt(3 * 2.5)  # r (1 - 2.5 r^2) is largest there
    radius = np.linalg.norm(geometry.grid.rays()[..., :2] / geometry.grid.rays()[..., 2:], axis=-1)
    assert (radius > folded + 0.01).any()
    assert not geometry.seen_left[radius > folded + 0.01].any()
    assert geometry.seen_left[radius < folded - 0.01].all()


def test_blown_out_in_the_left_image():
    rig = ideal_rig()
    left, right = pair(rig, FACING)
    left[PATCH] = 255
    cloud = decode(rig, (left, right))
    assert share(cloud, CORE, Status.SATURATED) == 1


def test_blown_out_in_the_right_image_alone():
    rig = ideal_rig()
    left, right = pair(rig, FACING)
    right[PATCH[0], PATCH[1].start - SHIFT : PATCH[1].stop - SHIFT] = 255
    cloud = decode(rig, (left, right))
    missing = ~cloud.valid[CORE]
    assert missing.mean() > 0.8
    assert (cloud.status[CORE][missing] == Status.SATURATED).all()


def test_everything_blown_out_in_the_right_image():
    rig = ideal_rig()
    left, right = pair(rig, FACING)
    cloud = decode(rig, (left, np.full_like(right, 255)))
    assert share(cloud, np.s_[:, 160:], Status.SATURATED) == 1


def test_blank_areas_are_not_painted_over():
    rig = ideal_rig()

    def half_blank(points):
        blank = np.hypot(points[..., 0] - 20, points[..., 1]) < 30
        return np.where(blank, 120, texture(points))

    images = pair(rig, FACING, half_blank)
    core = np.s_[105:130, 160:180]
    assert share(decode(rig, images), core, Status.LOW_MODULATION) == 1
    careless = decode(rig, images, SETTINGS.model_copy(update={"minimum_contrast_dn": 0.0}))
    assert careless.valid[core].any()  # what the smoothness term would have made of it


def test_beyond_the_search_range():
    rig = ideal_rig()
    images = pair(rig, FACING)
    far = decode(rig, images, MatcherSettings(near_mm=380, far_mm=475))
    assert share(far, np.s_[5:-5, 60:-5], Status.OUT_OF_RANGE) > 0.95
    near = decode(rig, images, MatcherSettings(near_mm=485, far_mm=700))
    assert share(near, np.s_[5:-5, 60:-5], Status.OUT_OF_RANGE) > 0.95


def test_hidden_from_the_right_camera_by_something_in_front():
    rig = ideal_rig()

    def draw_both(eye):
        """Draw a board at 400 mm, x from 0 to 60 mm, before the plane at 480 mm."""
        behind, front = draw(eye, FACING), draw(eye, plane([0, 0, 1], 400), lambda p: texture(p + 31))
        x = (np.arange(WIDTH) - eye.matrix[0, 2]) / FOCAL * 400 + eye.centre[0]
        return np.where((x > 0) & (x < 60), front, behind)

    cloud = decode(rig, (draw_both(rig.cameras["left"]), draw_both(rig.cameras["right"])))
    # the board's left edge is left column 150; 84 px of disparity before 70: 14 px of the plane are hidden beside it
    hidden = np.s_[20:-20, 150 - 12 : 150 - 4]
    assert share(cloud, hidden, Status.HIDDEN) > 0.8
    assert share(cloud, hidden, Status.VALID) < 0.1
    assert share(cloud, np.s_[20:-20, 160:200], Status.VALID) > 0.99


def test_images_that_show_different_things_are_ambiguous():
    rig = ideal_rig()
    left = draw(rig.cameras["left"], FACING)
    right = draw(rig.cameras["right"], FACING, lambda p: texture(p + 210))
    # the default of 5 % lets about a third of such false matches pass: docs/explanation/stereo.md
    cloud = decode(rig, (left, right), SETTINGS.model_copy(update={"uniqueness_percent": 60}))
    counts = {status: share(cloud, np.s_[5:-5, 60:-5], status) for status in Status}
    assert counts[Status.VALID] < 0.01
    assert counts[Status.AMBIGUOUS] == max(counts.values())


def test_status_is_valid_exactly_where_there_is_a_point():
    rig = real_rig()
    cloud = decode(rig, pair(rig, plane([0.4, 0, 1], 520)))
    np.testing.assert_array_equal(cloud.status == Status.VALID, cloud.valid)
    assert set(cloud.reasons()) <= {s.name.lower() for s in Status}


def test_images_of_another_camera_are_refused():
    rig = ideal_rig()
    left, right = pair(rig, FACING)
    with pytest.raises(InputError, match="right image: shape"):
        decode(rig, (left, right[:-1]))
    with pytest.raises(InputError, match="left image: dtype"):
        decode(rig, (left.astype(np.float32), right))
    with pytest.raises(InputError, match="full_scale"):
        decode_stereo(left, right, stereo_geometry(rig), SETTINGS, ImageContext("", "simulated", 1023))


def test_a_rig_that_is_no_stereo_pair_is_refused():
    rig = ideal_rig()
    with pytest.raises(InputError, match="two or more"):
        stereo_geometry(Rig({"left": rig.cameras["left"]}))
    with pytest.raises(InputError, match="left camera first"):
        stereo_geometry(Rig(dict(reversed(rig.cameras.items()))))


@given(near=st.floats(30, 3000), ratio=st.floats(1.01, 20))
def test_search_range_holds_near_and_far(near, ratio):
    rectification = stereo_geometry(ideal_rig()).rectification
    settings = MatcherSettings(near_mm=near, far_mm=near * ratio)
    if rectification.disparity(settings.far_mm) > WIDTH - 1:
        with pytest.raises(InputError, match="near_mm"):
            search_range(rectification, settings)
        return
    first, count = search_range(rectification, settings)
    assert count % 16 == 0
    assert first < rectification.disparity(settings.far_mm) + 1e-9
    assert first + count - 1 >= min(rectification.disparity(settings.near_mm), WIDTH - 1) - 1e-9


@pytest.mark.parametrize(
    "given", [{"block_size": 25}, {"block_size": 11, "p2": 280}, {"block_size": 21, "prefilter_cap": 127}]
)
def test_settings_whose_costs_overflow_in_opencv_are_refused(given):
    """Before, 16 bits overflowed: of random dots half to none had the right disparity."""
    with pytest.raises(ValidationError, match="OpenCV's costs have 16 bits"):
        MatcherSettings(near_mm=380, far_mm=600, **given)
    MatcherSettings(near_mm=380, far_mm=600, method="correlation", **given)


@pytest.mark.parametrize("mode", ["hh", "sgbm", "3way"])
def test_the_largest_block_that_is_allowed_gives_the_right_disparities(mode):
    """Of the texture with the largest costs, in which every pixel differs."""
    settings = MatcherSettings(near_mm=380, far_mm=600, block_size=21, mode=mode)
    noise = np.random.default_rng(1).integers(0, 256, (60, 300)).astype(np.uint8)
    matched = match_both_ways(noise, np.roll(noise, -40, axis=1), (60, 240), 30, 32, settings).disparity
    assert (np.abs(matched - 40) < 0.5).mean() > 0.99


@pytest.mark.parametrize("columns", [1, 5])
def test_fewer_columns_than_a_block_have_no_match(columns):
    """Before, an error of OpenCV."""
    settings = MatcherSettings(near_mm=380, far_mm=600, block_size=21)
    noise = np.random.default_rng(1).integers(0, 256, (60, 300)).astype(np.uint8)
    matched = match_both_ways(noise, np.roll(noise, -40, axis=1), (60, 60 + columns), 30, 16, settings).disparity
    assert matched.shape == (60, columns) and np.isnan(matched).all()


@pytest.mark.parametrize("method", ["sgbm", "census", "correlation"])
def test_faint_texture_of_a_bracket_is_matched_as_in_its_longest_exposure(method):
    """In 8 bits of the shortest exposure it had three levels: 54, 75 and 32 % of the points were right."""
    rng, rig, surface = np.random.default_rng(4), ideal_rig(), plane([0.3, 0, 1], 470)
    settings = SETTINGS.model_copy(update={"method": method, "sub_pixel": "method"})
    rates = {name: draw(eye, surface) / 230 * 20.0 for name, eye in rig.cameras.items()}  # DN of the longest exposure
    times = (1 / 16, 1 / 4, 1.0)

    def stack(rate):
        noisy = [8 + rng.poisson(rate * 30 * t) / 30 + rng.normal(0, 0.3, rate.shape) for t in times]
        return np.stack(noisy).round().clip(0, 255).astype(np.uint8)

    def share_right(images, **exposure):
        decoding = Decoding(black_level_dn=8, **exposure)
        capture = Capture("drawn", "active_stereo", "simulated", rig, images, 8, decoding)
        cloud = capture_cloud(capture, settings)
        error = np.full(cloud.status.shape, np.inf)
        n, c = surface
        error[cloud.valid] = np.abs(cloud.points[cloud.valid] @ n - c)
        return float(np.mean(error < 0.01 * 470))

    bracket = {name: stack(rate) for name, rate in rates.items()}
    alone = share_right({name: images[-1:] for name, images in bracket.items()}, exposure_s=1.0)
    merged = share_right(bracket, exposure_s=times)
    print(method, alone, merged)
    assert alone > 0.7 and merged > alone - 0.02
