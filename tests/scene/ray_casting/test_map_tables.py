"""F and sigma on the device against the map's own answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.lambert_projection import inverse_lambert_projection, lambert_projection
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from characterisation.maps.tables import FIELDS
from mitsim.scene.backend import mi
from mitsim.scene.ray_casting.map_tables import MapTables

NODES = 25
AXIS = np.linspace(-1, 1, NODES)


def a_map(rng: np.random.Generator, distances: tuple[float, ...], unknown: float, silent: float) -> PerformanceMap:
    """Rough random fields, shares of whose nodes are unknown, or have no sigma because nothing came back."""
    shape = (2, len(distances), NODES, NODES)
    fraction = np.clip(rng.normal(0.6, 0.4, shape), 0, 1)
    sigma = np.exp(rng.normal(-2, 0.3, shape))
    lost = rng.random(shape) < silent
    fraction[lost], sigma[lost] = 0.0, np.nan
    holes = rng.random(shape) < unknown
    values = [np.where(holes, np.nan, one) for one in (fraction, sigma, 0.01 + 0 * fraction, 0.02 * sigma)]
    fields = {n: (("sample", "distance", "b", "a"), v) for n, v in zip(FIELDS, values, strict=False)}
    coordinates = {
        "finish": ("sample", ["metal"] * 2),
        "roughness": ("sample", [0.1, 0.4]),
        "distance": list(distances),
        "a": AXIS,
        "b": AXIS,
    }
    return PerformanceMap(xr.Dataset(fields, coordinates, {"name": "rough", "schema_version": SCHEMA_VERSION}))


def queries(rng: np.random.Generator, axis: np.ndarray, distances: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """|V| and N in single precision, within the map and beyond it, and at its knots and nodes."""
    place = rng.uniform(1.05 * axis[0], 1.05 * axis[-1], (count, 2))
    place[: count // 20] = rng.choice(axis, (count // 20, 2))
    normal = inverse_lambert_projection(place).astype(np.float32).astype(float)
    distance = rng.uniform(0.97 * distances[0], 1.03 * distances[-1], count)
    distance[count // 30 : count // 15] = rng.choice(distances, count // 15 - count // 30)
    return distance.astype(np.float32).astype(float), normal


def on_device(tables: MapTables, number: int, distance: np.ndarray, normal: np.ndarray) -> list[np.ndarray]:
    single = distance.astype(np.float32), normal.astype(np.float32).T
    answer = tables.look_up(mi.UInt32(number), mi.Float(single[0]), mi.Vector3f(single[1]), mi.Bool(True))
    return [np.array(values) for values in answer]


def undecided(surface, distance: np.ndarray, normal: np.ndarray, step: float) -> np.ndarray:
    """Queries so near to a limit of what is known, or to a node, that a rounding of normals decides; (n,)."""
    node = (lambert_projection(normal) - surface.first) / surface.step
    known = [np.isfinite(surface.look_up(distance, normal)[k]) for k in (0, 1)]
    out = (np.abs(node - np.rint(node)) < 1e-4).any(-1)
    for move in np.ndindex(3, 3):
        moved = normal + step * np.array([move[0] - 1, move[1] - 1, 0])
        there = surface.look_up(distance, moved / np.linalg.norm(moved, axis=1, keepdims=True))
        out |= (np.isfinite(there[0]) != known[0]) | (np.isfinite(there[1]) != known[1])
    return out


@pytest.mark.parametrize(("name", "sample"), [("ensenso-n10", 2), ("ensenso-n10", 4), ("zivid-2-m70", 1)])
def test_a_map_that_comes_with_mitsim_answers_alike_on_the_device(name: str, sample: int) -> None:
    performance_map = PerformanceMap.load(shipped_maps()[name])
    surface = performance_map.surface(*performance_map.samples[sample])
    axis, distances = (performance_map.data[n].values.astype(float) for n in ("a", "distance"))
    distance, normal = queries(np.random.default_rng(1), axis, distances, 60_000)
    reference = surface.look_up(distance, normal)[:2]
    fraction, sigma = on_device(MapTables([surface]), 0, distance, normal)
    near = undecided(surface, distance, normal, 1e-6)
    assert near.mean() < 0.06  # the one in twenty that were put on nodes, which make the limit
    for got, expected in zip((fraction, sigma), reference, strict=True):
        assert np.array_equal(np.isnan(got)[~near], np.isnan(expected)[~near])
    answered = np.isfinite(fraction) & np.isfinite(reference[0])
    assert 0.3 < answered.mean() < 0.9
    # places have 7 digits of 97 nodes, so the way between two is good to 1e-5; F is steep in few places only
    assert np.abs(fraction - reference[0])[answered].max() < 1e-5
    known = np.isfinite(sigma) & np.isfinite(reference[1])
    error = np.abs(sigma / reference[1] - 1)[known]
    assert np.quantile(error, 0.999) < 1e-5
    assert error.max() < 1e-4


@given(
    seed=st.integers(0, 2**32 - 1),
    distances=st.sampled_from([(500.0,), (400.0, 600.0), (400.0, 512.0, 640.0, 900.0)]),
    unknown=st.sampled_from([0.0, 0.1, 0.5]),
    silent=st.sampled_from([0.0, 0.2]),
    roughness=st.sampled_from([0.1, 0.3]),
)
@settings(max_examples=12)
def test_what_is_unknown_on_the_device_is_what_the_map_does_not_know(seed, distances, unknown, silent, roughness):
    rng = np.random.default_rng(seed)
    performance_map = a_map(rng, distances, unknown, silent)
    surfaces = [performance_map.surface("metal", ra) for ra in (0.4, roughness)]
    distance, normal = queries(rng, AXIS, np.array(distances), 3000)
    if len(distances) == 1:
        distance[: len(distance) // 2] = distances[0]
    reference = surfaces[1].look_up(distance, normal)[:2]
    near = undecided(surfaces[1], distance, normal, 1e-6)
    for got, expected in zip(on_device(MapTables(surfaces), 1, distance, normal), reference, strict=True):
        assert np.array_equal(np.isnan(got)[~near], np.isnan(expected)[~near])
        both = np.isfinite(got) & np.isfinite(expected) & ~near
        # rough fields: probits and ln sigma differ by some units between nodes, over which places are good to 1e-6
        assert np.allclose(got[both], expected[both], rtol=3e-5, atol=1e-5)


def test_nothing_is_answered_from_behind_or_for_what_is_not_asked() -> None:
    surface = a_map(np.random.default_rng(1), (400.0, 600.0), 0.0, 0.0).surface("metal", 0.1)
    tables = MapTables([surface])
    behind = tables.look_up(mi.UInt32(0), mi.Float(500.0), mi.Vector3f(0.0, 0.0, -1.0), mi.Bool(True))
    silent = tables.look_up(mi.UInt32(0), mi.Float(500.0), mi.Vector3f(0.0, 0.0, 1.0), mi.Bool(False))
    asked = tables.look_up(mi.UInt32(0), mi.Float(500.0), mi.Vector3f(0.0, 0.0, 1.0), mi.Bool(True))
    assert all(math.isnan(value[0]) for value in (*behind, *silent))
    assert all(math.isfinite(value[0]) for value in asked)
