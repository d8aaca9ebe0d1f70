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
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.atomic_io import atomic_write_named
from characterisation.point_cloud import ViewGrid
from mitsim.report.export.needed import needed
from mitsim.report.export.run_scene import RunScene, frustum, sensor_from_grid
from mitsim.running.version import __version__
from mitsim.sensor.transforms import Transform

#: length of the drawn frusta [mm]
FRUSTUM_MM = 60.0

#: OpenCV's camera axes (y down, z forward) from those of glTF and USD (y up, z backward)
OPENCV_FROM_OPENGL = Transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))

_FLOAT, _UINT32, _ARRAY_BUFFER, _ELEMENT_BUFFER = 5126, 5125, 34962, 34963
_LINES, _TRIANGLES = 1, 4


def write_glb(scene: RunScene, path: str | Path) -> None:
    """Write part and views as one binary glTF file."""
    gltf = needed("pygltflib", "pygltflib", f"{path}: glTF")
    file = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator=f"mitsim {__version__}"))
    blob = bytearray()
    glb = _Glb(gltf, file, blob)
    turn = Rotation.from_rotvec([-math.pi / 2, 0, 0]).as_quat()
    root = gltf.Node(name="part_frame", rotation=turn.tolist(), children=[])
    file.nodes.append(root)
    file.scenes, file.scene = [gltf.Scene(nodes=[0])], 0
    if scene.part is not None:
        colour = [0.7, 0.7, 0.72, 1.0]
        metal = gltf.PbrMetallicRoughness(baseColorFactor=colour, metallicFactor=0.2, roughnessFactor=0.6)
        file.materials.append(gltf.Material(name="part", pbrMetallicRoughness=metal, doubleSided=True))
        places, faces = np.asarray(scene.part.vertices), np.asarray(scene.part.faces)
        mesh = _mesh(glb, "part", places, faces.ravel(), _TRIANGLES, 0)
        _node(glb, root, "part", mesh=mesh)
    lines = camera = None
    if scene.grid is not None:
        places, edges = frustum(scene.grid, FRUSTUM_MM)
        lines = _mesh(glb, "frustum", places, np.array(edges).ravel(), _LINES, None)
        camera = _camera(glb, scene)
    for view in scene.views:
        node = _node(glb, root, view.name, view.part_from_sensor)
        node.extras = {"view": view.number, "best_of": list(view.best_of), "sensor": scene.sensor}
        if scene.grid is not None:
            pose = sensor_from_grid(scene.grid)
            _node(glb, node, f"{view.name}_frustum", pose, mesh=lines)
            _node(glb, node, f"{view.name}_camera", pose @ OPENCV_FROM_OPENGL, camera=camera)
    file.buffers = [gltf.Buffer(byteLength=len(blob))] if blob else []
    if blob:
        file.set_binary_blob(bytes(blob))
    with atomic_write_named(path) as partial:
        file.save_binary(str(partial))


def field_of_view(grid: ViewGrid) -> tuple[float, float]:
    """Return the vertical field of view [rad] and the aspect ratio of a grid with central principal point."""
    x, y = grid.width / grid.fx, grid.height / grid.fy
    return 2 * math.atan(y / 2), x / y


@dataclass(frozen=True)
class _Glb:
    """A file that is made: the library ``gltf``, its ``file`` object, and the ``blob`` of its numbers."""

    gltf: Any
    file: Any
    blob: bytearray


def _camera(glb: _Glb, scene: RunScene) -> int:
    assert scene.grid is not None
    gltf, file = glb.gltf, glb.file
    vertical, aspect = field_of_view(scene.grid)
    optics = gltf.Perspective(yfov=vertical, aspectRatio=aspect, znear=0.01)
    file.cameras.append(gltf.Camera(type="perspective", perspective=optics, name=scene.sensor))
    return len(file.cameras) - 1


def _node(glb: _Glb, parent: Any, name: str, pose: Transform | None = None, **contents: Any) -> Any:
    """Append a node to its parent; ``pose`` in mm."""
    node = glb.gltf.Node(name=name, children=[], **contents)
    if pose is not None:
        node.translation = (pose.translation / 1000).tolist()
        node.rotation = Rotation.from_matrix(pose.rotation).as_quat(canonical=True).tolist()
    parent.children.append(len(glb.file.nodes))
    glb.file.nodes.append(node)
    return node


def _mesh(
    glb: _Glb,
    name: str,
    places: NDArray[np.float64],
    indices: NDArray[np.integer],
    mode: int,
    material: int | None,
) -> int:
    """Append places (n, 3) [mm] and indices as a mesh of one primitive."""
    gltf, file = glb.gltf, glb.file
    metres = (places / 1000).astype("<f4")
    position = _accessor(
        glb,
        metres.tobytes(),
        _ARRAY_BUFFER,
        gltf.Accessor(
            componentType=_FLOAT,
            count=len(metres),
            type="VEC3",
            min=metres.min(0).tolist(),
            max=metres.max(0).tolist(),
        ),
    )
    index = _accessor(
        glb,
        indices.astype("<u4").tobytes(),
        _ELEMENT_BUFFER,
        gltf.Accessor(
            componentType=_UINT32,
            count=len(indices),
            type="SCALAR",
        ),
    )
    primitive = gltf.Primitive(
        attributes=gltf.Attributes(POSITION=position), indices=index, mode=mode, material=material
    )
    file.meshes.append(gltf.Mesh(name=name, primitives=[primitive]))
    return len(file.meshes) - 1


def _accessor(glb: _Glb, data: bytes, target: int, accessor: Any) -> int:
    file, blob = glb.file, glb.blob
    file.bufferViews.append(glb.gltf.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(data), target=target))
    blob += data
    accessor.bufferView = len(file.bufferViews) - 1
    file.accessors.append(accessor)
    return len(file.accessors) - 1
