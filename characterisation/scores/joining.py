"""Propagate the pose errors of joined views to the features that they measure.

Signal chain: uncertainty of each view's pose in the common frame -> a small motion x_v = [w, t] of everything that the
view measured, with covariance K_v -> change J_f x_v of the parameters of each feature f -> joint covariance of all
features of a view, C_v = diag(C_fv) + J K_v J^T -> joint information of views, and of a set of them.

A rigid motion of all features changes no measurement between them. A set of one view therefore has no pose error;
features from different views have all of it. There are two ways to join views:

- Best: every view is weighted by its joint information (generalised least squares). The total information is the sum of
  C_v^-1 over views, and no unbiased way is better (Gauss and Markov).
- Merged: the points of all views are fitted together, as if joined without error. A feature is then the mean of its
  views, each weighted by its own information P_fv. With A_fv = (sum_v P_fv)^-1 P_fv,

      cov(f, g) = d_fg (sum_v P_fv)^-1 + sum_v A_fv J_f K_v J_g^T A_gv^T

In a best fit, K is only the prior of each pose. The fit estimates the poses e_v together with the features, by
generalised least squares, from what the views measure: y_v = theta + J e_v + noise. The moved points are then merged:

    theta^ = sum_v A_v (y_v - J e^_v) = sum_v T_v y_v,      cov = sum_v T_v (diag(C_fv) + J K J^T) T_v^T

The estimate e^ is linear in all y_v, which gives T_v. The best way bounds the search for sets.

One sensor with one calibration takes all views. One standard deviation of the calibration changes a feature by S_fv (p,
k) in the part frame. S_fv differs from view to view, but has the same k causes in all views, so it does not average out
as noise does. With the weights A_v of merging (T_v of a best fit), joined features change by sum_v A_v S_v. This adds

    (sum_v A_v S_v) (sum_v A_v S_v)^T

Neither way includes it in the weights, because the fit of joined points does not contain it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.linalg import block_diag

from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats
from characterisation.scores.view_sets import NOTHING

Joining = Literal["exact", "robot", "stage", "targets", "best_fit"]

#: standard uncertainty of each view's pose in the common frame, at the middle of the part: along each axis [mm] and
#: about each axis [deg]. For a best fit it is that before the fit. Sources and grades: docs/reference/unknowns.md
POSE_KNOWN: dict[Joining, tuple[float, float]] = {
    "exact": (0.0, 0.0),
    "robot": (0.3, 0.03),
    "stage": (0.05, 0.01),
    "targets": (0.03, 0.01),
    "best_fit": (2.0, 0.5),
}

#: number of places about a surface whose feet determine its motion; several times the largest number of parameters
_PLACES = 60


@dataclass(frozen=True)
class JoinedView:
    """One view: covariance and shared errors of its features.

    ``covariance`` (p, p) of each feature, due to noise; None for a feature that it does not see well enough. ``shared``
    S (p, k) of each feature: changes by the k causes that all views have in common; by default, none.
    """

    covariance: tuple[Floats | None, ...]
    shared: tuple[Floats, ...] | None = None


def pose_covariance(position_mm: float, angle_deg: float) -> Floats:
    """Return K (6, 6) of a motion [w (rad), t (mm)], equal along and about each axis."""
    return np.diag([math.radians(angle_deg) ** 2] * 3 + [position_mm**2] * 3)


def rigid_derivatives(estimate: Any, about: Floats) -> Floats:
    """Return J (p, 6): change of the parameters of a surface or figure by a motion [w (rad), t (mm)] about a point.

    For a circle or a point of an edge, it excludes the change due to the motion of its plane.
    """
    if isinstance(estimate, Circle):
        carried = _carried(estimate.centre, estimate.ray, estimate.normal, about)
        return np.vstack([tangents(estimate.normal) @ carried, np.zeros(6)])
    if isinstance(estimate, EdgePoint):
        carried = _carried(estimate.point, estimate.ray, estimate.normal, about)
        return np.vstack([estimate.direction @ carried, [*-estimate.normal, 0.0, 0.0, 0.0]])
    rng = np.random.default_rng(0)
    middle = estimate.centre if hasattr(estimate, "centre") else estimate.point
    points = np.asarray(middle) + rng.normal(0.0, float(getattr(estimate, "radius", 10.0)), (_PLACES, 3))
    at = estimate.meet(points, None)
    zero = np.zeros(estimate.parameter_count)
    by_parameters = estimate.linearised(zero, at.foot, None)[1]
    by_motion = -np.hstack([np.cross(at.foot - about, at.normal), at.normal])
    return np.asarray(np.linalg.lstsq(by_parameters, by_motion, rcond=None)[0])


def _carried(point: Floats, ray: Floats, normal: Floats, about: Floats) -> Floats:
    """Return the motion (3, 6) of a point within its plane, less its slide along the ray as the plane moves."""
    x, y, z = point - about
    moved = np.hstack([np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]), np.eye(3)])
    return np.asarray(moved - np.outer(ray, normal @ moved) / (ray @ normal))


def joint_information(view: JoinedView, rigid: Sequence[Floats], motion_covariance: Floats) -> Floats:
    """Return the information (P, P) of one view on the parameters of all features together; 0 for unseen features.

    ``rigid`` is J (p, 6) of each feature; ``motion_covariance`` is K (6, 6). Errors that views have in common are not
    included.
    """
    sizes = [len(jacobian) for jacobian in rigid]
    ends = np.cumsum(sizes)
    out = np.zeros((ends[-1], ends[-1]))
    seen = [f for f, block in enumerate(view.covariance) if block is not None]
    if not seen:
        return out
    rows = np.concatenate([np.arange(ends[f] - sizes[f], ends[f]) for f in seen])
    motion = np.concatenate([rigid[f] for f in seen])
    covariance = block_diag(*[view.covariance[f] for f in seen]) + motion @ motion_covariance @ motion.T
    scale = np.sqrt(np.diag(covariance))
    out[np.ix_(rows, rows)] = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    return out


def joined_covariance(
    views: Sequence[JoinedView], rigid: Sequence[Floats], motion_covariance: Floats, best_fit: bool = False
) -> Floats:
    """Return the covariance (P, P) of all features fitted to the joined points of views; very large for unseen ones.

    ``rigid`` is J (p, 6) of each feature; ``motion_covariance`` K (6, 6) of each pose, before the fit if there is one.
    ``best_fit``: whether the poses are estimated together with the features; otherwise the points are merged.
    """
    ends = np.cumsum([len(jacobian) for jacobian in rigid])
    out = np.eye(ends[-1]) / NOTHING
    indices = [np.arange(end - len(jacobian), end) for end, jacobian in zip(ends, rigid, strict=True)]
    seen = [f for f in range(len(rigid)) if any(view.covariance[f] is not None for view in views)]
    if not seen:
        return out
    rows = np.concatenate([indices[f] for f in seen])
    at = {f: np.searchsorted(rows, indices[f]) for f in seen}
    count = len(rows)
    weights, noises = np.zeros((2, len(views), count, count))
    motions = np.zeros((len(views), count, 6))
    for v, view in enumerate(views):
        for f in seen:
            if (covariance := view.covariance[f]) is not None:
                block = np.ix_(at[f], at[f])
                weights[v][block], noises[v][block] = np.linalg.inv(covariance), covariance
                motions[v, at[f]] = rigid[f]
    mean = np.linalg.inv(weights.sum(axis=0))
    taken = mean @ weights
    if best_fit:
        taken = taken - _by_estimated_poses(weights, motions, motion_covariance, mean)
    common = np.zeros((count, 1))
    total = np.zeros((count, count))
    for v, view in enumerate(views):
        total += taken[v] @ (noises[v] + motions[v] @ motion_covariance @ motions[v].T) @ taken[v].T
        if view.shared is not None:
            common = common + taken[v] @ np.concatenate([view.shared[f] for f in seen])
    out[np.ix_(rows, rows)] = total + common @ common.T
    return out


def _by_estimated_poses(weights: Floats, motions: Floats, motion_covariance: Floats, mean: Floats) -> Floats:
    """Return the change (views, P, P) of the features by the poses that a best fit estimates from each view."""
    views, count, _ = motions.shape
    designs = np.zeros((views, count, count + 6 * views))
    designs[:, :, :count] = np.eye(count)
    for v, motion in enumerate(motions):
        designs[v, :, count + 6 * v : count + 6 * v + 6] = motion
    gains = designs.swapaxes(1, 2) @ weights
    normal = (gains @ designs).sum(axis=0)
    normal[count:, count:] += block_diag(*[np.linalg.inv(motion_covariance)] * views)
    scale = np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    carried = np.hstack(list(mean @ weights @ motions))
    return np.asarray(carried @ inverse[count:] @ gains)


def invariant(form: Floats, rigid: Floats, variances: Floats) -> Floats:
    """Return the part of a quadratic form G (P, P) that a rigid motion of all features does not change.

    A measurement between features has G J = 0. Finite steps give this only to rounding, which an uncertain pose would
    magnify. ``rigid`` J (P, 6); ``variances`` (P,) scale the parameters.
    """
    scale = np.sqrt(variances)
    scaled = rigid / scale[:, None]
    projector = np.eye(len(scale)) - scaled @ np.linalg.pinv(scaled, rcond=1e-9)
    inner = projector @ (form * np.outer(scale, scale)) @ projector
    return np.asarray(inner / np.outer(scale, scale))
