"""Write clouds as ROS 2 messages in MCAP: ``sensor_msgs/PointCloud2`` and their frames, with rosbags.

Units are metres (REP 103). The root of the frames is ``part``. A view's frame ends in ``_optical``: x right, y down, z
forward (REP 103, "suffix frames"), which is mitsim's sensor frame. ``/tf_static`` is written once, at the start. Its
channel has the durability "transient local", so ``ros2 bag play`` also delivers it to late subscribers. Views are one
second apart, starting one second after the epoch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.atomic_io import atomic_write_named
from mitsim.report.export.cloud_points import FIELDS, CloudPoints
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import quaternion
from mitsim.sensor.transforms import Transform

ROOT = "part"
_SECOND = 1_000_000_000
_POINT_FIELD = {"<f4": 7, "<u2": 4, "<i2": 3}  # sensor_msgs/PointField: FLOAT32, UINT16, INT16


@dataclass(frozen=True)
class Stamped:
    """A cloud in the frame of its view: ``topic``, the ``frame``'s name, and its pose in the part frame if known."""

    topic: str
    frame: str
    points: CloudPoints
    pose: Transform | None


def write_mcap(clouds: Sequence[Stamped], path: str | Path) -> None:
    """Write clouds in the frames of their sensors as messages, and all known frames as ``/tf_static``."""
    rosbag2, typesys, interfaces = (
        needed(f"rosbags.{module}", "rosbags", f"{path}: ROS 2 in MCAP")
        for module in ("rosbag2", "typesys", "interfaces")
    )
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with atomic_write_named(path) as file:
        bag = file.with_suffix(".bag")
        with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:

            def write(topic: str, message: Any, second: int, *quality: Any) -> None:
                kind = message.__msgtype__
                channel = writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=quality)
                writer.write(channel, second * _SECOND, store.serialize_cdr(message, kind))

            poses = {cloud.frame: cloud.pose for cloud in clouds if cloud.pose is not None}
            if poses:
                transforms = [_transform(store, name, pose) for name, pose in poses.items()]
                write("/tf_static", _message(store, "tf2_msgs/msg/TFMessage", transforms), 1, _latched(interfaces))
            for second, cloud in enumerate(clouds, 1):
                write(cloud.topic, _cloud_message(store, cloud.points.in_metres(), cloud.frame, second), second)
        (bag / f"{bag.name}.mcap").replace(file)


def _cloud_message(store: Any, points: CloudPoints, frame: str, second: int) -> Any:
    """Return ``sensor_msgs/PointCloud2`` of points in metres: unordered, dense."""
    table = points.table()
    dtype = table.dtype
    fields = [
        _message(store, "sensor_msgs/msg/PointField", name, dtype.fields[name][1], _POINT_FIELD[kind], 1)  # type: ignore[index]
        for name, kind in FIELDS.items()
    ]
    return _message(
        store,
        "sensor_msgs/msg/PointCloud2",
        _header(store, frame, second),
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(table),
        data=table.view(np.uint8).ravel(),
        is_dense=bool(np.isfinite(points.points).all()),
    )


def _transform(store: Any, frame: str, pose: Transform) -> Any:
    shift = _message(store, "geometry_msgs/msg/Vector3", *(pose.translation / 1000).tolist())
    turn = _message(store, "geometry_msgs/msg/Quaternion", *quaternion(pose))
    moved = _message(store, "geometry_msgs/msg/Transform", shift, turn)
    return _message(store, "geometry_msgs/msg/TransformStamped", _header(store, ROOT, 1), frame, moved)


def _header(store: Any, frame: str, second: int) -> Any:
    return _message(store, "std_msgs/msg/Header", _message(store, "builtin_interfaces/msg/Time", second, 0), frame)


def _message(store: Any, kind: str, *values: Any, **named: Any) -> Any:
    return store.types[kind](*values, **named)


def _latched(interfaces: Any) -> Any:
    """Return the quality of service of ``/tf_static``: transient local, reliable, keep the last."""
    forever, last = interfaces.QosTime(9223372036, 854775807), (interfaces.QosHistory.KEEP_LAST, 1)
    kept = interfaces.QosReliability.RELIABLE, interfaces.QosDurability.TRANSIENT_LOCAL
    return interfaces.Qos(*last, *kept, forever, forever, interfaces.QosLiveliness.AUTOMATIC, forever, False)
