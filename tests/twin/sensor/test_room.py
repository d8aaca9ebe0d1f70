"""The light of a room from captures with the projector off, where there is some, and where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.sensor.camera import Rig
from mitsim.sensor.vignetting import camera_illumination
from mitsim.twin.sensor.input_captures import InputCapture
from mitsim.twin.sensor.room import fit_room
from tests.twin.sensor.small_unit import small_sensor, specimen


@pytest.mark.parametrize(("light_dn", "lit"), [(-0.3, False), (0.0, False), (7.0, True)])
def test_a_dark_room_has_no_light_and_no_shape(light_dn, lit):
    """Before, a black level 0.3 DN too high gave a negative irradiance, which no sensor file takes."""
    sensor = small_sensor()
    rig = Rig({"left": sensor.rig.cameras["left"]}, sensor.rig.projector)
    imager = replace(sensor.imager, black_level=sensor.imager.black_level - light_dn)
    levels = sensor.imager.black_level + np.random.default_rng(2).normal(0, 1, (1, 240, 320))
    images = {"left": np.clip(np.rint(levels), 0, 255).astype(np.uint8)}
    capture = Capture("small", "active_stereo", "device", rig, images, decoding=Decoding(exposure_s=3e-4))
    source = InputCapture(Path("off"), capture, "off")
    found = fit_room([source], replace(sensor, rig=rig, imager=imager), {"off": specimen()})
    value = found.estimates[0]
    assert (value.value > 10 * value.uncertainty) == lit
    assert value.value >= 0
    assert len(found.estimates) == (6 if lit else 1)
    assert found.terms[0] == value.value and any(found.terms[1:]) == lit


def test_an_even_dim_room_of_little_noise_has_no_shape():
    """1 to 3 DN, noise of 0.5 DN. Before, curvatures were up to 4.3 u from 0, by trimmed means of whole grey levels."""
    sensor, errors = small_sensor(), []
    camera = sensor.rig.cameras["left"]
    rig = Rig({"left": camera}, sensor.rig.projector)
    for number, light_dn in enumerate((1.1, 1.3, 1.6, 1.8, 2.2, 2.4, 2.7, 2.9)):
        rng = np.random.default_rng(number)
        loss = camera_illumination(sensor.imager.corner_illumination, camera)
        levels = sensor.imager.black_level + light_dn * (1.0 if loss is None else loss)
        levels = levels + rng.normal(0, 0.5, (1, 240, 320))
        images = {"left": np.rint(levels).astype(np.uint8)}
        images["left"][:, rng.integers(0, 240, 500), rng.integers(0, 320, 500)] = 60  # specks
        capture = Capture("small", "active_stereo", "device", rig, images, decoding=Decoding(exposure_s=3e-4))
        found = fit_room([InputCapture(Path("off"), capture, "off")], replace(sensor, rig=rig), {"off": specimen()})
        errors.append([one.value / one.uncertainty for one in found.estimates[1:]])
    assert np.abs(errors).max() < 3.5
