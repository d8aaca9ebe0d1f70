"""What the report says of the numbers, against closed forms."""

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.words.numbers import count, listed, percent, rounded, two_digits
from mitsim.report import findings


def scores_of(u, possible=None, tolerance=None):
    """Scores whose u is (measurement, view); impossible views rank last."""
    u = np.atleast_2d(np.asarray(u, float))
    possible = np.isfinite(u) if possible is None else np.atleast_2d(possible)
    by = ("measurement", "view")
    rank = np.where(possible, u, np.inf).argsort(axis=1, kind="stable").argsort(axis=1) + 1
    fields = {"predicted_uncertainty": (by, u), "uncertainty_possible": (by, possible), "uncertainty_rank": (by, rank)}
    fields["tolerance"] = ("measurement", [np.nan] * len(u) if tolerance is None else tolerance)
    names = [f"m{i}" for i in range(len(u))]
    return xr.Dataset(fields, {"measurement": names, "view": 10 + np.arange(u.shape[1])})


def test_the_best_view_is_that_of_least_u_among_the_possible():
    assert findings.best_view(scores_of([0.3, 0.1, 0.2]), "m0") == 11
    assert findings.best_view(scores_of([0.3, 0.1, 0.2], [True, False, True]), "m0") == 12
    assert findings.best_view(scores_of([0.3, math.nan, 0.2]), "m0") == 12
    assert findings.best_view(scores_of([0.3, 0.1, 0.2], [False] * 3), "m0") is None
    assert findings.ranked_views(scores_of([0.3, 0.1, 0.2, 0.4], [True, False, True, True]), "m0").tolist() == [2, 0, 3]


def test_reason_shares_are_of_the_pixels_that_could_see_the_part():
    grid = ViewGrid(1, 1, 0, 0, 4, 1)

    def cloud(*status: Status) -> PointCloud:
        points = np.full((1, 4, 3), np.nan, np.float32)
        return PointCloud(points, np.array([status], np.uint8), grid, "s", "predicted")

    S = Status
    predicted = cloud(S.NO_SURFACE, S.VALID, S.VALID, S.DROPPED)
    decoded = cloud(S.LOW_MODULATION, S.VALID, S.HIDDEN, S.HIDDEN)
    shares = findings.reason_shares([(predicted, decoded)])
    assert shares == {
        S.VALID: (pytest.approx(2 / 3), pytest.approx(1 / 3)),
        S.HIDDEN: (0, pytest.approx(2 / 3)),
        S.DROPPED: (pytest.approx(1 / 3), 0),
    }
    assert findings.reason_shares([]) == {}


@pytest.mark.parametrize("limit_deg", [20, 35, 50])
def test_half_recovery_is_found_where_it_is(limit_deg):
    axis = np.linspace(-1.2, 1.2, 61)
    b, a = np.meshgrid(axis, axis, indexing="ij")
    radius = np.hypot(a, b)
    incidence = 2 * np.arcsin(np.minimum(radius / 2, 1))
    fraction = np.where(radius > 1.2, np.nan, incidence < np.radians(limit_deg))
    fraction[incidence < np.radians(6)] = 0.0  # a mirror's highlight in the middle does not end the search
    fields = ("recovered_fraction", "ray_noise_std", "recovered_fraction_error", "ray_noise_std_error")
    performance_map = PerformanceMap(
        xr.Dataset(
            dict.fromkeys(fields, (("sample", "distance", "b", "a"), fraction[None, None])),
            {"a": axis, "b": axis, "distance": [600.0], "finish": ("sample", ["x"]), "roughness": ("sample", [np.nan])},
        )
    )
    assert np.degrees(findings.half_recovery_incidence(performance_map, 0, 0)) == pytest.approx(limit_deg, abs=2.6)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.07048, "0.070"),
        (12.34, "12"),
        (1.26, "1.3"),
        (0.0996, "0.10"),
        (123.4, "120"),
        (-0.5, "−0.50"),
        (0, "0"),
        (9.96, "10"),
        (math.nan, "–"),
    ],
)
def test_two_digits(value, text):
    assert two_digits(value) == text


@given(st.floats(1e-6, 1e6))
def test_two_digits_are_within_half_of_the_last(value):
    assert float(two_digits(value)) == pytest.approx(value, rel=0.0501)


def test_numbers_in_words():
    assert rounded(-0.2) == "0" and rounded(-12.6) == "−13" and rounded(math.nan) == "–"
    assert percent(0.0001) == "<\N{NO-BREAK SPACE}0.1\N{NO-BREAK SPACE}%"
    assert percent(0.9951) == ">\N{NO-BREAK SPACE}99\N{NO-BREAK SPACE}%" and percent(1) == "100\N{NO-BREAK SPACE}%"
    assert percent(0.0996) == "10\N{NO-BREAK SPACE}%" and percent(0.054) == "5.4\N{NO-BREAK SPACE}%"
    assert count(16088) == "16\N{NARROW NO-BREAK SPACE}088"
    assert listed([]) == "" and listed(["a"]) == "a" and listed(["a", "b", "c"]) == "a, b and c"
