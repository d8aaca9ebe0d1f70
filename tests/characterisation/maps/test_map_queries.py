"""What a map answers between its nodes, distances and roughnesses: with a field known at the nodes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from characterisation.files.errors import InputError
from characterisation.lambert_projection import inverse_lambert_projection, lambert_projection
from characterisation.maps.building import NODES
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import FIELDS, from_probit, to_probit

AXIS = np.linspace(-1, 1, NODES)
B, A = np.meshgrid(AXIS, AXIS, indexing="ij")


def map_of(fraction, sigma, distances=(400.0, 600.0, 900.0), roughness=(0.1, 0.4, 1.6), error=0.01, relative=0.02):
    """Functions of (a, b, |V|, Ra), known for incidences up to 60 deg."""
    shape = (len(roughness), len(distances), NODES, NODES)
    ra, v = np.asarray(roughness)[:, None, None, None], np.asarray(distances)[:, None, None]
    values = [np.broadcast_to(f(A, B, v, ra), shape).astype(float) for f in (fraction, sigma)]
    values += [np.full(shape, error), relative * values[1]]
    known = np.hypot(A, B) <= 1 + 1e-9
    fields = {
        n: (("sample", "distance", "b", "a"), np.where(known, x, np.nan)) for n, x in zip(FIELDS, values, strict=False)
    }
    coordinates = {
        "finish": ("sample", ["metal"] * len(roughness)),
        "roughness": ("sample", list(roughness)),
        "distance": list(distances),
        "a": AXIS,
        "b": AXIS,
    }
    return PerformanceMap(xr.Dataset(fields, coordinates, {"name": "known", "schema_version": SCHEMA_VERSION}))


def power_law(a, b, v, ra):
    return 1e-6 * v**2 * ra**0.3 * np.exp(0.4 * a - 0.2 * b)


def plane(a, b, v, ra):
    """Linear in the place, ln |V| and ln Ra on the scale of probits."""
    return from_probit(np.asarray(0.7 + 0.3 * a + 0.2 * b - 0.8 * np.log(v / 600) + 0.3 * np.log(ra)))[0]


LINEAR = map_of(plane, power_law)


def directions(count, rng, largest=0.97):
    radius, turn = largest * np.sqrt(rng.random(count)), rng.uniform(0, 2 * math.pi, count)
    place = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    return place, inverse_lambert_projection(place)


@given(st.floats(400, 900), st.floats(0.1, 1.6), st.integers(0, 10**6))
@settings(deadline=None, max_examples=40)
def test_a_power_law_of_distance_and_roughness_is_kept_exactly(distance, roughness, seed):
    place, normals = directions(50, np.random.default_rng(seed))
    found = LINEAR.query("metal", roughness, np.full(50, distance), normals)
    # single precision: 1e-7 of ln sigma, of places in steps of the grid, and of F
    assert np.allclose(found.sigma, power_law(*place.T, distance, roughness), rtol=2e-5)
    assert np.allclose(found.fraction, plane(*place.T, distance, roughness), atol=2e-5)


def test_it_agrees_with_scipys_interpolator():
    rng = np.random.default_rng(11)

    def rough(a, b, v, ra):
        return 0.5 + 0.4 * np.sin(9 * a + v / 100) * np.cos(7 * b) * ra / 1.6

    performance_map = map_of(rough, lambda *at: 0.1 + 0.1 * rough(*at))
    place, normals = directions(40_000, rng, 0.9)  # more than two runs
    distance = rng.uniform(400, 900, len(place))
    found = performance_map.query("metal", 0.4, distance, normals)
    axes = (np.log(performance_map.data["distance"].values), AXIS, AXIS)
    at = np.column_stack([np.log(distance), place[:, 1], place[:, 0]])
    fraction, sigma = (performance_map.data[name].values[1] for name in ("recovered_fraction", "ray_noise_std"))
    probit = RegularGridInterpolator(axes, np.nan_to_num(to_probit(fraction)[0]))(at)
    assert np.allclose(found.fraction, from_probit(probit)[0], atol=3e-5)
    assert np.allclose(np.log(found.sigma), RegularGridInterpolator(axes, np.nan_to_num(np.log(sigma)))(at), atol=3e-5)


def test_errors_of_two_knots_join_as_independent_ones():
    """The probit of F and ln sigma are linear in ln |V|: half way in it, half of the root sum; at a knot its own."""
    axis = np.array([[0.0, 0.0, 1.0]])
    half = LINEAR.query("metal", 0.4, [math.sqrt(400 * 600)], axis)
    per_fraction = [to_probit(plane(0, 0, v, 0.4))[1] for v in (400, math.sqrt(400 * 600), 600)]
    expected = 0.01 * math.hypot(per_fraction[0], per_fraction[2]) / 2 / per_fraction[1]
    assert half.fraction_error == pytest.approx(expected, rel=1e-5)
    assert half.sigma_error / half.sigma == pytest.approx(0.02 / math.sqrt(2), rel=1e-5)
    knot = LINEAR.query("metal", 0.4, [600.0], axis)
    assert knot.fraction_error == pytest.approx(0.01, rel=1e-6)
    assert knot.sigma_error / knot.sigma == pytest.approx(0.02, rel=1e-6)


@pytest.mark.parametrize("along", ["distance", "roughness"])
def test_a_bend_between_knots_is_in_the_error(along):
    """The probit a parabola in the logarithm: what the straight line leaves out is known exactly from three knots."""
    knots = np.log([400.0, 600.0, 900.0] if along == "distance" else [0.1, 0.4, 1.6])

    def parabola(a, b, v, ra):
        z = 0.5 + 0.2 * (np.log(v if along == "distance" else ra) - knots[1]) ** 2 + 0 * (a + v + ra)
        return from_probit(np.asarray(z))[0]

    performance_map = map_of(parabola, power_law, error=1e-6)
    share = 0.3
    at = math.exp(knots[0] + share * (knots[1] - knots[0]))
    where = (0.4, [at]) if along == "distance" else (at, [600.0])
    found = performance_map.query("metal", *where, np.array([[0.0, 0.0, 1.0]]))
    left_out = 0.2 * share * (1 - share) * (knots[1] - knots[0]) ** 2
    z, per_fraction = to_probit(found.fraction)
    assert z - to_probit(parabola(0, 0, at, at))[0] == pytest.approx(left_out, rel=1e-3)
    assert found.fraction_error * per_fraction == pytest.approx(left_out, rel=1e-3)


def test_between_two_knots_alone_the_error_is_unknown():
    two = map_of(plane, power_law, distances=(400.0, 600.0), roughness=(0.1, 0.4))
    axis = np.array([[0.0, 0.0, 1.0]])
    for roughness, distance in ((0.1, 500.0), (0.2, 400.0)):
        found = two.query("metal", roughness, [distance], axis)
        assert np.isfinite(found.fraction) and np.isfinite(found.sigma)
        assert np.isnan(found.fraction_error) and np.isnan(found.sigma_error)
    assert np.isfinite(two.query("metal", 0.4, [600.0], axis).fraction_error)


def test_nothing_is_said_beyond_half_a_cell_of_the_known_nodes():
    """Nodes within 60 deg are known; an answer needs known corners that hold half of the weight."""
    turn, step = np.linspace(0, 2 * math.pi, 400), AXIS[1] - AXIS[0]
    for radius, answered in ((1 - 0.75 * step, True), (1 + 0.75 * step, False)):
        normals = inverse_lambert_projection(radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
        found = LINEAR.query("metal", 0.4, np.full(400, 600.0), normals)
        for values in (found.fraction, found.sigma, found.fraction_error, found.sigma_error):
            assert np.isfinite(values).all() if answered else np.isnan(values).all()


@pytest.mark.parametrize("distance", [399.9, 900.1, 0.0, -500.0, math.nan, math.inf])
def test_nothing_is_said_at_other_distances(distance):
    found = LINEAR.query("metal", 0.4, [distance], np.array([[0.0, 0.0, 1.0]]))
    assert all(np.isnan(values).all() for values in vars(found).values())


@pytest.mark.parametrize("normal", [[0, 0, -1], [1, 0, 0], [math.nan] * 3, [0.9, 0, math.sqrt(0.19)]])
def test_nothing_is_said_of_other_normals(normal):
    found = LINEAR.query("metal", 0.4, [600.0, 600.0], np.array([normal, [0.0, 0.0, 1.0]], float))
    assert np.isnan(found.fraction[0]) and np.isnan(found.sigma[0])
    assert np.isfinite(found.fraction[1])


def test_one_distance_answers_there_and_nowhere_else():
    one = map_of(plane, power_law, distances=(600.0,))
    found = one.query("metal", 0.4, [600.0, 601.0], np.array([[0.0, 0.0, 1.0]] * 2))
    assert found.fraction[0] == pytest.approx(plane(0, 0, 600, 0.4), abs=1e-6) and np.isnan(found.fraction[1])
    assert found.fraction_error[0] == pytest.approx(0.01)


def test_a_hole_of_sigma_takes_that_of_its_brim_where_f_is_not_zero():
    """F falls to 0 within 10 deg; where a corner still has F, there is a sigma to draw with."""
    performance_map = map_of(lambda a, b, v, ra: np.where(np.hypot(a, b) < 0.17, 0, 0.8) + 0 * v * ra, power_law)
    sigma, fraction = (performance_map.data[name] for name in ("ray_noise_std", "recovered_fraction"))
    performance_map = PerformanceMap(performance_map.data.assign(ray_noise_std=sigma.where(fraction > 0)))
    place, normals = directions(5000, np.random.default_rng(1), 0.3)
    found = performance_map.query("metal", 0.4, np.full(5000, 500.0), normals)
    assert (found.fraction[np.isnan(found.sigma)] == 0).all()
    assert (found.fraction[np.isfinite(found.sigma)] > 1e-5).mean() > 0.999  # the others: a corner of no weight
    assert 0 < (found.fraction == 0).mean() < 1
    deep = np.hypot(*place.T) < 0.17 - 0.03
    assert (found.fraction[deep] == 0).all()


def test_shapes_of_queries_are_kept():
    found = LINEAR.query("metal", 0.4, 500.0, np.broadcast_to([0.0, 0.0, 1.0], (4, 5, 3)))
    assert found.fraction.shape == (4, 5)
    assert LINEAR.query("metal", 0.4, np.empty(0), np.empty((0, 3))).sigma.shape == (0,)


def test_one_normal_is_that_of_every_distance():
    distances = np.array([450.0, 500.0, 700.0])
    one = LINEAR.query("metal", 0.4, distances, np.array([0.6, 0.0, 0.8]))
    each = LINEAR.query("metal", 0.4, distances, np.tile([0.6, 0.0, 0.8], (3, 1)))
    assert np.array_equal(one.sigma, each.sigma) and np.isfinite(one.sigma).all()
    assert LINEAR.query("metal", 0.4, 500.0, [0.6, 0.0, 0.8]).sigma == each.sigma[1]


@pytest.mark.parametrize(
    ("distance", "normals", "message"),
    [
        ([500.0, 500.0], [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]], "0.0, 0.0, 2.0"),
        (500.0, [0.0, 0.0, 0.0], "length 1"),
        ([500.0, 500.0], [[0.0, 0.0, 1.0]] * 3, "as many"),
        (500.0, [0.0, 1.0], "one"),
    ],
)
def test_a_query_of_no_normals_is_refused(distance, normals, message):
    """A normal twice as long was taken for another direction: F and sigma of another tilt."""
    with pytest.raises(InputError, match=message):
        LINEAR.query("metal", 0.4, distance, normals)


def test_a_compact_file_is_small_and_answers_the_same(tmp_path):
    LINEAR.save(tmp_path / "whole.nc")
    LINEAR.save(tmp_path / "compact.nc", compact=True)
    assert (tmp_path / "compact.nc").stat().st_size < 0.2 * (tmp_path / "whole.nc").stat().st_size
    compact = PerformanceMap.load(tmp_path / "compact.nc")
    _, normals = directions(1000, np.random.default_rng(2))
    whole, again = (m.query("metal", 0.3, np.full(1000, 555.0), normals) for m in (LINEAR, compact))
    # 10 bits of mantissa, rounded: 2^-11 of a value; 5 bits: 2^-6 of an error
    assert np.allclose(again.fraction, whole.fraction, rtol=2**-11)
    assert np.allclose(again.sigma, whole.sigma, rtol=2**-11 + 1e-6)
    assert np.allclose(again.fraction_error, whole.fraction_error, rtol=2**-6)


@pytest.mark.parametrize("version", [SCHEMA_VERSION + 1, 1, "two"])
def test_a_map_of_another_schema_is_refused(version, tmp_path):
    PerformanceMap(LINEAR.data.assign_attrs(schema_version=version)).save(tmp_path / "map.nc")
    with pytest.raises(InputError, match=f"schema_version: found .*{version}.*allowed: 2"):
        PerformanceMap.load(tmp_path / "map.nc")


def test_equal_area_places_are_looked_up_where_the_nodes_are():
    node = inverse_lambert_projection(np.array([[AXIS[60], AXIS[30]]]))
    assert np.allclose(lambert_projection(node), [AXIS[60], AXIS[30]])
    found = LINEAR.query("metal", 0.4, [600.0], node)
    assert found.fraction == pytest.approx(LINEAR.data["recovered_fraction"].values[1, 1, 30, 60], abs=1e-6)
