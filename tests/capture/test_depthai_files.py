"""DepthAI's calibrations against the package's own reading of them, and its recordings, made here by the package."""

from __future__ import annotations

import copy
import json
import os
import shutil
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from depthai_recordings import record
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.errors import InputError
from mitsim.capture.cloud import capture_cloud, decoder_settings
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.readers import depthai_replay
from mitsim.capture.readers.depthai_calibration import read_depthai_calibration
from mitsim.capture.readers.depthai_recording import read_depthai_recording
from mitsim.capture.readers.mcap_check import check_mcap
from mitsim.errors import MissingEnvironmentError

needs_depthai = pytest.mark.skipif(find_spec("depthai") is None, reason="no depthai: pip install 'mitsim[depthai]'")

WIDTH, HEIGHT, FOCAL, BASELINE = 64, 40, 50.0, 75.4


def entry(to: int, turn: list[float], translation: list[float], fisheye: bool = False) -> dict:
    """One camera as a device stores it: centimetres, single precision."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix().astype(np.float32)
    distortion = [0.1, -0.05, 0.01, 0.002, *[0.0] * 10] if fisheye else [0.0] * 14
    return {
        "cameraType": int(fisheye), "distortionCoeff": distortion, "height": HEIGHT, "width": WIDTH,
        "intrinsicMatrix": [[FOCAL, 0.0, 31.5], [0.0, FOCAL, 19.5], [0.0, 0.0, 1.0]], "lensPosition": 0,
        "specHfovDeg": 70.0,
        "extrinsics": {
            "rotationMatrix": rotation.tolist() if to >= 0 else [], "toCameraSocket": to,
            "translation": dict(zip("xyz", translation, strict=True)),
            "specTranslation": {"x": -7.5 if to == 2 else 3.75, "y": 0.0, "z": 0.0},
        },
    }  # fmt: skip


def calibration(version: int = 7, fisheye: bool = False, as_map: bool = False) -> dict:
    """Left (1) -> right (2) -> colour (0): x_right = R x_left + T with T = -7.54 cm along x."""
    cameras = [
        [1, entry(2, [0, 0, 0], [-BASELINE / 10, 0.0, 0.0], fisheye)],
        [2, entry(0, [0.3, -0.5, 0.2], [3.75, 0.01, -0.02], fisheye)],
        [0, entry(-1, [0, 0, 0], [0.0, 0.0, 0.0])],
    ]
    none = {"rectifiedRotationLeft": np.eye(3).tolist(), "rectifiedRotationRight": np.eye(3).tolist()}
    return {
        "batchName": "", "batchTime": 0, "boardConf": "", "boardName": "DM9098", "boardRev": "R6", "version": version,
        "productName": "OAK-D-TEST", "hardwareConf": "", "boardCustom": "", "boardOptions": 0,
        "cameraData": {str(socket): each for socket, each in cameras} if as_map else cameras,
        "imuExtrinsics": entry(-1, [0, 0, 0], [0.0, 0.0, 0.0])["extrinsics"], "miscellaneousData": [],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2, **none},
    }  # fmt: skip


def save(path: Path, table: object) -> Path:
    path.write_text(json.dumps(table))
    return path


def against_the_package(path: Path) -> None:
    """Cameras, extrinsics and baselines at several sizes, as ``CalibrationHandler`` gives them."""
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    import depthai as dai

    theirs, ours = dai.CalibrationHandler(str(path)), read_depthai_calibration(path)
    left, right = theirs.getStereoLeftCameraId(), theirs.getStereoRightCameraId()
    expected = theirs.getCameraExtrinsics(left, right, False, dai.LengthUnit.MILLIMETER)
    # stored and multiplied in single precision
    np.testing.assert_allclose(ours.right_from_left.matrix(), expected, atol=5e-5)
    baselines = [theirs.getBaselineDistance(right, left, spec, dai.LengthUnit.MILLIMETER) for spec in (True, False)]
    assert ours.spec_baseline_mm == pytest.approx(baselines[0], rel=1e-5)
    assert np.linalg.norm(ours.right_from_left.translation) == pytest.approx(baselines[1], rel=1e-5)
    for size in ((1280, 800), (1280, 720), (640, 400), (640, 480), (320, 200)):
        rig = ours.rig(*size)
        for socket, camera in zip((left, right), rig.cameras.values(), strict=True):
            np.testing.assert_allclose(camera.matrix, theirs.getCameraIntrinsics(socket, *size), rtol=1e-6)
            np.testing.assert_allclose(camera.distortion, theirs.getDistortionCoefficients(socket), rtol=1e-6)
            assert (camera.model == "fisheye") == (theirs.getDistortionModel(socket) == dai.CameraModel.Fisheye)
        place = np.linalg.inv(np.array(expected, float))
        np.testing.assert_allclose(rig.cameras["right"].sensor_from_camera.matrix(), place, atol=1e-4)


@needs_depthai
@pytest.mark.parametrize(("version", "fisheye"), [(6, False), (7, False), (7, True)])
def test_a_calibration_is_read_as_depthai_reads_it(tmp_path, version, fisheye):
    against_the_package(save(tmp_path / "c.json", calibration(version, fisheye)))


@pytest.mark.parametrize("as_map", [False, True])
def test_centimetres_become_millimetres_along_the_chain(tmp_path, as_map):
    """By hand: the colour camera lies beyond the right one in the chain and plays no part."""
    read = read_depthai_calibration(save(tmp_path / "c.json", calibration(as_map=as_map)))
    np.testing.assert_allclose(read.right_from_left.translation, [-BASELINE, 0, 0], atol=1e-9)
    np.testing.assert_allclose(read.rig().cameras["right"].centre, [BASELINE, 0, 0], atol=1e-9)
    assert (read.spec_baseline_mm, read.name) == (75.0, "OAK-D-TEST")


def test_the_chain_is_followed_both_ways(tmp_path):
    """Left and right both told from the colour camera: right_from_left = (colour_from_right)^-1 colour_from_left."""
    table = calibration()
    table["cameraData"][0][1] = entry(0, [0, 0, 0], [-3.0, 0, 0])
    table["cameraData"][1][1] = entry(0, [0, 0, 0], [4.5, 0, 0])
    read = read_depthai_calibration(save(tmp_path / "c.json", table))
    np.testing.assert_allclose(read.right_from_left.translation, [-75, 0, 0], atol=1e-9)


def at(table, path):
    *above, last = path
    for key in above:
        table = table[key]
    return table, last


@pytest.mark.parametrize(
    ("path", "wrong", "told"),
    [
        (("cameraData",), 3, "cameraData"),
        (("cameraData", 0, 1, "intrinsicMatrix"), [[1, 2], [3]], "cameraData.1.intrinsicMatrix"),
        (("cameraData", 0, 1, "intrinsicMatrix", 0, 0), -50.0, "cameraData.1.intrinsicMatrix"),
        (("cameraData", 1, 1, "distortionCoeff"), [0.1] * 6, "cameraData.2.distortionCoeff"),
        (("cameraData", 1, 1, "cameraType"), 2, "cameraData.2.cameraType: found 2"),
        (("cameraData", 1, 1, "width"), 10**9, "cameraData.2.width"),
        (("cameraData", 0, 1, "extrinsics", "rotationMatrix"), [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "rotationMatrix"),
        (("cameraData", 0, 1, "extrinsics", "translation"), None, "extrinsics.translation"),
        (("cameraData", 0, 1, "extrinsics", "translation", "x"), "7", "extrinsics.translation.x"),
        (("cameraData", 2, 1, "extrinsics"), entry(1, [0, 0, 0], [1, 0, 0])["extrinsics"], "bites its tail"),
        (("cameraData", 0, 1, "extrinsics", "toCameraSocket"), -1, "no way from socket 1 to 2"),
        (("stereoRectificationData", "leftCameraSocket"), 9, "leftCameraSocket: found 9; allowed: one of"),
        (("stereoRectificationData",), None, "leftCameraSocket: found nothing"),
    ],
)
def test_what_is_wrong_with_a_calibration_is_named(tmp_path, path, wrong, told):
    table = calibration()
    above, last = at(table, path)
    above[last] = wrong
    with pytest.raises(InputError, match=told):
        read_depthai_calibration(save(tmp_path / "c.json", table))


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


def paths(value, before=()) -> list[tuple]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for key, inner in items for path in ((*before, key), *paths(inner, (*before, key)))]


@settings(max_examples=150)
@given(st.sampled_from(paths(calibration())), JSON_VALUES)
def test_any_value_anywhere_is_read_or_refused_in_words(path, value):
    table = copy.deepcopy(calibration())
    above, last = at(table, path)
    above[last] = value
    with tempfile.TemporaryDirectory() as place:
        file = save(Path(place) / "c.json", table)
        try:
            read_depthai_calibration(file).rig(320, 200)
        except InputError as error:
            assert error.where == str(file)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"{}", b"\xff\xfe", b"[" * 100_000])
def test_text_that_is_no_calibration(tmp_path, text):
    (tmp_path / "c.json").write_bytes(text)
    with pytest.raises(InputError, match=r"c\.json"):
        read_depthai_calibration(tmp_path / "c.json")


MATRIX = np.array([[55.0, 0, 32.0], [0, 55.0, 20.0], [0, 0, 1]])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three frames of a pair, of disparity in 1/8 px and of the depth that it makes with the designed baseline."""
    rng = np.random.default_rng(7)
    pair = rng.integers(0, 256, (2, 3, HEIGHT, WIDTH)).astype(np.uint8)
    disparity = rng.integers(30, 200, (3, HEIGHT, WIDTH)).astype(np.uint16)
    disparity[:, :5] = 0
    with np.errstate(divide="ignore"):
        depth = np.where(disparity > 0, 55.0 * 75.0 * 8 / disparity, 0).astype(np.uint16)
    streams = {"left": pair[0], "right": pair[1], "disparity": disparity, "depth": depth}
    folder = record(tmp_path_factory.mktemp("oak") / "recording", streams, MATRIX, first=40)
    save(folder / "calibration.json", calibration())
    return folder, streams


def only(recorded, place: Path, *names: str) -> Path:
    place.mkdir()
    for name in (*(f"{name}.mcap" for name in names), "calibration.json"):
        shutil.copy(recorded[0] / name, place / name)
    return place


@needs_depthai
def test_a_recorded_pair_comes_back_bit_by_bit_with_the_devices_maps_beside(recorded, tmp_path):
    folder, streams = recorded
    with pytest.raises(InputError, match=r"3 frames; allowed: one in a capture: choose 0 to 2"):
        read_depthai_recording(folder)
    capture = read_depthai_recording(folder, frame=1)
    assert (capture.technology, capture.source, capture.sensor) == ("active_stereo", "replay", "OAK-D-TEST")
    for side in ("left", "right"):
        np.testing.assert_array_equal(capture.images[side][0], streams[side][1])
    assert capture.settings["measured_from"] == "raw pair"
    assert capture.settings["sequence"] == 41
    assert capture.settings["baseline_mm"] == pytest.approx(BASELINE)
    assert capture.settings["spec_baseline_mm"] == 75.0
    np.testing.assert_array_equal(np.isnan(capture.derived["depth"]), streams["depth"][1] == 0)
    read = read_capture(write_capture(capture, tmp_path / "c"))
    np.testing.assert_array_equal(read.derived["disparity"], capture.derived["disparity"])


@needs_depthai
def test_disparity_goes_before_depth_and_is_triangulated_with_the_calibrated_baseline(recorded, tmp_path):
    """The depth beside it was made with the designed 75 mm: it tells how disparity is counted, and nothing else."""
    capture = read_depthai_recording(only(recorded, tmp_path / "r", "disparity", "depth"), frame=2)
    assert (capture.technology, capture.settings["measured_from"]) == ("disparity_map", "disparity")
    assert (capture.settings["subpixel_bits"], capture.settings["subpixel_bits_from"]) == (3, "depth")
    cloud = capture_cloud(capture, decoder_settings(capture)[0])
    raw = recorded[1]["disparity"][2]
    np.testing.assert_array_equal(cloud.valid, raw > 0)
    local = (cloud.points - cloud.grid.origin) @ cloud.grid.rotation
    np.testing.assert_allclose(local[raw > 0][:, 2], 55.0 * BASELINE * 8 / raw[raw > 0], rtol=1e-5)


@needs_depthai
def test_depth_alone_is_taken_as_it_is_and_says_so(recorded, tmp_path):
    folder = only(recorded, tmp_path / "r", "depth")
    capture = read_depthai_recording(folder / "depth.mcap", frame=0)
    assert (capture.technology, capture.settings["measured_from"]) == ("depth_map", "device depth")
    cloud = capture_cloud(capture, decoder_settings(capture)[0])
    raw = recorded[1]["depth"][0]
    np.testing.assert_array_equal(cloud.points[raw > 0][:, 2], raw[raw > 0])
    row, column = 20, 50
    x = (column - 32.0) / 55.0 * raw[row, column]
    assert cloud.points[row, column, 0] == pytest.approx(x, rel=1e-6)


@needs_depthai
def test_how_disparity_is_counted_is_told_or_assumed(recorded, tmp_path):
    folder = only(recorded, tmp_path / "r", "disparity")
    told = read_depthai_recording(folder, frame=0, subpixel_bits=3)
    assumed = read_depthai_recording(folder, frame=0)
    assert (told.settings["subpixel_bits_from"], assumed.settings["subpixel_bits_from"]) == ("option", "default")
    np.testing.assert_array_equal(told.derived["disparity"], assumed.derived["disparity"] * 4)


@needs_depthai
def test_damage_that_replay_does_not_see_is_refused(recorded, tmp_path):
    folder = only(recorded, tmp_path / "r", "depth")
    file = folder / "depth.mcap"
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"depth\.mcap: byte \d+: found a damaged record"):
        read_depthai_recording(folder, frame=0)
    file.write_bytes(content[:-100])
    with pytest.raises(InputError, match="cut off"):
        read_depthai_recording(folder, frame=0)


@needs_depthai
@settings(max_examples=300)
@given(data=st.data())
def test_any_flip_in_the_frames_of_a_recording_is_noticed(recorded, data):
    content = bytearray((recorded[0] / "disparity.mcap").read_bytes())
    # header and chunk end where the message index begins; schema and channel are in the chunk as well
    first = int.from_bytes(content[9:17], "little") + 17
    last = first + 9 + int.from_bytes(content[first + 1 : first + 9], "little")
    assert content[first] == 0x06
    place = None
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        # beyond the times in the header of the chunk, which nobody reads
        place = data.draw(st.integers(first + 9 + 16, last - 1))
        content[place] ^= data.draw(st.integers(1, 255))
    try:
        check_mcap(bytes(content), "x.mcap")
    except InputError:
        return
    # the header of the LZ4 frame itself: what comes out is whole, or the checksum of the chunk would not agree
    frame = content.index(b"\x04\x22\x4d\x18", first)
    assert place is not None and frame + 4 <= place < frame + 7


@given(st.binary(max_size=200))
def test_bytes_that_are_no_recording_are_refused(data):
    magic = b"\x89MCAP0\r\n"
    for content in (data, magic + data, magic + data + magic):
        with pytest.raises(InputError):
            check_mcap(content, "x.mcap")


@needs_depthai
def test_a_recording_that_ends_the_maker_s_library_or_never_ends_is_answered(recorded, tmp_path, monkeypatch):
    folder = only(recorded, tmp_path / "r", "depth")
    monkeypatch.setattr(depthai_replay, "PATIENCE_S", 0.01)
    with pytest.raises(InputError, match=r"replays for over 0\.01 s"):
        read_depthai_recording(folder, frame=0)
    monkeypatch.undo()
    monkeypatch.setattr(depthai_replay, "__name__", "no.such.module")
    with pytest.raises(InputError, match="DepthAI cannot replay"):
        read_depthai_recording(folder, frame=0)


def test_without_the_package_the_machine_lacks_something(tmp_path, monkeypatch):
    magic = b"\x89MCAP0\r\n"
    footer = b"\x02" + (20).to_bytes(8, "little") + bytes(20)
    (tmp_path / "depth.mcap").write_bytes(magic + footer + magic)
    save(tmp_path / "calibration.json", calibration())
    monkeypatch.setattr(depthai_replay, "find_spec", lambda name: None)
    with pytest.raises(MissingEnvironmentError, match="pip install"):
        read_depthai_recording(tmp_path)


def test_videos_and_doubtful_folders_are_refused(tmp_path):
    save(tmp_path / "calibration.json", calibration())
    with pytest.raises(InputError, match=r"no \.mcap; allowed: files whose names say left"):
        read_depthai_recording(tmp_path)
    (tmp_path / "left.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"found a video.*compressed with loss"):
        read_depthai_recording(tmp_path)
    for name in ("left.mcap", "CAM_B_raw.mcap", "rectifiedLeft.mcap"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"left: found CAM_B_raw\.mcap and left\.mcap; allowed: one file"):
        read_depthai_recording(tmp_path)
    (tmp_path / "CAM_B_raw.mcap").unlink()
    (tmp_path / "calibration.json").rename(tmp_path / "elsewhere.json")
    with pytest.raises(InputError, match="one calibration beside the recording"):
        read_depthai_recording(tmp_path)
