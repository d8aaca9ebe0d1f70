"""The rig files in ``scenes/rigs``, as they are: imported and decoded at the first try, from simulated folders."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner

from characterisation.cloud_files import read_cloud
from mitsim.cli.program import app
from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform
from tests.simulated_rigs import images_seen, save_calibration, save_images, surface_seen

SCENES = Path(__file__).parents[3] / "scenes/rigs"
FILES = {path.stem: path.read_text(encoding="utf-8") for path in sorted(SCENES.glob("*.toml"))}

#: plane and ball stand about here [mm]
DEPTH = 500.0

LENS = np.array([-0.12, 0.05, 0.0005, -0.0004, 0.01])
BESIDE = ((0.5, -11.0, 0.3), (100.0, 3.0, 5.0))
ABOVE = ((-11.0, 0.5, 0.3), (4.0, -100.0, 5.0))


def eye(x=0.0, turn=0.0, lens=LENS, model="perspective"):
    K = np.array([[280.0, 0, 119.3], [0, 281, 90.6], [0, 0, 1]])
    return Camera(K, lens, 240, 180, Transform.from_degrees((0, turn, 0.2 if x else 0), (x, 0.5 if x else 0, 0)), model)


def beamer(width, height, place=BESIDE, lens=(0.02, -0.01, 0, 0, 0), focal=1.05):
    """A projector whose field the camera just sees, or with a shorter focal length (in widths) a part of it."""
    K = np.array([[focal * width, 0, width / 2 - 0.5], [0, focal * width, height / 2 - 0.5], [0, 0, 1]])
    return Camera(K, np.array(lens, float), width, height, Transform.from_degrees(*place))


@dataclass(frozen=True)
class Rigged:
    """A rig as it stands: its cameras and projector, the names of its calibration's values, and of its images."""

    cameras: dict
    projector: Camera
    calibration: object
    names: str = "image_{:02d}.png"
    full: int = 255
    tolerance: float = 1.0


def extrinsics(camera, to_mm=1.0):
    """R and T of stereoCalibrate for an eye that stands somewhere in the first camera's frame."""
    R = camera.sensor_from_camera.rotation.T
    return {"R": R, "T": -R @ camera.sensor_from_camera.translation / to_mm}


def yml(name, **names):
    """Write K, D, size of the first eye (1) and the second (2), R and T under names of one's own."""

    def write(folder, one, two):
        values = {
            "K1": one.matrix,
            "D1": one.distortion,
            "S1": [one.width, one.height],
            "K2": two.matrix,
            "D2": two.distortion,
            "S2": [two.width, two.height],
            **extrinsics(two),
        }
        save_calibration(folder / name, **{own: values[known] for known, own in names.items()})

    return write


def opencv(name="calib.yml"):
    return yml(
        name,
        K1="camera_matrix",
        D1="distortion_coefficients",
        S1="image_size",
        K2="projector_matrix",
        D2="projector_distortion",
        S2="projector_size",
        R="R",
        T="T",
    )


def two_files(folder, one, two):
    yml("intrinsics.yml", K1="M1", D1="D1", K2="M2", D2="D2")(folder, one, two)
    yml("extrinsics.yml", R="R", T="T")(folder, one, two)


def matlab(folder, one, two):
    values = extrinsics(two)
    om = cv2.Rodrigues(values["R"])[0]
    table = {"om": om, "T": values["T"].reshape(3, 1)}
    for side, each in (("left", one), ("right", two)):
        K, kc = each.matrix, each.distortion[:, None]
        table |= {f"fc_{side}": np.diag(K)[:2, None], f"cc_{side}": K[:2, 2:], f"alpha_c_{side}": 0.0}
        table |= {f"kc_{side}": kc, f"kc_{side}_error": kc}
    savemat(folder / "Calib_Results_stereo.mat", table)


def numpys(folder, one, two):
    np.savez(
        folder / "calib.npz",
        mtx=one.matrix,
        dist=one.distortion[None],
        proj_mtx=two.matrix,
        proj_dist=two.distortion[None],
        **extrinsics(two),
    )


def plain_json(folder, one, two):
    values = extrinsics(two, 10.0)
    table = {
        "camera_matrix": one.matrix,
        "camera_distortion": one.distortion,
        "projector_matrix": two.matrix,
        "projector_distortion": two.distortion,
        "R": values["R"],
        "t": values["T"],
    }
    (folder / "calibration.json").write_text(json.dumps({name: value.tolist() for name, value in table.items()}))


def file_each(folder, one, two):
    for name, each in (("camera", one), ("projector", two)):
        save_calibration(
            folder / f"{name}.yml",
            camera_matrix=each.matrix,
            distortion_coefficients=each.distortion,
            image_width=each.width,
            image_height=each.height,
        )
    save_calibration(folder / "stereo.yml", **extrinsics(two))


ONE = {"camera": eye()}
PAIR = {"left": eye(), "right": eye(60.0, -6.0)}
ROUND = np.array([0.05, -0.02, 0.004, 0.0])
FISH = {name: replace(each, distortion=ROUND, model="fisheye") for name, each in PAIR.items()}
PAIRED = {"K1": "K1", "D1": "D1", "S1": "image_size", "K2": "K2", "D2": "D2", "R": "R", "T": "T"}
RIGS = {
    "opencv": Rigged(ONE, beamer(256, 192), opencv(), "graycode_{:02d}.png", tolerance=4.0),
    "moreno": Rigged(  # the camera resolves single columns
        ONE,
        beamer(1024, 768, focal=0.28),
        yml("calibration.yml", K1="cam_K", D1="cam_kc", K2="proj_K", D2="proj_kc", R="R", T="T"),
        "cam_{:02d}.png",
        tolerance=8.0,
    ),
    "pair": Rigged(PAIR, beamer(1024, 768), two_files, "{camera}/{index:02d}.png", tolerance=2.0),
    "fringes": Rigged(ONE, beamer(912, 1140), matlab, "{:d}.bmp"),
    "complementary": Rigged(ONE, beamer(1280, 720), numpys),
    "pair-fringes": Rigged(PAIR, beamer(1280, 800), yml("stereo.yml", **PAIRED), "{camera}_{index:02d}.png"),
    "rows": Rigged(ONE, beamer(256, 192, ABOVE), opencv(), tolerance=4.0),
    "fisheye": Rigged(FISH, beamer(1280, 720), yml("fisheye.yml", **PAIRED), "{camera}_{index:02d}.png"),
    "both-axes": Rigged(ONE, beamer(1280, 720), plain_json, "pat{:02d}.png"),
    "on-off": Rigged(ONE, beamer(256, 192), file_each, "on and off", tolerance=6.0),
    "threshold": Rigged(
        ONE,
        beamer(256, 192),
        yml("rig.yml", K1="Kc", D1="kc", K2="Kp", D2="kp", S2="projector_size", R="R", T="T"),
        "{:d}.tif",
        4095,
        4.0,
    ),
    "beat": Rigged(ONE, beamer(854, 480), opencv("calib.xml")),
}


def test_the_page_has_the_rigs_that_are_tested():
    assert set(RIGS) == set(FILES)
    assert len(RIGS) >= 10


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_file_of_the_how_to_works_at_the_first_try(tmp_path, name):
    """No warning, no missing key; the points lie on plane and ball within the error of a stripe or of noise."""
    rig = RIGS[name]
    (tmp_path / "rig.toml").write_text(FILES[name], encoding="utf-8")
    cameras = list(rig.cameras.values())
    second = cameras[1] if len(cameras) == 2 else rig.projector
    rig.calibration(tmp_path, cameras[0], second)
    known = load_sensor(tmp_path / "rig.toml", "decoding", (240, 180))
    for number, (camera, each) in enumerate(rig.cameras.items()):
        stack = images_seen(known.pattern, each, rig.projector, surface_seen(each), full=rig.full, seed=number)
        if known.ambient_image:
            stack = np.concatenate([stack, np.full_like(stack[:1], 10)])
        if name == "beat":
            stack = np.stack([stack // 2, stack, stack // 3], axis=-1)
        if name == "on-off":
            for index, image in enumerate(stack):
                axis, bit, state = "xy"[index // 14], index % 14 // 2, ("off", "on")[index % 2]
                save_images(tmp_path / "images", [image], f"{axis}_bit{bit:02d}_{state}.png")
            save_images(tmp_path / "images", [stack[0]], "preview.png")
            continue
        for index, image in enumerate(stack):
            save_images(tmp_path / "images", [image], rig.names.format(index, camera=camera, index=index))
    output = ""
    for arguments in (
        ["import", "images", "--sensor", "rig.toml", "-o", "capture"],
        ["decode", "capture", "-o", "cloud.ply"],
    ):
        done = CliRunner().invoke(
            app, [str(tmp_path / a) if not a.startswith("-") and i else a for i, a in enumerate(arguments)]
        )
        assert done.exit_code == 0, done.output
        output += done.output
    assert "warning" not in output, output
    cloud = read_cloud(tmp_path / "cloud.ply")
    points = cloud.points[cloud.valid].astype(float)
    off = np.abs(distance_from_surface(points))
    print(f"{name}: {cloud.valid.mean():.2f} valid, {np.median(off):.2f} mm, 95 % {np.percentile(off, 95):.2f} mm")
    assert cloud.valid.mean() > 0.8
    assert np.median(off) < rig.tolerance
    assert np.percentile(off, 90) < 4 * rig.tolerance


def distance_from_surface(points):
    """Along z [mm] from the plane, or from the ball where that is nearer: an exact check without a grid."""
    plane = points[:, 2] - (DEPTH + 0.1 * points[:, 0])
    ball = np.linalg.norm(points - [0.02 * DEPTH, 0, 0.92 * DEPTH], axis=1) - 0.08 * DEPTH
    return np.where(np.abs(plane) < np.abs(ball), plane, ball)
