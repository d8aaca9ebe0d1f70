"""Loss toward the corners against the cos^4 law, worked out pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.vignetting import camera_illumination, cos4_corner


def test_illumination_is_the_law_of_cosines():
    # an ideal lens of focal length f: cos^4, whatever the corner
    f = 600.0
    camera = Camera(np.array([[f, 0, 370], [0, f, 245], [0, 0, 1]]), np.zeros(5), 752, 480)
    rows, columns = np.mgrid[:480, :752]
    cos4 = 1 / (1 + ((columns - 370) ** 2 + (rows - 245) ** 2) / f**2) ** 2
    found = camera_illumination(cos4.min(), camera)
    assert found.dtype == np.float32
    assert np.allclose(found, cos4, rtol=1e-6)
    given = camera_illumination(0.4, camera)
    assert np.allclose(given[[245, 0], [370, 751]], [1, 0.4], atol=0.02)
    assert given.min() == pytest.approx(0.4, rel=1e-6)
    for corner in (0.0, -1.0, 1.01, np.nan):
        with pytest.raises(InputError, match="corner_illumination"):
            camera_illumination(corner, camera)


@pytest.mark.parametrize("name", presets())
def test_a_lens_of_which_nothing_is_said_follows_the_law_of_cosines(name):
    """Every camera's own law, from its focal length and the place in the image, whatever the field and the corner."""
    sensor = load_sensor(name)
    for camera in sensor.rig.cameras.values():
        (fx, _, cx), (_, fy, cy), _ = camera.matrix
        rows, columns = np.mgrid[: camera.height, : camera.width]
        angle = np.arctan(np.hypot(columns - cx, rows - cy) / np.sqrt(fx * fy))
        np.testing.assert_allclose(camera_illumination(None, camera), np.cos(angle) ** 4, rtol=1e-5)
        assert cos4_corner(camera) == pytest.approx((np.cos(angle) ** 4).min(), rel=1e-9)
        assert camera_illumination(1.0, camera) is None
        assert camera_illumination(0.7, camera).min() == pytest.approx(0.7, rel=1e-6)


def test_the_law_of_cosines_at_45_degrees_is_a_quarter():
    camera = Camera(np.array([[50.0, 0, 50], [0, 50, 40], [0, 0, 1]]), np.zeros(5), 101, 81)
    found = camera_illumination(None, camera)
    assert found[40, 50] == 1
    assert found[40, [0, 100]] == pytest.approx(0.25)
