"""Ensenso recordings, made here in both of the maker's ways of writing them, and broken in many ways of our own."""

import copy
import io
import json
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.capture.recordings.ensenso import ensenso_originals, read_ensenso
from mitsim.capture.recordings.nxlib_calibration import NxLibTree, link_of
from mitsim.decoding.cloud import decoder_settings
from mitsim.sensor.png import encode_png
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT, BASELINE = 40, 24, 101.0
LEFT_ROTATION = Rotation.from_euler("xyz", [0.2, -4.6, 0.1], degrees=True).as_matrix()
RIGHT_ROTATION = Rotation.from_euler("xyz", [-0.1, 3.7, -0.2], degrees=True).as_matrix()
CORRECTED = Rotation.from_euler("x", 0.05, degrees=True).as_matrix() @ RIGHT_ROTATION
IMAGES = np.random.default_rng(5).integers(0, 256, (2, HEIGHT, WIDTH)).astype(np.uint8)


def by_columns(matrix: np.ndarray) -> list:
    return matrix.T.tolist()


def intrinsic(f: float, cx: float, cy: float, scale: float = 1.0) -> list:
    return by_columns(np.array([[f * scale, 0, cx * scale], [0, f * scale, cy * scale], [0, 0, 1]]))


def node(old: bool = False) -> dict:
    """Camera node as NxLib writes it: old files have arrays of distortion and halved dynamic matrices."""
    scale = 0.5 if old else 1.0
    new_style = {"K1": -0.5, "K2": 0.3, "K3": -0.1, "T1": 1e-3, "T2": 2e-3, "Rx": -3e-3, "Ry": 4e-3}
    distortion = [-0.5, 0.3, 1e-3, 2e-3, -0.1] if old else new_style

    def pair(right_rotation, scale):
        return {
            "Left": {"Camera": intrinsic(33, 15, 11, scale), "Rotation": by_columns(LEFT_ROTATION)},
            "Right": {"Camera": intrinsic(33, 22, 11, scale), "Rotation": by_columns(right_rotation)},
        }

    return {
        "ModelName": "N10-304-18",
        "SerialNumber": "150358",
        "Calibration": {
            "Monocular": {
                "Left": {"Camera": intrinsic(35, 19.5, 11.5), "Distortion": copy.copy(distortion)},
                "Right": {"Camera": intrinsic(36, 20.5, 12.5), "Distortion": distortion},
            },
            "Stereo": {"Baseline": BASELINE, **pair(RIGHT_ROTATION, 1.0)},
            "Dynamic": {"Stereo": pair(CORRECTED, scale)},
        },
        "Link": {"Target": "Workspace", "Translation": [1, 2, 3], "Rotation": {"Angle": 0.1, "Axis": [0, 0, 1]}},
        "Parameters": {
            "Capture": {"Exposure": 1.5, "Gain": 2, "Projector": True, "HardwareGamma": True},
            "DisparityMap": {
                "Scaling": scale,
                "MeasurementVolume": {"Near": {"LeftTop": [-1, -1, 300]}, "Far": {"LeftTop": [-2, -2, 600]}},
            },
        },
        "Sensor": {"Size": [WIDTH, HEIGHT], "ModelName": "UI524xTE-M", "Port": {"Type": "Ethernet"}},
    }


def files(tree: dict, base: str = "") -> dict[str, bytes]:
    return {
        f"{base}1_150358_left.png": encode_png(IMAGES[0]),
        f"{base}1_150358_right.png": encode_png(IMAGES[1]),
        f"{base}1_150358_calib.json": json.dumps(tree).encode(),
    }


def pack(path: Path, content: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


def unpack(folder: Path, content: dict[str, bytes]) -> Path:
    for name, data in content.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("base", ["", "camera/"])
@pytest.mark.parametrize("form", ["zip", "enscam", "folder"])
def test_every_form_of_a_recording_is_the_same_capture(tmp_path, old, base, form):
    content = files(node(old), base)
    path = unpack(tmp_path / "r", content) if form == "folder" else pack(tmp_path / f"r.{form}", content)
    capture = read_ensenso(path)
    assert (capture.sensor, capture.serial, capture.source) == ("N10-304-18", "150358", "device")
    assert (capture.technology, capture.bits) == ("active_stereo", 8)
    np.testing.assert_array_equal(capture.images["left"], IMAGES[:1])
    np.testing.assert_array_equal(capture.images["right"], IMAGES[1:])
    np.testing.assert_array_equal(capture.rig.reference.matrix, [[35, 0, 19.5], [0, 35, 11.5], [0, 0, 1]])
    tilts = [0, 0] if old else [-3e-3, 4e-3]
    expected = [-0.5, 0.3, 1e-3, 2e-3, -0.1, *[0] * 7, *tilts]
    np.testing.assert_array_equal(capture.rig.reference.distortion, expected)
    pair = capture.rig.rectification
    np.testing.assert_allclose(pair.matrix_left, [[33, 0, 15], [0, 33, 11], [0, 0, 1]], rtol=1e-15)
    np.testing.assert_allclose(pair.matrix_right[0], [33, 0, 22], rtol=1e-15)


def test_rotations_are_transposed_and_the_right_camera_is_placed(tmp_path):
    rig = read_ensenso(pack(tmp_path / "r.zip", files(node()))).rig
    np.testing.assert_allclose(rig.rectification.rotation_left, LEFT_ROTATION, atol=1e-12)
    np.testing.assert_allclose(rig.rectification.rotation_right, CORRECTED, atol=1e-12)
    # one point is seen in the same row of both rectified images, f B / Z apart
    point = np.array([12.0, -7.0, 400.0])
    seen = []
    for eye, rotation in zip(rig.cameras.values(), (LEFT_ROTATION, CORRECTED), strict=True):
        rectified = rotation @ eye.sensor_from_camera.inverse().points(point)
        seen.append(rectified)
    np.testing.assert_allclose(seen[0] - seen[1], [BASELINE, 0, 0], atol=1e-9)
    np.testing.assert_allclose(rig.reference.sensor_from_camera.matrix(), Transform.identity().matrix())


def test_the_factory_calibration_on_request(tmp_path):
    path = pack(tmp_path / "r.zip", files(node(old=True)))
    static = read_ensenso(path, dynamic=False)
    np.testing.assert_allclose(static.rig.rectification.rotation_right, RIGHT_ROTATION, atol=1e-12)
    np.testing.assert_allclose(static.rig.rectification.matrix_left[0], [33, 0, 15])
    assert static.settings["rectification"] == "static"
    assert read_ensenso(path).settings["rectification"] == "dynamic"
    without = node()
    del without["Calibration"]["Dynamic"]
    plain = read_ensenso(pack(tmp_path / "s.zip", files(without)))
    np.testing.assert_allclose(plain.rig.rectification.rotation_right, RIGHT_ROTATION, atol=1e-12)
    assert plain.settings["rectification"] == "static"


def test_settings_carry_units_and_the_link_is_only_recorded(tmp_path):
    capture = read_ensenso(pack(tmp_path / "r.zip", files(node())))
    found, stated = capture.settings, capture.decoding
    assert stated.exposure_s == pytest.approx(1.5e-3)
    assert (found["gain"], found["projector_on"], found["hardware_gamma"]) == (2, True, True)
    assert (stated.near_mm, stated.far_mm) == (300, 600)
    assert found["link_translation_mm"] == [1, 2, 3]
    assert found["link_angle_rad"] == 0.1


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.update(ModelName="VirtualStereoCamera"),
        lambda t: t["Sensor"].update(ModelName="VirtualMonoCamera"),
        lambda t: t["Sensor"].update(Left={"Port": {"Type": "Virtual"}}),
    ],
)
def test_the_makers_virtual_cameras_are_simulated(tmp_path, change):
    tree = node()
    change(tree)
    assert read_ensenso(pack(tmp_path / "r.zip", files(tree))).source == "simulated"


def test_originals_are_the_bytes_of_the_recording(tmp_path):
    content = files(node())
    assert ensenso_originals(pack(tmp_path / "r.zip", files(node(), "deep/"))) == content


FIELDS = [
    "ModelName",
    "SerialNumber",
    "Calibration/Monocular/Left/Camera",
    "Calibration/Monocular/Right/Distortion",
    "Calibration/Monocular/Right/Distortion/K2",
    "Calibration/Stereo/Baseline",
    "Calibration/Dynamic/Stereo/Left/Camera",
    "Calibration/Dynamic/Stereo/Right/Rotation",
]


def at(tree: dict, path: str) -> tuple[dict, str]:
    *above, last = path.split("/")
    for key in above:
        tree = tree[key]
    return tree, last


@pytest.mark.parametrize("path", FIELDS)
@pytest.mark.parametrize("wrong", ["missing", None, [], {}, [[1, 2], [3]], float("nan"), 1e400, True])
def test_a_wrong_field_is_named(tmp_path, path, wrong):
    tree = node()
    above, last = at(tree, path)
    if wrong == "missing":
        del above[last]
    else:
        above[last] = wrong
    with pytest.raises(InputError, match=path):
        read_ensenso(pack(tmp_path / "r.zip", files(tree)))


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        ("Calibration/Stereo/Baseline", -90.0),
        ("Calibration/Monocular/Left/Camera", np.zeros((3, 3)).tolist()),
        ("Calibration/Monocular/Left/Camera", [[35, 0, 19.5], [0, 35, 11.5], [0, 0, 1]]),  # by rows
        ("Calibration/Dynamic/Stereo/Left/Rotation", (2 * np.eye(3)).tolist()),
        ("Calibration/Dynamic/Stereo/Right/Camera", intrinsic(34, 22, 11)),
        ("Parameters/DisparityMap/Scaling", 0),
        ("Sensor/Size", [WIDTH + 1, HEIGHT]),
        ("Parameters/DisparityMap/MeasurementVolume/Near/LeftTop", [-1, -1, 0]),
        ("Parameters/DisparityMap/MeasurementVolume/Far/LeftTop", [-2, -2, -600]),
        ("Parameters/Capture/Exposure", -1.5),
    ],
)
def test_an_impossible_value_is_named(tmp_path, path, wrong):
    tree = node()
    above, last = at(tree, path)
    above[last] = wrong
    with pytest.raises(InputError, match=path):
        read_ensenso(pack(tmp_path / "r.zip", files(tree)))


@pytest.mark.parametrize("missing", ["left.png", "right.png", "calib.json"])
def test_a_missing_file_is_named(tmp_path, missing):
    content = {name: data for name, data in files(node()).items() if not name.endswith(missing)}
    for path in (pack(tmp_path / "r.zip", content), unpack(tmp_path / "r", content)):
        with pytest.raises(InputError, match=rf"\*_{missing}: found no such file"):
            read_ensenso(path)


def test_an_image_without_its_calibration_is_refused(tmp_path):
    content = files(node()) | {"2_150358_left.png": b""}
    with pytest.raises(InputError, match=r"2_150358_left\.png: found an image without its calibration"):
        read_ensenso(pack(tmp_path / "r.zip", content))


@pytest.mark.parametrize("form", ["zip", "folder"])
def test_of_several_image_sets_one_is_chosen(tmp_path, form):
    other = {name.replace("1_", "2_"): data for name, data in files(node()).items()}
    other["2_150358_left.png"] = encode_png(255 - IMAGES[0])
    content = files(node()) | other
    path = unpack(tmp_path / "r", content) if form == "folder" else pack(tmp_path / "r.zip", content)
    with pytest.raises(InputError, match=r"2 image sets \(1_150358, 2_150358\).*--frame 0 to 1"):
        read_ensenso(path)
    np.testing.assert_array_equal(read_ensenso(path, frame=0).images["left"][0], IMAGES[0])
    second = read_ensenso(path, frame=1)
    np.testing.assert_array_equal(second.images["left"][0], 255 - IMAGES[0])
    assert second.settings["image_set"] == "2_150358"
    assert set(ensenso_originals(path, 1)) == {f"2_150358_{end}" for end in ("left.png", "right.png", "calib.json")}
    with pytest.raises(InputError, match="--frame: found 2; allowed: 0 to 1"):
        read_ensenso(path, frame=2)


def series(count: int, tree: dict, ending: str = "png") -> dict[str, bytes]:
    """A FlexView series as the maker's manual says: two digits before the side."""
    out = {"1_150358_calib.json": json.dumps(tree).encode()}
    for number in range(count):
        for side, image in zip(("left", "right"), IMAGES, strict=True):
            shown = np.roll(image, number, axis=1)
            data = encode_png(shown) if ending == "png" else cv2.imencode(f".{ending}", shown)[1].tobytes()
            out[f"1_150358_{number:02d}_{side}.{ending}"] = data
    return out


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_a_flex_view_series_is_read_in_the_order_of_its_numbers(tmp_path, ending):
    tree = node()
    tree["Parameters"]["Capture"]["FlexView"] = 12
    capture = read_ensenso(unpack(tmp_path / "r", series(12, tree, ending)))
    expected = np.stack([np.roll(IMAGES[0], number, axis=1) for number in range(12)])
    np.testing.assert_array_equal(capture.images["left"], expected)
    assert capture.settings["flex_view"] == 12
    # all frames are matched at once
    assert decoder_settings(capture)[0].method == "correlation"
    assert decoder_settings(replace(capture, images={k: v[:1] for k, v in capture.images.items()}))[0].method == "sgbm"


def test_a_series_with_a_gap_or_of_another_length_is_refused(tmp_path):
    tree = node()
    tree["Parameters"]["Capture"]["FlexView"] = 4
    content = series(4, tree)
    for missing in ("1_150358_02_left.png", "1_150358_00_right.png"):
        part = {name: data for name, data in content.items() if name != missing}
        with pytest.raises(InputError, match=missing.rpartition("_")[2]):
            read_ensenso(pack(tmp_path / "r.zip", part))
    with pytest.raises(InputError, match="3 left and 4 right"):
        read_ensenso(pack(tmp_path / "s.zip", {n: d for n, d in content.items() if n != "1_150358_03_left.png"}))
    tree["Parameters"]["Capture"]["FlexView"] = 8
    with pytest.raises(InputError, match="Parameters/Capture/FlexView: found 8; allowed: 4"):
        read_ensenso(pack(tmp_path / "t.zip", series(4, tree)))
    with pytest.raises(InputError, match="Parameters/Capture/FlexView: found 8; allowed: false or 0"):
        read_ensenso(pack(tmp_path / "u.zip", files(tree)))


def test_the_link_takes_the_target_to_the_rectified_camera(tmp_path):
    """By hand: a quarter turn about z, then the translation."""
    tree = node()
    tree["Link"] = {
        "Target": "Workspace",
        "Translation": [1, 2, 500],
        "Rotation": {"Angle": np.pi / 2, "Axis": [0, 0, 1]},
    }
    link = link_of(NxLibTree(json.dumps(tree).encode(), "calib.json"))
    np.testing.assert_allclose(link.points(np.array([[10.0, 0.0, 0.0]])), [[1, 12, 500]], atol=1e-12)
    del tree["Link"]
    assert link_of(NxLibTree(json.dumps(tree).encode(), "c")) is None
    for wrong in ({"Angle": 1, "Axis": [1, 1, 1]}, {"Angle": 1}, {"Angle": "1", "Axis": [0, 0, 1]}):
        tree["Link"] = {"Translation": [0, 0, 0], "Rotation": wrong}
        with pytest.raises(InputError, match="Link/Rotation"):
            link_of(NxLibTree(json.dumps(tree).encode(), "c"))


def test_a_zip_of_too_many_files_or_too_many_bytes_is_stopped(tmp_path, monkeypatch):
    path = pack(tmp_path / "r.zip", files(node()) | {f"more/{number}": b"" for number in range(50)})
    monkeypatch.setattr("mitsim.capture.recordings.recording_files.MOST_FILES", 50)
    with pytest.raises(InputError, match="53 files; allowed: up to 50"):
        read_ensenso(path)
    monkeypatch.undo()
    monkeypatch.setattr("mitsim.capture.recordings.recording_files.LARGEST_RECORDING", 500)
    with pytest.raises(InputError, match="up to 500 bytes in all"):
        read_ensenso(path)


def test_broken_images_are_named(tmp_path):
    content = files(node())
    for broken in (content["1_150358_left.png"][:-9], b"", b"GIF89a"):
        with pytest.raises(InputError, match=r"1_150358_left\.png"):
            read_ensenso(pack(tmp_path / "r.zip", content | {"1_150358_left.png": broken}))
    with pytest.raises(InputError, match="as the left image"):
        read_ensenso(pack(tmp_path / "r.zip", content | {"1_150358_left.png": encode_png(IMAGES[0, :-1])}))


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\xff\xfe", b"[" * 100_000])
def test_text_that_is_no_calibration(tmp_path, text):
    with pytest.raises(InputError, match=r"calib\.json"):
        read_ensenso(pack(tmp_path / "r.zip", files(node()) | {"1_150358_calib.json": text}))


def test_what_is_no_recording(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_ensenso(tmp_path / "nowhere.zip")
    (tmp_path / "text.zip").write_text("hello")
    with pytest.raises(InputError, match="cannot be unpacked"):
        read_ensenso(tmp_path / "text.zip")


def test_a_zip_that_swells_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr("mitsim.capture.recordings.recording_files.LARGEST_FILE", 10_000)
    with pytest.raises(InputError, match="10000 bytes"):
        read_ensenso(pack(tmp_path / "r.zip", files(node()) | {"1_150358_left.png": bytes(1_000_000)}))


def test_nothing_is_written_by_reading(tmp_path):
    path = pack(tmp_path / "r.zip", files(node(), "../"))
    capture = read_ensenso(path)
    assert capture.serial == "150358"
    assert [p.name for p in tmp_path.iterdir()] == ["r.zip"]
    assert all("/" not in name for name in ensenso_originals(path))


def zipped() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files(node()).items():
            archive.writestr(name, data)
    return stream.getvalue()


ZIP = zipped()


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_a_damaged_zip_is_refused_or_read_whole(data):
    damaged = bytearray(ZIP)
    if data.draw(st.booleans()):
        damaged = damaged[: data.draw(st.integers(0, len(ZIP) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            damaged[data.draw(st.integers(0, len(ZIP) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "r.zip"
        path.write_bytes(damaged)
        try:
            capture = read_ensenso(path)
        except InputError:
            return
        np.testing.assert_array_equal(capture.images["left"], IMAGES[:1])
        np.testing.assert_array_equal(capture.images["right"], IMAGES[1:])


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


def all_paths(tree: dict, before: str = "") -> list[str]:
    found = []
    for key, value in tree.items():
        found.append(f"{before}{key}")
        if isinstance(value, dict):
            found += all_paths(value, f"{before}{key}/")
    return found


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(all_paths(node())), JSON_VALUES)
def test_any_value_anywhere_is_read_or_refused_in_words(path, value):
    tree = copy.deepcopy(node())
    above, last = at(tree, path)
    above[last] = value
    with tempfile.TemporaryDirectory() as place:
        folder = unpack(Path(place) / "r", files(tree))
        try:
            read_ensenso(folder)
        except InputError:
            return
