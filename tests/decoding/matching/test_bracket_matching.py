"""A merged bracket is matched at the noise limits of its longest exposure, so that it loses none of its points."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.matching.reference_matching import reference_geometry
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.image_formation import expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.transforms import Transform

HEIGHT, WIDTH, FOCAL, BASELINE, DISPARITY = 120, 200, 300.0, 60.0, 30.35
DEPTH = FOCAL * BASELINE / DISPARITY
TIMES = (1 / 16, 1 / 4, 1.0)
IMAGER = Imager(
    pixel_um=5, quantum_efficiency=0.6, full_well=10000, read_noise=8, bits=8, black_level=4, f_number=4, prnu=0, dsnu=0
)
SETTINGS = MatcherSettings(near_mm=400, far_mm=900)
MATRIX = np.array([[FOCAL, 0, 99.5], [0, FOCAL, 59.5], [0, 0, 1]])
RIG = Rig(
    {
        "left": Camera(MATRIX, np.zeros(5), WIDTH, HEIGHT),
        "right": Camera(MATRIX, np.zeros(5), WIDTH, HEIGHT, Transform(np.eye(3), np.array([BASELINE, 0, 0]))),
    }
)


def share_of_true_points(settings: MatcherSettings, electrons: float, times: tuple[float, ...], seed: int = 0) -> float:
    """Share of pixels within 1 % of a plane of dots, whose brightest have ``electrons`` in an exposure of 1."""
    rng = np.random.default_rng(seed)
    dots = gaussian_filter((rng.random((HEIGHT, WIDTH + 80)) < 0.3).astype(float), 0.7)
    light = {"left": dots, "right": shift(dots, (0, -DISPARITY), order=3, mode="nearest")}
    images = {
        name: np.stack(
            [
                expose(electrons * (0.1 + 0.9 * field[:, 40:-40] / dots.max()) * time, IMAGER, None, Noise(), rng)
                for time in times
            ]
        )
        for name, field in light.items()
    }
    decoding = Decoding(exposure_s=times, black_level_dn=IMAGER.black_level)
    capture = Capture("drawn", "active_stereo", "simulated", RIG, images, 8, decoding)
    depth = capture_cloud(capture, settings).points[10:-10, 60:-20, 2]
    return float(np.mean(np.abs(depth - DEPTH) < 0.01 * DEPTH))


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "sgbm"},
        {"method": "sgbm", "contrast_window_px": 21},
        {"method": "census", "block_size": 5},
        {"method": "correlation"},
    ],
)
@pytest.mark.parametrize("electrons", [800, 3000])
def test_a_bracket_has_the_points_of_its_longest_exposure(changes, electrons):
    settings = SETTINGS.model_copy(update=changes)
    alone = share_of_true_points(settings, electrons, TIMES[-1:])
    assert alone > 0.9
    assert share_of_true_points(settings, electrons, TIMES) > alone - 0.01


@pytest.mark.parametrize("method", ["sgbm", "census", "correlation"])
def test_a_bracket_has_points_where_its_longest_exposure_is_saturated(method):
    settings = SETTINGS.model_copy(update={"method": method})
    bright = 8 * IMAGER.full_well
    assert share_of_true_points(settings, bright, TIMES[-1:]) < 0.7
    assert share_of_true_points(settings, bright, TIMES) > 0.9


DOTS = RandomDots(kind="random_dots", run_length_px=2.0, bright_share=0.4, blur_px=0.5, seed=3)
ONE = Rig({"camera": RIG.cameras["left"]}, RIG.cameras["right"])
REFERENCE = reference_geometry(ONE, DOTS, DEPTH)


def off_plane_of_one_camera(settings: MatcherSettings, electrons: float, times: tuple[float, ...]):
    """Errors of the points of a plane at the depth of the reference [mm]; NaN without a point."""
    rng, light = np.random.default_rng(0), 0.1 + 0.9 * REFERENCE.reference / REFERENCE.reference.max()
    stack = np.stack([expose(electrons * light * time, IMAGER, None, Noise(), rng) for time in times])
    decoding = Decoding(exposure_s=times, black_level_dn=IMAGER.black_level, pattern=DOTS)
    capture = Capture("drawn", "reference_stereo", "simulated", ONE, {"camera": stack}, 8, decoding)
    return capture_cloud(capture, settings, REFERENCE).points[10:-10, 60:-20, 2] - DEPTH


@pytest.mark.parametrize("method", ["sgbm", "census", "correlation"])
@pytest.mark.parametrize("electrons", [800, 3000, 10000, 80000])
@pytest.mark.parametrize("ratio", [16, 128])
def test_a_bracket_of_one_camera_has_the_points_of_its_longest_exposure(method, electrons, ratio):
    """SGBM kept 7 % of the points of 3000 electrons, since levels of the shortest exposure were rounded to 8 bits."""
    settings = SETTINGS.model_copy(update={"method": method, "block_size": 5, "reference_mm": DEPTH})
    alone, merged = (off_plane_of_one_camera(settings, electrons, times) for times in ((1.0,), (1 / ratio, 1 / 4, 1.0)))
    shares = [np.mean(np.abs(each) < 0.01 * DEPTH) for each in (alone, merged)]
    assert shares[1] > shares[0] - 0.01
    assert shares[1] > 0.9 or electrons < 1000
    if method == "correlation" and electrons < IMAGER.full_well:
        assert np.nanstd(merged) < 1.1 * np.nanstd(alone)
