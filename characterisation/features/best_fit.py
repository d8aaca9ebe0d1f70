"""Align one cloud to another: find the motion that brings points onto a surface given by points only.

Signal chain: points of both -> nearest neighbour in the reference, its normal from the neighbours around it -> distance
along that normal -> least squares over six degrees of freedom about a rough pose, with a prior for the motion ->
repeated until the motion converges (iterative closest point, point to plane: Chen and Medioni, Image Vis. Comput. 10
(1992) 145-155).

A direction that neither the points nor the prior determine stays unchanged, such as the shift of a plane within itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from characterisation.features.robust_fit import CLIP, FitError, robust_std

Floats = NDArray[np.float64]

#: number of neighbours that determine a normal, largest number of points used, and largest number of steps
NEIGHBOURS, POINTS, STEPS = 16, 4000, 40

#: the fit ends with a step smaller than this [mm, at the farthest point]
REST_MM = 1e-4

#: directions with less than this share of the largest information are left to the prior, because the noise of the
#: normals alone adds some information, their variance
UNDECIDED = 1e-3

#: least number of points that lie on both
LEAST = 50


def motion_matrix(step: Floats, about: Floats) -> Floats:
    """Return the motion (4, 4) that turns by step[:3] [rad] about a point (3,) and then shifts by step[3:] [mm]."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    out[:3, 3] = about + step[3:] - out[:3, :3] @ about
    return out


def best_fit(points: Floats, reference: Floats, about: Floats, known: Floats, reach_mm: float, seed: int = 0) -> Floats:
    """Return the motion (4, 4) of points (n, 3) [mm] onto a reference (m, 3).

    Parameters
    ----------
    about
        (3,) centre of the rotations.
    known
        (6, 6) prior covariance of the motion [w (rad), t (mm)], whose mean is 0.
    reach_mm
        Points farther from the reference than this are excluded. The limit shrinks as the motion converges, to three
        times the spacing of the reference.

    Raises
    ------
    FitError
        If fewer than :data:`LEAST` points lie on both.
    """
    rng = np.random.default_rng(seed)
    some = points if len(points) <= POINTS else points[rng.choice(len(points), POINTS, replace=False)]
    tree = cKDTree(reference)
    prior = np.linalg.inv(known)
    total, moved = np.eye(4), some
    span = float(np.linalg.norm(some - about, axis=1).max())
    some_of_it = reference[:: 1 + len(reference) // 1000]
    spacing = float(np.quantile(tree.query(some_of_it, k=2)[0][:, 1], 0.9)) if len(reference) > 1 else 0.0
    gate = max(reach_mm, 3 * spacing)
    for _ in range(STEPS):
        distance, nearest = tree.query(moved, distance_upper_bound=gate)
        on_both = np.isfinite(distance)
        if on_both.sum() < LEAST:
            raise FitError(f"{on_both.sum()} points lie on both clouds, at least {LEAST} are required")
        normals, middles = _planes(tree, reference, nearest[on_both])
        place = moved[on_both]
        residual = np.einsum("ni,ni->n", place - middles, normals)
        scale = robust_std(residual)
        near = np.abs(residual) <= CLIP * scale
        g = np.hstack([np.cross(place[near] - about, normals[near]), normals[near]])
        so_far = _step_of(total, about)
        decided = _decided(g, span)
        information = decided @ g.T @ g @ decided.T / scale**2
        pull = decided @ g.T @ residual[near] / scale**2
        step = np.linalg.solve(information + prior, -pull - prior @ so_far)
        motion = motion_matrix(step, about)
        total = motion @ total
        moved = some @ total[:3, :3].T + total[:3, 3]
        gate = max(
            gate / 2, CLIP * scale, 3 * spacing
        )  # a point between points of the reference must stay within the limit
        if np.abs(step[:3]).max() * span + np.abs(step[3:]).max() < REST_MM:
            break
    return np.asarray(total)


def _decided(g: Floats, span: float) -> Floats:
    """Return the projection (6, 6) of a gradient by the motion onto the directions that the normals determine.

    Directions that only the noise of the normals determines are excluded.
    """
    scale = np.array([1 / span] * 3 + [1.0] * 3)
    values, axes = np.linalg.eigh((g * scale).T @ (g * scale))
    kept = axes[:, values > UNDECIDED * values[-1]]
    return np.asarray((kept @ kept.T * scale) / scale[:, None])


def _planes(tree: cKDTree, reference: Floats, nearest: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return normals and middles (k, 3) of the neighbourhoods of reference points, each computed once."""
    unique, inverse = np.unique(nearest, return_inverse=True)
    _, around = tree.query(reference[unique], k=min(NEIGHBOURS, len(reference)))
    places = reference[around]
    middle = places.mean(axis=1)
    centred = places - middle[:, None]
    normal = np.linalg.eigh(np.einsum("kni,knj->kij", centred, centred))[1][:, :, 0]
    return normal[inverse], middle[inverse]


def _step_of(motion: Floats, about: Floats) -> Floats:
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([turn, motion[:3, :3] @ about + motion[:3, 3] - about])
