"""Write part and views as glTF 2.0 (Khronos; ISO/IEC 12113), one binary ``.glb``, with pygltflib.

glTF uses metres with y up. The node ``part_frame`` rotates the part frame, with z up, to it; all nodes below are in the
part frame. Each view is a node with the pose of the sensor frame. It has two children on its image grid:
``..._camera``, a camera that looks along its own -z with y up, and ``..._frustum``, lines. A glTF camera has its
principal point at the centre; the frustum has the sensor's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.atomic_io import atomic_write_named
from characterisation.point_cloud import ViewGrid
from characterisation.words.version import __version__
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import RunScene, frustum, quaternion, sensor_from_grid
from mitsim.sensor.transforms import Transform

#: length of the drawn frusta [mm]
FRUSTUM_MM = 60.0

#: OpenCV's camera axes (y down, z forward) from those of glTF and USD (y up, z backward)
OPENCV_FROM_OPENGL = Transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))

#: numbers by which glTF names types of components, targets of buffers, and modes of primitives (section 5)
_FLOAT = 5126
_UINT32 = 5125
_ARRAY_BUFFER = 34962
_ELEMENT_BUFFER = 34963
_LINES = 1
_TRIANGLES = 4


def write_glb(scene: RunScene, path: str | Path) -> None:
    """Write part and views as one binary glTF file."""
    gltf = needed("pygltflib", "pygltflib", f"{path}: glTF")
    turn = Rotation.from_rotvec([-math.pi / 2, 0, 0]).as_quat()
    root = gltf.Node(name="part_frame", rotation=turn.tolist(), children=[])
    asset = gltf.Asset(version="2.0", generator=f"mitsim {__version__}")
    glb = _Glb(gltf, gltf.GLTF2(asset=asset, nodes=[root], scenes=[gltf.Scene(nodes=[0])], scene=0), bytearray())
    if scene.part is not None:
        colour = [0.7, 0.7, 0.72, 1.0]
        metal = gltf.PbrMetallicRoughness(baseColorFactor=colour, metallicFactor=0.2, roughnessFactor=0.6)
        glb.file.materials.append(gltf.Material(name="part", pbrMetallicRoughness=metal, doubleSided=True))
        vertices, faces = np.asarray(scene.part.vertices), np.asarray(scene.part.faces)
        glb.node(root, "part", mesh=glb.mesh("part", vertices, faces, mode=_TRIANGLES, material=0))
    grid, lines, camera = scene.grid, None, None
    if grid is not None:
        lines = glb.mesh("frustum", *frustum(grid, FRUSTUM_MM), mode=_LINES)
        vertical, aspect = field_of_view(grid)
        optics = gltf.Perspective(yfov=vertical, aspectRatio=aspect, znear=0.01)
        camera = _appended(glb.file.cameras, gltf.Camera(type="perspective", perspective=optics, name=scene.sensor))
    for view in scene.views:
        node = glb.node(root, view.name, view.part_from_sensor)
        node.extras = {"view": view.number, "best_of": list(view.best_of), "sensor": scene.sensor}
        if grid is not None:
            pose = sensor_from_grid(grid)
            glb.node(node, f"{view.name}_frustum", pose, mesh=lines)
            glb.node(node, f"{view.name}_camera", pose @ OPENCV_FROM_OPENGL, camera=camera)
    if glb.blob:
        glb.file.buffers = [gltf.Buffer(byteLength=len(glb.blob))]
        glb.file.set_binary_blob(bytes(glb.blob))
    with atomic_write_named(path) as partial:
        glb.file.save_binary(str(partial))


def field_of_view(grid: ViewGrid) -> tuple[float, float]:
    """Return the vertical field of view [rad] and the aspect ratio of a grid with central principal point."""
    x, y = grid.width / grid.fx, grid.height / grid.fy
    return 2 * math.atan(y / 2), x / y


@dataclass(frozen=True)
class _Glb:
    """A file in the making: the library ``gltf``, its ``file`` object, and the ``blob`` of its numbers."""

    gltf: Any
    file: Any
    blob: bytearray

    def node(self, parent: Any, name: str, pose: Transform | None = None, **contents: Any) -> Any:
        """Append a node to its parent; ``pose`` in mm."""
        node = self.gltf.Node(name=name, children=[], **contents)
        if pose is not None:
            node.translation = (pose.translation / 1000).tolist()
            node.rotation = list(quaternion(pose))
        parent.children.append(_appended(self.file.nodes, node))
        return node

    def mesh(
        self, name: str, vertices: NDArray[np.float64], corners: ArrayLike, mode: int, material: int | None = None
    ) -> int:
        """Append a mesh of one primitive: vertices (n, 3) [mm], and indices of the ends or corners (m, 2 or 3)."""
        metres = (vertices / 1000).astype("<f4")
        ends = {"min": metres.min(0).tolist(), "max": metres.max(0).tolist()}
        position = self._accessor(metres, _ARRAY_BUFFER, componentType=_FLOAT, type="VEC3", **ends)
        indices = np.asarray(corners).ravel().astype("<u4")
        index = self._accessor(indices, _ELEMENT_BUFFER, componentType=_UINT32, type="SCALAR")
        attributes = self.gltf.Attributes(POSITION=position)
        primitive = self.gltf.Primitive(attributes=attributes, indices=index, mode=mode, material=material)
        return _appended(self.file.meshes, self.gltf.Mesh(name=name, primitives=[primitive]))

    def _accessor(self, values: NDArray[Any], target: int, **kind: Any) -> int:
        buffer = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": values.nbytes, "target": target}
        self.blob.extend(values.tobytes())
        view = _appended(self.file.bufferViews, self.gltf.BufferView(**buffer))
        return _appended(self.file.accessors, self.gltf.Accessor(bufferView=view, count=len(values), **kind))


def _appended(items: list[Any], item: Any) -> int:
    """Append an item, and return its index, by which glTF refers to it."""
    items.append(item)
    return len(items) - 1
