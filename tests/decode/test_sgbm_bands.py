"""Semi-global matching in bands: OpenCV's own disparities, all of them, whatever the bands and the memory."""

import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.decoding.matching import sgbm
from mitsim.decoding.matching.sgbm_bands import (
    Penalties,
    bytes_by_opencv,
    bytes_of_band,
    fits_16_bits,
    match_in_bands,
    rows_in_budget,
)
from mitsim.sensor.matcher import MatcherSettings


def pair(height, width, blur, noise, seed):
    """Two images with a pattern 5 px aside, a step in it and a blank part."""
    rng = np.random.default_rng(seed)
    wide = rng.integers(0, 256, (height, width + 24)).astype(np.float32)
    wide = cv2.GaussianBlur(wide, (0, 0), blur)
    wide[height // 2 : height // 2 + 6] = 100
    wide = np.clip(128 + (wide - wide.mean()) * 40 / max(float(wide.std()), 1e-3), 0, 255)
    other = np.where(np.arange(height)[:, None] < height // 3, wide[:, 5 : width + 5], wide[:, 11 : width + 11])
    other = np.clip(other + rng.normal(0, noise, other.shape), 0, 255)
    return wide[:, :width].astype(np.uint8), other.astype(np.uint8)


@settings(max_examples=40)
@given(
    height=st.integers(3, 40),
    width=st.integers(6, 60),
    count=st.sampled_from([16, 32, 48]),
    block=st.sampled_from([3, 5, 7, 9]),
    p1=st.integers(0, 20),
    p2=st.integers(0, 60),
    cap=st.integers(1, 127),
    uniqueness=st.integers(0, 100),
    blur=st.floats(0.3, 4),
    noise=st.floats(0, 20),
    seed=st.integers(0, 999),
    rows=st.integers(1, 50),
)
def test_bands_are_opencv_to_the_last_bit(
    height, width, count, block, p1, p2, cap, uniqueness, blur, noise, seed, rows
):
    reference, other = pair(height, width + count, blur, noise, seed)
    penalties = Penalties(block, p1 * block**2, p2 * block**2, cap, uniqueness)
    if not fits_16_bits(penalties):
        return
    whole = cv2.StereoSGBM.create(
        0, count, block, penalties.p1, penalties.p2, -1, cap, uniqueness, 0, 0, cv2.STEREO_SGBM_MODE_HH
    )
    found = match_in_bands(reference, other, count, penalties, rows)
    assert np.array_equal(found, whole.compute(reference, other))


@pytest.mark.parametrize("block", [3, 5, 31])
@pytest.mark.parametrize("mode", ["hh", "sgbm"])
def test_matches_do_not_depend_on_the_budget(block, mode):
    """Also where the sums would not fit 16 bits, and OpenCV matches whatever the budget says."""
    left, right = pair(48, 150, 1.0, 3.0, 4)
    chosen = MatcherSettings(near_mm=1, far_mm=2, block_size=block, mode=mode)
    wide, one_way, tiny = (
        sgbm.match_both_ways(left, right, (10, 120), -8, 32, chosen, budget) for budget in (1e9, 1.5e6, 1e4)
    )
    if block < 31:
        assert np.isfinite(wide.disparity).mean() > 0.5
    for other in (one_way, tiny):
        for name in ("disparity", "disagreement", "matched_back"):
            np.testing.assert_array_equal(getattr(other, name), getattr(wide, name))


def test_a_tiny_budget_matches_in_bands(monkeypatch):
    """The test above would prove nothing if the bands were never taken."""
    taken = []

    def noted(reference, other, count, penalties, rows):
        taken.append(rows)
        return match_in_bands(reference, other, count, penalties, rows)

    monkeypatch.setattr(sgbm, "match_in_bands", noted)
    left, right = pair(48, 150, 1.0, 3.0, 4)
    chosen = MatcherSettings(near_mm=1, far_mm=2)
    sgbm.match_both_ways(left, right, (10, 120), -8, 32, chosen, 1e9)
    assert not taken
    sgbm.match_both_ways(left, right, (10, 120), -8, 32, chosen, 1e4)
    assert len(taken) == 2 and max(taken) < 48


def test_the_rows_of_a_band_keep_the_budget_where_any_do():
    rows = rows_in_budget(450e6, 1024, 1280, 512)
    assert bytes_of_band(rows, 1024, 1280, 512) <= 450e6 < bytes_of_band(rows + 1, 1024, 1280, 512)
    least = rows_in_budget(1.0, 1024, 1280, 512)
    assert bytes_of_band(least, 1024, 1280, 512) == min(bytes_of_band(k, 1024, 1280, 512) for k in range(1, 1025))


@pytest.mark.parametrize("rows", [4, 16, 64])
def test_the_memory_of_bands_is_what_is_said(rows):
    """To a quarter, of which small images take more for what does not grow with the range."""
    height, width, count = 128, 160, 64
    reference, other = pair(height, width + count, 1.0, 3.0, 4)
    tracemalloc.start()
    match_in_bands(reference, other, count, Penalties(5, 200, 800, 63, 5), rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.25 * bytes_of_band(rows, height, width, count)


@pytest.mark.parametrize("count", [64, 256, 512, 1024, 1280])
def test_both_ways_together_keep_the_budget_whatever_the_range(count):
    """Images of 1280 x 1024: what OpenCV takes, or a band of as many rows as fit; at least one row has to."""
    budget = sgbm.BUDGET_BYTES
    share, ways = sgbm._memory_per_direction(
        MatcherSettings(near_mm=275, far_mm=3878, mode="hh"), 1024, 1280, count, budget
    )
    taken = bytes_by_opencv(1024, 1280, count)
    if taken > share:
        taken = bytes_of_band(rows_in_budget(share, 1024, 1280, count), 1024, 1280, count)
    assert ways * taken <= budget
