"""The calibrations that come with the presets, and the command that makes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import mitsim.sensor
from characterisation.files.errors import InputError
from mitsim.cli.program import app
from mitsim.sensor.drift import Drift
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_covariance import read_rig_covariance
from mitsim.sensor.rig_parameters import moved
from mitsim.study.calibration import virtual_calibration
from mitsim.study.calibration.virtual_calibration import calibrate

FOLDER = Path(mitsim.sensor.__file__).parent / "presets" / "calibrations"


@pytest.mark.parametrize("name", presets())
def test_every_preset_comes_calibrated(name, rng):
    sensor = load_sensor(name)
    alone, drifted = preset_covariance(sensor, Drift.none()), preset_covariance(sensor)
    assert {each.rpartition(".")[0] for each in alone.names} - {"path"} == set(sensor.measuring_eyes)
    assert (drifted.one_sigma >= alone.one_sigma).all() and (alone.one_sigma > 0).all()
    true = moved(sensor.rig, drifted.names, drifted.draw(rng))
    point = np.array([0.0, 0.0, np.sqrt(np.prod(sensor.working_range_mm))])
    shift = np.abs(true.reference.project(point) - sensor.rig.reference.project(point)).max()
    assert 0 < shift < 5
    assert (FOLDER / f"{name}.toml").stat().st_size < 20_000


def test_a_file_is_what_the_command_writes_today(monkeypatch):
    monkeypatch.setattr(virtual_calibration, "_DRAWS", 20)  # of the accuracy, not of the covariance
    sensor = load_sensor("kinect-v2")
    stored, made = preset_covariance(sensor, Drift.none()), calibrate(sensor).covariance
    assert stored.names == made.names and stored.source.startswith(made.source)
    assert np.allclose(stored.one_sigma, made.one_sigma, rtol=1e-3)
    assert np.allclose(stored.correlation, made.correlation, atol=1e-3)


def test_another_rig_has_no_calibration(n10):
    other = replace(n10, rig=moved(n10.rig, ["left.k1"], [0.01]))
    with pytest.raises(InputError, match=r"left\.k1.*another rig"):
        preset_covariance(other)
    with pytest.raises(InputError, match=r"mine.*mitsim calibrate"):
        preset_covariance(replace(n10, name="mine"))


def test_the_command_writes_a_file_that_reads_back(tmp_path):
    path = tmp_path / "c.toml"
    done = CliRunner().invoke(
        app,
        [
            "calibrate",
            "kinect-v2",
            "-o",
            str(path),
            "--poses",
            "8",
            "--board",
            "9x7x70:composite",
            "--drift",
            "path_offset_mm=3",
            "--check",
            "4",
        ],
    )
    assert done.exit_code == 0, done.output
    assert "ball bar" in done.output and "all of 4 calibrations" in done.output
    assert done.stderr.strip().endswith(f"calibration: {path}")
    found = read_rig_covariance(path, load_sensor("kinect-v2").rig)
    assert "9 x 7 squares of 70 mm" in found.source and found.details["drift_path_offset_mm"] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--drift", "vergance_mrad=1"], "vergance_mrad.*did you mean 'vergence_mrad'"),
        (["--drift", "vergence_mrad=a"], "a number"),
        (["--board", "x"], "--board"),
        (["--poses", "2"], "--poses"),
    ],
)
def test_bad_options_are_refused_and_nothing_is_written(arguments, message, tmp_path):
    path = tmp_path / "c.toml"
    done = CliRunner().invoke(app, ["calibrate", "kinect-v2", "-o", str(path), *arguments])
    assert isinstance(done.exception, InputError)
    with pytest.raises(InputError, match=message):
        raise done.exception
    assert not path.exists()
