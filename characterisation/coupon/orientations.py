"""Choose the orientations at which a coupon is captured, and refine them where F or sigma changes.

Signal chain: vertices of a subdivided icosahedron within a cap -> F and sigma measured there -> edges along which F or
sigma changes by more than a tolerance, or at which sigma is uncertain -> their midpoints, which are vertices of the
next subdivision -> measured in turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from characterisation.files.arrays import Floats
from characterisation.files.documents import Document

# an icosahedron on the unit sphere has 10 * 4^k + 2 vertices after k subdivisions:
# k = 1: 42, 2: 162, 3: 642, 4: 2562, with neighbours about 34, 17, 8.6, 4.3 deg apart

#: limit of the deviation from a straight line, in units of the tolerance
BENT = 0.5

#: limit of the difference along an edge, in units of the tolerance
STEEP = 3.0

#: F below which a better sigma is of no use
WORTH = 0.02


class Refinement(Document):
    """Criteria by which a campaign adds orientations, and stops.

    An edge joins two neighbouring orientations. It is *rough* if F differs along it by more than ``fraction``, or sigma
    by more than the factor 1 + ``sigma``. A straight slope needs no more orientations. Where an end of the edge lies
    half-way between two other orientations, one of two further conditions must therefore hold:

    - *bent*: the value at that end differs from the mean of the two others by more than half the tolerance;
    - *steep*: the value differs along the edge by more than three times the tolerance.

    Every difference must also exceed twice its standard error. All edges of the triangles beside a rough edge are
    halved, until they are edges of an icosahedron subdivided ``subdivisions`` times.

    An edge with recovered points at both ends is also halved if sigma is uncertain at one of them. Sigma is uncertain
    if its standard error exceeds the share ``sigma_error`` of it, and F exceeds :data:`WORTH`.
    """

    fraction: Annotated[float, Field(gt=0, le=1)] = 0.1
    sigma: Annotated[float, Field(gt=0, le=10)] = 0.25
    sigma_error: Annotated[float, Field(gt=0, le=10)] | None = None
    subdivisions: int = Field(default=4, ge=1, le=6)


@dataclass(frozen=True)
class RefinedNormals:
    """Result of :func:`refine`: ``normals`` (m, 3) to add; number of ``unresolved`` edges that may not be halved."""

    normals: Floats
    unresolved: int


@lru_cache(maxsize=8)
def _sphere(subdivisions: int) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Return vertices (n, 3), edges (e, 2) and edges of each face (f, 3) of a subdivided icosahedron, poles on z."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(sphere.vertices, np.float64)
    first = vertices[0] / np.linalg.norm(vertices[0])
    turn = np.asarray(trimesh.geometry.align_vectors(first, [0, 0, 1]))[:3, :3]  # type: ignore[no-untyped-call]
    edges, of_faces = np.asarray(sphere.edges_unique, np.int64), np.asarray(sphere.faces_unique_edges, np.int64)
    return np.asarray(vertices @ turn.T), edges, of_faces


def sphere_directions(subdivisions: int) -> Floats:
    """Return the vertices (10 * 4^k + 2, 3) of an icosahedron subdivided k times, on the unit sphere, poles on z."""
    return _sphere(subdivisions)[0].copy()


def cap_directions(subdivisions: int, largest_angle: float) -> Floats:
    """Return the directions (n, 3) of the sphere within ``largest_angle`` [rad] of +z, nearest first.

    They are the normals of the coupon in the view frame, whose z axis points toward the sensor (talk of Kinnell and
    Justham, 2018, slide *Data Collection*, step 1: sub-divided icosahedron).
    """
    directions = sphere_directions(subdivisions)
    angle = np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
    order = np.lexsort((np.arctan2(directions[:, 1], directions[:, 0]), np.round(angle, 9)))
    return directions[order][angle[order] <= largest_angle]


def refine(
    normals: Floats,
    fraction: Floats,
    fraction_error: Floats,
    sigma: Floats,
    sigma_error: Floats,
    refinement: Refinement,
    largest_angle: float,
) -> RefinedNormals:
    """Return the normals to add to those that were measured: the talk's *variable density* (slide *Data Collection*).

    Parameters
    ----------
    normals
        (n, 3) measured so far: vertices of icosahedra of various subdivisions.
    fraction, fraction_error, sigma, sigma_error
        (n,) F and sigma [mm] there with their standard errors. Sigma is NaN, and ignored, where no point was recovered.
    refinement, largest_angle
        Where to add normals; largest incidence [rad] of an added one.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        measures = [
            (fraction, fraction_error, refinement.fraction),
            (np.log(sigma), sigma_error / sigma, float(np.log1p(refinement.sigma))),
        ]
        has_sigma = np.isfinite(sigma)
        limit = np.inf if refinement.sigma_error is None else refinement.sigma_error
        uncertain = has_sigma & (fraction > WORTH) & (sigma_error > limit * sigma)
    tree = cKDTree(normals)
    half_way = np.zeros(len(normals), bool)
    bent = np.zeros((2, len(normals)), bool)
    added: list[Floats] = []
    unresolved = 0
    for level in range(refinement.subdivisions + 1):
        vertices, edges, of_faces = _sphere(level)
        apart, index = tree.query(vertices)
        measured = (apart[edges] < 1e-6).all(axis=1)
        ends = index[edges[measured]]
        first = ~half_way[ends].any(axis=1)
        rough = np.zeros(len(edges), bool)
        for number, (values, errors, tolerance) in enumerate(measures):
            here = first | bent[number, ends].any(axis=1) | _differ(values, errors, ends, STEEP * tolerance)
            rough[measured] |= here & _differ(values, errors, ends, tolerance)
        if level == refinement.subdivisions:
            unresolved += int(rough.sum())
            break
        middles = normals[ends].sum(axis=1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        away, middle = tree.query(middles) if len(middles) else (np.zeros(0), np.zeros(0, np.int64))
        existing = away < 1e-6
        half_way[middle[existing]] = True
        for number, (values, errors, tolerance) in enumerate(measures):
            bent[number, middle[existing]] = _bent(values, errors, ends[existing], middle[existing], BENT * tolerance)
        halved = np.zeros(len(edges), bool)
        halved[of_faces[rough[of_faces].any(axis=1)]] = True
        halved[measured] |= uncertain[ends].any(axis=1) & has_sigma[ends].all(axis=1)
        wanted = halved[measured] & ~existing & (np.arccos(np.clip(middles[:, 2], -1, 1)) <= largest_angle)
        added.append(middles[wanted])
    new = np.concatenate(added) if added else np.empty((0, 3))
    # an edge belongs to one subdivision, so its midpoint is found only once
    order = np.lexsort((np.arctan2(new[:, 1], new[:, 0]), -np.round(new[:, 2], 9)))
    return RefinedNormals(new[order], unresolved)


def _differ(values: Floats, errors: Floats, ends: NDArray[np.int64], tolerance: float) -> NDArray[np.bool_]:
    """Return along which edges (e, 2) the values differ by more than a tolerance, and by more than chance."""
    difference = np.abs(values[ends[:, 0]] - values[ends[:, 1]])
    chance = 2 * np.hypot(errors[ends[:, 0]], errors[ends[:, 1]])
    with np.errstate(invalid="ignore"):
        return np.asarray((difference > tolerance) & (difference > chance))


def _bent(
    values: Floats, errors: Floats, ends: NDArray[np.int64], middle: NDArray[np.int64], tolerance: float
) -> NDArray[np.bool_]:
    """Return which edges (e, 2) differ in the middle (e,) from the mean of their ends, by more than both limits."""
    off = np.abs(values[middle] - values[ends].mean(axis=1))
    chance = 2 * np.sqrt(errors[middle] ** 2 + (errors[ends] ** 2).sum(axis=1) / 4)
    with np.errstate(invalid="ignore"):
        return np.asarray((off > tolerance) & (off > chance))
