"""Real Ensenso recordings through our own reading, rectification, matching and metric.

Published beside the recordings: local noise 0.265 mm on the N35-604's sheet; dots of the N10's plates 18.75 mm apart;
the vendor software's own pose of the N35-806's plate in its workspace.
"""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from characterisation.coupon.metrics import ray_noise_std
from characterisation.point_cloud import Status
from characterisation.region_of_interest import Roi
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.recordings.ensenso import ensenso_originals, read_ensenso
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.stereo import decode_stereo
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.transforms import Transform

pytestmark = pytest.mark.real

# the sheet's inside in the N35-604's rectified image
COLUMNS, ROWS, PATCH = (360, 920), (270, 610), 40
BLOW_UP = 8


@pytest.fixture(scope="module")
def sheet(real_data, tmp_path_factory):
    """Cloud of the hand-held sheet, by way of a capture folder."""
    path = real_data / "ensenso" / "colorized_point_cloud" / "stereo.zip"
    folder = tmp_path_factory.mktemp("captures") / "sheet"
    capture = read_capture(write_capture(read_ensenso(path), folder, vendor=ensenso_originals(path)))
    assert (capture.sensor, capture.serial, capture.source) == ("N35-604-16-BL", "160606", "device")
    assert capture.settings["projector_on"] is True
    assert capture.decoding.exposure_s == pytest.approx(0.153e-3, rel=0.01)
    settings = MatcherSettings(near_mm=capture.decoding.near_mm, far_mm=capture.decoding.far_mm)
    left, right = capture.images["left"][0], capture.images["right"][0]
    roi = Roi.between(COLUMNS[0], ROWS[0], COLUMNS[1], ROWS[1])
    return decode_stereo(
        left,
        right,
        stereo_geometry(capture.rig),
        settings,
        ImageContext(capture.sensor, capture.source, 2**capture.bits - 1, roi=roi),
    )


def test_the_sheet_is_recovered_whole(sheet):
    inside = sheet.status[ROWS[0] : ROWS[1], COLUMNS[0] : COLUMNS[1]]
    assert np.mean(inside == Status.VALID) > 0.999
    distance = np.linalg.norm(sheet.points[sheet.valid], axis=-1)
    assert 430 < np.median(distance) < 465


def test_noise_along_the_view_ray_of_the_sheet(sheet):
    patches = np.stack(
        [
            sheet.points[row : row + PATCH, column : column + PATCH].reshape(-1, 3)
            for row in range(ROWS[0], ROWS[1] - PATCH + 1, PATCH)
            for column in range(COLUMNS[0], COLUMNS[1] - PATCH + 1, PATCH)
        ]
    )
    sigma = np.median(ray_noise_std(patches).sigma)
    assert sigma == pytest.approx(0.265, rel=0.15)


def dots(image: np.ndarray, diameter: float = 12.0) -> np.ndarray:
    """Centres (n, 2) [px] of the dark round dots, some with a bright middle, of calibration plates."""
    like = np.pi / 4 * diameter**2
    size = (image.shape[1] * BLOW_UP, image.shape[0] * BLOW_UP)
    fine = cv2.GaussianBlur(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), (0, 0), BLOW_UP)
    dark = cv2.adaptiveThreshold(
        fine, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, int(2 * diameter) * BLOW_UP + 1, 6
    )
    found = []
    outlines, family = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for outline, (_, _, _, parent) in zip(outlines, family[0], strict=True):
        area, length = cv2.contourArea(outline), cv2.arcLength(outline, True)
        if parent < 0 and 0.53 * like < area / BLOW_UP**2 < 1.95 * like and 4 * np.pi * area / length**2 > 0.75:
            moments = cv2.moments(outline)
            centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
            found.append((centre + 0.5) / BLOW_UP - 0.5)  # pixel centres at integers, in both
    return np.array(found)


def triangulated_dots(capture) -> tuple[np.ndarray, np.ndarray]:
    """Dots as points (n, 3) [mm] in the rectified left frame, and their difference in row [px], left less right."""
    geometry = stereo_geometry(capture.rig)
    left, right = (
        dots(cv2.remap(capture.images[name][0], chart[0], chart[1], cv2.INTER_CUBIC))
        for name, chart in (("left", geometry.map_left), ("right", geometry.map_right))
    )
    pair = geometry.rectification
    # between these depths there is one candidate at most: dots are 25 px apart, the disparities span 18 px
    least, most = pair.disparity(475.0), pair.disparity(415.0)
    points, rows = [], []
    for column, row in left:
        disparity, difference = column - right[:, 0], row - right[:, 1]
        match = np.flatnonzero((np.abs(difference) < 2) & (disparity > least) & (disparity < most))
        if len(match) == 1:
            z = float(pair.depth(disparity[match[0]]))
            K = pair.matrix_left
            points.append([(column - K[0, 2]) / K[0, 0] * z, (row - K[1, 2]) / K[1, 1] * z, z])
            rows.append(difference[match[0]])
    return np.array(points), np.array(rows)


def spacings(points: np.ndarray) -> np.ndarray:
    """Distances [mm] of all neighbours in a grid of about 18.75 mm; diagonals are 26.5 mm."""
    pairs = cKDTree(points).query_pairs(22.5, output_type="ndarray")
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)


@pytest.fixture(scope="module")
def plates(real_data):
    """Triangulated dots of the two plates and their row differences, by the factory's and the corrected calibration."""
    path = real_data / "ensenso" / "locate_multiple_patterns" / "camera.zip"
    captures = {"static": read_ensenso(path, dynamic=False), "dynamic": read_ensenso(path)}
    assert captures["static"].sensor == "N10-304-18"
    return {name: triangulated_dots(capture) for name, capture in captures.items()}


def spacing_of_plates(points: np.ndarray) -> list[float]:
    means = []
    for plate in (points[points[:, 0] < 10], points[points[:, 0] >= 10]):
        assert len(plate) == 49
        distances = spacings(plate)
        assert len(distances) == 84  # 2 x 7 x 6 neighbours
        assert distances.std() < 0.1
        means.append(distances.mean())
    return means


def test_dots_of_two_plates_are_as_far_apart_as_they_were_made(plates):
    """With the factory calibration, as the published 18.695 and 18.704 mm."""
    assert spacing_of_plates(plates["static"][0]) == pytest.approx([18.75, 18.75], rel=0.005)


def test_the_device_corrects_its_rows_and_hardly_its_scale(plates):
    rows = {name: np.median(difference) for name, (_, difference) in plates.items()}
    assert rows["static"] == pytest.approx(-0.9, abs=0.1)
    assert abs(rows["dynamic"]) < 0.15
    # It also turned each camera by 0.17 mrad toward the other: 2 x 0.17e-3 x 589 px of 133 px are 0.15 % of depth.
    static, dynamic = (np.array(spacing_of_plates(plates[name][0])) for name in ("static", "dynamic"))
    np.testing.assert_allclose(dynamic / static, 1 - 0.0015, atol=0.0006)


def transform_of(node: dict) -> Transform:
    """Of a rotation about an axis and a translation, as NxLib writes them."""
    turn = Rotation.from_rotvec(node["Rotation"]["Angle"] * np.array(node["Rotation"]["Axis"]))
    return Transform(turn.as_matrix(), np.array(node["Translation"]))


def in_rows(centres: np.ndarray) -> np.ndarray:
    """Centres (49, 2) of an upright 7 x 7 plate, row after row."""
    rows = centres[np.argsort(centres[:, 1])].reshape(7, 7, 2)
    return np.concatenate([row[np.argsort(row[:, 0])] for row in rows])


def test_the_workspace_is_the_vendors_own(real_data):
    """The dots of a plate, by ``Link``, lie where the vendor's software found the plate in the workspace."""
    folder = real_data / "ensenso" / "locate_pattern"
    capture = read_ensenso(folder / "camera.zip", frame=0)
    assert capture.settings["link_target"] == "Irmgard"
    geometry, pair = stereo_geometry(capture.rig), capture.rig.rectification
    left, right = (
        in_rows(dots(cv2.remap(capture.images[name][0], chart[0], chart[1], cv2.INTER_CUBIC), diameter=26.0))
        for name, chart in (("left", geometry.map_left), ("right", geometry.map_right))
    )
    z = pair.depth(left[:, 0] - right[:, 0])
    rays = np.linalg.solve(pair.matrix_left, np.column_stack([left, np.ones(49)]).T).T
    in_sensor = (rays * z[:, None]) @ pair.rotation_left
    workspace_from_sensor = Transform.from_matrix(capture.settings["sensor_from_workspace"]).inverse()
    found = workspace_from_sensor.points(in_sensor)
    steps = 18.75 * (np.arange(7) - 3)
    plate = np.stack([*np.meshgrid(steps, steps), np.zeros((7, 7))], axis=-1).reshape(-1, 3)
    vendors = transform_of(json.loads((folder / "pattern_pose.json").read_text())).points(plate)
    off, nearest = cKDTree(vendors).query(found)
    assert len(set(nearest)) == 49
    # the plate's middle is a mean of 49 dots; a dot alone is uncertain by 0.03 px of disparity, 2.4 mm/px
    assert np.linalg.norm(found.mean(axis=0) - vendors.mean(axis=0)) < 0.05
    assert np.sqrt(np.mean(off**2)) < 0.1


@pytest.mark.parametrize("name", ["telecentric_projection", "stereo_camera"])
def test_virtual_cameras_are_told_from_real_ones(real_data, name):
    capture = read_ensenso(real_data / "ensenso" / name / "camera.zip")
    assert capture.source == ("simulated" if name == "telecentric_projection" else "device")
