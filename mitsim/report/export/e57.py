"""Write clouds as E57 (ASTM E2807) with pye57: one scan for each view, with its pose.

Lengths are in metres, as the standard requires. Points are in the frame of their scan, and ``pose`` takes them to the
frame of the file, the part frame. Standard fields are cartesianX, Y, Z, rowIndex and columnIndex. Sigma, covariance and
feature are fields of an extension with the prefix ``mitsim``, which other readers skip.
"""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.atomic_io import atomic_write_named
from characterisation.words.version import __version__
from mitsim.report.export.cloud_points import COVARIANCE, CloudPoints
from mitsim.report.export.cloud_writers import about
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import quaternion
from mitsim.report.export.xml_text import xml_text
from mitsim.sensor.transforms import Transform

#: prefix of the fields that E57 does not define
PREFIX = "mitsim"

#: XML namespace of these fields: a name, not an address (RFC 2606 reserves .invalid)
NAMESPACE = "https://mitsim.invalid/e57/1.0"


def write_e57(scans: Sequence[tuple[str, CloudPoints, Transform | None]], path: str | Path) -> None:
    """Write scans: for each a name, its points, and the pose of their frame in the part frame, None if unknown."""
    pye57 = needed("pye57", "pye57", f"{path}: E57")
    with atomic_write_named(path) as file:
        image = pye57.E57(str(file), mode="w")
        try:
            image.image_file.extensionsAdd(PREFIX, NAMESPACE)
            for name, points, pose in scans:
                _write_scan(image, pye57.libe57, xml_text(name), points.in_metres(), pose)
            image.close()
        except Exception:
            del image.image_file  # else pye57 closes it again, and prints the traceback of a full disk
            raise


def _write_scan(image: Any, libe57: Any, name: str, points: CloudPoints, pose: Transform | None) -> None:
    file, table = image.image_file, points.table()
    guid = uuid.UUID(hashlib.sha256(name.encode() + table.tobytes()).hexdigest()[:32])
    head: dict[str, Any] = {
        "guid": f"{{{guid}}}",
        "name": name,
        "description": json.dumps(about(points)),
        "sensorModel": points.sensor,
        "sensorSoftwareVersion": f"mitsim {__version__}",
    }
    if pose is not None:
        x, y, z, w = quaternion(pose)
        translation = dict(zip("xyz", (pose.translation / 1000).tolist(), strict=True))
        head["pose"] = {"rotation": {"w": w, "x": x, "y": y, "z": z}, "translation": translation}
    if len(table):
        head["indexBounds"] = _bounds(row=table["row"], column=table["col"]) | {"returnMinimum": 0, "returnMaximum": 0}
        head["cartesianBounds"] = _bounds(**{axis: table[axis] for axis in "xyz"})
    scan = _structure(file, libe57, head)
    single = libe57.E57_SINGLE
    prototype, buffers = libe57.StructureNode(file), libe57.VectorSourceDestBuffer()
    arrays: list[NDArray[Any]] = []  # libe57 keeps only pointers
    columns: dict[str, tuple[NDArray[Any], Any]] = {
        f"cartesian{axis.upper()}": (table[axis], libe57.FloatNode(file, 0.0, single)) for axis in "xyz"
    }
    columns["rowIndex"] = table["row"], libe57.IntegerNode(file, 0, 0, 65535)
    columns["columnIndex"] = table["col"], libe57.IntegerNode(file, 0, 0, 65535)
    for field in ("sigma", *COVARIANCE):
        columns[f"{PREFIX}:{field}"] = table[field], libe57.FloatNode(file, 0.0, single)
    columns[f"{PREFIX}:feature"] = table["feature"], libe57.IntegerNode(file, -1, -32768, 32767)
    for field, (values, node) in columns.items():
        prototype.set(field, node)
        arrays.append(np.ascontiguousarray(values))
        if len(table):
            buffers.append(libe57.SourceDestBuffer(file, field, arrays[-1], len(table), True, True))
    vector = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set("points", vector)
    image.data3d.append(scan)
    if len(table):
        writer = vector.writer(buffers)
        writer.write(len(table))
        writer.close()


def _bounds(**columns: NDArray[Any]) -> dict[str, Any]:
    ends = (("Minimum", np.min), ("Maximum", np.max))
    return {f"{name}{end}": function(values).item() for name, values in columns.items() for end, function in ends}


def _structure(file: Any, libe57: Any, values: dict[str, Any]) -> Any:
    """Return a node of E57 with a child for each text, whole number, number or table."""
    nodes = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
    out = libe57.StructureNode(file)
    for name, value in values.items():
        table = isinstance(value, dict)
        out.set(name, _structure(file, libe57, value) if table else nodes[type(value)](file, value))
    return out
