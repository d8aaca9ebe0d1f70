"""Light of the room and a misaligned camera of one unit, through the whole simulated capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor_file import MisalignmentTable, RoomTable
from mitsim.sensor.transforms import look_at

SHEET = {"sheet": {"type": "rectangle", "to_world": None, "bsdf": {"type": "matt_white", "reflectance": 0.5}}}


def sheet(wavelength):
    from mitsim.scene import backend

    backend.activate()
    size = backend.mi.ScalarTransform4f().scale([2000, 2000, 1])
    return scene_from_dict({"sheet": {**SHEET["sheet"], "to_world": size}}, wavelength)


@pytest.fixture(scope="module")
def n10():
    return load_sensor("ensenso-n10")


POSE = look_at((0.0, 0.0, 600.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.0)


def radiance(sensor, camera="left"):
    simulated = SimulatedSensor(sensor)
    return simulated.radiance(sheet(sensor.wavelength_nm), POSE, camera, Rendering(samples=1, depth=1), seed=1)[0]


def test_the_room_adds_irradiance_times_reflectance_over_pi(n10):
    chip = replace(n10.imager, corner_illumination=1.0)
    plain = replace(n10, imager=chip)
    lit = replace(plain, room=RoomTable(irradiance_w_mm2=2e-6, gradient=(0.5, -0.2)))
    added = (radiance(lit) - radiance(plain)).astype(float)
    camera = n10.rig.reference
    rays = camera.rays(camera.pixel_grid())
    expected = 0.5 / np.pi * 2e-6 * (1 + 0.5 * rays[..., 0] / rays[..., 2] - 0.2 * rays[..., 1] / rays[..., 2])
    inner = np.s_[40:-40, 40:-40]
    # the directional albedo of the sheet is found by a few thousand samples
    np.testing.assert_allclose(added[inner], expected[inner], rtol=0.01)


def test_a_turned_camera_moves_its_rows_and_the_capture_keeps_its_calibration(n10):
    off = replace(n10, misalignment=MisalignmentTable(row_mrad=2.0))
    ideal, turned = radiance(n10, "right"), radiance(off, "right")
    # a turn by w about x moves the image down by f w: 627 px x 2 mrad
    part = np.s_[200:280, 300:460]
    shifts = np.arange(-3, 3.01, 0.25)
    costs = []
    for shift in shifts:
        rows = np.arange(200, 280) + shift
        low = np.floor(rows).astype(int)
        share = (rows - low)[:, None]
        moved = (1 - share) * turned[low, 300:460] + share * turned[low + 1, 300:460]
        costs.append(float(((moved - ideal[part]) ** 2).mean()))
    assert shifts[int(np.argmin(costs))] == pytest.approx(627.2 * 2e-3, abs=0.13)
    simulated = SimulatedSensor(off)
    taken = simulated.capture(
        sheet(off.wavelength_nm), POSE, rendering=Rendering(samples=1), seed=1, noise=Noise.none()
    )
    right = taken.rig.cameras["right"].sensor_from_camera.rotation
    np.testing.assert_array_equal(right, n10.rig.cameras["right"].sensor_from_camera.rotation)


def test_a_map_is_told_from_that_of_another_room_and_old_maps_stay_known(n10):
    from characterisation.maps.performance_map import PerformanceMap
    from characterisation.maps.shipped import map_path
    from mitsim.sensor.sensor_text import sensor_checksum

    lit = replace(n10, room=RoomTable(irradiance_w_mm2=2e-6))
    turned = replace(n10, misalignment=MisalignmentTable(row_mrad=0.1))
    smooth = replace(n10, imager=replace(n10.imager, smoothing_px=0.5))
    assert len({sensor_checksum(one) for one in (n10, lit, turned, smooth)}) == 4
    shipped = PerformanceMap.load(map_path("ensenso-n10"))
    assert shipped.data.attrs["sensor_checksum"] == sensor_checksum(n10)
