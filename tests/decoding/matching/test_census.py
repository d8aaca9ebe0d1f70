"""Matching by census codes: against a slow one, on drawn planes, and what it does not depend on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter, map_coordinates

from mitsim.decoding.matching import census, sgbm
from mitsim.decoding.matching.census import census_words, match_census_both_ways
from mitsim.decoding.matching.sub_pixel import offset_of_minimum
from mitsim.sensor.matcher import MatcherSettings
from tests.decoding.matching.test_stereo import decode, disparity_error, ideal_rig, pair, plane, real_rig

WIDTH, HEIGHT = 160, 60
SETTINGS = MatcherSettings(near_mm=380, far_mm=600, method="census", block_size=3)


def drawn(disparity: float, frames: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Frames of both eyes, 8 bit: left column x is right column x - disparity."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    left, right = [], []
    for frame in range(frames):
        smooth = gaussian_filter(np.random.default_rng(frame).standard_normal((HEIGHT, WIDTH + 120)), 1.2, mode="wrap")
        values = 120 + 30 * smooth / smooth.std()
        left.append(map_coordinates(values, [rows, columns + 40], order=5))
        right.append(map_coordinates(values, [rows, columns + 40 + disparity], order=5))
    return tuple(np.clip(np.rint(each), 0, 255).astype(np.uint8) for each in (left, right))


def matched(images, first=5, count=32, **changes):
    return match_census_both_ways(*images, (0, WIDTH), first, count, SETTINGS.model_copy(update=changes))


def test_a_code_says_which_neighbours_are_darker():
    image = np.random.default_rng(1).integers(0, 256, (20, 30)).astype(np.uint8)
    for window, words in ((3, 1), (5, 1), (9, 2)):
        codes = census_words(image, window)
        assert len(codes) == words
        reach = window // 2
        for row, column in ((9, 12), (15, 20)):
            part = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
            expected = (part < image[row, column]).sum()
            assert sum(int(word[row, column]).bit_count() for word in codes) == expected


def test_whole_disparities_are_those_of_a_slow_search_without_penalties():
    """With P1 and P2 next to nothing, eight paths rank disparities as eight times the cost of a pixel does."""
    images = drawn(17.3)
    found = matched(images, p1=1e-6, p2=1e-6, uniqueness_percent=0, block_size=5).disparity
    left, right = (census_words(each[0], 7)[0] for each in images)
    for row, column in ((20, 60), (31, 90), (40, 120), (45, 140)):
        costs = [
            np.bitwise_count(
                left[row - 2 : row + 3, column - 2 : column + 3]
                ^ right[row - 2 : row + 3, column - d - 2 : column - d + 3]
            ).sum()
            for d in range(5, 37)
        ]
        assert abs(found[row, column] - (5 + int(np.argmin(costs)))) <= 0.5


@pytest.mark.parametrize("largest", [200, 30_000])
@pytest.mark.parametrize(("mode", "steps"), [("hh", 8), ("sgbm", 5), ("3way", 3)])
def test_paths_are_those_of_the_formula_pixel_by_pixel(mode, steps, largest, monkeypatch):
    """Sums of 200 fit into 16 bits; those of 30,000 are limited to the largest integer."""
    height, count, width, p1, p2 = 7, 16, 9, 11, 40
    cost = np.random.default_rng(largest).integers(0, largest, (height, count, width))
    every = [(0, 1), (0, -1), (1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1)]
    total = np.zeros_like(cost)
    for down, right in every[:steps]:
        path = {}
        for row in range(height)[:: -1 if down < 0 else 1]:
            for column in range(width)[:: -1 if right < 0 else 1]:
                before = path.get((row - down, column - right), np.zeros(count, int))
                wide = np.pad(before, 1, constant_values=10**6)
                best = np.min([before, wide[:-2] + p1, wide[2:] + p1, np.full(count, before.min() + p2)], axis=0)
                path[row, column] = cost[row, :, column] + best - before.min()
                total[row, :, column] += path[row, column]
    monkeypatch.setattr(census, "_TOGETHER", 3)
    found = census._summed_paths(cost.astype(np.int16), census._Penalties(p1, p2), mode)
    np.testing.assert_array_equal(found, np.minimum(total, 32767))


@pytest.mark.parametrize("fit", ["parabola", "equiangular"])
@pytest.mark.parametrize("frames", [1, 3])
def test_planes_come_back_and_fractions_cancel(fit, frames):
    off = []
    for fraction in np.arange(4) / 4:
        matches = matched(drawn(15 + fraction, frames), sub_pixel=fit)
        inner = matches.disparity[8:-8, 50:-10]
        assert np.isfinite(inner).mean() > 0.97
        error = inner[np.isfinite(inner)] - (15 + fraction)
        assert np.abs(error).mean() < 0.2
        off.append(error.mean())
        assert (matches.disagreement[8:-8, 50:-10] <= 1).mean() > 0.95
    assert abs(np.mean(off)) < 0.02


@given(gain=st.floats(0.5, 1.0), offset=st.integers(0, 40))
@settings(max_examples=8, deadline=None)
def test_brightness_and_contrast_of_one_eye_do_not_matter(gain, offset):
    left, right = drawn(16.0)
    darker = (offset + gain * right).astype(np.uint8)
    plain, other = matched((left, right)).disparity, matched((left, darker)).disparity
    inner = np.s_[8:-8, 50:-10]
    # rounding makes a few neighbours equal that were not
    assert np.nanmean(np.abs(other[inner] - plain[inner])) < 0.05


def sloping(down: float) -> tuple[np.ndarray, np.ndarray]:
    """A pair whose disparity changes by ``down`` from row to row, 17 px in the middle row."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    smooth = gaussian_filter(np.random.default_rng(4).standard_normal((HEIGHT, WIDTH + 120)), 1.2, mode="wrap")
    values = 120 + 30 * smooth / smooth.std()
    disparity = 17 + down * (rows - HEIGHT / 2)
    images = (map_coordinates(values, [rows, columns + 40 + shift], order=5) for shift in (0.0, disparity))
    return tuple(np.clip(np.rint(each), 0, 255).astype(np.uint8)[None] for each in images)


def test_one_pass_follows_a_slope_late_and_eight_paths_do_not():
    truth = {down: (17 + down * (np.arange(HEIGHT) - HEIGHT / 2))[8:-8, None] for down in (0.12, -0.12)}
    mean = {
        (mode, down): np.nanmean(matched(sloping(down), mode=mode).disparity[8:-8, 50:-10] - truth[down])
        for mode in ("hh", "sgbm", "3way")
        for down in truth
    }
    for mode in ("sgbm", "3way"):  # behind the rows above: too small where disparity grows, too large where it falls
        assert mean[mode, 0.12] < -0.015 and mean[mode, -0.12] > 0.015
        assert abs(mean["hh", 0.12]) < 0.5 * abs(mean[mode, 0.12])


def test_large_blocks_of_many_frames_do_not_overflow():
    found = matched(drawn(15.0, 6), block_size=15, census_window_px=9, p1=100, p2=1000).disparity[12:-12, 50:-16]
    assert np.isfinite(found).mean() > 0.97
    assert np.abs(found - 15).max() < 0.5


@pytest.mark.parametrize("method", ["census", "sgbm"])
def test_strips_of_a_large_image_change_little_beside_a_cut(method, monkeypatch):
    images = (np.concatenate([each] * 7, axis=1) for each in drawn(18.6))
    left, right = images if method == "census" else (each[0] for each in images)
    match = match_census_both_ways if method == "census" else sgbm.match_both_ways
    chosen = SETTINGS.model_copy(update={"method": method, "sub_pixel": "method"})
    whole = match(left, right, (0, WIDTH), 5, 32, chosen)
    monkeypatch.setattr(sgbm, "LARGEST_BYTES", 310 * 4 * WIDTH * 32)
    assert len(list(sgbm.strips(7 * HEIGHT, WIDTH, 32))) == 4
    cut = match(left, right, (0, WIDTH), 5, 32, chosen)
    for name in ("disparity", "disagreement", "matched_back"):
        same = np.isclose(getattr(cut, name), getattr(whole, name), equal_nan=True)
        assert same.mean() > 0.99


def test_what_the_right_eye_does_not_see_is_not_matched_back():
    left, right = drawn(12.0)
    right = right.copy()
    right[:, :, 60:80] = np.random.default_rng(8).integers(0, 255, (1, HEIGHT, 20))
    matches = matched((left, right))
    inside = matches.disagreement[10:-10, 76:88]
    assert not (inside <= 1).mean() > 0.6
    assert (matches.disagreement[10:-10, 110:140] <= 1).mean() > 0.95


@pytest.mark.parametrize("make_rig", [ideal_rig, real_rig])
def test_a_drawn_plane_is_decoded_where_it_is(make_rig):
    rig, surface = make_rig(), plane([0.3, 0.1, 1], 487.3)
    cloud = decode(rig, pair(rig, surface), SETTINGS)
    error = disparity_error(cloud, rig, surface)
    assert cloud.valid.mean() > 0.6
    assert abs(np.median(error)) < 0.05 and np.abs(error).mean() < 0.15


def test_offsets_of_minima_are_exact_for_their_own_shape():
    place = np.linspace(-0.49, 0.49, 11)
    square = [(step - place) ** 2 for step in (-1, 0, 1)]
    straight = [np.abs(step - place) for step in (-1, 0, 1)]
    np.testing.assert_allclose(offset_of_minimum(*square, "parabola"), place, atol=1e-6)
    np.testing.assert_allclose(offset_of_minimum(*straight, "equiangular"), place, atol=1e-6)
    assert np.abs(offset_of_minimum(*straight, "parabola") - place).max() > 0.05
    flat = np.ones(3)
    np.testing.assert_array_equal(offset_of_minimum(flat, flat, flat, "parabola"), 0)


def test_settings_that_a_method_does_not_have_are_refused():
    with pytest.raises(ValidationError, match="block_size"):
        MatcherSettings(near_mm=1, far_mm=2, block_size=1)
    for method, fit in (("sgbm", "equiangular"), ("census", "opencv"), ("correlation", "opencv")):
        with pytest.raises(ValidationError, match="sub_pixel"):
            MatcherSettings(near_mm=1, far_mm=2, method=method, sub_pixel=fit)
    assert MatcherSettings(near_mm=1, far_mm=2, method="census", block_size=1).support_px == 7
