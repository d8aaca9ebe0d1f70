"""Numbers that are no depths and no points, or have no known unit, are refused or left out: they were measured."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from characterisation.files.errors import InputError
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.array_file import map_in
from mitsim.capture.recordings.cloud_text import points_of_text
from mitsim.capture.recordings.depth_image import missing_depths, read_depth_image
from mitsim.decoding.plain_clouds import read_plain_cloud
from tests.capture.recordings.cloud_files_of_others import pinhole_cloud

CLOUD = pinhole_cloud()


def pinhole(folder):
    """Return a calibration of images of 64 x 48 px."""
    path = folder / "camera.json"
    path.write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}')
    return path


@pytest.mark.parametrize(
    ("name", "depth", "message"),
    [
        ("left_disp.tif", np.full((48, 64), 66.0, np.float32), "found disparities, by the name"),
        ("inverse_depth.tif", np.full((48, 64), 66.0, np.float32), "found disparities, by the name"),
        ("idepth.png", np.full((48, 64), 660, np.uint16), "found disparities, by the name"),
        ("inverse.tif", np.full((48, 64), 0.0017, np.float32), r"depth: found a median of 0\.0017, in a unit"),
        ("um.tif", np.full((48, 64), 6e5, np.float32), r"depth: found a median of 6e\+05, in a unit"),
        ("levels.png", np.full((48, 64), 30000, np.uint16), r"depth: found a median of 3e\+04, in a unit"),
    ],
)
def test_depths_of_an_unknown_quantity_are_refused(tmp_path, name, depth, message):
    """They were 66 mm, 1.7 mm, 600 m and 30 m."""
    cv2.imwrite(str(tmp_path / name), depth)
    with pytest.raises(InputError, match=message):
        read_depth_image(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path)))
    if "unit" in message:
        capture = read_depth_image(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path), scale_mm=0.01))
        assert capture.derived["depth"].max() == pytest.approx(depth[0, 0] / 100)


def test_disparities_are_told_by_the_folder(tmp_path):
    """KITTI's are levels of 1/256 px in files of numbers alone: a wall at 0.6 m was at 12.8 m."""
    for name, refused in (("disp_occ_0/000000_10.png", True), ("disparity/depth_0.png", False)):
        (tmp_path / name).parent.mkdir()
        cv2.imwrite(str(tmp_path / name), np.full((48, 64), 12800, np.uint16))
        if refused:
            with pytest.raises(InputError, match="found disparities, by the name"):
                read_depth_image(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path)))
        else:
            assert (
                read_depth_image(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path))).derived["depth"].max()
                == 12800
            )


@pytest.mark.parametrize("name", ["a.npy", "depth.npy"])
@pytest.mark.parametrize(("per_mm", "told"), [(0.1, True), (1.0, False), (0.001, False)])
def test_a_cloud_or_depth_that_may_be_in_cm_is_told(tmp_path, name, per_mm, told):
    """Before, cm were taken as mm without a word."""
    np.save(tmp_path / name, (CLOUD if name == "a.npy" else CLOUD[..., 2]) * per_mm)
    read = read_recording(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path)))
    assert any("if these are cm, say --" in note for note in read.capture.settings.get("warnings", [])) is told
    stated = {"unit": "cm"} if name == "a.npy" else {"scale_mm": 10.0}
    read = read_recording(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path), **stated))
    assert not any("if these are cm" in note for note in read.capture.settings.get("warnings", []))


@pytest.mark.parametrize(
    ("name", "depth", "millimetres"),
    [("depth_cm", 60.0, 600.0), ("depth_m", 25.0, 25000.0), ("depth_mm", 12.0, 12.0), ("depth.um", 6e5, 600.0)],
)
def test_the_unit_in_the_name_of_an_array(tmp_path, name, depth, millimetres):
    """60 cm were 60 mm, 25 m were 25 mm, and 12 mm were 12 m."""
    np.savez(tmp_path / "a.npz", **{name: np.full((48, 64), depth, np.float32)})
    capture = read_depth_image(tmp_path / "a.npz", ReadOptions(calibration=pinhole(tmp_path)))
    assert capture.derived["depth"].max() == pytest.approx(millimetres)
    assert capture.settings["depth_scale_mm"] == pytest.approx(millimetres / depth)


def test_disparities_beside_depths_are_left_out(tmp_path):
    np.savez(tmp_path / "a.npz", disparity=np.full((48, 64), 66.0))
    with pytest.raises(InputError, match="found disparities, by the name"):
        read_depth_image(tmp_path / "a.npz", ReadOptions(calibration=pinhole(tmp_path)))
    np.savez(tmp_path / "a.npz", disparity=np.full((48, 64), 66.0), z=np.full((48, 64), 700.0))
    assert (
        read_depth_image(tmp_path / "a.npz", ReadOptions(calibration=pinhole(tmp_path))).derived["depth"].max() == 700
    )


@pytest.mark.parametrize("other", ["rgb", "normals", "image"])
def test_colours_and_normals_of_an_archive_are_no_points(tmp_path, other):
    """The largest array was measured, or the first: colours put a plane at 500 mm at 212 mm."""
    values = np.random.default_rng(0).uniform(0, 255, (*CLOUD.shape[:2], 3))
    np.savez(tmp_path / "a.npz", **{other: np.concatenate([values, values]), "p3d": CLOUD})
    assert np.array_equal(map_in((tmp_path / "a.npz").read_bytes(), tmp_path / "a.npz"), CLOUD, equal_nan=True)


def test_colours_before_the_points_of_a_text_are_refused():
    rows = [(200, 10 + i % 7, i % 256, 0.37 * i - 3.2, 0.11 * i, 500.25 + 0.3 * i) for i in range(50)]
    text = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    with pytest.raises(InputError, match="the first three seem to be colours"):
        points_of_text(text, Path("a.xyz"))
    whole = [(i % 9, i // 9, 200 - i, 0.6, 0.0, -0.8) for i in range(50)]
    text = "\n".join(" ".join(map(str, row)) for row in whole).encode()
    assert points_of_text(text, Path("a.xyz"))[0][-1].tolist() == [4, 5, 151]


@pytest.mark.parametrize("ending", [".csv", ".txt", ".asc"])
def test_a_map_of_depths_in_a_text_is_no_list_of_points(tmp_path, ending):
    """The first three columns were measured as x, y and z."""
    path = tmp_path / f"a{ending}"
    head = "ncols 64\nnrows 48\ncellsize 1\n" if ending == ".asc" else ""
    np.savetxt(path, np.full((48, 64), 600.5), header=head, comments="", delimiter="," if ending == ".csv" else " ")
    with pytest.raises(InputError, match=r"64 columns without names, as of a map of depths.*--calibration"):
        points_of_text(path.read_bytes(), path)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".mat"])
@pytest.mark.parametrize(
    ("before", "told"),
    [
        (np.arange(400.0)[:, None], "the first seems to count"),
        (np.stack(np.divmod(np.arange(400.0), 20), axis=1), "the first two seem to count"),
        (np.random.default_rng(0).integers(0, 255, (400, 3)), "the first three seem to be colours"),
    ],
)
def test_counters_and_colours_before_the_points_of_an_array_are_refused(tmp_path, suffix, before, told):
    """They were measured as x, y and z; of a text they were refused."""
    values = np.concatenate(
        [before, np.random.default_rng(1).uniform([-90, -90, 500], [90, 90, 600], (400, 3))], axis=1
    )
    path = tmp_path / f"a{suffix}"
    save = {".npy": np.save, ".npz": lambda file, array: np.savez(file, cloud=array)}
    (savemat(path, {"cloud": values}) if suffix == ".mat" else save[suffix](path, values))
    with pytest.raises(InputError, match=told):
        read_plain_cloud(path)
    coloured = np.concatenate([values[:, -3:], before], axis=1)
    np.save(tmp_path / "b.npy", coloured)
    np.testing.assert_allclose(read_plain_cloud(tmp_path / "b.npy")[0].points[0], values[:, -3:], rtol=1e-6)


@pytest.mark.parametrize(
    "other",
    [
        {"K": np.eye(3)},
        {"pose": np.eye(4)},
        {"dist": np.zeros((1, 5))},
        {"poses": np.tile(np.eye(4), (4, 1, 1)), "K": np.eye(3)},
    ],
)
@pytest.mark.parametrize("name", ["depth", "z_map"])
def test_a_calibration_beside_depths_is_neither_points_nor_depths(tmp_path, name, other):
    """Before, "shape: found depth 48 x 64, K 3 x 3"."""
    depth = np.random.default_rng(0).uniform(600, 700, (48, 64))
    np.savez(tmp_path / "a.npz", **{name: depth}, **other)
    assert np.array_equal(map_in((tmp_path / "a.npz").read_bytes(), tmp_path / "a.npz"), depth)


def test_depths_by_name_are_read_beside_a_list_of_points(tmp_path):
    depth = np.random.default_rng(0).uniform(600, 700, (48, 64))
    np.savez(tmp_path / "a.npz", depth=depth, corners=np.zeros((88, 3)))
    assert np.array_equal(map_in((tmp_path / "a.npz").read_bytes(), tmp_path / "a.npz"), depth)


def test_a_map_is_of_the_camera_of_its_size(tmp_path):
    """Before, it had the name of the first one."""
    eyes = {
        name: {"fx": f, "fy": f, "cx": w / 2, "cy": h / 2, "width": w, "height": h}
        for name, f, w, h in (("color", 120, 128, 96), ("depth", 60, 64, 48))
    }
    (tmp_path / "eyes.json").write_text(json.dumps(eyes))
    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(600, 700, (48, 64)))
    assert set(read_depth_image(tmp_path / "a.npy", ReadOptions(calibration=tmp_path / "eyes.json")).rig.cameras) == {
        "depth"
    }
    rows, columns = np.mgrid[:48, :64]
    z = 700 + 20 * np.sin(columns / 9)
    np.save(tmp_path / "b.npy", np.stack([(columns - 32) / 60 * z, (rows - 24) / 60 * z, z], axis=-1))
    options = ReadOptions(calibration=str(tmp_path / "eyes.json"))
    assert set(read_recording(tmp_path / "b.npy", options).capture.rig.cameras) == {"depth"}


@pytest.mark.parametrize(
    ("values", "frame", "said"), [(CLOUD, "0", "--frame for an array of points"), (CLOUD[..., 2], "3", "frame")]
)
def test_a_frame_that_is_not_there_is_refused(tmp_path, values, frame, said):
    """Before, it was ignored."""
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(InputError, match=said):
        read_recording(tmp_path / "a.npy", ReadOptions(calibration=str(pinhole(tmp_path)), frame=frame))


@pytest.mark.parametrize(("left_out", "said"), [(3069, ">\u00a099\u00a0%"), (31, "1.0\u00a0%")])
def test_a_share_is_a_plain_percentage(left_out, said):
    """Before, 99.9 % were 1e+02 %."""
    levels = np.full(48 * 64, 700, np.uint16)
    levels[:left_out] = 65535
    assert missing_depths(levels.reshape(48, 64))[1][0].startswith(f"{said} of the pixels")
