"""Gray code alone between two cameras: no bias, whatever the width of the stripes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.scene.backend import mi
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.smaller_sensors import middle_part

FRINGES = (Path(__file__).parents[1] / "data/fringes.toml").read_text(encoding="utf-8")
LEFT = FRINGES[FRINGES.index("[cameras.camera]") : FRINGES.index("[projector]")]
RIGHT = (
    LEFT.replace("cameras.camera", "cameras.right").replace("317.2, 241.4", "322.9, 238.1").replace("-0.12", "-0.10")
    + "position_mm = [120.0, 1.0, 4.0]\nrotation_deg = [0.4, -11.0, -0.3]\n\n"
)
PATTERN = FRINGES[FRINGES.index("[pattern]") : FRINGES.index("[imager]")]


def sensor_of(stripe, tmp_path):
    """Stripes so many projector pixels wide, between two cameras."""
    width = int(FRINGES.split("[projector]")[1].split("width = ")[1].split("\n")[0].split("#")[0])
    bits = int(np.ceil(np.log2(width))) - int(np.log2(stripe))
    text = FRINGES.replace(LEFT, LEFT.replace("cameras.camera", "cameras.left") + RIGHT)
    text = text.replace(PATTERN, f'[pattern]\nkind = "gray_code"\nbits = {bits}\n\n')
    text = text.replace("position_mm = [140.0, 5.0, 10.0]", "position_mm = [60.0, -40.0, 10.0]")
    text = text.replace("rotation_deg = [0.5, -13.0, 0.3]", "rotation_deg = [-3.0, -5.5, 0.3]")
    path = tmp_path / "pair.toml"
    path.write_text(text + 'triangulate = "cameras"\n', encoding="utf-8")
    return load_sensor(path)


def cloud_of(sensor, shape, pose):
    scene = scene_from_dict({"shape": {**shape, "bsdf": {"type": "matt_white"}}}, sensor.wavelength_nm)
    capture = SimulatedSensor(sensor).capture(scene, pose, rendering=Rendering(samples=16), seed=1)
    return capture_cloud(capture, sensor.settings, sensor_geometry(sensor), imager=sensor.imager)


POSE = look_at([0, 0, 600], [0, 0, 0], [0, 1, 0])


@pytest.mark.parametrize("stripe", [2, 16])
def test_a_plane_has_no_bias(stripe, tmp_path):
    sensor = middle_part(sensor_of(stripe, tmp_path), 640, 240)
    cloud = cloud_of(sensor, {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([1000, 1000, 1])}, POSE)
    inner = cloud.valid.copy()
    inner[:12] = inner[-12:] = inner[:, :40] = inner[:, -40:] = False
    off = POSE.points(cloud.points[inner].astype(float))[:, 2]
    print(f"stripes of {stripe} px, plane: {len(off)} points, mean {off.mean():.4f} mm, std {off.std():.4f} mm")
    assert len(off) > 0.6 * inner[12:-12, 40:-40].size
    assert abs(off.mean()) < 0.1 * off.std()


#: standard deviation [mm] about the faces of the corner below when every pixel met the centre of its stripe
STAIRCASE = {4: 0.83, 8: 1.71}


@pytest.mark.parametrize("stripe", STAIRCASE)
def test_the_faces_of_a_corner_are_flat_and_square(stripe, tmp_path):
    """Three faces of a cube, its corner toward the cameras: each at an angle to the stripes, and with an edge."""
    sensor = sensor_of(stripe, tmp_path)
    pose = look_at([380, 380, 380], [50, 50, 50], [0, 0, 1])
    cloud = cloud_of(sensor, {"type": "cube", "to_world": mi.ScalarTransform4f().scale([100, 100, 100])}, pose)
    points = pose.points(cloud.points[cloud.valid].astype(float))
    for axis in range(3):
        others = np.delete(points, axis, axis=1)
        own = (np.abs(points[:, axis] - 100) < 8) & (others < 90).all(axis=1) & (others > 10).all(axis=1)
        off = points[own, axis] - 100
        print(f"stripes of {stripe} px, face {axis}: {own.sum()}, mean {off.mean():.4f} mm, std {off.std():.4f} mm")
        assert own.sum() > 3000
        assert abs(off.mean()) < 0.1 * off.std()
        assert off.std() < STAIRCASE[stripe] / 5


@pytest.mark.parametrize("stripe", [2, 16])
def test_a_ball_has_no_bias(stripe, tmp_path):
    sensor = middle_part(sensor_of(stripe, tmp_path), 640, 240)
    cloud = cloud_of(sensor, {"type": "sphere", "radius": 60.0}, POSE)
    points = POSE.points(cloud.points[cloud.valid].astype(float))
    normal = points / np.linalg.norm(points, axis=1, keepdims=True)
    facing = normal[:, 2] > 0.8
    off = np.linalg.norm(points[facing], axis=1) - 60.0
    print(f"stripes of {stripe} px, ball: {len(off)} points, mean {off.mean():.4f} mm, std {off.std():.4f} mm")
    assert facing.sum() > 3000
    assert abs(off.mean()) < 0.1 * off.std()
