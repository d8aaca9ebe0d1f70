"""Align views by best fit: move every view so that its points lie on shapes that the views share.

Signal chain: points of each shape from each view, in one frame, as the poses are known before -> orthogonal distance of
every point to its shape -> one least-squares adjustment of the poses of all views and of the parameters of all shapes,
with the prior of the poses -> motion of each view.

Neither poses nor shapes are given: the shapes start as nominal and are free. A pose therefore has the error of
generalised least squares (:mod:`characterisation.scores.joining`). Directions that the shapes leave open, as a plane
that slides on itself, stay as they are known before.

Points of a view and shape weigh by their variance s^2 and by the number a of them that counts as one,

    a = 1 + sum over all others j of rho_ij,

with rho the correlation of their residuals about a shape of their own. Without it, information of thousands of points
that are correlated would outweigh the prior of the poses.

Clouds are not laid on one another point by point (iterative closest point). A decoder that matches windows has noise of
bumps a few mm wide. The normals of a cloud follow the bumps, and so seem to determine what the shapes leave open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from characterisation.features.robust_fit import CLIP, SMALLEST_SCALE, FitError, robust_std
from characterisation.features.surfaces import Surface
from characterisation.files.arrays import Floats

#: points of a shape from one view that are used
POINTS = 2000

#: steps at most
STEPS = 40

#: first steps, which choose points and weights
CHOICES = 5

#: a step of the poses [mm, at the farthest point] that is their end
REST_MM = 1e-4

#: fewest points of a shape from one view
LEAST = 50

#: points about which the correlation of residuals is summed
_MIDDLES = 200

#: rings about each, as wide as the distance to the fourth neighbour, in which it is summed until it vanishes
_RINGS = 60


@dataclass(frozen=True)
class _Part:
    """Points (n, 3) of a shape from a view; each represents ``thinning`` points.

    The robust standard deviation of its residuals is at least ``least_scale`` [mm].
    """

    view: int
    shape: str
    points: Floats
    thinning: float
    least_scale: float


@dataclass(frozen=True)
class _Chosen:
    """Which points (n,) of a part are used, and their weight [1/mm^2]."""

    near: NDArray[np.bool_]
    weight: float


def motion_matrix(step: Floats, about: Floats) -> Floats:
    """Motion (4, 4) that turns by step[:3] [rad] about a point (3,) and then shifts by step[3:] [mm]."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    out[:3, 3] = about + step[3:] - out[:3, :3] @ about
    return out


def best_fit(
    views: Sequence[Mapping[str, Floats]],
    shapes: Mapping[str, Surface],
    about: Floats,
    pose_covariance: Floats,
    seed: int = 0,
    least_scales: Sequence[Mapping[str, float]] = (),
) -> list[Floats]:
    """Return the motion (4, 4) of each view, in their order.

    Raises FitError if the views are not all connected by shapes of which two views have :data:`LEAST` points each, or
    the points do not determine a shape.

    Parameters
    ----------
    views
        Of each view points (n, 3) [mm] by the name of their shape.
    shapes
        Nominal shapes in the frame of the points.
    about
        (3,) [mm] Centre of the rotations.
    pose_covariance
        (6, 6) covariance of the motion [w (rad), t (mm)] that is expected of each view, of mean 0.
    seed
        Selects the random numbers of the fit.
    least_scales
        Of each view the least scale [mm] of the residuals of each shape, for rounded points
        (:func:`characterisation.features.starts.rounding_scale`); by default that of exact points.
    """
    parts = _parts(views, least_scales or [{}] * len(views), np.random.default_rng(seed))
    _check_connected(parts, len(views))
    names = list(dict.fromkeys(part.shape for part in parts))
    fitted = {name: shapes[name] for name in names}
    motions = [np.eye(4) for _ in views]
    span = max(float(np.linalg.norm(part.points - about, axis=1).max()) for part in parts)
    prior, chosen = np.linalg.inv(pose_covariance), list[_Chosen]()
    sizes = [fitted[name].parameter_count for name in names]
    starts = dict(zip(names, 6 * len(views) + np.cumsum([0, *sizes[:-1]]), strict=True))
    for number in range(STEPS):
        rows = [_linearised(part, motions[part.view], fitted[part.shape], about) for part in parts]
        if number < CHOICES:
            rng = np.random.default_rng(seed)
            chosen = [_choose(*row, part, rng) for row, part in zip(rows, parts, strict=True)]
        normal = block_diag(*[prior] * len(views), np.zeros((sum(sizes), sum(sizes))))
        pull = np.zeros(len(normal))
        pull[: 6 * len(views)] = np.concatenate([prior @ _step_of(motion, about) for motion in motions])
        for part, (_, residual, by_pose, by_shape), choice in zip(parts, rows, chosen, strict=True):
            g = np.hstack([by_pose, by_shape])[choice.near]
            first = starts[part.shape]
            at = np.r_[6 * part.view : 6 * part.view + 6, first : first + by_shape.shape[1]]
            normal[np.ix_(at, at)] += choice.weight * g.T @ g
            pull[at] += choice.weight * g.T @ residual[choice.near]
        step = _solved(normal, -pull)
        motions = [motion_matrix(step[6 * v : 6 * v + 6], about) @ motion for v, motion in enumerate(motions)]
        fitted = {
            name: fitted[name].moved(step[starts[name] : starts[name] + size])
            for name, size in zip(names, sizes, strict=True)
        }
        moved = np.abs(step[: 6 * len(views)].reshape(-1, 6))
        if number >= CHOICES and moved[:, :3].max() * span + moved[:, 3:].max() < REST_MM:
            break
    return motions


def _parts(
    views: Sequence[Mapping[str, Floats]], scales: Sequence[Mapping[str, float]], rng: np.random.Generator
) -> list[_Part]:
    parts = []
    for number, (view, least) in enumerate(zip(views, scales, strict=True)):
        for name, points in view.items():
            if len(points) >= LEAST:
                sample = points if len(points) <= POINTS else points[rng.choice(len(points), POINTS, replace=False)]
                least_scale = least.get(name, SMALLEST_SCALE)
                parts.append(_Part(number, name, sample, len(points) / len(sample), least_scale))
    return parts


def _check_connected(parts: Sequence[_Part], count: int) -> None:
    reached, before = {0}, set[int]()
    while reached != before:
        before = set(reached)
        names = {part.shape for part in parts if part.view in reached}
        reached |= {part.view for part in parts if part.shape in names}
    if len(reached) < count:
        alone = ", ".join(str(view + 1) for view in range(count) if view not in reached)
        raise FitError(f"views {alone} of the set share no shape with the first, of which both have {LEAST} points")


def _linearised(part: _Part, motion: Floats, shape: Surface, about: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return places (n, 3), residuals (n,), and their derivatives by the motion (n, 6) and by the shape (n, p)."""
    points = part.points @ motion[:3, :3].T + motion[:3, 3]
    residual, by_shape, _ = shape.linearised(np.zeros(shape.parameter_count), points, None)
    normal = shape.meet(points, None).normal
    return points, residual, np.hstack([np.cross(points - about, normal), normal]), by_shape


def _choose(
    points: Floats, residual: Floats, by_pose: Floats, by_shape: Floats, part: _Part, rng: np.random.Generator
) -> _Chosen:
    """Choose points within :data:`CLIP` robust standard deviations; weight them by residuals about their own shape.

    A motion moves points as a change of the shape does. So to first order these residuals do not depend on the poses.
    """
    near = np.abs(residual) <= CLIP * max(robust_std(residual), part.least_scale)
    if near.sum() <= by_shape.shape[1]:
        raise FitError(f"{part.shape}: only {near.sum()} points lie on one {part.shape}")
    g = by_shape[near]
    left = residual[near] - g @ np.linalg.lstsq(g, residual[near], rcond=1e-9)[0]
    variance = max(float(left @ left) / len(left), SMALLEST_SCALE**2)
    return _Chosen(near, part.thinning / (variance * counted_as_one(points[near], left, part.thinning, rng)))


def counted_as_one(points: Floats, residual: Floats, thinning: float, rng: np.random.Generator) -> float:
    """Return the number a of points whose residuals (n,), at places (n, 3), are as good as one; at least 1.

    ``points``: (n, 3) [mm]. ``residual``: (n,) [mm]. ``thinning``: number of measured points that each of these stands
    for. ``rng``: chooses the points about which correlation is summed.
    """
    middles = rng.choice(len(points), min(_MIDDLES, len(points)), replace=False)
    apart = cdist(points[middles], points)
    product = residual[middles, None] * residual
    near = min(4, len(points) - 1)
    width = max(float(np.median(np.partition(apart[:20], near, axis=1)[:, near])), np.finfo(float).tiny)
    apart /= width
    np.minimum(apart, _RINGS, out=apart)
    product[np.arange(len(middles)), middles] = 0.0  # a point and itself
    sums = np.bincount(apart.astype(np.intp).ravel(), product.ravel(), _RINGS + 1)[:_RINGS]
    until = int(np.argmax(sums <= 0)) if (sums <= 0).any() else _RINGS
    square = max(float(residual @ residual) / len(residual), np.finfo(float).tiny)
    return 1.0 + thinning * max(float(sums[:until].sum()), 0.0) / len(middles) / square


def _solved(normal: Floats, right: Floats) -> Floats:
    scale = np.sqrt(np.diag(normal))
    try:
        step = np.linalg.solve(normal / np.outer(scale, scale), right / scale) / scale
    except np.linalg.LinAlgError:
        step = np.full(len(right), np.nan)
    if not np.isfinite(step).all():
        raise FitError("the points of all views together do not determine a shape")
    return np.asarray(step)


def _step_of(motion: Floats, about: Floats) -> Floats:
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([turn, motion[:3, :3] @ about + motion[:3, 3] - about])
