"""Write clouds with covariances as PLY and PCD.

PLY is written here, because the only library that writes custom properties has no permissive licence. PCD is written by
pypcd4.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from characterisation.files.atomic_io import atomic_write, atomic_write_named
from mitsim.report.export.cloud_points import FIELDS, CloudPoints
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import quaternion
from mitsim.sensor.transforms import Transform

#: integers have 32 bits: Open3D skips properties of 16
_PLY_TYPES = {"<f4": ("float", "<f4"), "<u2": ("int", "<i4"), "<i2": ("int", "<i4")}


def about(points: CloudPoints) -> dict[str, object]:
    """Return the description of a cloud for a file's header."""
    return {
        "sensor": points.sensor,
        "source": points.source,
        "frame": points.frame,
        "unit": points.unit,
        "feature_names": list(points.feature_names),
        "covariance": "sigma^2 r r^T, r the unit view ray; NaN where sigma is unknown",
    }


def write_cloud_ply(points: CloudPoints, path: str | Path) -> None:
    """Write binary little-endian PLY, one vertex for each point, with the properties :data:`FIELDS`."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment units {points.unit}",
        f"comment frame {points.frame}",
        f"comment mitsim {json.dumps(about(points))}",
        f"element vertex {len(points.points)}",
        *(f"property {_PLY_TYPES[kind][0]} {name}" for name, kind in FIELDS.items()),
        "end_header\n",
    ]
    table = points.table().astype([(name, _PLY_TYPES[kind][1]) for name, kind in FIELDS.items()])
    with atomic_write(path) as file:
        file.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def write_cloud_pcd(points: CloudPoints, path: str | Path, part_from_sensor: Transform | None = None) -> None:
    """Write binary PCD 0.7 with the fields :data:`FIELDS`.

    ``VIEWPOINT``, which programs apply to the points, is the pose of the sensor in the part frame if the points are in
    the sensor frame and the pose is known. Otherwise it is the identity.
    """
    pypcd4 = needed("pypcd4", "pypcd4", f"{path}: PCD")
    table = points.table()
    types = [np.dtype(kind).type for kind in FIELDS.values()]
    cloud = pypcd4.PointCloud.from_points([table[name] for name in FIELDS], list(FIELDS), types)
    if part_from_sensor is not None and points.frame == "sensor":
        scale = 0.001 if points.unit == "m" else 1.0
        x, y, z, w = quaternion(part_from_sensor)
        cloud.metadata.viewpoint = (*(scale * part_from_sensor.translation).tolist(), w, x, y, z)
    with atomic_write_named(path) as file:
        cloud.save(file, encoding=pypcd4.Encoding.BINARY)
