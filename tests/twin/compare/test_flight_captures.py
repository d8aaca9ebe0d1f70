"""Validating captures of time of flight, whose images are correlations and not light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.test_targets import plate
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from mitsim.twin.compare.captures_run import validate_captures


@pytest.mark.parametrize("distance", [1000.0, 3000.0])
def test_the_power_of_the_light_source_is_found_at_any_distance(tmp_path, distance):
    """The first correlation falls with the light where its phase is over 90 deg: beyond 2.3 m at 16 MHz."""
    kinect = load_sensor("kinect-v2")
    dimmed = SimulatedSensor(replace(kinect, projector=replace(kinect.projector, flux=0.5 * kinect.projector.flux)))
    pose = look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])
    capture = dimmed.capture(plate(distance, "matt white", 860), pose, seed=4)
    write_capture(replace(capture, source="device"), tmp_path / "real")
    validation = validate_captures(
        tmp_path / "real", None, tmp_path / "out", "kinect-v2", Roi(140, 80, 220, 220), None, seed=1
    )
    twin = read_capture(tmp_path / "out/simulated")
    # half of the preset's 12 W, on a plate of 0.85
    assert twin.settings["rebuilt"]["power_times_reflectance_w"] == pytest.approx(6 * 0.85, rel=5e-3)
    rows = {row.quantity: row for row in validation.comparison.rows}
    assert rows["contrast"].why == "there are no dots in the light of the correlations"
    # the level is 2 K m w, the range of the correlations over the phase; the middle is brighter than the rim
    images = capture.images["depth"].reshape(3, 3, 424, 512)[..., 80:300, 140:360].astype(float)
    steps = 2 / 3 * np.abs(np.einsum("k,fkij->fij", np.exp(2j * np.pi * np.arange(3) / 3), images))
    assert rows["median grey level"].real == pytest.approx(np.median(2 * np.sqrt((steps**2).mean(axis=0))), rel=0.1)
