"""Organised clouds, depth images and stereo pairs of other programs: imported, kept, decoded."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.coupon.patch_table import overall
from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.organised_cloud import read_organised_cloud
from mitsim.capture.recordings.pinhole_fit import fit_pinhole
from mitsim.capture.recordings.stereo_pair import read_stereo_pair
from mitsim.decoding.checks.checked_cloud import checked_cloud
from mitsim.decoding.cloud import capture_cloud, capture_geometry, decoder_settings, sensor_geometry
from mitsim.maps.campaign.acquire import coupon_cloud
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DeviceMapSettings
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from tests.capture.recordings.cloud_files_of_others import pcd, pinhole_cloud, ply
from tests.shell import mitsim_here

CLOUD = pinhole_cloud()
HEIGHT, WIDTH = CLOUD.shape[:2]
PINHOLE = {"fx": 60.0, "fy": 61.0, "cx": 31.3, "cy": 22.8, "width": WIDTH, "height": HEIGHT}


def save(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def pinhole(folder: Path, **changes) -> Path:
    return save(folder / "pinhole.json", json.dumps(PINHOLE | changes).encode())


def decoded(capture: Capture, folder: Path):
    """The cloud of a capture by way of its folder, as ``mitsim decode`` does it."""
    read = read_capture(write_capture(capture, folder))
    return capture_cloud(read, decoder_settings(read)[0])


@pytest.mark.parametrize("name", ["ascii.pcd", "binary.pcd", "binary_compressed.pcd", "binary_little_endian.ply"])
def test_a_cloud_comes_out_as_it_went_in_and_brings_its_camera(tmp_path, name):
    kind, _, ending = name.partition(".")
    content = pcd(CLOUD, kind) if ending == "pcd" else ply(CLOUD, kind)
    capture = read_organised_cloud(save(tmp_path / name, content), ReadOptions())
    assert (capture.technology, capture.source, capture.sensor) == ("point_map", "device", "point-cloud")
    assert capture.settings["unit_of_file"] == "mm"
    # float32 points: 6e-8 of 60 px
    np.testing.assert_allclose(capture.rig.reference.matrix, [[60, 0, 31.3], [0, 61, 22.8], [0, 0, 1]], atol=1e-4)
    cloud = decoded(capture, tmp_path / "c")
    np.testing.assert_array_equal(cloud.points, CLOUD)
    assert (cloud.status[10:14, 20:30] == Status.NO_SURFACE).all()
    seen = cloud.grid.project(CLOUD[cloud.valid].astype(float))
    rows, columns = np.nonzero(cloud.valid)
    np.testing.assert_allclose(seen, np.stack([columns, rows], axis=-1), atol=1e-3)


def test_units_are_told_by_the_distance_or_by_the_user(tmp_path):
    metres = save(tmp_path / "m.pcd", pcd(CLOUD / 1000, "binary"))
    capture = read_organised_cloud(metres, ReadOptions())
    assert capture.settings["unit_of_file"] == "m"
    np.testing.assert_allclose(capture.derived["points"], CLOUD, rtol=1e-6)
    forced = read_organised_cloud(metres, ReadOptions(unit="cm"))
    np.testing.assert_allclose(forced.derived["points"], CLOUD / 100, rtol=1e-6)


@pytest.mark.parametrize(("value", "unit"), [(1e38, "m"), (-3e38, "mm"), (2000.0, "m"), (1e20, None)])
def test_coordinates_that_are_no_measurement_are_refused(tmp_path, value, unit):
    points = CLOUD.copy()
    points[5, 5] = value
    with pytest.raises(InputError, match=r"up to 1e\+06 mm\. check --unit"):
        read_organised_cloud(save(tmp_path / "far.pcd", pcd(points, "binary")), ReadOptions(unit=unit))


def test_zeros_are_no_points(tmp_path):
    capture = read_organised_cloud(save(tmp_path / "z.pcd", pcd(np.nan_to_num(CLOUD), "binary")), ReadOptions())
    np.testing.assert_array_equal(capture.derived["points"], CLOUD)


@pytest.mark.parametrize("mark", [(-1.0, -1.0, -1.0), (0.0, 0.0, -1.0), (5.0, 6.0, 0.0), (1e4, 1e4, 1e4)])
@pytest.mark.parametrize("ending", ["pcd", "ply"])
def test_points_that_stand_for_missing_ones_leave_the_grid(tmp_path, ending, mark):
    """Before, a PLY lost its grid by them, and those of a PCD were points."""
    points = CLOUD.copy()
    points[np.isnan(CLOUD[..., 0])] = mark
    if mark[2] == 0:  # pixels without a depth, whose x and y the program keeps
        points[np.isnan(CLOUD[..., 0]), 0] = np.arange(np.isnan(CLOUD[..., 0]).sum())
    content = pcd(points, "binary") if ending == "pcd" else ply(points, "binary_little_endian", grid="none")
    capture = read_organised_cloud(save(tmp_path / f"a.{ending}", content), ReadOptions())
    np.testing.assert_array_equal(capture.derived["points"], CLOUD)
    assert ("left out, since" in str(capture.settings.get("warnings"))) == (mark[2] != 0)


def test_the_unit_in_a_remark_of_a_ply_counts(tmp_path):
    content = ply(CLOUD * 1000, "ascii").replace(b"\nelement", b"\ncomment units: micrometers\nelement", 1)
    capture = read_organised_cloud(save(tmp_path / "a.ply", content), ReadOptions())
    assert capture.settings["unit_of_file"] == "um"
    np.testing.assert_allclose(capture.derived["points"], CLOUD, rtol=1e-6)
    given = read_organised_cloud(tmp_path / "a.ply", ReadOptions(unit="mm"))
    assert given.settings["unit_of_file"] == "mm"


def test_options_of_depths_and_of_points_are_told_apart(tmp_path):
    np.save(tmp_path / "depth.npy", np.full((48, 64), 700.0))
    with pytest.raises(InputError, match="--unit for an array of depths"):
        read_recording(tmp_path / "depth.npy", ReadOptions(unit="mm", calibration=str(pinhole(tmp_path))))
    np.save(tmp_path / "points.npy", CLOUD)
    with pytest.raises(InputError, match="--scale for an array of points"):
        read_recording(tmp_path / "points.npy", ReadOptions(scale_mm=0.1))


def test_clouds_with_y_up_are_refused_or_turned(tmp_path):
    path = save(tmp_path / "up.pcd", pcd(CLOUD * np.array([1, -1, -1], np.float32), "binary"))
    with pytest.raises(InputError, match=r"behind the camera.*--axes opengl"):
        read_organised_cloud(path, ReadOptions())
    np.testing.assert_array_equal(read_organised_cloud(path, ReadOptions(axes="opengl")).derived["points"], CLOUD)


@pytest.mark.parametrize("mirrored", [[-1, 1, 1], [1, -1, 1]])
def test_mirrored_clouds_are_refused(tmp_path, mirrored):
    path = save(tmp_path / "left.pcd", pcd(CLOUD * np.array(mirrored, np.float32), "binary"))
    with pytest.raises(InputError, match="points that match no camera at the origin"):
        read_organised_cloud(path, ReadOptions())


def test_a_cloud_in_a_workspace_is_refused_and_its_link_undone(tmp_path):
    """The link takes the workspace to the rectified left frame, and the cloud is turned on to the sensor frame."""
    turn = Rotation.from_euler("xyz", [170, 5, 30], degrees=True)
    rectified_from_workspace = Transform(turn.as_matrix(), np.array([10.0, -20.0, 650.0]))
    rectified_from_left = Rotation.from_euler("xyz", [1, -6, 0.5], degrees=True).as_matrix()
    moved = rectified_from_workspace.inverse().points(CLOUD).astype(np.float32)
    path = save(tmp_path / "w.pcd", pcd(moved, "binary"))
    with pytest.raises(InputError, match="workspace"):
        read_organised_cloud(path, ReadOptions())
    angle = float(np.linalg.norm(turn.as_rotvec()))
    link = {
        "Target": "Workspace",
        "Translation": [10.0, -20.0, 650.0],
        "Rotation": {"Angle": angle, "Axis": (turn.as_rotvec() / angle).tolist()},
    }
    calibration = {"Stereo": {"Left": {"Rotation": rectified_from_left.T.tolist()}}}  # stored by columns
    calib = save(tmp_path / "1_2_calib.json", json.dumps({"Link": link, "Calibration": calibration}).encode())
    capture = read_organised_cloud(path, ReadOptions(link=calib))
    np.testing.assert_allclose(capture.derived["points"], CLOUD @ rectified_from_left, atol=1e-3)
    np.testing.assert_allclose(capture.rig.reference.sensor_from_camera.rotation, rectified_from_left.T, atol=1e-12)
    sensor_from_workspace = Transform.from_matrix(capture.settings["sensor_from_workspace"])
    np.testing.assert_allclose(sensor_from_workspace.points(moved), capture.derived["points"], atol=1e-3)
    cloud = decoded(capture, tmp_path / "c")
    seen, (rows, columns) = cloud.grid.project(cloud.points[cloud.valid].astype(float)), np.nonzero(cloud.valid)
    np.testing.assert_allclose(seen, np.stack([columns, rows], axis=-1), atol=2e-3)
    bare = save(tmp_path / "3_4_calib.json", json.dumps({"Link": link}).encode())
    with pytest.raises(InputError, match="Calibration/Stereo/Left/Rotation: found nothing"):
        read_organised_cloud(path, ReadOptions(link=bare))


def test_clouds_that_state_no_grid_have_the_one_of_their_points_or_are_refused(tmp_path):
    for name, content in (("a.ply", ply(CLOUD, grid="none")), ("b.pcd", pcd(CLOUD, "binary", height=1))):
        path = save(tmp_path / name, content)
        for calibration in (None, pinhole(tmp_path)):
            capture = read_organised_cloud(path, ReadOptions(calibration=calibration))
            np.testing.assert_array_equal(capture.derived["points"], CLOUD)
    held = np.isfinite(CLOUD[..., 0])
    for name, content in (("a.ply", ply(CLOUD[held][None], grid="none")), ("b.pcd", pcd(CLOUD[held][None], "binary"))):
        with pytest.raises(InputError, match=r"without a grid.*--calibration"):
            read_organised_cloud(save(tmp_path / name, content), ReadOptions())
        with pytest.raises(InputError, match=f"{held.sum()} points; allowed: 64 x 48"):
            read_organised_cloud(tmp_path / name, ReadOptions(calibration=pinhole(tmp_path)))


def test_a_lens_with_distortion_is_fitted_or_given(tmp_path):
    matrix = np.array([[60.0, 0, 31.3], [0, 61.0, 22.8], [0, 0, 1]])
    camera = Camera(matrix, np.array([-0.2, 0.05, 0, 0, 0]), WIDTH, HEIGHT)
    local = camera.rays(camera.pixel_grid())
    points = (local / local[..., 2:] * CLOUD[..., 2:]).astype(np.float32)
    path = save(tmp_path / "d.pcd", pcd(points, "binary"))
    assert read_organised_cloud(path, ReadOptions()).rig.reference.distortion[:2] == pytest.approx(
        [-0.2, 0.05], abs=1e-2
    )
    shifted = save(tmp_path / "e.pcd", pcd(points + np.float32([30, 0, 0]), "binary"))
    with pytest.raises(InputError, match=r"points that match no camera at the origin: .* px rms.*--calibration"):
        read_organised_cloud(shifted, ReadOptions())
    capture = read_organised_cloud(path, ReadOptions(calibration=pinhole(tmp_path, distortion=[-0.2, 0.05, 0, 0, 0])))
    assert capture.settings["off_the_rays_px"] < 1e-3
    cloud = decoded(capture, tmp_path / "c")
    seen, pixels = camera.project(cloud.points[cloud.valid].astype(float)), camera.pixel_grid()[cloud.valid]
    np.testing.assert_allclose(seen, pixels, atol=1e-3)
    with pytest.raises(InputError, match="px from the view rays of their pixels"):
        read_organised_cloud(path, ReadOptions(calibration=pinhole(tmp_path, cx=35.0)))


DAMAGED = {
    "a.pcd": pcd(CLOUD / 1000, "binary"),
    "b.pcd": pcd(CLOUD, "binary_compressed"),
    "c.ply": ply(CLOUD),
    "d.png": cv2.imencode(".png", np.nan_to_num(CLOUD[..., 2]).astype(np.uint16))[1].tobytes(),
}


@settings(max_examples=200)
@given(st.sampled_from(list(DAMAGED)), st.data())
def test_a_damaged_file_ends_in_words_or_in_a_capture_that_can_be_kept(name, data):
    content = bytearray(DAMAGED[name])
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    for _ in range(data.draw(st.integers(0, 6)) if content else 0):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    with tempfile.TemporaryDirectory() as place:
        path = save(Path(place) / name, bytes(content))
        try:
            found = read_recording(
                path, ReadOptions(calibration=str(pinhole(Path(place))) if name == "d.png" else None)
            )
        except InputError:
            return
        capture = read_capture(write_capture(found.capture, Path(place) / "c", vendor=found.originals))
        cloud = capture_cloud(capture, decoder_settings(capture)[0])
        assert (cloud.grid.width, cloud.grid.height) == (found.capture.rig.reference.width, len(cloud.points))


def test_too_few_points_fit_nothing():
    lone = np.full((40, 40, 3), np.nan, np.float32)
    lone[:5, :5] = [1, 2, 300]
    assert fit_pinhole(lone) is None
    assert fit_pinhole(np.broadcast_to(np.array([1, 2, 300], np.float32), (40, 40, 3))) is None


@settings(max_examples=60)
@given(
    st.floats(50, 2000), st.floats(0.9, 1.1), st.floats(0, 1), st.floats(0, 1), st.integers(20, 60), st.integers(30, 70)
)
def test_any_pinhole_is_found_from_its_points(f, aspect, x, y, rows, columns):
    row, column = np.mgrid[:rows, :columns].astype(float)
    z = 500 + 20 * np.sin(row) + column
    points = np.stack([(column - x * columns) / f * z, (row - y * rows) / (f * aspect) * z, z], axis=-1)
    found = fit_pinhole(points.astype(np.float32))
    if rows * columns < 1000:
        assert found is None
        return
    camera, rms = found
    # rounding of x and z to float32 moves a pixel by 1e-7 of its place; the lines are fitted to a thousand of them
    assert rms < 1e-4
    np.testing.assert_allclose(camera.matrix[[0, 1], [0, 1]], [f, f * aspect], rtol=1e-5)
    np.testing.assert_allclose(camera.matrix[:2, 2], [x * columns, y * rows], atol=1e-3)


def depth_png(folder: Path, depth: np.ndarray, name: str = "depth.png") -> Path:
    return save(folder / name, cv2.imencode(Path(name).suffix, depth)[1].tobytes())


@pytest.mark.parametrize("name", ["depth.png", "depth.tif"])
@pytest.mark.parametrize(("scale", "invalid"), [(1.0, 0), (0.1, 0), (0.5, 65535)])
def test_a_depth_image_becomes_points_on_its_cameras_rays(tmp_path, name, scale, invalid):
    levels = np.where(np.isfinite(CLOUD[..., 2]), np.rint(CLOUD[..., 2] / scale), invalid).astype(np.uint16)
    capture = read_depth_image(
        depth_png(tmp_path, levels, name), ReadOptions(calibration=pinhole(tmp_path), scale_mm=scale, invalid=invalid)
    )
    assert capture.technology == "depth_map"
    cloud = decoded(capture, tmp_path / "c")
    known = levels != invalid
    np.testing.assert_array_equal(cloud.valid, known)
    np.testing.assert_allclose(cloud.points[known][:, 2], levels[known] * scale, rtol=1e-6)
    columns = np.nonzero(known)[1]
    x = (columns - 31.3) / 60 * levels[known] * scale
    np.testing.assert_allclose(cloud.points[known][:, 0], x, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    ("mark", "kind", "warning"),
    [
        (-1.0, np.float32, "a depth under 0"),
        (-9999.0, np.float64, "a depth under 0"),
        (1e10, np.float32, "the same depth of 1e+10"),
        (np.finfo(np.float32).max, np.float32, "the same depth of 3.4"),
        (60000, np.uint16, "the same depth of 60000"),
        (-1, np.int16, "a depth under 0"),
        (-1, np.int32, "a depth under 0"),
        (np.inf, np.float32, None),
    ],
)
def test_levels_that_no_surface_has_are_missing(tmp_path, mark, kind, warning):
    """Before, most of these were refused, and a depth of 60000 was one of 60 m."""
    hole = np.isnan(CLOUD[..., 2])
    levels = np.where(hole, 0, np.rint(CLOUD[..., 2])).astype(kind)
    levels[hole] = mark
    assert cv2.imwrite(str(tmp_path / "depth.tif"), levels)
    capture = read_depth_image(tmp_path / "depth.tif", ReadOptions(calibration=pinhole(tmp_path)))
    np.testing.assert_array_equal(capture.derived["depth"], np.where(hole, np.nan, np.rint(CLOUD[..., 2])))
    told = capture.settings.get("warnings", [])
    assert warning is None or [warning in each for each in told] == [True]
    assert warning is not None or not told


@pytest.mark.parametrize("name", ["cloud.pcd", "cloud.stl", "cloud.xyz"])
def test_a_cloud_is_not_named_after_another_format(tmp_path, name):
    """Before, a PLY file had the name of an STL or a PCD."""
    write_capture(
        read_depth_image(
            depth_png(tmp_path, np.full((48, 64), 700, np.uint16)), ReadOptions(calibration=pinhole(tmp_path))
        ),
        tmp_path / "c",
    )
    done = mitsim_here("decode", tmp_path / "c", "-o", tmp_path / name, code=2)
    assert "allowed: a PLY file: cloud.ply" in done.stderr
    assert not (tmp_path / name).exists()


def test_a_wall_far_behind_is_a_surface(tmp_path):
    levels = np.where(np.isnan(CLOUD[..., 2]), 6500, np.rint(CLOUD[..., 2])).astype(np.uint16)
    capture = read_depth_image(depth_png(tmp_path, levels), ReadOptions(calibration=pinhole(tmp_path)))
    assert np.isfinite(capture.derived["depth"]).all()
    only_behind = np.where(np.isnan(CLOUD[..., 2]), 0, -CLOUD[..., 2])
    assert cv2.imwrite(str(tmp_path / "behind.tif"), only_behind)
    with pytest.raises(InputError, match="check --scale"):
        read_depth_image(tmp_path / "behind.tif", ReadOptions(calibration=pinhole(tmp_path)))


def test_what_is_wrong_with_a_depth_image_is_named(tmp_path):
    good = np.full((HEIGHT, WIDTH), 700, np.uint16)
    with pytest.raises(InputError, match=r"8 bits.*has lost its depths"):
        read_depth_image(depth_png(tmp_path, good.astype(np.uint8)), ReadOptions(calibration=pinhole(tmp_path)))
    with pytest.raises(InputError, match="size: found 64 x 47 px; allowed: 64 x 48 px"):
        read_depth_image(depth_png(tmp_path, good[1:]), ReadOptions(calibration=pinhole(tmp_path)))
    with pytest.raises(InputError, match="only the level 0"):
        read_depth_image(depth_png(tmp_path, good * 0), ReadOptions(calibration=pinhole(tmp_path)))
    with pytest.raises(InputError, match=r"depth: found 70000 to inf mm; .*check --scale"):
        far = good.astype(np.float32)
        far[0, 0] = 1e38  # before, infinity in the capture
        assert cv2.imwrite(str(tmp_path / "far.tif"), far)
        read_depth_image(tmp_path / "far.tif", ReadOptions(calibration=pinhole(tmp_path), scale_mm=100))
    with pytest.raises(InputError, match="--camera: found 'right'; allowed: camera"):
        read_depth_image(depth_png(tmp_path, good), ReadOptions(calibration=pinhole(tmp_path), camera="right"))
    with pytest.raises(InputError, match="no such file"):
        read_depth_image(depth_png(tmp_path, good), ReadOptions(calibration=tmp_path / "nothing.json"))


def test_a_devices_map_is_decoded_with_the_range_of_its_sensor(tmp_path, n10):
    """Settings of any sensor give the range; of the device's own, all is taken."""
    capture = replace(
        read_organised_cloud(save(tmp_path / "a.pcd", pcd(CLOUD, "binary")), ReadOptions()), sensor=n10.name
    )
    near = n10.matcher.model_copy(update={"near_mm": 690.0, "far_mm": 720.0})
    cloud = capture_cloud(capture, near)
    z = CLOUD[..., 2]
    np.testing.assert_array_equal(cloud.valid, (z >= 690) & (z <= 720))
    assert (cloud.status[z > 721] == Status.OUT_OF_RANGE).all()
    assert decoder_settings(replace(capture, sensor="other"))[0] == DeviceMapSettings(near_mm=1e-3, far_mm=1e6)
    told = replace(capture, sensor="other", decoding=Decoding(near_mm=5, far_mm=4))
    with pytest.raises(InputError, match=r"settings\.json.*near_mm under far_mm"):
        decoder_settings(told)
    with pytest.raises(InputError, match="map of depth, since its technology is depth_map"):
        capture_cloud(replace(capture, technology="depth_map"), near)


def test_a_campaigns_window_of_the_sensor_holds_the_coupon_in_the_devices_own_grid(n10: Sensor):
    """A coupon's part is asked for in the grid of the sensor file; the map has another grid, and shows the same."""
    geometry = sensor_geometry(n10)
    eye = Camera(
        np.array([[400.0, 0, 160.0], [0, 400.0, 120.0], [0, 0, 1]]),
        np.zeros(5),
        320,
        240,
        n10.rig.reference.sensor_from_camera,
    )
    capture = Capture(
        n10.name,
        "depth_map",
        "device",
        Rig({"depth": eye}),
        {},
        16,
        derived={"depth": np.full((240, 320), 500.0, np.float32)},
    )
    centre = np.array([10.0, -20.0, 500.0])
    corners = centre + np.array([[x, y, 0] for x in (-30, 30) for y in (-30, 30)])
    pixels = geometry.grid.project(corners)
    roi = Roi.between(*np.floor(pixels.min(axis=0)), *np.ceil(pixels.max(axis=0)))
    cloud = capture_cloud(capture, n10.settings, geometry, roi)
    whole = capture_cloud(capture, n10.settings)
    on_coupon = np.abs(whole.points[..., :2] - centre[:2]).max(axis=-1) < 30
    assert on_coupon.sum() > 1000
    np.testing.assert_array_equal(cloud.points[on_coupon], whole.points[on_coupon])
    assert cloud.valid.sum() < 0.5 * whole.valid.sum()


def test_coupons_in_depth_maps_give_the_fraction_and_noise_that_were_put_in(n10: Sensor, rng):
    """F = 0.9 and sigma = 0.2 mm along the ray, by the metrics of every campaign, on the device's own grid."""
    eye = Camera(np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), np.zeros(5), 640, 480)
    ray = eye.rays(eye.pixel_grid())
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    along = np.cross(normal, [0.0, 1.0, 0.0])
    coupon = Coupon(np.array([10.0, -5.0, 500.0]), normal, along / np.linalg.norm(along), 160, 160)
    distance = (coupon.centre @ normal) / (ray @ normal) + 0.2 * rng.standard_normal(ray.shape[:2])
    kept = rng.random(ray.shape[:2]) < 0.9
    depth = np.where(kept, distance * ray[..., 2], np.nan).astype(np.float32)
    capture = Capture(n10.name, "depth_map", "device", Rig({"depth": eye}), {}, 16, derived={"depth": depth})
    geometry = capture_geometry(capture, n10.settings)
    found = overall(measure_patches(coupon_cloud(capture, coupon, geometry, n10), coupon))
    # 160 x 160 px: the standard error of F is 0.3 / 160, that of sigma 0.2 / sqrt(2 x 160^2); both times 4
    assert found.fraction == pytest.approx(0.9, abs=0.008)
    assert found.sigma == pytest.approx(0.2, abs=0.004)


STEREO = """%YAML:1.0
---
K1: [[300., 0., 100.], [0., 300., 60.], [0., 0., 1.]]
K2: [[300., 0., 100.], [0., 300., 60.], [0., 0., 1.]]
D1: [0., 0., 0., 0., 0.]
D2: [0., 0., 0., 0., 0.]
R: [[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]]
T: [-40., 0., 0.]
image_size: [200, 120]
"""


def test_a_stereo_pair_and_opencvs_calibration_measure_a_plane(tmp_path, rng):
    """A plane squarely at f B / d = 300 40 / 24 = 500 mm."""
    texture = cv2.GaussianBlur(rng.integers(0, 256, (120, 400)).astype(np.float32), (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    (tmp_path / "pair").mkdir()
    for number, shift in enumerate((24, 12)):
        depth_png(tmp_path / "pair", texture[:, 100:300], f"left_{number}.png")
        colour = np.repeat(texture[:, 100 + shift : 300 + shift, None], 3, axis=2)
        colour[..., 0] //= 2  # of a colour camera green is taken
        depth_png(tmp_path / "pair", colour, f"right_{number}.png")
    calibration = save(tmp_path / "stereo.yml", STEREO.encode())
    with pytest.raises(InputError, match=r"2 pairs.*--frame 0 to 1"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=calibration))
    for number, depth in ((0, 500.0), (1, 1000.0)):
        capture = read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=calibration, frame=number))
        cloud = decoded(capture, tmp_path / f"c{number}")
        assert cloud.valid.mean() > 0.5
        assert np.median(cloud.points[cloud.valid][:, 2]) == pytest.approx(depth, rel=0.01)
    with pytest.raises(InputError, match="--frame: found 2"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=calibration, frame=2))
    with pytest.raises(InputError, match="two cameras"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=pinhole(tmp_path)))
    (tmp_path / "pair" / "right_1.png").unlink()
    with pytest.raises(InputError, match="2 of left and 1 of right"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=calibration))


def test_a_thumbnail_beside_a_pair_does_not_count(tmp_path):
    """Before, a calibration without a size was checked with that of the thumbnail."""
    (tmp_path / "pair").mkdir()
    for name, shape in (("a_preview", (12, 20)), ("left_0", (120, 200)), ("right_0", (120, 200))):
        depth_png(tmp_path / "pair", np.full(shape, 90, np.uint8), f"{name}.png")
    calibration = save(tmp_path / "stereo.yml", STEREO.replace("image_size: [200, 120]\n", "").encode())
    capture = read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=calibration))
    assert capture.images["left"].shape == (1, 120, 200)
    assert (capture.rig.reference.width, capture.rig.reference.height) == (200, 120)
    wrong = save(tmp_path / "wrong.yml", calibration.read_bytes().replace(b"300., 0., 100.", b"300., 0., 9000."))
    with pytest.raises(InputError, match=r"wrong\.yml: .*principal"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=wrong))


@pytest.mark.parametrize(
    ("order", "told"),
    [
        ((0, 24), ""),
        ((24, 0), "the images of left and right fit the calibration if they are exchanged"),
        ((0, 0), "the images of left and right are the same"),
    ],
)
def test_a_pair_that_contradicts_its_calibration_is_said(tmp_path, rng, order, told):
    """Before, exchanged images gave points in a third of the pixels, 200 mm off, without a word."""
    texture = cv2.GaussianBlur(rng.integers(0, 256, (120, 400)).astype(np.float32), (0, 0), 1.5)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    (tmp_path / "pair").mkdir()
    for side, shift in zip(("left", "right"), order, strict=True):
        depth_png(tmp_path / "pair", texture[:, 100 + shift : 300 + shift], f"{side}.png")
    capture = read_stereo_pair(
        tmp_path / "pair", ReadOptions(calibration=save(tmp_path / "stereo.yml", STEREO.encode()))
    )
    warnings = checked_cloud(capture, *decoder_settings(capture)).warnings
    assert [told in each for each in warnings] == ([True] if told else [])


@pytest.mark.parametrize(("factor", "bits", "empty"), [(16, 12, 0), (256, 8, 8), (4, 10, 0)])
def test_a_pair_of_more_bits_has_the_contrast_of_one_of_eight(tmp_path, rng, factor, bits, empty):
    """Before, 12 bits in files of 16 had a sixteenth of the contrast, and saturated pixels were not known."""
    texture = cv2.GaussianBlur(rng.integers(0, 256, (60, 300)).astype(np.float32), (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint16)
    low = 0 if empty else rng.integers(0, factor, texture.shape)
    levels = (texture * factor + low).astype(np.uint16)
    (tmp_path / "pair").mkdir()
    for side, shift in (("left", 0), ("right", 24)):
        depth_png(tmp_path / "pair", np.repeat(levels, 2, axis=0)[:, 50 + shift : 250 + shift], f"{side}.png")
    capture = read_stereo_pair(
        tmp_path / "pair", ReadOptions(calibration=save(tmp_path / "stereo.yml", STEREO.encode()))
    )
    assert (capture.bits, capture.settings.get("empty_bits", 0)) == (bits, empty)
    assert capture.images["left"].max() == (255 if empty else levels[:, 50:250].max())


def test_a_damaged_colour_image_is_not_half_read(tmp_path):
    (tmp_path / "pair").mkdir()
    colour = np.random.default_rng(3).integers(0, 256, (120, 200, 3)).astype(np.uint8)
    for side in ("left", "right"):
        path = depth_png(tmp_path / "pair", colour, f"{side}.png")
    path.write_bytes(path.read_bytes()[:40_000])
    with pytest.raises(InputError, match=r"right\.png: found a PNG cut off"):
        read_stereo_pair(tmp_path / "pair", ReadOptions(calibration=save(tmp_path / "stereo.yml", STEREO.encode())))
