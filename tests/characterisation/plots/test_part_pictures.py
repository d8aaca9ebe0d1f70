"""The viewer's frame, the edges between shapes and the place for a name in pictures of parts, by closed forms."""

import math

import numpy as np
import pytest

from characterisation.plots.part_pictures import innermost_pixel, shape_edges, viewer_frame


@pytest.mark.parametrize("elevation", [-1.2, 0.0, 0.6])
@pytest.mark.parametrize("azimuth", [-2.0, 0.0, 0.5 * math.pi])
def test_the_viewers_frame_is_right_handed_upright_and_looks_from_there(azimuth, elevation):
    right, up, toward = frame = viewer_frame(azimuth, elevation)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.cross(right, up), toward, atol=1e-15)
    assert right[2] == 0
    assert up[2] == pytest.approx(math.cos(elevation))
    assert math.asin(toward[2]) == pytest.approx(elevation)
    assert math.atan2(toward[1], toward[0]) == pytest.approx(azimuth)


def test_edges_are_where_the_left_or_upper_pixel_shows_another_shape():
    shape = np.full((4, 5), -1)
    shape[1:3, 2:4] = 7
    expected = [[0, 0, 0, 0, 0], [0, 0, 1, 1, 1], [0, 0, 1, 0, 1], [0, 0, 1, 1, 0]]
    np.testing.assert_array_equal(shape_edges(shape), np.array(expected, bool))


def test_the_innermost_pixel_is_the_middle_of_a_disc_and_avoids_the_pictures_border():
    rows, columns = np.mgrid[:40, :60]
    assert innermost_pixel(np.hypot(rows - 22, columns - 31) < 12) == (22, 31)
    assert innermost_pixel(np.ones((9, 9), bool)) == (4, 4)
