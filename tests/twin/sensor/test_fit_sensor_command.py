"""mitsim fit sensor from the shell's side: a file that loads, a table, undetermined numbers, and errors as messages."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.scene.load import scene_from_dict
from mitsim.scene.test_targets import plate
from mitsim.sensor.fitted_to import images_digest
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.transforms import Transform, look_at
from mitsim.twin.sensor import run, specimen_simulator
from mitsim.twin.sensor.estimate import FittedKey
from mitsim.twin.sensor.input_captures import read_input_captures, repeats
from mitsim.twin.sensor.noise import ImagerFit
from mitsim.twin.sensor.write import (
    Entry,
    _entries,
    moved_paths,
    with_cameras,
    with_entries,
    with_exposure,
    write_sensor,
)
from tests.smaller_sensors import coarse_sensor


@pytest.mark.parametrize("name", [name for name in presets() if name != "kinect-v2"])
def test_every_preset_takes_fitted_numbers_and_is_a_sensor_again(name, tmp_path):
    sensor, path = load_sensor(name), run.sensor_path(name)
    text = moved_paths(path.read_text(encoding="utf-8"), path.parent, tmp_path)
    entries = {
        "projector.flux_w": "0.5",
        "imager.smoothing_px": "0.4",
        "imager.prnu": "0.002",
        "room.irradiance_w_mm2": "1e-6",
        "room.gradient": "[0.5, -0.2]",
        "name": '"mine"',
        "unknowns.calibration.row_mrad": "0.2",
    }
    text = with_cameras(text, dict(sensor.rig.cameras), "test")
    text = with_exposure(text, 1e-3, "as recorded")
    (tmp_path / "mine.toml").write_text(with_entries(text, {k: Entry(v, "fitted") for k, v in entries.items()}))
    again = load_sensor(tmp_path / "mine.toml")
    assert (again.projector.flux, again.imager.smoothing_px, again.imager.prnu) == (0.5, 0.4, 0.002)
    assert again.room.gradient == (0.5, -0.2) and again.unknowns.calibration.row_mrad == 0.2
    assert again.name == "mine" and again.exposure.base_s == 1e-3
    for camera, other in zip(sensor.rig.cameras.values(), again.rig.cameras.values(), strict=True):
        np.testing.assert_allclose(other.matrix, camera.matrix, rtol=1e-8)
        np.testing.assert_allclose(other.sensor_from_camera.matrix(), camera.sensor_from_camera.matrix(), atol=1e-6)
    assert again.imager.full_well == sensor.imager.full_well  # what is not determined is as it was


@pytest.mark.parametrize(("row", "roll", "vergence"), [(-3.0, 4.0, 12.5**0.5), (0.1, -0.1, 0.24)])
def test_a_camera_that_turned_may_have_turned_toward_the_other(row, roll, vergence, tmp_path):
    """The second camera of a unit turned by 5 mrad in all; the next unit's vergence was still drawn with 0.24 mrad."""
    turns = [
        FittedKey(f"misalignment.{key}_mrad", value, 0.0, "mrad", ("sheet",), "row errors over the field")
        for key, value in (("row", row), ("roll", roll))
    ]
    sensor = load_sensor("ensenso-n10")
    assert sensor.unknowns.calibration.vergence_mrad == 0.24
    path = run.sensor_path("ensenso-n10")
    text = moved_paths(path.read_text(encoding="utf-8"), path.parent, tmp_path)
    text = with_entries(text, _entries(run.SensorFit(sensor, (), tuple(turns), ())))
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    written = load_sensor(tmp_path / "mine.toml").unknowns.calibration
    assert (written.row_mrad, written.roll_mrad) == (abs(row), abs(roll))
    assert written.vergence_mrad == pytest.approx(vergence, rel=1e-4)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three captures of one pose with the projector off, and two in the dark, of an N10 of another full well."""
    folder = tmp_path_factory.mktemp("captures")
    preset = load_sensor("ensenso-n10")
    from mitsim.scene import backend

    backend.activate()
    chip = replace(preset.imager, full_well=15000, read_noise=50.0, dsnu=0.0, prnu=0.0, row_noise=0.0)
    lit = replace(preset, imager=chip)
    size = backend.mi.ScalarTransform4f().scale([110, 80, 1])  # 24 patches, just enough for terms over the field
    sheet = {"type": "rectangle", "to_world": size, "bsdf": {"type": "matt_white"}}
    scene = scene_from_dict({"sheet": sheet}, preset.wavelength_nm)
    pose = look_at((0.0, 0.0, 500.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.0)
    simulated = SimulatedSensor(lit)
    light = simulated.light(scene, pose, rendering=Rendering(samples=4), seed=1)
    for number in range(3):
        write_capture(simulated.expose(light, 10 + number), folder / f"on_{number}")
    none = replace(light, radiance={name: 0 * values for name, values in light.radiance.items()})
    for number in range(2):
        dark = simulated.expose(none, 20 + number)
        dark.settings["dark"] = True
        write_capture(dark, folder / f"dark_{number}")
    return folder


def test_repeats_are_found_and_the_dark_is_told_by_the_settings(recorded):
    input_captures = read_input_captures(sorted(recorded.iterdir()), (), (), load_sensor("ensenso-n10"))
    groups = {(group[0].kind, len(group)) for group in repeats(input_captures)}
    assert groups == {("dark", 2), ("on", 3)}


def test_a_file_of_ones_own_camera(recorded, tmp_path, monkeypatch):
    # one draw of the dots, of few rays: how well three of them determine the numbers of dots is for test_dots.py
    monkeypatch.setattr(run, "fit_sensor", partial(run.fit_sensor, draws=1))
    monkeypatch.setattr(specimen_simulator, "_SAMPLES", 4)
    output = tmp_path / "my-camera.toml"
    folders = [str(folder) for folder in sorted(recorded.iterdir())]
    result = CliRunner().invoke(
        app, ["fit", "sensor", *folders, "--sensor", "ensenso-n10", "-o", str(output)], catch_exceptions=False
    )
    assert result.exit_code == 0
    mine = load_sensor(output)
    # repeats of dots and of the dark: well known, in spite of the 8 bits
    assert mine.imager.full_well == pytest.approx(15000, rel=0.05)
    assert mine.imager.read_noise == pytest.approx(50, rel=0.05)
    # the noise of repeats contains that of rows: the 6 e- of the preset beside it would count twice
    assert mine.imager.row_noise == 0.0
    assert "| imager.row_noise_e | 0, before 6 |" in result.stdout
    # the count is that of the table, whose rows say which numbers are not determined
    fitted, others = map(int, re.search(r"(\d+) fitted parameters, (\d+) not determined", result.stderr).groups())
    estimates = re.findall(
        r"(?m)^\| (?!number)[\w.\[\]]+ \| [^|]+ \| ([^|]+) \| [^|]* \| [^|]+ \| [^|]+ \|$", result.stdout
    )
    absent = [interval == "not determined" for interval in estimates]
    assert any(absent) and fitted == len(absent) - sum(absent)
    assert others >= sum(absent) + 1  # and the row noise
    # nothing is called kept that the preset does not have
    assert "imager.smoothing_px (repeats of one pose)" not in re.sub(r"(?m)^Not determined.*$", "", result.stdout)
    assert not re.search(r"(?m)^\| [\w.]+ \| 0, kept ", result.stdout)
    assert {one.name: one.images_sha256 for one in mine.fitted_to} == {
        folder: images_digest(read_capture(folder).images) for folder in folders
    }
    assert "| imager.full_well_e |" in result.stdout and "| not determined | in the file |" in result.stdout
    assert "photon transfer of repeats" in output.read_text()
    assert result.stderr.splitlines()[-1].startswith("verdict: ")
    preset = run.sensor_path("ensenso-n10").read_text(encoding="utf-8")
    for kept in re.findall(r"(?m)^\| ([\w.]+) \| [^|]*, kept \| [^|]* \|$", result.stdout):
        line = next((one for one in preset.splitlines() if one.startswith(f"{kept.rpartition('.')[2]} ")), None)
        assert line is None or line in output.read_text(), kept  # what is not determined is as it was
    assert mine.name == "my-camera"


def test_the_fixed_pattern_stays_where_no_fitted_noise_contains_it(recorded, tmp_path, monkeypatch):
    """Before, one capture of dots that left the noise undetermined took the fixed pattern out of the file."""
    monkeypatch.setattr(specimen_simulator, "_SAMPLES", 4)
    preset = load_sensor("ensenso-n10")
    found = run.fit_sensor([recorded / "on_0"], "ensenso-n10", draws=1)
    write_sensor(found, "ensenso-n10", tmp_path / "mine.toml")
    mine = load_sensor(tmp_path / "mine.toml").imager
    assert {"imager.full_well_e", "imager.read_noise_e"} <= {one.key for one in found.undetermined}
    assert (mine.dsnu, mine.prnu) == (preset.imager.dsnu, preset.imager.prnu)
    # finest detail has no noise of whole rows, so no fitted number contains it
    assert mine.row_noise == preset.imager.row_noise


def test_noise_of_one_image_of_stripes_takes_the_place_of_the_fixed_pattern(tmp_path, monkeypatch):
    """Before, the fixed pattern of the preset stayed beside noise that contains it, and repeats were overwritten."""
    path = coarse_sensor("zivid-2-m70", 4, tmp_path)
    sensor = load_sensor(path)
    assert sensor.imager.dsnu > 0 and sensor.imager.prnu > 0
    wall = plate(3000.0, "matt white", sensor.wavelength_nm)
    pose = Transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 700.0]))
    simulated = SimulatedSensor(sensor)
    light = simulated.light(wall, pose, rendering=Rendering(samples=4), seed=1)
    folders = [write_capture(simulated.expose(light, seed), tmp_path / f"wall_{seed}") for seed in (1, 2)]
    of_stripes = [FittedKey("imager.read_noise_e", 7.0, 1.0, "e-", ("wall",), "one image")]
    monkeypatch.setattr(run, "fit_stripes", lambda *_: of_stripes)
    by_repeats = FittedKey("imager.read_noise_e", 5.0, 1.0, "e-", ("wall",), "photon transfer of repeats")
    for known, read, pattern in (((), 7.0, 0.0), ((by_repeats,), 5.0, sensor.imager.prnu)):
        imager = ImagerFit(sensor.imager, known, known=bool(known), repeated=bool(known))
        monkeypatch.setattr(run, "fit_imager", lambda *_, imager=imager: imager)
        write_sensor(run.fit_sensor(folders, path), path, tmp_path / "mine.toml")
        mine = load_sensor(tmp_path / "mine.toml").imager
        assert (mine.read_noise, mine.prnu) == (read, pattern)


def test_a_plain_sheet_without_the_projector_is_where_the_lit_one_is(recorded, monkeypatch):
    """Before, an error: without dots it has no points, so no plane was found in it."""
    lit, dark = (
        read_input_captures([recorded / name], (), (), load_sensor("ensenso-n10"))[0] for name in ("on_0", "dark_0")
    )
    off = replace(dark, kind="off")

    def found(source, _):
        if source is off:
            raise InputError(source.name, "pose", "0 points", "500 points")
        return f"plane of {source.name}"

    monkeypatch.setattr(run, "_specimen", found)
    assert run._specimens([lit], [off], None) == dict.fromkeys((lit.name, off.name), f"plane of {lit.name}")
    with pytest.raises(InputError, match="0 points"):
        run._specimens([], [off], None)


def test_what_cannot_be_is_one_message(recorded, tmp_path):
    preset = load_sensor("ensenso-n10")
    with pytest.raises(InputError, match="CAPTURES: found none"):
        read_input_captures([], (), (), preset)
    with pytest.raises(InputError, match="a folder twice"):
        read_input_captures([recorded / "on_0"], (), [recorded / "on_0"], preset)
    write_capture(read_capture(recorded / "on_0"), tmp_path / "copy")  # as a repeat it halved the noise
    with pytest.raises(InputError, match=r"images: found those of .*on_0"):
        read_input_captures([recorded / "on_0", tmp_path / "copy"], (), (), preset)
    with pytest.raises(InputError, match=r"technology: found active_stereo"):
        read_input_captures([recorded / "on_0"], (), (), load_sensor("david-sls-3"))
    with pytest.raises(InputError, match=r"--output.* a .toml file"):
        CliRunner().invoke(
            app, ["fit", "sensor", "x", "--sensor", "ensenso-n10", "-o", "x.json"], catch_exceptions=False
        )


def test_the_old_way_to_fit_a_finish_is_still_there():
    runner = CliRunner()
    assert "width alpha of a coupon's specular lobe" in runner.invoke(app, ["fit", "finish", "--help"]).stdout
    assert "sensor" in runner.invoke(app, ["fit", "--help"]).stdout
    with pytest.raises(InputError, match="capture"):  # captures without a word before them
        runner.invoke(app, ["fit", "nowhere/capture_1"], catch_exceptions=False)
