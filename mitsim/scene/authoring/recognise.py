"""Recognise the plane, cylinder or sphere on which a piece of a mesh lies.

Signal chain: vertices and normals of a piece -> least squares of the candidate surfaces, the simplest first -> the
first surface with all vertices within :data:`~mitsim.scene.authoring.face.TOLERANCE_MM`.

The vertices of a tessellation lie on the original surface; the centres of its triangles do not. Surfaces are therefore
fitted to the vertices. The distance of the centres is returned as ``sag``, the error of the faceted form.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import trimesh

from characterisation.features.fits import fit_cylinder, fit_sphere
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cylinder, Plane, Sphere
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats
from mitsim.scene.authoring.face import TOLERANCE_MM, Face, Ints, Surface, outward_normals, surface_distance

#: a normal is perpendicular to an axis within this sine: 0.6 deg
_ACROSS = 0.01


def recognised(mesh: trimesh.Trimesh, piece: Ints) -> Face:
    """Return one piece as a face, with the surface on which it lies, if any."""
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
    """Yield the candidate surfaces of a piece, the simplest first."""
    total = areas.sum()
    mean = areas @ normals / total
    if np.linalg.norm(mean) > 0.99:
        yield Plane(areas @ middles / total, mean / np.linalg.norm(mean))
    # the normals of a cylinder lie in the plane perpendicular to its axis
    spread, directions = np.linalg.eigh((normals * areas[:, None]).T @ normals / total)
    axis = directions[:, 0]
    if spread[1] > _ACROSS**2 and np.abs(normals @ axis).max() < _ACROSS and len(vertices) >= 6:
        yield _cylinder(vertices, axis)
    # two rings of vertices always lie on a sphere (as on a chamfer), so interior vertices are required
    if _vertices_inside(triangles) >= 4:
        try:
            fitted = fit_sphere(vertices)
            yield Sphere(fitted.centre, fitted.radius)
        except FitError:
            return


def _cylinder(vertices: Floats, axis: Floats) -> Cylinder:
    """Fit a cylinder by least squares; it starts from the circle through the projected vertices (Kasa's method)."""
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
        pass  # too few vertices to improve the start
    direction = start.axis * np.sign(start.axis[np.argmax(np.abs(start.axis))])
    along = (vertices - start.point) @ direction
    return Cylinder(start.point + along.min() * direction, direction, start.radius)


def _vertices_inside(triangles: Ints) -> int:
    """Count the vertices of a piece that do not lie on its border."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return len(np.unique(triangles)) - len(np.unique(unique[count == 1]))
