"""Regions of interest: what is read out of a capture, and that a part decodes as it does within the whole."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.scene.load import load_scene
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.smaller_sensors import middle_part, narrow_search

ROOT = Path(__file__).parents[2]
FRINGES = (ROOT / "tests/data/fringes.toml").read_text(encoding="utf-8")
LEFT = FRINGES[FRINGES.index("[cameras.camera]") : FRINGES.index("[projector]")]
RIGHT = LEFT.replace("cameras.camera", "cameras.right") + (
    "position_mm = [120.0, 1.0, 4.0]\nrotation_deg = [0.4, -11.0, -0.3]\n\n"
)
PATTERN = FRINGES[FRINGES.index("[pattern]") : FRINGES.index("[imager]")]
GRAY = '[pattern]\nkind = "gray_code"\naxis = "both"\n\n'
MIXED = '[pattern]\nkind = "gray_code_phase_shift"\nperiod_px = 16\nsteps = 4\n\n'
BRACKET = "[exposure]\nbracket = { count = 2, factor = 4 }\n"

#: what each is, and how far from the edge of a window its points are those of the whole image [px]
SENSORS = {
    "phase": 0,
    "gray": 0,
    "gray and phase": 0,
    "time of flight": 0,
    "sgbm": 8,
    "correlation of 4 frames": 0,
    "correlation of 1 frame": 0,
    "reference": 0,
    "two cameras": 0,
    "bracket": 0,
}

_FRAMES = [(0.0, 0.0), (9.0, 4.0), (18.0, 8.0), (27.0, 12.0)]


def sensor_of(kind: str, folder: Path):
    n10 = narrow_search(middle_part(load_sensor("ensenso-n10"), 560, 300), 450, 750)
    match kind:
        case "time of flight":
            return load_sensor("kinect-v2")
        case "reference":
            return narrow_search(middle_part(load_sensor("primesense-carmine-1.09"), 480, 300), 450, 750)
        case "sgbm":
            return n10
        case "correlation of 4 frames" | "correlation of 1 frame":
            shifts = _FRAMES if "4" in kind else _FRAMES[:1]
            matcher = n10.matcher.model_copy(update={"method": "correlation", "block_size": 7})
            return replace(n10, matcher=matcher, pattern=n10.pattern.model_copy(update={"shifts_px": shifts}))
    text = {
        "phase": FRINGES,
        "gray": FRINGES.replace(PATTERN, GRAY),
        "gray and phase": FRINGES.replace(PATTERN, MIXED),
        "bracket": FRINGES.replace("[exposure]\n", BRACKET),
        "two cameras": FRINGES.replace(LEFT, LEFT.replace("cameras.camera", "cameras.left") + RIGHT)
        + 'triangulate = "cameras"\n',
    }[kind]
    path = folder / "sensor.toml"
    path.write_text(text, encoding="utf-8")
    return middle_part(load_sensor(path), 440, 320)


class Shown:
    """A sensor that looks at the coupon askew."""

    def __init__(self, kind: str, folder: Path) -> None:
        self.sensor = sensor_of(kind, folder)
        self.geometry = sensor_geometry(self.sensor)
        self.simulated = SimulatedSensor(self.sensor)
        self.scene = load_scene(ROOT / "scenes/coupon/matt_white.xml", self.sensor.wavelength_nm)
        self.pose = look_at([150, -100, 560], [0, 0, 0], [0, 1, 0])
        self.corners = self.pose.inverse().points(60.0 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)]))

        self.captures: dict[tuple[bool, Noise | None], Capture] = {}  # which the tests of one sensor share

    def capture(self, around: bool = False, noise: Noise | None = None):
        if (around, noise) not in self.captures:
            corners = self.corners if around else None
            self.captures[around, noise] = self.simulated.capture(
                self.scene, self.pose, rendering=Rendering(samples=1), seed=4, around=corners, noise=noise
            )
        return self.captures[around, noise]

    def cloud(self, capture, roi=None):
        return capture_cloud(capture, self.sensor.settings, self.geometry, roi, self.sensor.imager)


@pytest.fixture(scope="module", params=SENSORS)
def shown(request, tmp_path_factory):
    one = Shown(request.param, tmp_path_factory.mktemp("sensor"))
    one.margin, one.kind = SENSORS[request.param], request.param
    return one


@pytest.fixture(scope="module")
def phase(tmp_path_factory):
    return Shown("phase", tmp_path_factory.mktemp("sensor"))


def test_a_window_has_the_bytes_of_the_whole_image(shown):
    capture = shown.capture()
    assert not capture.decoding.read_out
    whole = shown.cloud(capture)
    rows, columns = (np.flatnonzero(whole.valid.any(axis=axis)) for axis in (1, 0))
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(3):
        (top, bottom), (left, right) = (np.sort(rng.choice(each, 2, replace=False)) for each in (rows, columns))
        bottom, right = max(bottom, top + 24), max(right, left + 24)
        part = shown.cloud(capture, Roi.between(left, top, right, bottom))
        m = shown.margin
        inner = (slice(top + m, bottom - m), slice(left + m, right - m))
        compared += int(whole.valid[inner].sum())
        assert part.points[inner].tobytes() == whole.points[inner].tobytes()
        np.testing.assert_array_equal(part.status[inner] == Status.VALID, whole.status[inner] == Status.VALID)
        assert (part.sigma is None) == (whole.sigma is None)
        if whole.sigma is not None:
            assert part.sigma[inner].tobytes() == whole.sigma[inner].tobytes()
        beyond = np.ones(whole.valid.shape, bool)
        beyond[top:bottom, left:right] = False
        assert (part.status[beyond] == Status.NO_SURFACE).all()
        assert np.isnan(part.points[beyond]).all()
    assert compared > 500


def test_a_capture_around_the_coupon_is_read_out_and_decoded_there_only(shown, tmp_path):
    capture, none = shown.capture(True), Noise.none()
    parts = capture.decoding.read_out
    assert set(parts) == set(shown.sensor.rig.cameras)
    sharp, whole = shown.capture(True, none), shown.capture(False, none)
    for name, roi in parts.items():
        images = capture.images[name].copy()
        inner = np.s_[:, roi.top + 3 : roi.bottom - 3, roi.left + 3 : roi.right - 3]  # the blur reaches 2 px
        np.testing.assert_array_equal(sharp.images[name][inner], whole.images[name][inner])
        images[:, *roi.slices] = 0
        assert not images.any()
    cloud = shown.cloud(capture)
    corners = shown.geometry.grid.project(shown.corners)
    low, high = np.floor(corners.min(axis=0)) - 40, np.ceil(corners.max(axis=0)) + 40
    rows, columns = np.nonzero(cloud.valid)
    assert len(rows) > 300
    assert columns.min() >= low[0]
    assert columns.max() <= high[0]
    assert rows.min() >= low[1]
    assert rows.max() <= high[1]
    if shown.kind == "two cameras":
        write_capture(capture, tmp_path / "capture")
        again = shown.cloud(read_capture(tmp_path / "capture"))
        assert again.points.tobytes() == cloud.points.tobytes()


def test_without_noise_the_part_that_was_read_out_decodes_as_in_a_whole_capture(shown):
    none = Noise.none()
    part, whole = (shown.cloud(shown.capture(around, none)) for around in (True, False))
    corners = shown.geometry.grid.project(shown.corners)
    left, top = np.ceil(corners.min(axis=0)).astype(int) + shown.margin
    right, bottom = np.floor(corners.max(axis=0)).astype(int) - shown.margin
    inner = np.s_[top:bottom, left:right]
    assert whole.valid[inner].sum() > 300
    both = part.valid[inner] & whole.valid[inner]
    # a matcher's block reaches over the coupon's edge, and its rivals lie anywhere in the row
    assert both.sum() >= 0.99 * whole.valid[inner].sum()
    np.testing.assert_allclose(part.points[inner][both], whole.points[inner][both], rtol=2e-3)


def test_noise_within_the_part_is_that_of_the_imager(phase):
    """Of pixels that see past the coupon: read noise and the 1/12 DN^2 of quantisation.

    The standard deviation of n values is known to 1 / sqrt(2 n) of itself; the bound is five times that. Pixels are
    left out that any image shows 12 standard deviations over black: they see the coupon.
    """
    imager = phase.sensor.imager
    noise = Noise.only("read", "quantisation")
    images = phase.capture(True, noise).images["camera"].astype(float)
    roi = phase.capture(True).decoding.read_out["camera"]
    corner = images[:, roi.top : roi.top + 8, roi.left : roi.left + 40]  # beside the coupon, which stands askew
    most = imager.black_level + 12 * imager.gain * imager.read_noise
    dark = corner[:, corner.max(axis=0) < most]
    expected = np.sqrt((imager.gain * imager.read_noise) ** 2 + 1 / 12)
    assert dark.size > 3000
    assert np.isclose(dark.std(), expected, rtol=5 / np.sqrt(2 * dark.size))


def test_an_automatic_exposure_is_that_of_the_whole_image(tmp_path):
    rule = FRINGES[FRINGES.index("[exposure]") : FRINGES.index("[decoder]")]
    automatic = '[exposure]\nrule = "automatic"\nlevel = 0.8\npercentile = 97\nlimits_s = [1e-6, 1.0]\n\n'
    path = tmp_path / "automatic.toml"
    path.write_text(FRINGES.replace(rule, automatic), encoding="utf-8")
    sensor = load_sensor(path)
    simulated, scene = SimulatedSensor(sensor), load_scene(ROOT / "scenes/coupon/matt_white.xml", 460)
    pose = look_at([0, 0, 560], [0, 0, 0], [0, 1, 0])
    corners = pose.inverse().points(60.0 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)]))
    none = Noise.none()
    whole, part = (
        simulated.capture(scene, pose, rendering=Rendering(samples=1), seed=1, noise=none, **given)
        for given in ({}, {"around": corners})
    )
    assert part.decoding.exposure_s == pytest.approx(whole.decoding.exposure_s, rel=1e-6)


def test_a_window_beside_what_was_read_out_shows_nothing(shown):
    capture = shown.capture(True)
    cloud = shown.cloud(capture, Roi(0, 0, 30, 20))
    assert (cloud.status == Status.NO_SURFACE).all()
    assert not cloud.valid.any()


@pytest.mark.parametrize(
    ("read_out", "named"),
    [
        ({"eye": Roi(0, 0, 10, 10)}, "eye"),
        ({"camera": Roi(400, 0, 100, 10)}, "440 x 320"),
        ({"camera": Roi(0, -1, 10, 10)}, "440 x 320"),
        ({"camera": Roi(0, 0, 0, 10)}, "440 x 320"),
    ],
)
def test_a_region_that_cannot_be_is_refused(phase, read_out, named):
    capture = phase.capture(True)
    with pytest.raises(InputError, match=re.escape(named)):
        replace(capture, decoding=capture.decoding.model_copy(update={"read_out": read_out}))


@pytest.mark.parametrize("roi", [Roi(0, 0, 441, 10), Roi(10, 0, 0, 10), Roi(-1, 0, 11, 10)])
def test_a_window_outside_the_grid_is_refused(phase, roi):
    with pytest.raises(InputError, match="region of interest"):
        phase.cloud(phase.capture(True), roi)
