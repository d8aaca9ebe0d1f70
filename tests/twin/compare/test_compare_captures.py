"""A capture against others of the same plane: alike but for the seed, and with one thing changed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.scene.test_targets import plate
from mitsim.sensor.fitted_to import FittedCapture, images_digest
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from mitsim.twin.compare import captures_run
from mitsim.twin.compare import compare_captures as compare_module
from mitsim.twin.compare.captures_run import validate_captures
from mitsim.twin.compare.compare_captures import compare_captures
from mitsim.twin.compare.compared_quantities import QUANTITIES
from mitsim.twin.compare.rebuild import check_technology, projector_was_on, rebuild
from mitsim.twin.compare.specimen_patches import PATCH_PX, specimen_patches
from mitsim.twin.finish.electrons import linearised, pixel_noise
from mitsim.twin.finish.find_specimen import find_specimen, image_mask
from tests.smaller_sensors import narrow_search

SIZE, DISTANCE = 190.0, 480.0

#: figures that a change of what is named on the left must move
MOVED = {
    "blur": {"contrast"},
    "power": {"median grey level", "grey levels, distance"},
    "noise": {"finest detail"},
}


def pose(sensor):
    """12 deg off the plate's normal, the plate in the middle of the image."""
    eye = DISTANCE * np.array([0.0, -np.sin(np.radians(12)), np.cos(np.radians(12))])
    return look_at(eye, np.zeros(3), (0.0, 1.0, 0.0)) @ sensor.rig.reference.sensor_from_camera.inverse()


def taken(sensor, seed):
    corners = SIZE / 2 * np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)])
    around = pose(sensor).inverse().points(corners)
    scene = plate(SIZE, "matt white", sensor.wavelength_nm)
    return SimulatedSensor(sensor).capture(
        scene, pose(sensor), rendering=Rendering(samples=4), seed=seed, around=around
    )


def fitted_capture(name, capture):
    return FittedCapture(name=name, images_sha256=images_digest(capture.images))


def as_recorded(capture):
    """The same as if a device had taken it: no pose, nothing of how it was rendered."""
    kept = Decoding(exposure_s=capture.decoding.exposure_s, read_out=capture.decoding.read_out)
    records = {"projector_on": True}
    return replace(capture, source="device", decoding=kept, settings=records, world_from_sensor=None)


@pytest.fixture(scope="module")
def n10_module():
    """The N10 with lenses that do not distort, and a search about the plate: both take most of the time otherwise."""
    from mitsim.sensor.preset import load_sensor

    sensor = narrow_search(load_sensor("ensenso-n10"), 400, 560)
    cameras = {name: replace(camera, distortion=np.zeros(5)) for name, camera in sensor.rig.cameras.items()}
    return replace(sensor, rig=replace(sensor.rig, cameras=cameras))


@pytest.fixture(scope="module")
def real(n10_module):
    return as_recorded(taken(n10_module, 1))


@pytest.fixture(scope="module")
def specimen(n10_module, real):
    return find_specimen(real, n10_module.settings, None, "real")


@pytest.fixture(scope="module")
def again(n10_module):
    """The same, with another seed."""
    return taken(n10_module, 2)


@pytest.fixture(scope="module", autouse=True)
def patches_of_real(real, specimen):
    """The patches of the recorded capture are those of its first comparison."""
    of_any, of_real = compare_module.specimen_patches, {}

    def once(capture, settings, geometry, at, window_px):
        if capture is not real or at is not specimen:
            return of_any(capture, settings, geometry, at, window_px)
        if window_px not in of_real:
            of_real[window_px] = of_any(capture, settings, geometry, at, window_px)
        return of_real[window_px]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare_module, "specimen_patches", once)
        yield


@pytest.fixture(scope="module")
def changed(n10_module):
    """Sensors with one thing changed."""
    one, imager = n10_module, n10_module.imager
    return {
        # all three blurs of a dot on the image: of the lens, of the mask, and by defocus, which is small here
        "blur": replace(
            one,
            imager=replace(imager, blur_px=2 * imager.blur_px),
            pattern=one.pattern.model_copy(update={"blur_px": 2 * one.pattern.blur_px}),
        ),
        "power": replace(one, projector=replace(one.projector, flux=one.projector.flux / 2)),
        # a quarter of the well at the same grey level: every source is twice as many DN
        "noise": replace(
            one,
            linewidth_nm=None,
            imager=replace(
                imager,
                full_well=imager.full_well / 4,
                read_noise=imager.read_noise / 2,
                dsnu=imager.dsnu / 2,
                prnu=2 * imager.prnu,
                row_noise=imager.row_noise / 2,
                quantum_efficiency=imager.quantum_efficiency / 4,
            ),
        ),
    }


def compared(real, other, specimen, sensor):
    return compare_captures(real, other, specimen, sensor.settings, "simulated")


def rows(comparison):
    return {row.quantity: row for row in comparison.rows}


def test_a_plate_is_found_where_it_stands(n10_module, specimen):
    truth = pose(n10_module).inverse()  # sensor from world: where the plate's frame lies
    found = specimen.world_from_sensor.inverse()
    # 230 mm plate, some 4 10^4 points of 0.3 mm noise: angle to 0.3 / (66 sqrt(4e4 / A)) rad, A = 30 px^2, 1e-4; the
    # plate's own plane is seen at 0.1 mm
    assert found.rotation[:, 2] @ truth.rotation[:, 2] > np.cos(np.radians(0.1))
    assert abs((found.translation - truth.translation) @ truth.rotation[:, 2]) < 0.15


def test_all_of_a_named_window_is_specimen(n10_module, real, specimen):
    part = Roi(250, 150, 200, 150)
    named = find_specimen(real, n10_module.settings, part, "real")
    mask = image_mask(named, real.rig.reference)
    wanted = np.zeros_like(mask)
    wanted[150:300, 250:450] = True
    # cells of 1/120 of the window: its rim is one cell wide
    assert np.count_nonzero(mask ^ wanted) < 2 * (200 + 150) * 200 / 120 * 1.5
    normals = [each.world_from_sensor.inverse().rotation[:, 2] for each in (named, specimen)]
    assert normals[0] @ normals[1] > np.cos(np.radians(0.1))


def test_the_same_plate_with_another_seed_agrees(n10_module, real, specimen, again):
    found = compared(real, again, specimen, n10_module)
    told = {name: (row.difference, row.uncertainty) for name, row in rows(found).items() if row.verdict == "differs"}
    assert not told
    assert found.agrees
    assert rows(found)["F"].real > 0.9
    assert rows(found)["sigma in disparity"].real == pytest.approx(0.12, abs=0.04)  # docs/explanation/light.md


@pytest.mark.parametrize("change", MOVED)
def test_a_change_shows_in_the_right_quantity(n10_module, real, specimen, changed, change):
    if change == "noise":  # beside speckle, which is grain of every pixel too, it would not stand out
        real = as_recorded(taken(replace(n10_module, linewidth_nm=None), 1))
    found = rows(compared(real, taken(changed[change], 2), specimen, n10_module))
    differing = {name for name, row in found.items() if row.verdict == "differs"}
    assert MOVED[change] <= differing
    for name in differing & {"contrast", "finest detail", "run length", "sigma in disparity"}:  # by their ratio
        assert f"real is {found[name].real / found[name].simulated:.2g} times simulated" in found[name].why
    others = set().union(*(names for other, names in MOVED.items() if other != change)) - MOVED[change]
    if change == "power":  # a ratio does not know it
        assert "contrast" not in differing or found["contrast"].difference < 0
        assert found["median grey level"].simulated == pytest.approx(found["median grey level"].real / 2, abs=4)
    elif change == "noise":
        # the dots' own edges stay, so squares are compared: twice the noise n adds 3 n^2. n is EMVA's, and that of some
        # level between the dark and the bright of the dots
        imager, inside = n10_module.imager, image_mask(specimen, real.rig.reference, 15)
        levels = np.percentile(real.images["left"][0][inside], [10, 90])
        variance = pixel_noise(imager, imager, 1, real.decoding.exposure_s, False).variance(linearised(levels, imager))
        added = np.sqrt((found["finest detail"].simulated ** 2 - found["finest detail"].real ** 2) / 3)
        assert imager.gain * np.sqrt(variance[0]) < added < imager.gain * np.sqrt(variance[1])
        assert "median grey level" in others - differing
    else:
        assert found["contrast"].simulated < found["contrast"].real
        assert "median grey level" in others - differing


def test_finest_detail_is_the_standard_deviation_of_white_noise(n10_module, real, specimen, rng):
    noisy = {
        name: rng.normal(120.0, 6.0, stack.shape).clip(0, 255).round().astype(np.uint8)
        for name, stack in real.images.items()
    }
    seen = specimen_patches(replace(real, images=noisy), n10_module.settings, stereo_geometry(real.rig), specimen, 15)
    # quantisation adds 1/12; of some 15000 pixels 25 weights leave a tenth independent: a median to 1.2 / sqrt(1500)
    assert np.median(seen.finest) == pytest.approx(np.hypot(6.0, np.sqrt(1 / 12)), rel=3 * 0.031)
    # of a window of 15 x 15: sqrt(224 / 225) of the deviation, over the mean
    assert np.mean(seen.contrast) == pytest.approx(6.0 / 120.0, rel=0.02)
    # noise crosses its mean every second pixel
    assert seen.pixels.sum() / seen.crossings.sum() == pytest.approx(2.0, rel=0.03)


def test_rows_of_the_right_image_that_are_off_are_found(n10_module, real, specimen, again):
    """The right camera's principal point 0.4 px too high in the calibration that is decoded with."""
    other = again
    right = other.rig.cameras["right"]
    matrix = right.matrix + np.array([[0, 0, 0], [0, 0, 0.4], [0, 0, 0]])
    rig = replace(other.rig, cameras={**other.rig.cameras, "right": replace(right, matrix=matrix)})
    row = rows(compared(real, replace(other, rig=rig), specimen, n10_module))["vertical error"]
    # Bouguet's rectification keeps the scale: what is 0.4 px in the raw image is so in the rectified one
    assert row.verdict == "differs"
    assert abs(row.simulated) == pytest.approx(0.4, abs=0.08)
    assert abs(row.real) < 0.03


def test_a_simulated_capture_whose_calibration_gives_other_patches_is_refused(n10_module, real, specimen, again):
    """Before, "found 29 patches; allowed: 6 or more", or a ValueError of NumPy."""
    left = again.rig.reference
    for share in (0.8, 0.5):
        other = replace(left, matrix=left.matrix * np.array([[share], [share], [1.0]]))
        rig = replace(again.rig, cameras={**again.rig.cameras, "left": other})
        with pytest.raises(InputError, match=r"twin: calibration: found \d+ patches .*; allowed: that of REAL"):
            compare_captures(real, replace(again, rig=rig), specimen, n10_module.settings, "twin")


def test_a_rebuilt_capture_is_as_bright_and_agrees(n10_module, changed, tmp_path):
    dim = replace(n10_module, projector=replace(n10_module.projector, flux=0.7 * n10_module.projector.flux))
    recorded = as_recorded(taken(dim, 3))
    write_capture(recorded, tmp_path / "real")
    found = CliRunner().invoke(app, ["compare", str(tmp_path / "real"), "-o", str(tmp_path / "out"), "--seed", "5"])
    assert found.exit_code == 0, found.output
    twin = read_capture(tmp_path / "out" / "simulated")
    assert twin.source == "simulated"
    # the plate reflects 0.85; its median level is known to half a level of 60
    assert twin.settings["rebuilt"]["power_times_reflectance_w"] == pytest.approx(0.7 * 0.85, rel=0.03)
    table = json.loads((tmp_path / "out" / "comparison.json").read_text())
    verdicts = {row["quantity"]: row["verdict"] for row in table["rows"]}
    assert verdicts["median grey level"] == "not comparable"
    assert verdicts["sigma, median"] == verdicts["F"] == verdicts["contrast"] == "agrees"
    page = (tmp_path / "out" / "index.md").read_text()
    assert "side_by_side.png" in page
    assert "| F |" in found.stdout
    assert (tmp_path / "out" / "side_by_side.png").stat().st_size > 10_000


def test_a_comparison_with_the_capture_of_the_fit_says_so(n10_module, real, again, tmp_path):
    """Before, a sensor that was fitted to a capture agreed with it without a word."""
    mine = replace(n10_module, name="mine", fitted_to=(fitted_capture("sheet", real),))
    write_capture(as_recorded(real), tmp_path / "real")
    write_capture(as_recorded(again), tmp_path / "again")
    write_capture(taken(mine, 7), tmp_path / "twin")
    told = []
    for name in ("real", "again"):
        arguments = ["compare", *(str(tmp_path / one) for one in (name, "twin")), "-o", str(tmp_path / f"out_{name}")]
        found = CliRunner().invoke(app, arguments)
        page = (tmp_path / f"out_{name}" / "index.md").read_text()
        stored = json.loads((tmp_path / f"out_{name}" / "comparison.json").read_text())["fitted"]
        assert ("mine was fitted to these images (sheet)" in page) == (stored in found.stderr and stored != "")
        told.append(stored)
    assert "shows the fit, not a prediction" in told[0]
    assert told[1] == ""


def test_a_texture_stands_in_where_the_projector_was_off(n10_module, real, specimen):
    twin = rebuild(real, n10_module, specimen, "real", projector_on=False, seed=4)
    found = rows(compare_captures(real, twin, specimen, n10_module.settings, "twin", projector_on=False))
    assert found["contrast"].verdict == "not comparable"
    # lens and pixels blurred the recording already; a second time would take a sixth of the contrast of these dots
    assert found["contrast"].simulated == pytest.approx(found["contrast"].real, rel=0.08)
    inside = image_mask(specimen, real.rig.reference, 15)
    ours, theirs = (each.images["left"][0][inside].astype(float) for each in (real, twin))
    # the texture lies where it was seen: a shift of 2 px, or a turned image, would leave nothing of this
    assert np.corrcoef(ours, theirs)[0, 1] > 0.8
    assert found["F"].simulated > 0.9


def test_what_needs_a_pattern_is_not_compared_where_one_had_none(n10_module, real, specimen, again):
    found = compare_captures(real, again, specimen, n10_module.settings, "twin", projector_on=False)
    for quantity in QUANTITIES:
        row = rows(found).get(quantity.name)
        if row is not None and quantity.needs_pattern:
            assert (row.verdict, row.why) == ("not comparable", "the projector was off in REAL")
    assert rows(found)["finest detail"].verdict == "agrees"


def test_an_uncertainty_of_rounding_is_none():
    """Draws that all give 0.9 have a standard deviation of 10^-16, by rounding of their mean, and not 7 10^15 u."""

    def constant(patches, picked):
        return np.full(len(picked), 0.9 if patches.source == "simulated" else 0.0)

    class Seen:
        def __init__(self, source):
            self.source = source

    quantity = replace(QUANTITIES[0], figure=constant, margin=0.0, factor=1.0)
    (row,) = compare_module._row(quantity, Seen("device"), Seen("simulated"), 400, {}, np.random.default_rng(1))
    assert (row.uncertainty, row.verdict, row.why) == (0.0, "differs", "by more than the margin")


@pytest.fixture(scope="module")
def folder(real, tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "real"
    write_capture(replace(real, sensor="MY-SENSOR"), path)
    return path


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((None, None, None, None), r"--sensor: found none, and .* comes from MY-SENSOR"),
        # before the capture is decoded, which finds no plane in this window
        ((None, "kinect-v2", Roi(0, 0, 20, 20), None), "--sensor: technology: found kinect-v2 of time_of_flight"),
        ((None, "ensenso-n10", Roi(700, 0, 200, 100), None), r"--window: found \[700, 0, 200, 100\]"),
        ((None, "ensenso-n10", Roi(0, 0, 20, 20), None), r"--window: found 0 points in \[0, 0, 20, 20\]"),
        (("itself", None, None, None), "source: found device; allowed: simulated"),
    ],
)
def test_bad_input_is_one_message(folder, tmp_path, arguments, told):
    simulated, sensor, window, projector = arguments
    other = folder if simulated == "itself" else None
    with pytest.raises(InputError, match=told):
        validate_captures(folder, other, tmp_path, sensor, window, projector, 1)


def test_a_pair_of_which_nobody_says_whether_dots_were_on_is_asked_about(real):
    """Pairs of other programs: rebuilt with dots, or with the specimen's own texture?"""
    unsaid = replace(real, settings={key: value for key, value in real.settings.items() if key != "projector_on"})
    with pytest.raises(InputError, match=r"mine/settings.json: projector_on: found nothing.*--projector on or off"):
        projector_was_on(unsaid, None, "mine")
    assert projector_was_on(unsaid, "on", "mine")
    assert not projector_was_on(replace(unsaid, settings={"projector_on": False}), None, "mine")
    assert projector_was_on(replace(unsaid, technology="structured_light"), None, "mine")


def test_a_capture_that_mitsim_rendered_needs_another_to_compare_with(n10_module, tmp_path):
    pose = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])
    around = 20.0 * np.array([[0, 0, 25], [1, 0, 25], [0, 1, 25]])
    capture = SimulatedSensor(n10_module).capture(
        plate(80, "matt white", 850), pose, rendering=Rendering(samples=1), seed=1, around=around
    )
    path = write_capture(capture, tmp_path / "ours")
    with pytest.raises(InputError, match=r"a simulation of mitsim; .* name SIMULATED"):
        validate_captures(path, None, tmp_path, None, None, None, 1)


def test_a_simulated_capture_of_another_place_is_refused(n10_module, real, specimen):
    near = replace(
        specimen,
        world_from_sensor=replace(
            specimen.world_from_sensor, translation=specimen.world_from_sensor.translation * np.array([1.0, 1.0, 0.9])
        ),
    )
    with pytest.raises(InputError, match=r"twin: pose: found a specimen .* % nearer or farther"):
        compared_twin = rebuild(real, n10_module, near, "real")
        compare_captures(real, compared_twin, specimen, n10_module.settings, "twin")


def test_a_specimen_of_few_patches_is_refused(n10_module, real, specimen, again):
    small = replace(specimen, occupied=np.zeros_like(specimen.occupied))
    small.occupied[:2, :2] = True
    with pytest.raises(InputError, match=rf"REAL: specimen: found 0 patches of {PATCH_PX} px"):
        compare_captures(real, again, small, n10_module.settings, "twin")


def test_a_projector_is_on_or_off(folder, tmp_path):
    found = CliRunner().invoke(app, ["compare", str(folder), "-o", str(tmp_path), "--projector", "dim"])
    assert found.exit_code != 0
    assert isinstance(found.exception, InputError)


def test_a_cloud_of_the_device_says_how_to_compare_clouds():
    """No preset is of the technology of a cloud."""
    sensor = load_sensor("realsense-d435")
    cloud = Capture("mine", "point_map", "device", sensor.rig, {})
    with pytest.raises(InputError, match="measure acceptance CLOUD --plane NAME --simulated realsense-d435"):
        check_technology(cloud, sensor, "captures/mine")


def test_the_decoder_of_the_simulated_sensor_decodes_both_captures(n10_module, real, tmp_path, monkeypatch):
    """A recording that states no decoder was decoded by the default matcher, whatever the sensor's."""
    strict = replace(n10_module, matcher=n10_module.matcher.model_copy(update={"minimum_contrast_dn": 25.0}))
    monkeypatch.setattr(captures_run, "sensor_of", lambda *_: strict)
    path = write_capture(replace(real, sensor="MY-SENSOR"), tmp_path / "real")
    found = validate_captures(path, None, tmp_path / "out", "strict", None, None, 1)
    assert f"Decoder of both: 400 to 560 mm; settings of {strict.name}." in found.preamble
    shares = {row.quantity: row for row in found.comparison.rows}["share low_modulation"]
    specimen = find_specimen(real, strict.settings, None, "real")
    status = capture_cloud(real, strict.settings).status[image_mask(specimen, real.rig.reference, 15)]
    assert shares.real == pytest.approx(np.mean(status == Status.LOW_MODULATION), abs=0.05)
    assert shares.real > 0.2 and shares.simulated > 0.2
    given = validate_captures(path, tmp_path / "out" / "simulated", tmp_path, None, None, "on", 1)
    rows = {row.quantity: row for row in given.comparison.rows}
    assert rows["share low_modulation"].real == shares.real
    assert "settings of ensenso-n10" in given.preamble


def test_a_recording_of_other_images_than_the_sensor_takes_keeps_its_decoder(n10_module, real):
    """The N35 correlates four shifted patterns: on one of them its matcher has 9.3 mm of noise, the other 0.26 mm."""
    pattern = n10_module.pattern.model_copy(update={"shifts_px": [(0.0, 0.0), (9.0, 4.0)]})
    shifted = replace(n10_module, pattern=pattern, matcher=n10_module.matcher.model_copy(update={"block_size": 3}))
    settings, _, words = captures_run._decoder(real, None, shifted, True)
    assert settings.block_size != 3
    assert "that of the recording" in words and "that of ensenso-n10 is for 2 images, and the recording has 1" in words
    one = replace(shifted, pattern=n10_module.pattern)
    assert captures_run._decoder(real, None, one, True)[0].block_size == 3
    settings, _, words = captures_run._decoder(real, None, one, False)
    assert settings.block_size != 3 and "that of ensenso-n10 is for images with the projector on" in words
