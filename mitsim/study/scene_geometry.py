"""Store the geometry for a picture of a part with its sensor: faces by shape, and the sensor's eyes.

Signal chain: scene and sensor -> ``stand.npz``: triangles of every shape, centres of the eyes and the rays through the
corners of their images -> read again for the picture (:mod:`mitsim.report.placement_figure`).
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.atomic_io import atomic_write
from characterisation.files.checked_files import LARGEST_FILE, read_bounded
from characterisation.files.errors import InputError, in_one_line
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.triangles import triangles_by_shape
from mitsim.sensor.rig_parameters import eyes as eyes_of
from mitsim.sensor.sensor import Sensor

#: name of the file in a run's folder
GEOMETRY_FILE = "stand.npz"


@dataclass(frozen=True)
class SceneGeometry:
    """A part and the eyes of a sensor.

    ``corners`` (n, 3, 3) of triangles [mm], part frame; ``shape`` (n,) index into ``names``. For every eye, the
    reference camera first: ``centres`` (k, 3) [mm] and ``rays`` (k, 4, 3), unit vectors through the corners of its
    image in cyclic order, both in the sensor frame. ``reach`` holds the nearest and farthest working distance [mm].
    ``camera`` is the name of the reference camera, empty if the file is old.
    """

    corners: Floats
    shape: NDArray[np.int64]
    names: tuple[str, ...]
    centres: Floats
    rays: Floats
    reach: tuple[float, float]
    camera: str = ""


def write_scene_geometry(folder: Path, scene: Scene, sensor: Sensor) -> None:
    """Write ``stand.npz`` atomically into a folder."""
    parts = triangles_by_shape(scene)
    eyes = list(eyes_of(sensor.rig).values())
    rays = []
    for eye in eyes:
        right, bottom = eye.width - 0.5, eye.height - 0.5
        around = eye.rays_to_fold(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
        directions = eye.sensor_from_camera.directions(around)
        rays.append(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    out = io.BytesIO()
    np.savez_compressed(
        out,
        corners=np.concatenate([np.empty((0, 3, 3)), *parts.values()]).astype(np.float32),
        shape=np.repeat(np.arange(len(parts)), [len(part) for part in parts.values()]),
        names=np.array(list(parts), "U"),
        centres=np.array([eye.centre for eye in eyes]),
        rays=np.array(rays),
        reach=np.array(sensor.working_range_mm, float),
        camera=np.array(next(iter(sensor.rig.cameras)), "U"),
    )
    with atomic_write(folder / GEOMETRY_FILE) as file:
        file.write_bytes(out.getvalue())


def read_scene_geometry(folder: Path) -> SceneGeometry | None:
    """Read ``stand.npz`` of a folder; return None if there is none. Raises InputError if the file cannot be read."""
    path = folder / GEOMETRY_FILE
    if not path.exists():
        return None
    packed = read_bounded(path)
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as entries:
            unpacked = sum(entry.file_size for entry in entries.infolist())
        if unpacked > LARGEST_FILE:
            raise InputError(path, "size", f"{unpacked:,} bytes unpacked", f"up to {LARGEST_FILE:,}")
        with np.load(io.BytesIO(packed), allow_pickle=False) as data:
            near, far = map(float, data["reach"])
            return SceneGeometry(
                data["corners"].astype(float).reshape(-1, 3, 3),
                data["shape"].astype(np.int64),
                tuple(map(str, data["names"])),
                data["centres"].astype(float).reshape(-1, 3),
                data["rays"].astype(float).reshape(-1, 4, 3),
                (near, far),
                str(data["camera"]) if "camera" in data else "",
            )
    except InputError:
        raise
    except Exception as error:  # zip, zlib and NumPy raise many types of errors for damaged files
        reason = in_one_line(error)
        raise InputError(path, "", f"a file that cannot be read ({reason})", "as mitsim run writes it") from None
