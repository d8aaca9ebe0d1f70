"""Recorded stereo pairs of others through our decoder, and the simulated N35 beside the recorded one."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from characterisation.coupon.metrics import ray_noise_std
from characterisation.region_of_interest import Roi
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.ensenso import read_ensenso
from mitsim.capture.recordings.stereo_pair import read_stereo_pair
from mitsim.capture.simulated.rendering import Rendering
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.depth_range import surface_beyond
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.stereo import decode_stereo
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.transforms import Transform
from tests.figures_of_surfaces import mean_run_length

pytestmark = pytest.mark.real

# the sheet's inside in the N35-604's rectified image, and in its raw left image
COLUMNS, ROWS, PATCH = (360, 920), (270, 610), 40
RAW = np.s_[300:600, 450:950]


def gray(path) -> np.ndarray:
    if not path.is_file():
        pytest.skip(f"no recording {path.name}")
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def rectified_rig(matrix, baseline: float, size, matrix_right=None) -> Rig:
    """A pair whose images are rectified already."""
    right = matrix if matrix_right is None else matrix_right
    place = Transform(np.eye(3), np.array([baseline, 0.0, 0.0]))
    cameras = {"left": Camera(matrix, np.zeros(5), *size), "right": Camera(right, np.zeros(5), *size, place)}
    return Rig(cameras, rectification=Rectification(matrix, right, np.eye(3), np.eye(3), baseline, *size))


def decoded(left, right, rig, settings):
    return decode_stereo(left, right, stereo_geometry(rig), settings, ImageContext("recorded", "device", 255))


MATCHERS = pytest.mark.parametrize(
    "changes",
    [
        {},
        {"method": "correlation", "block_size": 9},
    ],
    ids=["sgbm", "correlation"],
)


@MATCHERS
def test_squares_of_a_board_seen_by_a_realsense(real_data, changes):
    """Published beside the pair: squares of 22.9 +- 0.7 mm at about 440 mm."""
    left, right = (gray(real_data / "simsense" / f"{side}1.png") for side in ("left", "right"))
    matrix = np.array([[427.12, 0, 426.93], [0, 427.12, 234.78], [0, 0, 1]])
    settings = MatcherSettings(near_mm=200, far_mm=2000, **changes)
    cloud = decoded(left, right, rectified_rig(matrix, 50.0, (left.shape[1], left.shape[0])), settings)
    assert cloud.valid.mean() > 0.8
    found, corners = cv2.findChessboardCorners(left, (9, 6))
    assert found
    corners = cv2.cornerSubPix(left, corners, (4, 4), (-1, -1), (3, 50, 1e-4)).astype(np.float32)
    points = cv2.remap(cloud.points, corners[..., 0], corners[..., 1], cv2.INTER_LINEAR).reshape(6, 9, 3)
    sides = np.concatenate([np.linalg.norm(np.diff(points, axis=k), axis=-1).ravel() for k in (0, 1)])
    assert np.isfinite(sides).mean() > 0.9
    assert np.nanmean(sides) == pytest.approx(22.9, abs=0.3)
    assert np.nanstd(sides) < 0.8


@MATCHERS
def test_share_of_bad_pixels_of_the_middlebury_motorcycle(real_data, changes):
    """Pixels off by more than 2 px, of those with a point; the rest of the scene has none, and is not filled."""
    folder = real_data / "middlebury_motorcycle"
    left, right = (gray(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    with np.load(folder / "motorcycle_disp.npz") as file:
        true = file[file.files[0]].astype(float)
    known = np.isfinite(true) & (true > 0)
    matrix = np.array([[994.978, 0, 311.193], [0, 994.978, 254.877], [0, 0, 1]])
    moved = matrix + np.array([[0, 0, 31.086], [0, 0, 0], [0, 0, 0]])
    rig = rectified_rig(matrix, 193.001, (left.shape[1], left.shape[0]), moved)
    near, far = (float(rig.rectification.depth(np.array(disparity))) for disparity in (70.0, 2.0))
    cloud = decoded(left, right, rig, MatcherSettings(near_mm=near, far_mm=far, **changes))
    off = np.abs(rig.rectification.disparity(cloud.points[..., 2]) - true)[cloud.valid & known]
    assert len(off) > 0.75 * known.sum()
    assert np.mean(off > 2) < 0.10
    assert np.median(off) < 0.2


def depthai_rig(path) -> Rig:
    """A second, short reading of a calibration: left (socket 1) and right (socket 2) camera, from centimetres."""
    cameras = dict(json.loads(path.read_text())["cameraData"])

    def camera(entry, place):
        fisheye = entry["cameraType"] == 1
        distortion = np.array(entry["distortionCoeff"][: 4 if fisheye else 14])
        model = "fisheye" if fisheye else "perspective"
        matrix = np.array(entry["intrinsicMatrix"])
        return Camera(matrix, distortion, entry["width"], entry["height"], place, model)

    pose = cameras[2]["extrinsics"]
    assert pose["toCameraSocket"] == 1
    u, _, v = np.linalg.svd(np.array(pose["rotationMatrix"]))
    place = Transform(u @ v, 10 * np.array([pose["translation"][axis] for axis in "xyz"]))
    return Rig({"left": camera(cameras[1], Transform.identity()), "right": camera(cameras[2], place)})


def test_distance_of_a_wall_through_two_fisheye_lenses(real_data):
    """3.53 m by triangulating the corners of its markers, done elsewhere; here the dense points inside of them."""
    calibration = "calib_sensor_07_051923.json"
    folder = real_data / "oak" / "wall_3470mm"
    if not folder.is_dir():
        pytest.skip("no recording of the wall")
    capture = read_stereo_pair(folder, ReadOptions(calibration=folder / calibration, frame=0))
    expected = depthai_rig(folder / calibration)
    for name, camera in capture.rig.cameras.items():  # read here by a few lines of their own
        np.testing.assert_array_equal(camera.matrix, expected.cameras[name].matrix)
        np.testing.assert_array_equal(camera.distortion, expected.cameras[name].distortion)
        place = camera.sensor_from_camera.matrix(), expected.cameras[name].sensor_from_camera.matrix()
        np.testing.assert_allclose(*place, atol=1e-9)
    geometry = stereo_geometry(capture.rig)
    cloud = capture_cloud(capture, MatcherSettings(near_mm=1500, far_mm=8000), geometry)
    left = capture.images["left"][0]
    straight = cv2.remap(left, geometry.map_left[0], geometry.map_left[1], cv2.INTER_LINEAR)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    outlines, numbers, _ = detector.detectMarkers(straight)
    assert set(numbers.ravel()) == set(range(5, 12))
    depths = []
    for outline in outlines:
        inside = cv2.fillConvexPoly(np.zeros(straight.shape, np.uint8), outline[0].astype(np.int32), 1) > 0
        assert cloud.valid[inside].mean() > 0.8
        depths.append(np.median(cloud.points[inside & cloud.valid][:, 2]))
    print(f"{calibration}: {np.median(depths):.0f} mm, {np.ptp(depths):.0f} mm between the markers")
    # 0.14 px of disparity are 20 mm here; the wall is not seen squarely: its markers differ by 70 mm
    assert np.median(depths) == pytest.approx(3530, abs=50)
    assert np.ptp(depths) < 100


@pytest.fixture(scope="module")
def recording(real_data):
    path = real_data / "ensenso" / "colorized_point_cloud" / "stereo.zip"
    if not path.is_file():
        pytest.skip("no N35-604 recording")
    return read_ensenso(path)


def sheet_cloud(capture, rig):
    settings = MatcherSettings(near_mm=292.3, far_mm=530.3)
    roi = Roi.between(COLUMNS[0], ROWS[0], COLUMNS[1], ROWS[1])
    left, right = capture.images["left"][0], capture.images["right"][0]
    return decode_stereo(left, right, stereo_geometry(rig), settings, ImageContext("n35", "device", 255, roi=roi))


def sheet_sigma(cloud) -> float:
    """Median sigma along the view ray of patches of 40 x 40 px [mm]."""
    patches = [
        cloud.points[row : row + PATCH, column : column + PATCH].reshape(-1, 3)
        for row in range(ROWS[0], ROWS[1] - PATCH + 1, PATCH)
        for column in range(COLUMNS[0], COLUMNS[1] - PATCH + 1, PATCH)
    ]
    return float(np.median(ray_noise_std(np.stack(patches)).sigma))


def texture(image) -> dict[str, np.ndarray]:
    """Contrast, autocorrelation at 1 to 3 px and run length of dots, where they are even."""
    values = image.astype(float)
    mean = cv2.boxFilter(values, -1, (31, 31))
    deviation = np.sqrt(cv2.boxFilter((values - mean) ** 2, -1, (31, 31)))
    spectrum = np.abs(np.fft.fft2((values - mean) / deviation)) ** 2
    correlation = np.fft.ifft2(spectrum).real
    correlation = (correlation[0, 1:4] + correlation[1:4, 0]) / 2 / correlation[0, 0]
    run = (mean_run_length(values, mean) + mean_run_length(values.T.copy(), mean.T)) / 2
    return {"deviation": deviation.mean(), "correlation": correlation, "run": run}


def shape_of(cloud) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of the sheet's own smooth shape: a polynomial of degree 6 in 1/z over the whole sheet.

    Its 28 terms follow the bend of 14 x 8 patches, not the noise inside of one.
    """
    grid, window = cloud.grid, np.s_[slice(*ROWS), slice(*COLUMNS)]
    middle = np.array([sum(ROWS) / 2, sum(COLUMNS) / 2])
    half = np.array([np.ptp(ROWS), np.ptp(COLUMNS)]) / 2

    def terms(rows, columns):
        v, u = (rows - middle[0]) / half[0], (columns - middle[1]) / half[1]
        return np.stack([u**i * v**j for i in range(7) for j in range(7 - i)], axis=-1)

    z = (cloud.points[window].astype(float) @ grid.rotation)[..., 2]
    rows, columns = (axis.astype(float) for axis in np.mgrid[window])
    there = np.isfinite(z)
    weights = np.linalg.lstsq(terms(rows[there], columns[there]), 1 / z[there], rcond=None)[0]
    # a border for the matcher, as deep as the edge that it goes on from
    rows, columns = np.mgrid[ROWS[0] - 60 : ROWS[1] + 61 : 8, COLUMNS[0] - 60 : COLUMNS[1] + 61 : 8].astype(float)
    z = 1 / (terms(rows.clip(*ROWS), columns.clip(*COLUMNS)) @ weights)
    local = np.stack([(columns - grid.cx) / grid.fx * z, (rows - grid.cy) / grid.fy * z, z], axis=-1)
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    triangles = np.stack([np.stack(each, axis=-1) for each in ((a, c, b), (b, c, d))])
    return local.reshape(-1, 3) @ grid.rotation.T + grid.origin, triangles.reshape(-1, 3)


def write_mesh(path, vertices, triangles) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    points = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices)
    path.write_text(header + points + "".join(f"3 {a} {b} {c}\n" for a, b, c in triangles))


@pytest.fixture(scope="module")
def simulated_sheet(recording, tmp_path_factory):
    """Captures by the preset's optics, pattern and blur of a matt sheet of the recorded shape, where it was held.

    Exposure and black of the projector, which holds the room's light as well, are those that give the recorded grey
    level and contrast of the dots. Noise is that found on that sheet: 0.13 DN^2 of variance for each DN, so full
    scale, were it straight, stands for 1920 electrons, and 2.3 DN in the dark. All of the sheet lies under the first
    knee of the unit's companding curve, where the curve is straight.
    """
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.scene.load import scene_from_dict
    from mitsim.sensor.preset import load_sensor

    cloud = sheet_cloud(recording, recording.rig)
    mesh = tmp_path_factory.mktemp("sheet") / "sheet.ply"
    vertices, triangles = shape_of(cloud)
    write_mesh(mesh, vertices, triangles)
    preset = load_sensor("ensenso-n35")
    sensor = replace(
        preset,
        rig=replace(recording.rig, projector=preset.projector.optics),
        imager=replace(preset.imager, full_well=250 / 0.13, read_noise=16.0, dsnu=8.0, companding=()),
        pattern=preset.pattern.model_copy(update={"shifts_px": []}),
    )
    sheet = {"type": "ply", "filename": str(mesh), "bsdf": {"type": "matt_white"}}
    scene = scene_from_dict({"sheet": sheet}, sensor.wavelength_nm)
    recorded, offset = recording.images["left"][0][RAW], sensor.imager.black_level

    def captures(seconds, black, seeds, samples):
        changed = replace(
            sensor,
            projector=replace(preset.projector, black_level=black),
            exposure=replace(sensor.exposure, base_s=seconds),
        )
        simulated = SimulatedSensor(changed)
        here = Transform.identity()
        return [
            simulated.capture(scene, here, rendering=Rendering(samples=samples), seed=seed, around=vertices)
            for seed in seeds
        ]

    seconds, black = 8e-5, 0.4
    for _ in range(2):
        found = captures(seconds, black, [0], 4)[0].images["left"][0][RAW]
        # half of the pattern is bright: light of the dots is seconds (1 - black), of level that and twice the black
        dots = seconds * (1 - black) * texture(recorded)["deviation"] / texture(found)["deviation"]
        level = seconds * (1 + black) * (recorded.mean() - offset) / (found.mean() - offset)
        seconds, black = (level + dots) / 2, (level - dots) / (level + dots)
    return captures(seconds, black, [1, 2, 3], 8), cloud


def smooth_contrast(image, column) -> np.ndarray:
    """Standard deviation of the dots, without most of the pixels' noise, in blocks of 50 x 50 px, (6, 10)."""
    smooth = cv2.GaussianBlur(image[280:580, column : column + 500].astype(float), (0, 0), 1.0)
    smooth -= cv2.boxFilter(smooth, -1, (51, 51))
    return smooth.reshape(6, 50, 10, 50).std(axis=(1, 3))


def fine_noise(image) -> tuple[np.ndarray, np.ndarray]:
    """Mean of 5 x 5 px, and the square of what changes sign from pixel to pixel there, which no optics can do."""
    filtered = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70)
    values = image.astype(float)
    return cv2.boxFilter(values, -1, (5, 5)), cv2.sepFilter2D(values, -1, filtered, filtered) ** 2


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_recorded_n35_compands_ten_bits_to_eight(recording, side):
    """out = in, in // 4 + 67 from 89, in // 8 + 128 from 189, 1023 -> 255: it is what levels count, and the noise."""
    # the blurred thing in front of the unit: all levels, and smooth
    image = recording.images[side][0][740:]
    counts = np.bincount(image.ravel(), minlength=256).astype(float)
    before, after = counts[80:89].mean(), counts[90:93].mean()
    # of each: the jump, which the true density takes part in, and 3 of 4 levels of the converter in the first
    assert 3.2 < after / before < 6.0
    assert counts[89] / counts[90] == pytest.approx(0.75, abs=0.08)
    assert counts[189:193].mean() / counts[184:189].mean() == pytest.approx(2.0, abs=0.4)
    level, square = fine_noise(image)
    noise = {}  # [DN of the converter]
    for name, low, high, step in (
        ("dark", 74, 84, 1),
        ("low", 92, 98, 4),
        ("high", 178, 184, 4),
        ("light", 194, 200, 8),
    ):
        noise[name] = step**2 * (square[(level > low) & (level < high)].mean() - 1 / 12)
    # across a knee noise in grey levels falls 14 and 4 times; in levels of the converter it grows by some shot noise
    assert 0.9 < noise["low"] / noise["dark"] < 1.4
    assert 0.9 < noise["light"] / noise["high"] < 1.4


def test_dots_of_the_simulated_n35_look_as_recorded(recording, simulated_sheet):
    captures, _ = simulated_sheet
    ours, real = (texture(each.images["left"][0][RAW]) for each in (captures[0], recording))
    assert ours["deviation"] == pytest.approx(real["deviation"], rel=0.05)
    np.testing.assert_allclose(ours["correlation"], real["correlation"], atol=0.03)
    assert ours["run"] == pytest.approx(real["run"], rel=0.05)


@pytest.mark.parametrize(("side", "column"), [("left", 430), ("right", 380)])
def test_dots_of_the_simulated_n35_fade_outward_as_recorded(recording, simulated_sheet, side, column):
    """The light of projector and lenses: contrast at the sheet's rim relative to its middle."""
    captures, _ = simulated_sheet
    ours, real = (smooth_contrast(each.images[side][0], column) for each in (captures[0], recording))
    ratio = np.log(real / ours) - np.log(real / ours).mean()
    # a block has some 300 dots, which know its contrast to about 6 %; without fading the spread is 0.17, the rim -0.17
    print(f"{side}: {ratio.std():.3f}", np.round(ratio, 2))
    assert ratio.std() < 0.11
    rim = np.ones(ratio.shape, bool)
    rim[1:-1, 2:-2] = False
    assert abs(ratio[rim].mean() - ratio[~rim].mean()) < 0.05


def test_noise_of_the_simulated_sheet_is_that_of_the_recorded_one(recording, simulated_sheet):
    """Same shape, place, contrast, level and matcher; sigma of the simulated one is a mean of three captures."""
    captures, cloud = simulated_sheet
    real = sheet_sigma(cloud)
    each = [sheet_sigma(sheet_cloud(capture, recording.rig)) for capture in captures]
    ours = float(np.mean(each))
    print(f"sheet: recorded {real:.4f} mm, simulated {np.round(each, 4)} mm, ratio {ours / real:.3f}")
    assert 1 / 1.15 < ours / real < 1.15


def test_a_wall_beyond_the_range_is_told(real_data):
    """Decoded from 0.7 to 1.2 m, a wall at 3.5 m makes scattered points; a coarse look finds where it is."""
    folder = real_data / "oak" / "wall_3470mm"
    if not folder.exists():
        pytest.skip("no recording of the wall")
    calibration = str(folder / "calib_sensor_07_051923.json")
    capture = read_recording(folder, ReadOptions(calibration=calibration, frame=0, range_mm=(700.0, 1200.0))).capture
    settings, _ = decoder_settings(capture)
    found = surface_beyond(capture, capture_cloud(capture, settings), settings)
    assert found is not None and found.share > 0.3
    # the farthest tenth is wall; 1 px of the coarse disparity is 0.7 m there, and less than half of it is allowed
    assert found.depths[0] > 1200 and found.depths[1] == pytest.approx(3530, abs=300)
