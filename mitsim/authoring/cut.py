"""A mesh of a part cut into its faces, with planes, cylinders and spheres recognised.

Signal chain: triangles [mm] -> vertices merged, degenerate triangles dropped -> neighbours joined where the surface
bends by less than an angle (or where the CAD file says that they are one face) -> least squares of a plane, a
cylinder, a sphere through each piece -> what lies on the surface by :data:`TOLERANCE_MM` is recognised -> neighbours
on one surface joined (CAD cuts a cylinder in two) -> names by kind and area.

A tessellation's vertices lie on the surface that was tessellated; the middles of its triangles do not. So surfaces are
fitted to the vertices, and the distance of the middles is told as ``sag``: that is the error of the faceted form.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from characterisation.features.fits import Cone, Cylinder, FitError, Plane, Sphere, fit_cylinder, fit_sphere, tangents
from mitsim.errors import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Torus:
    """Torus about the line through ``centre`` (3,) [mm] along unit ``axis`` (3,).

    ``radius`` [mm] of the middle of its tube, ``tube`` [mm] that of the tube. No task measures it; it is here for its
    normals.
    """

    centre: Floats
    axis: Floats
    radius: float
    tube: float

    kind: ClassVar[str] = "torus"

    def from_tube(self, points: Floats) -> Floats:
        """Vectors (..., 3) [mm] from the middle of the tube to points (..., 3)."""
        local = points - self.centre
        along = (local @ self.axis)[..., None] * self.axis
        across = local - along
        length = np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
        return np.asarray(across * (1 - self.radius / length) + along)


Surface = Plane | Cylinder | Sphere | Cone | Torus

#: how far a vertex may lie from the surface that it is said to lie on [mm]
TOLERANCE_MM = 0.01

#: more faces than this are a scan, or noise, and not a machined part
LARGEST_COUNT = 1000

#: vertices nearer than this are one [mm]
MERGE_MM = 1e-4

#: triangles of one plane differ by less than this in their normals [deg]
_FLAT_DEG = 0.2

#: a flat patch is cut out of a piece that is no plane as a whole if it has this share of its area: the facets of a
#: round surface bend by less than the joining angle of 20 deg, so there are 18 or more of them, each 5.6 % or less
_FLAT_SHARE = 0.10

#: a normal is at right angles to an axis within this [sin]: 0.6 deg
_ACROSS = 0.01


@dataclass(frozen=True)
class Face:
    """One face of a part.

    ``vertices`` (n, 3) [mm] and ``triangles`` (m, 3), counter-clockwise as seen from outside; ``surface`` what it was
    recognised as, or None; ``convex`` whether a round surface bulges outward (a boss, not a bore); ``deviation`` the
    largest distance of a vertex from the surface, ``sag`` that of a triangle's middle [mm], NaN where there is no
    surface. Of a CAD file: ``normals`` (n, 3) of the drawn surface at the vertices, the ``part`` of an assembly and the
    ``body`` that it belongs to, its ``colour`` (sRGB, 0 to 1), the numbers of its ``entities`` in the file and the name
    that it has there, and which of the body's ``edges`` bound it.
    """

    name: str
    vertices: Floats
    triangles: Ints
    surface: Surface | None
    convex: bool
    deviation: float
    sag: float
    normals: Floats | None = None
    part: str = ""
    body: int = 0
    colour: tuple[float, float, float] | None = None
    entities: tuple[int, ...] = ()
    drawn_name: str = ""
    edges: frozenset[int] = frozenset()

    @property
    def kind(self) -> str:
        """``plane``, ``cylinder``, ``sphere``, ``cone``, ``torus``, or ``face`` for anything else."""
        return self.surface.kind if self.surface else "face"

    @property
    def area(self) -> float:
        """Area of the triangles [mm^2]."""
        return float(_areas(self.vertices, self.triangles).sum())

    def corner_normals(self) -> Floats | None:
        """Outward unit normals (m, 3, 3) at the corners of the triangles.

        Those of the recognised surface, else those that the CAD file gives; None without either.
        """
        if self.surface is None:
            return None if self.normals is None else self.normals[self.triangles]
        corners = self.vertices[self.triangles]
        if isinstance(self.surface, Cone):  # its tip has no normal of its own: the triangle's then
            corners = corners + 1e-6 * (corners.mean(axis=1, keepdims=True) - corners)
        return outward_normals(self.surface, corners) * (1.0 if self.convex else -1.0)

    def corner_places(self) -> Floats | None:
        """Places (m, 3, 2) [mm] on the developed surface, u and v; None for what has no such map.

        On a plane along the two :func:`~characterisation.features.fits.tangents` of the normal; on a cylinder u goes
        round and v along the axis. Each triangle is developed by itself, so none straddles a seam.
        """
        corners = self.vertices[self.triangles]
        if isinstance(self.surface, Plane):
            return np.asarray((corners - self.surface.point) @ tangents(self.surface.normal).T)
        if isinstance(self.surface, Cylinder):
            local = corners - self.surface.point
            first, second = np.moveaxis(local @ tangents(self.surface.axis).T, -1, 0)
            angle = np.arctan2(second, first)
            angle = angle[:, :1] + (angle - angle[:, :1] + np.pi) % (2 * np.pi) - np.pi
            return np.stack([self.surface.radius * angle, local @ self.surface.axis], axis=-1)
        return None


@dataclass(frozen=True)
class Cut:
    """A part cut into faces, and what was done to it, in sentences for the user."""

    faces: list[Face]
    remarks: list[str]


def cut(
    vertices: Floats, triangles: Ints, angle_deg: float = 20.0, drawn: Ints | None = None, where: str = "mesh"
) -> Cut:  # fmt: skip
    """Cut a mesh into faces.

    Parameters
    ----------
    vertices, triangles
        (n, 3) [mm] and (m, 3).
    angle_deg
        Neighbouring triangles that bend by less belong to one face.
    drawn
        (m,) which face of the CAD model each triangle came from, where that is known: then it decides, not the angle.
    where
        What to call the mesh in a message.

    Raises
    ------
    InputError
        If no triangle has an area, or there are more than :data:`LARGEST_COUNT` faces.
    """
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    mesh.merge_vertices(digits_vertex=round(-np.log10(MERGE_MM)), merge_tex=True, merge_norm=True)
    kept = mesh.nondegenerate_faces(height=1e-9) & mesh.unique_faces()
    remarks = [f"{int((~kept).sum())} degenerate or duplicate triangles left out"] if not kept.all() else []
    if not kept.any():
        raise InputError(where, "", "only triangles without area", "a mesh of the part's surface")
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[kept], process=False)
    drawn = None if drawn is None else np.asarray(drawn)[kept]
    mesh, turned = _outside_out(mesh)
    remarks += turned

    pairs, bend = mesh.face_adjacency, np.degrees(mesh.face_adjacency_angles)
    joined = bend < angle_deg if drawn is None else drawn[pairs[:, 0]] == drawn[pairs[:, 1]]
    pieces = _components(pairs[joined], np.arange(len(mesh.faces)))
    if len(pieces) > LARGEST_COUNT:
        hint = f"raise --angle from {angle_deg:g} deg if round surfaces were meshed coarsely; scans are not cut"
        raise InputError(where, "", f"{len(pieces)} faces", f"at most {LARGEST_COUNT}", hint)
    if drawn is None:
        pieces = [part for piece in pieces for part in _without_flats(mesh, piece, pairs, bend, angle_deg)]
    faces = [_recognised(mesh, piece) for piece in pieces]
    pieces, faces = _joined(mesh, pieces, faces, pairs)
    return Cut(_named(faces), remarks)


def _outside_out(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, list[str]]:
    """Turn every closed body so that its normals point outward; what is not closed is left and told of."""
    remarks, triangles = [], mesh.faces.copy()
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)  # type: ignore[no-untyped-call]
        triangles = mesh.faces.copy()
        remarks.append("triangles of mixed winding made consistent")
    bodies = _components(mesh.face_adjacency, np.arange(len(triangles)))
    open_bodies, inward = 0, 0
    for body in bodies:
        one = trimesh.Trimesh(mesh.vertices, triangles[body], process=False)
        if not one.is_watertight:
            open_bodies += 1
        elif one.volume < 0 and not _inside_another(mesh, body, bodies):
            triangles[body] = triangles[body][:, ::-1]
            inward += 1
    if inward:
        remarks.append(f"{inward} of {len(bodies)} bodies had inward normals: turned outward")
    if open_bodies:
        what = "the mesh is" if len(bodies) == 1 else f"{open_bodies} of {len(bodies)} bodies are"
        remarks.append(f"{what} not closed, so outward cannot be told: mitsim check shows what is seen from behind")
    return trimesh.Trimesh(mesh.vertices, triangles, process=False), remarks


def _inside_another(mesh: trimesh.Trimesh, body: Ints, bodies: list[Ints]) -> bool:
    """Whether a body's box lies within that of another: a cavity, whose normals rightly point into it."""
    mine = mesh.vertices[mesh.faces[body]].reshape(-1, 3)
    for other in bodies:
        if other is body:
            continue
        box = mesh.vertices[mesh.faces[other]].reshape(-1, 3)
        if (mine.min(0) > box.min(0)).all() and (mine.max(0) < box.max(0)).all():
            return True
    return False


def _components(pairs: NDArray[np.integer], members: Ints) -> list[Ints]:
    """Connected sets of triangles (numbers in ``members``), where ``pairs`` (k, 2) are neighbours."""
    place = np.full(int(members.max(initial=-1)) + 1, -1)
    place[members] = np.arange(len(members))
    inside = pairs[(pairs < len(place)).all(axis=1)]
    inside = place[inside]
    inside = inside[(inside >= 0).all(axis=1)]
    graph = coo_matrix((np.ones(len(inside), bool), (inside[:, 0], inside[:, 1])), shape=(len(members),) * 2)
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(members[order], np.flatnonzero(np.diff(label[order])) + 1) if len(members) else []


def _without_flats(
    mesh: trimesh.Trimesh, piece: Ints, pairs: NDArray[np.integer], bend: Floats, angle_deg: float
) -> list[Ints]:
    """Cut large flat patches out of a piece that is no surface as a whole: a fillet joins it to its neighbours."""
    if _recognised(mesh, piece).surface is not None:
        return [piece]
    area = mesh.area_faces
    patches = _components(pairs[bend < _FLAT_DEG], piece)
    flats = [patch for patch in patches if area[patch].sum() > _FLAT_SHARE * area[piece].sum()]
    if not flats:
        return [piece]
    rest = np.setdiff1d(piece, np.concatenate(flats))
    return [*flats, *_components(pairs[bend < angle_deg], rest)]


def _recognised(mesh: trimesh.Trimesh, piece: Ints) -> Face:
    """One piece as a face, with the surface that it lies on, if there is one."""
    used, triangles = np.unique(mesh.faces[piece], return_inverse=True)
    vertices, triangles = mesh.vertices[used].astype(float), triangles.reshape(-1, 3)
    areas, normals, middles = mesh.area_faces[piece], mesh.face_normals[piece], mesh.triangles_center[piece]
    for candidate in _candidates(vertices, triangles, areas, normals, middles):
        deviation = float(np.abs(surface_distance(candidate, vertices)).max())
        if deviation <= TOLERANCE_MM:
            outward = float(areas @ np.einsum("ij,ij->i", outward_normals(candidate, middles), normals))
            sag = float(np.abs(surface_distance(candidate, middles)).max())
            return Face("", vertices, triangles, candidate, outward > 0, deviation, sag)
    return Face("", vertices, triangles, None, True, np.nan, np.nan)


def _candidates(
    vertices: Floats, triangles: Ints, areas: Floats, normals: Floats, middles: Floats
) -> Iterable[Surface]:
    """Surfaces that a piece may lie on, the plainest first."""
    total = areas.sum()
    mean = areas @ normals / total
    if np.linalg.norm(mean) > 0.99:
        yield Plane(areas @ middles / total, mean / np.linalg.norm(mean))
        return
    # the normals of a cylinder lie in the plane across its axis
    spread, directions = np.linalg.eigh((normals * areas[:, None]).T @ normals / total)
    axis = directions[:, 0]
    if spread[1] > _ACROSS**2 and np.abs(normals @ axis).max() < _ACROSS and len(vertices) >= 6:
        yield _cylinder(vertices, axis)
    # two rings of vertices lie on a sphere whatever is between them (a chamfer does), so some must lie inside
    if _vertices_inside(triangles) >= 4:
        try:
            fitted = fit_sphere(vertices)
            yield Sphere(fitted.centre, fitted.radius)
        except FitError:
            return


def _cylinder(vertices: Floats, axis: Floats) -> Cylinder:
    """Least-squares cylinder; a circle through the vertices seen along the axis is the start (Kasa's algebraic fit)."""
    basis = tangents(axis)
    across = vertices @ basis.T
    middle = across.mean(axis=0)
    local = across - middle
    solution, *_ = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), (local**2).sum(1), rcond=None)
    radius = float(np.sqrt(max(solution[2] + solution[:2] @ solution[:2], 1e-12)))
    start = Cylinder((solution[:2] + middle) @ basis, axis, radius)
    try:
        fitted = fit_cylinder(vertices, start)
        start = Cylinder(fitted.point, fitted.axis, fitted.radius)
    except FitError:
        pass  # so few vertices that the start is as good
    direction = start.axis * np.sign(start.axis[np.argmax(np.abs(start.axis))])
    along = (vertices - start.point) @ direction
    return Cylinder(start.point + along.min() * direction, direction, start.radius)


def _vertices_inside(triangles: Ints) -> int:
    """How many vertices of a piece do not lie on its border."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return len(np.unique(triangles)) - len(np.unique(unique[count == 1]))


def _joined(
    mesh: trimesh.Trimesh, pieces: list[Ints], faces: list[Face], pairs: NDArray[np.integer]
) -> tuple[list[Ints], list[Face]]:
    """Join neighbours that lie on one surface."""
    owner = np.empty(len(mesh.faces), int)
    for number, piece in enumerate(pieces):
        owner[piece] = number
    neighbours = np.unique(np.sort(owner[pairs], axis=1), axis=0)
    same = [(a, b) for a, b in neighbours.tolist() if a != b and same_surface(faces[a], faces[b])]
    if not same:
        return pieces, faces
    groups = _components(np.array(same), np.arange(len(pieces)))
    merged = [np.concatenate([pieces[number] for number in group]) for group in groups]
    again = [
        faces[group[0]] if len(group) == 1 else _recognised(mesh, piece)
        for group, piece in zip(groups, merged, strict=True)
    ]
    return merged, again


def same_surface(first: Face, second: Face, tolerance_mm: float = TOLERANCE_MM) -> bool:
    """Whether two faces lie on one surface, on the same side of it, within ``tolerance_mm``."""
    if first.surface is None or second.surface is None or first.kind != second.kind or first.convex != second.convex:
        return False
    larger, smaller = (first, second) if first.area >= second.area else (second, first)
    assert larger.surface is not None
    return bool(np.abs(surface_distance(larger.surface, smaller.vertices)).max() <= tolerance_mm)


def _named(faces: list[Face]) -> list[Face]:
    """Names by kind, the largest first: plane_1, plane_2, cylinder_1."""
    out, count = [], {"plane": 0, "cylinder": 0, "sphere": 0, "face": 0}
    kinds = list(count)
    for face in sorted(
        faces, key=lambda one: (kinds.index(one.kind), -round(one.area, 6), one.vertices.mean(0).tolist())
    ):
        count[face.kind] += 1
        out.append(replace(face, name=f"{face.kind}_{count[face.kind]}"))
    return out


def surface_distance(surface: Surface, points: Floats) -> Floats:
    """Signed distance [mm] of points (..., 3) from a surface; outside is positive."""
    if isinstance(surface, Torus):
        return np.asarray(np.linalg.norm(surface.from_tube(points), axis=-1) - surface.tube)
    if isinstance(surface, Cone):
        return surface.meet(points.reshape(-1, 3), None).residual.reshape(points.shape[:-1])
    if isinstance(surface, Plane):
        return np.asarray((points - surface.point) @ surface.normal)
    if isinstance(surface, Cylinder):
        local = points - surface.point
        return np.asarray(
            np.linalg.norm(local - (local @ surface.axis)[..., None] * surface.axis, axis=-1) - surface.radius
        )
    return np.asarray(np.linalg.norm(points - surface.centre, axis=-1) - surface.radius)


def outward_normals(surface: Surface, points: Floats) -> Floats:
    """Unit normals (..., 3) of a surface, away from its axis or centre."""
    if isinstance(surface, Plane):
        return np.broadcast_to(surface.normal, points.shape).copy()
    if isinstance(surface, Cylinder):
        local = points - surface.point
        radial = local - (local @ surface.axis)[..., None] * surface.axis
    elif isinstance(surface, Cone):
        local = points - surface.point
        radial = local - (local @ surface.axis)[..., None] * surface.axis
        radial /= np.maximum(np.linalg.norm(radial, axis=-1, keepdims=True), 1e-12)
        radial = np.cos(surface.half_angle) * radial - np.sin(surface.half_angle) * surface.axis
    elif isinstance(surface, Torus):
        radial = surface.from_tube(points)
    else:
        radial = points - surface.centre
    return np.asarray(radial / np.maximum(np.linalg.norm(radial, axis=-1, keepdims=True), 1e-12))


def _areas(vertices: Floats, triangles: Ints) -> Floats:
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1))
