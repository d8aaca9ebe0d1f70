"""``mitsim measure`` on recordings: dots of plates whose pitch is known."""

import pytest

from mitsim.capture.cloud import capture_cloud, decoder_settings
from mitsim.capture.readers.ensenso import read_ensenso
from mitsim.measure.plate import Plate, image_on_grid, measure_plate
from mitsim.measure.windows import ImageWindow

pytestmark = pytest.mark.real


@pytest.mark.parametrize(
    ("folder", "window", "published"),
    [
        # the corrected calibration, whose dots triangulated without a cloud are 18.64 and 18.66 mm apart
        ("locate_multiple_patterns", (110, 120, 200, 190), 18.64),
        ("locate_multiple_patterns", (345, 130, 220, 200), 18.66),
        # published 18.712 +- 0.015 mm with the static calibration, and 18.75 mm by its print
        ("stereo_camera", (380, 180, 480, 480), 18.75),
    ],
)
def test_the_pitch_of_plates(folder, window, published, real_data):
    capture = read_ensenso(real_data / "ensenso" / folder / "camera.zip", frame=0)
    settings, imager = decoder_settings(capture)
    cloud = capture_cloud(capture, settings, imager=imager)
    plate = Plate(ImageWindow(*window), 18.75)
    pitch, *_ = measure_plate("plate", plate, cloud, image_on_grid(capture, cloud.grid))
    assert pitch.points >= 45
    assert pitch.value == pytest.approx(published, abs=0.02)
