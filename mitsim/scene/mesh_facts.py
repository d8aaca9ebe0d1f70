"""Facts about a mesh: its open edges, its volume, and triangles that no mesh should have."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MeshFacts:
    """A shape's triangles, in the world frame.

    ``vertices`` (n, 3) [mm], those at one place merged; ``triangles`` (m, 3); ``open_edges`` that belong to one
    triangle only, and their ends ``border`` (open_edges, 2, 3) [mm]; ``crowded_edges`` to more than two; ``volume``
    [mm^3], signed, 0 unless closed; ``degenerate`` and ``duplicate`` triangles; ``texture`` and ``smooth``: whether
    there are u, v and normals at the vertices.
    """

    vertices: Floats
    triangles: NDArray[np.int64]
    open_edges: int
    crowded_edges: int
    volume: float
    degenerate: int
    duplicate: int
    texture: bool
    smooth: bool
    border: Floats = field(default_factory=lambda: np.empty((0, 2, 3)), repr=False)

    @property
    def closed(self) -> bool:
        """Whether every edge belongs to two triangles."""
        return self.open_edges == self.crowded_edges == 0


def mesh_facts(
    vertices: Floats, triangles: NDArray[np.int64], merge: float, texture: bool = False, smooth: bool = False
) -> MeshFacts:
    """Count the faults of triangles (m, 3) on vertices (n, 3) [mm]; vertices within ``merge`` [mm] are one."""
    _, first, inverse = np.unique(np.round(vertices / merge), axis=0, return_index=True, return_inverse=True)
    vertices, triangles = vertices[first], inverse.reshape(-1)[triangles]
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], axis=0, initial=0.0)
    degenerate = area <= merge * longest
    sound = triangles[~degenerate]
    duplicate = len(sound) - len(np.unique(np.sort(sound, axis=1), axis=0)) if len(sound) else 0
    edges = np.sort(sound[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True) if len(edges) else (edges, np.empty(0, int))
    open_edges, crowded = int((count == 1).sum()), int((count > 2).sum())
    middle = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    volume = float(np.einsum("ij,ij->", a - middle, np.cross(b - middle, c - middle)) / 6)
    closed = open_edges == crowded == 0 and len(sound) > 0
    return MeshFacts(
        vertices,
        triangles,
        open_edges,
        crowded,
        volume if closed else 0.0,
        int(degenerate.sum()),
        duplicate,
        texture,
        smooth,
        vertices[edges[count == 1]],
    )
