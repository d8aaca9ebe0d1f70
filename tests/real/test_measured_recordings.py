"""``mitsim measure`` on recordings: dots of plates whose pitch is known, and a wall."""

import pytest

from characterisation.region_of_interest import Roi
from characterisation.tasks.windows import WindowPlan, measure_windows
from mitsim.capture.recordings.ensenso import read_ensenso
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.input_clouds import cloud_paths, read_cloud
from mitsim.decoding.plate import Plate, image_on_grid, measure_plate

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
    if folder == "stereo_camera":  # a plate at 510 mm; the recording's own search, 276 to 4089 mm, is thrice as wide
        settings = settings.model_copy(update={"near_mm": 400.0, "far_mm": 700.0})
    cloud = capture_cloud(capture, settings, imager=imager)
    plate = Plate(Roi(*window), 18.75)
    pitch, *_ = measure_plate("plate", plate, cloud, image_on_grid(capture, cloud.grid))
    assert pitch.points >= 45
    assert pitch.value == pytest.approx(published, abs=0.02)


def test_a_wall_in_a_cloud_of_another_program(real_data):
    """Figures of docs/how-to/measure.md."""
    (path,) = cloud_paths([real_data / "primesense_pcl" / "capture0001.pcd"])
    plan = WindowPlan({"wall": ("plane", Roi(420, 60, 150, 100))})
    found = {one.name: one for one in measure_windows(read_cloud(path).cloud, plan)}
    assert found["wall distance"].value == pytest.approx(2485.53, abs=0.01)
    assert found["wall noise"].value == pytest.approx(14.90, abs=0.01)
    assert found["wall flatness"].points > 14900
