"""Names that a user gives become files and pages: checked once, at the door, before anything is written."""

import json
import os
import sys
from pathlib import Path

import pytest
import typer

from characterisation.files.documents import LONGEST_NAME, checked_name
from characterisation.files.errors import InputError
from mitsim.cli.program import main
from mitsim.sensor.preset import load_sensor
from tests.small_study import small_study

SCENES = Path(__file__).parents[2] / "scenes"
PRESET = Path(__file__).parents[2] / "mitsim" / "sensor" / "presets" / "ensenso-n10.toml"

HOSTILE = (
    "\u0301a",  # a mark without a letter before it
    "../../evil",
    "/tmp/evil",
    "N10/lab 2",
    "a\\b",
    "C:evil",
    "..",
    ".hidden",
    "ends. ",
    "",
    "a\0b",
    "a\nb",
    "a\x1b[2Jb",
    "\u202etxt",
    "<script>alert(1)</script>",
    'x" onload="alert(1)',
    "a`b",
    "*",
    "a|b",
    "a" * (LONGEST_NAME + 1),
    "ß" * LONGEST_NAME,
)


@pytest.mark.parametrize(
    "name",
    ["ensenso-n10", "pillar1_radius", "Größe 2", "N10 (lab #2)", "a.b", "1", "Ø 20 +- 0.1", "シール面", "พื้นผิว", "मुख"],
)
def test_usual_names_are_names(name):
    assert checked_name(name) == name


def command(*arguments):
    """Exit code and what was told of a command, run in this process."""
    before, sys.argv = sys.argv, ["mitsim", *map(str, arguments)]
    try:
        main()
    except SystemExit as done:
        return done.code
    except typer.Exit as done:
        return done.exit_code
    finally:
        sys.argv = before
    return 0


def quoted(name):
    """A name as TOML writes it: its escapes are JSON's."""
    return json.dumps(name)


def sensor_called(folder, name):
    text = PRESET.read_text(encoding="utf-8").replace('name = "ensenso-n10"', f"name = {quoted(name)}", 1)
    (folder / "sensor.toml").write_text(text, encoding="utf-8")
    return folder / "sensor.toml"


def commands_with(folder, sensor):
    """Every command that reads a sensor, a task or a plan in which a name stands; outputs lie in ``folder / out``."""
    part, task, out = SCENES / "two_pillars" / "matt_white.xml", folder / "task.toml", folder / "out"
    study = folder / "study.toml"
    study.write_text(
        f'scene = "{part}"\ntask = "{task}"\nsensor = "{sensor}"\n[views]\nsubdivisions = 0\n', encoding="utf-8"
    )
    campaign = SCENES / "coupon" / "quick.toml"
    at = ("--sensor", sensor, "--position", 0, -300, 400)
    yield ["map", "sheet", sensor, "-o", out]
    yield ["run", study, "-o", out]
    yield ["study", "score", study, "-o", out]
    yield ["study", "state", study, "--view", 1, "-o", out]
    yield ["map", "make", campaign, "--sensor", sensor, "-o", out]
    yield ["render", part, *at, "-o", out / "capture"]
    yield ["map", "predict", part, "--map", "ensenso-n10", *at, "-o", out / "a.ply"]
    yield ["calibrate", sensor, "-o", out / "covariance.json"]
    yield ["map", "validate", "ensenso-n10", campaign, "--sensor", sensor, "-o", out]


@pytest.mark.parametrize("name", HOSTILE)
def test_names_that_lead_elsewhere_are_none(name):
    with pytest.raises(ValueError, match="a name of at most"):
        checked_name(name)


@pytest.mark.parametrize("name", [HOSTILE[0], HOSTILE[11], HOSTILE[14]])
def test_no_command_takes_a_sensor_of_a_name_that_leads_elsewhere(tmp_path, capfd, name, monkeypatch):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    monkeypatch.chdir(inner)
    sensor = sensor_called(inner, name)
    (inner / "task.toml").write_bytes((SCENES / "two_pillars" / "task.toml").read_bytes())
    for arguments in commands_with(inner, sensor):
        assert command(*arguments) == 2, arguments
        told = capfd.readouterr().err
        assert "sensor.toml" in told and "name" in told and "Traceback" not in told
        assert "\x1b" not in told and "\0" not in told
    written = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if not path.is_dir()}
    assert written == {Path("a/b") / name for name in ("sensor.toml", "task.toml", "study.toml")}


@pytest.mark.parametrize("name", [HOSTILE[0], "radius 1/2"])
@pytest.mark.parametrize("kind", ["features", "measurements"])
def test_no_command_takes_a_task_with_such_names(tmp_path, capfd, name, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (SCENES / "two_pillars" / "task.toml").read_text(encoding="utf-8")
    old = {"features": "pillar1", "measurements": "pillar1_radius"}[kind]
    text = text.replace(f"[{kind}.{old}]", f"[{kind}.{quoted(name)}]", 1)
    (tmp_path / "task.toml").write_text(text, encoding="utf-8")
    for arguments in commands_with(tmp_path, "ensenso-n10"):
        if arguments[0] in ("run", "study"):
            assert command(*arguments) == 2, arguments
            told = capfd.readouterr().err
            assert "task.toml" in told and "a name of at most" in told
    assert {path.name for path in tmp_path.rglob("*") if not path.is_dir()} == {"task.toml", "study.toml"}


@pytest.mark.parametrize("name", ["../x", "left cam", "a/b", "ü", ""])
def test_a_camera_has_a_name_that_its_images_can_have(tmp_path, name):
    text = PRESET.read_text(encoding="utf-8").replace("[cameras.left]", f'[cameras."{name}"]')
    (tmp_path / "sensor.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="camera's name"):
        load_sensor(tmp_path / "sensor.toml")


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes are of Linux")
def test_a_folder_with_a_name_in_latin_1_is_refused_before_the_work(tmp_path, capfd, monkeypatch):
    """Before, a traceback when the scores of all views were written."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/Pr\xfcfstand"))
    folder.mkdir()
    (folder / "study.toml").write_text(small_study("{}"), encoding="utf-8")
    monkeypatch.chdir(folder)
    for command in (["run"], ["study", "score"]):
        monkeypatch.setattr(sys, "argv", ["mitsim", *command, "study.toml", "-o", "out"])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 2
        assert "Pr\\udcfcfstand/out; allowed: a path in UTF-8" in capfd.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["study.toml"]
