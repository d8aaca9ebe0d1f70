"""Collect facts about the shapes of a scene: material, size, mesh, and the side that faces outward.

Signal chain: scene XML -> Mitsuba's shapes -> triangles (:mod:`mitsim.scene.mesh_facts`), areas, boxes and materials;
rays from all directions (:mod:`mitsim.scene.first_hits`) -> counts of hits on the front and back of each shape.
:mod:`mitsim.scene.authoring.check` evaluates the facts.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.orientations import sphere_directions
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.scene.backend import mi
from mitsim.scene.first_hits import first_hits
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.materials import Finish
from mitsim.scene.mesh_facts import MeshFacts, mesh_facts
from mitsim.scene.xml_check import checked_trees

#: points on each shape
_SAMPLES = 2048

#: rays along one side of the square grid of each direction
_ROW = 96

#: spacing of the grid in which vertices are merged, as a share of the size of the scene
_MERGE = 1e-6


#: least angle over which the intensity of a spot falls [rad], so that its flux is finite; chosen
_LEAST_FALL = 1e-6


@dataclass(frozen=True)
class ShapeFacts:
    """Facts about one shape of a scene.

    - ``name`` in the scene; ``named``: whether its author gave it an id.
    - ``kind``, ``bsdf``: types of the shape and its BSDF in the XML, also if the BSDF was replaced by a finish.
    - ``finish``; None for a stock BSDF.
    - ``alpha``: width of the lobe along u and v in Beckmann's sense [1]; ``alpha_factor``: its one-sigma factor [1].
      NaN if there is none. ``provenance``: source of alpha, in words.
    - ``lay``: direction of the machining marks.
    - ``area`` [mm^2]; NaN if Mitsuba does not compute it, as for an instance or a curve.
    - ``bounds`` (2, 3): corners of the bounding box [mm], world frame.
    - ``delta``: whether it only reflects as a mirror or refracts; ``two_sided``: whether its back reflects too;
      ``emitter``: whether it emits light.
    - ``mesh``; None for a shape that is no mesh.
    - ``points``, ``normals`` (n, 3): points spread evenly over it [mm], world frame, and unit normals on the reflecting
      side.
    - ``front_hits``, ``back_hits``: number of rays from all directions that meet its front and its back first. If no
      ray meets it: number of rays that leave the scene from its front and its back.
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
    emitter: bool
    mesh: MeshFacts | None
    points: Floats
    normals: Floats
    front_hits: int
    back_hits: int


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a scene."""

    shapes: tuple[ShapeFacts, ...]  # of the scene
    bounds: Floats  # (2, 3) corners of the bounding box [mm], world frame
    merged_mesh: MeshFacts | None  # all meshes as one, without emitters; None if there are none
    #: kind and flux [W] of each. The flux is NaN for an emitter without a position (sky, directional light)
    emitters: tuple[tuple[str, float], ...]


def inspect(scene: Scene) -> SceneFacts:
    """Return all facts about a loaded scene."""
    types = _types_in_xml(Path(scene.where))
    front_hits, back_hits = _count_first_hits(scene)
    size = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))
    rows = zip(scene.shapes, scene.names, scene.finishes, front_hits.tolist(), back_hits.tolist(), strict=True)
    shapes = tuple(_count_escaping_rays(scene, _facts(*row, types, size * _MERGE), size) for row in rows)
    return SceneFacts(shapes, scene.bounds, _merged_mesh(shapes, size * _MERGE), _emitters(scene))


def shape_facts(scene: Scene, names: Collection[str]) -> tuple[ShapeFacts, ...]:
    """Return the facts about the shapes of these names, without hits of rays."""
    types = _types_in_xml(Path(scene.where))
    size = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))
    rows = zip(scene.shapes, scene.names, scene.finishes, strict=True)
    return tuple(_facts(*row, 0, 0, types, size * _MERGE) for row in rows if row[1] in names)


def _facts(
    shape: Any,
    name: str,
    finish: Finish | None,
    front_hits: int,
    back_hits: int,
    types: dict[str, tuple[str, str]],
    merge: float,
) -> ShapeFacts:
    """Collect the facts about one shape; ``types`` are those of :func:`_types_in_xml`."""
    bsdf = shape.bsdf()
    kind, plugin = types.get(shape.id(), (shape.class_name().lower(), bsdf.class_name()))
    flags = int(bsdf.flags())
    smooth = int(mi.BSDFFlags.Diffuse) | int(mi.BSDFFlags.Glossy)
    alpha, factor, provenance, lay = _roughness(finish, bsdf)
    points, normals = _points_on(shape)
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
        area=_area(shape),
        bounds=bounds_of(shape),
        delta=bool(flags & int(mi.BSDFFlags.Delta)) and not flags & smooth,
        two_sided=bool(flags & int(mi.BSDFFlags.BackSide)),
        emitter=bool(shape.is_emitter()),
        mesh=_mesh(shape, merge),
        points=points,
        normals=normals,
        front_hits=front_hits,
        back_hits=back_hits,
    )


def _roughness(finish: Finish | None, bsdf: Any) -> tuple[tuple[float, float], float, str, str]:
    """Return alpha (u, v), its one-sigma factor, its source and the lay."""
    if finish is not None:
        scatter = finish.scatter
        if scatter is None:
            return (np.nan, np.nan), np.nan, "", "none"
        return (scatter.alpha_u, scatter.alpha_v), scatter.alpha_factor, scatter.provenance, scatter.lay
    values = mi.traverse(bsdf)
    alphas = [
        float(np.ravel(values[key])[0])
        for key in ("alpha_u.value", "alpha_v.value", "alpha.value", "alpha")
        if key in values.keys()  # noqa: SIM118 - not a dict
    ]
    if not alphas:
        return (np.nan, np.nan), np.nan, "", "none"
    return (alphas[0], alphas[min(1, len(alphas) - 1)]), np.nan, "written in the scene", "none"


def _area(shape: Any) -> float:
    """Return the area of a shape [mm^2]; NaN if Mitsuba does not compute it."""
    try:
        return float(np.ravel(shape.surface_area())[0])
    except RuntimeError:
        return float("nan")


def _points_on(shape: Any) -> tuple[Floats, Floats]:
    """Return points and normals (n, 3) even over a shape, by Roberts's R2 sequence (2018); none if not sampled."""
    steps = np.arange(1, _SAMPLES + 1)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
    square = (0.5 + steps).astype(np.float64) % 1.0
    try:
        sample = shape.sample_position(0.0, mi.Point2f(square.astype(np.float32).T))
    except RuntimeError:
        return np.empty((0, 3)), np.empty((0, 3))
    points = np.array(sample.p, float).T
    return points, np.broadcast_to(np.array(sample.n, float).T, points.shape)  # a disk returns one normal


def _mesh(shape: Any, merge: float) -> MeshFacts | None:
    if not shape.is_mesh():
        return None
    vertices = np.array(shape.vertex_positions_buffer(), float).reshape(-1, 3)
    triangles = np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)
    if shape.has_flipped_normals():
        triangles = triangles[:, ::-1]
    return mesh_facts(vertices, triangles, merge, bool(shape.has_vertex_texcoords()))


def _merged_mesh(shapes: tuple[ShapeFacts, ...], merge: float) -> MeshFacts | None:
    """Merge all meshes, because a part that is divided into faces is closed only as a whole."""
    meshes = [shape.mesh for shape in shapes if shape.mesh is not None and not shape.emitter]
    if not meshes:
        return None
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])[:-1]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    triangles = np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)])
    return mesh_facts(vertices, triangles, 10 * merge)


def _count_first_hits(scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return how many rays meet the front and the back of each shape first, (shapes,) each.

    Parallel rays arrive from 42 directions around the scene, on a square grid for each direction.
    """
    bounds = bounds_of(scene.mitsuba)  # with lamps
    radius = 0.51 * float(np.linalg.norm(bounds[1] - bounds[0]))
    steps = (np.arange(_ROW) + 0.5) / _ROW * 2 - 1
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * radius
    origins, directions = [], []
    for direction in sphere_directions(1):
        axis = np.eye(3)[np.argmin(np.abs(direction))]
        first = np.cross(direction, axis)
        first /= np.linalg.norm(first)
        offsets = grid @ np.stack([first, np.cross(direction, first)])
        origins.append(bounds.mean(axis=0) + 2 * radius * direction + offsets)
        directions.append(np.broadcast_to(-direction, offsets.shape))
    hits = first_hits(scene.mitsuba, np.concatenate(origins), np.concatenate(directions))
    count = len(scene.names)
    front_hits = np.bincount(hits.shape[hits.front], minlength=count)
    back_hits = np.bincount(hits.shape[(hits.shape >= 0) & ~hits.front], minlength=count)
    return front_hits, back_hits


def _count_escaping_rays(scene: Scene, shape: ShapeFacts, size: float) -> ShapeFacts:
    """Count the rays that leave the scene from a shape that no ray from outside met, such as the bottom of a bore.

    Returns the facts with these counts in place of ``front_hits`` and ``back_hits``, or unchanged.
    """
    if shape.front_hits + shape.back_hits or not len(shape.points):
        return shape
    points, normals = shape.points[:: _SAMPLES // 64], shape.normals[:: _SAMPLES // 64]
    directions = np.vstack(
        [sphere_directions(2), normals.mean(axis=0) / max(np.linalg.norm(normals.mean(axis=0)), 1e-9)]
    )
    side = np.sign(normals @ directions.T)
    origins = points[:, None] + 1e-5 * size * side[..., None] * normals[:, None]
    met = first_hits(scene.mitsuba, origins, np.broadcast_to(directions, origins.shape)).shape
    escaped = met.reshape(side.shape) < 0
    return replace(shape, front_hits=int((escaped & (side > 0)).sum()), back_hits=int((escaped & (side < 0)).sum()))


def _emitters(scene: Scene) -> tuple[tuple[str, float], ...]:
    """Return the kind and flux [W] of each emitter.

    A surface of area A and radiance L emits pi L A, a point of intensity I emits 4 pi I. A spot whose intensity falls
    linearly from I at the angle b to 0 at c emits 2 pi I (1 - (sin c - sin b) / (c - b)).
    """
    out = []
    for shape in scene.shapes:
        if shape.is_emitter():
            radiance = _value(shape.emitter(), "radiance.value")
            out.append(("area", np.pi * radiance * _area(shape)))
    for emitter in scene.mitsuba.emitters():
        if not emitter.flags() & int(mi.EmitterFlags.Surface):
            solid_angle = 4 * np.pi
            if emitter.class_name() == "SpotLight":
                beam, cutoff = (np.radians(_value(emitter, key)) for key in ("beam_width", "cutoff_angle"))
                beam = min(beam, cutoff - _LEAST_FALL)
                solid_angle = 2 * np.pi * (1 - (np.sin(cutoff) - np.sin(beam)) / (cutoff - beam))
            out.append((emitter.class_name(), solid_angle * _value(emitter, "intensity.value")))
    return tuple(out)


def _value(parent: Any, key: str) -> float:
    values = mi.traverse(parent)
    return float(np.ravel(values[key])[0]) if key in values.keys() else np.nan  # noqa: SIM118 - not a dict


def _types_in_xml(path: Path) -> dict[str, tuple[str, str]]:
    """Return the types of each named shape and of its BSDF in the XML, by the id of the shape."""
    try:
        every = [element for root in checked_trees(path) for element in root.iter()]
    except InputError:
        return {}  # the scene was not loaded from a file
    types = {str(e.get("id")): str(e.get("type")) for e in every if e.tag == "bsdf"}
    out = {}
    for shape in (e for e in every if e.tag == "shape"):
        child = shape.find("bsdf")
        references = [types[str(r.get("id"))] for r in shape.iter("ref") if r.get("id") in types]
        bsdf = (
            str(child.get("type")) if child is not None else references[0] if references else "diffuse (Mitsuba's own)"
        )
        if shape.get("type") == "instance":
            bsdf = "as in its group"
        out[str(shape.get("id"))] = (str(shape.get("type")), bsdf)
    return out
