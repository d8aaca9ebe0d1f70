"""Read the faces of a STEP file with their exact surfaces, instead of estimates from a mesh.

Signal chain: STEP -> OpenCASCADE in a separate process (:mod:`mitsim.scene.authoring.step_worker`) -> faces with their
exact surfaces -> faces of one body that lie on one surface and share an edge joined (CAD divides a bore into two
halves) -> names from the file's text.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.words.progress import say_progress
from mitsim.scene.authoring import step_mesh, step_worker
from mitsim.scene.authoring.face import Face, Ints, Surface, Torus, centred, mesh_distances, outward_normals
from mitsim.scene.authoring.join_faces import join_faces
from mitsim.scene.authoring.part21 import StepText, read_step_text
from mitsim.scene.authoring.placements import check_placements
from mitsim.scene.authoring.read_mesh import check_size
from mitsim.scene.authoring.units import stated_units, step_units, unit_assumed
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM

#: distance of the default mesh from the true surface, without a sensor [mm]; chosen
CHORD_MM = 0.01
#: angle between its facets [rad]; it only keeps small round faces round, since the normals are exact
BEND = 0.2

#: seconds between lines of progress
_LINE_EVERY_S = 5.0

#: seconds between lines that say that the process still runs: one face with thousands of holes takes minutes; chosen
_STILL_EVERY_S = 30.0

#: finest mesh [mm]; finer ones exceed every sensor, and single precision for a part of a metre
FINEST_MM = 1e-4

#: most triangles of a part without a sensor: 85 MB of files, and a minute; chosen
MOST_TRIANGLES = 1_000_000

#: most time of the process [s]: some ten times what the most triangles take; chosen
_SECONDS = 1800
_INSTALL = 'pip install "cadquery-ocp-novtk<8" (or "mitsim[step]"), or save the part as STL'
_MESHES = "an STL, OBJ, PLY, OFF, 3MF or glTF file"


@dataclass(frozen=True)
class Fineness:
    """How fine a mesh is: the chord error [mm] of its faces."""

    chord_mm: float = CHORD_MM  # of faces that a task can measure
    others_mm: float | None = None  # of tori and free forms; None for the same
    #: triangles of a file, beyond which the largest faces become coarser, measured ones first
    most: int = MOST_TRIANGLES
    #: chord error [mm] of a sphere or cylinder per standard uncertainty of its fitted radius, for one point of noise 1
    #: on each mm^2. Faces of few points have up to ``others_mm``; None: all have ``chord_mm``
    fitted_mm2: float | None = None


@dataclass(frozen=True)
class Drawn:
    """Faces of a STEP file, remarks about their processing, whether they bound closed bodies, and the file's text."""

    faces: list[Face]
    remarks: list[str]
    closed: bool
    text: StepText


def step_installed() -> bool:
    """Return whether STEP files can be read in this installation."""
    return importlib.util.find_spec("OCP") is not None


_DEFAULT = Fineness()


def read_step(path: str | Path, fineness: Fineness = _DEFAULT, units: str | None = None) -> Drawn:
    """Read the faces of a STEP file, in mm, meshed as finely as asked, and report the progress.

    ``units`` (``mm``, ``m``, ``inch``) of a file that does not state its own; mm if None. Raises InputError if the file
    cannot be read, contains no faces, states another unit than ``units``, or the required library is not installed.
    """
    path = Path(path)
    if not step_installed():
        raise InputError(path, "", "a STEP file, which needs OpenCASCADE", _MESHES, _INSTALL)
    text = read_step_text(path)
    check_placements(path, text)
    scale, unit_remarks = _scale(path, text, units)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "faces.npz"
        command = [
            *(sys.executable, "-P", "-m", step_worker.__name__),
            str(path),
            str(out),
            repr(_requested(fineness.chord_mm)),
            repr(BEND),
            repr(scale),
            repr(_requested(fineness.others_mm or fineness.chord_mm)),
            repr(fineness.most),
            repr((fineness.fitted_mm2 or 0.0) / 2),  # as the others, for what OpenCASCADE exceeds
        ]
        done = run_worker(command, path, lambda size: check_size(path, size * scale, stated_units(text)))
        if "ImportError" in done.stderr or "ModuleNotFoundError" in done.stderr:
            found = "a STEP file, and an unsupported version of OpenCASCADE"
            raise InputError(path, "", found, _MESHES, _INSTALL)
        if done.returncode != 0 or not out.exists():
            raise InputError(path, "", "a file that OpenCASCADE cannot read", "a STEP file (AP203, AP214 or AP242)")
        with np.load(out) as data:
            read = json.loads(data["text"].tobytes())
            arrays = {key: data[key] for key in ("vertices", "normals", "triangles")}
    names = _names(text)
    faces, vertex, triangle = [], 0, 0
    for record in read["faces"]:
        points, corners = record["counts"]
        here, there = slice(vertex, vertex + points), slice(triangle, triangle + corners)
        vertex, triangle = vertex + points, triangle + corners
        face = _face(record, arrays["vertices"][here], arrays["normals"][here], arrays["triangles"][there])
        faces.append(replace(face, drawn_name=names.get(record["entity"], "")))
    joined = join_faces(faces)
    remarks = unit_remarks
    if len(joined) < len(faces):
        remarks.append(f"{len(faces)} faces in the file, {len(joined)} after those of one surface were joined")
    if read["lost"]:
        remarks.append(f"{read['lost']} faces could not be meshed and are left out")
    bodies = len({face.body for face in faces})
    if bodies > 1:
        remarks.append(f"{bodies} bodies, each with its own faces")
    if read["chord_mm"] > 1.01 * _requested(fineness.chord_mm):
        coarse = 2 * read["chord_mm"]
        remarks.append(
            f"the largest curved faces are meshed to {coarse:.2g} mm instead of {fineness.chord_mm:.2g} mm, which would"
            f" take over {fineness.most:,} triangles, or too long for a part of over 10 m"
            + (f"; --chord allows {MOST_TRIANGLES:,}" if fineness.most < MOST_TRIANGLES else "")
        )
    closed = all(record["closed"] for record in read["faces"])
    if not closed:
        remarks.append("the file has surfaces that bound no solid: mitsim check reports visible backs")
    return Drawn(joined, remarks, closed, text)


def _requested(chord_mm: float) -> float:
    """Return the chord to request [mm]: OpenCASCADE exceeds it by a factor of up to 2."""
    return max(chord_mm / 2, FINEST_MM)


def run_worker(command: list[str], path: Path, check: Callable[[float], list[str]]) -> subprocess.CompletedProcess[str]:
    """Run the process that reads ``path``, check the size of the part before it is meshed, and report the progress.

    Raises InputError if it takes more than half an hour, or as ``check``.
    """
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, errors="replace", env=_environment()
        ) as process,
    ):
        over, ended = threading.Event(), threading.Event()

        def stop() -> None:
            over.set()
            process.kill()

        def say_still() -> None:
            start = time.monotonic()
            while not ended.wait(_STILL_EVERY_S):
                taken = time.monotonic() - start
                say_progress(f"{path.name}: still meshing after {taken:.0f} s; it ends after {_SECONDS / 60:.0f} min")

        limit = threading.Timer(_SECONDS, stop)
        limit.start()
        threading.Thread(target=say_still, daemon=True).start()
        try:
            assert process.stdout is not None
            _report(process.stdout, path, check)
            code = process.wait()
        finally:
            limit.cancel()
            ended.set()
            process.kill()
        if over.is_set():
            hint = "check its unit and size, give a larger --chord, or leave out details"
            raise InputError(path, "", f"a part that cannot be meshed within {_SECONDS // 60} minutes", "others", hint)
        errors.seek(0)
        return subprocess.CompletedProcess(command, code, "", errors.read())


def _environment() -> dict[str, str]:
    """Return the environment of a process that finds this package wherever it is started."""
    package = str(Path(step_worker.__file__).parents[3])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def _report(lines: Iterable[str], path: Path, check: Callable[[float], list[str]]) -> None:
    """Check the size, and report how many triangles are made, and the time that the others will take."""
    start = last = time.monotonic()
    say_progress(f"{path.name}: reading and meshing its faces")
    for line in lines:
        if line.startswith(step_mesh.SPANS):
            for remark in check(float(line.removeprefix(step_mesh.SPANS))):
                say_progress(f"{path.name}: {remark}")
        if not line.startswith(step_mesh.TOLD):
            continue
        made, total = map(float, line.removeprefix(step_mesh.TOLD).split())
        now = time.monotonic()
        if now - last >= _LINE_EVERY_S and made < total:
            left = (now - start) / made * (total - made)
            say_progress(f"{path.name}: {made:,.0f} of about {total:,.0f} triangles, {left:.0f} s left")
            last = now


def _scale(path: Path, text: StepText, units: str | None) -> tuple[float, list[str]]:
    """Return the size [mm] of the unit that OpenCASCADE takes for mm, 1 for a file with its own, and a remark.

    OpenCASCADE converts the lengths of each context that states a unit, and takes all others as mm.
    """
    stated = step_units(text)
    if not stated:
        if units is None:
            return 1.0, [unit_assumed(path.name)]
        return LENGTHS_MM[units], []
    if units is not None and not all(math.isclose(length, LENGTHS_MM[units]) for length in stated):
        words = stated_units(text)
        hint = "leave out --units: the file's dimensions and tolerances have units of their own, too"
        raise InputError("--units", "", repr(units), f"{words}, the unit that {path.name} states", hint)
    return 1.0, []


def _names(text: StepText) -> dict[int, str]:
    """Return the names of the faces by the number of their entity."""
    names = {}
    for entity in text.all("ADVANCED_FACE", "FACE_SURFACE"):
        values = entity.of("ADVANCED_FACE", "FACE_SURFACE")
        if values and isinstance(values[0], str):
            names[entity.number] = values[0].strip()
    return names


def _face(record: dict[str, Any], vertices: Floats, normals: Floats, triangles: Ints) -> Face:
    """Make one face from the worker's data."""
    surface = _surface(record, vertices, triangles)
    convex, deviation, sag = True, float("nan"), float("nan")
    if surface is not None:
        facing = np.einsum("ij,ij->i", outward_normals(surface, vertices), normals).sum()
        if isinstance(surface, Plane):
            surface = Plane(surface.point, surface.normal if facing > 0 else -surface.normal)
        else:
            convex = bool(facing > 0)
        deviation, sag = mesh_distances(surface, vertices, triangles)
    colour = record["colour"]
    return Face(
        "",
        vertices,
        triangles,
        surface,
        convex,
        deviation,
        sag,
        normals,
        record["part"],
        record["body"],
        None if colour is None else (colour[0], colour[1], colour[2]),
        (record["entity"],) if record["entity"] else (),
        "",
        frozenset(record["edges"]),
    )


def _surface(record: dict[str, Any], vertices: Floats, triangles: Ints) -> Surface | None:
    """Return the surface in a task's terms: points on the face's own section of an axis."""
    if record["kind"] == "freeform":
        return None
    point, axis = np.array(record["point"]), np.array(record["axis"])
    axis = axis / np.linalg.norm(axis)
    if record["kind"] == "plane":
        return centred(Plane(point, axis), vertices, triangles)
    if record["kind"] == "sphere":
        return Sphere(point, record["radius"])
    if record["kind"] == "cone":
        half = record["half_angle"]
        if half < 0:
            axis, half = -axis, -half
        along = (vertices - point) @ axis
        wide = float(along.max())
        return Cone(point + wide * axis, axis, record["radius"] + wide * float(np.tan(half)), half)
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    if record["kind"] == "torus":
        return Torus(point, axis, record["radius"], record["tube"])
    return Cylinder(point + float(((vertices - point) @ axis).min()) * axis, axis, record["radius"])
