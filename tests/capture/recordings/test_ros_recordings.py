"""Bags that rosbags wrote: depths, clouds and pairs come back in mm, and everything else is refused in words."""

from __future__ import annotations

import json

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings import any_recording, ros_bag
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.decoding import input_clouds
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.input_clouds import read_cloud
from tests.capture.recordings.ros_bags import (
    ROS1,
    ROS2,
    cloud,
    depth_messages,
    depth_mm,
    image,
    info,
    packed,
    points_m,
    quantised,
    typed,
    write_bag,
)

FORMS = [("bag", None), ("bag", "LZ4"), ("bag", "BZ2"), ("db3", None), ("db3", "MESSAGE"), ("mcap", None)]


def store_of(form):
    return ROS1 if form == "bag" else ROS2


def bag(folder, messages, form="mcap", compression=None):
    return write_bag(folder / ("b.bag" if form == "bag" else "b"), messages, form, compression)


def depth_of(path, **options):
    return read_recording(path, ReadOptions(**options)).capture.derived["depth"]


def seen(depth):
    return np.where(depth > 0, depth, np.nan).astype(np.float32)


@pytest.mark.parametrize(("form", "compression"), FORMS)
def test_a_depth_image_comes_back_with_its_camera(tmp_path, form, compression):
    path = bag(tmp_path, depth_messages(store_of(form), frames=3), form, compression)
    capture = read_recording(path, ReadOptions(frame="2")).capture
    assert np.array_equal(capture.derived["depth"], seen(depth_mm()), equal_nan=True)
    assert np.array_equal(capture.rig.reference.matrix, [[60, 0, 31.3], [0, 61, 22.8], [0, 0, 1]])
    assert capture.settings["stamp_s"] == pytest.approx(1 + 2 / 30, abs=1e-6)
    with pytest.raises(InputError, match="--frame"):
        read_recording(path, ReadOptions())
    with pytest.raises(InputError, match="0 to 2"):
        read_recording(path, ReadOptions(frame="3"))


@pytest.mark.parametrize("form", ["db3", "mcap"])
def test_the_folder_of_a_bag_is_read_as_its_file(tmp_path, form):
    path = bag(tmp_path, depth_messages(ROS2), form)
    assert np.array_equal(depth_of(path.parent), depth_of(path), equal_nan=True)


def test_files_of_a_split_bag_follow_one_another(tmp_path):
    first, second = depth_messages(ROS2), [("/camera/depth/image_rect_raw", image(ROS2, depth_mm() * 2, "16UC1"))]
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, part in ((2, first), (10, second)):
        write_bag(tmp_path / f"part{number}", part, "db3").rename(folder / f"bag_{number}.db3")
    assert np.nanmax(depth_of(folder, frame="1")) == 2 * depth_mm().max()


def test_the_largest_level_is_no_depth(tmp_path):
    """Before, it was a depth of 65.5 m."""
    levels = depth_mm().copy()
    levels[20, 30] = 65535
    path = bag(tmp_path, [("/a/camera_info", info(ROS2)), ("/a/depth", image(ROS2, levels, "16UC1"))])
    capture = read_recording(path, ReadOptions()).capture
    expected = seen(np.where(levels == 65535, 0, levels))
    np.testing.assert_array_equal(capture.derived["depth"], expected)
    assert ["the level 65535" in warning for warning in capture.settings["warnings"]] == [True]


METRES = depth_mm().astype(np.float32) / 1000
PREFIX, LEVELS = quantised(METRES)


@pytest.mark.parametrize(
    ("made", "tolerance"),
    [
        (lambda store: image(store, METRES, "32FC1"), 1e-4),
        (lambda store: image(store, METRES, "32FC1", padding=8), 1e-4),
        (lambda store: image(store, depth_mm(), "mono16", big=True), 1e-4),
        (lambda store: image(store, depth_mm(), "16UC1", padding=6), 1e-4),
        (lambda store: packed(store, depth_mm(), "16UC1; compressedDepth png", bytes(12)), 1e-4),
        (lambda store: packed(store, depth_mm(), "16UC1; png compressed "), 1e-4),
        (lambda store: packed(store, LEVELS, "32FC1; compressedDepth png", PREFIX), 0.1),  # half a level: 0.08 mm
    ],
)
def test_every_encoding_of_a_depth_is_the_same_depth(tmp_path, made, tolerance):
    path = bag(tmp_path, [("/a/camera_info", info(ROS2)), ("/a/depth", made(ROS2))])
    found = depth_of(path)
    assert np.array_equal(np.isnan(found), depth_mm() == 0)
    assert np.nanmax(np.abs(found - seen(depth_mm()))) < tolerance


@pytest.mark.parametrize(
    ("name", "encoding", "is_depth"),
    [
        ("/camera/aligned_depth_to_color/image_raw", "16UC1", True),
        ("/camera/depth/image", "mono16", True),
        ("/camera/rgb/image_mono", "mono16", False),
        ("/camera/snr/image", "32FC1", False),
        ("/camera/confidence/image", "16UC1", False),
    ],
)
def test_an_image_of_16_bits_is_a_depth_by_its_topic_too(tmp_path, name, encoding, is_depth):
    """Before, grey images of 16 bits and maps of the signal-to-noise ratio were depths."""
    values = METRES if encoding == "32FC1" else depth_mm()
    space = name.rpartition("/")[0]
    path = bag(tmp_path, [(f"{space}/camera_info", info(ROS2)), (name, image(ROS2, values, encoding))])
    if is_depth:
        assert np.array_equal(depth_of(path), seen(depth_mm()), equal_nan=True)
    else:
        with pytest.raises(InputError, match=f"{name} .*Image, {encoding}"):
            depth_of(path)


def test_a_bag_of_the_viewer_of_realsense_has_its_own_unit(tmp_path):
    sensor = "/device_0/sensor_0"
    unit = typed(ROS1, "std_msgs/msg/Float32", data=0.0001)
    path = bag(
        tmp_path,
        [
            (f"{sensor}/option/Depth_Units/value", unit),
            (f"{sensor}/Depth_0/info/camera_info", info(ROS1, p=np.zeros(12), model="Brown Conrady")),
            (f"{sensor}/Infrared_1/info/camera_info", info(ROS1, k=np.eye(3).ravel(), p=np.zeros(12))),
            (f"{sensor}/Infrared_1/image/data", image(ROS1, depth_mm(), "mono16")),
            (f"{sensor}/Depth_0/image/data", image(ROS1, depth_mm(), "mono16")),
        ],
        "bag",
    )
    assert np.nanmax(depth_of(path)) == pytest.approx(depth_mm().max() / 10)
    assert np.nanmax(depth_of(path, scale_mm=0.5)) == pytest.approx(depth_mm().max() / 2)


def test_the_camera_info_of_another_camera_is_not_taken(tmp_path):
    path = bag(tmp_path, [("/cam/color/camera_info", info(ROS2)), ("/cam/depth/image", image(ROS2, METRES, "32FC1"))])
    with pytest.raises(InputError, match=r"/cam/color/camera_info.*--calibration"):
        read_recording(path, ReadOptions())


def test_a_camera_info_is_read_with_what_qualifies_it(tmp_path):
    """The principal point of the full imager is moved to the region, and a rectified image has the projection's."""
    whole = info(ROS2, roi=(100, 50, 64, 48), k=[60, 0, 131.3, 0, 61, 72.8, 0, 0, 1], size=(320, 240))
    path = bag(tmp_path, [("/a/camera_info", whole), ("/a/depth", image(ROS2, depth_mm(), "16UC1"))])
    assert read_recording(path, ReadOptions()).capture.rig.reference.matrix[:2, 2] == pytest.approx([31.3, 22.8])
    projection = [55, 0, 30, 0, 0, 55, 20, 0, 0, 0, 1, 0]
    bent = info(ROS2, p=projection, d=[-0.2, 0.05, 0, 0, 0])
    for name, focal, first in (("image_rect", 55, 0), ("image_raw", 60, -0.2)):
        path = write_bag(
            tmp_path / name, [("/a/camera_info", bent), (f"/a/{name}", image(ROS2, depth_mm(), "16UC1"))], "mcap"
        )
        camera = read_recording(path, ReadOptions()).capture.rig.reference
        assert camera.matrix[0, 0] == focal
        assert np.r_[camera.distortion, 0][0] == first


@pytest.mark.parametrize(("form", "kind", "big"), [("bag", "f4", False), ("db3", "f8", False), ("mcap", "f4", True)])
def test_an_organised_cloud_comes_back_in_mm(tmp_path, form, kind, big):
    made = cloud(store_of(form), points_m(), kind, big, padding=4)
    capture = read_recording(bag(tmp_path, [("/points", made)], form), ReadOptions()).capture
    assert np.nanmax(np.abs(capture.derived["points"] - points_m() * 1000)) < 1e-3
    assert capture_cloud(capture, decoder_settings(capture)[0]).valid.sum() == (depth_mm() > 0).sum()


def test_a_small_cloud_has_the_camera_of_its_namespace(tmp_path):
    """300 points are too few to fit a camera; that of another size or place is not taken."""
    few = points_m()
    few[:, 30:] = np.nan
    few[12:] = np.nan
    for name, matrix in (("right", None), ("wrong", [90.0, 0, 31.3, 0, 61, 22.8, 0, 0, 1])):
        messages = [("/depth/camera_info", info(ROS2, k=matrix)), ("/depth/points", cloud(ROS2, few))]
        path = write_bag(tmp_path / name, messages, "mcap")
        if name == "right":
            assert read_recording(path, ReadOptions()).capture.rig.reference.matrix[0, 0] == 60
        else:
            with pytest.raises(InputError, match="match no camera at the origin"):
                read_recording(path, ReadOptions())


def test_a_cloud_without_a_grid_is_measured_and_not_imported(tmp_path):
    path = bag(tmp_path, [("/points", cloud(ROS2, points_m()[depth_mm() > 0][None]))])
    with pytest.raises(InputError, match="without a grid"):
        read_recording(path, ReadOptions())
    found = read_cloud(path).cloud
    assert found.valid.sum() == (depth_mm() > 0).sum()
    assert np.nanmean(found.points[..., 2]) == pytest.approx(np.nanmean(points_m()[..., 2]) * 1000, abs=1e-3)


@pytest.mark.parametrize("organised", [False, True])
def test_a_bag_to_measure_is_recognised_and_opened_once(tmp_path, monkeypatch, organised):
    points = points_m() if organised else points_m()[depth_mm() > 0][None]
    path = bag(tmp_path, [("/points", cloud(ROS2, points))])
    calls = []
    for module, name in ((input_clouds, "kind_of"), (any_recording, "kind_of"), (ros_bag, "open_bag")):
        real = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, name=name, real=real, **k: calls.append(name) or real(*a, **k))
    assert (read_cloud(path).cloud.grid.height > 1) == organised
    assert calls == ["kind_of", "open_bag"]


def pair(store, second=1.0, baseline_m=0.05):
    texture = np.random.default_rng(3).integers(0, 255, (48, 64)).astype(np.uint8)
    right = [60, 0, 31.3, -60 * baseline_m, 0, 61, 22.8, 0, 0, 0, 1, 0]
    return [
        ("/l/camera_info", info(store)),
        ("/r/camera_info", info(store, p=right)),
        ("/l/image_rect_raw", image(store, texture, "mono8")),
        ("/r/image_rect_raw", image(store, np.stack([texture] * 3, axis=-1), "rgb8", second)),
    ]


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_a_pair_of_images_is_a_capture_of_two_cameras(tmp_path, form):
    path = bag(tmp_path, pair(store_of(form)), form)
    names = ("/l/image_rect_raw", "/r/image_rect_raw")
    capture = read_recording(path, ReadOptions(topic=names)).capture
    assert capture.technology == "active_stereo"
    assert np.linalg.norm(capture.rig.cameras["right"].centre) == pytest.approx(50, abs=1e-6)
    assert np.array_equal(capture.images["left"], capture.images["right"])
    with pytest.raises(InputError, match="--topic LEFT --topic RIGHT"):
        read_recording(path, ReadOptions())


def test_a_pair_of_two_times_or_without_a_baseline_is_refused(tmp_path):
    names = ("/l/image_rect_raw", "/r/image_rect_raw")
    with pytest.raises(InputError, match=r"0.1 s from the left image"):
        read_recording(write_bag(tmp_path / "a", pair(ROS2, 1.1), "mcap"), ReadOptions(topic=names))
    with pytest.raises(InputError, match="without a baseline"):
        read_recording(write_bag(tmp_path / "b", pair(ROS2, baseline_m=0), "mcap"), ReadOptions(topic=names))


def test_a_calibration_of_two_single_cameras_is_none_of_a_pair(tmp_path):
    """Before, both images were of one place."""
    eyes = {name: {"K": [[60, 0, x], [0, 61, 22.8], [0, 0, 1]]} for name, x in (("one", 31.3), ("other", 33.3))}
    (tmp_path / "eyes.json").write_text(json.dumps(eyes))
    options = ReadOptions(topic=("/l/image_rect_raw", "/r/image_rect_raw"), calibration=str(tmp_path / "eyes.json"))
    with pytest.raises(InputError, match="one, other, without the pose of the second; allowed: two cameras"):
        read_recording(bag(tmp_path, pair(ROS2)), options)


def test_several_topics_are_listed_and_one_is_chosen(tmp_path):
    path = bag(tmp_path, [*depth_messages(ROS2), *depth_messages(ROS2, "/other"), ("/points", cloud(ROS2, points_m()))])
    with pytest.raises(InputError, match=r"3 topics.*/other/image_rect_raw \(depth, 1\).*/points \(cloud, 1\)"):
        read_recording(path, ReadOptions())
    assert read_recording(path, ReadOptions(topic=("/points",))).capture.technology == "point_map"
    with pytest.raises(InputError, match="did you mean '/points'"):
        read_recording(path, ReadOptions(topic=("/point",)))
    with pytest.raises(InputError, match=r"CameraInfo, 1 messages"):
        read_recording(path, ReadOptions(topic=("/other/camera_info",)))


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (lambda: packed(ROS2, depth_mm(), "16UC1; compressedDepth rvl", bytes(12)), "compressedDepth as PNG"),
        (lambda: packed(ROS2, depth_mm(), "16UC1; jpeg compressed bgr8"), "compressed as PNG"),
        (lambda: image(ROS2, np.zeros((48, 64), np.uint16), "16UC1"), "no pixel with a depth"),
        (lambda: image(ROS2, -METRES, "32FC1"), "check --scale"),
        (lambda: image(ROS2, depth_mm()[:, :60], "16UC1"), "60 x 48 px"),
        (lambda: image(ROS2, np.zeros((48, 64), np.uint8), "mono8"), "a bag with"),
    ],
)
def test_what_is_no_depth_is_refused_with_the_reason(tmp_path, made, text):
    path = bag(tmp_path, [("/a/camera_info", info(ROS2)), ("/a/depth", made())])
    with pytest.raises(InputError, match=text):
        read_recording(path, ReadOptions())


def test_a_message_shorter_than_it_says_is_refused(tmp_path):
    made = image(ROS2, depth_mm(), "16UC1")
    made.data = made.data[:-2]
    with pytest.raises(InputError, match="6142 bytes in rows of 128"):
        read_recording(bag(tmp_path, [("/a/camera_info", info(ROS2)), ("/a/depth", made)]), ReadOptions())


@pytest.mark.parametrize("form", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 0.97])
def test_a_truncated_bag_is_refused(tmp_path, form, share):
    path = bag(tmp_path, depth_messages(store_of(form), frames=4), form)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(InputError, match=path.name):
        read_recording(path, ReadOptions(frame="3"))


def test_a_definition_of_its_own_is_refused(tmp_path):
    path = bag(tmp_path, depth_messages(ROS1), "bag")
    text = path.read_bytes()
    digest = ROS1.generate_msgdef("sensor_msgs/msg/Image")[1].encode()
    path.write_bytes(text.replace(digest, digest[::-1]))
    with pytest.raises(InputError, match="a definition of sensor_msgs/msg/Image that is not ROS's"):
        read_recording(path, ReadOptions())


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("image_rect", True),
        ("image_rect/compressed", True),
        ("image_rect_raw", True),
        ("image_rectified", True),
        ("rect/image_raw", False),
        ("image_corrected", False),
        ("direct", False),
    ],
)
def test_the_word_rect_tells_a_rectified_image(tmp_path, topic, rectified):
    """Before, a transport hid the word, and ``corrected`` contained it."""
    texture = np.random.default_rng(3).integers(0, 255, (48, 64)).astype(np.uint8)
    messages = []
    for side, shift in (("l", 0.0), ("r", -3.0)):
        p = [50, 0, 31.3, shift, 0, 51, 22.8, 0, 0, 0, 1, 0]
        shown = packed(ROS2, texture, "mono8; png compressed") if "/comp" in topic else image(ROS2, texture, "mono8")
        messages += [(f"/{side}/camera_info", info(ROS2, p=p, d=[-0.3, 0, 0, 0, 0])), (f"/{side}/{topic}", shown)]
    capture = read_recording(bag(tmp_path, messages), ReadOptions(topic=(f"/l/{topic}", f"/r/{topic}"))).capture
    assert capture.rig.reference.matrix[0, 0] == (50 if rectified else 60)
    assert capture.rig.reference.distortion.any() != rectified


def test_the_kept_messages_of_a_pair_are_those_that_were_read(tmp_path):
    """Before, the right one was that of the same number."""
    (*calibration, (left, one), (right, other)) = pair(ROS2)
    late = pair(ROS2, second=1.1)[-1][1]
    early = pair(ROS2, second=0.9)[-1][1]
    path = bag(tmp_path, [*calibration, (left, one), (right, early), (right, other), (right, late)])
    kept = read_recording(path, ReadOptions(topic=(left, right))).originals
    assert set(kept) == {"l_image_rect_raw_0.msg", "r_image_rect_raw_1.msg"}
    message = ROS2.deserialize_cdr(kept["r_image_rect_raw_1.msg"], "sensor_msgs/msg/Image")
    assert message.header.stamp.sec == 1 and message.header.stamp.nanosec == 0
