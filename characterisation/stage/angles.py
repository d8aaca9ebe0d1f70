"""Compute the angles of a stage that show a coupon's normal to a sensor, and which normals are reachable.

Signal chain: axes of the stage and their limits (TOML) + wanted normals -> angles of the axes -> reachable or not.

A stage is a chain of axes; the first is fixed to the ground and the last carries the coupon. With all axes at zero the
normal of the coupon is ``normal``. Turned by theta_i about axis a_i, it is N = R(a_1, theta_1) ... R(a_k, theta_k) n_0.
For two axes the angles have a closed form with none, one or two solutions: Paden and Kahan's second subproblem (Murray,
Li, Sastry, *A Mathematical Introduction to Robotic Manipulation*, section 3.3.2). With three axes there is a family of
solutions. Each axis in turn is stepped through its range and the other two are solved for; the solution with the least
motion is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator, model_validator

from characterisation.features.vectors import unit
from characterisation.files.arrays import Floats
from characterisation.files.documents import Document, Name

#: largest deviation of a reached normal from the wanted one [rad]
TOLERANCE = 1e-6

#: step of the search over one of three axes [rad]
SEARCH_STEP = math.radians(1.0)

_TURN = 2 * math.pi

#: tolerance of a limit for rounding [rad]
_SLACK = 1e-9

#: solutions with a smaller error [rad] precede all others
_EXACT = 1e-10

#: increase of the motion of all others [rad^2]
_ROUGH = 1e3

Degrees = Annotated[float, Field(ge=-360, le=360)]


class StageAxis(Document):
    """One axis: its ``direction`` in the view frame while all axes are at zero, and its limits."""

    name: Name
    direction: tuple[float, float, float]
    limits_deg: tuple[Degrees, Degrees]

    @model_validator(mode="after")
    def _possible(self) -> StageAxis:
        if self.limits_deg[0] >= self.limits_deg[1]:
            raise ValueError("the lower limit before the upper")
        if np.linalg.norm(self.direction) < 1e-9:
            raise ValueError("a direction that is not zero")
        return self

    def unit(self) -> Floats:
        """Return the unit direction (3,)."""
        return unit(self.direction)

    def nearest(self, angles: ArrayLike) -> Floats:
        """Return the same angles (n,) [rad] plus whole turns, within the limits and as small as possible.

        Where none is within the limits, it is the one nearest to them.
        """
        angles = np.asarray(angles, float)
        low, high = np.radians(self.limits_deg)
        fewest, most = np.ceil((low - 1e-9 - angles) / _TURN), np.floor((high + 1e-9 - angles) / _TURN)
        within = angles + _TURN * np.minimum(np.maximum(np.rint(-angles / _TURN), fewest), most)
        below, above = angles + _TURN * most, angles + _TURN * fewest
        nearer = np.where(above - high < low - below, above, below)
        return np.asarray(np.where(fewest <= most, within, nearer))


class Stage(Document):
    """The ``[stage]`` table: axes in the view frame (x along the baseline, z from the coupon toward the sensor).

    Example: a pan-tilt table that carries the coupon has pan about y first, then tilt about x.
    """

    axes: Annotated[list[StageAxis], Field(min_length=1, max_length=3)]
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @field_validator("normal")
    @classmethod
    def _not_zero(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        if np.linalg.norm(normal) < 1e-9:
            raise ValueError("a direction that is not zero")
        return normal

    def normals(self, angles: ArrayLike) -> Floats:
        """Return the normals (n, 3) of the coupon at angles (n, axes) [rad]."""
        angles = np.atleast_2d(np.asarray(angles, float))
        out = np.broadcast_to(unit(self.normal), (len(angles), 3))
        for axis, turn in reversed(list(zip(self.axes, angles.T, strict=True))):
            out = turned(out, axis.unit(), turn)
        return np.asarray(out)

    def angles(self, normals: ArrayLike) -> Floats:
        """Return the angles (n, axes) [rad] of least motion for each normal (n, 3); NaN where it is unreachable."""
        wanted = np.atleast_2d(np.asarray(normals, float))

        def error(angles: Floats) -> Floats:
            return np.asarray(np.linalg.norm(self.normals(angles) - wanted, axis=1))

        return least_motion(self.axes, self._candidates(wanted), error, len(wanted)).angles

    def _candidates(self, wanted: Floats) -> list[Floats]:
        """Return angles (n, axes) that may show the wanted normals, NaN where there is no solution."""
        start = np.broadcast_to(unit(self.normal), wanted.shape)
        units = [axis.unit() for axis in self.axes]
        if len(units) == 1:
            return [about_one(start, wanted, units[0])[:, None]]
        if len(units) == 2:
            return about_two(start, wanted, units[0], units[1])
        return [candidate for searched in range(3) for candidate in self._searched(searched, start, wanted, units)]

    def _searched(self, searched: int, start: Floats, wanted: Floats, units: list[Floats]) -> list[Floats]:
        """Return candidates with one of three axes at every step within its limits."""
        low, high = np.radians(self.axes[searched].limits_deg)
        steps = low + SEARCH_STEP * np.arange(math.floor((high - low) / SEARCH_STEP) + 1)
        out = []
        for step in np.unique(np.concatenate([steps, [high], [0.0] if low <= 0 <= high else []])):
            angle = np.full(len(start), step)
            if searched == 0:  # R1 R2 R3 n0 = n  ->  R2 R3 n0 = R1' n
                pairs = about_two(start, turned(wanted, units[0], -angle), units[1], units[2])
            elif searched == 1:  # R2 R3 = R(R2 a3) R2
                third = turned(units[2][None], units[1], angle[:1])[0]
                pairs = about_two(turned(start, units[1], angle), wanted, units[0], third)
            else:
                pairs = about_two(turned(start, units[2], angle), wanted, units[0], units[1])
            out += [np.insert(pair, searched, step, axis=1) for pair in pairs]
        return out


@dataclass(frozen=True)
class Reach:
    """Reach of a stage for n views: ``angles`` (n, axes) [rad], NaN if impossible, and the reason, else ""."""

    angles: Floats
    reasons: list[str]


def least_motion(
    axes: Sequence[StageAxis], candidates: Iterable[Floats], error: Callable[[Floats], Floats], count: int
) -> Reach:
    """Return the angles of least motion within the limits.

    Parameters
    ----------
    axes, count
        Axes of the stage, with their limits, and number n of views.
    candidates, error
        Angles (n, axes) [rad] that may be solutions, NaN where there is none; returns the error (n,) of such angles.
    """
    best = np.full((count, len(axes)), np.nan)
    least, beyond = np.full(count, np.inf), np.full(count, np.inf)
    low, high = np.radians([axis.limits_deg for axis in axes]).T
    for solved in candidates:
        angles = np.stack([axis.nearest(turn) for axis, turn in zip(axes, solved.T, strict=True)], axis=1)
        off = np.where(np.isfinite(angles).all(axis=1), error(np.nan_to_num(angles)), np.inf)
        there = off < TOLERANCE
        excess = np.where(there, np.maximum(low - angles, angles - high).max(axis=1), np.inf)
        excess = np.where(excess < _SLACK, 0.0, excess)
        motion = np.where(off < _EXACT, 0.0, _ROUGH) + (angles**2).sum(axis=1)
        better = there & ((excess < beyond) | ((excess == beyond) & (motion < least)))
        best[better], least[better], beyond[better] = angles[better], motion[better], excess[better]
    reasons = [_reason(axes, angles) if over > 0 else "" for angles, over in zip(best, beyond, strict=True)]
    return Reach(np.where(beyond[:, None] > 0, np.nan, best), reasons)


def _reason(axes: Sequence[StageAxis], angles: Floats) -> str:
    """Return the reason why angles (axes,) [rad] are out of reach; NaN stands for no solution."""
    if not np.isfinite(angles).all():
        return "stage: no angles of its axes show this view"
    degrees = np.degrees(angles)
    over = [max(axis.limits_deg[0] - turn, turn - axis.limits_deg[1]) for axis, turn in zip(axes, degrees, strict=True)]
    worst = int(np.argmax(over))
    low, high = axes[worst].limits_deg
    return f"stage: {axes[worst].name} {degrees[worst]:.1f} deg beyond {low:g} to {high:g}"


def turned(vectors: Floats, axis: Floats, angle: Floats) -> Floats:
    """Turn vectors (n, 3) about a unit axis (3,) by angles (n,) [rad], with Rodrigues' formula."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = (vectors @ axis)[:, None] * axis
    return np.asarray(along + cos * (vectors - along) + sin * np.cross(axis, vectors))


def about_one(start: Floats, wanted: Floats, axis: Floats) -> Floats:
    """Return the angle (n,) about one axis that brings start nearest to wanted (Paden and Kahan's first subproblem)."""
    a = start - (start @ axis)[:, None] * axis
    b = wanted - (wanted @ axis)[:, None] * axis
    return np.asarray(np.arctan2(np.cross(a, b) @ axis, (a * b).sum(axis=1)))


def about_two(start: Floats, wanted: Floats, first: Floats, second: Floats) -> list[Floats]:
    """Return both solutions (n, 2) of R(first, t1) R(second, t2) start = wanted, NaN where there is none.

    The intermediate vector c = R(second, t2) start has unit length. It has the component of start along ``second``, and
    that of wanted along ``first``, so c = alpha first + beta second +- gamma (first x second).

    Parameters
    ----------
    start, wanted
        Unit vectors (n, 3).
    first, second
        Unit axes (3,).
    """
    cos = float(first @ second)
    if abs(cos) > 1 - 1e-12:  # two parallel axes act as one
        alone = about_one(start, wanted, first)
        return [np.stack([alone, np.zeros(len(start))], axis=1)]
    p, q = wanted @ first, start @ second
    alpha, beta = (p - cos * q) / (1 - cos**2), (q - cos * p) / (1 - cos**2)
    across = np.cross(first, second)
    left = (1 - alpha**2 - beta**2 - 2 * alpha * beta * cos) / (across @ across)
    # slightly below zero is the single solution at the edge of the range
    gamma = np.sqrt(np.where(left < -1e-9, np.nan, np.maximum(left, 0.0)))
    out = []
    for sign in (1.0, -1.0):
        between = alpha[:, None] * first + beta[:, None] * second + sign * gamma[:, None] * across
        out.append(np.stack([about_one(between, wanted, first), about_one(start, between, second)], axis=1))
    return out
