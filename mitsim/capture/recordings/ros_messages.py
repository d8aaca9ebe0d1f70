"""Read messages of ROS: depth and grey images, organised clouds, and the calibration of a camera.

Signal chain: bytes of a message -> fields, by rosbags, after ROS's own definition of the type -> arrays.

Definitions in a bag are not used, since rosbags makes program code of them; ROS 2 has not changed those below, and a
ROS 1 bag states the digest of its own. Depths have ROS's units (REP 118): ``16UC1`` in mm, ``32FC1`` in m. Compressed
depths are those of ``compressed_depth_image_transport``: a header of 12 bytes, then a PNG.
"""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from characterisation.files.errors import InputError, in_one_line
from mitsim.capture.grey_image import decode_grey
from mitsim.capture.recordings.ros_bag import RosBag, Topic
from mitsim.sensor.png import LONGEST_SIDE_PX

#: type of the messages that hold an image without compression
IMAGE = "sensor_msgs/msg/Image"

#: type of the messages that hold a PNG or JPEG image
PACKED_IMAGE = "sensor_msgs/msg/CompressedImage"
#: type of the messages that hold a point cloud
CLOUD = "sensor_msgs/msg/PointCloud2"

#: type of the messages that hold the calibration of a camera
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

#: type of the messages in which RealSense's viewer states the unit of depths
FLOAT = "std_msgs/msg/Float32"

#: encodings of depths (librealsense writes ``mono16``), and their unit [mm]
DEPTHS = {"16UC1": 1.0, "mono16": 1.0, "32FC1": 1000.0}

#: NumPy types of the encodings that are read, and their channels; a colour image gives one of its channels
_PIXELS = {
    "16UC1": ("u2", 1), "mono16": ("u2", 1), "32FC1": ("f4", 1), "8UC1": ("u1", 1), "mono8": ("u1", 1),
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "8UC3": ("u1", 3),
}  # fmt: skip

#: NumPy types of sensor_msgs/PointField
_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}

#: header of a compressed depth: a number that says nothing, and two parameters of quantised inverse depths
_PACKED_HEADER = struct.Struct("<iff")


def read_message(bag: RosBag, topic: Topic, number: int) -> Any:
    """Return a message of a topic by its number, from 0."""
    data = bag.message(topic.name, number)
    where = f"{bag.path} {topic.name}"
    try:
        store = _definitions(topic.ros1)
        if topic.ros1 and topic.digest not in ("", "*", store.generate_msgdef(topic.kind)[1]):
            raise ValueError(f"a definition of {topic.kind} that is not ROS's")
        return (store.deserialize_ros1 if topic.ros1 else store.deserialize_cdr)(data, topic.kind)
    except Exception as error:  # rosbags may raise anything for a damaged message
        text = in_one_line(error, 160)
        raise InputError(where, f"message {number}", f"not readable ({text})", topic.kind) from None


@cache
def _definitions(ros1: bool) -> Any:
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


def encoding_of(message: Any) -> str:
    """Return the encoding of an image: of a compressed one, that of its pixels before compression if it states it."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    return str(message.format).partition(";")[0].strip()


def depth_of(message: Any, where: str) -> tuple[NDArray[Any], float]:
    """Return the numbers (H, W) of a depth image, uint16 or float32, and their unit [mm] by its encoding."""
    encoding = encoding_of(message)
    if encoding not in DEPTHS:
        raise InputError(where, "encoding", repr(encoding), " | ".join(DEPTHS))
    if hasattr(message, "encoding"):
        return _pixels(message, where)[..., 0], DEPTHS[encoding]
    data, kind = bytes(message.data), str(message.format)
    if "jpeg" in kind or "rvl" in kind.lower():
        hint = "record the topic without compression, or with compressedDepth as PNG"
        raise InputError(where, "format", repr(kind), "a depth image compressed as PNG", hint)
    if "compressedDepth" not in kind:
        return decode_grey(data, where), DEPTHS[encoding]
    if len(data) <= _PACKED_HEADER.size:
        raise InputError(where, "data", f"{len(data)} bytes", "a header of 12 bytes and a PNG")
    _, scale, offset = _PACKED_HEADER.unpack_from(data)
    levels = decode_grey(data[_PACKED_HEADER.size :], where)
    if encoding != "32FC1":
        return levels, DEPTHS[encoding]
    with np.errstate(all="ignore"):
        inverse = np.where(levels > 0, scale / (levels.astype(np.float32) - np.float32(offset)), np.nan)
    return inverse.astype(np.float32), DEPTHS[encoding]


def grey_of(message: Any, where: str, channel: int) -> NDArray[np.unsignedinteger[Any]]:
    """Return the grey image (H, W), or one ``channel`` (in OpenCV's order) of a colour image, uint8 or uint16."""
    if not hasattr(message, "encoding"):
        return decode_grey(bytes(message.data), where, channel=channel)
    pixels = _pixels(message, where)
    if pixels.dtype.kind != "u":
        raise InputError(where, "encoding", repr(message.encoding), "a grey or colour image of 8 or 16 bits")
    if pixels.shape[2] == 1:
        return pixels[..., 0]
    reverse = str(message.encoding).startswith("rgb")
    return np.ascontiguousarray(pixels[..., 2 - channel if reverse else channel])


def _pixels(message: Any, where: str) -> NDArray[Any]:
    """Return the pixels (H, W, channels) of an image, whose rows are ``step`` bytes apart."""
    if message.encoding not in _PIXELS:
        raise InputError(where, "encoding", repr(str(message.encoding)[:40]), " | ".join(_PIXELS))
    kind, channels = _PIXELS[message.encoding]
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    shape, row = (int(message.height), int(message.width)), int(message.width) * channels * dtype.itemsize
    _check_sides(shape, where)
    step, data = int(message.step) or row, np.asarray(message.data, np.uint8)
    if step < row or data.size < step * (shape[0] - 1) + row:
        found = f"{data.size} bytes in rows of {step}"
        raise InputError(where, "data", found, f"{shape[1]} x {shape[0]} px of {row // shape[1]} bytes")
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    pixels = np.ndarray((*shape, channels), dtype, np.ascontiguousarray(data), strides=strides)
    return pixels.astype(dtype.newbyteorder("="))


def points_of(message: Any, where: str) -> NDArray[np.float32]:
    """Return the points (H, W, 3) of a cloud as in the message; a cloud without a grid has one row."""
    fields = {str(field.name): (int(field.offset), _FIELDS.get(int(field.datatype), "")) for field in message.fields}
    if not all(fields.get(axis, (0, ""))[1] in ("f4", "f8") for axis in "xyz"):
        raise InputError(where, "fields", ", ".join(fields)[:80] or "none", "x, y and z of floating point")
    shape, step, row = (int(message.height), int(message.width)), int(message.point_step), int(message.row_step)
    count = shape[0] * shape[1]
    if min(shape) > 1:
        _check_sides(shape, where)
    data = np.ascontiguousarray(np.asarray(message.data, np.uint8))
    row = row or step * shape[1]
    ends = max(fields[axis][0] + np.dtype(fields[axis][1]).itemsize for axis in "xyz")
    whole = count > 0 and ends <= step and row >= step * shape[1]
    if not whole or data.size < row * (shape[0] - 1) + step * (shape[1] - 1) + ends:
        found = f"{data.size} bytes, {step} for each point"
        raise InputError(where, "data", found, f"{shape[1]} x {shape[0]} points")
    order = ">" if message.is_bigendian else "<"
    out = np.empty((*shape, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for number, axis in enumerate("xyz"):
            offset, kind = fields[axis]
            out[..., number] = np.ndarray(shape, order + kind, data, offset, (row, step))
    return out


def calibration_of(message: Any, rectified: bool) -> dict[str, Any]:
    """Return the fields of a ``camera_info`` by ROS 2's names, as plain values.

    Of ``rectified`` images, the camera is that of the projection matrix, without distortion, if the message has one.
    """
    numbers = ("width", "height", "binning_x", "binning_y")
    table: dict[str, Any] = {name: int(getattr(message, name)) for name in numbers}
    table["distortion_model"] = str(message.distortion_model).lower().replace(" ", "_")
    for letter in "dkrp":
        values = getattr(message, letter, getattr(message, letter.upper(), ()))
        table[letter] = [float(value) for value in np.asarray(values).ravel()]
    sides = ("x_offset", "y_offset", "width", "height")
    table["roi"] = {name: int(getattr(message.roi, name)) for name in sides}
    P = np.array(table["p"]).reshape(3, 4) if len(table["p"]) == 12 else np.zeros((3, 4))
    if rectified and P[0, 0] > 0 and P[1, 1] > 0:
        table |= {"k": P[:, :3].ravel().tolist(), "d": [], "r": np.eye(3).ravel().tolist()}
    return table


def _check_sides(shape: tuple[int, int], where: str) -> None:
    if not all(1 <= side <= LONGEST_SIDE_PX for side in shape):
        raise InputError(where, "size", f"{shape[1]} x {shape[0]} px", f"sides of 1 to {LONGEST_SIDE_PX} px")


def unit_of_depths(bag: RosBag, depth: Topic) -> float | None:
    """Return the unit of depths [mm] that RealSense's viewer recorded for a depth sensor; None without one."""
    sensor = "/".join(depth.name.split("/")[:3])
    topic = bag.topics.get(f"{sensor}/option/Depth_Units/value")
    if topic is None or topic.kind != FLOAT or topic.count < 1:
        return None
    unit = float(read_message(bag, topic, 0).data) * 1000
    if not 1e-4 <= unit <= 1e3:
        raise InputError(f"{bag.path} {topic.name}", "", f"{unit / 1000:g} m", "a unit of depth from 1e-7 to 1 m")
    return unit


def label_of(topic: Topic, path: Path) -> str:
    """Return the name of a topic in messages."""
    return f"{path} {topic.name}"
