"""Collect facts about a mesh: its open edges, its volume, and degenerate and duplicate triangles.

Signal chain: vertices and triangles -> coincident vertices merged -> triangles per edge -> open and non-manifold edges,
volume of a closed mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats


@dataclass(frozen=True)
class MeshFacts:
    """The triangles of a shape, world frame."""

    #: ``vertices`` (n, 3) [mm], after merging, and ``triangles`` (m, 3), indices of vertices
    vertices: Floats
    triangles: NDArray[np.int64]
    #: ``open_edges``, ``nonmanifold_edges``: number of edges of only one triangle, and of more than two
    open_edges: int
    nonmanifold_edges: int
    volume: float  # [mm^3], positive if the normals point outward; 0 if the mesh is not closed
    #: ``degenerate``, ``duplicate``: number of triangles without area, and of repeated triangles
    degenerate: int
    duplicate: int
    texture: bool  # whether the vertices have texture coordinates u, v
    #: (open_edges, 2, 3) end points of the open edges [mm]
    open_edge_ends: Floats = field(default_factory=lambda: np.empty((0, 2, 3)), repr=False)

    @property
    def closed(self) -> bool:
        """Whether every edge belongs to exactly two triangles."""
        return self.open_edges == self.nonmanifold_edges == 0


def mesh_facts(vertices: Floats, triangles: NDArray[np.int64], merge: float, texture: bool = False) -> MeshFacts:
    """Return the facts about a mesh. The volume is a sum over triangles of a . (b x c) / 6, about the mean vertex.

    ``vertices``, ``triangles``: (n, 3) [mm], and (m, 3) indices of vertices. ``merge``: vertices in one cell of a grid
    of this spacing [mm] are merged. ``texture``: whether the vertices have u and v.
    """
    _, first, inverse = np.unique(np.round(vertices / merge), axis=0, return_index=True, return_inverse=True)
    vertices, triangles = vertices[first], inverse.reshape(-1)[triangles]
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], axis=0, initial=0.0)
    degenerate = area <= merge * longest
    regular = triangles[~degenerate]
    low, middle, high = np.sort(regular, axis=1).T
    # one whole number for each pair of vertices: rows of several numbers take six times as long to sort
    size = max(len(vertices), 1)
    first_edges = np.unique(low * size + middle, return_inverse=True)[1]
    duplicate = len(regular) - len(np.unique(first_edges * size + high))
    pairs = np.concatenate([low * size + middle, middle * size + high, low * size + high])
    pairs, count = np.unique(pairs, return_counts=True)
    edges = np.stack(np.divmod(pairs, size), axis=1)
    open_edges, nonmanifold = int((count == 1).sum()), int((count > 2).sum())
    centre = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    volume = float(np.einsum("ij,ij->", a - centre, np.cross(b - centre, c - centre)) / 6)
    closed = open_edges == nonmanifold == 0 and len(regular) > 0
    return MeshFacts(
        vertices,
        triangles,
        open_edges,
        nonmanifold,
        volume if closed else 0.0,
        int(degenerate.sum()),
        duplicate,
        texture,
        vertices[edges[count == 1]],
    )
