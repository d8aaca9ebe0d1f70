"""Clouds without a grid and clouds in arrays and texts, measured and as a reference."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from shell import mitsim_here

from characterisation.cloud_files import write_cloud
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.recordings import organised_cloud
from mitsim.decoding.input_clouds import read_cloud
from mitsim.decoding.plain_clouds import read_plain_cloud

WIDTH, HEIGHT = 60, 45
GRID = ViewGrid(200.0, 200.0, 29.5, 22.0, WIDTH, HEIGHT)


def plane(offset=0.0):
    """Points (H, W, 3) [mm] of the plane z = 600 + offset, with a hole."""
    rays = GRID.rays()
    points = (rays / rays[..., 2:] * (600.0 + offset)).astype(np.float32)
    points[5:8, 10:20] = np.nan
    return points


def ply(points):
    rows = points.reshape(-1, 3)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n{}end_header\n"
    return head.format(len(rows), "".join(f"property float {a}\n" for a in "xyz")).encode() + rows.tobytes()


def save(path, points):
    """Write points as the suffix asks; arrays keep their rows and columns, all others are lists of points.

    The lists have one point more at their end, or else the grid would be found from them.
    """
    rows = np.concatenate([points.reshape(-1, 3), np.full((1, 3), np.nan, np.float32)])
    if path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".mat":
        x, y, z = np.moveaxis(points.astype(float), -1, 0)
        savemat(path, {"about": "text", "scale": 1.0, "X": x, "Y": y, "Z": z})
    elif path.suffix == ".ply":
        path.write_bytes(ply(rows))
    elif path.suffix == ".pcd":
        head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {len(rows)}\nHEIGHT 1\nDATA binary\n"
        path.write_bytes(head.encode() + rows.tobytes())
    elif path.suffix == ".csv":
        path.write_text("x,y,z,intensity\n" + "".join(f"{x},{y},{z},7\n" for x, y, z in rows.tolist()))
    else:
        path.write_text("# scan\n" + "".join(f"{x} {y} {z}\n" for x, y, z in rows.tolist()).replace("nan", "-nan(ind)"))
    return path


def decoded(path, points):
    status = np.where(np.isfinite(points[..., 0]), Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    write_cloud(PointCloud(points, status, GRID, "known", "simulated"), path)
    return path


@pytest.mark.parametrize("name", ["a.npy", "a.mat", "a.ply", "a.pcd", "a.xyz", "a.csv"])
def test_a_cloud_without_a_camera_is_measured_and_is_a_reference(tmp_path, name):
    given = save(tmp_path / name, plane(2.0))
    read = read_cloud(given)
    np.testing.assert_allclose(read.cloud.points[read.cloud.valid], plane(2.0)[np.isfinite(plane()[..., 0])], rtol=1e-6)
    assert (read.cloud.grid.height == 1) == (name not in ("a.npy", "a.mat"))
    other = decoded(tmp_path / "decoded.ply", plane())
    there = mitsim_here("measure", given, "--plane", "all", "--against", other, "--json")
    back = mitsim_here("measure", other, "--against", given, "--json")
    values = [
        {one["name"]: one["value"] for one in json.loads(done.stdout)["clouds"][0]["measurements"]}
        for done in (there, back)
    ]
    assert values[0]["all distance"] == pytest.approx(602.0, rel=1e-3)
    assert values[0]["all flatness"] < 1e-3
    assert values[0]["difference median"] == pytest.approx(2.0, rel=0.01)  # of rays up to 8 deg from the normal
    assert values[1]["difference median"] == pytest.approx(-2.0, rel=0.01)
    assert "in mm, which" in there.stderr


def test_metres_are_recognised_and_the_rays_pass_through_the_points(tmp_path):
    cloud, about = read_plain_cloud(save(tmp_path / "a.xyz", plane() / 1000))
    assert "in m, which" in about
    seen = cloud.valid
    assert seen.sum() == np.isfinite(plane()[..., 0]).sum()
    points = cloud.points[seen].astype(float)
    assert points[:, 2] == pytest.approx(600.0, abs=1e-3)
    along = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(cloud.grid.rays()[seen], along, atol=1e-6)


def test_a_reference_with_a_grid_may_lie_anywhere(tmp_path):
    """An organised cloud in the frame of a robot matches no pinhole; only its points matter."""
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {WIDTH}\nHEIGHT {HEIGHT}\nDATA binary\n"
    turn = Rotation.from_rotvec([0.9, 0.4, 0.2]).as_matrix()
    moved = (plane() @ turn.T + [300, -200, 50]).astype(np.float32)
    path = tmp_path / "robot.pcd"
    path.write_bytes(head.encode() + moved.tobytes())
    with pytest.raises(InputError, match="no camera at the origin"):
        read_cloud(path)
    assert np.isfinite(read_cloud(path, reference=True).cloud.points[..., 0]).sum() == np.isfinite(moved[..., 0]).sum()


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
@pytest.mark.parametrize("organised", [False, True])
def test_a_cloud_of_another_program_is_decoded_once(tmp_path, monkeypatch, name, organised):
    """Whether it has a grid follows from the same decoding as its points."""
    path, calls = save(tmp_path / name, plane()), []
    if organised:
        without_the_last = {"a.ply": (b"vertex 2701", b"vertex 2700"), "a.pcd": (b"WIDTH 2701", b"WIDTH 2700")}
        path.write_bytes(path.read_bytes()[:-12].replace(*without_the_last[name], 1))
    for decode in ("decode_ply", "decode_pcd"):
        real = getattr(organised_cloud, decode)
        monkeypatch.setattr(organised_cloud, decode, lambda *given, real=real: calls.append(real) or real(*given))
    cloud = read_cloud(path).cloud
    assert (cloud.grid.height > 1) == organised
    assert len(calls) == 1
    assert cloud.valid.sum() == np.isfinite(plane()[..., 0]).sum()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.npy", b"\x93NUMPY\x01\x00", "unreadable"),
        ("a.mat", b"MATLAB 5.0", "unreadable"),
        ("a.ply", b"solid of another format\nvertex 1 2 3\n", "a PLY file"),
        ("a.xyz", b"1 2 3\n4 5\n", "equal columns"),
        ("a.xyz", b"", "equal columns"),
        ("a.xyz", b"1 2 3\nfour five six\n1 2 x\n", "equal columns"),
        ("a.csv", b"x,y,z\nnan,nan,nan\n", "no points"),
    ],
)
def test_a_file_that_is_no_cloud_is_refused_in_words(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_cloud(tmp_path / name)


def test_an_archive_of_arrays_under_the_suffix_of_one_is_refused(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        np.savez(file, points=plane())
    with pytest.raises(InputError, match=r"unreadable.*np\.save"):
        read_cloud(tmp_path / "a.npy")


def test_numbers_that_a_file_of_level_4_states_are_bounded(tmp_path):
    """Its header promises 40000 x 40000 numbers, 12.8 GB, of which none follow."""
    (tmp_path / "a.mat").write_bytes(struct.pack("<5i", 0, 40_000, 40_000, 0, 2) + b"P\0")
    with pytest.raises(InputError, match=r"1,600,000,000 values; allowed: up to"):
        read_cloud(tmp_path / "a.mat")


def test_a_list_of_points_has_no_picture(tmp_path):
    done = mitsim_here(
        "measure", save(tmp_path / "a.xyz", plane()), "--plane", "all", "--picture", tmp_path / "p.png", code=2
    )
    assert "without a grid" in done.stderr
    assert not (tmp_path / "p.png").exists()
