"""Two cameras and a projector that only writes the code, from a sensor file to the cloud, without noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from characterisation.features.fits import fit_sphere
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, decoder_settings, sensor_geometry
from mitsim.scene.backend import mi
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

FRINGES = (Path(__file__).parents[1] / "data/fringes.toml").read_text(encoding="utf-8")
LEFT = FRINGES[FRINGES.index("[cameras.camera]") : FRINGES.index("[projector]")]
RIGHT = (
    LEFT.replace("cameras.camera", "cameras.right").replace("317.2, 241.4", "322.9, 238.1").replace("-0.12", "-0.10")
    + "position_mm = [120.0, 1.0, 4.0]\nrotation_deg = [0.4, -11.0, -0.3]\n\n"
)


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    """The fringes of tests/data between two cameras, all three lenses distorted."""
    text = FRINGES.replace(LEFT, LEFT.replace("cameras.camera", "cameras.left") + RIGHT)
    text = text.replace("position_mm = [140.0, 5.0, 10.0]", "position_mm = [60.0, -40.0, 10.0]")
    text = text.replace("rotation_deg = [0.5, -13.0, 0.3]", "rotation_deg = [-3.0, -5.5, 0.3]")
    path = tmp_path_factory.mktemp("pair") / "pair.toml"
    path.write_text(text + 'triangulate = "cameras"\n', encoding="utf-8")
    return load_sensor(path)


@pytest.fixture(scope="module")
def simulated(sensor):
    return SimulatedSensor(sensor)


def cloud_of(sensor, simulated, shape, pose):
    scene = scene_from_dict({"shape": {**shape, "bsdf": {"type": "matt_white"}}}, sensor.wavelength_nm)
    capture = simulated.capture(scene, pose, rendering=Rendering(samples=9), seed=1, noise=Noise.none())
    return capture, capture_cloud(capture, sensor.settings, sensor_geometry(sensor))


@pytest.mark.parametrize("tilt", [0, 20])
def test_a_plane_comes_back_between_two_cameras(sensor, simulated, tilt, tmp_path):
    """A pixel is worth 3.3 mm of depth; the rms is 1/1000 of one, by coordinates interpolated between raw pixels.

    The blur mirrors the pattern at the rims of the images; what sees the rim of the right one is few pixels anywhere.
    """
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], tilt).scale([1000, 1000, 1])
    pose = look_at([0, 0, 600], [0, 0, 0], [0, 1, 0])
    capture, cloud = cloud_of(sensor, simulated, {"type": "rectangle", "to_world": to_world}, pose)
    inner = cloud.valid.copy()
    inner[:8] = inner[-8:] = inner[:, :8] = inner[:, -8:] = False
    world = pose.points(cloud.points[inner].astype(float))
    a = np.radians(tilt)
    off = world @ np.array([np.sin(a), 0, np.cos(a)])
    rim = np.abs(off) > 0.05
    print(
        f"between two cameras: plane tilted {tilt} deg: {len(off)} points, rms {1000 * off.std():.2f} um, "
        f"mean {1000 * off.mean():.2f} um"
    )
    assert cloud.valid.mean() > 0.5
    assert rim.mean() < 1e-3
    assert off.std() < 0.005
    assert abs(off.mean()) < 0.001
    if tilt == 0:
        write_capture(capture, tmp_path / "capture")
        again = read_capture(tmp_path / "capture")
        again = replace(again, decoding=again.decoding.model_copy(update={"decoder": sensor.decoder}))
        np.testing.assert_array_equal(capture_cloud(again, decoder_settings(again)[0]).points, cloud.points)


def test_a_sphere_comes_back_between_two_cameras(sensor, simulated):
    """Radius 60 mm at 600 mm. Chords of interpolation lie inside, by microns up to 60 deg from the axis."""
    pose = look_at([0, 0, 660], [0, 0, 0], [0, 1, 0])
    _, cloud = cloud_of(sensor, simulated, {"type": "sphere", "radius": 60.0}, pose)
    assert set(np.unique(cloud.status[~cloud.valid])) <= {
        Status.NO_SURFACE,
        Status.LOW_MODULATION,
        Status.HIDDEN,
        Status.AMBIGUOUS,
        Status.PHASE_INCONSISTENT,
    }
    world = pose.points(cloud.points[cloud.valid].astype(float))
    facing = world[:, 2] > 30  # up to 60 deg from the axis
    fit = fit_sphere(world[facing], viewpoint=np.array([0, 0, 660.0]))
    print(
        f"between two cameras: sphere: radius error {1000 * (fit.radius - 60):.2f} um, "
        f"residual {1000 * fit.residual_std:.2f} um, {facing.sum()} points"
    )
    assert facing.sum() > 10000
    assert abs(fit.radius - 60) < 0.005
    assert fit.residual_std < 0.003


def test_one_camera_is_not_enough(tmp_path):
    (tmp_path / "one.toml").write_text(FRINGES + 'triangulate = "cameras"\n', encoding="utf-8")
    with pytest.raises(InputError, match="two cameras"):
        load_sensor(tmp_path / "one.toml")
