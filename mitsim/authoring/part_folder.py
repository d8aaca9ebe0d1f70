"""From a CAD file or a mesh to a scene folder: one PLY for each face, a scene XML, a task.

::

    NAME/
      NAME.xml       scene: one finish, one shape for each face, named plane_1, cylinder_1, ...
      plane_1.ply    binary; exact normals (and lengths u, v) of what was recognised
      task.toml      the recognised features' geometry, and an example of a measurement

STEP is read by ``cascadio`` (OpenCASCADE), which is an optional part of the installation; anything else by trimesh.
The file is read in a process of its own where a native library parses it: a file that crashes that library must not
take us with it.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
import uuid
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh
from numpy.typing import NDArray

from characterisation.features.fits import Cylinder, Plane, Sphere
from mitsim.authoring.cut import Cut, Face, Floats, Ints, cut
from mitsim.errors import InputError, nearest
from mitsim.surface.metals import CONSTANTS
from mitsim.surface.processes import PROCESSES

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


@dataclass(frozen=True)
class Finishing:
    """What the drawing says of all faces: metal, process, Ra [um]."""

    metal: str = "aluminium"
    process: str = "ground"
    roughness: float = 0.8

    def __post_init__(self) -> None:
        for option, value, known in (("--metal", self.metal, CONSTANTS), ("--process", self.process, PROCESSES)):
            if value not in known:
                raise InputError(option, "", repr(value), ", ".join(known), nearest(value, list(known)))
        if not 0.005 <= self.roughness <= 10:
            raise InputError("--Ra", "", f"{self.roughness:g}", "0.005 to 10 um")


def write_part(
    path: str | Path, folder: str | Path, units: str | None = None, finishing: Finishing | None = None,
    angle_deg: float = 20.0,
) -> Cut:  # fmt: skip
    """Read a part, cut it into faces and write its scene folder, whole or not at all; returns the cut.

    Raises
    ------
    InputError
        Of :func:`read_mesh` and :func:`~mitsim.authoring.cut.cut`; if the folder exists or cannot be written.
    """
    path, folder = Path(path), Path(folder).absolute()
    finishing = finishing or Finishing()
    if not 0 < angle_deg < 90:
        raise InputError("--angle", "", f"{angle_deg:g} deg", "over 0 to 90 deg")
    if folder.exists():
        raise InputError(folder, "", "a folder that exists", "a new one", "nothing that is there is overwritten")
    if not re.fullmatch(r"[\w][\w .-]{0,99}", folder.name):
        raise InputError("--output", "", repr(folder.name), "a folder name of letters, digits, dot, dash, underscore")
    mesh = read_mesh(path, units)
    part = cut(mesh.vertices, mesh.triangles, angle_deg, mesh.drawn, str(path))
    partial = folder.with_name(f".{folder.name}.partial-{uuid.uuid4().hex[:12]}")
    try:
        partial.mkdir(parents=True)
        for face in part.faces:
            (partial / f"{face.name}.ply").write_bytes(ply(face))
        (partial / f"{folder.name}.xml").write_text(scene_xml(part.faces, finishing, path.name), encoding="utf-8")
        (partial / "task.toml").write_text(task_toml(part.faces, folder.name), encoding="utf-8")
        partial.rename(folder)
    except OSError as error:
        raise InputError(folder, "", f"a folder that cannot be written ({error})", "a place to write to") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return part


def ply(face: Face) -> bytes:
    """Binary PLY of a face.

    A recognised face has the exact normals of its surface, since a faceted cylinder mirrors light like its facets;
    planes and cylinders also have lengths u, v [mm], which a lay needs. Triangles share no vertices then.
    """
    normals, places = face.corner_normals(), face.corner_places()
    if normals is None:
        mesh = trimesh.Trimesh(face.vertices, face.triangles, process=False)
        return _exported(mesh.export(file_type="ply", vertex_normal=False))
    mesh = trimesh.Trimesh(
        face.vertices[face.triangles].reshape(-1, 3), np.arange(3 * len(face.triangles)).reshape(-1, 3),
        vertex_normals=normals.reshape(-1, 3), process=False,
    )  # fmt: skip
    if places is not None:
        for name, values in zip("uv", np.moveaxis(places.reshape(-1, 2), -1, 0), strict=True):
            mesh.vertex_attributes[name] = values.astype(np.float32)
    return _exported(mesh.export(file_type="ply", vertex_normal=True, include_attributes=True))


def _exported(data: Any) -> bytes:
    assert isinstance(data, bytes)
    return data


def scene_xml(faces: list[Face], finishing: Finishing, source: str) -> str:
    """The scene of all faces, in one finish."""
    source = re.sub(r"-(?=-)|-$", "- ", source)  # two dashes end a comment
    round_ones = [f.sag for f in faces if f.surface is not None and f.kind != "plane"]
    facets = f" Facets of round faces stand off by up to {max(round_ones):.2g} mm." if round_ones else ""
    lines = [
        f"<!-- Made from {source} by mitsim part. A shape's id is the name of a face; rename it here and in task.toml.",
        f"     Lengths in mm, Ra in um.{facets} -->",
        '<scene version="3.0.0">',
        f'    <default name="metal" value="{finishing.metal}"/>',
        f'    <default name="process" value="{finishing.process}"/>',
        f'    <default name="Ra" value="{finishing.roughness:g}"/>',
        "",
        '    <bsdf type="machined_metal" id="finish">',
        '        <string name="metal" value="$metal"/>',
        '        <string name="process" value="$process"/>',
        '        <float name="Ra" value="$Ra"/>',
        "    </bsdf>",
        "",
    ]
    for face in faces:
        lines += [
            f'    <shape type="ply" id={quoteattr(face.name)}>  <!-- {described(face)} -->',
            f'        <string name="filename" value={quoteattr(face.name + ".ply")}/>',
            *(['        <boolean name="face_normals" value="true"/>'] if face.surface is None else []),
            '        <ref id="finish"/>',
            "    </shape>",
        ]
    return "\n".join([*lines, "</scene>", ""])


def described(face: Face) -> str:
    """One line of a face: what it is, where, how large."""
    surface = face.surface
    if isinstance(surface, Plane):
        what = f"normal {_numbers(surface.normal, 3)}, at {_numbers(surface.point, 3)}"
    elif isinstance(surface, Cylinder):
        what = (
            f"{'boss' if face.convex else 'bore'}, radius {_number(surface.radius)}, axis {_numbers(surface.axis, 3)}"
        )
    elif isinstance(surface, Sphere):
        what = f"radius {_number(surface.radius)}, centre {_numbers(surface.centre, 3)}"
    else:
        what = "no plane, cylinder or sphere; flat facets"
    return f"{what}; {face.area:.4g} mm^2"


def task_toml(faces: list[Face], name: str) -> str:
    """The recognised features, and an example measurement as a comment."""
    lines = [
        f"# Features of {name}.xml, as mitsim part recognised them: geometry in the part frame, in mm.",
        "# Keep what you measure, delete the rest; a study needs at least one measurement (docs/formats.md).",
        "",
        *_example(faces),
    ]
    known = [face for face in faces if face.surface is not None]
    if not known:
        lines += ["# No plane, cylinder or sphere was recognised.", "[features]", ""]
    for face in known:
        surface = face.surface
        lines += [f"[features.{face.name}]", f'kind = "{face.kind}"']
        if isinstance(surface, Sphere):
            lines += [f"point_mm = {_numbers(surface.centre)}"]
        elif isinstance(surface, Cylinder):
            lines += [f"point_mm = {_numbers(surface.point)}", f"direction = {_numbers(surface.axis, 7)}"]
        elif isinstance(surface, Plane):
            lines += [f"point_mm = {_numbers(surface.point)}", f"direction = {_numbers(surface.normal, 7)}"]
        if isinstance(surface, Cylinder | Sphere):
            lines += [f"radius_mm = {_number(surface.radius)}"]
        lines.append("")
    return "\n".join(lines)


def _example(faces: list[Face]) -> list[str]:
    first = next((face for face in faces if isinstance(face.surface, Cylinder | Sphere)), None)
    if first is None or not isinstance(first.surface, Cylinder | Sphere):
        return ["# Nothing that is measured so far lies between planes alone: see docs/formats.md, Task TOML.", ""]
    return [
        f"# [measurements.{first.name}_radius]",
        '# kind = "radius"',
        f'# features = ["{first.name}"]',
        f"# nominal = {_number(first.surface.radius)}",
        '# unit = "mm"',
        "",
    ]


def _numbers(values: NDArray[np.floating], places: int = 4) -> str:
    return f"[{', '.join(_number(float(value), places) for value in values)}]"


def _number(value: float, places: int = 4) -> str:
    """Write a length to 0.1 um: a mesh file in single precision knows no more."""
    return str(round(float(value), places) + 0.0)
