"""Read a part's triangles from a mesh file with trimesh. STEP: :mod:`mitsim.scene.authoring.read_step`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from characterisation.files.errors import InputError, nearest
from mitsim.scene.authoring.face import Floats, Ints

#: units of length [mm]
UNITS = {"mm": 1.0, "m": 1000.0, "inch": 25.4}

#: formats with a fixed unit: glTF is in metres
_IN_METRES = (".glb", ".gltf")

#: STEP files state their unit
STEP = (".step", ".stp", ".p21")
_MESHES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf")

_LARGEST_FILE = 1024**3


@dataclass(frozen=True)
class Mesh:
    """Triangles of a file: ``vertices`` (n, 3) [mm], ``triangles`` (m, 3)."""

    vertices: Floats
    triangles: Ints


def read_mesh(path: str | Path, units: str | None = None) -> Mesh:
    """Read any mesh that trimesh supports, in mm.

    ``units`` (``mm``, ``m``, ``inch``) for formats that do not state theirs; mm if None.

    Raises
    ------
    InputError
        If the file is missing, does not match its suffix, contains no triangles, or needs a package that is absent.
    """
    path = Path(path)
    check_part_file(path, units)
    scene = _load(path)
    scale = UNITS[units] if units else 1000.0 if path.suffix.lower() in _IN_METRES else 1.0
    return _gathered(path, scene, scale)


def check_part_file(path: Path, units: str | None) -> None:
    """Check that a part's file exists, has a supported type, and that its unit may be given.

    Raises
    ------
    InputError
        If a check fails.
    """
    kind = path.suffix.lower()
    if units is not None and units not in UNITS:
        raise InputError("--units", "", repr(units), ", ".join(UNITS), nearest(units, list(UNITS)))
    if not path.is_file():
        there = sorted(p.name for p in path.parent.glob("*") if p.is_file()) if path.parent.is_dir() else []
        raise InputError(path, "", "no such file", "a STEP file or a mesh", nearest(path.name, there))
    if kind not in (*STEP, *_MESHES):
        raise InputError(path, "", f"the ending {kind!r}", ", ".join((*STEP, *_MESHES)))
    if units is not None and kind in STEP:
        raise InputError("--units", "", repr(units), "nothing: a STEP file states its own unit")
    if path.stat().st_size > _LARGEST_FILE:
        raise InputError(path, "", "a file over 1 GiB", "a smaller one", "mesh the part more coarsely")


def _load(path: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return trimesh.load_scene(path)
    except ImportError as error:
        package = getattr(error, "name", None) or str(error)
        raise InputError(
            path, "", f"a format that needs the package {package}", "STL, PLY or OBJ", f"pip install {package}"
        ) from None
    except Exception as error:  # the reader raises any exception on damaged files
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        allowed = f"a {path.suffix.lower().lstrip('.').upper()} file"
        raise InputError(path, "", f"an unreadable file ({reason})", allowed) from None


def _gathered(path: Path, scene: Any, scale: float) -> Mesh:
    """Merge all meshes of a trimesh scene in its frame, in mm."""
    vertices, triangles, start = [], [], 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        if np.shape(mesh.vertices)[1:] != (3,) or np.shape(mesh.faces)[1:] != (3,):  # OBJ with two numbers per vertex
            raise InputError(path, "", "vertices or triangles without three numbers", "a valid mesh")
        matrix = np.asarray(transform, float)
        turn = 1 if np.linalg.det(matrix[:3, :3]) > 0 else -1  # a mirrored instance reverses its triangles
        vertices.append(np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3])
        triangles.append(np.asarray(mesh.faces, np.int64)[:, ::turn] + start)
        start += len(mesh.vertices)
    if not triangles:
        raise InputError(path, "", "no triangles", "a mesh of the part's surface")
    points = np.concatenate(vertices) * scale
    corners = np.concatenate(triangles)
    if not np.isfinite(points).all() or corners.min() < 0 or corners.max() >= len(points):
        raise InputError(path, "", "vertices that are not numbers, or triangles without vertices", "a valid mesh")
    check_size(path, points[np.unique(corners)])
    return Mesh(points, corners)


def check_size(path: Path, points: Floats) -> None:
    """Check that a part with these points (n, 3) [mm] measures 1 mm to 100 m across.

    Raises
    ------
    InputError
        If it does not.
    """
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not 1.0 <= size <= 1e5:
        hint = "give --units m or --units inch if the file uses them" if size < 1 else "see --units"
        raise InputError(path, "", f"a part {size:g} mm across", "1 mm to 100 m", hint)
