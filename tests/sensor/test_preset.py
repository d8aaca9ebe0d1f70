"""Sensor files: the preset is what it says, and what is wrong in a user's file is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.sensor.imager import electrons_per_radiance
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.transforms import Transform
from mitsim.study.reading import open_study
from mitsim.talk.talk_file import sensor_in, sensor_key
from mitsim.twin.sensor.run import sensor_path
from tests.small_study import small_study

PRESET = Path(__file__).parents[2] / "mitsim/sensor/presets/ensenso-n10.toml"


@pytest.mark.parametrize("name", [name for name in presets() if load_sensor(name).technology == "active_stereo"])
def test_both_cameras_of_a_stereo_preset_see_the_middle_of_its_range(name):
    sensor = load_sensor(name)
    middle = np.array([[0.0, 0.0, sum(sensor.working_range_mm) / 2]])
    reference = sensor.rig.reference
    for camera in sensor.rig.cameras.values():
        column, row = camera.project(reference.sensor_from_camera.points(middle))[0]
        assert 0.1 < column / camera.width < 0.9 and 0.3 < row / camera.height < 0.7


def test_the_exposure_rule_gives_the_level_that_it_states(n10):
    radiance = 0.85 / np.pi * n10.projector.plane_irradiance / 600**2
    electrons = radiance * electrons_per_radiance(n10.imager, 850, n10.exposure.base_s)
    assert np.isclose(electrons / n10.imager.full_well, 0.40)
    assert "matt white" in n10.exposure.rule


def test_every_preset_loads():
    for name in presets():
        assert load_sensor(name).name == name


@pytest.mark.parametrize(
    ("old", "new", "field", "hint"),
    [
        ("full_well_e = 20000", "full_wel_e = 20000", "imager.full_wel_e", "did you mean 'full_well_e'?"),
        (
            "quantum_efficiency = 0.27",
            "quantum_efficiency = 27",
            "imager.quantum_efficiency",
            "less than or equal to 1",
        ),
        ("width = 752", 'width = "wide"', "cameras.left.width", "integer"),
        ("wavelength_nm = 850", "wavelength_nm = 0.85", "wavelength_nm", "400"),
        ("block_size = 5", "block_size = 4", "matcher.block_size", "odd"),
        ("limits_s = [1e-5, 1e-2]", "limits_s = [1e-5, 1e-4]", "exposure.limits_s", "flux_w"),
        ("flux_w = 1.0", "flux_w = 1e-320", "exposure.limits_s", "inf s: change projector.flux_w"),
        ("working_range_mm = [400, 800]", "working_range_mm = [800, 400]", "working_range_mm", "near before far"),
        # a second camera, and a projector, that look backwards
        ("rotation_deg = [0.0, -8.3, 0.0]", "rotation_deg = [0.0, 171.7, 0.0]", "working_range_mm", "right and proj"),
        ("rotation_deg = [0.0, -4.15, 0.0]", "rotation_deg = [180.0, 0.0, 0.0]", "working_range_mm", "same part"),
        ('technology = "active_stereo"', "", "technology", "required"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, old, new, field, hint):
    text = PRESET.read_text()
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_sensor(file)
    assert caught.value.field == field
    assert hint in str(caught.value)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("name", presets())
def test_a_measurement_has_an_image_for_each_pattern_or_delay(name):
    sensor = load_sensor(name)
    delays = 0 if sensor.pattern.kind != "amplitude_modulation" else len(sensor.pattern.images()[0])
    assert sensor.frames == len(sensor.patterns()) + delays > 0


def test_a_sensor_file_may_be_named_in_capitals(tmp_path):
    """Before, RIG.TOML was an unknown preset, also in a study, in the talk and when fitting a sensor."""
    path = tmp_path / "RIG.TOML"
    path.write_bytes(PRESET.read_bytes())
    (tmp_path / "study.toml").write_text(small_study("{}", sensor="RIG.TOML"))
    assert load_sensor(path).name == "ensenso-n10"
    assert open_study(tmp_path / "study.toml").sensor.name == "ensenso-n10"
    assert sensor_in(tmp_path, "RIG.TOML").name == "ensenso-n10" and sensor_key("RIG.TOML") == "RIG"
    assert sensor_path(path) == path


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(InputError, match="did you mean 'ensenso-n10'"):
        load_sensor("ensenso-n11")


def test_a_camera_that_no_point_needs_hides_nothing(tmp_path):
    """Two cameras beside a projector: one is enough, unless the file says that the two are matched."""
    n10, david = load_sensor("ensenso-n10"), load_sensor("david-sls-3")
    assert list(n10.measuring_rig.cameras) == ["left", "right"]
    eye = david.rig.reference
    second = replace(eye, sensor_from_camera=Transform.from_degrees([0, 0, 0], [-120.0, 0, 0]))
    two = replace(david, rig=replace(david.rig, cameras={"left": eye, "right": second}))
    assert list(two.measuring_rig.cameras) == ["left"]
    assert two.measuring_rig.baseline_direction[0] > 0.8  # toward the projector, not toward the camera beyond
    assert two.rig.baseline_direction[0] == -1
    matched = replace(two, decoder=two.decoder.model_copy(update={"triangulate": "cameras"}))
    assert list(matched.measuring_rig.cameras) == ["left", "right"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("focal_px", "[1e-9, 1e-9]"),
        ("focal_px", "[1e9, 1000]"),
        ("principal_px", "[1e9, 0]"),
        ("width", "20000"),
        ("position_mm", "[1e9, 0, 0]"),
    ],
)
def test_optics_that_cannot_be_are_refused(tmp_path, key, value):
    lines = PRESET.read_text(encoding="utf-8").split("\n")
    start = next(number for number, line in enumerate(lines) if line.startswith("[cameras.right]"))
    end = next(number for number in range(start + 1, len(lines)) if lines[number].startswith("["))
    more = [f"{key} = {value}", *(["height = 20000"] if key == "width" else [])]
    gone = {line.split(" = ")[0] for line in more}
    kept = [line for line in lines[start + 1 : end] if line.split("=")[0].strip() not in gone]
    (tmp_path / "s.toml").write_text("\n".join([*lines[: start + 1], *kept, *more, *lines[end:]]), encoding="utf-8")
    with pytest.raises(InputError, match=r"pixels|focal_px from|principal_px within|within 100 m"):
        load_sensor(tmp_path / "s.toml")
