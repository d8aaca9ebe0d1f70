"""Join the faces of a CAD file that lie on one surface, because CAD programs divide a bore into two halves."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np

from characterisation.features.surfaces import Cylinder, Plane
from mitsim.scene.authoring.face import Face, centred, mesh_distances, same_surface
from mitsim.scene.authoring.segment_mesh import components

#: halves of one surface agree within this [mm]; a CAD program's own tolerance is 1e-3 to 1e-5
ONE_SURFACE_MM = 1e-3


def join_faces(faces: list[Face]) -> list[Face]:
    """Join faces of one body that share an edge and lie on one surface."""
    owners = defaultdict(list)
    for number, face in enumerate(faces):
        for edge in face.edges:
            owners[face.part, face.body, edge].append(number)
    neighbours = {(shared[0], other) for shared in owners.values() for other in shared[1:]}
    same = [pair for pair in neighbours if same_surface(faces[pair[0]], faces[pair[1]], ONE_SURFACE_MM)]
    groups = components(np.array(same, int).reshape(-1, 2), np.arange(len(faces)))
    return [_as_one([faces[number] for number in group]) for group in groups]


def _as_one(members: list[Face]) -> Face:
    """Join the parts of one surface to one face."""
    if len(members) == 1:
        return members[0]
    start = np.cumsum([0, *(len(member.vertices) for member in members)])
    vertices = np.concatenate([member.vertices for member in members])
    triangles = np.concatenate([member.triangles + at for member, at in zip(members, start, strict=False)])
    surface = members[0].surface
    assert surface is not None  # only faces with a surface are joined
    if isinstance(surface, Cylinder):
        along = float(((vertices - surface.point) @ surface.axis).min())
        surface = Cylinder(surface.point + along * surface.axis, surface.axis, surface.radius)
    elif isinstance(surface, Plane):
        surface = centred(surface, vertices, triangles)
    deviation, sag = mesh_distances(surface, vertices, triangles)
    normals = np.concatenate([member.normals for member in members if member.normals is not None])
    return replace(
        members[0],
        vertices=vertices,
        triangles=triangles,
        surface=surface,
        deviation=deviation,
        sag=sag,
        normals=normals,
        entities=tuple(sorted(number for member in members for number in member.entities)),
        colour=next((member.colour for member in members if member.colour), None),
        drawn_name=next((member.drawn_name for member in members if member.drawn_name), ""),
        edges=frozenset().union(*(member.edges for member in members)),
    )
