"""What a capture says of its images."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding.cloud import capture_cloud
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.transforms import Transform


def capture_of(images: np.ndarray, technology: str, **decoding: bool) -> Capture:
    height, width = images.shape[1:]
    matrix = np.array([[100.0, 0, (width - 1) / 2], [0, 100.0, (height - 1) / 2], [0, 0, 1]])
    camera = Camera(matrix, np.zeros(5), width, height)
    return Capture("one", technology, "device", Rig({"left": camera}), {"left": images}, 16, Decoding(**decoding))


def test_brightness_of_time_of_flight_is_the_range_of_the_correlation() -> None:
    """The mean over the phase steps is the zero level, whatever the light."""
    amplitude, phase = np.linspace(10, 900, 12).reshape(3, 4), np.arange(12.0).reshape(3, 4)
    steps = np.arange(4)[:, None, None] * np.pi / 2
    images = np.rint(16384 + amplitude * np.cos(phase + steps)).astype(np.uint16)
    np.testing.assert_allclose(capture_of(images, "time_of_flight").brightness("left"), 2 * amplitude, atol=2)


def test_brightness_leaves_out_the_image_of_ambient_light() -> None:
    images = np.full((3, 2, 2), 100, np.uint16) * np.array([1, 3, 9], np.uint16)[:, None, None]
    assert capture_of(images, "structured_light", ambient_image=True).brightness("left")[0, 0] == 200
    assert capture_of(images, "structured_light").brightness("left")[0, 0] == pytest.approx(1300 / 3)


def two_cameras(names: list[str], technology: str = "active_stereo") -> Capture:
    """Return a capture of a pair whose images are given in some order."""
    matrix = np.array([[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]])
    place = Transform(np.eye(3), np.array([50.0, 0.0, 0.0]))
    cameras = {
        name: Camera(matrix, np.zeros(5), 64, 48, at) for name, at in (("left", Transform.identity()), ("right", place))
    }
    noise = np.random.default_rng(1).integers(0, 256, (1, 48, 64)).astype(np.uint8)
    images = {"left": noise, "right": np.roll(noise, -10, axis=2)}
    return Capture("one", technology, "device", Rig(cameras), {name: images[name] for name in names}, 8)


def test_images_are_in_the_order_of_the_cameras() -> None:
    """Before, a dictionary in another order exchanged the two cameras."""
    settings = MatcherSettings(near_mm=300, far_mm=900)
    ordered, other = (capture_cloud(two_cameras(names), settings) for names in (["left", "right"], ["right", "left"]))
    assert ordered.valid.mean() > 0.3
    np.testing.assert_array_equal(other.points, ordered.points)


@pytest.mark.parametrize("name", ["left", "right"])
def test_a_pair_of_which_one_camera_has_no_images_is_not_decoded(name: str) -> None:
    other = {"left": "right", "right": "left"}[name]
    with pytest.raises(InputError, match=f"none of {other}; allowed: images of left and right"):
        capture_cloud(two_cameras([name]), MatcherSettings(near_mm=300, far_mm=900))
