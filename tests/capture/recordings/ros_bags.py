"""Bags of ROS, written by rosbags."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from mitsim.sensor.png import encode_png

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
SIZE, F, C = (64, 48), (60.0, 61.0), (31.3, 22.8)


def typed(store, name, /, **fields):
    return store.types[name](**fields)


def header(store, second=1.0, frame="camera_optical"):
    stamp = typed(store, "builtin_interfaces/msg/Time", sec=int(second), nanosec=int(second % 1 * 1e9))
    own = {"seq": 0} if store is ROS1 else {}
    return typed(store, "std_msgs/msg/Header", stamp=stamp, frame_id=frame, **own)


def depth_mm() -> np.ndarray:
    """Depth (48, 64) [mm] of a wavy surface; 0 where it is missing."""
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    depth = np.round(700 + 30 * np.sin(columns / 9) + 20 * np.cos(rows / 7)).astype(np.uint16)
    depth[10:14, 20:30] = 0
    return depth


def image(store, values: np.ndarray, encoding: str, second=1.0, padding=0, big=False):
    rows = np.ascontiguousarray(values.astype(values.dtype.newbyteorder(">") if big else values.dtype))
    data = rows.view(np.uint8).reshape(len(values), -1)
    data = np.pad(data, ((0, 0), (0, padding)))
    return typed(
        store,
        "sensor_msgs/msg/Image",
        header=header(store, second),
        height=values.shape[0],
        width=values.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=data.shape[1],
        data=data.ravel(),
    )


def packed(store, values: np.ndarray, form: str, prefix: bytes = b""):
    data = np.frombuffer(prefix + encode_png(values), np.uint8)
    return typed(store, "sensor_msgs/msg/CompressedImage", header=header(store), format=form, data=data)


def quantised(depth_m: np.ndarray) -> tuple[bytes, np.ndarray]:
    """Header and 16-bit levels of ``32FC1; compressedDepth``: levels = a / depth + b."""
    a, b = 3000.0, 5.0
    levels = np.where(depth_m > 0, np.round(a / np.maximum(depth_m, 1e-6) + b), 0).astype(np.uint16)
    return struct.pack("<iff", 0, a, b), levels


def info(store, k=None, p=None, d=(), roi=(0, 0, 0, 0), model="plumb_bob", size=SIZE):
    K = np.array([F[0], 0, C[0], 0, F[1], C[1], 0, 0, 1.0] if k is None else k)
    P = np.column_stack([K.reshape(3, 3), np.zeros(3)]).ravel() if p is None else np.array(p, float)
    letters = {"d": np.array(d, float), "k": K, "r": np.eye(3).ravel(), "p": P}
    letters = {name.upper() if store is ROS1 else name: value for name, value in letters.items()}
    region = typed(
        store, "sensor_msgs/msg/RegionOfInterest",
        x_offset=roi[0], y_offset=roi[1], width=roi[2], height=roi[3], do_rectify=False,
    )  # fmt: skip
    return typed(
        store,
        "sensor_msgs/msg/CameraInfo",
        header=header(store),
        width=size[0],
        height=size[1],
        distortion_model=model,
        binning_x=0,
        binning_y=0,
        roi=region,
        **letters,
    )


def cloud(store, points_m: np.ndarray, kind="f4", big=False, padding=0):
    """``PointCloud2`` of points (H, W, 3) [m], with a colour between the coordinates and bytes after each row."""
    order = ">" if big else "<"
    dtype = np.dtype([("x", order + kind), ("rgb", order + "u4"), ("y", order + kind), ("z", order + kind)])
    table = np.zeros(points_m.shape[:2], dtype)
    for axis, values in zip("xyz", np.moveaxis(points_m, -1, 0), strict=True):
        table[axis] = values
    numbers = {"f4": 7, "f8": 8, "u4": 6}
    fields = [
        typed(
            store, "sensor_msgs/msg/PointField",
            name=name, offset=dtype.fields[name][1], datatype=numbers[dtype[name].str[1:]], count=1,
        )
        for name in dtype.names
    ]  # fmt: skip
    rows = np.pad(table.view(np.uint8).reshape(len(table), -1), ((0, 0), (0, padding)))
    return typed(
        store,
        "sensor_msgs/msg/PointCloud2",
        header=header(store),
        height=table.shape[0],
        width=table.shape[1],
        fields=fields,
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=rows.shape[1],
        data=rows.ravel(),
        is_dense=False,
    )


def points_m() -> np.ndarray:
    """Points (48, 64, 3) [m] of :func:`depth_mm`, NaN where it is missing."""
    depth = np.where(depth_mm() > 0, depth_mm() / 1000, np.nan).astype(np.float32)
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.stack([(columns - C[0]) / F[0] * depth, (rows - C[1]) / F[1] * depth, depth], axis=-1)


def write_bag(path: Path, messages, form: str = "bag", compression=None) -> Path:
    """Write (topic, message) pairs, made with the store of ``form``: ``bag``, ``db3`` or ``mcap``."""
    store = ROS1 if form == "bag" else ROS2
    if form == "bag":
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression])
    else:
        plugin = StoragePlugin.SQLITE3 if form == "db3" else StoragePlugin.MCAP
        writer = Writer2(path, version=8, storage_plugin=plugin)
        if compression:
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        open_topics = {}
        for number, (topic, message) in enumerate(messages):
            kind = message.__msgtype__
            if topic not in open_topics:
                open_topics[topic] = writer.add_connection(topic, kind, typestore=store)
            write = store.serialize_ros1 if form == "bag" else store.serialize_cdr
            writer.write(open_topics[topic], 10**9 + number, bytes(write(message, kind)))
    return path if form == "bag" else next(path.glob(f"*.{form}"), path)


def depth_messages(store, topic="/camera/depth", frames=1):
    """Depth images of one camera and its ``camera_info``."""
    out = [(f"{topic}/camera_info", info(store))]
    return out + [(f"{topic}/image_rect_raw", image(store, depth_mm(), "16UC1", 1 + k / 30)) for k in range(frames)]
