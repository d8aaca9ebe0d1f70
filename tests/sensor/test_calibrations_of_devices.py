"""Calibrations of devices, data sets and photogrammetry, against the formulas of their manuals at the image's corners.

Before, all were refused: the .txt files with a hint at ROS's calibrator, Metashape's as XML of another program, and
those of Azure Kinect and of VINS's equidistant lens as files without a matrix. The formulas give pixels as the format
counts them; `half` is what the centre of its first pixel has, 0 or 0.5.
"""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings.calibration_file import camera_of, read_calibration
from mitsim.capture.recordings.stereo_pair import names_of_pair

SIZE = (1280, 960)
#: rays whose pixels lie in the corners and the middle of an image of 1280 x 960 px with f near 1000 px
X, Y = (np.array(axis) for axis in ([-0.62, 0.6, 0.63, -0.6, 0.1], [-0.46, -0.45, 0.47, 0.46, -0.05]))
RAYS = np.stack([X, Y, np.ones(5)], axis=1)
R2 = X**2 + Y**2
F, CX, CY = 1003.5, 641.3, 477.9


def lens(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0):
    """The formula of OpenCV's manual, written out."""
    radial = (1 + k1 * R2 + k2 * R2**2 + k3 * R2**3) / (1 + k4 * R2 + k5 * R2**2 + k6 * R2**3)
    x = X * radial + 2 * p1 * X * Y + p2 * (R2 + 2 * X**2)
    y = Y * radial + p1 * (R2 + 2 * Y**2) + 2 * p2 * X * Y
    return x, y


def round_lens(k1, k2, k3, k4):
    """Of OPENCV_FISHEYE: the angle from the axis, in place of its tangent, in a polynomial of odd powers."""
    r = np.sqrt(R2)
    angle = np.arctan(r)
    scale = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8) / r
    return X * scale, Y * scale


def sees(camera, bent, focal=(F, F), centre=(CX, CY), half=0.0, size=SIZE):
    expected = np.stack([focal[0] * bent[0] + centre[0], focal[1] * bent[1] + centre[1]], axis=1) - half
    np.testing.assert_allclose(camera.project(700 * RAYS), expected, atol=1e-6)
    assert (camera.width, camera.height) == size


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


BENT = (-0.11, 0.07, 8e-4, -6e-4, -0.02, 0.03, 0.02, -0.01)
ROUND = (0.02, -0.01, 0.004, -0.002)
COLMAP = {
    "SIMPLE_PINHOLE": ((F, CX, CY), (F, F), lens()),
    "PINHOLE": ((F, 999.5, CX, CY), (F, 999.5), lens()),
    "SIMPLE_RADIAL": ((F, CX, CY, -0.1), (F, F), lens(-0.1)),
    "RADIAL": ((F, CX, CY, -0.1, 0.04), (F, F), lens(-0.1, 0.04)),
    "OPENCV": ((F, 999.5, CX, CY, *BENT[:4]), (F, 999.5), lens(*BENT[:4])),
    "FULL_OPENCV": ((F, 999.5, CX, CY, *BENT), (F, 999.5), lens(*BENT)),
    "OPENCV_FISHEYE": ((F, 999.5, CX, CY, *ROUND), (F, 999.5), round_lens(*ROUND)),
}


def colmap(model, numbers, number=1):
    return f"{number} {model} 1280 960 {' '.join(map(repr, numbers))}\n"


@pytest.mark.parametrize("model", COLMAP)
def test_models_of_colmap(tmp_path, model):
    numbers, focal, bent = COLMAP[model]
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    read = read_calibration(written(tmp_path / "cameras.txt", head + colmap(model, numbers)))
    sees(read.rig.reference, bent, focal, half=0.5)
    assert read.notes == ()


def test_cameras_of_colmap_are_no_pair(tmp_path):
    """Its unit of length is unknown, and cameras.txt has no pose."""
    text = colmap("PINHOLE", (F, F, CX, CY), 2) + colmap("SIMPLE_RADIAL", (F, CX, CY, -0.1), 7)
    read = read_calibration(written(tmp_path / "cameras.txt", text))
    assert (list(read.rig.cameras), read.unrelated) == (["camera_2", "camera_7"], True)
    sees(camera_of(read, "camera_7", SIZE, "a.png")[1], lens(-0.1), half=0.5)
    with pytest.raises(InputError, match="without the pose of the second"):
        names_of_pair(read, "cameras.txt")


@pytest.mark.parametrize(
    "line",
    ["1 FOV 1280 960 900 900 640 480 0.9", "1 THIN_PRISM_FISHEYE 1280 960 " + "1 " * 12, "1 OPENCV 1280 960 1 2"],
)
def test_other_models_of_colmap_are_refused_by_name(tmp_path, line):
    with pytest.raises(
        InputError, match=rf"camera 1: found {line.split()[1]} with \d+ parameters; allowed: SIMPLE_PIN"
    ):
        read_calibration(written(tmp_path / "cameras.txt", line))


MIDDLEBURY = """cam0=[1003.5 0 641.3; 0 1003.5 477.9; 0 0 1]
cam1=[1003.5 0 693.8; 0 1003.5 477.9; 0 0 1]
doffs=52.5
baseline=193.001
width=1280
height=960
ndisp=290
isint=0
vmin=31
vmax=257
"""


def test_middlebury(tmp_path):
    """Z = baseline f / (d + doffs), in mm."""
    read = read_calibration(written(tmp_path / "calib.txt", MIDDLEBURY))
    sees(read.rig.reference, lens())
    point = np.array([[100.0, -50.0, 2000.0]])
    left, right = (camera.project(point)[0] for camera in read.rig.cameras.values())
    assert 193.001 * F / (left[0] - right[0] + 52.5) == pytest.approx(2000.0)
    assert left[1] == pytest.approx(right[1]) and read.notes == ()
    with pytest.raises(InputError, match=r"doffs: found 50\.0; allowed: cx of cam1 less cx of cam0, 52\.5"):
        read_calibration(written(tmp_path / "calib.txt", MIDDLEBURY.replace("doffs=52.5", "doffs=50")))
    with pytest.raises(InputError, match=r"baseline of 0\.193 in a unit that the file does not state"):
        read_calibration(written(tmp_path / "calib.txt", MIDDLEBURY.replace("193.001", "0.193")))


#: projections with the numbers of KITTI's: cameras 0 and 1 are grey, 2 and 3 colour; the last column is K t
P = {
    number: np.array([[F, 0, CX, along], [0, F, CY, down], [0, 0, 1, deep]])
    for number, (along, down, deep) in enumerate(
        [(0, 0, 0), (-379.7842, 0, 0), (45.75831, -0.3454157, 0.004981016), (-334.1081, 2.33066, 0.003201153)]
    )
}


def kitti(names):
    return "".join(f"{name}: {' '.join(map(repr, matrix.ravel().tolist()))}\n" for name, matrix in names.items())


def is_projected(rig, first, second):
    """Points [m] of the rectified frame lie where the projections of the two cameras have them."""
    points = np.random.default_rng(2).uniform([-3, -2, 5], [3, 2, 20], (40, 3))
    homogeneous = np.c_[points, np.ones(40)]
    pixels = [seen[:, :2] / seen[:, 2:] for seen in (homogeneous @ P[first].T, homogeneous @ P[second].T)]
    own = points + np.linalg.solve(P[first][:, :3], P[first][:, 3])
    for camera, expected in zip(rig.cameras.values(), pixels, strict=True):
        np.testing.assert_allclose(camera.project(1000 * own), expected, atol=1e-6)


def named(folder, file, first, second):
    keys = f'[calibration.keys.left]\nmatrix = "{first}"\n[calibration.keys.right]\nmatrix = "{second}"\n'
    text = f'[calibration]\nfile = "{file}"\ncameras = ["left", "right"]\nprojector = false\n{keys}'
    return written(folder / "pair.toml", text)


@pytest.mark.parametrize(("first", "second"), [(0, 1), (2, 3)])
def test_two_of_the_four_cameras_of_kitti_are_named(tmp_path, first, second):
    """The baselines of grey and colour differ by a percent: none is taken unasked."""
    text = kitti({f"P{number}": matrix for number, matrix in P.items()}) + "Tr_velo_to_cam: " + "0.1 " * 12
    read = read_calibration(written(tmp_path / "000000.txt", text), SIZE)
    with pytest.raises(InputError, match=r"found P0, P1, P2, P3; allowed: two cameras.*name two of them"):
        names_of_pair(read, "000000.txt")
    read = read_calibration(named(tmp_path, "000000.txt", f"P{first}", f"P{second}"), SIZE)
    is_projected(read.rig, first, second)


def test_kitti_before_and_after_rectification(tmp_path):
    """The size of the images tells which; the cameras before have a lens and a pose from camera 0 in metres."""
    turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    shift, bent = np.array([-0.537, 0.006, -0.012]), np.array(BENT[:5])
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
    for number, (R, T) in enumerate([(np.eye(3), np.zeros(3)), (turn, shift)]):
        raw = {"S": np.array([1392.0, 512.0]), "K": P[0][:, :3], "D": bent, "R": R, "T": T}
        rectified = {"S_rect": np.array([1242.0, 375.0]), "R_rect": np.eye(3), "P_rect": P[number]}
        text += kitti({f"{name}_{number:02}": value for name, value in (raw | rectified).items()})
    written(tmp_path / "calib_cam_to_cam.txt", text)
    read = read_calibration(tmp_path / "calib_cam_to_cam.txt", (1242, 375))
    is_projected(read.rig, 0, 1)
    read = read_calibration(tmp_path / "calib_cam_to_cam.txt", (1392, 512))
    expected, _ = cv2.projectPoints(7 * RAYS, cv2.Rodrigues(turn)[0], shift, P[0][:, :3], bent)
    np.testing.assert_allclose(read.rig.cameras["right"].project(7000 * RAYS), expected[:, 0], atol=1e-6)
    with pytest.raises(InputError, match=r"size: found images of 640 x 480 px; allowed: 1392 x 512 or 1242 x 375 px"):
        read_calibration(tmp_path / "calib_cam_to_cam.txt", (640, 480))


ZED = {"Baseline": 119.978, "TY": 0.26, "TZ": 0.16, "CV": 0.0062, "RX": -0.0009, "RZ": 0.0008}


def zed(separate=False, round_one=False):
    names = ("k1", "k2", "k3", "k4") if round_one else ("k1", "k2", "p1", "p2", "k3")
    bent = "".join(f"{name} = {value}\n" for name, value in zip(names, ROUND if round_one else BENT, strict=False))
    text = ""
    for ending, scale in (("FHD1200", 1.5), ("SVGA", 0.75)):
        for side in ("LEFT", "RIGHT"):
            text += f"[{side}_CAM_{ending}]\nfx={F * scale}\nfy={F * scale}\ncx={CX * scale}\ncy={400 * scale}\n"
            text += "" if separate else bent
    text += f"[LEFT_DISTO]\n{bent}[RIGHT_DISTO]\n{bent}" if separate else ""
    stereo = {f"{name}_FHD1200" if len(name) == 2 and name not in ("TY", "TZ") else name: v for name, v in ZED.items()}
    stereo |= {f"{name}_SVGA": ZED[name] for name in ("CV", "RX", "RZ")}
    return (
        f"{text}[STEREO]\n" + "".join(f"{name}={value}\n" for name, value in stereo.items()) + "[MISC]\nSensor_ID=0\n"
    )


@pytest.mark.parametrize("round_one", [False, True])
@pytest.mark.parametrize("separate", [False, True])
@pytest.mark.parametrize(("size", "scale"), [((1920, 1200), 1.5), ((960, 600), 0.75)])
def test_a_zed(tmp_path, size, scale, separate, round_one):
    """Its calibration program writes Baseline = -T[0], TY, TZ, and the vector RX, CV, RZ, of cv2.stereoCalibrate."""
    path = written(tmp_path / "SN1234.conf", zed(separate, round_one))
    read = read_calibration(path, size)
    K = np.array([[F * scale, 0, CX * scale], [0, F * scale, 400 * scale], [0, 0, 1]])
    bent, project = (ROUND, cv2.fisheye.projectPoints) if round_one else (BENT[:5], cv2.projectPoints)
    turn, shift = np.array([ZED["RX"], ZED["CV"], ZED["RZ"]]), np.array([-ZED["Baseline"], ZED["TY"], ZED["TZ"]])
    expected, _ = project(700 * RAYS[:, None], turn, shift, K, np.array(bent))
    np.testing.assert_allclose(read.rig.cameras["right"].project(700 * RAYS), expected[:, 0], atol=1e-6)
    sees(
        read.rig.cameras["left"],
        round_lens(*ROUND) if round_one else lens(*BENT[:5]),
        *K[[0, 1, 0, 1], [0, 1, 2, 2]].reshape(2, 2),
        size=size,
    )
    assert read.notes == ()


def test_a_zed_needs_the_size_of_the_images(tmp_path):
    """Of a sensor file without images, that of its cameras."""
    path = written(tmp_path / "SN1234.conf", zed())
    with pytest.raises(InputError, match=r"found images of unknown size; allowed: 1920 x 1200 or 960 x 600 px"):
        read_calibration(path)
    text = '[calibration]\nfile = "SN1234.conf"\ncameras = ["left", "right"]\nprojector = false\n'
    written(tmp_path / "a.toml", f"{text}[cameras.left]\nwidth = 960\nheight = 600\n")
    assert read_calibration(tmp_path / "a.toml").rig.cameras["right"].width == 960
    with pytest.raises(InputError, match="baseline: found 'wide'; allowed: a number"):
        read_calibration(written(path, zed().replace("119.978", "wide")), (960, 600))


METASHAPE = {"f": F, "cx": 1.3, "cy": -2.1, "b1": 4.5, "k1": -0.11, "k2": 0.07, "k3": -0.02, "p1": 8e-4, "p2": -6e-4}


def metashape(values, projection="frame"):
    lines = "".join(f"  <{name}>{value}</{name}>\n" for name, value in values.items())
    head = f'<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>{projection}</projection>\n'
    return (
        f"{head}<width>1280</width>\n<height>960</height>\n{lines}<date>2024-05-01T10:00:00Z</date>\n</calibration>\n"
    )


def as_metashape(f, cx, cy, b1, k1, k2, k3, p1, p2):
    """The formula of the manual, "Frame cameras"."""
    radial = 1 + k1 * R2 + k2 * R2**2 + k3 * R2**3
    x = X * radial + (p1 * (R2 + 2 * X**2) + 2 * p2 * X * Y)
    y = Y * radial + (p2 * (R2 + 2 * Y**2) + 2 * p1 * X * Y)
    return np.stack([1280 * 0.5 + cx + x * f + x * b1, 960 * 0.5 + cy + y * f], axis=1)


def test_metashape(tmp_path):
    inner = "".join(f"<{name}>{value}</{name}>" for name, value in METASHAPE.items())
    begun = inner.replace(str(F), "900")
    blocks = "".join(
        f'<calibration type="frame" class="{kind}"><resolution width="1280" height="960"/>{values}</calibration>'
        for kind, values in (("initial", begun), ("adjusted", inner))
    )
    project = (
        f'<document version="2.0.0"><chunk><sensors><sensor type="frame">{blocks}</sensor></sensors></chunk></document>'
    )
    for text in (metashape(METASHAPE), project):
        camera = read_calibration(written(tmp_path / "a.xml", text)).rig.reference
        np.testing.assert_allclose(camera.project(700 * RAYS), as_metashape(**METASHAPE) - 0.5, atol=1e-6)
        assert (camera.width, camera.height) == SIZE


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"b2": -4.25}, r"a skew of -4\.25 px.*no B2 in Metashape"),
        ({"k4": 0.02}, r"k4 of 0\.02 without k5 and k6.*a k4 of r\^8 \(Metashape\)"),
        ({"p3": 0.1}, r"p3, p4: found 0\.1, 0"),
        ({"f": "much"}, "f: found 'much'"),
    ],
)
def test_a_lens_of_metashape_that_opencv_lacks_is_refused(tmp_path, more, told):
    with pytest.raises(InputError, match=told):
        read_calibration(written(tmp_path / "a.xml", metashape(METASHAPE | more)))


def test_a_fisheye_of_metashape_is_refused(tmp_path):
    with pytest.raises(InputError, match="projection: found fisheye"):
        read_calibration(written(tmp_path / "a.xml", metashape(METASHAPE, "fisheye")))


def kinect(model="BrownConrady", high=3072, codx=0.0):
    def camera(purpose, sides, numbers):
        values = [*numbers, *BENT[:2], *BENT[4:], codx, 0, BENT[3], BENT[2]]
        inner = {"ModelParameterCount": 14, "ModelParameters": values}
        inner |= {"ModelType": f"CALIBRATION_LensDistortionModel{model}"}
        more = {"Purpose": f"CALIBRATION_CameraPurpose{purpose}", "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
        return {"Intrinsics": inner, "SensorWidth": sides[0], "SensorHeight": sides[1], **more}

    cameras = [camera("Depth", (1024, 1024), (0.501, 0.503, 0.492, 0.493))]
    cameras += [camera("PhotoVideo", (4096, high), (0.499, 0.506, 0.478, 0.637))]
    return {"CalibrationInformation": {"Cameras": cameras, "InertialSensors": []}}


#: size of the images, size of the sensor after binning or scaling, and corner of the images in it
MODES = [
    ((640, 576), (1024, 1024), (192, 180), 0),
    ((320, 288), (512, 512), (96, 90), 0),
    ((1024, 1024), (1024, 1024), (0, 0), 0),
    ((1280, 720), (1280, 960), (0, 120), 1),
    ((2048, 1536), (2048, 1536), (0, 0), 1),
    ((3840, 2160), (3840, 2880), (0, 360), 1),
]


@pytest.mark.parametrize(("size", "full", "corner", "which"), MODES)
def test_an_azure_kinect(tmp_path, size, full, corner, which):
    """Its order is k1 to k6, the lens's middle, p2, p1; shares of the sensor, from the corner of its first pixel."""
    cx, cy, fx, fy = kinect()["CalibrationInformation"]["Cameras"][which]["Intrinsics"]["ModelParameters"][:4]
    read = read_calibration(written(tmp_path / "calibration.json", json.dumps(kinect())), size)
    k1, k2, p1, p2, k3, k4, k5, k6 = BENT
    x = X * (1 + k1 * R2 + k2 * R2**2 + k3 * R2**3) / (1 + k4 * R2 + k5 * R2**2 + k6 * R2**3)
    y = Y / X * x
    x, y = x + (R2 + 2 * X**2) * p2 + 2 * X * Y * p1, y + (R2 + 2 * Y**2) * p1 + 2 * X * Y * p2
    centre = (cx * full[0] - corner[0], cy * full[1] - corner[1])
    sees(read.rig.reference, (x, y), (fx * full[0], fy * full[1]), centre, half=0.5, size=size)
    assert read.notes == ()


@pytest.mark.parametrize(
    ("table", "size", "told"),
    [
        (kinect(), (800, 600), "size: found images of 800 x 600 px; allowed: 640 x 576 or"),
        (kinect("Rational6KT"), (640, 576), "ModelType: found CALIBRATION_LensDistortionModelRational6KT"),
        (kinect(codx=0.01), (640, 576), "around cx and cy"),
    ],
)
def test_an_azure_kinect_that_opencv_lacks_is_refused(tmp_path, table, size, told):
    with pytest.raises(InputError, match=told):
        read_calibration(written(tmp_path / "calibration.json", json.dumps(table)), size)


def test_an_equidistant_lens_of_vins(tmp_path):
    """r = theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9."""
    numbers = dict(zip(("k2", "k3", "k4", "k5"), ROUND, strict=True)) | {"mu": F, "mv": 999.5, "u0": CX, "v0": CY}
    lines = "".join(f"   {name}: {value}\n" for name, value in numbers.items())
    text = "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: cam0\nimage_width: 1280\nimage_height: 960\n"
    read = read_calibration(written(tmp_path / "cam0.yaml", f"{text}projection_parameters:\n{lines}"))
    sees(read.rig.reference, round_lens(*ROUND), (F, 999.5))
    assert read.notes == ()


def mrcal(pose, key="extrinsics", model="LENSMODEL_OPENCV8", bent=BENT):
    numbers = [F, 999.5, CX, CY, *bent]
    return (
        f"# generated by mrcal-calibrate-cameras\n{{\n    'lensmodel':  '{model}',\n\n    'intrinsics': {numbers},\n"
        f"    'valid_intrinsics_region': [ [ 0, 0 ], [ 9, 9 ], ],\n"
        f"    'optimization_inputs': b'a%&',\n    '{key}': {pose.tolist()},\n    'imagersize': [ 1280, 960,],\n}}\n"
    )


def test_a_pair_of_mrcal(tmp_path):
    """The extrinsics take points of a frame of reference to the camera; mrcal states no unit."""
    poses = [np.array([0.1, -0.2, 0.3, 15.0, -20.0, 30.0]), np.array([0.12, -0.15, 0.32, -105.0, -18.0, 28.0])]
    written(tmp_path / "a.cameramodel", mrcal(poses[0]))
    written(tmp_path / "b.cameramodel", mrcal(poses[1], "rt_cam_ref"))
    files = 'file = ["a.cameramodel", "b.cameramodel"]\ncameras = ["left", "right"]\nprojector = false\n'
    read = read_calibration(written(tmp_path / "pair.toml", f"[calibration]\n{files}"))
    sees(read.rig.cameras["left"], lens(*BENT), (F, 999.5))
    turn = cv2.Rodrigues(poses[0][:3])[0]
    reference = (700 * RAYS - poses[0][3:]) @ turn
    K = np.array([[F, 0, CX], [0, 999.5, CY], [0, 0, 1]])
    expected, _ = cv2.projectPoints(reference, poses[1][:3], poses[1][3:], K, np.array(BENT))
    np.testing.assert_allclose(read.rig.cameras["right"].project(700 * RAYS), expected[:, 0], atol=1e-6)
    sees(read_calibration(tmp_path / "b.cameramodel").rig.reference, lens(*BENT), (F, 999.5))
    flat = written(tmp_path / "c.cameramodel", mrcal(poses[0], model="LENSMODEL_PINHOLE", bent=()))
    sees(read_calibration(flat).rig.reference, lens(), (F, 999.5))
    other = written(tmp_path / "d.cameramodel", mrcal(poses[0], model="LENSMODEL_CAHVOR", bent=BENT[:5]))
    with pytest.raises(InputError, match=r"lensmodel: found LENSMODEL_CAHVOR; .*mrcal-convert-lensmodel"):
        read_calibration(other)


@pytest.mark.parametrize("rows", [3, 4])
def test_a_matrix_alone(tmp_path, rows):
    """As ScanNet's intrinsic_depth.txt."""
    matrix = np.eye(rows)
    matrix[:2, :3] = [[F, 0, CX], [0, F, CY]]
    text = "".join(" ".join(f"{number:.6f}" for number in row) + "\n" for row in matrix)
    sees(read_calibration(written(tmp_path / "intrinsic_depth.txt", text), SIZE).rig.reference, lens())


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("ost.txt", "# oST version 5.0 parameters\n\n[image]\n\nwidth\n640\n", r"saves the same numbers as \.yaml"),
        ("a.txt", "1 2 3\n4 5 6\n", "found text of another form; allowed: cameras.txt of COLMAP, calib.txt of"),
        ("a.txt", "", "text of another form"),
        ("a.conf", "[LEFT_CAM_HD]\nfx\n", "text of another form|sections that cannot be read"),
        ("a.cameramodel", "{ 'lensmodel': ", "text of another form"),
        ("a.cameramodel", "[" * 100000, "text of another form"),
        ("calib.txt", "P2: 1 2 3\n", "P2: found"),
        ("calib.txt", MIDDLEBURY.replace("baseline=193.001", "baseline="), "baseline: found"),
        ("calib.txt", MIDDLEBURY.replace("477.9; 0 0 1", "477.9; 0 0 x"), "cam0: found"),
    ],
)
def test_text_of_no_form_or_half_of_one_is_refused(tmp_path, name, text, told):
    with pytest.raises(InputError, match=told):
        read_calibration(written(tmp_path / name, text), SIZE)


@pytest.mark.parametrize("piece", ["\n", "<calibration>", "[", "a", "a:", "1 ", " [LEFT_CAM_HD\n"])
@pytest.mark.parametrize("name", ["a.txt", "a.cameramodel"])
def test_long_text_is_refused(tmp_path, name, piece):
    """A search that takes the square of the length would take hours."""
    with pytest.raises(InputError):
        read_calibration(written(tmp_path / name, piece * 30_000), SIZE)
