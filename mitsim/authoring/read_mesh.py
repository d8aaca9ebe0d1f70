"""Read a part's triangles from a CAD file or a mesh.

STEP is read by ``cascadio`` (OpenCASCADE), which is an optional part of the installation; anything else by trimesh.
The file is read in a process of its own where a native library parses it: a file that crashes that library must not
take us with it.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from mitsim.authoring.cut import Floats, Ints
from mitsim.errors import InputError, nearest

#: lengths of a file's unit [mm]
UNITS = {"mm": 1.0, "m": 1000.0, "inch": 25.4}

#: formats whose unit is laid down: glTF is in metres, and STEP files say theirs (cascadio turns it into metres)
_IN_METRES = (".glb", ".gltf", ".step", ".stp")
_STEP = (".step", ".stp")
_MESHES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf")

#: how finely STEP is meshed: distance from the true surface [mm], and bend from facet to facet [rad]
STEP_TOLERANCE_MM, STEP_BEND = 0.01, 0.1

_LARGEST_FILE = 1024**3
_CONVERT = """
import sys, cascadio
with open(sys.argv[1], "rb") as file:
    data = file.read()
glb = cascadio.load(data, "step", tol_linear=float(sys.argv[3]), tol_angular=float(sys.argv[4]), include_brep=True)
with open(sys.argv[2], "wb") as file:
    file.write(glb)
"""


@dataclass(frozen=True)
class Mesh:
    """Triangles of a file: ``vertices`` (n, 3) [mm], ``triangles`` (m, 3), ``drawn`` (m,) the face of the CAD model."""

    vertices: Floats
    triangles: Ints
    drawn: Ints | None


def read_mesh(path: str | Path, units: str | None = None) -> Mesh:
    """Read a STEP file or any mesh that trimesh reads, in mm.

    ``units`` (``mm``, ``m``, ``inch``) of formats that do not say theirs; mm if None.

    Raises
    ------
    InputError
        If the file is missing, is not what its ending says, holds no triangles, or needs a package that is absent.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if units is not None and units not in UNITS:
        raise InputError("--units", "", repr(units), ", ".join(UNITS), nearest(units, list(UNITS)))
    if not path.is_file():
        there = sorted(p.name for p in path.parent.glob("*") if p.is_file()) if path.parent.is_dir() else []
        raise InputError(path, "", "no such file", "a STEP file or a mesh", nearest(path.name, there))
    if kind not in (*_STEP, *_MESHES):
        raise InputError(path, "", f"the ending {kind!r}", ", ".join((*_STEP, *_MESHES)))
    if units is not None and kind in _STEP:
        raise InputError("--units", "", repr(units), "nothing: a STEP file says its own unit")
    if path.stat().st_size > _LARGEST_FILE:
        raise InputError(path, "", "a file over 1 GiB", "a smaller one", "mesh the part more coarsely")
    scene = _load_step(path) if kind in _STEP else _load(path, path)
    scale = UNITS[units] if units else 1000.0 if kind in _IN_METRES else 1.0
    return _gathered(path, scene, scale)


def _load_step(path: Path) -> Any:
    if importlib.util.find_spec("cascadio") is None:
        hint = "pip install cascadio, or save the part as STL"
        raise InputError(path, "", "a STEP file, and no cascadio that could read it", "an STL, PLY or OBJ file", hint)
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder) / "part.glb"
        command = [sys.executable, "-c", _CONVERT, path, glb, STEP_TOLERANCE_MM, STEP_BEND]
        try:
            done = subprocess.run([str(c) for c in command], capture_output=True, timeout=3600, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(path, "", "a part that is not meshed within an hour", "a simpler one") from None
        if done.returncode != 0 or not glb.exists() or glb.stat().st_size == 0:
            raise InputError(path, "", "nothing that OpenCASCADE can read", "a STEP file (AP203, AP214 or AP242)")
        return _load(glb, path)


def _load(file: Path, told: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return trimesh.load_scene(file)
    except ImportError as error:
        package = getattr(error, "name", None) or str(error)
        raise InputError(told, "", f"a format that needs the package {package}", "STL, PLY or OBJ",
                         f"pip install {package}") from None  # fmt: skip
    except Exception as error:  # a reader of files raises anything on garbage
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        allowed = f"a {told.suffix.lower().lstrip('.').upper()} file"
        raise InputError(told, "", f"what cannot be read ({reason})", allowed) from None


def _gathered(path: Path, scene: Any, scale: float) -> Mesh:
    """All meshes of a trimesh scene in its frame, in mm; numbers of CAD faces made unique over its bodies."""
    vertices, triangles, drawn, start, faces = [], [], [], 0, 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        matrix = np.asarray(transform, float)
        turn = 1 if np.linalg.det(matrix[:3, :3]) > 0 else -1  # a mirrored instance turns its triangles over
        vertices.append(np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3])
        triangles.append(np.asarray(mesh.faces, np.int64)[:, ::turn] + start)
        label = mesh.face_attributes.get("brep_index")
        drawn.append(None if label is None else np.asarray(label, np.int64).ravel() + faces)
        start += len(mesh.vertices)
        faces += 0 if label is None else int(np.max(label)) + 1
    if not triangles:
        raise InputError(path, "", "no triangles", "a mesh of the part's surface")
    points = np.concatenate(vertices) * scale
    corners = np.concatenate(triangles)
    if not np.isfinite(points).all() or corners.min() < 0 or corners.max() >= len(points):
        raise InputError(path, "", "vertices that are no numbers, or triangles without vertices", "a sound mesh")
    size = float(np.linalg.norm(np.ptp(points[np.unique(corners)], axis=0)))
    if not 1.0 <= size <= 1e5:
        hint = "say --units m or --units inch if the file is in them" if size < 1 else "see --units"
        raise InputError(path, "", f"a part {size:g} mm across", "1 mm to 100 m", hint)
    known = all(one is not None and len(one) == len(t) for one, t in zip(drawn, triangles, strict=True))
    return Mesh(points, corners, np.concatenate([one for one in drawn if one is not None]) if known else None)
