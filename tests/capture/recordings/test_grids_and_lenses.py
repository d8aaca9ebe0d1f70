"""Clouds as Zivid, Photoneo and NumPy save them: without a stated grid, through a lens, in netCDF-4 or an array."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import netCDF4
import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.capture.recordings.pinhole_fit import fit_pinhole, grid_of
from mitsim.capture.recordings.recognise import kind_of
from mitsim.decoding.input_clouds import read_cloud
from mitsim.sensor.camera import Camera
from mitsim.sensor.png import encode_png
from mitsim.sensor.preset import load_sensor
from tests.capture.recordings.cloud_files_of_others import pinhole_cloud, ply

LENS = np.array([-0.27, 0.35, 2e-4, -3e-4, -0.32])  # as of a Zivid
WIDTH, HEIGHT = 96, 60
CAMERA = Camera(np.array([[88.0, 0, 47.2], [0, 88.4, 30.1], [0, 0, 1]]), LENS, WIDTH, HEIGHT)


def bent_cloud(camera=CAMERA, missing=np.nan) -> np.ndarray:
    """Points (60, 96, 3) [mm] on the exact view rays of a camera with a lens, with holes."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.stack([columns, rows], axis=-1).astype(float))
    z = 700 + 30 * np.sin(columns / 9) + 20 * np.cos(rows / 7)
    points = (rays / rays[..., 2:] * z[..., None]).astype(np.float32)
    points[10:14, 20:30] = missing
    points[0, :5] = missing
    return points


def test_a_lens_is_found_where_a_pinhole_does_not_fit():
    camera, rms = fit_pinhole(bent_cloud())
    assert rms < 1e-3
    assert camera.distortion == pytest.approx(LENS, abs=2e-3)
    pixels = np.stack(np.meshgrid(np.arange(0, WIDTH, 5), np.arange(0, HEIGHT, 5)), axis=-1).astype(float)
    assert np.abs(camera.rays(pixels) - CAMERA.rays(pixels)).max() < 1e-5


def test_a_lens_does_not_stand_for_another_frame():
    """A cloud that is turned by 3 deg or shifted by 20 mm lies on the rays of no camera at the origin."""
    points, angle = bent_cloud(), np.deg2rad(3)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    assert fit_pinhole(points @ turn.T)[1] > 0.05
    assert fit_pinhole(points + np.float32([20, 0, 0]))[1] > 0.05


@pytest.mark.parametrize("missing", [np.nan, 0.0])
@pytest.mark.parametrize("turned", [1, -1])
def test_the_grid_is_found_from_the_points(missing, turned):
    points = bent_cloud(missing=missing) * np.float32([1, turned, turned])
    assert grid_of(points.reshape(-1, 3)) == (WIDTH, HEIGHT)


def test_no_grid_is_found_where_missing_points_are_left_out():
    flat = bent_cloud().reshape(-1, 3)
    assert grid_of(flat[np.isfinite(flat[:, 0])]) is None
    assert grid_of(np.random.default_rng(1).permutation(flat)) is None


@pytest.mark.parametrize(("missing", "order"), [(0.0, "binary_little_endian"), (np.nan, "ascii")])
def test_an_organised_ply_needs_no_grid_in_its_header(tmp_path, missing, order):
    """PhoXi Control writes (0, 0, 0) for pixels without a point, Zivid Studio NaN; neither states the grid."""
    path = tmp_path / "scan.ply"
    path.write_bytes(ply(bent_cloud(missing=missing), order, grid="none"))
    capture = read_recording(path, ReadOptions()).capture
    assert capture.settings["grid_from"] == "the points"
    assert np.array_equal(np.isnan(capture.derived["points"]), np.isnan(bent_cloud()))
    cloud = read_cloud(path).cloud
    assert cloud.points.shape == (HEIGHT, WIDTH, 3)
    assert cloud.valid.sum() == HEIGHT * WIDTH - 45


def zdf(path, points, *, group="data", **more):
    """A file as Zivid's samples read it; ``more``: other variables of the group."""
    with netCDF4.Dataset(path, "w", format="NETCDF4") as file:
        place = file.createGroup(group)
        for name, size in zip(("rows", "columns", "xyz"), points.shape, strict=True):
            place.createDimension(name, size)
        place.createDimension("rgba", 4)
        variable = place.createVariable("pointcloud", "f4", ("rows", "columns", "xyz"), zlib=True)
        variable[...] = points
        place.createVariable("rgba_image", "u1", ("rows", "columns", "rgba"))[...] = np.arange(4) * 50
        place.createVariable("snr", "f4", ("rows", "columns"))[...] = 12.5
        for name, values in more.items():
            dims = [f"{name}_{k}" for k in range(np.ndim(values))]
            for dim, size in zip(dims, np.shape(values), strict=True):
                place.createDimension(dim, size)
            place.createVariable(name, "f8", dims)[...] = values
    return path


def test_a_zdf_comes_back_with_its_colour_and_its_camera(tmp_path):
    path = zdf(tmp_path / "a.zdf", bent_cloud(), camera_matrix=CAMERA.matrix, distortion_coefficients=LENS)
    assert kind_of(path) == "zdf"
    capture = read_recording(path, ReadOptions()).capture
    assert np.allclose(capture.derived["points"], bent_cloud(), atol=1e-3, equal_nan=True)
    assert capture.rig.reference.distortion.tolist() == LENS.tolist()
    assert capture.settings["snr_median"] == 12.5
    assert (capture.images["camera"] == 50).all()
    assert read_cloud(path).cloud.valid.sum() == HEIGHT * WIDTH - 45


def test_the_numbers_of_a_camera_may_be_attributes(tmp_path):
    path = zdf(tmp_path / "a.zdf", bent_cloud())
    with netCDF4.Dataset(path, "a") as file:
        matrix = file.createGroup("intrinsics").createGroup("CameraMatrix")
        matrix.setncatts({"FX": 88.0, "FY": 88.4, "CX": 47.2, "CY": 30.1})
        names = ("K1", "K2", "P1", "P2", "K3")
        file["intrinsics"].createGroup("Distortion").setncatts(dict(zip(names, LENS, strict=True)))
    camera = read_recording(path, ReadOptions()).capture.rig.reference
    assert camera.matrix.tolist() == CAMERA.matrix.tolist()
    assert camera.distortion.tolist() == LENS.tolist()


def test_a_zdf_without_a_camera_or_with_another_one_has_the_camera_of_its_points(tmp_path):
    other = CAMERA.matrix * np.array([[1.3], [1.3], [1]])
    for name, more in (("none", {}), ("other", {"camera_matrix": other})):
        capture = read_recording(zdf(tmp_path / f"{name}.zdf", bent_cloud(), **more), ReadOptions()).capture
        assert capture.rig.reference.matrix[0, 0] == pytest.approx(88.0, abs=0.01)
        assert capture.settings["fitted_camera_rms_px"] < 1e-3


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_zdf_is_refused(tmp_path, share):
    whole = zdf(tmp_path / "a.zdf", bent_cloud()).read_bytes()
    (tmp_path / "b.zdf").write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(InputError, match=r"b\.zdf"):
        read_recording(tmp_path / "b.zdf", ReadOptions())


def test_what_is_no_cloud_of_zivid_is_refused(tmp_path):
    with netCDF4.Dataset(tmp_path / "a.zdf", "w") as file:
        file.createDimension("n", 3)
        file.createVariable("x", "f4", ("n",))[...] = 1
    with pytest.raises(InputError, match="points of rows x columns x 3"):
        read_recording(tmp_path / "a.zdf", ReadOptions())
    (tmp_path / "scan.praw").write_bytes(b"PRAW" + bytes(100))
    with pytest.raises(InputError, match=r"PhoXi Control, whose format Photoneo has not published.*save it as PLY"):
        read_recording(tmp_path / "scan.praw", ReadOptions())


def pinhole_file(folder):
    path = folder / "camera.toml"
    path.write_text(
        "[cameras.camera]\nwidth = 64\nheight = 48\nfocal_px = [60.0, 61.0]\nprincipal_px = [31.3, 22.8]\n",
        encoding="utf-8",
    )
    return str(path)


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<i4", "<f4", "<f8"])
@pytest.mark.parametrize("metres", [False, True])
@pytest.mark.parametrize("by_columns", [False, True])
def test_depths_in_an_array_are_in_mm_or_in_m(tmp_path, dtype, metres, by_columns):
    if metres and np.dtype(dtype).kind != "f":
        return
    depth = np.nan_to_num(pinhole_cloud()[..., 2]).round()
    values = (depth / 1000 if metres else depth).astype(dtype)
    np.save(tmp_path / "depth.npy", np.asfortranarray(values) if by_columns else values)
    capture = read_recording(tmp_path / "depth.npy", ReadOptions(calibration=pinhole_file(tmp_path))).capture
    expected = np.where(depth > 0, depth, np.nan)
    assert np.allclose(capture.derived["depth"], expected, atol=1e-3, equal_nan=True)


@pytest.mark.parametrize("name", ["a.tiff", "a.tif", "a.pfm", "a.pgm"])
@pytest.mark.parametrize("metres", [False, True])
def test_depths_in_images_of_floating_point_and_of_16_bits(tmp_path, name, metres):
    """A PFM has its rows from the bottom."""
    depth = np.nan_to_num(pinhole_cloud()[..., 2]).round()
    whole = name == "a.pgm"
    values = depth.astype(np.uint16) if whole else (depth / 1000 if metres else depth).astype(np.float32)
    assert cv2.imwrite(str(tmp_path / name), values)
    capture = read_recording(tmp_path / name, ReadOptions(calibration=pinhole_file(tmp_path))).capture
    expected = np.where(depth > 0, depth, np.nan)
    assert np.allclose(capture.derived["depth"], expected, atol=1e-3, equal_nan=True)


@pytest.mark.parametrize(("scale", "read"), [("-1", True), ("-1.000000", True), ("-0.003922", False), ("-2", False)])
def test_a_scale_in_a_pfm_is_refused_since_programs_differ(tmp_path, scale, read):
    """Middlebury writes -1/255 beside numbers that are as they are; OpenCV divides by it."""
    depth = np.full((60, 80), 0.6, "<f4")
    (tmp_path / "a.pfm").write_bytes(f"Pf\n80 60\n{scale}\n".encode() + depth.tobytes())
    camera = {"fx": 80.0, "fy": 80.0, "cx": 39.5, "cy": 29.5, "width": 80, "height": 60}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    options = ReadOptions(calibration=str(tmp_path / "camera.json"))
    if read:
        assert np.allclose(read_recording(tmp_path / "a.pfm", options).capture.derived["depth"], 600)
        return
    with pytest.raises(InputError, match=f"scale: found {scale}; allowed: 1 or -1"):
        read_recording(tmp_path / "a.pfm", options)


def test_the_largest_level_is_no_depth(tmp_path):
    """Before, pixels without a depth stood at 65.5 m."""
    depth = np.nan_to_num(pinhole_cloud()[..., 2]).round().astype(np.uint16)
    depth[:3] = 65535
    assert cv2.imwrite(str(tmp_path / "a.png"), depth)
    options = ReadOptions(calibration=pinhole_file(tmp_path))
    capture = read_recording(tmp_path / "a.png", options).capture
    assert np.isnan(capture.derived["depth"][:3]).all()
    assert np.nanmax(capture.derived["depth"]) == depth[3:].max()
    assert "6.2\N{NO-BREAK SPACE}% of the pixels have the level 65535" in capture.settings["warnings"][0]
    told = read_recording(tmp_path / "a.png", replace(options, invalid=65535)).capture
    assert "warnings" not in told.settings and np.isnan(told.derived["depth"][:3]).all()


@pytest.mark.parametrize(("name", "says"), [("a.raw", "bytes without their size"), ("a.jpg", "8 bits")])
def test_images_that_have_no_depths_are_refused_with_the_reason(tmp_path, name, says):
    if name == "a.jpg":
        cv2.imwrite(str(tmp_path / name), np.full((48, 64), 90, np.uint8))
    else:
        (tmp_path / name).write_bytes(bytes(100))
    with pytest.raises(InputError, match=says):
        read_recording(tmp_path / name, ReadOptions(calibration=pinhole_file(tmp_path)))


def test_points_in_an_array_are_an_organised_cloud(tmp_path):
    np.save(tmp_path / "points.npy", pinhole_cloud().astype(float))
    capture = read_recording(tmp_path / "points.npy", ReadOptions()).capture
    assert np.allclose(capture.derived["points"], pinhole_cloud(), equal_nan=True)
    np.save(tmp_path / "points.npy", pinhole_cloud()[None])
    with pytest.raises(InputError, match="rows x columns"):
        read_recording(tmp_path / "points.npy", ReadOptions())
    with (tmp_path / "two.npy").open("wb") as stream:  # before, the first was read
        np.save(stream, pinhole_cloud())
        np.save(stream, pinhole_cloud())
    with pytest.raises(InputError, match="bytes beyond the array"):
        read_recording(tmp_path / "two.npy", ReadOptions())
    np.save(tmp_path / "points.npy", np.array(["a"]))
    with pytest.raises(InputError, match="real numbers"):
        read_recording(tmp_path / "points.npy", ReadOptions())


@pytest.mark.parametrize("size", [(424, 240), (1280, 720), (640, 480)])
def test_a_depth_of_any_resolution_has_the_scaled_camera_of_its_preset(tmp_path, size):
    """The field of view across the middle is that of the preset, or cut to the shape of the image."""
    (tmp_path / "depth.png").write_bytes(encode_png(np.full(size[::-1], 700, np.uint16)))
    capture = read_recording(tmp_path / "depth.png", ReadOptions(sensor="realsense-d435")).capture
    full = load_sensor("realsense-d435").rig.reference
    scale = max(size[0] / full.width, size[1] / full.height)
    camera = capture.rig.reference
    assert camera.matrix[0, 0] == pytest.approx(scale * full.matrix[0, 0])
    # the direction at the middle of the images is the same
    middles = [eye.rays(np.array([(eye.width - 1) / 2, (eye.height - 1) / 2])) for eye in (camera, full)]
    assert np.abs(middles[0] - middles[1]).max() < 1e-9
    assert any("--calibration" in note for note in capture.settings["warnings"])


def test_the_cloud_of_another_unit_than_the_preset_has_its_own_camera(tmp_path):
    """A preset is the camera of a type; a calibration is that of the unit, and has to fit."""
    path = tmp_path / "scan.ply"
    path.write_bytes(ply(bent_cloud(), grid="none"))
    capture = read_recording(path, ReadOptions(sensor="zivid-2-m70")).capture
    assert capture.sensor == "zivid-2-m70"
    assert capture.rig.reference.matrix[0, 0] == pytest.approx(88.0, abs=0.01)
    assert capture.decoding.near_mm == read_calibration("zivid-2-m70").range_mm[0]
    wrong = tmp_path / "camera.toml"
    wrong.write_text(
        "[cameras.camera]\nwidth = 96\nheight = 60\nfocal_px = [120.0, 120.0]\nprincipal_px = [47.0, 30.0]\n",
        encoding="utf-8",
    )
    with pytest.raises(InputError, match="px from the view rays"):
        read_recording(path, ReadOptions(calibration=str(wrong)))


def test_a_scaled_camera_keeps_the_field_of_view():
    whole = read_calibration("realsense-d435").rig.reference
    half = read_calibration("realsense-d435", (whole.width // 2, whole.height // 2)).rig.reference
    corners = np.array([[-0.5, -0.5], [whole.width - 0.5, whole.height - 0.5]])
    assert np.allclose(half.rays((corners + 0.5) / 2 - 0.5), whole.rays(corners))
    assert replace(half, width=whole.width) != half
