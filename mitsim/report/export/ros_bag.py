"""Write clouds as ROS 2 messages in MCAP: ``sensor_msgs/PointCloud2`` and their frames, with mcap-ros2-support.

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

_SEPARATOR = "=" * 80
_TIME = f"{_SEPARATOR}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"{_SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_VECTOR = f"{_SEPARATOR}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_QUATERNION = f"{_SEPARATOR}\nMSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"

#: message definitions of ROS 2 common_interfaces and geometry2, without their comments
_CLOUD = f"""std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
{_SEPARATOR}
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
{_HEADER}{_TIME}"""

_FRAMES = f"""geometry_msgs/TransformStamped[] transforms
{_SEPARATOR}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_SEPARATOR}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{_VECTOR}{_QUATERNION}{_HEADER}{_TIME}"""

#: quality of service in rosbag2's form (rosbag2_transport/qos): transient local, reliable, keep the last
_LATCHED = """- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""


@dataclass(frozen=True)
class Stamped:
    """A cloud in the frame of its view: ``topic``, the ``frame``'s name, and its pose in the part frame if known."""

    topic: str
    frame: str
    points: CloudPoints
    pose: Transform | None


def write_mcap(clouds: Sequence[Stamped], path: str | Path) -> None:
    """Write clouds in the frames of their sensors as messages, and all known frames as ``/tf_static``."""
    ros2 = needed("mcap_ros2.writer", "mcap-ros2-support", f"{path}: ROS 2 in MCAP")
    with atomic_write_named(path) as file, ros2.Writer(str(file)) as bag:
        frames = bag.register_msgdef("tf2_msgs/msg/TFMessage", _FRAMES)
        kind = bag.register_msgdef("sensor_msgs/msg/PointCloud2", _CLOUD)
        known = {one.frame: one.pose for one in clouds if one.pose is not None}
        if known:
            _latch(bag, "/tf_static", frames)
            transforms = [_transform(name, pose) for name, pose in known.items()]
            bag.write_message("/tf_static", frames, {"transforms": transforms}, _SECOND, _SECOND)
        for k, one in enumerate(clouds):
            when = (k + 1) * _SECOND
            bag.write_message(one.topic, kind, cloud_message(one.points.in_metres(), one.frame, k + 1), when, when, k)


def cloud_message(points: CloudPoints, frame: str, second: int) -> dict[str, Any]:
    """Return ``sensor_msgs/PointCloud2`` of points in metres, as a dictionary: unordered, dense."""
    table = points.table()
    dtype = table.dtype
    fields = [
        {"name": name, "offset": dtype.fields[name][1], "datatype": _POINT_FIELD[kind], "count": 1}  # type: ignore[index]
        for name, kind in FIELDS.items()
    ]
    return {
        "header": _header(frame, second),
        "height": 1,
        "width": len(table),
        "fields": fields,
        "is_bigendian": False,
        "point_step": dtype.itemsize,
        "row_step": dtype.itemsize * len(table),
        "data": table.tobytes(),
        "is_dense": bool(np.isfinite(points.points).all()),
    }


def _transform(frame: str, pose: Transform) -> dict[str, Any]:
    return {
        "header": _header(ROOT, 1),
        "child_frame_id": frame,
        "transform": {
            "translation": dict(zip("xyz", (pose.translation / 1000).tolist(), strict=True)),
            "rotation": dict(zip("xyzw", quaternion(pose), strict=True)),
        },
    }


def _header(frame: str, second: int) -> dict[str, Any]:
    return {"stamp": {"sec": second, "nanosec": 0}, "frame_id": frame}


def _latch(bag: Any, topic: str, schema: Any) -> None:
    """Open a channel with a quality of service, which the library's own function does not support."""
    bag._channel_ids[topic] = bag._writer.register_channel(
        topic=topic, message_encoding="cdr", schema_id=schema.id, metadata={"offered_qos_profiles": _LATCHED}
    )
