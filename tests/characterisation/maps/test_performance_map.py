"""The map gives back the functions that it was made of, and says nothing beyond them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from characterisation.coupon.orientations import cap_directions, sphere_directions
from characterisation.coupon.patch_table import patch_table
from characterisation.files.errors import InputError
from characterisation.lambert_projection import inverse_lambert_projection, lambert_projection
from characterisation.maps.building import SampleTable, build_map
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.tables import from_probit, to_probit
from tests.characterisation.maps.known_sensor import without_offsets

LARGEST = math.radians(50)


def known_fraction(normals):
    return 0.95 - 0.6 * (1 - normals[:, 2]) + 0.1 * normals[:, 0]


def known_sigma(normals, distance, roughness):
    return 1e-6 * distance**2 * (1 + 0.8 * (1 - normals[:, 2])) * (1 + 0.2 * math.log(roughness))


def at_nominal(normals, distance):
    """Columns of patches of which those of one normal are one capture."""
    capture = np.unique(np.round(normals, 6), axis=0, return_inverse=True)[1].ravel()
    nominal = np.full(len(normals), float(distance))
    return {"orientation": capture, "distance": nominal, **without_offsets(len(normals))}


def table_of(normals, distance, roughness, finish, rng):
    fraction, sigma = known_fraction(normals), known_sigma(normals, distance, roughness)
    possible = np.full(len(normals), 113)
    count = rng.binomial(113, fraction)
    degrees = count - 3
    measured = sigma * np.sqrt(rng.chisquare(degrees) / degrees)
    patches = patch_table(
        normal_x=normals[:, 0],
        normal_y=normals[:, 1],
        points=count,
        points_possible=possible,
        ray_noise_inliers=measured,
        false_fraction=np.zeros(len(normals)),
        **at_nominal(normals, distance),
    )
    return SampleTable(finish, roughness if finish != "matt_white" else math.nan, distance, patches)


@pytest.fixture(scope="module")
def performance_map():
    rng = np.random.default_rng(7)
    normals = np.repeat(cap_directions(4, LARGEST), 3, axis=0)
    tables = [table_of(normals, d, ra, "metal", rng) for d in (400.0, 600.0, 800.0) for ra in (0.1, 0.4)]
    tables.append(table_of(normals, 600.0, 1.0, "matt_white", rng))
    return build_map(tables, {"name": "known", "sensor": "known"}, LARGEST, nodes=29)


def test_known_functions_come_back_within_their_own_errors(performance_map, rng):
    normals = cap_directions(3, math.radians(42))
    answer = performance_map.query("metal", 0.4, np.full(len(normals), 600.0), normals)
    z_fraction = (answer.fraction - known_fraction(normals)) / answer.fraction_error
    z_sigma = (answer.sigma - known_sigma(normals, 600.0, 0.4)) / answer.sigma_error
    assert np.isfinite(z_fraction).all()
    for z in (z_fraction, z_sigma):
        assert abs(np.median(z)) < 0.5
        assert 0.88 < (np.abs(z) < 2).mean() <= 1.0
    assert np.abs(answer.fraction - known_fraction(normals)).mean() < 0.02
    assert np.abs(answer.sigma / known_sigma(normals, 600.0, 0.4) - 1).mean() < 0.03


def test_the_logarithm_of_sigma_is_linear_in_those_of_distance_and_roughness(performance_map):
    """Half way between two knots of a logarithm lies their geometric mean."""
    normals = cap_directions(2, math.radians(40))
    at = np.full(len(normals), math.sqrt(400.0 * 600.0))
    middle = performance_map.query("metal", 0.2, at, normals)
    corners = [
        performance_map.query("metal", ra, np.full(len(normals), d), normals)
        for ra in (0.1, 0.4)
        for d in (400.0, 600.0)
    ]
    assert np.allclose(np.log(middle.sigma), np.mean([np.log(c.sigma) for c in corners], axis=0), atol=1e-6)
    probits = np.mean([to_probit(c.fraction)[0] for c in corners], axis=0)
    assert np.allclose(middle.fraction, from_probit(probits)[0], atol=1e-5)


def test_matt_white_has_no_roughness(performance_map):
    axis = np.array([[0.0, 0.0, 1.0]])
    answers = [performance_map.query("matt_white", ra, np.array([600.0]), axis).fraction for ra in (math.nan, 3.0)]
    assert answers[0] == answers[1]


@pytest.mark.parametrize("distance", [399.0, 801.0])
def test_nothing_is_said_outside_the_distances(performance_map, distance):
    answer = performance_map.query("metal", 0.2, np.array([distance]), np.array([[0.0, 0.0, 1.0]]))
    assert np.isnan(answer.fraction)


def test_nothing_is_said_beyond_the_largest_incidence(performance_map):
    steep = np.array([[math.sin(a), 0.0, math.cos(a)] for a in np.radians([56, 80, 89])])
    assert np.isnan(performance_map.query("metal", 0.2, np.full(3, 600.0), steep).fraction).all()
    assert np.isnan(performance_map.query("metal", 0.2, np.array([600.0]), np.array([[0.0, 0.0, -1.0]])).fraction)


@pytest.mark.parametrize("roughness", [0.05, 0.7])
def test_roughness_is_not_extrapolated(performance_map, roughness):
    with pytest.raises(InputError, match=r"allowed: 0\.1 to 0\.4 um"):
        performance_map.query("metal", roughness, np.array([600.0]), np.array([[0.0, 0.0, 1.0]]))


def test_an_unknown_finish_names_the_nearest(performance_map):
    with pytest.raises(InputError, match="did you mean 'matt_white'"):
        performance_map.query("mat_white", 0.1, np.array([600.0]), np.array([[0.0, 0.0, 1.0]]))


def test_saved_and_loaded_it_answers_the_same(performance_map, tmp_path):
    performance_map.save(tmp_path / "map.nc")
    again = PerformanceMap.load(tmp_path / "map.nc")
    normals = cap_directions(2, math.radians(40))
    where = ("metal", 0.3, np.full(len(normals), 555.0), normals)
    assert np.array_equal(again.query(*where).sigma, performance_map.query(*where).sigma)
    assert str(again.samples) == str(performance_map.samples)
    assert [p.name for p in tmp_path.iterdir()] == ["map.nc"]


def test_files_that_are_no_map_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        PerformanceMap.load(tmp_path / "map.nc")
    (tmp_path / "text.nc").write_text("not netCDF")
    with pytest.raises(InputError, match="cannot be read"):
        PerformanceMap.load(tmp_path / "text.nc")
    xr.Dataset({"x": 1}).to_netcdf(tmp_path / "other.nc")
    with pytest.raises(InputError, match="recovered_fraction"):
        PerformanceMap.load(tmp_path / "other.nc")


SHIFTS = {("alpha", "low"): -0.1, ("alpha", "high"): 0.2, ("share", "low"): -0.3, ("share", "high"): 0.1}


def node_normals(performance_map, largest):
    """Normals of the map's nodes up to an incidence: there nothing is interpolated."""
    a, b = np.meshgrid(performance_map.data["a"], performance_map.data["b"], indexing="ij")
    normals = inverse_lambert_projection(np.column_stack([a.ravel(), b.ravel()]))
    return normals[normals[:, 2] > math.cos(largest)]


def with_spread(finish, roughness, distances=(400.0, 600.0)):
    """A sample of F 0.5 and 0.2 of noise along the normal, whose variants are moved by SHIFTS."""
    normals = np.repeat(cap_directions(2, LARGEST), 8, axis=0)

    def table(distance, shift, variant):
        many = np.full(len(normals), 1.0)
        patches = patch_table(
            normal_x=normals[:, 0],
            normal_y=normals[:, 1],
            points=1000 * (0.5 + shift) * many,
            points_possible=1000 * many,
            ray_noise_inliers=(0.2 - shift / 5) / normals[:, 2],
            false_fraction=0 * many,
            **at_nominal(normals, distance),
        )
        return SampleTable(finish, roughness, distance, patches, variant)

    return [table(d, shift, variant) for d in distances for variant, shift in {None: 0.0, **SHIFTS}.items()]


def test_spread_is_the_root_sum_of_squares_of_half_differences():
    plain = [table for table in with_spread("metal", 0.4) if table.variant is None]
    tables = with_spread("metal", 0.1) + plain
    performance_map = build_map(tables, {"name": "known"}, LARGEST, nodes=17)
    normals = node_normals(performance_map, math.radians(40))
    here = np.full(len(normals), 500.0)
    found = performance_map.query("metal", 0.1, here, normals)
    assert np.allclose(found.fraction, 0.5)
    assert np.allclose(found.fraction_spread, math.hypot(0.15, 0.2), rtol=1e-6)
    assert np.allclose(found.sigma_spread * normals[:, 2], math.hypot(0.03, 0.04), rtol=1e-6)
    for roughness in (0.4, 0.2):  # of a sample without variants nothing is known, nor between it and its neighbour
        found = performance_map.query("metal", roughness, here, normals)
        assert np.isfinite(found.sigma).all()
        assert np.isnan(found.fraction_spread).all() and np.isnan(found.sigma_spread).all()


def test_variants_leave_the_rest_of_the_map_as_it_is():
    tables = with_spread("metal", 0.1)
    whole = build_map(tables, {}, LARGEST, nodes=17).data
    plain = build_map([table for table in tables if table.variant is None], {}, LARGEST, nodes=17).data
    for name in plain.data_vars:
        assert np.array_equal(plain[name], whole[name], equal_nan=True) == ("spread" not in str(name)), name


def test_a_map_from_before_there_were_spreads_still_answers(performance_map):
    names = [name for name in performance_map.data.data_vars if "spread" in str(name)]
    assert len(names) == 2
    former = PerformanceMap(performance_map.data.drop_vars(names))
    where = ("metal", 0.3, np.full(1, 555.0), np.array([[0.0, 0.0, 1.0]]))
    assert former.query(*where).fraction == performance_map.query(*where).fraction
    assert np.isnan(former.query(*where).fraction_spread).all()


@given(st.floats(0, 1.5), st.floats(-3.14, 3.14))
def test_equal_area_round_trip(incidence, azimuth):
    normal = np.array(
        [math.sin(incidence) * math.cos(azimuth), math.sin(incidence) * math.sin(azimuth), math.cos(incidence)]
    )
    place = lambert_projection(normal)
    assert np.isclose(np.linalg.norm(place), 2 * math.sin(incidence / 2), atol=1e-9)
    assert np.allclose(inverse_lambert_projection(place), normal, atol=1e-9)


def test_icosahedra_have_their_numbers_and_a_pole():
    for k, count in ((0, 12), (1, 42), (2, 162), (3, 642)):
        directions = sphere_directions(k)
        assert directions.shape == (count, 3)
        assert np.allclose(np.linalg.norm(directions, axis=1), 1)
        assert np.isclose(directions[:, 2].max(), 1)
    cap = cap_directions(3, math.radians(30))
    angle = np.arccos(np.clip(cap[:, 2], -1, 1))
    assert (np.diff(angle) > -1e-6).all()
    assert angle.max() <= math.radians(30)


def test_a_neighbour_that_recovered_nothing_does_not_silence_the_sample_that_was_measured(rng):
    """Shiny metal recovers nothing at a tilt, so its sigma is unknown there; that of the duller sample is known."""
    normals = np.repeat(cap_directions(2, LARGEST), 8, axis=0)
    tables = []
    for roughness, fraction in ((0.1, 0.0), (0.4, 0.9)):
        table = table_of(normals, 600.0, 0.4, "metal", rng)
        count = rng.binomial(113, fraction, len(normals))
        sigma = np.where(count > 10, 0.3 / normals[:, 2], np.nan)
        patches = table.patches.assign(points=("patch", count), ray_noise_inliers=("patch", sigma))
        tables += [SampleTable("metal", roughness, d, patches) for d in (400.0, 600.0)]
    performance_map = build_map(tables, {"name": "known"}, LARGEST, nodes=17)
    inside = node_normals(performance_map, math.radians(40))
    at = np.full(len(inside), 600.0)
    own = performance_map.query("metal", 0.4, at, inside)
    assert np.allclose(own.sigma * inside[:, 2], 0.3, rtol=1e-6)
    assert np.allclose(own.fraction, 0.9, atol=0.06)
    none = performance_map.query("metal", 0.1, at, inside)
    assert np.isnan(none.sigma).all()
    assert (none.fraction == 0).all()
    between = performance_map.query("metal", 0.2, at, inside)
    assert np.allclose(between.sigma * inside[:, 2], 0.3, rtol=1e-6)
    half = (to_probit(own.fraction)[0] + to_probit(none.fraction)[0]) / 2
    assert np.allclose(between.fraction, from_probit(half)[0], atol=1e-5)
