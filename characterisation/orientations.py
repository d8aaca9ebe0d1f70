"""Orientations at which a coupon is shown to a sensor."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

#: vertices of a unit icosahedron's sphere after k subdivisions: 10 * 4^k + 2
#: k = 1: 42, 2: 162, 3: 642, 4: 2562, neighbours about 34, 17, 8.6, 4.3 deg apart


def sphere_directions(subdivisions: int) -> NDArray[np.float64]:
    """Vertices (10 * 4^k + 2, 3) of a subdivided icosahedron on the unit sphere, poles on the z axis."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(sphere.vertices, np.float64)
    first = vertices[0] / np.linalg.norm(vertices[0])
    turn = np.asarray(trimesh.geometry.align_vectors(first, [0, 0, 1]))[:3, :3]  # type: ignore[no-untyped-call]
    return np.asarray(vertices @ turn.T)


def cap_directions(subdivisions: int, largest_angle: float) -> NDArray[np.float64]:
    """Directions (n, 3) of the sphere within ``largest_angle`` [rad] of +z, nearest first.

    They are the normals at which a coupon is shown, in the view frame: z toward the sensor.
    """
    directions = sphere_directions(subdivisions)
    angle = np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
    order = np.lexsort((np.arctan2(directions[:, 1], directions[:, 0]), np.round(angle, 9)))
    return directions[order][angle[order] <= largest_angle]
