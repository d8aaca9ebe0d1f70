"""From a CAD file or a mesh to a scene folder: one PLY for each face, a scene XML, a task.

::

    NAME/
      NAME.xml       scene: one finish, one shape for each face, named plane_1, cylinder_1, ...
      plane_1.ply    binary; exact normals (and lengths u, v) of what was recognised
      task.toml      the recognised features' geometry, and an example of a measurement
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh
from numpy.typing import NDArray

from characterisation.features.fits import Cylinder, Plane, Sphere
from characterisation.whole_files import FULL, write_folder
from mitsim.authoring.cut import Cut, Face, cut
from mitsim.authoring.read_mesh import read_mesh
from mitsim.errors import InputError, nearest
from mitsim.surface.metals import CONSTANTS
from mitsim.surface.processes import PROCESSES


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
        Of :func:`~mitsim.authoring.read_mesh.read_mesh` and :func:`~mitsim.authoring.cut.cut`; if the folder exists or
        cannot be written.
    OSError
        On a full disk, see :func:`~characterisation.whole_files.write_folder`.
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
    files = {f"{face.name}.ply": ply(face) for face in part.faces}
    files[f"{folder.name}.xml"] = scene_xml(part.faces, finishing, path.name).encode()
    files["task.toml"] = task_toml(part.faces, folder.name).encode()
    try:
        write_folder(folder, files)
    except OSError as error:
        if error.errno in FULL:
            raise
        raise InputError(folder, "", f"a folder that cannot be written ({error})", "a place to write to") from None
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
