"""One sensor file for a rig that somebody else built: it renders, and its images come back through an import."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from characterisation.cloud_files import read_cloud
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud
from mitsim.scene.backend import mi
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

FRINGES = (Path(__file__).parents[1] / "data/fringes.toml").read_text(encoding="utf-8")
SEQUENCE = """[pattern]
kind = "image_sequence"
images = [
    { show = "black" },
    { show = "fringes", period_px = 18, shifts_deg = [-90, 0, 90, 180] },
    { show = "unused" },
    { show = "gray", stripe_px = 72, first = "least_significant" },
    { show = "fringes", period_px = 144, shifts_deg = [240, 120, 0] },
    { show = "white" },
]

"""


def written(folder):
    """The optics of tests/data/fringes.toml in a YAML file of OpenCV's, all else in the sensor file."""
    whole = load_sensor(Path(__file__).parents[1] / "data/fringes.toml").rig
    eye, projector = whole.cameras["camera"], whole.projector
    place = projector.sensor_from_camera.inverse()
    storage = cv2.FileStorage(str(folder / "calib.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in {
        "M1": eye.matrix,
        "D1": eye.distortion,
        "M2": projector.matrix,
        "D2": projector.distortion,
        "R": place.rotation,
        "T": place.translation / 10,
    }.items():
        storage.write(name, value)
    storage.release()
    head, _, rest = FRINGES.partition("[cameras.camera]")
    light = rest[rest.index("flux_w") : rest.index("[pattern]")]
    end = rest[rest.index("[imager]") :].replace("bits = 12", "bits = 8").replace("black_level_dn = 64", "")
    text = f"""{head}[calibration]
file = "calib.yml"
to_mm = 10
[cameras.camera]
width = {eye.width}
height = {eye.height}
[projector]
width = {projector.width}
height = {projector.height}
{light}{SEQUENCE}{end}"""
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return load_sensor(folder / "rig.toml"), whole


def test_a_rig_renders_and_its_images_come_back_through_import(tmp_path):
    sensor, whole = written(tmp_path)
    np.testing.assert_allclose(sensor.rig.projector.centre, whole.projector.centre, atol=1e-9)
    to_world = mi.ScalarTransform4f().scale([150, 150, 1])
    shape = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "matt_white"}}
    scene = scene_from_dict({"plate": shape}, sensor.wavelength_nm)
    pose = look_at([0, 0, 600], [0, 0, 0], [0, 1, 0])
    capture = SimulatedSensor(sensor).capture(
        scene, pose, rendering=Rendering(samples=9), seed=1, noise=Noise.only("quantisation")
    )
    images = capture.images["camera"]
    assert len(images) == 14
    means = images.mean(axis=(1, 2))
    assert np.argmax(means) == 13  # white is the last, black the first, and the unused one is black
    assert max(means[0], means[5]) < 0.05 * means[13]
    direct = capture_cloud(capture, sensor.settings)
    assert direct.valid.sum() > 90000
    world = pose.points(direct.points[direct.valid].astype(float))
    off = np.abs(world[:, 2])[np.abs(world[:, :2]).max(axis=1) < 145]
    # 1/255 of full scale makes 0.007 projector pixels, of 3 mm each; beyond are the rims of the light and of the image
    assert np.mean(off < 0.15) > 0.99
    assert np.percentile(off, 68.3) < 0.04

    folder = tmp_path / "images"
    folder.mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / f"shot{index}.png"), image)
    run = CliRunner()
    done = run.invoke(app, ["import", str(folder), "--sensor", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "c")])
    assert done.exit_code == 0, done.output
    done = run.invoke(app, ["decode", str(tmp_path / "c"), "-o", str(tmp_path / "cloud.ply")])
    assert done.exit_code == 0, done.output
    again = read_cloud(tmp_path / "cloud.ply")
    assert again.source == "device"
    np.testing.assert_array_equal(again.points, direct.points)
    np.testing.assert_array_equal(again.status, direct.status)
