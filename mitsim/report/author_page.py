"""Make the page for authoring a part: click a face, name it, set its finish and measurements, save the files.

Signal chain: scene XML and shapes, task, findings of ``mitsim check`` -> one self-contained page with the canvas of
:mod:`mitsim.report.view_sphere`, a colour and a number for each face -> the scene's XML, ``task.toml`` and
``study.toml`` as texts. The page offers them as downloads, or sends them to the command that serves it
(:mod:`mitsim.report.author_server`).
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from characterisation.tasks.definitions import DEFINITIONS
from mitsim.report.templates import joined_script, rendered, script_content
from mitsim.report.view_clouds import box_around, packed, packed_normals, smoothly_shaded
from mitsim.report.view_data import COLOURS, as_json
from mitsim.scene.authoring.check import Authored
from mitsim.scene.authoring.finding import SceneFinding
from mitsim.scene.authoring.general_tolerances import ANGLES, BROKEN_EDGES, LINEAR, ZONES
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.triangles import triangles_by_shape
from mitsim.scene.surface.metals import CONSTANTS
from mitsim.scene.surface.processes import PROCESSES

#: in the order in which they are joined to one script
SCRIPTS = ("view_scene.js", "author_geometry.js", "author_files.js", "author_page.js")

#: triangles of all faces together; enough for display
MOST_TRIANGLES = 150_000

#: largest number of faces on a page
MOST_FACES = 2000


def author_page(about: Authored, served: str = "") -> str:
    """Return the page as HTML.

    ``served`` is the token of the command that accepts saved files; it is empty for a page that stands alone. Raises
    InputError if the scene was not read from a file, or has more than :data:`MOST_FACES` shapes.
    """
    data = page_data(about, served)
    content = {"data": as_json(data), "title": data["name"], "served": bool(served)}
    content |= {"metals": list(CONSTANTS), "processes": list(PROCESSES)}
    return rendered("author_page.html.j2", content | script_content(joined_script(SCRIPTS)))


def page_data(about: Authored, served: str) -> dict[str, Any]:
    """Return the data for the script."""
    path = Path(about.scene.where)
    if not path.is_file():
        raise InputError(path, "", "a scene that was not read from a file", "a scene read from a scene XML")
    if len(about.facts.shapes) > MOST_FACES:
        raise InputError(path, "", f"{len(about.facts.shapes)} shapes", f"at most {MOST_FACES} on a page")
    table = tomllib.loads(about.task_path.read_text(encoding="utf-8")) if about.task_path else {}
    name = about.task_path.name if about.task_path else "task.toml"
    study = path.parent / "study.toml"
    return {
        "name": path.stem,
        "xml": path.read_text(encoding="utf-8"),
        "scene_file": path.name,
        "task_file": name,
        "study_there": study.exists(),
        "sensor": about.sensor.name,
        "features": table.get("features", {}),
        "measurements": table.get("measurements", {}),
        "decision": table.get("decision"),
        "kinds": {kind: _definition(kind) for kind in DEFINITIONS},
        "processes": {key: list(process.usual) for key, process in PROCESSES.items()},
        "metals": list(CONSTANTS),
        "known": characterised(about.sensor.name),
        "general": {"linear": LINEAR, "broken_edges": BROKEN_EDGES, "angles": ANGLES, "zones": ZONES},
        "colours": COLOURS,
        "served": served,
        "findings": findings_data(about.findings),
        "solid": solid(about.scene, {shape.name for shape in about.facts.shapes if np.isnan(shape.area)}),
    }


def findings_data(findings: Sequence[SceneFinding]) -> list[dict[str, str]]:
    """Return the findings for the script."""
    return [asdict(finding) for finding in findings]


def _definition(kind: Any) -> dict[str, Any]:
    definition = DEFINITIONS[kind]
    facts = {name: getattr(definition, name) for name in ("kinds", "unit", "datums", "many", "zone")}
    return facts | {"outline": "outline" in definition.needs}


def characterised(sensor: str) -> dict[str, list[float]] | None:
    """Return the finishes in the sensor's shipped map with their range of Ra [um]; None without a shipped map."""
    path = shipped_maps().get(sensor)
    if path is None:
        return None
    out: dict[str, list[float]] = {}
    for finish, roughness in PerformanceMap.load(path).samples:
        low, high = out.get(finish, [roughness, roughness])
        out[finish] = [min(low, roughness), max(high, roughness)]
    return {name: [] if np.isnan(ends).any() else ends for name, ends in out.items()}


def solid(scene: Scene, without_area: Collection[str] = ()) -> dict[str, Any]:
    """Return all faces for the canvas: base64 of ``vertices`` and ``normals`` (planes x, y, z), ``triangles`` (uint32).

    ``faces`` holds for each shape its name, its number of triangles, a point on the surface near its centre, its size
    [mm] and its area; null for the shapes ``without_area``, which are drawn as their bounding boxes.
    """
    there = triangles_by_shape(scene)
    every = [there.get(name, np.empty((0, 3, 3))) for name in scene.names]
    box = box_around([corners.reshape(-1, 3) for corners in every])
    most = fair_share([len(corners) for corners in every], MOST_TRIANGLES)
    vertices, normals, triangles, faces, start = [], [], [], [], 0
    for name, corners in zip(scene.names, every, strict=True):
        mesh = _shaded(corners, most)
        vertices.append(np.asarray(mesh.vertices))
        normals.append(np.asarray(mesh.vertex_normals))
        triangles.append(np.asarray(mesh.faces) + start)
        start += len(mesh.vertices)
        unknown = {"area": None} if name in without_area else {}
        faces.append({"name": name, "triangles": len(mesh.faces)} | _measures(corners) | unknown)
    return {
        "box": {"origin": box.origin.tolist(), "step": box.step},
        "faces": faces,
        "vertices": packed(box.steps(np.concatenate([np.empty((0, 3)), *vertices])).T.tobytes()),
        "normals": packed_normals(np.concatenate([np.empty((0, 3)), *normals])),
        "triangles": packed(np.concatenate([np.empty((0, 3), int), *triangles]).astype("<u4").tobytes()),
    }


def fair_share(counts: Sequence[int], most: int) -> int:
    """Return the largest number of triangles for one shape, so that all shapes together have at most ``most``.

    Small shapes keep all triangles. Decimation harms planes with holes most, and these have few triangles.
    """
    left, share = most, most
    for number, count in enumerate(sorted(counts)):
        share = left // (len(counts) - number)
        if count > share:
            return max(share, 1)
        left -= count
    return most


def _shaded(corners: np.ndarray, most: int) -> trimesh.Trimesh:
    if not len(corners):
        return trimesh.Trimesh(np.empty((0, 3)), np.empty((0, 3), int))
    merged = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=True)
    return smoothly_shaded(merged, most)


def _measures(corners: np.ndarray) -> dict[str, Any]:
    """Return a point on the surface near the centre, the box and the area of triangles (n, 3, 3)."""
    if not len(corners):
        return {"anchor": None, "size": [0.0, 0.0, 0.0], "area": 0.0}
    areas = trimesh.triangles.area(corners)  # type: ignore[no-untyped-call]
    middles = corners.mean(axis=1)
    middle = areas @ middles / max(float(areas.sum()), 1e-12)
    anchor = middles[int(np.linalg.norm(middles - middle, axis=1).argmin())]
    size = np.ptp(corners.reshape(-1, 3), axis=0)
    return {
        "anchor": np.round(anchor, 3).tolist(),
        "size": np.round(size, 3).tolist(),
        "area": round(float(areas.sum()), 2),
    }
