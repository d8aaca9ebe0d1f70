"""Find problems in a scene before it is rendered, and advise on each.

Signal chain: facts about the shapes (:mod:`mitsim.scene.inspect`), what a sensor sees from one pose, the nominal
geometry of a task (:mod:`mitsim.scene.authoring.check_task`) -> findings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mitsim.scene.authoring.check_task import NOMINAL_MM, TaskFeatures, task_findings
from mitsim.scene.authoring.finding import SceneFinding, Severity
from mitsim.scene.inspect import SceneFacts, ShapeFacts
from mitsim.scene.load import Scene
from mitsim.scene.mesh_facts import MeshFacts
from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.visible_surfaces import VisibleSurfaces
from mitsim.sensor.calibration_qualifiers import UNITS_MM
from mitsim.sensor.rig_parameters import eyes
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.sensor.working_volume import depth, field_of_view, in_image, in_working_volume

#: a part of fewer pixels at the middle of the working range probably has another unit
SMALL_PX = 40

#: a border shorter than this share of the shape's diagonal is that of a hole, else that of a face
_HOLE = 0.5

#: share of slivers without area above which they are reported; a fine mesh of a curved face has a few
_SLIVERS = 0.01

#: edges closer than this share of the part's size close one another; chosen
_CLOSED = 1e-4

#: spacing of single-precision lengths at the part above which it is reported [mm]; noise of sensors is 10 um and more
_ROUNDED_MM = 1e-3

#: up to this number of back-side pixels are rays through the seam of two faces
_CRACK_PX = 10

#: shapes whose triangles Mitsuba itself makes
_STOCK = ("rectangle", "disk", "cube", "sphere", "cylinder")

#: units in which a part that looks too small may have been modelled [mm]
_UNITS = {word: UNITS_MM[word] for word in ("inches", "metres")}


@dataclass(frozen=True)
class Authored:
    """A scene with its facts and the findings about it, and the path of its task (None without one)."""

    scene: Scene
    facts: SceneFacts
    sensor: Sensor
    findings: Sequence[SceneFinding]
    task_path: Path | None
    task: TaskFeatures | None


def findings(
    facts: SceneFacts,
    sensor: Sensor,
    pose: Transform,
    visible: VisibleSurfaces,
    posed: bool,
    task: TaskFeatures | None = None,
) -> list[SceneFinding]:
    """Return all findings, the most severe first.

    Parameters
    ----------
    facts, sensor, pose, visible
        About the scene; the sensor, its pose, and what it sees from there.
    posed
        Whether the author chose the pose; then shapes outside the working volume are reported.
    task
        The features to measure, if any.
    """
    measured = set(task.features) if task else set()
    all_findings: list[SceneFinding] = []
    borders = open_borders(facts)
    for number, shape in enumerate(facts.shapes):
        if shape.emitter:
            continue
        all_findings += _named(shape)
        all_findings += _material(shape, shape.name in measured)
        all_findings += _mesh(shape, borders[number])
        all_findings += _facing(shape, number, visible)
        if posed:
            all_findings += _placed(shape, number, sensor, pose, visible)
    all_findings += _whole(facts, sensor, sum(len(border) for border in borders))
    if task:
        all_findings += task_findings(facts, task)
    order = ("error", "warning", "note")
    return sorted(all_findings, key=lambda finding: order.index(finding.severity))


def _named(shape: ShapeFacts) -> Iterator[SceneFinding]:
    if not shape.named:
        yield SceneFinding(
            "warning",
            shape.name,
            f"a {shape.kind} without an id; mitsim chose this name, and it may change",
            f'Write <shape type="{shape.kind}" id="...">: a task names features by id',
        )


def _material(shape: ShapeFacts, measured: bool) -> Iterator[SceneFinding]:
    severity: Severity = "error" if measured else "warning"
    if shape.delta:
        problem = f"a {shape.bsdf} only mirrors or refracts: black under a point-like projector"
        yield SceneFinding(severity, shape.name, problem, "Use machined_metal, or a rough BSDF")
    elif shape.kind == "instance":
        problem = "an instance has no finish of its own, so no performance map covers it"
        advice = "Write the shape itself if it is measured; as it is, it occludes, but has no predicted points"
        yield SceneFinding(severity, shape.name, problem, advice)
    elif shape.finish is None:
        problem = f"the BSDF {shape.bsdf} has no finish, so no performance map covers it"
        advice = "Use machined_metal, gloss_paint, powder_coat or matt_white; as it is, it occludes but gives no points"
        yield SceneFinding(severity, shape.name, problem, advice)
    else:
        name, roughness = shape.finish.name.partition("/")[2], shape.finish.roughness
        process = PROCESSES.get(name)
        if process is not None and (roughness < process.usual[0] or roughness > process.usual[1]):
            advice = (
                f"{name.capitalize()} metal usually has {process.usual[0]:g} to {process.usual[1]:g} um: "
                "check process and unit on the drawing"
            )
            yield SceneFinding("warning", shape.name, f"Ra {roughness:g} um is unusual for {name}", advice)
    u, v = shape.alpha
    if abs(u - v) > 0.01 * (u + v) and shape.mesh is not None and not shape.mesh.texture:
        problem = f"a lay (alpha {u:.3g} along u, {v:.3g} along v) on a mesh without u, v: its direction is arbitrary"
        advice = "Export the mesh with texture coordinates; mitsim part writes them for planes and cylinders"
        yield SceneFinding("warning", shape.name, problem, advice)


def _mesh(shape: ShapeFacts, border: NDArray[np.float64]) -> Iterator[SceneFinding]:
    mesh = shape.mesh
    if mesh is None or shape.kind in _STOCK:
        return
    if mesh.duplicate or mesh.degenerate > _SLIVERS * len(mesh.triangles):
        problem = f"{mesh.degenerate} triangles without area, {mesh.duplicate} duplicates"
        yield SceneFinding("warning", shape.name, problem, "Clean the mesh: mitsim part leaves them out")
    if mesh.nonmanifold_edges:
        yield SceneFinding(
            "warning",
            shape.name,
            f"{mesh.nonmanifold_edges} edges belong to more than two triangles",
            "Remove inner walls, or make one shape of each touching body",
        )
    holes = _holes(mesh, border)
    if holes:
        yield SceneFinding(
            "warning",
            shape.name,
            f"not watertight: {holes} open edges",
            "Close the holes (trimesh.repair.fill_holes), or light passes through them",
        )


def open_borders(facts: SceneFacts) -> list[NDArray[np.float64]]:
    """Return the open edges (k, 2, 3) [mm] of each shape that no other edge closes.

    Edges close one another within :data:`_CLOSED` of the part's size. The faces of a part are meshed separately: their
    edges meet within a CAD program's tolerance, not vertex by vertex.
    """
    borders = [
        np.empty((0, 2, 3)) if shape.mesh is None or shape.emitter else shape.mesh.open_edge_ends
        for shape in facts.shapes
    ]
    every = np.concatenate(borders) if borders else np.empty((0, 2, 3))
    if len(every) < 2:
        return borders
    limit = max(NOMINAL_MM / 5, _CLOSED * float(np.linalg.norm(facts.bounds[1] - facts.bounds[0])))
    still = _apart(every, limit)
    ends = np.cumsum([0, *(len(border) for border in borders)])
    return [border[still[a:b]] for border, a, b in zip(borders, ends, ends[1:], strict=False)]


def _apart(edges: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
    """Return which edges (n, 2, 3) have no other edge within ``limit`` of their middle.

    An edge of length L has a point within the limit only if its middle is within L / 2 + limit. Edges are searched by
    their length, each class up to twice as long as the one before, so that a long edge among short ones is found.
    """
    middles, along = edges.mean(axis=1), edges[:, 1] - edges[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), limit)
    of_length, apart, every = np.frexp(length / limit)[1], np.ones(len(edges), bool), cKDTree(middles)
    for length_class in np.unique(of_length):
        members = np.flatnonzero(of_length == length_class)
        reach = float(length[members].max()) / 2 + limit
        pairs = cKDTree(middles[members]).sparse_distance_matrix(every, reach, output_type="coo_matrix")
        member, other = members[pairs.row], pairs.col
        from_start = middles[other] - edges[member, 0]
        share = np.einsum("ij,ij->i", from_start, along[member]) / np.maximum((along[member] ** 2).sum(-1), 1e-30)
        away = np.linalg.norm(from_start - np.clip(share, 0, 1)[:, None] * along[member], axis=1)
        apart[other[(away <= limit) & (member != other)]] = False
    return apart


def _holes(mesh: MeshFacts, border: NDArray[np.float64]) -> int:
    """Count the open edges that bound a hole, which has a short border; that of an open face surrounds the face."""
    if not len(border):
        return 0
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    _, corner = np.unique(np.round(border.reshape(-1, 3) / (1e-6 * size)), axis=0, return_inverse=True)
    ends = corner.reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(int(ends.max()) + 1,) * 2)
    _, loop = connected_components(graph, directed=False)
    of_edge = loop[ends[:, 0]]
    around = np.bincount(of_edge, np.linalg.norm(border[:, 1] - border[:, 0], axis=1))
    return int((around[of_edge] < _HOLE * size).sum())


def _facing(shape: ShapeFacts, number: int, visible: VisibleSurfaces) -> Iterator[SceneFinding]:
    """Yield findings about faces whose black back side is visible."""
    if shape.two_sided:
        return
    turn = 'Reverse its triangles, or write <boolean name="flip_normals" value="true"/>'
    mesh, mine = shape.mesh, visible.shape == number
    if mesh is not None and mesh.closed and mesh.volume < 0:
        problem = f"inward normals: a closed mesh of {mesh.volume:.4g} mm^3, black from outside"
        yield SceneFinding("error", shape.name, problem, turn)
    elif shape.front_hits + shape.back_hits == 0:
        problem = "visible from nowhere: it lies inside the part, or is very small"
        yield SceneFinding("note", shape.name, problem, "Leave it out if it is not needed")
    elif shape.front_hits < 0.02 * shape.back_hits:
        problem = "inward normals: only its black back is visible, from all directions"
        yield SceneFinding("error", shape.name, problem, turn)
    elif mine.sum() > _CRACK_PX and not visible.front[mine].any():
        problem = "shows only its black back in this view"
        yield SceneFinding("warning", shape.name, problem, f"{turn}; or look from the other side")


def _placed(
    shape: ShapeFacts, number: int, sensor: Sensor, pose: Transform, visible: VisibleSurfaces
) -> Iterator[SceneFinding]:
    """Yield findings about shapes that the chosen pose cannot measure."""
    mine = visible.shape == number
    if not len(shape.points) or (mine.any() and not visible.front[mine].any()):
        return  # another finding reports a visible back
    points, normals = pose.inverse().points(shape.points), pose.inverse().directions(shape.normals)
    facing = np.einsum("ij,ij->i", normals, sensor.rig.reference.centre - points) > 0
    if not (facing.any() or shape.two_sided):
        problem = "faces away from the sensor in this pose"
        yield SceneFinding("note", shape.name, problem, "Look from another side if it is measured")
        return
    shown = points if shape.two_sided else points[facing]
    share = float(in_working_volume(sensor, shown).mean())
    if share == 0:
        problem = f"outside the working volume in this pose: {_why_outside(sensor, shown)}"
        yield SceneFinding("warning", shape.name, problem, "Move the sensor")
        return
    if share < 0.99:
        problem = f"{100 * share:.0f} % of the facing area lies in the working volume: {_why_outside(sensor, shown)}"
        yield SceneFinding("note", shape.name, problem, "Move the sensor if the rest is measured")
    if not (mine & visible.seen_by_all).any():
        why = "another camera or the projector does not see it" if mine.any() else "other faces occlude it"
        problem = f"cameras and projector see no point in common: {why}"
        yield SceneFinding("warning", shape.name, problem, "Look from another side if it is measured")


def _why_outside(sensor: Sensor, points: np.ndarray) -> str:
    near, far = sensor.working_range_mm
    along = depth(sensor, points)
    reasons = []
    if along.min() < near or along.max() > far:
        reasons.append(f"{along.min():.0f} to {along.max():.0f} mm deep, the sensor works from {near:g} to {far:g} mm")
    reasons += [
        f"not {'wholly ' if in_image(eye, points).any() else ''}in the image of the {name}"
        for name, eye in eyes(sensor.rig).items()
        if not in_image(eye, points).all()
    ]
    return "; ".join(reasons)


def _whole(facts: SceneFacts, sensor: Sensor, open_edges: int) -> Iterator[SceneFinding]:
    """Yield findings about size, units, gaps and light of the whole scene."""
    yield from _size(sorted((facts.bounds[1] - facts.bounds[0]).tolist(), reverse=True), sensor)
    far = float(np.abs(facts.bounds).max())
    if (rounded := float(np.spacing(np.float32(far)))) > _ROUNDED_MM:
        problem = (
            f"the part lies up to {far / 1000:.0f} m from the origin, where lengths are rounded to {rounded:.2g} mm"
        )
        yield SceneFinding("warning", "", problem, "Export the part with an origin near it, before it becomes a mesh")
    parts = [shape for shape in facts.shapes if not shape.emitter]
    cut = all(shape.kind not in _STOCK for shape in parts)
    each_closed = all(shape.mesh is not None and shape.mesh.closed for shape in parts)
    if facts.merged_mesh is not None and cut and open_edges and not each_closed:
        problem = f"all meshes together are not closed ({open_edges} open edges)"
        advice = "Correct if only one side of the part is modelled: light passes through the openings"
        yield SceneFinding("note", "", problem, advice)
    if facts.emitters:
        fluxes = [flux for _, flux in facts.emitters if np.isfinite(flux)]
        kinds = ", ".join(sorted({kind for kind, _ in facts.emitters}))
        total = f", {sum(fluxes):.3g} W in all" if fluxes else ""
        unstated = f", {len(facts.emitters) - len(fluxes)} without a flux" if len(fluxes) < len(facts.emitters) else ""
        problem = (
            f"ambient light, {len(facts.emitters)} emitter{'s'[: len(facts.emitters) > 1]} ({kinds}{total}{unstated})"
        )
        advice = f"It is added to every image; the projector emits {sensor.projector.flux:g} W"
        yield SceneFinding("note", "", problem, advice)


def _size(sizes: list[float], sensor: Sensor) -> Iterator[SceneFinding]:
    """Yield findings about a part in the wrong unit or larger than the view; ``sizes`` [mm], the largest first."""
    near, far = sensor.working_range_mm
    middle = (near + far) / 2
    pixel = middle / float(sensor.rig.reference.matrix[0, 0])
    if sizes[0] < SMALL_PX * pixel:
        largest = 3 * field_of_view(sensor, far)[0]
        guesses = [
            f"if it was modelled in {unit} it is {factor * sizes[0]:.4g} mm: scale by {factor:g}"
            for unit, factor in _UNITS.items()
            if SMALL_PX * pixel <= factor * sizes[0] <= largest
        ]
        problem = f"the part is {sizes[0]:.4g} mm across, {sizes[0] / pixel:.0f} px at {middle:g} mm"
        yield SceneFinding(
            "warning", "", problem, f"Lengths are mm; {'; '.join(guesses) or 'check the unit of the file'}"
        )
    view = sorted(field_of_view(sensor, near), reverse=True)
    if sizes[0] > view[0] or sizes[1] > view[1]:
        part = " x ".join(f"{size:.0f}" for size in sizes)
        problem = f"the part is {part} mm, the common view at {near:g} mm is {view[0]:.0f} x {view[1]:.0f} mm"
        unit = "; or its unit is not mm" if sizes[0] > 10 * view[0] else ""
        yield SceneFinding("warning", "", problem, f"Increase the distance, or plan several views{unit}")
