"""F and sigma of a surface with a lay, between the directions in which it was characterised.

Signal chain: normals N and the direction t of the surface's parameter u, both in the view frame -> lay angle psi -> the
two neighbouring directions of the map -> N turned with its marks onto each of them -> F and sigma of both, mixed.

Marks reflect a line of light across them. It passes through the mirror direction h, in which a mirror would show the
light to the camera, and turns about it with the marks. At a point at the distance |V| on the view ray,

    h = (m_x / |V|, m_y / |V|, 1), normalised

with m half-way between camera and light, in the view frame of the reference camera; with several cameras, the mean. The
smallest rotation that takes h to the view ray z, and then that which takes N to z, take t into the image plane; psi is
its angle there from x. It is periodic in 180 deg. Between two directions k and k + 1 of the map, at the share t of the
way,

    F(N, psi) = (1 - t) F_k(R(psi_k - psi) N) + t F_k+1(R(psi_k+1 - psi) N)

R is the rotation about h. The same holds for ln sigma. For one camera and a far light this is exact, apart from the
change of incidence. The errors of the answer do not contain the error of this approximation.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.datasets import Variable
from characterisation.maps.tables import AT_KNOT, FIELDS, Surface

#: dimensions of the fields over the directions of a lay
LAY_NODES = ("sample", "lay", "distance", "b", "a")

#: fields of a map over these dimensions, NaN for samples without a lay, by the field of the mean over directions
LAY_FIELDS = {name: f"lay_{name}" for name in FIELDS[:4]}

#: variables in the file of a map
SCHEMA = {
    "lay": Variable(("lay",), low=0.0, high=180.0, needed=False),
    "lay_mirror_x": Variable((), low=-1e6, high=1e6, needed=False),
    "lay_mirror_y": Variable((), low=-1e6, high=1e6, needed=False),
    **{name: Variable(LAY_NODES, low=0.0, high=1e9, gaps=True, needed=False) for name in LAY_FIELDS.values()},
}

_Z = np.array([0.0, 0.0, 1.0])


def mirror_direction(distance: NDArray[np.floating], mirror_mm: tuple[float, float]) -> Floats:
    """Return h (..., 3), a unit vector of the view frame, at distances |V| (...) [mm]; ``mirror_mm`` is m."""
    slope = np.stack([mirror_mm[0] / distance, mirror_mm[1] / distance, np.ones_like(distance)], axis=-1)
    return np.asarray(slope / np.linalg.norm(slope, axis=-1, keepdims=True))


def tangent_at(normals: Floats, lay_deg: float, mirror: Floats) -> Floats:
    """Return the tangents (..., 3) with a lay angle [deg], for normals and mirror directions h (..., 3)."""
    flat = np.array([np.cos(np.radians(lay_deg)), np.sin(np.radians(lay_deg)), 0.0])
    return _rotated_with(_rotated_with(flat, _Z, _rotated_with(normals, mirror, _Z)), _Z, mirror)


def lay_angle_deg(normals: NDArray[np.floating], tangents: NDArray[np.floating], mirror: Floats) -> Floats:
    """Return the lay angle [deg], 0 to 180, of tangents at normals, for mirror directions h; all (..., 3)."""
    flat = _rotated_with(_rotated_with(tangents, mirror, _Z), _rotated_with(normals, mirror, _Z), _Z)
    return np.asarray(np.degrees(np.arctan2(flat[..., 1], flat[..., 0])) % 180.0)


def turned(vectors: NDArray[np.floating], angle_deg: Floats, mirror: Floats) -> Floats:
    """Return vectors (n, 3), each turned by its angle (n,) [deg] about its mirror direction h (n, 3)."""
    cosine, sine = (of(np.radians(angle_deg))[..., None] for of in (np.cos, np.sin))
    along = mirror * _dot(vectors, mirror)
    return np.asarray(cosine * (vectors - along) + sine * np.cross(mirror, vectors) + along)


def _rotated_with(vectors: NDArray[np.floating], start: NDArray[np.floating], end: NDArray[np.floating]) -> Floats:
    """Return vectors (..., 3), rotated by the smallest rotation that takes one unit vector to another."""
    both = start + end
    less = both * _dot(both, vectors) / (1 + _dot(start, end))
    return np.asarray(vectors - less + 2 * end * _dot(start, vectors), float)


def _dot(first: NDArray[np.floating], second: NDArray[np.floating]) -> Floats:
    return np.asarray(np.sum(first * second, axis=-1, keepdims=True), float)


def directions_of(data: xr.Dataset, sample: int) -> list[dict[str, Floats]]:
    """Return the fields of a sample of a map in each direction, by their names without one; empty without a lay."""
    if any(name not in data.variables for name in SCHEMA):
        return []
    fields = {name: data[stored].values[sample].astype(float) for name, stored in LAY_FIELDS.items()}
    if not np.isfinite(fields[FIELDS[0]]).any():
        return []
    return [{name: values[k] for name, values in fields.items()} for k in range(data.sizes["lay"])]


def between_directions(
    surface: Surface, distance: Floats, normals: NDArray[np.floating], tangents: NDArray[np.floating]
) -> list[Floats]:
    """Return F, sigma [mm], their errors and spreads, (n,) each, of a surface whose u lies along tangents (n, 3).

    Where the tangent is NaN, or the map has no F in one of the neighbouring directions, the answer is the mean over
    directions. Elsewhere nothing is unknown of the direction, and the spreads are NaN. ``distance`` is |V| (n,) [mm];
    ``normals`` and ``tangents`` (n, 3) are in the view frame.
    """
    mean = surface.look_up(distance, normals)
    count, mirror = len(surface.directions), mirror_direction(distance, surface.mirror_mm)
    lay_deg = lay_angle_deg(normals, tangents, mirror)
    position = np.where(np.isfinite(lay_deg), lay_deg, 0.0) % 180.0 * (count / 180.0)
    before = np.minimum(position.astype(int), count - 1)
    t = position - before
    near = _in_directions(surface, before, distance, turned(normals, -t * 180.0 / count, mirror))
    far = _in_directions(surface, (before + 1) % count, distance, turned(normals, (1 - t) * 180.0 / count, mirror))
    near = [np.where(t > 1 - AT_KNOT, b, a) for a, b in zip(near, far, strict=True)]
    far = [np.where(t < AT_KNOT, a, b) for a, b in zip(near, far, strict=True)]
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction, fraction_error = (1 - t) * near[0] + t * far[0], np.hypot((1 - t) * near[2], t * far[2])
        near_sigma, far_sigma = (np.where(np.isnan(a[1]), b[1], a[1]) for a, b in ((near, far), (far, near)))
        sigma = np.exp((1 - t) * np.log(near_sigma) + t * np.log(far_sigma))
        shares = [np.where(np.isnan(end[1]), np.nan, end[3] / end[1]) for end in (near, far)]
        sigma_error = sigma * np.hypot((1 - t) * shares[0], t * shares[1])
    determined = np.isfinite(lay_deg) & np.isfinite(fraction)
    nothing = np.full(len(distance), np.nan)
    answers = [fraction, sigma, fraction_error, sigma_error, nothing, nothing]
    return [np.where(determined, answer, whole) for answer, whole in zip(answers, mean, strict=True)]


def _in_directions(surface: Surface, number: NDArray[np.int64], distance: Floats, normals: Floats) -> list[Floats]:
    """Return F, sigma and their errors, (n,) each, from the direction of each point."""
    out = [np.full(len(distance), np.nan) for _ in range(4)]
    for k, direction in enumerate(surface.directions):
        chosen = np.flatnonzero(number == k)
        if len(chosen):
            for values, answer in zip(out, direction.look_up(distance[chosen], normals[chosen]), strict=False):
                values[chosen] = answer
    return out
