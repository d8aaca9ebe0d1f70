"""By how many rows a patch lies lower in the right image."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from mitsim.decoding.matching.row_error import MAXIMUM_ROWS, row_error

SIDE, DISPARITY = 80, 6.0


def found(lower: float) -> float:
    """The row error of a patch of random texture that lies ``lower`` rows lower in the right image, under a veil."""
    left = 100 + 800 * gaussian_filter(np.random.default_rng(3).standard_normal((SIDE, SIDE)), 2.0, mode="wrap")
    right = 12 + shift(left, (lower, -DISPARITY), order=3, mode="grid-wrap")
    straight = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE))).astype(np.float32)
    rows, columns = (one.ravel() for one in np.mgrid[25:55, 25:55])
    geometry = SimpleNamespace(map_left=straight, map_right=straight)
    return row_error(left, right, geometry, rows, columns, np.full(len(rows), DISPARITY))


@pytest.mark.parametrize("lower", [-1.3, -0.4, 0.0, 0.7, 1.2])
def test_it_is_found_with_its_sign_and_its_fraction(lower):
    # a parabola through three whole rows is 0.06 px off between them
    assert found(lower) == pytest.approx(lower, abs=0.08)


@pytest.mark.parametrize("lower", [-4.0, 4.0])
def test_one_beyond_the_rows_that_are_tried_is_unknown(lower):
    assert abs(lower) > MAXIMUM_ROWS
    assert np.isnan(found(lower))
