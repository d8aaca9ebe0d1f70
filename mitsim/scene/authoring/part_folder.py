"""Convert a CAD file or a mesh to a scene folder: one PLY for each face, a scene XML, a task.

::

    NAME/
      NAME.xml       scene: a finish for each colour of the file, one shape for each face, named top, bore_12mm, ...
      top.ply        binary; exact normals (and lengths u, v) of recognised or drawn surfaces
      task.toml      the features' geometry; the drawing's measurements, or an example of one
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.files.atomic_io import FULL, write_folder
from characterisation.files.errors import InputError, nearest
from mitsim.scene.authoring.drawing_task import DrawnTask, drawn_task
from mitsim.scene.authoring.face import Face, Torus
from mitsim.scene.authoring.naming import cylinder_kind, with_names
from mitsim.scene.authoring.product_information import read_product_information
from mitsim.scene.authoring.read_mesh import STEP, check_part_file, check_size, read_mesh
from mitsim.scene.authoring.read_step import Fineness, read_step
from mitsim.scene.authoring.segment_mesh import segment_mesh
from mitsim.scene.authoring.task_text import number, numbers, task_toml
from mitsim.scene.authoring.units import stated_units
from mitsim.scene.surface.metals import CONSTANTS
from mitsim.scene.surface.named_finishes import NAMED_FINISHES, NamedFinish
from mitsim.scene.surface.processes import PROCESSES


@dataclass(frozen=True)
class Finishing:
    """Finish of all faces: metal, process and Ra [um] from the drawing, or instead a ``named`` finish.

    ``named`` is one of :data:`~mitsim.scene.surface.named_finishes.NAMED_FINISHES`; ``reflectance`` [1] and ``gloss``
    [GU at 60 deg] override its own.
    """

    metal: str = "aluminium"
    process: str = "ground"
    roughness: float = 0.8
    named: str | None = None
    reflectance: float | None = None
    gloss: float | None = None

    def __post_init__(self) -> None:
        if self.named is not None and self.named not in NAMED_FINISHES:
            allowed, hint = ", ".join(NAMED_FINISHES), nearest(self.named, list(NAMED_FINISHES))
            raise InputError("--finish", "", repr(self.named), allowed, hint)
        usual = NAMED_FINISHES[self.named].properties if self.named else {}
        for key, limits in (("reflectance", (0.01, 0.85)), ("gloss", (0.5, 100.0))):
            value = getattr(self, key)
            if value is None:
                continue
            if key not in usual:
                has = ", ".join(name for name, finish in NAMED_FINISHES.items() if key in finish.properties)
                raise InputError(f"--{key}", "", f"{value:g}", f"together with one of these --finish: {has}")
            if not limits[0] <= value <= limits[1]:
                raise InputError(f"--{key}", "", f"{value:g}", f"{limits[0]:g} to {limits[1]:g}")
        for option, value, names in (("--metal", self.metal, CONSTANTS), ("--process", self.process, PROCESSES)):
            if value not in names:
                base = "an alloy goes by its base metal" if option == "--metal" else ""
                raise InputError(option, "", repr(value), ", ".join(names), nearest(value, list(names)) or base)
        if not 0.005 <= self.roughness <= 10:
            raise InputError("--Ra", "", f"{self.roughness:g}", "0.005 to 10 um")

    @property
    def material(self) -> NamedFinish:
        """Return the material of the scene."""
        if self.named is None:
            written: dict[str, str | float] = {"metal": self.metal, "process": self.process, "Ra": self.roughness}
            return NamedFinish("machined_metal", written, "")
        finish = NAMED_FINISHES[self.named]
        overrides = {"reflectance": self.reflectance, "gloss": self.gloss}
        return replace(finish, properties=finish.properties | {k: v for k, v in overrides.items() if v is not None})


@dataclass(frozen=True)
class Part:
    """A part's named faces, remarks about their processing, and the task of its drawing, if the file has one."""

    faces: list[Face]
    remarks: list[str]
    drawing: DrawnTask | None = None


def read_part(
    path: str | Path, units: str | None = None, angle_deg: float = 20.0, fineness: Fineness | None = None
) -> Part:
    """Read a STEP file or a mesh, and name its faces.

    Raises InputError as :func:`~mitsim.scene.authoring.read_step.read_step`,
    :func:`~mitsim.scene.authoring.read_mesh.read_mesh` and :func:`~mitsim.scene.authoring.segment_mesh.segment_mesh`.

    ``path``, ``units``: the file, and its unit of length if it states none. ``angle_deg``, ``fineness``: of a mesh:
    neighbouring triangles with a smaller angle between them belong to one face; of the mesh of a STEP file.
    """
    path = Path(path)
    check_part_file(path, units)
    if path.suffix.lower() not in STEP:
        mesh = read_mesh(path, units)
        made = segment_mesh(mesh.vertices, mesh.triangles, angle_deg, str(path))
        return Part(with_names(made.faces), [*mesh.remarks, *made.remarks])
    drawn = read_step(path, fineness or Fineness(), units)
    size = float(np.linalg.norm(np.ptp(np.concatenate([face.vertices for face in drawn.faces]), axis=0)))
    remarks = drawn.remarks + check_size(path, size, stated_units(drawn.text))
    faces = with_names(drawn.faces)
    information = read_product_information(drawn.text)
    return Part(faces, remarks, drawn_task(information, faces) if information.found else None)


def write_part(
    path: str | Path,
    folder: str | Path,
    units: str | None = None,
    finishing: Finishing | None = None,
    angle_deg: float = 20.0,
    fineness: Fineness | None = None,
) -> Part:
    """Read a part, write its scene folder atomically, and return the part.

    Raises InputError as :func:`read_part`; or if the folder exists or cannot be written. Raises OSError on a full disk,
    see :func:`~characterisation.files.atomic_io.write_folder`.

    Parameters
    ----------
    path, units, angle_deg, fineness
        As for :func:`read_part`.
    folder, finishing
        To be made; finish of all faces, ground aluminium by default.
    """
    path, folder = Path(path), Path(folder).absolute()
    finishing = finishing or Finishing()
    if not 0 < angle_deg < 90:
        raise InputError("--angle", "", f"{angle_deg:g} deg", "over 0 to 90 deg")
    if fineness is not None and not 0 < fineness.chord_mm <= 10:
        raise InputError("--chord", "", f"{fineness.chord_mm:g} mm", "over 0 to 10 mm")
    if folder.exists():
        raise InputError(folder, "", "a folder that exists", "a new one", "existing files are not overwritten")
    if not re.fullmatch(r"[\w][\w .-]{0,99}", folder.name):
        raise InputError("--output", "", repr(folder.name), "a folder name of letters, digits, dot, dash, underscore")
    part = read_part(path, units, angle_deg, fineness)
    files = {f"{face.name}.ply": ply(face) for face in part.faces}
    files[f"{folder.name}.xml"] = scene_xml(part.faces, finishing, path.name).encode()
    files["task.toml"] = task_toml(part.faces, folder.name, part.drawing).encode()
    try:
        write_folder(folder, files)
    except OSError as error:
        if error.errno in FULL:
            raise
        raise InputError(folder, "", f"a folder that cannot be written ({error})", "a writable place") from None
    return part


def ply(face: Face) -> bytes:
    """Return the binary PLY of a face.

    A recognised face has the exact normals of its surface, because a faceted cylinder reflects light like its facets.
    Other faces of a CAD file have the file's normals. Planes and cylinders also have lengths u, v [mm], as a lay
    requires. In these cases triangles share no vertices.
    """
    normals, coordinates = face.corner_normals(), face.corner_places()
    if normals is None:
        mesh = trimesh.Trimesh(face.vertices, face.triangles, process=False)
        return _exported(mesh.export(file_type="ply", vertex_normal=False))
    mesh = trimesh.Trimesh(
        face.vertices[face.triangles].reshape(-1, 3),
        np.arange(3 * len(face.triangles)).reshape(-1, 3),
        vertex_normals=normals.reshape(-1, 3),
        process=False,
    )
    if coordinates is not None:
        for name, values in zip("uv", np.moveaxis(coordinates.reshape(-1, 2), -1, 0), strict=True):
            mesh.vertex_attributes[name] = values.astype(np.float32)
    return _exported(mesh.export(file_type="ply", vertex_normal=True, include_attributes=True))


def _exported(data: Any) -> bytes:
    assert isinstance(data, bytes)
    return data


def scene_xml(faces: list[Face], finishing: Finishing, source: str) -> str:
    """Return the scene of all faces, with a finish for each colour of the file; initially all finishes are equal."""
    material = finishing.material
    source = re.sub(r"-(?=-)|-$", "- ", source)  # two dashes end a comment
    round_ones = [f.sag for f in faces if f.surface is not None and f.kind != "plane"]
    facets = f" Facets of round faces deviate by up to {max(round_ones):.2g} mm." if round_ones else ""
    lines = [
        f"<!-- Made from {source} by mitsim part. A shape's id is the name of a face; rename it here and in task.toml.",
        f"     Lengths in mm, Ra in um.{facets} -->",
        '<scene version="3.0.0">',
        *(f'    <default name="{name}" value="{_written(value)}"/>' for name, value in material.properties.items()),
        "",
    ]
    finishes = finish_names(faces)
    for colour, name in finishes.items():
        parameters = (
            f"  <!-- colour {hexadecimal(colour)} of the file -->" if colour is not None and len(finishes) > 1 else ""
        )
        lines += [
            f'    <bsdf type="{material.kind}" id="{name}">{parameters}',
            *(
                f'        <{"string" if isinstance(value, str) else "float"} name="{key}" value="${key}"/>'
                for key, value in material.properties.items()
            ),
            "    </bsdf>",
            "",
        ]
    parts = list(dict.fromkeys((face.part, face.body) for face in faces))
    for part in parts:
        if len(parts) > 1:
            lines += ["", f"    <!-- part {re.sub('-+', '-', part[0]).strip('-')} -->"]
        for face in faces:
            if (face.part, face.body) != part:
                continue
            smooth = face.surface is not None or face.normals is not None
            lines += [
                f'    <shape type="ply" id={quoteattr(face.name)}>  <!-- {described(face)} -->',
                f'        <string name="filename" value={quoteattr(face.name + ".ply")}/>',
                *([] if smooth else ['        <boolean name="face_normals" value="true"/>']),
                f'        <ref id="{finishes[face.colour]}"/>',
                "    </shape>",
            ]
    return "\n".join([*lines, "</scene>", ""])


def _written(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def finish_names(faces: list[Face]) -> dict[tuple[float, float, float] | None, str]:
    """Return an id of a finish for each colour of a part: ``finish`` for the largest area, else by its colour."""
    area: dict[tuple[float, float, float] | None, float] = {face.colour: 0.0 for face in faces} or {None: 0.0}
    for face in faces:
        area[face.colour] += face.area
    order = sorted(area, key=lambda colour: (-round(area[colour], 3), str(colour)))
    return {c: "finish" if n == 0 else f"finish_{hexadecimal(c)[1:]}" for n, c in enumerate(order)}


def hexadecimal(colour: tuple[float, float, float] | None) -> str:
    """Return a colour as ``#rrggbb``; ``#none`` for none."""
    return "#none" if colour is None else "#" + "".join(f"{round(255 * channel):02x}" for channel in colour)


def described(face: Face) -> str:
    """Describe a face in one line: kind, position, size."""
    surface = face.surface
    if isinstance(surface, Plane):
        description = f"normal {numbers(surface.normal, 3)}, at {numbers(surface.point, 3)}"
    elif isinstance(surface, Cylinder):
        kind = cylinder_kind(face, surface).replace("_", " ")
        description = f"{kind}, radius {number(surface.radius)}, axis {numbers(surface.axis, 3)}"
    elif isinstance(surface, Cone):
        angle = number(float(np.rad2deg(2 * surface.half_angle)), 3)
        description = (
            f"cone of {angle} deg, radius {number(surface.radius)} at its wide end, axis {numbers(surface.axis, 3)}"
        )
    elif isinstance(surface, Sphere):
        description = f"radius {number(surface.radius)}, centre {numbers(surface.centre, 3)}"
    elif isinstance(surface, Torus):
        description = f"torus of radius {number(surface.radius)}, its tube {number(surface.tube)}, not measured"
    elif face.normals is not None:
        description = "free form, with the normals of the CAD file"
    else:
        description = "neither plane, cylinder nor sphere; flat facets"
    return f"{description}; {face.area:.4g} mm^2"
