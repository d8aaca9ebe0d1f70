"""Spots of a diffractive element: one in each cell, in tiles; and frames of a shifted mask."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from mitsim.sensor.pattern import DiffractionSpots, RandomDots, another_mask, diffraction_spots, dot_frames


@pytest.mark.parametrize(("cell", "places"), [(9.0, 3), (20.0, 7), (12.5, 5)])
def test_every_cell_holds_one_spot_of_the_stated_size(cell, places):
    width, height = 400, 300
    field = diffraction_spots(width, height, cell, places, 1.0, (1, 1), seed=3)
    middle = (np.arange(places) + 0.5) * cell / places - 0.5
    # every cell that lies whole in the field: its brightest pixel is within half a pixel of one of the places
    for row in range(int(height // cell)):
        for column in range(int(width // cell)):
            top, left = int(np.ceil(row * cell - 0.5)), int(np.ceil(column * cell - 0.5))
            part = field[top : top + int(cell), left : left + int(cell)]
            y, x = np.unravel_index(part.argmax(), part.shape)
            assert np.abs(middle + row * cell - (top + y)).min() <= 1
            assert np.abs(middle + column * cell - (left + x)).min() <= 1
            assert part.max() > 0.7
    assert np.isclose(field.mean(), 2 * np.pi / cell**2, rtol=0.05)


def test_tiles_repeat():
    field = diffraction_spots(360, 270, 9.0, 3, 1.2, (2, 3), seed=1)
    inner = slice(20, -20)
    np.testing.assert_allclose(field[inner, 20:160], field[inner, 200:340], atol=1e-6)
    np.testing.assert_allclose(field[20:70, inner], field[110:160, inner], atol=1e-6)
    assert abs(np.corrcoef(field[:80].ravel(), field[40:120].ravel())[0, 1]) < 0.2


def test_frames_are_the_mask_moved_right_and_down():
    pattern = RandomDots(kind="random_dots", run_length_px=6, seed=2, shifts_px=[(0, 0), (7, 3), (0.5, 0)])
    still, moved, half = dot_frames(pattern, 200, 150)
    np.testing.assert_array_equal(moved[3:, 7:], still[:-3, :-7])
    np.testing.assert_allclose(half[:, 1:], (still[:, 1:] + still[:, :-1]) / 2, atol=1e-6)


def test_no_shifts_is_one_frame_as_ever():
    from mitsim.sensor.pattern import random_blobs

    pattern = RandomDots(kind="random_dots", run_length_px=6, bright_share=0.4, blur_px=0.9, seed=2)
    (only,) = dot_frames(pattern, 200, 150)
    np.testing.assert_array_equal(only, random_blobs(200, 150, 6, 0.4, 0.9, 2))


def test_spots_smaller_than_a_pixel_are_refused():
    with pytest.raises(ValidationError, match="spot_px"):
        DiffractionSpots(kind="diffraction_spots", cell_px=9, spot_px=0.1)


@pytest.mark.parametrize(
    "pattern",
    [
        RandomDots(kind="random_dots", run_length_px=6, bright_share=0.4, blur_px=0.9, seed=2),
        DiffractionSpots(kind="diffraction_spots", cell_px=9, places=3, spot_px=1.6, tiles=(2, 2), seed=2),
    ],
    ids=["random dots", "spots"],
)
def test_masks_of_two_devices_differ_and_have_the_same_statistics(pattern):
    masks = [dot_frames(another_mask(pattern, seed), 480, 360)[0] for seed in (11, 12, 13)]
    cells = masks[0].size / (6 if pattern.kind == "random_dots" else 9) ** 2
    for one, other in ((masks[0], masks[1]), (masks[1], masks[2])):
        # independent fields: a correlation of four standard deviations is one in 16,000
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 4 / np.sqrt(cells / 4)
        assert one.mean() == pytest.approx(other.mean(), abs=4 * one.std() / np.sqrt(cells / 4))
        assert one.std() == pytest.approx(other.std(), rel=4 / np.sqrt(cells / 4))
        for lag in (2, 5):
            there = [(each - each.mean())[:, lag:] * (each - each.mean())[:, :-lag] for each in (one, other)]
            assert there[0].mean() == pytest.approx(there[1].mean(), abs=4 * there[0].std() / np.sqrt(cells / 4))
    assert another_mask(pattern, pattern.seed) == pattern
