"""Read a part's triangles from a mesh file with trimesh. STEP: :mod:`mitsim.scene.authoring.read_step`."""

from __future__ import annotations

import math
import re
import warnings
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError, in_one_line, nearest
from mitsim.scene.authoring.face import Ints
from mitsim.scene.authoring.step_mesh import LARGE_MM
from mitsim.scene.authoring.units import commented_unit, unit_assumed, unit_words
from mitsim.scene.authoring.unread_mesh import GLTF, unread
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM, UNITS_MM

STEP = (".step", ".stp", ".p21")
_MESHES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf")

#: formats with polygons, which are divided into fans
_POLYGONS = (".obj", ".ply", ".off")

#: cosine of the angle between the normals of triangles that fold back on one another
_FOLDED = -0.99999

#: takes coordinates of glTF, whose y is up (glTF 2.0, section 3.4), to those of a part, whose z is up
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_LARGEST_FILE = 1024**3

#: diagonal of a part that is read [mm]: single precision of a mesh is 8 um at 100 m
_SIZES_MM = (1.0, 1e5)

#: diagonal of a part without a remark [mm]: a sensor of the presets resolves a smaller one with few points, and none
#: works at over 5 m; chosen
_USUAL_MM = (3.0, LARGE_MM)


@dataclass(frozen=True)
class Mesh:
    """Triangles of a file: ``vertices`` (n, 3) [mm], ``triangles`` (m, 3), and ``remarks`` about their unit."""

    vertices: Floats
    triangles: Ints
    remarks: tuple[str, ...] = ()


def read_mesh(path: str | Path, units: str | None = None) -> Mesh:
    """Read any mesh that trimesh supports, in mm.

    ``units`` (``mm``, ``m``, ``inch``) of a file that does not state its own, mm if None. It takes precedence over a
    stated unit that differs, with a remark. Raises InputError if the file is missing, does not match its suffix,
    contains no triangles, or more than can be read, or needs a package that is absent.
    """
    path = Path(path)
    check_part_file(path, units)
    if found := unread(path):
        hint = "save the part alone, as plain triangles, or as STL or STEP"
        raise InputError(path, "", found, "triangles of the part's surface", hint)
    scene = _load(path)
    scale, remarks = _scale(path, scene, units)
    mesh = _gathered(path, scene, scale)
    remarks += mesh.remarks
    if path.suffix.lower() not in GLTF:
        return Mesh(mesh.vertices, mesh.triangles, remarks)
    remarks += (f"{path.name} has y up, as glTF defines it: turned, so that z is up",)
    return Mesh(mesh.vertices @ _Z_UP_FROM_Y_UP.T, mesh.triangles, remarks)


def check_part_file(path: Path, units: str | None) -> None:
    """Check that a part's file exists, has a supported type, and may be given this unit, by an InputError."""
    kind = path.suffix.lower()
    if units is not None and units not in LENGTHS_MM:
        raise InputError("--units", "", repr(units), ", ".join(LENGTHS_MM), nearest(units, list(LENGTHS_MM)))
    if not path.is_file():
        there = sorted(p.name for p in path.parent.glob("*") if p.is_file()) if path.parent.is_dir() else []
        raise InputError(path, "", "no such file", "a STEP file or a mesh", nearest(path.name, there))
    if kind not in (*STEP, *_MESHES):
        hint = "export the part from the CAD program as STEP"
        raise InputError(path, "", f"the ending {kind!r}", ", ".join((*STEP, *_MESHES)), hint)
    if path.stat().st_size > _LARGEST_FILE:
        raise InputError(path, "", "a file over 1 GiB", "a smaller one", "mesh the part more coarsely")


def _load(path: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if path.suffix.lower() == ".obj":
                return trimesh.Scene(_obj_mesh(path.read_bytes()))
            return trimesh.load_scene(path, process=False)  # else it leaves out vertices that are not numbers
    except ImportError as error:
        package = getattr(error, "name", None) or str(error)
        raise InputError(
            path, "", f"a format that needs the package {package}", "STL, PLY or OBJ", f"pip install {package}"
        ) from None
    except Exception as error:  # the reader raises any exception on damaged files
        reason = in_one_line(error, 120)
        allowed = f"a file of the format {path.suffix.lower().lstrip('.').upper()}"
        raise InputError(path, "", f"an unreadable file ({reason})", allowed, "save the part as STL or STEP") from None


def _obj_mesh(data: bytes) -> trimesh.Trimesh:
    """Return the polygons of an OBJ file, divided into fans.

    trimesh counts relative numbers from the last vertex of the file instead of the last one before the polygon, and
    skips lines that begin with a blank.
    """
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in re.sub(rb"\\\r?\n", b" ", data).splitlines():
        keyword, *words = line.partition(b"#")[0].split() or [b""]
        if keyword == b"v":
            vertices.append([float(word) for word in words[:3]])
        elif keyword == b"f":
            numbers = [int(word.partition(b"/")[0]) for word in words]
            first, *others = [number - 1 if number >= 0 else len(vertices) + number for number in numbers]
            triangles += [(first, *pair) for pair in pairwise(others)]
    return trimesh.Trimesh(vertices, triangles, process=False)


def _scale(path: Path, scene: Any, units: str | None) -> tuple[float, tuple[str, ...]]:
    """Return the size of a file's unit [mm], and a remark unless the file states it and nothing contradicts it."""
    stated = _stated_unit(path, scene)
    if stated is None:
        if units is None:
            return 1.0, (unit_assumed(path.name),)
        return LENGTHS_MM[units], ()
    if units is None or math.isclose(stated, LENGTHS_MM[units]):
        return stated, ()
    return LENGTHS_MM[units], (f"{path.name} states {unit_words(stated)} as its unit: --units {units} is used instead",)


def _stated_unit(path: Path, scene: Any) -> float | None:
    """Return the unit of length [mm] that a mesh file states, None without one."""
    kind = path.suffix.lower()
    if kind in GLTF:
        return LENGTHS_MM["m"]
    if kind == ".3mf":
        word = str(scene.metadata.get("units", "millimeter")).strip().lower()
        if word not in UNITS_MM:
            raise InputError(path, "unit", repr(word[:40]), "micron, millimeter, centimeter, inch, foot or meter")
        return UNITS_MM[word]
    with path.open("rb") as file:
        return commented_unit(kind, file.read(4096))


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
        raise InputError(path, "", "no triangles, or only a part of a file", "a mesh of the part's surface")
    points = np.concatenate(vertices) * scale
    corners = np.concatenate(triangles)
    if not np.isfinite(points).all() or corners.min() < 0 or corners.max() >= len(points):
        raise InputError(path, "", "vertices that are not numbers, or triangles without vertices", "a valid mesh")
    remarks = check_size(path, float(np.linalg.norm(np.ptp(points[np.unique(corners)], axis=0))))
    if path.suffix.lower() in _POLYGONS and (folded := _folded(points, corners)):
        hint = "export triangles, or STEP or STL: polygons that are not convex are not divided correctly"
        raise InputError(path, "", f"{folded} triangles that fold back on a neighbour", "a surface without folds", hint)
    return Mesh(points, corners, tuple(remarks))


def _folded(points: Floats, triangles: Ints) -> int:
    """Count pairs of neighbours, also across a triangle without area, that lie in one plane on the same side of it."""
    mesh = trimesh.Trimesh(points, triangles, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)  # type: ignore[no-untyped-call]
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    longest = np.max([((b - a) ** 2).sum(1), ((c - b) ** 2).sum(1), ((a - c) ** 2).sum(1)], axis=0)
    length = np.linalg.norm(normals, axis=1)
    flat = length <= 1e-7 * longest
    normals /= np.where(flat, np.inf, length)[:, None]
    pairs = mesh.face_adjacency
    across = defaultdict(list)
    for facet, other in pairs[flat[pairs].any(axis=1)].tolist():
        across[facet].append(other)
        across[other].append(facet)
    linked = [
        (facet, other) for at in np.flatnonzero(flat) for facet in across[at] for other in across[at] if facet < other
    ]
    every = np.concatenate([pairs, np.array(linked, int).reshape(-1, 2)])
    return int((np.einsum("ij,ij->i", normals[every[:, 0]], normals[every[:, 1]]) < _FOLDED).sum())


def check_size(path: Path, size: float, stated: str = "") -> list[str]:
    """Return a remark about the unit if a part of this diagonal [mm] is not of a usual size.

    ``stated`` is the unit of a file in which ``--units`` cannot change it. Raises InputError if the part does not
    measure 1 mm to 100 m across.
    """
    hint = "give --units if the file has another unit: m or inch, for example"
    if stated:
        hint = f"the file states {stated}: if that is wrong, export it again from the CAD program in the right unit"
    across = f"{size / 1e3:.3g} m" if size > _USUAL_MM[1] else f"{size:.3g} mm"
    if not _SIZES_MM[0] <= size <= _SIZES_MM[1]:
        raise InputError(path, "", f"a part {across} across", "1 mm to 100 m", hint)
    if _USUAL_MM[0] <= size <= _USUAL_MM[1]:
        return []
    return [f"the part is {across} across, which is unusual; {hint}"]
