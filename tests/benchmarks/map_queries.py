"""How long a query of a performance map takes, beside a plain look-up and scipy's.

python tests/benchmarks/map_queries.py [queries] [rounds]

A map of known functions with three distances and three samples is asked for F, sigma and their standard errors at
random distances and normals of one surface. All rows of the table run in turns, round after round, so that a slow
moment of the machine falls on all of them. "former" is the look-up of schema 1: one gather of all fields for each
corner, linear in |V|, two samples for a Ra between them. scipy's interpolate the same four fields at a sample's Ra, and
add no error of interpolation.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

from characterisation.lambert_projection import lambert_projection
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import FIELDS

DISTANCES, ROUGHNESS, NODES, REACH = np.array([400.0, 565.7, 800.0]), np.array([0.1, 0.4, 1.6]), 97, 1.0


def a_map() -> PerformanceMap:
    """F and sigma known within 60 deg of incidence."""
    axis = np.linspace(-REACH, REACH, NODES)
    b, a = np.meshgrid(axis, axis, indexing="ij")
    radius, distance, ra = np.hypot(a, b), DISTANCES[:, None, None], ROUGHNESS[:, None, None, None]
    fraction = np.clip(1.1 - 0.4 * radius - 0.2 * distance / 800 + 0.05 * a, 0, 1) * (1 - 0.05 * ra)
    sigma = 1e-6 * distance**2 * (1 + radius**2) * (1 + 0.3 * ra)
    values = dict(zip(FIELDS, (fraction, sigma, 0.02 + 0 * fraction, 0.05 * sigma), strict=False))
    fields = {n: (("sample", "distance", "b", "a"), np.where(radius > REACH, np.nan, v)) for n, v in values.items()}
    coordinates = {"finish": ("sample", ["metal"] * 3), "roughness": ("sample", ROUGHNESS), "distance": DISTANCES}
    return PerformanceMap(xr.Dataset(fields, {**coordinates, "a": axis, "b": axis}, {"name": "known"}))


def queries(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) [mm] and normals (n, 3) within 59 deg, equally many for equal solid angles."""
    rng = np.random.default_rng(1)
    z, turn = rng.uniform(math.cos(math.radians(59)), 1, count), rng.uniform(0, 2 * math.pi, count)
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=-1)
    return rng.uniform(400, 800, count), normals


def former(fields: np.ndarray, distance: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The look-up of schema 1, of one sample: ``fields`` (distance, b, a, 6)."""
    near = np.clip(np.searchsorted(DISTANCES, distance) - 1, 0, len(DISTANCES) - 2)
    t = ((distance - DISTANCES[near]) / (DISTANCES[near + 1] - DISTANCES[near]))[:, None]
    place = (lambert_projection(normals) + REACH) / (2 * REACH / (NODES - 1))
    corner = np.clip(np.floor(place).astype(int), 0, NODES - 2)
    (column, row), (u, v) = corner.T, (place - corner).T
    total, weight = np.zeros((len(distance), 6)), np.zeros((len(distance), 6))
    for d_row, w_row in ((0, 1 - v), (1, v)):
        for d_column, w_column in ((0, 1 - u), (1, u)):
            first = fields[near, row + d_row, column + d_column]
            second = fields[near + 1, row + d_row, column + d_column]
            value = np.asarray((1 - t) * first + t * second)
            sigma = value[..., 1::2]
            value[..., 1::2] = np.where(np.isnan(sigma), np.where(np.isnan(first), second, first)[..., 1::2], sigma)
            value = np.where(t == 0, first, np.where(t == 1, second, value))
            w = np.where(np.isfinite(value), (w_row * w_column)[:, None], 0.0)
            total += w * np.nan_to_num(value)
            weight += w
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0.25, total / weight, np.nan)


def rows(count: int) -> dict[str, Callable[[], object]]:
    """What is timed, by its name in the table."""
    performance_map = a_map()
    distance, normals = queries(count)
    names = [*FIELDS[:4]]
    four = [performance_map.data[name].values[1] for name in names]
    six = np.stack([*four, *[np.full_like(four[0], np.nan)] * 2], axis=-1)
    axis = performance_map.data["a"].values
    grids = [RegularGridInterpolator((DISTANCES, axis, axis), np.nan_to_num(field)) for field in four]

    def interpolator() -> list[np.ndarray]:
        place = lambert_projection(normals)
        at = np.column_stack([distance, place[:, 1], place[:, 0]])
        return [grid(at) for grid in grids]

    def coordinates() -> list[np.ndarray]:
        place = (lambert_projection(normals) + REACH) / (2 * REACH / (NODES - 1))
        at = np.stack([np.interp(distance, DISTANCES, np.arange(3)), place[:, 1], place[:, 0]])
        return [map_coordinates(np.nan_to_num(field), at, order=1) for field in four]

    return {
        "PerformanceMap.query, Ra of a sample": lambda: performance_map.query("metal", 0.4, distance, normals),
        "PerformanceMap.query, Ra between": lambda: performance_map.query("metal", 0.3, distance, normals),
        "former, Ra of a sample": lambda: former(six, distance, normals),
        "former, Ra between (two samples)": lambda: [former(six, distance, normals) for _ in (0, 1)],
        "scipy RegularGridInterpolator, 4 fields": interpolator,
        "scipy map_coordinates order=1, 4 fields": coordinates,
    }


def main(count: int = 1_000_000, rounds: int = 5) -> None:
    """Print the table."""
    timed = rows(count)
    seconds: dict[str, list[float]] = {name: [] for name in timed}
    for _ in range(rounds):
        for name, ask in timed.items():
            start = time.perf_counter()
            ask()
            seconds[name].append(time.perf_counter() - start)
    print(f"{count} queries, {rounds} rounds; microseconds a query")
    print(f"{'':42s}{'best':>8s}{'median':>8s}")
    for name, values in seconds.items():
        print(f"{name:42s}{min(values) / count * 1e6:8.3f}{statistics.median(values) / count * 1e6:8.3f}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
