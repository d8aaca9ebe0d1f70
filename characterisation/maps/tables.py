"""Interpolate the fields of one surface between the nodes of a performance map.

Signal chain: fields of the samples of one finish at the nodes -> interpolated by ln Ra to the surface -> flat tables of
probits of F, ln sigma and their errors -> queries in runs that fit into the cache: four corners gathered, bilinear over
the normal, by ln |V| between distances.

ln sigma is linear in ln |V| and in ln Ra, so that sigma follows a power law between two distances. F is linear in the
same variables on the probit scale, z = Phi^-1(c + (1 - 2c) F). A point is lost where its signal falls below a
threshold. The signal follows a power law as well, and varies from point to point by a factor. F itself, linear between
a distance where all points are recovered and one where few are, would be far too low half-way. c keeps z finite at F =
0 and 1.

Let t be the way between the knots x_j and x_j+1, 0 to 1. The independent errors of both knots combine with the error of
linear interpolation, estimated from the second divided difference (Stoer and Bulirsch, Introduction to Numerical
Analysis, 2.1.4):

    u^2 = [(1 - t) u_j]^2 + [t u_j+1]^2 + [t (1 - t) D]^2,      D = (x_j+1 - x_j)^2 f[x_j-1, x_j, x_j+1]

The same with x_j+2 is used if it is larger; the contribution of the knots' own errors to D is subtracted. Without a
third knot, D is unknown, and so is u between the two. Between nodes of the grid, which share their patches, errors are
linear.

Where sigma is unknown at one of two knots or corners, because no point was recovered, the value of the other is used. F
must be known at both knots, and at corners with half of the weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from characterisation.files.arrays import Floats, Singles
from characterisation.files.threads import in_threads

#: variables of the map, in the order of the answer
FIELDS = (
    "recovered_fraction",
    "ray_noise_std",
    "recovered_fraction_error",
    "ray_noise_std_error",
    "recovered_fraction_spread",
    "ray_noise_std_spread",
)

#: c: half a point of a patch of 113
PROBIT_MARGIN = 0.5 / 113

#: F within this distance of 0 or 1 is rounded to it
ROUNDED = 3e-6

#: number of queries in a run
RUN = 16384

#: within this share of an interval from a knot, only that knot is used
AT_KNOT = 1e-7


def between_samples(stacks: Mapping[str, Floats], roughnesses: Floats, roughness: float) -> list[Floats]:
    """Return the six fields of a surface of one roughness [um], from samples of Ra ``roughnesses`` (s,).

    The fields are the probit of F, ln sigma, and the errors and spreads of these two. ``stacks`` are (s, ...). If
    ``roughness`` is NaN, the first sample is returned.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = stacks[FIELDS[1]]
        probit, per_fraction = to_probit(stacks[FIELDS[0]])
        values = [
            probit,
            np.log(np.where(sigma > 0, sigma, np.nan)),
            stacks[FIELDS[2]] * per_fraction,
            stacks[FIELDS[3]] / sigma,
            stacks[FIELDS[4]] * per_fraction,
            stacks[FIELDS[5]] / sigma,
        ]
    if np.isnan(roughness) or len(roughnesses) == 1:
        return [value[0] for value in values]
    x, at = np.log(roughnesses), np.log(roughness)
    j = int(np.clip(np.searchsorted(x, at) - 1, 0, len(x) - 2))
    t = float(np.clip((at - x[j]) / (x[j + 1] - x[j]), 0.0, 1.0))
    if t < AT_KNOT or t > 1 - AT_KNOT:
        return [value[j + round(t)] for value in values]
    bends = [_interpolation_error(x, values[k], values[k + 2], j) for k in (0, 1)]
    return _mixed([v[j] for v in values], [v[j + 1] for v in values], np.asarray(t), bends)


def to_probit(fraction: Floats) -> tuple[Floats, Floats]:
    """Return the probit z of F, and dz/dF."""
    z = ndtri(PROBIT_MARGIN + (1 - 2 * PROBIT_MARGIN) * np.clip(fraction, 0.0, 1.0))
    return z, np.asarray(1.0 / _per_probit(z), float)


def from_probit(z: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the F of a probit z, and dF/dz."""
    fraction = (ndtr(z) - z.dtype.type(PROBIT_MARGIN)) / z.dtype.type(1 - 2 * PROBIT_MARGIN)
    # single precision may have moved F off 0 or 1
    fraction = np.where(fraction < ROUNDED, 0, np.where(fraction > 1 - ROUNDED, 1, fraction))
    return fraction.astype(z.dtype, copy=False), _per_probit(z)


def _per_probit(z: NDArray[np.floating]) -> NDArray[np.floating]:
    density = np.exp(z.dtype.type(-0.5) * z * z)
    return np.asarray(density * z.dtype.type(1 / (np.sqrt(2 * np.pi) * (1 - 2 * PROBIT_MARGIN))))


def _interpolation_error(knots: Floats, values: Floats, errors: Floats, interval: int) -> Floats:
    """Return D of an interval between knots (k,), for values and errors (k, ...); NaN without a third knot."""
    error = np.full(values.shape[1:], np.nan)
    width = knots[interval + 1] - knots[interval]
    for first in (interval - 1, interval):
        if not 0 <= first <= len(knots) - 3:
            continue
        x = knots[first : first + 3]
        share = np.array([1 / ((x[i] - x[i - 1]) * (x[i] - x[i - 2])) for i in range(3)]) * width**2
        bend = np.tensordot(share, values[first : first + 3], 1)
        chance = np.tensordot(share**2, errors[first : first + 3] ** 2, 1)
        error = np.fmax(error, np.sqrt(np.maximum(bend**2 - chance, 0.0)))
    return error


def _mixed(near: list[Floats], far: list[Floats], t: Floats, bends: list[Floats]) -> list[Floats]:
    """Interpolate the six fields at ``t`` between one knot (0) and the next (1); at a knot, only that knot is used."""
    out = [(1 - t) * n + t * f for n, f in zip(near, far, strict=True)]
    for k in (0, 1):
        left = t * (1 - t) * bends[k]
        out[k + 2] = np.sqrt(((1 - t) * near[k + 2]) ** 2 + (t * far[k + 2]) ** 2 + left**2)
    alone = np.isnan(near[1]) ^ np.isnan(far[1])  # sigma at one knot only, whose error does not apply here
    out[1] = np.where(alone, np.where(np.isnan(near[1]), far[1], near[1]), out[1])
    ends = zip(near, far, out, strict=True)
    return [np.where(t < AT_KNOT, n, np.where(t > 1 - AT_KNOT, f, value)) for n, f, value in ends]


class Surface:
    """F and sigma of one surface over |V| and N.

    Parameters
    ----------
    fields
        Probit of F, ln sigma, errors and spreads from :func:`between_samples`, each (distance, b, a).
    distances, axis
        |V| [mm] (d,), ascending, and the positions of the nodes along ``a`` and ``b`` (n,), equally spaced.
    directions
        The same surface with its lay in each of several directions, equally spaced from 0 to 180 deg
        (:mod:`characterisation.maps.lay`); empty without a lay. ``fields`` are then the mean over directions.
    mirror_mm
        The place m half-way between camera and light [mm], for directions.
    """

    def __init__(
        self,
        fields: list[Floats],
        distances: Floats,
        axis: Floats,
        directions: Sequence[Surface] = (),
        mirror_mm: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.directions, self.mirror_mm = tuple(directions), mirror_mm
        self.knots, self.first, self.step = np.log(distances), axis[0], axis[1] - axis[0]
        self.count = len(axis)
        self.fields = [field.reshape(len(distances), -1) for field in fields]
        pairs = range(len(distances) - 1)
        self.bends = [np.full_like(self.fields[0], np.nan) for _ in (0, 1)]
        if len(distances) > 1:
            self.bends = [
                np.stack([_interpolation_error(self.knots, self.fields[k], self.fields[k + 2], j) for j in pairs])
                for k in (0, 1)
            ]
        self.spread = bool(np.isfinite(self.fields[4]).any())
        self.tables = [np.ascontiguousarray(f, np.float32).ravel() for f in (*self.fields[:4], *self.bends)]
        self.plain = self._plain().ravel()

    def _plain(self) -> NDArray[np.bool_]:
        """Return the cells (interval, node at their low corner) with F and sigma at all corners and both distances."""
        n = self.count
        finite = (np.isfinite(self.fields[0]) & np.isfinite(self.fields[1])).reshape(-1, n, n)
        cell = np.zeros_like(finite)
        cell[:, :-1, :-1] = finite[:, :-1, :-1] & finite[:, :-1, 1:] & finite[:, 1:, :-1] & finite[:, 1:, 1:]
        return (cell[:-1] & cell[1:]) if len(cell) > 1 else cell

    def look_up(self, distance: Floats, normals: NDArray[np.floating]) -> list[Floats]:
        """Return F, sigma [mm], their errors and spreads at |V| (n,) [mm] and N (n, 3), (n,) each; NaN if unknown."""
        out = [np.full(len(distance), np.nan) for _ in FIELDS]
        runs = [slice(start, start + RUN) for start in range(0, len(distance), RUN)]

        def answer(run: slice) -> None:
            self._run(distance[run], normals[run], [values[run] for values in out])

        in_threads(answer, runs, most=len(runs) // 2)
        return out

    def _run(self, distance: Floats, normals: NDArray[np.floating], out: list[Floats]) -> None:
        x, y, z = (normals[:, i].astype(np.float32) for i in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.sqrt(np.float32(2) / (1 + z)) / np.float32(self.step)
            origin = np.float32(self.first / self.step)
            column, row = x * scale - origin, y * scale - origin
            interval, t, within = self._along(np.log(distance))
            last = np.float32(self.count - 1)
            # the outermost nodes lie on the limit itself, so rounding needs a tolerance
            within &= (np.minimum(column, row) >= -1e-4) & (np.maximum(column, row) <= last + np.float32(1e-4))
            within &= z > 0
        column, row = (np.clip(np.where(within, coordinate, 0), 0, last) for coordinate in (column, row))
        left, low = (np.minimum(coordinate.astype(np.int32), self.count - 2) for coordinate in (column, row))
        column -= left
        row -= low
        cell = (interval * self.count + low) * self.count + left
        plain = within & self.plain.take(cell, mode="clip")
        if self.spread:
            plain = np.zeros_like(plain)
        chosen: slice | NDArray[np.int64] = slice(None) if plain.all() else np.flatnonzero(plain)
        answers = self._with_all_corners(cell[chosen], t[chosen], column[chosen], row[chosen])
        for values, answer in zip(out, answers, strict=False):
            values[chosen] = answer
        incomplete = np.flatnonzero(within & ~plain)
        if len(incomplete):
            careful = self._with_missing_corners(cell[incomplete], t[incomplete], column[incomplete], row[incomplete])
            for values, fallback in zip(out, careful, strict=True):
                values[incomplete] = fallback

    def _along(self, log_distance: Floats) -> tuple[NDArray[np.int64], Singles, NDArray[np.bool_]]:
        """Return the interval, the way between its knots, and whether the distance lies in an interval."""
        if len(self.knots) == 1:
            nothing = np.zeros(len(log_distance), np.int64)
            return nothing, nothing.astype(np.float32), np.asarray(np.abs(log_distance - self.knots[0]) < 1e-9)
        interval = np.zeros(len(log_distance), np.int64)
        for knot in self.knots[1:-1]:
            interval += log_distance > knot
        t = (log_distance - self.knots.take(interval)) * (1 / np.diff(self.knots)).take(interval)
        within = (t >= -1e-9) & (t <= 1 + 1e-9)
        return interval, np.clip(t, 0, 1).astype(np.float32), within

    def _with_all_corners(self, cell: NDArray[np.int64], t: Singles, u: Singles, v: Singles) -> tuple[Singles, ...]:
        """Return F, sigma and errors where all corners have values."""
        upper = u * v
        shares = {1: u - upper, self.count: v - upper, self.count + 1: upper}

        def bilinear(table: Singles) -> Singles:
            total = table.take(cell, mode="clip") * (1 - u - v + upper)
            for step, share in shares.items():
                total += table[step:].take(cell, mode="clip") * share
            return total

        beyond = self.count**2 if len(self.knots) > 1 else 0
        back, left = 1 - t, t * (1 - t)
        left[left < AT_KNOT] = 0
        out = []
        for k in (0, 1):
            value, error = self.tables[k], self.tables[k + 2]
            near = bilinear(value)
            near += t * (bilinear(value[beyond:]) - near)
            squared = (back * bilinear(error)) ** 2 + (t * bilinear(error[beyond:])) ** 2
            between = np.where(left > 0, left * bilinear(self.tables[k + 4]), 0)
            out += [near, np.sqrt(squared + between**2)]
        sigma = np.exp(out[2])
        fraction, per_probit = from_probit(out[0])
        return fraction, sigma, per_probit * out[1], sigma * out[3]

    def _with_missing_corners(self, cell: NDArray[np.int64], t: Singles, u: Singles, v: Singles) -> list[Floats]:
        """Return all six fields where some corners or knots have no value."""
        corner = cell[:, None] + np.array([0, 1, self.count, self.count + 1])
        share = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1).astype(float)
        beyond = self.count**2 if len(self.knots) > 1 else 0
        near, far = ([field.ravel()[at] for field in self.fields] for at in (corner, corner + beyond))
        fields = _mixed(near, far, t[:, None].astype(float), [bend.ravel()[corner] for bend in self.bends])
        out = []
        for field in fields:
            usable = np.isfinite(field) & (share > 0)
            weight = np.where(usable, share, 0.0).sum(1)
            with np.errstate(invalid="ignore", divide="ignore"):
                out.append(np.where(weight > 0, np.where(usable, share * field, 0.0).sum(1) / weight, np.nan))
        answered = np.where(np.isfinite(fields[0]), share, 0.0).sum(1) >= 0.5
        sigma = np.exp(out[1])
        fraction, per_probit = from_probit(out[0])
        out = [fraction, sigma, per_probit * out[2], sigma * out[3], per_probit * out[4], sigma * out[5]]
        return [np.where(answered, values, np.nan) for values in out]
