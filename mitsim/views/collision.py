"""Test whether a sensor's body is clear of a part.

Signal chain: eyes of the sensor + margin -> a box in the sensor frame; triangles of the part -> search trees by size ->
triangles near the box -> exact distance from box to triangle [mm] -> clear or not.

A box and a triangle are convex polyhedra. If they do not meet, their distance is that between a corner of one and a
face of the other, or between two edges. Thirteen separating axes decide whether they meet (Gottschalk, Lin, Manocha,
SIGGRAPH 1996; Ericson, *Real-Time Collision Detection*, sections 5.1.9 and 5.2.9). The clear space is therefore the box
with rounded edges; its corners are not overestimated.

A body entirely inside a closed solid touches none of its triangles. There the winding number of the triangles about the
middle of the body is 1: the sum of their solid angles over 4 pi (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng.
30, 1983; for distant triangles A.r / r^3, with A their area along the normal). Only closed surfaces count; a floor does
not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from trimesh.grouping import unique_rows

from characterisation.files.arrays import Floats
from mitsim.scene.ray_casting.triangles import solid_angles
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.views.table import MARGIN_MM, SensorBody

#: winding number above which a point is inside: half-way from 0 to 1
_INSIDE = 0.5

#: corners nearer than this fraction of the part's size are merged
_MERGE = 1e-6

#: a surface is closed if its area vectors add to less than this fraction of its area
_CLOSED = 1e-3

#: distance, in units of its reach, beyond which a triangle counts as a point-like area
_FAR = 4.0

#: triangles per chunk
_AT_ONCE = 1 << 14

#: corners of a box in units of half its sides, and the two ends of each of its twelve edges
_CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_EDGES = np.array([(i, j) for i in range(8) for j in range(i) if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 2])


@dataclass(frozen=True)
class BodyBox:
    """A box in the sensor frame, parallel to its axes: ``centre`` (3,), and ``half`` its side lengths (3,) [mm]."""

    centre: Floats
    half: Floats


@dataclass(frozen=True)
class Solids:
    """Triangles (n, 3, 3) of closed surfaces, part frame [mm].

    Each has its middle, (n, 3), its area along its normal, (n, 3) [mm^2], and its ``reach`` (n,), the largest distance
    of a corner from the middle. ``bounds`` (2, 3) enclose all of them.
    """

    triangles: Floats
    middles: Floats
    areas: Floats
    reach: Floats
    bounds: Floats


@dataclass(frozen=True)
class Obstacle:
    """Triangles (n, 3, 3) [mm], part frame, and search trees of their middles.

    For each size class, ``trees`` holds the tree, the indices of its triangles, and the largest distance [mm] of a
    corner from its triangle's middle. ``solids`` are the closed surfaces.
    """

    triangles: Floats = field(repr=False)
    trees: tuple[tuple[cKDTree, NDArray[np.int64], float], ...] = field(repr=False)
    solids: Solids = field(repr=False)


def sensor_box(sensor: Sensor, body: SensorBody) -> BodyBox:
    """Return the box that represents a sensor: as given, or around the apertures of its cameras and projector."""
    eyes = [(camera.centre, sensor.pupil_mm(camera) / 2) for camera in sensor.rig.cameras.values()]
    eyes.append((sensor.projector.optics.centre, sensor.projector.aperture_mm / 2))
    low = np.min([centre - radius for centre, radius in eyes], axis=0)
    high = np.max([centre + radius for centre, radius in eyes], axis=0)
    middle = (low + high) / 2
    if body.size_mm is None:
        return BodyBox(middle, (high - low) / 2 + (MARGIN_MM if body.margin_mm is None else body.margin_mm))
    return BodyBox(middle if body.centre_mm is None else np.array(body.centre_mm), np.array(body.size_mm) / 2)


def obstacle(triangles: Floats) -> Obstacle:
    """Prepare triangles (n, 3, 3) [mm] for many queries.

    Sizes in a class differ by at most a factor of two, so that a few large triangles (a floor) do not widen the search
    among many small ones.
    """
    middles, reach = _middles(triangles)
    size = np.frexp(np.maximum(reach, 1e-3))[1]
    trees = []
    for size_class in np.unique(size):
        members = np.flatnonzero(size == size_class)
        trees.append((cKDTree(middles[members]), members, float(reach[members].max())))
    return Obstacle(triangles, tuple(trees), _solids(triangles))


def _middles(triangles: Floats) -> tuple[Floats, Floats]:
    """Return the middles (n, 3) of triangles, and the largest distance of a corner from the middle, (n,)."""
    middles = triangles.mean(axis=1)
    return middles, np.linalg.norm(triangles - middles[:, None], axis=2).max(axis=1, initial=0.0)


def _solids(triangles: Floats) -> Solids:
    """Return the triangles of closed surfaces: connected triangles whose area vectors add to zero."""
    corners = triangles.reshape(-1, 3)
    merge = max(_MERGE * float(np.ptp(corners, axis=0).max(initial=0.0)), 1e-9) if len(corners) else 1.0
    # from the least corner on, a million steps fit into 20 bits, so that rows are packed and sorted as one number each
    steps = np.round((corners - corners.min(axis=0, initial=np.inf)) / merge).astype(np.int64)
    _, at = unique_rows(steps)  # type: ignore[no-untyped-call]
    at = at.reshape(-1, 3)
    count = int(at.max(initial=-1)) + 1
    links = coo_matrix((np.ones(2 * len(at)), (at[:, [0, 1]].ravel(), at[:, [1, 2]].ravel())), shape=(count, count))
    surface = connected_components(links, directed=False)[1][at[:, 0]] if count else np.empty(0, np.int64)
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2
    total = np.zeros((int(surface.max(initial=-1)) + 1, 3))
    np.add.at(total, surface, areas)
    whole = np.bincount(surface, np.linalg.norm(areas, axis=1), len(total))
    closed = (np.linalg.norm(total, axis=1) < _CLOSED * whole)[surface]
    chosen = triangles[closed]
    inner = chosen.reshape(-1, 3)
    bounds = np.stack([inner.min(axis=0, initial=np.inf), inner.max(axis=0, initial=-np.inf)])
    middles, reach = _middles(chosen)
    return Solids(chosen, middles, areas[closed], reach, bounds)


def is_near(part: Obstacle, box: BodyBox, part_from_sensor: Transform, clearance: float) -> bool:
    """Return whether any triangle of a part is nearer to a box than ``clearance`` [mm], or meets it."""
    centre = part_from_sensor.points(box.centre)
    reach = float(np.linalg.norm(box.half)) + clearance
    indices = [members[tree.query_ball_point(centre, reach + radius)] for tree, members, radius in part.trees]
    near = np.concatenate([np.empty(0, np.int64), *indices])
    local = part_from_sensor.inverse().points(part.triangles[near]) - box.centre
    a, b, c = np.moveaxis(local, 1, 0)  # element-wise: NumPy is slow along axes of length three
    lowest, highest = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    local = local[(np.maximum(lowest, -highest) - box.half <= clearance).all(axis=1)]
    if (np.linalg.norm(_beyond(local, box.half), axis=2) < clearance).any():
        return True
    for first in range(0, len(local), _AT_ONCE):
        distance = box_distance(local[first : first + _AT_ONCE], box.half)
        if (distance < clearance).any() or (distance == 0).any():
            return True
    return False


def is_inside(part: Obstacle, point: Floats) -> bool:
    """Return whether a point (3,) [mm], part frame, lies inside a closed solid with outward normals."""
    solids = part.solids
    if not ((point > solids.bounds[0]) & (point < solids.bounds[1])).all():
        return False
    away = solids.middles - point
    squared = np.einsum("ij,ij->i", away, away)
    near = squared <= (_FAR * solids.reach) ** 2
    angles = np.einsum("ij,ij->i", solids.areas, away) / np.where(near, 1.0, squared) ** 1.5
    total = angles[~near].sum() + solid_angles(solids.triangles[near] - point).sum()
    return bool(total / (4 * np.pi) > _INSIDE)


def box_distance(triangles: Floats, half: Floats) -> Floats:
    """Return the distance (n,) [mm] of triangles (n, 3, 3) from a box about the origin; 0 if they meet."""
    corners, edges = _CORNERS * half, (_CORNERS * half)[_EDGES]
    nearest = np.linalg.norm(_beyond(triangles, half), axis=2).min(axis=1, initial=np.inf)
    sides = np.roll(triangles, -1, axis=1) - triangles
    starts, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    between = _segment_distance(triangles[:, :, None], sides[:, :, None], starts[None, None], along[None, None])
    nearest = np.minimum(nearest, between.min(axis=(1, 2), initial=np.inf))
    nearest = np.minimum(nearest, _face_distance(triangles, corners))
    return np.asarray(np.where(_meets(triangles, half), 0.0, nearest))


def _beyond(points: Floats, half: Floats) -> Floats:
    """Return how far points (..., 3) lie outside the box along each axis."""
    return np.asarray(np.maximum(np.abs(points) - half, 0.0))


def _face_distance(triangles: Floats, corners: Floats) -> Floats:
    """Return the least distance (n,) of points (m, 3) above triangles (n, 3, 3); infinite if none is there."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(first, second)
    area = (normal**2).sum(axis=1)
    there = area > 0
    share = np.where(there, area, 1.0)[:, None]
    unit, offset = normal / np.sqrt(share), corners - triangles[:, :1]
    u = np.einsum("nk,nmk->nm", np.cross(second, normal), offset) / share
    v = np.einsum("nk,nmk->nm", np.cross(normal, first), offset) / share
    over = there[:, None] & (u >= 0) & (v >= 0) & (u + v <= 1)
    height = np.abs(np.einsum("nk,nmk->nm", unit, offset))
    return np.asarray(np.where(over, height, np.inf).min(axis=1))


def _segment_distance(p: Floats, u: Floats, q: Floats, v: Floats) -> Floats:
    """Return the distance of segments p + s u and q + t v, with s and t from 0 to 1, broadcast; v is not zero."""
    r = p - q
    a, b, e = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    c, f = (u * r).sum(-1), (v * r).sum(-1)
    below = a * e - b * b
    crossing = below > 1e-12 * a * e  # parallel segments have the same distance everywhere
    s = np.where(crossing, np.clip((b * f - c * e) / np.where(crossing, below, 1.0), 0, 1), 0.0)
    t = np.clip((b * s + f) / e, 0, 1)
    extended = a > 0
    s = np.where(extended, np.clip((b * t - c) / np.where(extended, a, 1.0), 0, 1), 0.0)
    return np.asarray(np.linalg.norm(r + s[..., None] * u - t[..., None] * v, axis=-1))


def _meets(triangles: Floats, half: Floats) -> NDArray[np.bool_]:
    """Return whether triangles (n, 3, 3) meet a box about the origin: none of thirteen axes separates them."""
    sides = np.roll(triangles, -1, axis=1) - triangles
    crossed = np.cross(sides[:, :, None], np.eye(3)[None, None]).reshape(-1, 9, 3)
    normal = np.cross(sides[:, 0], sides[:, 1])[:, None]
    axes = np.concatenate([np.broadcast_to(np.eye(3), (len(triangles), 3, 3)), normal, crossed], axis=1)
    along = np.einsum("nak,nck->nac", axes, triangles)
    reach = np.abs(axes) @ half
    return np.asarray(((along.min(axis=2) <= reach) & (along.max(axis=2) >= -reach)).all(axis=1))
