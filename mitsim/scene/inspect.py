"""Facts about a scene's shapes: their material, their size, and the side that faces outward.

Signal chain: scene XML -> Mitsuba's shapes -> triangles (:mod:`mitsim.scene.mesh_facts`), areas, boxes, material of
each; rays from all around (:mod:`mitsim.scene.first_hits`) -> whether they meet its front or its back.
:mod:`mitsim.authoring.check` judges the facts.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.orientations import sphere_directions
from mitsim.scene.backend import mi
from mitsim.scene.first_hits import trace
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.materials import Finish
from mitsim.scene.mesh_facts import MeshFacts, mesh_facts

Floats = NDArray[np.float64]

#: points spread over each shape, and rays from each direction all around
_SAMPLES, _ROW = 2048, 96

#: vertices nearer than this share of the scene's size are one
_MERGE = 1e-6


@dataclass(frozen=True)
class ShapeFacts:
    """One shape of a scene.

    ``named`` whether its author gave it an id; ``kind`` and ``bsdf`` the types in the XML (of the BSDF also where a
    finish was made of it); ``finish`` None for a stock BSDF; ``alpha`` (u, v) in Beckmann's sense, NaN where there is
    none, ``alpha_factor`` its one-sigma factor (NaN if not known) and ``provenance`` where it comes from; ``lay`` of
    the marks; ``area`` [mm^2]; ``bounds`` (2, 3) [mm]; ``delta`` whether it only mirrors or refracts; ``two_sided``
    whether its back reflects too; ``lamp`` whether it shines; ``mesh`` its triangles, None for a stock surface;
    ``points``, ``normals`` (n, 3) spread over it, the normals on the reflecting side; ``fronts``, ``backs`` how many
    rays from all around meet its front and back first, or, where none does, leave the scene from there.
    """

    name: str
    named: bool
    kind: str
    bsdf: str
    finish: Finish | None
    alpha: tuple[float, float]
    alpha_factor: float
    provenance: str
    lay: str
    area: float
    bounds: Floats
    delta: bool
    two_sided: bool
    lamp: bool
    mesh: MeshFacts | None
    points: Floats
    normals: Floats
    fronts: int
    backs: int


@dataclass(frozen=True)
class SceneFacts:
    """All shapes; ``bounds`` (2, 3) [mm] of the scene; ``together`` all meshes as one; ``emitters`` kind and flux.

    The flux [W] is NaN for an emitter without a place (a sky, a distant lamp).
    """

    shapes: tuple[ShapeFacts, ...]
    bounds: Floats
    together: MeshFacts | None
    emitters: tuple[tuple[str, float], ...]


def inspect(scene: Scene) -> SceneFacts:
    """All facts about a scene that has been loaded."""
    written = _written(Path(scene.where))
    fronts, backs = _from_all_around(scene)
    size = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))
    rows = zip(scene.shapes, scene.names, scene.finishes, fronts.tolist(), backs.tolist(), strict=True)
    shapes = tuple(_way_out(scene, _facts(*row, written, size * _MERGE), size) for row in rows)
    return SceneFacts(shapes, scene.bounds, _together(shapes, size * _MERGE), _emitters(scene))


def _facts(
    shape: Any,
    name: str,
    finish: Finish | None,
    fronts: int,
    backs: int,
    written: dict[str, tuple[str, str]],
    merge: float,
) -> ShapeFacts:
    bsdf = shape.bsdf()
    kind, plugin = written.get(shape.id(), (shape.class_name().lower(), bsdf.class_name()))
    flags = int(bsdf.flags())
    smooth = int(mi.BSDFFlags.Diffuse) | int(mi.BSDFFlags.Glossy)
    alpha, factor, provenance, lay = _roughness(finish, bsdf)
    points, normals = _spread(shape)
    return ShapeFacts(
        name=name,
        named=bool(shape.id()),
        kind=kind,
        bsdf=plugin,
        finish=finish,
        alpha=alpha,
        alpha_factor=factor,
        provenance=provenance,
        lay=lay,
        area=float(np.ravel(shape.surface_area())[0]),
        bounds=bounds_of(shape),
        delta=bool(flags & int(mi.BSDFFlags.Delta)) and not flags & smooth,
        two_sided=bool(flags & int(mi.BSDFFlags.BackSide)),
        lamp=bool(shape.is_emitter()),
        mesh=_mesh(shape, merge),
        points=points,
        normals=normals,
        fronts=fronts,
        backs=backs,
    )


def _roughness(finish: Finish | None, bsdf: Any) -> tuple[tuple[float, float], float, str, str]:
    """Alpha (u, v), its one-sigma factor, where it comes from, and the lay."""
    if finish is not None:
        scatter = finish.scatter
        if scatter is None:
            return (np.nan, np.nan), np.nan, "", "none"
        return (scatter.alpha_u, scatter.alpha_v), scatter.alpha_factor, scatter.provenance, scatter.lay
    values = mi.traverse(bsdf)
    found = [
        float(np.ravel(values[key])[0])
        for key in ("alpha_u.value", "alpha_v.value", "alpha.value", "alpha")
        if key in values.keys()  # noqa: SIM118 - not a dict
    ]
    if not found:
        return (np.nan, np.nan), np.nan, "", "none"
    return (found[0], found[min(1, len(found) - 1)]), np.nan, "written in the scene", "none"


def _spread(shape: Any) -> tuple[Floats, Floats]:
    """Points and normals spread evenly over a shape (the R2 sequence); none on shapes that cannot be sampled."""
    steps = np.arange(1, _SAMPLES + 1)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
    square = (0.5 + steps).astype(np.float64) % 1.0
    try:
        sample = shape.sample_position(0.0, mi.Point2f(square.astype(np.float32).T))
    except RuntimeError:
        return np.empty((0, 3)), np.empty((0, 3))
    points = np.array(sample.p, float).T
    return points, np.broadcast_to(np.array(sample.n, float).T, points.shape)  # of a disk there is one normal


def _mesh(shape: Any, merge: float) -> MeshFacts | None:
    if not shape.is_mesh():
        return None
    vertices = np.array(shape.vertex_positions_buffer(), float).reshape(-1, 3)
    triangles = np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)
    if shape.has_flipped_normals():
        triangles = triangles[:, ::-1]
    smooth = bool(shape.has_vertex_normals()) and not shape.has_face_normals()
    return mesh_facts(vertices, triangles, merge, bool(shape.has_vertex_texcoords()), smooth)


def _together(shapes: tuple[ShapeFacts, ...], merge: float) -> MeshFacts | None:
    """All meshes as one, since a part cut into its faces is closed only as a whole."""
    meshes = [one.mesh for one in shapes if one.mesh is not None and not one.lamp]
    if not meshes:
        return None
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])[:-1]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    triangles = np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)])
    return mesh_facts(vertices, triangles, 10 * merge)


def _from_all_around(scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many rays meet the front and the back of each shape first, from 42 directions all around the scene."""
    radius = 0.51 * float(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))
    steps = (np.arange(_ROW) + 0.5) / _ROW * 2 - 1
    across = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * radius
    origins, directions = [], []
    for direction in sphere_directions(1):
        helper = np.eye(3)[np.argmin(np.abs(direction))]
        first = np.cross(direction, helper)
        first /= np.linalg.norm(first)
        plane = across @ np.stack([first, np.cross(direction, first)])
        origins.append(scene.centre + 2 * radius * direction + plane)
        directions.append(np.broadcast_to(-direction, plane.shape))
    hits = trace(scene, np.concatenate(origins), np.concatenate(directions))
    count = len(scene.names)
    fronts = np.bincount(hits.shape[hits.front], minlength=count)
    backs = np.bincount(hits.shape[(hits.shape >= 0) & ~hits.front], minlength=count)
    return fronts, backs


def _way_out(scene: Scene, shape: ShapeFacts, size: float) -> ShapeFacts:
    """Of a shape that rays from all around missed, as at the bottom of a bore: how many of its own leave the scene."""
    if shape.fronts + shape.backs or not len(shape.points):
        return shape
    points, normals = shape.points[:: _SAMPLES // 64], shape.normals[:: _SAMPLES // 64]
    ways = np.vstack([sphere_directions(2), normals.mean(axis=0) / max(np.linalg.norm(normals.mean(axis=0)), 1e-9)])
    facing = np.sign(normals @ ways.T)
    origins = points[:, None] + 1e-5 * size * facing[..., None] * normals[:, None]
    out = trace(scene, origins, np.broadcast_to(ways, origins.shape)).shape.reshape(facing.shape) < 0
    return replace(shape, fronts=int((out & (facing > 0)).sum()), backs=int((out & (facing < 0)).sum()))


def _emitters(scene: Scene) -> tuple[tuple[str, float], ...]:
    """Kind and flux [W] of every emitter; a lamp with a surface sends pi L A, a point 4 pi I."""
    out = []
    for shape in scene.shapes:
        if shape.is_emitter():
            radiance = _value(shape.emitter(), "radiance.value")
            out.append(("area", np.pi * radiance * float(np.ravel(shape.surface_area())[0])))
    for emitter in scene.mitsuba.emitters():
        if not emitter.flags() & int(mi.EmitterFlags.Surface):
            out.append((emitter.class_name(), 4 * np.pi * _value(emitter, "intensity.value")))
    return tuple(out)


def _value(thing: Any, key: str) -> float:
    values = mi.traverse(thing)
    return float(np.ravel(values[key])[0]) if key in values.keys() else np.nan  # noqa: SIM118 - not a dict


def _written(path: Path) -> dict[str, tuple[str, str]]:
    """Type of each named shape and of its BSDF, as the XML has them."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return {}  # a scene that was not made from a file
    types = {str(e.get("id")): str(e.get("type")) for e in root.iter("bsdf")}
    out = {}
    for shape in root.iter("shape"):
        own = shape.find("bsdf")
        references = [types[str(r.get("id"))] for r in shape.iter("ref") if r.get("id") in types]
        bsdf = str(own.get("type")) if own is not None else references[0] if references else "diffuse (Mitsuba's own)"
        out[str(shape.get("id"))] = (str(shape.get("type")), bsdf)
    return out
