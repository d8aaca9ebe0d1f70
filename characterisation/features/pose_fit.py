"""Fit the pose of a part to the points of several of its surfaces at once, with its covariance.

Signal chain: points by feature, nominal surfaces in the part frame, a rough pose -> robust fit of the distances to the
nominal surfaces, along the view rays, over six degrees of freedom (:mod:`characterisation.features.robust_fit`) ->
pose, and the covariance sigma^2 (J^T J)^-1 of a small motion.

A small motion rotates the part by a rotation vector w [rad] about a given point c and then shifts it by t [mm]. A foot
q on the surface moves by t + w x (q - c), and the residual along the ray changes by

    d eps = -N . (t + w x (q - c)) / (N.V) = -[(q - c) x N, N] . [w, t] / (N.V)

(the point-to-plane linearisation of Chen and Medioni, Image Vis. Comput. 10 (1992) 145-155, with N.V). The nominal
surfaces are assumed to have no form errors: the effect of the part's form errors on its pose is not in the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from characterisation.features.fitted import FitQuality
from characterisation.features.robust_fit import FitError, covariance_of, rays_from, robust_fit
from characterisation.features.starts import rounding_scale
from characterisation.features.surfaces import Surface

Array = NDArray[np.float64]

#: a motion is free if it changes the residuals by less than this share of the change by the best determined motion. A
#: nearly free motion shows in the covariance
FREE = 1e-7


@dataclass(frozen=True)
class Pose:
    """Pose of a part, ``sensor_from_part`` (4, 4), and the centre ``about`` (3,) [mm] of its rotations, sensor frame.

    Parameters of a small motion: rotation vector [rad] about the centre, then translation [mm], in the sensor frame.
    """

    sensor_from_part: Array
    about: Array

    parameter_count: ClassVar[int] = 6
    kind: ClassVar[str] = "pose"

    def moved(self, parameters: Array) -> Pose:
        """Move the pose by the six parameters."""
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(parameters[:3]).as_matrix()
        motion[:3, 3] = self.about - motion[:3, :3] @ self.about + parameters[3:]
        return Pose(motion @ self.sensor_from_part, self.about + parameters[3:])


@dataclass(frozen=True)
class PoseFit(FitQuality, Pose):
    """Fitted pose; ``about`` is the centroid of the used points."""


def pose_jacobian(surface: Surface, points: Array, rays: Array | None, about: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Return the derivatives (n, 6) of the residuals of points (n, 3) by a small motion of the surface.

    The motion is a rotation vector [rad] about the point ``about`` (3,) [mm] and a translation [mm], in the frame of
    all arguments.

    Parameters
    ----------
    surface
        Surface that is moved.
    points, rays
        (n, 3) [mm], and unit (n, 3); without rays, residuals are orthogonal distances.
    about
        (3,) [mm] centre of the rotation.

    See Also
    --------
    fit_pose : the fit that uses these derivatives
    """
    at = surface.meet(points, rays)
    turning = np.cross(at.foot - np.asarray(about, float), at.normal)
    jacobian: Array = -np.hstack([turning, at.normal]) / at.slope[:, None]
    return jacobian


def fit_pose(
    points: Mapping[str, ArrayLike],
    nominal: Mapping[str, Surface],
    sensor_from_part: ArrayLike,
    viewpoint: ArrayLike | None = None,
) -> PoseFit:
    """Fit the pose of a part to the points of its features.

    Raises FitError if the points leave a motion undetermined, which the message gives in the part frame; or if there
    are too few, or all are at grazing incidence.

    Parameters
    ----------
    points
        By feature, (n, 3) [mm] in the sensor frame; rows with NaN are ignored.
    nominal
        By feature, in the part frame; a feature for each of ``points``.
    sensor_from_part
        (4, 4) rough pose to start from. It may differ by some degrees and half the size of the smallest round feature.
    viewpoint
        (3,) [mm], optical centre of the sensor, sensor frame.

    See Also
    --------
    pose_jacobian : the derivatives of the residuals
    """
    arrays = {name: np.asarray(rows, float).reshape(-1, 3) for name, rows in points.items()}
    arrays = {name: rows[np.isfinite(rows).all(axis=1)] for name, rows in arrays.items()}
    stacked = np.concatenate([*arrays.values(), np.empty((0, 3))])
    if len(stacked) <= Pose.parameter_count:
        raise FitError(f"{len(stacked)} points, a pose needs at least {Pose.parameter_count + 1}")
    member = np.repeat(np.arange(len(arrays)), [len(rows) for rows in arrays.values()])
    surfaces = [nominal[name] for name in arrays]
    rays = rays_from(viewpoint, stacked)

    def linearised(pose: Pose, parameters: Array, chosen: NDArray[Any], along_rays: bool) -> tuple[Array, Array, Array]:
        moved = pose.moved(parameters)
        residual, cosine, jacobian = np.empty(len(chosen)), np.empty(len(chosen)), np.empty((len(chosen), 6))
        for number, surface in enumerate(surfaces):
            mine = np.flatnonzero(member[chosen] == number)
            surface_points = stacked[chosen[mine]]
            seen = rays[chosen[mine]] if along_rays and rays is not None else None
            placed = surface.placed(moved.sensor_from_part)
            residual[mine], _, _, _, cosine[mine] = placed.meet(surface_points, seen)
            jacobian[mine] = pose_jacobian(placed, surface_points, seen, moved.about)
        jacobian[:, :3] = jacobian[:, :3] @ _left_jacobian(parameters[:3])
        return residual, jacobian, cosine

    start = Pose(np.asarray(sensor_from_part, float), stacked.mean(axis=0))
    every = np.arange(len(stacked))
    _check_determined(linearised(start, np.zeros(6), every, True)[1], start, stacked)
    scales = [
        rounding_scale(rows, surface.placed(start.sensor_from_part))
        for rows, surface in zip(arrays.values(), surfaces, strict=True)
    ]
    pose, kept = robust_fit(start, linearised, len(stacked), max(scales))
    pose = Pose(pose.sensor_from_part, stacked[kept].mean(axis=0))
    residual, jacobian, _ = linearised(pose, np.zeros(6), np.flatnonzero(kept), True)
    _check_determined(jacobian, pose, stacked[kept])
    return PoseFit(pose.sensor_from_part, pose.about, *covariance_of(residual, jacobian, pose.kind))


def _left_jacobian(vector: Array) -> Array:
    """Return the left Jacobian (3, 3) of SO(3): how the rotation changes with its rotation vector.

    With angle a and unit axis u: sin(a)/a I + (1 - sin(a)/a) u u^T + (1 - cos(a))/a [u]x (Sola et al., A micro Lie
    theory, arXiv:1812.01537, appendix B).
    """
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = axis = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sinc = np.sin(angle) / angle
    left: Array = sinc * np.eye(3) + (1 - sinc) * np.outer(axis, axis) + (1 - np.cos(angle)) / angle * cross
    return left


def _check_determined(jacobian: Array, pose: Pose, points: Array) -> None:
    """Reject derivatives (n, 6) that leave a motion free, and name it in the part frame."""
    # a rotation is compared with a shift by its effect at the points' typical distance from the middle
    size = max(float(np.sqrt(np.mean(np.sum((points - pose.about) ** 2, axis=1)))), 1e-9)
    scale = np.array([size, size, size, 1.0, 1.0, 1.0])
    if not np.isfinite(jacobian).all():
        raise FitError(f"{len(points)} points that do not determine a pose")
    _, singular, motions = np.linalg.svd(jacobian / scale, full_matrices=False)
    free = motions[singular < FREE * singular[0]]
    if len(free):
        raise FitError(f"{len(points)} points leave the part free to {' and '.join(_in_words(free, size, pose))}")


def _in_words(motions: Array, size: float, pose: Pose) -> list[str]:
    """Describe free motions (k, 6) [size w, t] in words, in the part frame: shifts, then rotations."""
    turn, start = pose.sensor_from_part[:3, :3], pose.sensor_from_part[:3, 3]
    about = (pose.about - start) @ turn
    # combinations of the motions without rotation are shifts; the others are described without these
    left, singular, _ = np.linalg.svd(motions[:, :3])
    rank = int((singular > 1e-6).sum())
    shifts = left[:, rank:].T @ motions[:, 3:] @ turn
    turns = left[:, :rank].T @ motions
    vectors, carried = turns[:, :3] @ turn / size, turns[:, 3:] @ turn
    if len(shifts):
        basis, _ = np.linalg.qr(shifts.T)
        carried = carried - carried @ basis @ basis.T
    words = [f"shift along {_formatted(shift)}" for shift in _reduced(shifts)]
    if rank:
        # t = w x (c - p) of all rotations: p is the common point of the axes nearest to the origin
        crosses = np.concatenate([np.cross(vector, np.eye(3)).T for vector in vectors])
        middle = np.linalg.lstsq(crosses, (np.cross(vectors, about) - carried).ravel(), rcond=1e-9)[0]
        words += [f"turn about {_formatted(vector)} through {_formatted(middle, size)}" for vector in _reduced(vectors)]
    return words


def _reduced(directions: Array) -> Array:
    """Return the same span (k, 3) in directions with as many zeros as possible: reduced rows of length 1."""
    rows = np.array(directions)
    done = 0
    for column in range(3):
        if done == len(rows):
            break
        best = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[best, column]) < 1e-6 * max(float(np.abs(rows).max()), 1e-12):
            continue
        rows[[done, best]] = rows[[best, done]]
        rows[done] /= rows[done, column]
        other_rows = np.arange(len(rows)) != done
        rows[other_rows] -= np.outer(rows[other_rows, column], rows[done])
        done += 1
    unit_rows: Array = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
    return unit_rows


def _formatted(vector: Array, size: float = 1.0) -> str:
    """Return the numbers of a vector as text, with rounding errors replaced by 0."""
    cleaned = np.where(np.abs(vector) < 1e-5 * size, 0.0, vector)
    return "(" + ", ".join(f"{value:.4g}" for value in cleaned) + ")"
