"""Validating captures of structured light: one camera and a projector, Gray code or fringes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.capture.decoding import Decoding
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.plan import coupon_pose
from mitsim.scene.test_targets import plate
from mitsim.sensor.camera import Rig
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift, patterns
from mitsim.sensor.preset import load_sensor
from mitsim.twin.compare.captures_run import validate_captures
from mitsim.twin.compare.plain_image import plain_image
from mitsim.twin.finish import find_specimen

SIZE, DISTANCE = 70.0, 500.0

#: rows that need two cameras, or dots
UNFIT = {"sigma in disparity", "vertical error", "contrast", "run length"}

GRAY = ImageSequence.model_validate(
    {
        "kind": "image_sequence",
        "images": [{"show": "gray", "inverse": "each"}, {"show": "black"}, {"show": "white"}],
    }
)
FRINGES = PhaseShift(kind="phase_shift", periods_px=[1280, 160, 20], steps=4)


@pytest.fixture(scope="module")
def david():
    """The preset with 400 x 320 pixels in the middle of its image, the same rays and light."""
    whole = load_sensor("david-sls-3")
    camera = whole.rig.reference
    column, row = (camera.width - 400) // 2, (camera.height - 320) // 2
    matrix = camera.matrix - [[0, 0, column], [0, 0, row], [0, 0, 0]]
    window = replace(camera, matrix=matrix, width=400, height=320)
    return replace(whole, rig=Rig({"camera": window}, whole.rig.projector))


def recorded(sensor, pattern, flux=1.0):
    """A capture of a white plate by a sensor of another code and power, as if a device had taken it."""
    projector = replace(sensor.projector, flux=flux * sensor.projector.flux)
    taker = SimulatedSensor(replace(sensor, pattern=pattern, projector=projector))
    pose = coupon_pose(np.array([0.1, 0.0, 0.995]), DISTANCE, np.array([0, 0, 1.0]))
    corners = SIZE / 2 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)])
    around = pose.inverse().points(corners)
    capture = taker.capture(plate(SIZE, "matt white", 550), pose, rendering=Rendering(samples=4), seed=1, around=around)
    made = capture.decoding
    kept = Decoding(exposure_s=made.exposure_s, read_out=made.read_out, pattern=made.pattern)
    return replace(capture, source="device", decoding=kept, settings={}, world_from_sensor=None)


@pytest.fixture(scope="module")
def gray(david):
    return recorded(david, GRAY)


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        (GRAY, "the white image"),
        (FRINGES, "the brightest levels of the code's images"),
    ],
)
def test_the_power_is_that_of_the_device_and_rows_that_do_not_apply_say_so(david, tmp_path, pattern, words):
    write_capture(recorded(david, pattern, flux=0.7), tmp_path / "real")
    found = validate_captures(tmp_path / "real", None, tmp_path / "out", None, None, None, 5)
    twin = read_capture(tmp_path / "out" / "simulated")
    assert len(twin.images["camera"]) == len(read_capture(tmp_path / "real").images["camera"])
    power = twin.settings["rebuilt"]["power_times_reflectance_w"]
    assert power == pytest.approx(0.7 * 0.85 * david.projector.flux, rel=0.03)
    rows = {row.quantity: row for row in found.comparison.rows}
    for quantity in UNFIT:
        assert rows[quantity].verdict == "does not apply"
        assert np.isnan([rows[quantity].real, rows[quantity].simulated, rows[quantity].margin]).all()
    assert rows["median grey level"].simulated == pytest.approx(rows["median grey level"].real, rel=0.03)
    for quantity in ("F", "sigma, median", "distance"):
        assert rows[quantity].verdict == "agrees", rows[quantity]
    assert f"Grey levels are those of {words}." in found.preamble
    assert "nan" not in found.table.lower()
    stored = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert {row["quantity"] for row in stored["rows"] if row["verdict"] == "does not apply"} == UNFIT


@pytest.mark.parametrize(
    "code",
    [
        GRAY,
        GrayCode(kind="gray_code", inverse=True, white_black=False),
        GrayCode(kind="gray_code", white_black=True),
        GrayCodePhaseShift(kind="gray_code_phase_shift", period_px=16, steps=4, white_black=True),
    ],
)
def test_the_plain_image_of_a_gray_code_is_lit_all_over(david, gray, code):
    """A bit and its inverse light every pixel once, and white lights all: their brightest is 1 everywhere."""
    capture = replace(gray, decoding=Decoding(pattern=code))
    shown = patterns(code, david.projector.optics.width, david.projector.optics.height)
    plain = plain_image(capture)
    np.testing.assert_array_equal(plain.of(shown), 1.0)
    assert not plain.has_dots


def test_the_plain_image_of_fringes_is_near_their_crest(david, gray):
    """Of N shifts one lies within pi / N of the crest: at least mean + contrast cos(pi / N)."""
    capture = replace(gray, decoding=Decoding(pattern=FRINGES))
    shown = patterns(FRINGES, david.projector.optics.width, david.projector.optics.height)
    level = plain_image(capture).of(shown)
    assert level.min() >= FRINGES.mean + FRINGES.contrast * np.cos(np.pi / 4) - 1e-6
    assert level.max() <= FRINGES.mean + FRINGES.contrast + 1e-6


@pytest.fixture(scope="module")
def folder(gray, tmp_path_factory):
    return write_capture(gray, tmp_path_factory.mktemp("captures") / "real")


def test_structured_light_without_its_projector_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match=r"--projector: found off; allowed: on: .* is structured light"):
        validate_captures(folder, None, tmp_path, None, None, "off", 1)


def test_a_saturated_specimen_is_refused(gray, tmp_path):
    white, stack = plain_image(gray).images[0], gray.images["camera"].copy()
    stack[white][stack[white] > 40] = 255
    real = write_capture(replace(gray, images={"camera": stack}), tmp_path / "real")
    with pytest.raises(InputError, match=r"a median grey level of 255 .* in the white image; allowed: under 255"):
        validate_captures(real, None, tmp_path / "out", None, None, None, 1)


@pytest.mark.parametrize("flat", [True, False])
def test_a_window_without_a_plane_that_can_be_seen_is_one_message(david, folder, monkeypatch, rng, flat):
    """Points on a plane through the eye, or strewn at random along their rays, as a wrong calibration leaves them."""
    capture = read_capture(folder)
    camera = capture.rig.reference
    rays = camera.rays(camera.pixel_grid())
    points = (rays * rng.uniform(200, 4000, rays.shape[:2])[..., None]).astype(np.float32)
    if flat:
        points[..., 1] = 0.02 * points[..., 2]
    grid = ViewGrid(2048.0, 2048.0, 199.5, 159.5, 400, 320)
    cloud = PointCloud(
        points, np.full(points.shape[:2], Status.VALID, np.uint8), grid, "s", "device", np.array([1.0, 0, 0])
    )
    monkeypatch.setattr(find_specimen, "capture_cloud", lambda *args, **kwargs: cloud)
    with pytest.raises(
        InputError,
        match=r"--window: found .* points are seen at grazing incidence from the sensor, .*; allowed: a plane",
    ):
        find_specimen.find_specimen(capture, david.settings, Roi(20, 20, 300, 200), "real")
