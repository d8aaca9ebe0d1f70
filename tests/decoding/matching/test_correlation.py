"""Correlation of several frames: against a slow one, against drawn planes, with noise, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, map_coordinates

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.correlation import correlate_both_ways
from mitsim.decoding.matching.stereo import decode_stereo
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT, FOCAL, BASELINE = 240, 90, 400.0, 80.0
SETTINGS = MatcherSettings(near_mm=700, far_mm=2000, method="correlation", uniqueness_percent=5)


def pattern(seed: int) -> np.ndarray:
    """Smooth random values with an autocorrelation as of recorded dots, standard deviation 30 DN about 120."""
    smooth = gaussian_filter(np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH + 160)), 0.98, mode="wrap")
    return 120 + 30 * (smooth - smooth.mean()) / smooth.std()


def drawn(frames: int, disparity: float, slope: float = 0.0, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Rectified frames of both eyes: left column x is right column x - disparity - slope x."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    left, right = [], []
    for frame in range(frames):
        values = pattern(frame)
        seen = (columns + disparity) / (1 - slope)
        left.append(map_coordinates(values, [rows, columns + 60], order=5, mode="nearest"))
        right.append(map_coordinates(values, [rows, seen + 60], order=5, mode="nearest"))
    return tuple(np.stack(each) + rng.normal(0, noise, (frames, HEIGHT, WIDTH)) for each in (left, right))


def matched(images, first=10, count=32, **changes):
    left, right = (each.astype(np.float32) for each in images)
    return correlate_both_ways(left, right, (0, WIDTH), first, count, SETTINGS.model_copy(update=changes))


def error(images, disparity, slope=0.0, **changes):
    """Error of the disparity [px], where both eyes see the plane."""
    found = matched(images, **changes).disparity[8:-8, 60:-12]
    off = found - (disparity + slope * np.arange(WIDTH)[60:-12])
    assert np.isfinite(off).mean() > 0.98
    return off[np.isfinite(off)]


def test_whole_disparities_are_those_of_a_slow_search():
    """Straight from the definition of the correlation, block by block."""
    left, right = drawn(2, 17.3, 0.02, noise=8.0)
    found = np.rint(matched((left, right), uniqueness_percent=0).disparity - 0.0)
    for row, column in [(20, 90), (45, 120), (60, 200), (71, 151)]:
        scores = []
        for d in range(10, 42):
            blocks = [im[:, row - 2 : row + 3, c - 2 : c + 3] for im, c in ((left, column), (right, column - d))]
            a, b = (block - block.mean(axis=(1, 2), keepdims=True) for block in blocks)
            scores.append((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))
        assert abs(found[row, column] - (10 + int(np.argmax(scores)))) <= 1


@pytest.mark.parametrize("fraction", np.arange(8) / 8)
def test_no_fraction_of_a_pixel_is_preferred_without_noise(fraction):
    off = error(drawn(3, 20 + fraction), 20 + fraction)
    assert abs(off.mean()) < 0.01
    assert off.std() < 0.03


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.75])
def test_nor_with_noise_of_a_third_of_the_contrast(fraction):
    """Without the share of noise taken away, the mean would be off by 0.09 px at a quarter.

    The mean of about 12000 pixels, a block of 25 of them alike, scatters by 0.1 / sqrt(500) = 0.005 px.
    """
    off = error(drawn(4, 20 + fraction, noise=10.0), 20 + fraction)
    assert abs(off.mean()) < 0.03


def test_noise_falls_as_the_root_of_the_frames():
    two, eight = (error(drawn(n, 20.3, noise=3.0), 20.3, block_size=7).std() for n in (2, 8))
    # a few per cent of texture's own error, which falls alike
    assert np.isclose(two / eight, 2, rtol=0.15)


def test_a_sloping_plane_has_no_mean_error():
    off = error(drawn(4, 14.0, 0.05), 14.0, 0.05)
    assert abs(off.mean()) < 0.01
    assert off.std() < 0.04


@given(gain=st.floats(0.3, 2.0), offset=st.floats(-40, 40))
@settings(max_examples=10, deadline=None)
def test_brightness_and_contrast_of_one_eye_do_not_matter(gain, offset):
    left, right = drawn(2, 18.4)
    plain, changed = matched((left, right)), matched((left, gain * right + offset))
    both = np.isfinite(plain.disparity) & np.isfinite(changed.disparity)
    assert both.mean() > 0.75
    assert np.abs(plain.disparity - changed.disparity)[both].max() < 0.01


def test_pixels_that_the_other_camera_does_not_see_have_no_match_from_it_or_disagree():
    left, right = drawn(2, 20.0)
    far = drawn(2, 12.0)[1]
    right[:, :, 100:] = far[:, :, 100:]  # a nearer surface up to right column 100, a farther one behind
    found = matched((left, right))
    # left columns 112 to 120 are behind the nearer one: right columns 92 to 100 belong to both
    assert np.nanmedian(found.disparity[10:-10, 70:108]) == pytest.approx(20, abs=0.1)
    assert np.nanmedian(found.disparity[10:-10, 130:200]) == pytest.approx(12, abs=0.1)


def rig() -> Rig:
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    left = Camera(K, np.zeros(5), WIDTH, HEIGHT)
    right = Camera(K, np.zeros(5), WIDTH, HEIGHT, Transform(np.eye(3), np.array([BASELINE, 0, 0])))
    same = Rectification(K, K, np.eye(3), np.eye(3), BASELINE, WIDTH, HEIGHT)
    return Rig({"left": left, "right": right}, rectification=same)


def decoded(frames, settings=SETTINGS, **options):
    left, right = (np.rint(each).clip(1, 254).astype(np.uint8) for each in frames)
    return decode_stereo(
        left, right, stereo_geometry(rig()), settings, ImageContext("drawn", "simulated", 255, **options)
    )


def test_a_window_is_a_part_of_the_whole():
    frames = drawn(2, 20.4)
    whole, part = decoded(frames), decoded(frames, roi=Roi(80, 20, 120, 50))
    assert part.valid[25:65, 90:190].mean() > 0.98
    both = whole.valid & part.valid
    np.testing.assert_allclose(part.points[both], whole.points[both], rtol=1e-4)


@pytest.mark.parametrize("frames", [1, 2, 4])
@pytest.mark.parametrize("columns", [(60, 150), (101, 117), (64, 128)])
def test_a_match_does_not_depend_on_the_columns_beside_it(frames, columns):
    """To the last bit, from a block's half on; so does not what the right image says to it."""
    left, right = (each.astype(np.float32) - 120 for each in drawn(frames, 20.4, 0.02, noise=4.0))
    whole = correlate_both_ways(left, right, (0, WIDTH), 10, 32, SETTINGS)
    part = correlate_both_ways(left, right, columns, 10, 32, SETTINGS)
    for name in ("disparity", "disagreement", "matched_back"):
        one, other = getattr(part, name), getattr(whole, name)[:, slice(*columns)]
        assert np.ascontiguousarray(one[:, 2:-2]).tobytes() == np.ascontiguousarray(other[:, 2:-2]).tobytes(), name


def test_a_search_that_reaches_beyond_both_images_is_answered():
    """Of disparities under zero and over the width; what does not exist is matched with nothing."""
    left, right = (each.astype(np.float32) - 120 for each in drawn(3, 20.0))
    found = correlate_both_ways(left, right, (0, WIDTH), -WIDTH, 2 * WIDTH, SETTINGS)
    seen = found.disparity[8:-8, 40:-40]
    assert np.mean(np.abs(seen - 20) < 0.1) > 0.98
    columns = np.arange(WIDTH) - found.disparity
    assert (columns[np.isfinite(columns)] > -1).all()
    assert (columns[np.isfinite(columns)] < WIDTH).all()


def test_steps_of_the_disparity_show_in_the_depth():
    cloud = decoded(drawn(2, 20.4, 0.02), SETTINGS.model_copy(update={"disparity_step": 0.125}))
    steps = FOCAL * BASELINE / cloud.points[cloud.valid][:, 2] * 8
    assert len(np.unique(np.rint(steps))) > 10
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


def test_frames_that_do_not_go_together_are_refused():
    left, right = (each.astype(np.uint8) for each in drawn(3, 20.0))
    with pytest.raises(InputError, match="one pair"):
        settings = SETTINGS.model_copy(update={"method": "sgbm"})
        decode_stereo(left, right, stereo_geometry(rig()), settings, ImageContext("", "device", 255))
    with pytest.raises(InputError, match="3 left and 2 right"):
        decode_stereo(left, right[:2], stereo_geometry(rig()), SETTINGS, ImageContext("", "device", 255))


def test_a_lens_that_bends_so_much_that_opencv_loses_the_middle_is_rectified_all_the_same():
    """As the recorded N35: OpenCV puts the middle of the rectified image 300 px beside it."""
    K = np.array([[1154.0, 0, 636], [0, 1154.0, 499], [0, 0, 1]])
    bent = np.array([-0.557, 0.327, 0.0002, -0.0021, -0.107])
    place = Transform.from_degrees([0.0, -8.8, 0.0], [100.0, 0.0, 8.7])
    geometry = stereo_geometry(Rig({"left": Camera(K, bent, 1280, 1024), "right": Camera(K, bent, 1280, 1024, place)}))
    assert geometry.seen_left.mean() > 0.95
    assert geometry.seen_right.mean() > 0.95
    point = np.array([[20.0, -30.0, 450.0]])
    column, row = geometry.grid.project(point)[0]
    mapped = geometry.map_left[:, round(row), round(column)]
    off = mapped - next(iter([Camera(K, bent, 1280, 1024).project(point)[0]]))
    assert np.abs(off).max() < 1
