"""Clouds, depth images and calibrations that others recorded, by way of the importer."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from characterisation.coupon.metrics import ray_noise_std
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.decoding.checks.pair_sanity import row_error_warnings
from mitsim.decoding.checks.sanity import pair_row_error
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.stereo import decode_stereo
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from tests.capture.recordings.test_depthai_files import against_the_package

pytestmark = pytest.mark.real

#: of the PrimeSense: base line [mm] and focal length [px], from which its depth steps follow; 1/8 px is its step
BASELINE, FOCAL = 75.0, 525.0


def imported(path: Path, folder: Path, **given):
    """Capture of a recording, by way of its folder, and its cloud."""
    if not path.exists():
        pytest.skip(f"no recording {path.name}")
    found = read_recording(path, ReadOptions(**given))
    capture = read_capture(write_capture(found.capture, folder / "capture", vendor=found.originals))
    return capture, capture_cloud(capture, decoder_settings(capture)[0])


@pytest.mark.parametrize(
    ("name", "axes", "focal", "centre"),
    [
        *((f"capture000{number}.pcd", None, 525.0, (319.5, 239.5)) for number in range(1, 6)),
        ("milk_cartoon_all_small_clorox.pcd", "opengl", 525.0, (319.5, 239.5)),
        ("table_scene_mug_stereo_textured.pcd", None, 964.36, (319.81, 223.36)),
    ],
)
def test_organised_clouds_bring_their_camera_and_unit(real_data, tmp_path, name, axes, focal, centre):
    """525 px and (319.5, 239.5) by the driver of the PrimeSense; the stereo rig's from a fit of its own, elsewhere."""
    capture, cloud = imported(real_data / "primesense_pcl" / name, tmp_path, axes=axes)
    K = capture.rig.reference.matrix
    assert (cloud.grid.width, cloud.grid.height, capture.settings["unit_of_file"]) == (640, 480, "m")
    np.testing.assert_allclose(K[[0, 1], [0, 1]], focal, atol=0.01)
    np.testing.assert_allclose(K[:2, 2], centre, atol=0.01)
    assert capture.settings["fitted_camera_rms_px"] < 0.01
    assert 0.6 < cloud.valid.mean() < 0.9
    assert 500 < np.median(cloud.points[cloud.valid][:, 2]) < 3000
    assert (cloud.points[cloud.valid][:, 2] > 0).all()


def test_a_cloud_with_y_up_is_refused_with_what_to_do(real_data, tmp_path):
    path = real_data / "primesense_pcl" / "milk_cartoon_all_small_clorox.pcd"
    with pytest.raises(InputError, match="--axes opengl"):
        imported(path, tmp_path)


def flattest(cloud, near: float, far: float, side: int = 20) -> tuple[float, float]:
    """Sigma along the view ray of the flattest tenth of all whole patches between two distances, and their distance."""
    patches = [
        cloud.points[row : row + side, column : column + side].reshape(-1, 3)
        for row in range(0, 480 - side + 1, side // 2)
        for column in range(0, 640 - side + 1, side // 2)
    ]
    patches = np.stack([patch for patch in patches if np.isfinite(patch).all()])
    distance = np.linalg.norm(patches.mean(axis=1), axis=-1)
    patches, distance = patches[(distance > near) & (distance < far)], distance[(distance > near) & (distance < far)]
    sigma = ray_noise_std(patches).sigma
    few = np.argsort(sigma)[: max(1, len(sigma) // 10)]
    return float(np.median(sigma[few])), float(np.median(distance[few]))


@pytest.mark.parametrize(
    ("name", "axes", "near", "far", "bound"),
    [
        ("milk_cartoon_all_small_clorox.pcd", "opengl", 600, 800, 1.3),
        ("capture0005.pcd", None, 1300, 1500, 3.3),
    ],
)
def test_noise_of_a_primesense_on_planes(real_data, tmp_path, name, axes, near, far, bound):
    """Published beside the clouds as upper bounds: 1.3 mm at 0.7 m, 3.3 mm at 1.3 m.

    Under them lies what rounding alone makes of a tilted surface: steps of 1/8 px are Z^2 / (8 f B), their standard
    deviation 1/sqrt(12) of that.
    """
    _, cloud = imported(real_data / "primesense_pcl" / name, tmp_path, axes=axes)
    sigma, distance = flattest(cloud, near, far)
    rounding = distance**2 / (8 * FOCAL * BASELINE) / np.sqrt(12)
    print(f"{distance:.0f} mm: sigma {sigma:.2f} mm, of rounding {rounding:.2f} mm")
    assert rounding < sigma < bound


def recordings_of_oaks(real_data) -> list[Path]:
    return sorted((real_data / "oak" / "depth_recordings").glob("*.npz"))


def test_depth_images_of_ten_oaks_come_out_as_the_card_they_saw(real_data, tmp_path):
    """A card at 0.68 to 0.71 m. Their depths are f B / d of whole pixels d, rounded to mm: so is the decoded cloud."""
    files = recordings_of_oaks(real_data)
    if not files:
        pytest.skip("no depth recordings")
    assert len(files) == 10
    for number, file in enumerate(files):
        with np.load(file) as table:
            stack = next(table[key] for key in table.files if table[key].dtype == np.uint16)
        depth = stack.reshape(-1, *stack.shape[-2:])[0]
        png = tmp_path / f"{file.stem}.png"
        assert cv2.imwrite(str(png), depth)
        intrinsics = tmp_path / "camera.json"  # assumed: what matters here are depths
        intrinsics.write_text('{"fx": 404, "fy": 404, "cx": 320, "cy": 180, "width": 640, "height": 360}')
        _, cloud = imported(png, tmp_path / str(number), calibration=str(intrinsics))
        np.testing.assert_array_equal(cloud.valid, depth > 0)
        np.testing.assert_array_equal(cloud.points[cloud.valid][:, 2], depth[depth > 0])
        middle = np.median(cloud.points[cloud.valid][:, 2])
        assert 675 < middle < 712
        levels, counts = np.unique(depth[(depth > 600) & (depth < 800)], return_counts=True)
        levels = levels[counts > 20].astype(float)
        product = 1 / np.median(np.diff(1 / levels[::-1]))  # f B of steps of one pixel
        # a depth rounded to 1 mm moves f B / Z by half a mm of 700, of 40 px: 0.03; f B itself is known to 1 %
        offset = product / levels - np.rint(product / levels)
        assert np.ptp(np.unwrap(2 * np.pi * offset)) / (2 * np.pi) < 0.25
        assert product == pytest.approx(404 * 75, rel=0.05)


@pytest.mark.skipif(find_spec("depthai") is None, reason="no depthai: pip install 'mitsim[depthai]'")
@pytest.mark.parametrize(
    "name",
    [
        "eeprom/oak-d_BW1098OBC_v6_depthai_calib.json",
        "eeprom/sdk_1m_calib.json",
        "eeprom/people_counting_calib.json",
        "eeprom/new_calibration.json",
        "eeprom/OAK-D-PRO_eeprom.json",
        "eeprom/calib_18443010F116631200.json",
        "wall_3470mm/calib_sensor_07.json",
        "wall_3470mm/calib_sensor_07_051923.json",
    ],
)
def test_calibrations_of_real_units_are_read_as_depthai_reads_them(real_data, name):
    path = real_data / "oak" / name
    if not path.is_file():
        pytest.skip(f"no calibration {path.name}")
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    against_the_package(path)


def test_an_imported_ensenso_is_the_recording(real_data, tmp_path):
    """By way of the importer and of the folder: the same cloud as from the recording itself."""
    path = real_data / "ensenso" / "colorized_point_cloud" / "stereo.zip"
    if not path.is_file():
        pytest.skip(f"no recording {path.name}")
    found = read_recording(path, ReadOptions())
    capture = read_capture(write_capture(found.capture, tmp_path / "capture", vendor=found.originals))
    settings, _ = decoder_settings(capture)
    roi = Roi(500, 400, 60, 40)
    cloud = capture_cloud(capture, settings, roi=roi)
    left, right = (capture.images[side][0] for side in ("left", "right"))
    context = ImageContext(capture.sensor, "device", 255, roi=roi)
    expected = decode_stereo(left, right, stereo_geometry(capture.rig), settings, context)
    np.testing.assert_array_equal(cloud.points, expected.points)
    assert cloud.valid[400:440, 500:560].mean() > 0.99
    assert {file.suffix for file in (tmp_path / "capture" / "vendor").iterdir()} == {".png", ".json"}


@pytest.mark.parametrize(
    ("calibration", "rows"), [("calib_sensor_07.json", 0.58), ("calib_sensor_07_051923.json", -0.05)]
)
def test_the_older_calibration_of_the_oak_is_told_by_its_rows(real_data, tmp_path, calibration, rows):
    """Two calibrations of one unit: the markers on the wall fit the newer one to 0.13 px, the older to 0.41 px."""
    folder = real_data / "oak/wall_3470mm"
    capture, cloud = imported(
        folder, tmp_path, calibration=str(folder / calibration), frame=0, range_mm=(1500.0, 8000.0)
    )
    found = pair_row_error(capture, cloud)
    assert found == pytest.approx(rows, abs=0.05)
    assert len(row_error_warnings(found)) == (rows > 0.3)
