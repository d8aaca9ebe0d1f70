# Copyright the mitsim authors. SPDX-License-Identifier: Apache-2.0
# Licensed under the Apache License, Version 2.0: you may use this file, and the map beside it, in compliance with
# http://www.apache.org/licenses/LICENSE-2.0. Distributed "AS IS", without warranties or conditions of any kind.
"""A 3D sensor's performance map with numpy alone: F and sigma of every pixel from depth and normals, and noisy depth.

F is the probability that a pixel gets a point, sigma the standard deviation of its distance along the view ray [mm].
Both are NaN outside the map: for a finish, distance or angle that was not characterised. Nothing is extrapolated. The
map covers direct light; shadow, occlusion, reflections between faces and edges are the caller's responsibility.

    sensor = SensorMap("map.npz")
    fraction, sigma = sensor.image(depth, normals, K, "aluminium/ground", roughness=0.4)
    measured = sensor.draw(depth, normals, K, "aluminium/ground", 0.4, rng=np.random.default_rng(1))
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

_MARGIN = 0.5 / 113  # keeps the probits of F = 0 and 1 finite
_AT_KNOT = 1e-7  # place between two knots that counts as the knot, which needs no value of the other
_ROUNDED = 3e-6  # F this near 0 or 1 is rounded to it; chosen
_Z = np.arange(-4.0, 4.0005, 0.001)  # probits of the map lie within -2.7 and 2.7
_PHI = np.array([0.5 * math.erfc(-z / math.sqrt(2)) for z in _Z])  # the normal distribution function
_FARTHEST = 0.01  # largest error of a point, a share of |V|: points beyond it are not among those of F and sigma
_T = np.linspace(0.05, 3.999, 200)  # the same in standard deviations of normal errors, before those beyond it are cut
_INSIDE = 2 * np.interp(_T, _Z, _PHI) - 1
_REACH = _T / np.sqrt(1 - 2 * _T * np.exp(-(_T**2) / 2) / math.sqrt(2 * math.pi) / _INSIDE)  # and after that


class SensorMap:
    """A map written by ``mitsim export map``."""

    def __init__(self, path: str | Path) -> None:
        with np.load(path, allow_pickle=False) as file:
            self.sensor, self.finishes = str(file["sensor"]), [str(name) for name in file["finish"]]
            self.roughness, self.distances = file["roughness"].astype(float), file["distance"].astype(float)
            self.axis, self.baseline = file["axis"].astype(float), file["baseline"].astype(float)
            self.fields = file["probit"], file["log_sigma"]  # (sample, distance, b, a) each

    def image(self, depth: Any, normals: Any, K: Any, finish: str, roughness: float = math.nan) -> tuple[Any, Any]:
        """Return F and sigma [mm], (H, W) each, for the view of a pinhole camera.

        Parameters
        ----------
        depth
            (H, W) along the optical axis [mm].
        normals
            (H, W, 3) unit, camera frame (x right, y down, z forward), toward the camera.
        K
            (3, 3), pixel centres at integers.
        finish, roughness
            Material and finish, and Ra [um].

        See Also
        --------
        draw : a depth image with such errors
        """
        rays, length = self._rays(np.shape(depth), K)
        return self.look_up(np.asarray(depth) * length, self._in_view_frame(normals, rays), finish, roughness)

    def draw(self, depth: Any, normals: Any, K: Any, finish: str, roughness: float = math.nan, *, rng: Any) -> Any:
        """Draw a depth image (H, W) [mm] of the sensor: NaN without a point; errors of pixels are independent.

        Parameters
        ----------
        depth, normals, K, finish, roughness
            As for :meth:`image`.
        rng
            Generator of the draws.

        See Also
        --------
        image : F and sigma of the view
        """
        fraction, sigma = self.image(depth, normals, K, finish, roughness)
        _, length = self._rays(np.shape(depth), K)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = _FARTHEST * np.asarray(depth) * length / sigma
        noisy = np.asarray(depth) + sigma * _cut(rng.standard_normal(fraction.shape), reach) / length
        return np.where(rng.random(fraction.shape) < fraction, noisy, np.nan)

    def look_up(self, distance: Any, normals: Any, finish: str, roughness: float = math.nan) -> tuple[Any, Any]:
        """Return F and sigma [mm] (...) at distances and normals.

        The view frame of a point has z opposite to its view ray, x along the baseline, y = z cross x.

        Parameters
        ----------
        distance
            |V| (...) [mm].
        normals
            N (..., 3) unit, view frame.
        finish, roughness
            Material and finish, and Ra [um].

        See Also
        --------
        image : of all pixels of a view
        """
        probit, log_sigma = self._surface(finish, roughness)
        n = np.asarray(normals, float)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = n[..., :2] * np.sqrt(2 / (1 + n[..., 2:]))  # Lambert's equal-area projection
            log_distance = np.log(np.asarray(distance, float))
        knots, last = np.log(self.distances), len(self.axis) - 1
        column, row = np.moveaxis((at - self.axis[0]) / (self.axis[1] - self.axis[0]), -1, 0)
        inside = (np.minimum(column, row) >= -1e-4) & (np.maximum(column, row) <= last + 1e-4) & (n[..., 2] > 0)
        if len(knots) == 1:
            inside, j, t = (
                inside & (np.abs(log_distance - knots[0]) < 1e-9),
                np.zeros(log_distance.shape, int),
                np.zeros(log_distance.shape),
            )
        else:
            j = np.clip(np.searchsorted(knots, log_distance) - 1, 0, len(knots) - 2)
            t = (log_distance - knots[j]) / np.diff(knots)[j]
            inside = inside & (t >= -1e-9) & (t <= 1 + 1e-9)
        column, row = (np.clip(np.where(inside, index, 0), 0, last) for index in (column, row))
        left, low = (np.minimum(index.astype(int), last - 1) for index in (column, row))
        u, v = column - left, row - low
        share = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=-1)
        corners = (low[..., None] + [0, 0, 1, 1], left[..., None] + [0, 1, 0, 1])
        far = np.minimum(j + 1, len(knots) - 1)
        means: list[tuple[Any, Any]] = []
        for k, field in enumerate((probit, log_sigma)):
            near, beyond = field[(j[..., None], *corners)], field[(far[..., None], *corners)]
            values = _between(near, beyond, np.clip(t, 0, 1)[..., None], either=k == 1)
            valid = np.isfinite(values) & (share > 0)
            weight = np.where(valid, share, 0.0).sum(-1)
            # corners with F must have half of the weight
            enough = inside & ((weight >= 0.5) if k == 0 else means[0][1])
            with np.errstate(invalid="ignore", divide="ignore"):
                mean = np.where(valid, share * values, 0.0).sum(-1) / weight
            means.append((np.where(enough, mean, np.nan), enough))
        fraction = (np.interp(means[0][0], _Z, _PHI) - _MARGIN) / (1 - 2 * _MARGIN)
        fraction = np.where(fraction < _ROUNDED, 0.0, np.where(fraction > 1 - _ROUNDED, 1.0, fraction))
        return fraction, np.exp(means[1][0])

    def _surface(self, finish: str, roughness: float) -> tuple[Any, Any]:
        """Return the fields (distance, b, a) of a finish at Ra [um], linear in ln Ra between its samples."""
        members = sorted((i for i, name in enumerate(self.finishes) if name == finish), key=lambda i: self.roughness[i])
        if not members:
            raise ValueError(f"finish {finish!r}: the map has {', '.join(dict.fromkeys(self.finishes))}")
        samples, (probit, log_sigma) = self.roughness[members], self.fields
        if math.isnan(samples[0]) or (len(samples) == 1 and abs(roughness / samples[0] - 1) < 1e-6):
            return probit[members[0]].astype(float), log_sigma[members[0]].astype(float)
        if not samples[0] * (1 - 1e-6) <= roughness <= samples[-1] * (1 + 1e-6):
            raise ValueError(f"Ra {roughness:g} um: the map has {samples[0]:g} to {samples[-1]:g} um of {finish}")
        j = int(np.clip(np.searchsorted(np.log(samples), math.log(roughness)) - 1, 0, len(samples) - 2))
        t = np.asarray(np.clip(math.log(roughness / samples[j]) / math.log(samples[j + 1] / samples[j]), 0.0, 1.0))
        low, high = members[j], members[j + 1]
        return _between(probit[low], probit[high], t, False), _between(log_sigma[low], log_sigma[high], t, True)

    def _rays(self, shape: tuple[int, ...], K: Any) -> tuple[Any, Any]:
        """Return unit view rays (H, W, 3), and |V| over depth (H, W)."""
        rows, columns = np.indices(shape)
        x, y = (columns - K[0][2]) / K[0][0], (rows - K[1][2]) / K[1][1]
        length = np.sqrt(x**2 + y**2 + 1)
        return np.stack([x, y, np.ones(shape)], axis=-1) / length[..., None], length

    def _in_view_frame(self, normals: Any, rays: Any) -> Any:
        z = -rays
        x = self.baseline - z * (z @ self.baseline)[..., None]
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        return np.stack([(axis * normals).sum(-1) for axis in (x, np.cross(z, x), z)], axis=-1)


def normals_from_depth(depth: Any, K: Any) -> Any:
    """Return unit normals (H, W, 3) toward the camera from depth (H, W), by central differences; NaN at the border."""
    rows, columns = np.indices(np.shape(depth))
    x, y = (columns - K[0][2]) / K[0][0], (rows - K[1][2]) / K[1][1]
    points = np.stack([x, y, np.ones(x.shape)], axis=-1) * np.asarray(depth, float)[..., None]
    out = np.full(points.shape, np.nan)
    along, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    out[1:-1, 1:-1] = np.cross(down, along)  # y cross x: toward the camera, which is at -z
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def _between(near: Any, far: Any, t: Any, either: bool) -> Any:
    """Interpolate from near to far at ``t``; an end needs only its own value; ``either``: one known side suffices."""
    out = (1 - t) * near.astype(float) + t * far
    if either:
        out = np.where(np.isnan(near) ^ np.isnan(far), np.where(np.isnan(near), far, near), out)
    return np.where(t < _AT_KNOT, near, np.where(t > 1 - _AT_KNOT, far, out))


def _cut(deviates: Any, reach: Any) -> Any:
    """Return normal deviates of unit variance, cut at a largest size."""
    t = np.interp(np.nan_to_num(reach, nan=np.inf), _REACH, _T)
    share = 0.5 + (np.interp(deviates, _Z, _PHI) - 0.5) * np.interp(t, _T, _INSIDE)
    cut = np.interp(share, _PHI, _Z) * np.minimum(np.interp(t, _T, _REACH), reach) / t
    return np.where(reach < _REACH[-1], cut, deviates)
