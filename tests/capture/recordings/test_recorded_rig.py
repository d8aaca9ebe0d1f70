"""Sensor files of rigs that exist: the smallest that import and decode take, and what simulation says to them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import mitsim as ms
from characterisation.cloud_files import read_cloud
from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.image_folder import read_image_folder
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import load_sensor, named_sensor, presets
from mitsim.sensor.transforms import Transform
from tests.simulated_rigs import images_seen, save_calibration, save_images, surface_seen

SCENES = Path(__file__).parents[3] / "scenes"
HOW_TO = Path(__file__).parents[3] / "docs/how-to/import-a-rig.md"

TURN = Transform.from_degrees([0.5, -12.0, 0.3], [100.0, 3.0, 5.0])
CAMERA = Camera(np.array([[150.0, 0, 63.1], [0, 150, 47.4], [0, 0, 1]]), np.array([-0.1, 0.03, 0, 0, 0]), 128, 96)
PROJECTOR = Camera(np.array([[190.0, 0, 79.5], [0, 190, 63.5], [0, 0, 1]]), np.zeros(5), 160, 128, TURN)


def smallest() -> str:
    """The whole file that the how-to shows."""
    return re.findall(r"<!-- whole: smallest -->\n```toml\n(.*?)^```", HOW_TO.read_text(encoding="utf-8"), re.S | re.M)[
        0
    ]


def written(folder: Path, text: str) -> Path:
    """The sensor file and its calibration."""
    R = TURN.rotation.T
    save_calibration(
        folder / "calib.yml",
        camera_matrix=CAMERA.matrix,
        distortion_coefficients=CAMERA.distortion,
        image_size=[CAMERA.width, CAMERA.height],
        projector_matrix=PROJECTOR.matrix,
        projector_size=[PROJECTOR.width, PROJECTOR.height],
        R=R,
        T=-R @ TURN.translation,
    )
    (folder / "my.toml").write_text(text, encoding="utf-8")
    return folder / "my.toml"


def run(*arguments: object):
    done = CliRunner().invoke(app, [str(each) for each in arguments])
    assert done.exit_code == 0, done.output
    return done


def test_the_smallest_file_of_the_how_to_imports_and_decodes_at_the_first_try(tmp_path):
    file = written(tmp_path, smallest())
    truth = surface_seen(CAMERA)
    save_images(tmp_path / "images", images_seen(load_sensor(file, "decoding").pattern, CAMERA, PROJECTOR, truth))
    run("import", tmp_path / "images", "--sensor", file, "-o", tmp_path / "capture")
    done = run("decode", tmp_path / "capture", "-o", tmp_path / "cloud.ply")
    assert "50 to 20000 mm" in done.output
    assert "sigma of the points: that of a uniform error over the width of a stripe" in done.output
    cloud = read_cloud(tmp_path / "cloud.ply")
    assert cloud.valid.mean() > 0.8
    off = np.linalg.norm(cloud.points - truth, axis=-1)[cloud.valid]
    assert np.median(off) < 4 < 20 > np.percentile(off, 99)  # a stripe of 1 px is worth 12 mm
    assert np.nanmedian(cloud.sigma[cloud.valid]) > 1


def test_simulation_names_all_that_it_needs_at_once(tmp_path):
    with pytest.raises(InputError, match="simulation needs them") as caught:
        load_sensor(written(tmp_path, smallest()))
    lacking = caught.value.field.split(", ")
    assert {"wavelength_nm", "working_range_mm", "projector.flux_w", "exposure.rule"} < set(lacking)
    assert {f"imager.{key}" for key in ("pixel_um", "full_well_e", "read_noise_e", "f_number")} < set(lacking)
    # and that was all: with each of them the file is a sensor
    more = "wavelength_nm = 500\nworking_range_mm = [300, 900]\n[projector]\nflux_w = 1\n"
    more += '[exposure]\nrule = "fixed"\nexposure_s = 0.1\n[decoder]\nnear_mm = 300\nfar_mm = 900\n[imager]\n'
    more += "".join(f"{key.partition('.')[2]} = 0.5\n" for key in lacking if key.startswith("imager."))
    named = re.match(r"name = .*\ntechnology = .*\n", smallest())[0]
    whole = named + more + smallest().removeprefix(named)
    assert load_sensor(written(tmp_path, whole)).wavelength_nm == 500


@pytest.mark.parametrize(
    ("text", "lacking"),
    [
        ("", ["name", "technology", "cameras"]),
        (
            'technology = "structured_light"\n[cameras.left]\nwidth = 640\n[pattern]\nkind = "gray_code"\n',
            [
                "name",
                "cameras.left.height",
                "cameras.left.focal_px",
                "cameras.left.principal_px",
                "projector.width",
                "projector.height",
                "projector.focal_px",
                "projector.principal_px",
            ],
        ),
    ],
)
def test_all_that_a_rig_lacks_comes_in_one_message(tmp_path, text, lacking):
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_sensor(tmp_path / "my.toml", "decoding")
    assert set(lacking) <= set(caught.value.field.split(", "))
    assert not {each for each in caught.value.field.split(", ") if each.startswith(("imager", "exposure", "wave"))}


@pytest.mark.parametrize(
    ("text", "lacking"),
    [
        ("", {"name", "technology", "pattern.kind"}),
        ('technology = "structured_light"\n[calibration]\nfile = "c.yml"\n', {"name", "pattern.kind"}),
    ],
)
def test_import_names_all_that_is_missing_before_a_calibration_is_read(tmp_path, text, lacking):
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        named_sensor(tmp_path / "my.toml")
    assert lacking <= set(caught.value.field.split(", "))
    assert ("cameras" in caught.value.field) == (not text)


def test_a_misspelt_key_is_told_first_and_what_is_missing_beside_it(tmp_path):
    text = smallest().replace('name = "my-rig"\n', "") + "[imager]\nfull_wel_e = 1000\n"
    with pytest.raises(InputError, match=r"did you mean 'full_well_e'.*Also missing: name") as caught:
        load_sensor(written(tmp_path, text), "decoding")
    assert caught.value.field == "imager.full_wel_e"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('show = "white"', 'show = "whit"', r"pattern.images.2.show: found 'whit'; allowed: 'white', .*mean 'white'"),
        ('kind = "image_sequence"', 'kind = "sequence"', r"pattern.kind: found 'sequence'; .*mean 'image_sequence'"),
        ("calib.yml", "calibration.yml", r"calibration.yml: found no such file.*did you mean 'calib.yml'"),
        ("calib.yml", "mine.npz", r"mine.npz: found no such file.*the folder has: calib.yml"),
    ],
)
def test_a_misspelt_kind_or_file_names_the_nearest(tmp_path, old, new, told):
    with pytest.raises(InputError, match=told):
        load_sensor(written(tmp_path, smallest().replace(old, new)), "decoding", (CAMERA.width, CAMERA.height))


@pytest.mark.parametrize("name", presets())
def test_a_complete_sensor_is_the_same_rig(name):
    sensor = load_sensor(name, "decoding")
    for purpose in ("simulation", "decoding", "noise", "bits"):
        assert sensor.missing_for(purpose) == ()
    assert repr(sensor) == repr(load_sensor(name))
    assert sensor.described_imager == sensor.imager


def test_a_rig_names_what_each_purpose_lacks_and_the_simulation_refuses_it(tmp_path):
    rig = load_sensor(written(tmp_path, smallest() + "[imager]\npixel_um = 3.45\nf_number = 8\n"), "decoding")
    assert rig.missing_for("decoding") == ()
    with pytest.raises(InputError, match="purpose: found 'decode'; allowed: simulation, decoding"):
        rig.missing_for("decode")
    assert rig.missing_for("bits") == ("imager.bits",)
    assert rig.missing_for("noise") == ("imager.quantum_efficiency", "imager.full_well_e", "imager.read_noise_e")
    assert set(rig.missing_for("noise")) < set(rig.missing_for("simulation"))
    with pytest.raises(InputError, match="simulation needs them") as caught:
        SimulatedSensor(rig)
    assert caught.value.field == ", ".join(rig.missing_for("simulation"))
    pair = 'name = "pair"\ntechnology = "active_stereo"\n' + "".join(
        f"[cameras.{name}]\nwidth = 640\nheight = 480\nfocal_px = [500, 500]\nprincipal_px = [320, 240]\n{place}"
        for name, place in (("left", ""), ("right", "position_mm = [60, 0, 0]\n"))
    )
    (tmp_path / "pair.toml").write_text(pair, encoding="utf-8")
    stereo = load_sensor(tmp_path / "pair.toml", "decoding")
    assert (stereo.rig.projector, stereo.pattern, stereo.range_mm) == (None, None, None)
    with pytest.raises(InputError, match="pattern: found nothing"):
        stereo.patterns()
    assert {"projector.width", "projector.focal_px", "pattern.kind", "matcher.near_mm"} <= set(
        stereo.missing_for("simulation")
    )


def test_what_was_completed_is_nobodys(tmp_path):
    """No imager, no exposure, no range, no projector of ours is taken for the rig's."""
    text = smallest() + "[imager]\nbits = 12\nblack_level_dn = 64\n"
    rig = load_sensor(written(tmp_path, text), "decoding")
    assert (rig.bits, rig.imager.black_level, rig.described_imager) == (12, 64, None)
    assert (rig.exposure.base_s, rig.range_mm) == (None, None)
    rig = load_sensor(written(tmp_path, text + '[exposure]\nrule = "fixed"\nexposure_s = 0.02\n'), "decoding")
    assert rig.exposure.base_s == 0.02
    ranged = smallest() + "[decoder]\nnear_mm = 200\nfar_mm = 800\n"
    assert load_sensor(written(tmp_path, ranged), "decoding").range_mm == (200, 800)


def test_fringes_without_an_imager_have_the_sigma_of_their_own_noise_and_decode_says_so(tmp_path):
    text = smallest().partition("[pattern]")[0] + '[pattern]\nkind = "phase_shift"\nperiods_px = [170, 16]\n'
    file = written(tmp_path, text + '[exposure]\nrule = "fixed"\nexposure_s = 0.02\n')
    stack = images_seen(load_sensor(file, "decoding").pattern, CAMERA, PROJECTOR, surface_seen(CAMERA), full=4095)
    save_images(tmp_path / "images", stack)
    done = run("import", tmp_path / "images", "--sensor", file, "-o", tmp_path / "capture")
    capture = read_capture(tmp_path / "capture")
    assert (capture.bits, capture.decoding.exposure_s) == (12, 0.02)
    assert "bits_from" in done.output
    done = run("decode", tmp_path / "capture", "--range", 300, 800, "-o", tmp_path / "cloud.ply")
    assert "sigma of the points: from the contrast of the fringes and the residuals of their fit, 16 DN" in done.output
    assert np.isfinite(read_cloud(tmp_path / "cloud.ply").sigma).sum() > 5000


@pytest.mark.parametrize("empty", [4, 6, 8])
def test_levels_in_the_upper_bits_have_their_full_scale(tmp_path, empty):
    """Before, pixels that 12 bits saturate were valid, since 4095 * 16 is not 65535."""
    text = smallest().partition("[pattern]")[0] + '[pattern]\nkind = "phase_shift"\nperiods_px = [170, 16]\n'
    file = written(tmp_path, text)
    full = 2 ** (16 - empty) - 1
    code = load_sensor(file, "decoding").pattern
    stack = np.minimum(images_seen(code, CAMERA, PROJECTOR, surface_seen(CAMERA), full=full) * 1.5, full)
    stack = stack.astype(np.uint16)
    save_images(tmp_path / "upper", stack << empty)
    run("import", tmp_path / "upper", "--sensor", file, "-o", tmp_path / "capture")
    capture = read_capture(tmp_path / "capture")
    assert (capture.bits, capture.settings["empty_bits"]) == (16 - empty, empty)
    np.testing.assert_array_equal(capture.images["camera"], stack)


def test_a_program_decodes_with_a_rig_and_cannot_simulate_it(tmp_path):
    file = written(tmp_path, smallest())
    rig, truth = ms.load_sensor(file, "decoding"), surface_seen(CAMERA)
    save_images(tmp_path / "images", images_seen(rig.pattern, CAMERA, PROJECTOR, truth))
    cloud = ms.decode(read_image_folder(tmp_path / "images", rig), rig)
    assert cloud.valid.mean() > 0.8
    with pytest.raises(InputError, match=r"sensor my-rig: wavelength_nm, .*simulation needs them"):
        ms.render(ms.load_scene(SCENES / "coupon/coupon.xml", ms.load_sensor("ensenso-n10")), rig, np.eye(4))
