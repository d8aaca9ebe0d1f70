"""The performance map of a sensor: F and sigma over distance |V|, normal N in the view frame, and sample.

Signal chain: table of patches (:mod:`characterisation.patches`) -> pooled in the neighbourhood of every node of a
grid -> map with counts and standard errors -> netCDF; and back: queries -> bilinear over the normal, linear in
distance, linear in log Ra between samples of one finish.

Normals are laid out by Lambert's azimuthal equal-area projection of the hemisphere toward the sensor,
(a, b) = (N_x, N_y) sqrt(2 / (1 + N_z)): equal cells for equal solid angles, and a look-up without a search. The radius
is 2 sin(incidence / 2). The talk's gradient space (N_x/N_z, N_y/N_z) is a stretch of the same picture.

Nothing is extrapolated: outside the characterised normals, distances and Ra a query returns NaN.

A sample may come with *variants*, in which something that is not known of it was moved one standard deviation down or
up. Half of what that makes of F and of sigma, root sum of squares over all that is not known, is their *spread*:

    u^2(F) = sum over q of [(F(q high) - F(q low)) / 2]^2

(GUM 5.1.3, note 2: sensitivities by finite differences; the q are taken as independent).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from characterisation.errors import InputError, nearest
from characterisation.whole_files import written_whole

Floats = NDArray[np.float64]

#: what was moved, and to which end of its one standard deviation
Variant = tuple[str, Literal["low", "high"]]

#: smallest angular bandwidth of the pooling kernel [rad], and the farthest that the nearest patch may lie
BANDWIDTH, REACH = math.radians(2.5), math.radians(9.0)

#: the kernel widens until this many patches lie within one bandwidth
NEIGHBOURS = 5

#: patches with fewer degrees of freedom do not speak about sigma
LEAST_DEGREES = 10


def equal_area(normals: NDArray[np.floating]) -> Floats:
    """Lambert's projection (..., 2) of unit normals (..., 3) in the view frame."""
    z = np.asarray(normals[..., 2], float)
    return np.asarray(normals[..., :2] * np.sqrt(2.0 / np.maximum(1.0 + z, 1e-12))[..., None])


def from_equal_area(places: NDArray[np.floating]) -> Floats:
    """Unit normals (..., 3) of places (..., 2) in Lambert's projection."""
    r2 = (np.asarray(places, float) ** 2).sum(-1)
    scale = np.sqrt(np.maximum(1.0 - r2 / 4.0, 0.0))
    return np.concatenate([places * scale[..., None], (1.0 - r2 / 2.0)[..., None]], axis=-1)


@dataclass(frozen=True)
class Performance:
    """Answer of a map, one array element per query, NaN where the map has nothing to say.

    ``fraction`` F [1]; ``sigma`` [mm] along the view ray, without outliers; ``fraction_error``, ``sigma_error`` one
    standard error of the map itself; ``fraction_spread``, ``sigma_spread`` standard uncertainty by what is not known of
    the sample, NaN where the campaign did not ask for it.
    """

    fraction: Floats
    sigma: Floats
    fraction_error: Floats
    sigma_error: Floats
    fraction_spread: Floats
    sigma_spread: Floats


#: fraction and sigma by turns, which _mix relies on
_FIELDS = ("recovered_fraction", "ray_noise_std", "recovered_fraction_error", "ray_noise_std_error")
_SPREADS = ("recovered_fraction_spread", "ray_noise_std_spread")


class PerformanceMap:
    """A map, as an ``xarray.Dataset`` with dimensions (sample, distance, b, a)."""

    def __init__(self, data: xr.Dataset) -> None:
        self.data = data
        self._distances = data["distance"].values.astype(float)
        self._axis = data["a"].values.astype(float)
        unknown = np.full(data["recovered_fraction"].shape, np.nan, np.float32)
        fields = [data[name].values if name in data else unknown for name in (*_FIELDS, *_SPREADS)]
        self._fields = np.stack(fields, axis=-1)
        self._finishes = [str(f) for f in data["finish"].values]
        self._roughness = data["roughness"].values.astype(float)

    @property
    def finishes(self) -> list[str]:
        """Names of the finishes that were characterised."""
        return list(dict.fromkeys(self._finishes))

    @property
    def samples(self) -> list[tuple[str, float]]:
        """(finish, Ra [um] or NaN) of every sample."""
        return list(zip(self._finishes, self._roughness.tolist(), strict=True))

    def query(self, finish: str, roughness: float, distance: ArrayLike, normals: NDArray[np.floating]) -> Performance:
        """Look up F and sigma.

        Parameters
        ----------
        finish, roughness
            The surface: family name, and Ra [um] (ignored for a finish without Ra).
        distance, normals
            |V| [mm] (n,), and unit N in the view frame (n, 3).

        Raises
        ------
        InputError
            If the finish, or its Ra, was not characterised.
        """
        lower, upper, t = self._between(finish, roughness)
        values = self._at(lower, distance, normals)
        if t > 0:
            values = _mix(values, self._at(upper, distance, normals), np.asarray(t))
        return Performance(*np.moveaxis(values, -1, 0))

    def _between(self, finish: str, roughness: float) -> tuple[int, int, float]:
        members = [i for i, name in enumerate(self._finishes) if name == finish]
        where = str(self.data.attrs.get("name", "performance map"))
        if not members:
            hint = nearest(finish, self.finishes)
            raise InputError(where, "finish", repr(finish), ", ".join(self.finishes), hint)
        if math.isnan(self._roughness[members[0]]):
            return members[0], members[0], 0.0
        members.sort(key=lambda i: self._roughness[i])
        known = self._roughness[members]
        if not known[0] * (1 - 1e-6) <= roughness <= known[-1] * (1 + 1e-6):
            allowed = f"{known[0]:g} to {known[-1]:g} um, the range that was characterised for {finish}"
            raise InputError(where, "Ra", f"{roughness:g} um", allowed, "characterise a sample beyond it")
        j = int(np.clip(np.searchsorted(known, roughness) - 1, 0, max(len(known) - 2, 0)))
        if len(known) == 1:
            return members[0], members[0], 0.0
        t = (math.log(roughness) - math.log(known[j])) / (math.log(known[j + 1]) - math.log(known[j]))
        return members[j], members[j + 1], float(np.clip(t, 0.0, 1.0))

    def _at(self, sample: int, distance: ArrayLike, normals: NDArray[np.floating]) -> Floats:
        """The six fields (n, 6) of one sample: linear in distance, bilinear in the normal."""
        distance = np.asarray(distance, float)
        if len(self._distances) == 1:
            near, t = np.zeros(distance.shape, int), np.where(distance == self._distances[0], 0.0, np.nan)
            far = near
        else:
            near = np.clip(np.searchsorted(self._distances, distance) - 1, 0, len(self._distances) - 2)
            far = near + 1
            t = (distance - self._distances[near]) / (self._distances[far] - self._distances[near])
        t = np.where((t < -1e-9) | (t > 1 + 1e-9), np.nan, t)[..., None]
        step = self._axis[1] - self._axis[0]
        place = (equal_area(np.asarray(normals, float)) - self._axis[0]) / step
        corner = np.clip(np.floor(np.nan_to_num(place)).astype(int), 0, len(self._axis) - 2)
        outside = ((place < 0) | (place > len(self._axis) - 1)).any(-1) | (np.asarray(normals)[..., 2] <= 0)
        (column, row), (u, v) = np.moveaxis(corner, -1, 0), np.moveaxis(place - corner, -1, 0)
        total = np.zeros((*distance.shape, self._fields.shape[-1]))
        weight = np.zeros_like(total)
        for d_row, w_row in ((0, 1 - v), (1, v)):
            for d_column, w_column in ((0, 1 - u), (1, u)):
                here = self._fields[sample, near, row + d_row, column + d_column]
                there = self._fields[sample, far, row + d_row, column + d_column]
                value = _mix(here, there, t)
                w = np.where(np.isfinite(value), (w_row * w_column)[..., None], 0.0)
                total += w * np.nan_to_num(value)
                weight += w
        with np.errstate(invalid="ignore", divide="ignore"):
            out = np.where(weight > 0.25, total / weight, np.nan)
        return np.where(outside[..., None], np.nan, out)

    def save(self, path: str | Path) -> None:
        """Write netCDF, whole or not at all."""
        with written_whole(path) as file:
            self.data.to_netcdf(file)

    @staticmethod
    def load(path: str | Path) -> PerformanceMap:
        """Read a map.

        Raises
        ------
        InputError
            If the file is missing or is not a performance map.
        """
        path = Path(path)
        if not path.is_file():
            raise InputError(path, "", "no such file", "a performance map (map.nc) made by mitsim characterise")
        try:
            data = xr.load_dataset(path)
        except (OSError, ValueError) as error:
            raise InputError(path, "", f"a file that cannot be read ({error})", "netCDF") from None
        missing = [name for name in (*_FIELDS, "finish", "roughness") if name not in data]
        if missing:
            raise InputError(path, missing[0], "nothing", "a performance map with this variable")
        return PerformanceMap(data)


def _mix(first: Floats, second: Floats, t: Floats) -> Floats:
    """Fields (..., 4) between two neighbours, ``t`` of the way from the first (0) to the second (1).

    At an end only that neighbour speaks. F must be known on both sides; sigma is unknown where no point was ever
    recovered, and then the other side's is the best there is.
    """
    out = np.asarray((1 - t) * first + t * second)
    sigma = out[..., 1::2]
    out[..., 1::2] = np.where(np.isnan(sigma), np.where(np.isnan(first), second, first)[..., 1::2], sigma)
    out = np.where(t == 0, first, np.where(t == 1, second, out))
    out[..., 5] = np.where(np.isnan(out[..., 4]), np.nan, out[..., 5])  # a neighbour's spread says nothing of this one
    return np.where(np.isnan(t), np.nan, out)


@dataclass(frozen=True)
class SampleTable:
    """Patches of one sample (finish, Ra [um] or NaN), or of a variant of it, at one nominal distance [mm]."""

    finish: str
    roughness: float
    distance: float
    patches: xr.Dataset
    variant: Variant | None = None


def build_map(
    tables: Sequence[SampleTable], attributes: dict[str, Any], largest_incidence: float, nodes: int = 49
) -> PerformanceMap:
    """Pool tables of patches into a map.

    Parameters
    ----------
    attributes
        Written into the map: ``sensor``, ``source``, ``exposure_rule`` and whatever makes it reproducible. The
        exposure policy is part of a map's identity.
    largest_incidence
        Of the campaign [rad]; nodes beyond it stay empty.
    nodes
        Along each axis of the equal-area grid.
    """
    samples = sorted({(t.finish, t.roughness if not math.isnan(t.roughness) else -1.0) for t in tables})
    distances = sorted({t.distance for t in tables})
    reach = 2 * math.sin(largest_incidence / 2)
    axis = np.linspace(-reach, reach, nodes)
    shape = (len(samples), len(distances), nodes, nodes)
    fields = {name: np.full(shape, np.nan) for name in (*_FIELDS, *_SPREADS, "false_fraction", "patches")}
    ends: dict[tuple[int, int], dict[Variant, dict[str, Floats]]] = {}
    for table in tables:
        key = (table.finish, table.roughness if not math.isnan(table.roughness) else -1.0)
        i, j = samples.index(key), distances.index(table.distance)
        pooled = _pool(table.patches, axis, largest_incidence)
        if table.variant is not None:
            ends.setdefault((i, j), {})[table.variant] = pooled
            continue
        for name, values in pooled.items():
            fields[name][i, j] = values
    for place, variants in ends.items():
        for name, spread in zip(_FIELDS, _SPREADS, strict=False):
            fields[spread][place] = _spread({variant: pooled[name] for variant, pooled in variants.items()})
    dims = ("sample", "distance", "b", "a")
    described = {
        "recovered_fraction": ("1", "fraction of points recovered, F"),
        "ray_noise_std": ("mm", "standard deviation along the view ray, sigma, outliers left out"),
        "recovered_fraction_error": ("1", "standard error of F in the map"),
        "ray_noise_std_error": ("mm", "standard error of sigma in the map"),
        "recovered_fraction_spread": ("1", "standard uncertainty of F by what is not known of the sample"),
        "ray_noise_std_spread": ("mm", "standard uncertainty of sigma by what is not known of the sample"),
        "false_fraction": ("1", "false points, over possible ones"),
        "patches": ("1", "patches pooled, by weight"),
    }
    data = xr.Dataset(
        {n: (dims, v.astype(np.float32), dict(zip(("units", "long_name"), described[n], strict=True)))
         for n, v in fields.items()},
        coords={
            "finish": ("sample", np.array([s[0] for s in samples], dtype=str)),
            "roughness": ("sample", [s[1] if s[1] >= 0 else np.nan for s in samples],
                          {"units": "um", "long_name": "roughness average Ra"}),
            "distance": ("distance", distances, {"units": "mm", "long_name": "|V|"}),
            "a": ("a", axis, {"units": "1", "long_name": "equal-area place along the baseline"}),
            "b": ("b", axis, {"units": "1", "long_name": "equal-area place across the baseline"}),
        },
        attrs={"title": "performance map", "schema_version": 1, **attributes},
    )  # fmt: skip
    return PerformanceMap(data)


def _spread(ends: dict[Variant, Floats]) -> Floats:
    """Half differences between the high and the low end of each quantity, root sum of squares."""
    moved = sorted({quantity for quantity, _ in ends})
    return np.asarray(np.sqrt(sum(((ends[q, "high"] - ends[q, "low"]) / 2) ** 2 for q in moved)))


def _pool(patches: xr.Dataset, axis: Floats, largest_incidence: float) -> dict[str, Floats]:
    """Kernel-pooled fields (b, a) of one sample at one distance.

    F pools counts; sigma pools variances by degrees of freedom. Errors come from the scatter between patches, so
    they know about correlated pixels, which a binomial interval does not.
    """
    b, a = np.meshgrid(axis, axis, indexing="ij")
    places = np.stack([a.ravel(), b.ravel()], axis=-1)
    nodes = from_equal_area(places)
    nodes[(places**2).sum(-1) > (2 * math.sin(largest_incidence / 2)) ** 2 * (1 + 1e-9)] = np.nan
    n_x, n_y = patches["normal_x"].values, patches["normal_y"].values
    normals = np.stack([n_x, n_y, np.sqrt(np.maximum(1 - n_x**2 - n_y**2, 0))], axis=-1)
    out = {name: np.full(len(nodes), np.nan) for name in (*_FIELDS, "false_fraction", "patches")}
    if len(normals) < NEIGHBOURS:
        return {name: values.reshape(b.shape) for name, values in out.items()}

    inside = np.flatnonzero(np.isfinite(nodes[:, 2]))
    tree = cKDTree(normals)
    chord, _ = tree.query(nodes[inside], k=NEIGHBOURS)
    angle = 2 * np.arcsin(np.clip(chord / 2, 0, 1))
    keep = angle[:, 0] <= REACH
    inside, width = inside[keep], np.maximum(angle[keep, -1], BANDWIDTH)

    count, possible = patches["points"].values.astype(float), patches["points_possible"].values.astype(float)
    sigma, false = patches["ray_noise_inliers"].values, patches["false_fraction"].values
    degrees = np.where((count - 3 >= LEAST_DEGREES) & np.isfinite(sigma), count - 3, 0.0)
    variance = np.nan_to_num(sigma) ** 2
    for node, bandwidth in zip(inside, width, strict=True):
        near = np.array(tree.query_ball_point(nodes[node], 2 * math.sin(1.5 * bandwidth)))
        distance = 2 * np.arcsin(np.clip(np.linalg.norm(normals[near] - nodes[node], axis=1) / 2, 0, 1))
        w = np.exp(-0.5 * (distance / bandwidth) ** 2)
        effective = w.sum() ** 2 / (w**2).sum()
        fraction = (w * count[near]).sum() / (w * possible[near]).sum()
        scatter = (w * (count[near] / possible[near] - fraction) ** 2).sum() / w.sum()
        floor = fraction * (1 - fraction) / (w * possible[near]).sum()
        out["recovered_fraction"][node] = fraction
        out["recovered_fraction_error"][node] = math.sqrt(max(scatter / max(effective - 1, 1), floor))
        out["false_fraction"][node] = (w * false[near]).sum() / w.sum()
        out["patches"][node] = effective
        wd = w * degrees[near]
        if wd.sum() > 0:
            pooled = (wd * variance[near]).sum() / wd.sum()
            spread = (wd * (variance[near] - pooled) ** 2).sum() / wd.sum()
            count_effective = max(wd.sum() ** 2 / (wd**2).sum() - 1, 1)
            out["ray_noise_std"][node] = math.sqrt(pooled)
            error = math.sqrt(max(spread / count_effective, 2 * pooled**2 / wd.sum()))
            out["ray_noise_std_error"][node] = error / (2 * math.sqrt(pooled)) if pooled > 0 else 0.0
    return {name: values.reshape(b.shape) for name, values in out.items()}
