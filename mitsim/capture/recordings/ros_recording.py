"""Read a depth image, an organised cloud or a stereo pair of a bag of ROS as a capture.

A ``camera_info`` belongs to the images whose topic begins like its own: ``/camera/depth/camera_info`` to
``/camera/depth/image_rect_raw``. Images with the word ``rect`` in their topic are rectified: their camera is the
projection matrix.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.errors import InputError, nearest
from mitsim.capture.capture import Capture
from mitsim.capture.grey_image import channel_of
from mitsim.capture.recordings.calibration_file import Calibrated, calibrated_by, read_calibration
from mitsim.capture.recordings.cloud_numbers import leave_out_marks
from mitsim.capture.recordings.depth_image import depth_capture, missing_depths
from mitsim.capture.recordings.organised_cloud import StoredCloud
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recording_files import chosen_frame
from mitsim.capture.recordings.ros_bag import RosBag, Topic
from mitsim.capture.recordings.ros_messages import (
    CAMERA_INFO,
    CLOUD,
    DEPTHS,
    IMAGE,
    PACKED_IMAGE,
    calibration_of,
    depth_of,
    encoding_of,
    grey_of,
    label_of,
    points_of,
    read_message,
    unit_of_depths,
)
from mitsim.capture.recordings.stereo_pair import names_of_pair, pair_capture


@dataclass(frozen=True)
class Chosen:
    """The topics of a ``bag`` that are read, and their ``content``: ``depth``, ``cloud`` or ``pair``."""

    bag: RosBag
    topics: tuple[Topic, ...]
    content: str


def chosen_topics(bag: RosBag, names: Sequence[str]) -> Chosen:
    """Return the topics of these names; without names, the only depth image or cloud; errors list the topics."""
    contents = {topic.name: content for topic in bag.topics.values() if (content := _content(bag, topic))}
    usable = {name: content for name, content in contents.items() if content != "image"}
    for name in names:
        if name not in bag.topics:
            hint = nearest(name, list(bag.topics))
            raise InputError("--topic", "", repr(name), _listed(bag, contents) or "a topic of the bag", hint)
        if name not in contents:
            kind = f"{bag.topics[name].kind}, {bag.topics[name].count} messages"
            raise InputError("--topic", "", f"{name}, {kind}", _listed(bag, contents) or "images or clouds")
    if len(names) == 2 and {contents[name] for name in names} == {"image"}:
        return Chosen(bag, (bag.topics[names[0]], bag.topics[names[1]]), "pair")
    if len(names) == 1 and names[0] in usable:
        return Chosen(bag, (bag.topics[names[0]],), usable[names[0]])
    if names:
        allowed = "one topic of depths or of a cloud, or the left and the right images of a pair"
        raise InputError("--topic", "", " and ".join(names), allowed, _listed(bag, contents))
    if len(usable) == 1:
        name, content = next(iter(usable.items()))
        return Chosen(bag, (bag.topics[name],), content)
    if usable:
        hint = f"choose with --topic: {_listed(bag, contents)}"
        raise InputError(bag.path, "--topic", f"{len(usable)} topics with depths or clouds", "one of them", hint)
    if len(contents) >= 2:
        hint = f"choose a pair with --topic LEFT --topic RIGHT: {_listed(bag, contents)}"
        raise InputError(bag.path, "--topic", "images without depth", "depths, a cloud, or a pair", hint)
    there = ", ".join(_described(bag, topic) for topic in list(bag.topics.values())[:6]) or "nothing"
    raise InputError(bag.path, "", f"a bag with {there}", "depth images, organised clouds, or a pair of images")


def _content(bag: RosBag, topic: Topic) -> str:
    """Return the content of a topic: ``depth``, ``image`` or ``cloud``; empty for others."""
    if topic.count < 1:
        return ""
    if topic.kind == CLOUD:
        return "cloud"
    if topic.kind in (IMAGE, PACKED_IMAGE):
        encoding, name = encoding_of(read_message(bag, topic, 0)), topic.name.lower()
        other = any(word in name for word in _NO_DEPTHS) or encoding == "mono16"  # which librealsense writes for both
        return "depth" if encoding in DEPTHS and ("depth" in name or not other) else "image"
    return ""


#: words in topics of other images with the encodings of depths
_NO_DEPTHS = ("infra", "/ir", "thermal", "snr", "confidence", "intensity", "amplitude", "disparity")


def _described(bag: RosBag, topic: Topic) -> str:
    """Return a topic, its kind, and the encoding of its images."""
    is_image = topic.kind in (IMAGE, PACKED_IMAGE) and topic.count > 0
    encoding = f", {encoding_of(read_message(bag, topic, 0))}" if is_image else ""
    return f"{topic.name} ({topic.kind}{encoding})"


def _listed(bag: RosBag, contents: dict[str, str]) -> str:
    counts = {name: bag.topics[name].count for name in contents}
    return ", ".join(f"{name} ({content}, {counts[name]})" for name, content in list(contents.items())[:12])


def read_ros_cloud(chosen: Chosen, frame: int | None) -> StoredCloud:
    """Return the points of one message of a cloud, as they are in it.

    A ``camera_info`` in the namespace of its topic is its camera if it sees the points on their pixels.
    """
    bag, topic = chosen.bag, chosen.topics[0]
    number = chosen_frame(frame, topic.count, bag.path, f"messages of {topic.name}")
    message = read_message(bag, topic, number)
    points = np.array(points_of(message, label_of(topic, bag.path)))
    note = leave_out_marks(points)
    height, width = points.shape[:2]
    records = {"topic": topic.name} | _stamp(message)
    if min(height, width) < 2:
        return StoredCloud(bag.path, points, None, records, note=note)
    camera = None
    with suppress(InputError):  # then the camera is fitted to the points
        camera = replace(_calibrated(chosen, (width, height), None), nominal=True)
    return StoredCloud(bag.path, points, (width, height), records, camera, note=note)


def read_ros_depth(chosen: Chosen, frame: int | None, options: ReadOptions) -> Capture:
    """Read one depth image of a bag.

    ``frame`` is the number of the message, from 0; required if there are several. By default the camera is the
    ``camera_info`` of the topic, and the depth of one level that of the encoding, or that which RealSense's viewer
    recorded.
    """
    bag, topic = chosen.bag, chosen.topics[0]
    where = label_of(topic, bag.path)
    number = chosen_frame(frame, topic.count, bag.path, f"messages of {topic.name}")
    message = read_message(bag, topic, number)
    levels, unit = depth_of(message, where)
    if levels.dtype == np.uint8:
        raise InputError(where, "depth", "8 bits", "16 bits or floating point")
    recorded = unit_of_depths(bag, topic) if levels.dtype == np.uint16 else None
    scale = options.scale_mm or recorded or unit
    missing, warnings = missing_depths(levels, options.invalid or 0)
    with np.errstate(over="ignore"):
        depth = levels.astype(np.float32) * np.float32(scale)
    depth[missing] = np.nan
    calibrated = _calibrated(chosen, (depth.shape[1], depth.shape[0]), options.cameras)
    settings: dict[str, Any] = {"imported_from": bag.path.name, "topic": topic.name, "depth_scale_mm": float(scale)}
    settings |= _stamp(message) | ({"warnings": warnings} if warnings else {})
    return depth_capture(depth, calibrated, Path(where), settings, options)


def read_ros_pair(chosen: Chosen, frame: int | None, options: ReadOptions) -> tuple[Capture, tuple[int, int]]:
    """Read one stereo pair of a bag: the left image by its number, and the right image that is nearest in time.

    Returned with the numbers of both messages. ``frame`` is that of the left one, from 0; required if there are
    several. By default the cameras are the ``camera_info`` of both topics.
    """
    bag, (left, right) = chosen.bag, chosen.topics
    number = chosen_frame(frame, left.count, bag.path, f"messages of {left.name}")
    first = read_message(bag, left, number)
    second, other = _of_same_time(bag, right, first, number)
    places = [label_of(topic, bag.path) for topic in chosen.topics]
    channel = channel_of(options.channel)
    images = [grey_of(message, place, channel) for message, place in zip((first, second), places, strict=True)]
    size = (images[0].shape[1], images[0].shape[0])
    calibrated = _calibrated(chosen, size, options.cameras)
    names = names_of_pair(calibrated, options.cameras or bag.path)
    settings: dict[str, Any] = {"imported_from": bag.path.name, "topic": [left.name, right.name]} | _stamp(first)
    levels, labels = dict(zip(names, images, strict=True)), dict(zip(names, places, strict=True))
    return pair_capture(levels, labels, calibrated, settings, options.named), (number, other)


def _of_same_time(bag: RosBag, topic: Topic, first: Any, number: int) -> tuple[Any, int]:
    """Return the message of a topic whose stamp is that of another one, searched near its number; with its number."""
    near = [index for index in range(number - 2, number + 3) if 0 <= index < topic.count]
    messages = [read_message(bag, topic, index) for index in near]
    apart = [abs(_seconds(message) - _seconds(first)) for message in messages]
    if not apart or min(apart) > _SAME_TIME_S:
        nearest_one = f"{min(apart):.3g} s from the left image" if apart else "no message"
        where = label_of(topic, bag.path)
        raise InputError(where, "stamp", nearest_one, f"an image within {_SAME_TIME_S:g} s", "choose another --frame")
    best = int(np.argmin(apart))
    return messages[best], near[best]


#: largest difference in time of the two images of a pair; assumed: under a quarter of a frame at 60 Hz
_SAME_TIME_S = 0.004

#: names of topics of rectified images; a transport may follow
_RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:_[^/]*)?(?:/compressed(?:Depth)?)?$")


def _calibrated(chosen: Chosen, size: tuple[int, int], calibration: str | Path | None) -> Calibrated:
    if calibration is not None:
        return read_calibration(calibration, size)
    bag, tables = chosen.bag, {}
    for topic in chosen.topics:
        info = _info_of(bag, topic)
        rectified = _RECTIFIED.search(topic.name) is not None
        tables[info.name] = calibration_of(read_message(bag, info, 0), rectified)
    if len(tables) < len(chosen.topics):
        names = " and ".join(topic.name for topic in chosen.topics)
        found, allowed = f"one camera_info for {names}", "one for each: --calibration FILE"
        raise InputError(bag.path, ", ".join(tables), found, allowed)
    if len(tables) == 2 and not any(table["p"][3:4] not in ([], [0.0]) for table in tables.values()):
        hint = "--calibration FILE with both cameras, R and T"
        raise InputError(bag.path, ", ".join(tables), "projection matrices without a baseline", "a pair of ROS", hint)
    return calibrated_by(tables, bag.path, size)


def _info_of(bag: RosBag, topic: Topic) -> Topic:
    """Return the ``camera_info`` in the namespace of a topic; the longest one if there are several.

    RealSense's viewer names it ``NAMESPACE/info/camera_info``, others ``NAMESPACE/camera_info``.
    """
    spaces = {}
    for info in bag.topics.values():
        if info.kind == CAMERA_INFO and info.count:
            space = info.name.removesuffix("/camera_info").removesuffix("/info")
            if f"{topic.name}/".startswith(f"{space}/"):
                spaces[space] = info
    if not spaces:
        there = ", ".join(info.name for info in bag.topics.values() if info.kind == CAMERA_INFO)[:200]
        allowed = "a camera_info of this topic"
        raise InputError(bag.path, topic.name, there or "no camera_info", allowed, "or --calibration FILE")
    return spaces[max(spaces, key=len)]


def _seconds(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def _stamp(message: Any) -> dict[str, Any]:
    return {"stamp_s": round(_seconds(message), 6), "frame_id": str(message.header.frame_id)[:200]}
