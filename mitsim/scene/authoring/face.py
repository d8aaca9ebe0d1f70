"""Represent a face of a part: its triangles, its surface, distances from the surface and its normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Torus:
    """Torus about the line through ``centre`` (3,) [mm] along unit ``axis`` (3,).

    ``radius`` [mm] to the centre of its tube, ``tube`` [mm] of the tube itself. No task measures it; only its normals
    are used.
    """

    centre: Floats
    axis: Floats
    radius: float
    tube: float

    kind: ClassVar[str] = "torus"

    def from_tube(self, points: Floats) -> Floats:
        """Return vectors (..., 3) [mm] from the centre line of the tube to points (..., 3)."""
        local = points - self.centre
        along = (local @ self.axis)[..., None] * self.axis
        across = local - along
        length = np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
        return np.asarray(across * (1 - self.radius / length) + along)


Surface = Plane | Cylinder | Sphere | Cone | Torus

#: largest distance of a vertex from its recognised surface [mm]
TOLERANCE_MM = 0.01


@dataclass(frozen=True)
class Face:
    """One face of a part.

    - ``vertices`` (n, 3) [mm] and ``triangles`` (m, 3), counter-clockwise as seen from outside.
    - ``surface``: the recognised surface, or None.
    - ``convex``: whether a round surface bulges outward (a boss, not a bore).
    - ``deviation``: largest distance of a vertex from the surface; ``sag``: that of a triangle's centre [mm]; NaN
      without a surface.

    From a CAD file:

    - ``normals`` (n, 3) of the drawn surface at the vertices.
    - ``part`` of the assembly and ``body`` to which the face belongs; its ``colour`` (sRGB, 0 to 1).
    - numbers of its ``entities`` in the file, and its name there (``drawn_name``).
    - ``edges`` of the body that bound it.
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
        """Return ``plane``, ``cylinder``, ``sphere``, ``cone``, ``torus``, or ``face`` for anything else."""
        return self.surface.kind if self.surface else "face"

    @property
    def area(self) -> float:
        """Return the area of the triangles [mm^2]."""
        return float(_areas(self.vertices, self.triangles).sum())

    def corner_normals(self) -> Floats | None:
        """Return the outward unit normals (m, 3, 3) at triangles' corners, recognised or drawn; None without either."""
        if self.surface is None:
            return None if self.normals is None else self.normals[self.triangles]
        corners = self.vertices[self.triangles]
        if isinstance(self.surface, Cone):  # its tip has no normal: use the triangle's
            corners = corners + 1e-6 * (corners.mean(axis=1, keepdims=True) - corners)
        return outward_normals(self.surface, corners) * (1.0 if self.convex else -1.0)

    def corner_places(self) -> Floats | None:
        """Return the triangles (m, 3, 2) [mm], u and v, on the developed surface; None for other surfaces.

        On a plane they are along the two :func:`~characterisation.features.vectors.tangents` of the normal. On a
        cylinder u is circumferential and v axial. Each triangle is developed separately, so none crosses a seam.
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


def same_surface(first: Face, second: Face, tolerance_mm: float = TOLERANCE_MM) -> bool:
    """Return whether two faces lie on one surface, on the same side of it, within ``tolerance_mm``."""
    if first.surface is None or second.surface is None or first.kind != second.kind or first.convex != second.convex:
        return False
    larger, smaller = (first, second) if first.area >= second.area else (second, first)
    assert larger.surface is not None
    return bool(np.abs(surface_distance(larger.surface, smaller.vertices)).max() <= tolerance_mm)


def centred(plane: Plane, vertices: Floats, triangles: Ints) -> Plane:
    """Return a plane with its point at the centroid of the area of its face, which every mesh of the face has alike."""
    areas, middles = _areas(vertices, triangles), vertices[triangles].mean(axis=1)
    middle = areas @ middles / areas.sum() if areas.any() else middles.mean(axis=0)
    return plane.at_foot_of(middle)


def surface_distance(surface: Surface, points: Floats) -> Floats:
    """Return the signed distance [mm] of points (..., 3) from a surface; outside is positive."""
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


def mesh_distances(surface: Surface, vertices: Floats, triangles: Ints) -> tuple[float, float]:
    """Return the largest distances [mm] of the vertices of a mesh and of its triangles' centres from a surface."""
    at_vertices, at_middles = (
        float(np.abs(surface_distance(surface, points)).max())
        for points in (vertices, vertices[triangles].mean(axis=1))
    )
    return at_vertices, at_middles


def outward_normals(surface: Surface, points: Floats) -> Floats:
    """Return the unit normals (..., 3) of a surface, away from its axis or centre."""
    if isinstance(surface, Plane):
        return np.broadcast_to(surface.normal, points.shape).copy()
    if isinstance(surface, Cylinder | Cone):
        local = points - surface.point
        radial = local - (local @ surface.axis)[..., None] * surface.axis
        if isinstance(surface, Cone):
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
