"""DepthAI's calibrations against the package's own reading of them, and its recordings, made here by the package."""

from __future__ import annotations

import copy
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.recordings import depthai_recording
from mitsim.capture.recordings.depthai_calibration import DepthaiCalibration, read_depthai_calibration
from mitsim.capture.recordings.depthai_frames import RecordedFrame, read_frames
from mitsim.capture.recordings.depthai_recording import read_depthai_recording
from mitsim.capture.recordings.mcap_messages import mcap_messages
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.sensor.camera import Camera
from mitsim.sensor.transforms import Transform
from tests.capture.recordings.depthai_recordings import EXPOSURE_US, ISO, Recording, record, rewritten

needs_depthai = pytest.mark.skipif(find_spec("depthai") is None, reason="no depthai: pip install 'mitsim[depthai]'")

WIDTH, HEIGHT, FOCAL, BASELINE = 64, 40, 50.0, 75.4


def entry(to: int, turn: list[float], translation: list[float], fisheye: bool = False) -> dict:
    """One camera as a device stores it: centimetres, single precision."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix().astype(np.float32)
    distortion = [0.1, -0.05, 0.01, 0.002, *[0.0] * 10] if fisheye else [0.0] * 14
    return {
        "cameraType": int(fisheye),
        "distortionCoeff": distortion,
        "height": HEIGHT,
        "width": WIDTH,
        "intrinsicMatrix": [[FOCAL, 0.0, 31.5], [0.0, FOCAL, 19.5], [0.0, 0.0, 1.0]],
        "lensPosition": 0,
        "specHfovDeg": 70.0,
        "extrinsics": {
            "rotationMatrix": rotation.tolist() if to >= 0 else [],
            "toCameraSocket": to,
            "translation": dict(zip("xyz", translation, strict=True)),
            "specTranslation": {"x": -7.5 if to == 2 else 3.75, "y": 0.0, "z": 0.0},
        },
    }


def calibration(version: int = 7, fisheye: bool = False, as_map: bool = False) -> dict:
    """Left (1) -> right (2) -> colour (0): x_right = R x_left + T with T = -7.54 cm along x."""
    cameras = [
        [1, entry(2, [0, 0, 0], [-BASELINE / 10, 0.0, 0.0], fisheye)],
        [2, entry(0, [0.3, -0.5, 0.2], [3.75, 0.01, -0.02], fisheye)],
        [0, entry(-1, [0, 0, 0], [0.0, 0.0, 0.0])],
    ]
    none = {"rectifiedRotationLeft": np.eye(3).tolist(), "rectifiedRotationRight": np.eye(3).tolist()}
    return {
        "batchName": "",
        "batchTime": 0,
        "boardConf": "",
        "boardName": "DM9098",
        "boardRev": "R6",
        "version": version,
        "productName": "OAK-D-TEST",
        "hardwareConf": "",
        "boardCustom": "",
        "boardOptions": 0,
        "cameraData": {str(socket): each for socket, each in cameras} if as_map else cameras,
        "imuExtrinsics": entry(-1, [0, 0, 0], [0.0, 0.0, 0.0])["extrinsics"],
        "miscellaneousData": [],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2, **none},
    }


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
        (("cameraData", 2, 1, "extrinsics"), entry(1, [0, 0, 0], [1, 0, 0])["extrinsics"], "cyclic extrinsics"),
        (("cameraData", 0, 1, "extrinsics", "toCameraSocket"), -1, "no connection from socket 1 to 2"),
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
    pytest.importorskip("depthai", reason="recordings are made by depthai: pip install 'mitsim[depthai]'")
    rng = np.random.default_rng(7)
    pair = rng.integers(0, 256, (2, 3, HEIGHT, WIDTH)).astype(np.uint8)
    disparity = rng.integers(30, 200, (3, HEIGHT, WIDTH)).astype(np.uint16)
    disparity[:, :5] = 0
    with np.errstate(divide="ignore"):
        depth = np.where(disparity > 0, 55.0 * 75.0 * 8 / disparity, 0).astype(np.uint16)
    streams = {"left": pair[0], "right": pair[1], "disparity": disparity, "depth": depth}
    folder = tmp_path_factory.mktemp("oak") / "recording"
    record(Recording(folder, streams, MATRIX, first=40))
    save(folder / "calibration.json", calibration())
    return folder, streams


def only(recorded, place: Path, *names: str) -> Path:
    place.mkdir()
    for name in (*(f"{name}.mcap" for name in names), "calibration.json"):
        shutil.copy(recorded[0] / name, place / name)
    return place


def test_a_recorded_pair_comes_back_bit_by_bit_with_the_devices_maps_beside(recorded, tmp_path):
    folder, streams = recorded
    with pytest.raises(InputError, match=r"3 frames; allowed: one in a capture.*choose with --frame 0 to 2"):
        read_depthai_recording(folder, ReadOptions())
    capture = read_depthai_recording(folder, ReadOptions(frame=1))
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


def test_disparity_goes_before_depth_and_is_triangulated_with_the_calibrated_baseline(recorded, tmp_path):
    """The depth beside it was made with the designed 75 mm: it tells how disparity is counted, and nothing else."""
    capture = read_depthai_recording(only(recorded, tmp_path / "r", "disparity", "depth"), ReadOptions(frame=2))
    assert (capture.technology, capture.settings["measured_from"]) == ("disparity_map", "disparity")
    assert (capture.settings["subpixel_bits"], capture.settings["subpixel_bits_from"]) == (3, "depth")
    cloud = capture_cloud(capture, decoder_settings(capture)[0])
    raw = recorded[1]["disparity"][2]
    np.testing.assert_array_equal(cloud.valid, raw > 0)
    local = (cloud.points - cloud.grid.origin) @ cloud.grid.rotation
    np.testing.assert_allclose(local[raw > 0][:, 2], 55.0 * BASELINE * 8 / raw[raw > 0], rtol=1e-5)


def test_depth_alone_is_taken_as_it_is_and_says_so(recorded, tmp_path):
    folder = only(recorded, tmp_path / "r", "depth")
    capture = read_depthai_recording(folder / "depth.mcap", ReadOptions(frame=0))
    assert (capture.technology, capture.settings["measured_from"]) == ("depth_map", "device depth")
    cloud = capture_cloud(capture, decoder_settings(capture)[0])
    raw = recorded[1]["depth"][0]
    np.testing.assert_array_equal(cloud.points[raw > 0][:, 2], raw[raw > 0])
    row, column = 20, 50
    x = (column - 32.0) / 55.0 * raw[row, column]
    assert cloud.points[row, column, 0] == pytest.approx(x, rel=1e-6)


def test_the_largest_level_of_the_devices_depth_is_no_depth(recorded, monkeypatch):
    """Before, it was a depth of 65.5 m."""
    of_files = depthai_recording._read_frames

    def saturated(streams, frame):
        frames = of_files(streams, frame)
        levels = frames["depth"].image.copy()
        levels[20, 50] = 65535
        return frames | {"depth": replace(frames["depth"], image=levels)}

    monkeypatch.setattr(depthai_recording, "_read_frames", saturated)
    capture = read_depthai_recording(recorded[0], ReadOptions(frame=1))
    missing = recorded[1]["depth"][1] == 0
    missing[20, 50] = True
    np.testing.assert_array_equal(np.isnan(capture.derived["depth"]), missing)
    assert ["the level 65535" in warning for warning in capture.settings["warnings"]] == [True]


def test_how_disparity_is_counted_is_told_or_assumed(recorded, tmp_path):
    folder = only(recorded, tmp_path / "r", "disparity")
    told = read_depthai_recording(folder, ReadOptions(frame=0, subpixel_bits=3))
    assumed = read_depthai_recording(folder, ReadOptions(frame=0))
    assert (told.settings["subpixel_bits_from"], assumed.settings["subpixel_bits_from"]) == ("option", "default")
    np.testing.assert_array_equal(told.derived["disparity"], assumed.derived["disparity"] * 4)


def test_damage_is_refused(recorded, tmp_path):
    folder = only(recorded, tmp_path / "r", "depth")
    file = folder / "depth.mcap"
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"depth\.mcap: byte \d+: found a damaged record"):
        read_depthai_recording(folder, ReadOptions(frame=0))
    file.write_bytes(content[:-100])
    with pytest.raises(InputError, match="truncated"):
        read_depthai_recording(folder, ReadOptions(frame=0))


FRAMES = {"uint8": (np.uint8, False), "uint8, grey": (np.uint8, True), "uint16": (np.uint16, False)}


@pytest.fixture(scope="module")
def halved(tmp_path_factory):
    """Recordings of forty frames, more than the queues hold, with padded rows, of frames that were cut and halved."""
    pytest.importorskip("depthai", reason="recordings are made by depthai: pip install 'mitsim[depthai]'")
    matrix = np.array([[110.0, 0, 75.5], [0, 111.0, 51.0], [0, 0, 1]])
    made = {}
    for name, (dtype, grey) in FRAMES.items():
        stack = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, (40, HEIGHT, WIDTH)).astype(dtype)
        folder = tmp_path_factory.mktemp("halved") / "r"
        made[name] = Recording(folder, {"depth": stack}, matrix, 7, padding=6, cropped=True, grey=grey)
    record(*made.values())
    return made


@pytest.mark.parametrize("name", FRAMES)
def test_padded_rows_and_cropped_and_halved_frames_are_what_depthai_says(halved, name):
    """The last of the frames is read."""
    folder, stack = halved[name].folder, halved[name].streams["depth"]
    read = read_frames({"depth": folder / "depth.mcap"}, 39)["depth"]
    with np.load(folder / "depth.npz") as said:
        np.testing.assert_array_equal(read.image, said["images"][39])
        np.testing.assert_allclose(read.matrix, said["matrices"][39], rtol=1e-6)  # it tells single precision
    np.testing.assert_array_equal(read.image, stack[39])
    # by hand: cut at (8, 12), then halved
    np.testing.assert_allclose(read.matrix, [[55.0, 0, 33.75], [0, 55.5, 19.5], [0, 0, 1]], rtol=1e-6)
    assert (read.exposure_s, read.sensitivity_iso) == (pytest.approx((EXPOSURE_US + 39) * 1e-6), ISO)
    assert (read.sequence, read.count) == (46, 40)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"chunk_size": 1},
        {"enable_crcs": False},
        {"enable_data_crcs": True},
        {
            "use_statistics": False,
            "use_summary_offsets": False,
            "repeat_channels": False,
            "repeat_schemas": False,
            "index_types": IndexType.NONE,
        },
    ],
)
def test_recordings_packed_in_other_ways_hold_the_same_frames(recorded, tmp_path, options):
    content = (recorded[0] / "depth.mcap").read_bytes()
    (tmp_path / "depth.mcap").write_bytes(rewritten(content, **options))
    read = read_frames({"depth": tmp_path / "depth.mcap"}, 1)["depth"]
    expected = read_frames({"depth": recorded[0] / "depth.mcap"}, 1)["depth"]
    np.testing.assert_array_equal(read.image, expected.image)
    np.testing.assert_array_equal(read.matrix, expected.matrix)


def test_reading_needs_no_depthai(recorded, monkeypatch):
    monkeypatch.setitem(sys.modules, "depthai", None)
    assert read_depthai_recording(recorded[0], ReadOptions(frame=0)).technology == "active_stereo"


@settings(max_examples=400)
@given(data=st.data())
def test_any_flip_in_a_recording_is_noticed_or_changes_no_message(recorded, data):
    content = (recorded[0] / "disparity.mcap").read_bytes()
    expected = [(schema, message.data) for schema, _, message in mcap_messages(content, "x.mcap")]
    if data.draw(st.booleans()):
        damaged = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        place = data.draw(st.integers(0, len(content) - 1))
        flipped = content[place] ^ data.draw(st.integers(1, 255))
        damaged = content[:place] + bytes([flipped]) + content[place + 1 :]
    try:
        assert [(schema, message.data) for schema, _, message in mcap_messages(damaged, "x.mcap")] == expected
    except InputError as error:
        assert error.where == "x.mcap"


def img_frame(content: bytes) -> type:
    """The class of a recording's messages."""
    schema, channel, _ = next(make_reader(BytesIO(content)).iter_messages())
    read = DecoderFactory().decoder_for(channel.message_encoding, schema)
    assert read is not None
    return type(read(b""))


def changed(content: bytes, **values: int | bytes) -> bytes:
    """A recording whose frames say something else of themselves, by names as ``fb__width``."""
    frame = img_frame(content)

    def change(messages):
        out = []
        for data in messages:
            message = frame.FromString(data)
            for name, value in values.items():
                *above, last = name.split("__")
                setattr(message if not above else getattr(message, *above), last, value)
            out.append(message.SerializeToString())
        return out

    return rewritten(content, change)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"fb__type": 24}, "found frames of BITSTREAM, which are compressed with loss; allowed: RAW8, GRAY8, RAW16"),
        ({"fb__type": 22}, "found frames of NV12; allowed"),
        ({"fb__type": 99}, r"found a message that is not an ImgFrame \(99\)"),
        ({"fb__width": 0}, "size: found 0 x 40 px; allowed: sides of 1 to"),
        ({"fb__height": 2**32 - 1}, "size: found 64 x 4294967295 px"),
        ({"fb__height": 41}, "found a frame of 5120 bytes; allowed: 64 x 41 px of 2 bytes, rows 128 bytes apart"),
        ({"fb__stride": 130}, "found a frame of 5120 bytes; allowed: 64 x 40 px of 2 bytes, rows 130 bytes apart"),
        ({"fb__stride": 2**32 - 2}, "found a frame of 5120 bytes"),
        ({"fb__stride": 126}, "stride: found 126 bytes; allowed: at least a row of 64 px"),
        ({"fb__stride": 129}, "stride: found 129 bytes; allowed: .* whole pixels of 2 bytes"),
        ({"sequenceNum": 5, "data": b""}, "found a frame of 0 bytes"),
    ],
)
def test_frames_that_are_not_plain_or_not_whole_are_refused(recorded, tmp_path, values, told):
    file = tmp_path / "depth.mcap"
    file.write_bytes(changed((recorded[0] / "depth.mcap").read_bytes(), **values))
    with pytest.raises(InputError, match=rf"depth\.mcap: {told}"):
        read_frames({"depth": file}, 0)


@pytest.mark.parametrize(
    ("how", "told"),
    [
        (
            {"schema": lambda _, data: ("dai.proto.encoded_frame.EncodedFrame", data)},
            "frames of EncodedFrame, which are compressed with loss",
        ),
        ({"schema": lambda _, data: ("dai.proto.imu_data.IMUData", data)}, "found frames of IMUData; allowed: RAW8"),
        ({"schema": lambda name, _: (name, b"")}, "FileDescriptorSet .* is missing that schema"),
        ({"schema": lambda name, _: (name, chain(3000))}, "a message that is not an ImgFrame .*recursion"),
        ({"change": lambda _: []}, "a recording without a frame"),
        ({"change": lambda messages: [b"\xff", *messages]}, "a message that is not an ImgFrame"),
        ({"channels": 2}, "img_frame1: found a second stream"),
    ],
)
def test_recordings_of_something_else_are_refused(recorded, tmp_path, how, told):
    file = tmp_path / "depth.mcap"
    file.write_bytes(rewritten((recorded[0] / "depth.mcap").read_bytes(), **how))
    with pytest.raises(InputError, match=told):
        read_frames({"depth": file}, 0)


def chain(count: int) -> bytes:
    """Descriptions each of which needs the one before."""
    files = [FileDescriptorProto(name=str(n), dependency=[str(n - 1)]) for n in range(count)]
    return FileDescriptorSet(file=files).SerializeToString()


def test_frames_are_those_whose_numbers_all_streams_have(recorded, tmp_path):
    """The left stream has lost the first frame, the right one the last: one is common."""
    for name, kept in (("left", slice(1, None)), ("right", slice(None, 2))):
        content = rewritten((recorded[0] / f"{name}.mcap").read_bytes(), lambda messages, kept=kept: messages[kept])
        (tmp_path / f"{name}.mcap").write_bytes(content)
    files = {name: tmp_path / f"{name}.mcap" for name in ("left", "right")}
    frames = read_frames(files, None)
    for name, frame in frames.items():
        np.testing.assert_array_equal(frame.image, recorded[1][name][1])
        assert (frame.sequence, frame.count) == (41, 1)
    with pytest.raises(InputError, match=r"left\.mcap: --frame: found 1; allowed: 0 to 0"):
        read_frames(files, 1)
    files["left"].write_bytes(changed(files["left"].read_bytes(), sequenceNum=7))
    assert read_frames(files, 1)["left"].count == 2  # all of one number: told by their order
    files["left"].write_bytes(rewritten(files["left"].read_bytes(), lambda messages: messages[:1]))
    with pytest.raises(InputError, match="streams without a frame in common"):
        read_frames(files, None)


def fields_of(description: FileDescriptorSet) -> list[tuple[int, ...]]:
    """Places of all fields of all messages: file, message, messages in it, field."""

    def of(message, before):
        for number in range(len(message.field)):
            yield (*before, number)
        for number, inner in enumerate(message.nested_type):
            yield from of(inner, (*before, number))

    return [
        place
        for f, file in enumerate(description.file)
        for m, message in enumerate(file.message_type)
        for place in of(message, (f, m))
    ]


@settings(max_examples=200)
@given(data=st.data())
def test_any_description_and_any_message_are_read_or_refused_in_words(recorded, data):
    """Bytes of the message or of its description changed, or a field of another type, with whole checksums."""
    content = (recorded[0] / "depth.mcap").read_bytes()

    def edited(begin: bytes) -> bytes:
        at = data.draw(st.integers(0, min(len(begin), 600)) | st.integers(0, len(begin)))
        return begin[:at] + data.draw(st.binary(max_size=6)) + begin[at + data.draw(st.integers(0, 6)) :]

    def retyped(begin: bytes) -> bytes:
        description = FileDescriptorSet.FromString(begin)
        f, m, *inner, last = data.draw(st.sampled_from(fields_of(description)))
        message = description.file[f].message_type[m]
        for number in inner:
            message = message.nested_type[number]
        field = message.field[last]
        field.type, field.label = data.draw(st.integers(1, 18)), data.draw(st.integers(1, 3))
        if field.type not in (11, 14):
            field.ClearField("type_name")
        return description.SerializeToString()

    way = data.draw(st.sampled_from(["message", "description", "type"]))
    if way == "message":
        content = rewritten(content, lambda messages: [edited(messages[0]), *messages[1:]])
    else:
        edit = edited if way == "description" else retyped
        content = rewritten(content, schema=lambda name, begin: (name, edit(begin)))
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "depth.mcap"
        file.write_bytes(content)
        save(Path(place) / "calibration.json", calibration())
        try:
            capture = read_depthai_recording(file, ReadOptions(frame=0))
        except InputError as error:
            assert error.where == str(file)
        else:
            assert capture.technology == "depth_map"


def test_videos_and_doubtful_folders_are_refused(tmp_path):
    save(tmp_path / "calibration.json", calibration())
    with pytest.raises(InputError, match=r"no \.mcap; allowed: files whose names say left"):
        read_depthai_recording(tmp_path, ReadOptions())
    (tmp_path / "left.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"found a video.*compressed with loss"):
        read_depthai_recording(tmp_path, ReadOptions())
    for name in ("left.mcap", "CAM_B_raw.mcap", "rectifiedLeft.mcap"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"left: found CAM_B_raw\.mcap and left\.mcap; allowed: one file"):
        read_depthai_recording(tmp_path, ReadOptions())
    (tmp_path / "CAM_B_raw.mcap").unlink()
    (tmp_path / "calibration.json").rename(tmp_path / "elsewhere.json")
    with pytest.raises(InputError, match="one calibration beside the recording"):
        read_depthai_recording(tmp_path, ReadOptions())


def test_without_the_extra_other_recordings_load_and_these_say_what_to_install(recorded):
    """In a process of its own, where none of its packages can be imported."""
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('mcap', 'mcap_protobuf', 'lz4', 'zstandard', 'google')))\n"
        "import mitsim.cli.import_recording, mitsim.decoding.input_clouds\n"
        "from characterisation.files.errors import MissingEnvironmentError\n"
        "from mitsim.capture.recordings.any_recording import ReadOptions, read_recording\n"
        "try: read_recording(sys.argv[1], ReadOptions(frame=0))\n"
        "except MissingEnvironmentError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, recorded[0]], capture_output=True, text=True, check=False)
    assert "packages that are not installed (" in done.stdout and "pip install 'mitsim[recordings]'" in done.stdout, (
        done.stderr
    )


def test_the_maker_s_name_is_no_depth(tmp_path):
    """Before, both were the stream ``depth``: "depthai" contains it."""
    for name in ("depthai_left", "depthai_right", "DepthAI-depth"):
        (tmp_path / f"{name}.mcap").touch()
    streams = depthai_recording.recorded_streams(tmp_path)
    assert {name: file.stem for name, file in streams.items()} == {
        "depth": "DepthAI-depth",
        "left": "depthai_left",
        "right": "depthai_right",
    }


@pytest.mark.parametrize(
    ("name", "socket", "is_read"), [("depth", 2, False), ("depth", 1, True), ("disparity", 2, False)]
)
def test_a_map_of_another_camera_is_refused(recorded, tmp_path, name, socket, is_read):
    """Before, a map that was aligned to the right camera stood in the left one."""
    folder = only(recorded, tmp_path / "r", name)
    file = folder / f"{name}.mcap"
    file.write_bytes(changed(file.read_bytes(), instanceNum=socket))
    if is_read:
        assert read_depthai_recording(folder, ReadOptions(frame=0)).derived[name].any()
        return
    with pytest.raises(InputError, match="instanceNum: found 2; allowed: the camera at socket 1"):
        read_depthai_recording(folder, ReadOptions(frame=0))


def test_depth_and_disparity_have_one_frame():
    """Depth stood in the rectified frame of the left camera, all else in the camera's own: 12 mm off at 1 m."""
    eye = Camera(np.array([[55.0, 0, 32], [0, 55, 20], [0, 0, 1]]), np.zeros(5), 64, 40)
    right_from_left = Transform.from_degrees([0.3, 1.2, 0.4], [-75, 0.5, 1])
    calibration = DepthaiCalibration({1: eye, 2: eye}, 1, 2, right_from_left, None, "turned")
    frame = RecordedFrame(np.zeros((40, 64), np.uint16), eye.matrix, 0.0, 0, 0, 1, 1)
    depth = depthai_recording._depth_rig(frame, calibration).cameras["depth"]
    pair = depthai_recording._disparity_rig(frame, calibration)
    point = np.array([[120.0, -60.0, 1000.0]])
    rectified = pair.rectification.rotation_left @ point[0]
    wanted = (eye.matrix @ (rectified / rectified[2]))[:2]
    assert depth.project(point)[0] == pytest.approx(wanted, abs=1e-9)
