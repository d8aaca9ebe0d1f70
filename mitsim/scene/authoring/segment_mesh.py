"""Segment a mesh of a part into its faces, and recognise planes, cylinders and spheres.

Signal chain: triangles [mm] -> vertices merged, degenerate triangles removed -> neighbours joined if the angle between
them is small -> the surface of each piece (:mod:`mitsim.scene.authoring.recognise`) -> neighbours on one surface joined
(CAD divides a cylinder in two).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.scene.authoring.face import Face, Ints, same_surface
from mitsim.scene.authoring.recognise import recognised
from mitsim.scene.ray_casting.triangles import solid_angles

#: largest number of faces; a mesh with more is a scan or noise, not a machined part
LARGEST_COUNT = 1000

#: vertices closer than this are merged [mm]
MERGE_MM = 1e-4

#: largest angle between the normals of triangles of one plane [deg]
_FLAT_DEG = 0.2

#: a flat patch is separated from a piece without a surface if it has this share of its area. The facets of a round
#: surface differ by less than the joining angle of 20 deg, so there are 18 or more of them, each 5.6 % or less
_FLAT_SHARE = 0.10

#: points of a body that decide whether it lies inside another; chosen
_POINTS = 9


@dataclass(frozen=True)
class SegmentedMesh:
    """A part divided into faces, and remarks about the processing for the user."""

    faces: list[Face]
    remarks: list[str]


def segment_mesh(vertices: Floats, triangles: Ints, angle_deg: float = 20.0, where: str = "mesh") -> SegmentedMesh:
    """Segment a mesh into faces, which have no names yet.

    Raises InputError if no triangle has an area, or there are more than :data:`LARGEST_COUNT` faces.

    ``vertices``, ``triangles``, ``where``: (n, 3) [mm] and (m, 3), and name of the mesh in messages. ``angle_deg``:
    neighbouring triangles with a smaller angle between them belong to one face.
    """
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    mesh.merge_vertices(digits_vertex=round(-np.log10(MERGE_MM)), merge_tex=True, merge_norm=True)
    kept = mesh.nondegenerate_faces(height=1e-9) & mesh.unique_faces()
    remarks = [f"{int((~kept).sum())} degenerate or duplicate triangles left out"] if not kept.all() else []
    if not kept.any():
        raise InputError(where, "", "only triangles without area", "a mesh of the part's surface")
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[kept], process=False)
    mesh, turned = _outside_out(mesh)
    remarks += turned

    pairs, bend = mesh.face_adjacency, np.degrees(mesh.face_adjacency_angles)
    pieces = components(pairs[bend < angle_deg], np.arange(len(mesh.faces)))
    if len(pieces) > LARGEST_COUNT:
        hint = f"raise --angle from {angle_deg:g} deg if round surfaces were meshed coarsely; scans are not supported"
        raise InputError(where, "", f"{len(pieces)} faces", f"at most {LARGEST_COUNT}", hint)
    pieces = [part for piece in pieces for part in _without_flats(mesh, piece, pairs, bend, angle_deg)]
    return SegmentedMesh(_joined(mesh, pieces, pairs), remarks)


def _outside_out(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, list[str]]:
    """Orient the normals of every closed body outward; open bodies stay and are reported."""
    remarks, triangles = [], mesh.faces.copy()
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)  # type: ignore[no-untyped-call]
        triangles = mesh.faces.copy()
        remarks.append("triangles of mixed winding made consistent")
    bodies = components(mesh.face_adjacency, np.arange(len(triangles)))
    shells = [trimesh.Trimesh(mesh.vertices, triangles[body], process=False) for body in bodies]
    closed = [number for number, shell in enumerate(shells) if shell.is_watertight]
    around = {n: [other for other in closed if other != n and _inside(shells[n], shells[other])] for n in closed}
    # a body within another is a cavity, or a part in one: it is turned with the body around it, if that is inward
    inward = {n for n in closed if not around[n] and shells[n].volume < 0}
    inward |= {n for n in closed if inward.intersection(around[n]) and (shells[n].volume > 0) == len(around[n]) % 2}
    for number in inward:
        triangles[bodies[number]] = triangles[bodies[number]][:, ::-1]
    if inward:
        remarks.append(f"{len(inward)} of {len(bodies)} bodies had inward normals: turned outward")
    if open_bodies := len(bodies) - len(closed):
        subject = "the mesh is" if len(bodies) == 1 else f"{open_bodies} of {len(bodies)} bodies are"
        remarks.append(f"{subject} not closed, so the outward direction is unknown: mitsim check reports visible backs")
    return trimesh.Trimesh(mesh.vertices, triangles, process=False), remarks


def _inside(shell: trimesh.Trimesh, other: trimesh.Trimesh) -> bool:
    """Return whether a closed body lies within the material or a cavity of another, by the solid angle of its surface.

    The median of some points decides, since some may lie where both touch.
    """
    if (shell.bounds[0] < other.bounds[0]).any() or (shell.bounds[1] > other.bounds[1]).any():
        return False
    points = shell.triangles_center[:: max(1, len(shell.faces) // _POINTS)]
    angles = [abs(solid_angles(other.triangles - point).sum()) for point in points]
    return bool(np.median(angles) > 2 * np.pi)


def components(pairs: NDArray[np.integer], members: Ints) -> list[Ints]:
    """Return connected sets of ``members`` (n,) numbers, of which ``pairs`` (k, 2) are neighbours."""
    index = np.full(int(members.max(initial=-1)) + 1, -1)
    index[members] = np.arange(len(members))
    inside = pairs[(pairs < len(index)).all(axis=1)]
    inside = index[inside]
    inside = inside[(inside >= 0).all(axis=1)]
    graph = coo_matrix((np.ones(len(inside), bool), (inside[:, 0], inside[:, 1])), shape=(len(members),) * 2)
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(members[order], np.flatnonzero(np.diff(label[order])) + 1) if len(members) else []


def _without_flats(
    mesh: trimesh.Trimesh, piece: Ints, pairs: NDArray[np.integer], bend: Floats, angle_deg: float
) -> list[Ints]:
    """Separate large flat patches from a piece without a surface, to which a fillet joins them."""
    if recognised(mesh, piece).surface is not None:
        return [piece]
    area = mesh.area_faces
    patches = components(pairs[bend < _FLAT_DEG], piece)
    flats = [patch for patch in patches if area[patch].sum() > _FLAT_SHARE * area[piece].sum()]
    if not flats:
        return [piece]
    remainder = np.setdiff1d(piece, np.concatenate(flats))
    return [*flats, *components(pairs[bend < angle_deg], remainder)]


def _joined(mesh: trimesh.Trimesh, pieces: list[Ints], pairs: NDArray[np.integer]) -> list[Face]:
    """Return pieces as faces; neighbours that lie on one surface are joined."""
    faces = [recognised(mesh, piece) for piece in pieces]
    owner = np.empty(len(mesh.faces), int)
    for number, piece in enumerate(pieces):
        owner[piece] = number
    neighbours = np.unique(np.sort(owner[pairs], axis=1), axis=0)
    same = [(a, b) for a, b in neighbours.tolist() if a != b and same_surface(faces[a], faces[b])]
    groups = components(np.array(same, int).reshape(-1, 2), np.arange(len(pieces)))
    return [
        faces[group[0]] if len(group) == 1 else recognised(mesh, np.concatenate([pieces[number] for number in group]))
        for group in groups
    ]
