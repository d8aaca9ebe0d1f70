"""What the report says of the numbers, against closed forms."""

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import spearmanr

from characterisation.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.report import findings
from mitsim.report.numbers import count, listed, percent, rounded, two_digits


def scores_of(V, u, possible=None):
    V = np.asarray([V], float)
    possible = np.ones(V.shape, bool) if possible is None else np.asarray([possible])
    order = np.lexsort((-V[0], ~possible[0]))
    rank = np.empty(V.shape, int)
    rank[0, order] = np.arange(1, V.shape[1] + 1)
    dims = ("measurement", "view")
    fields = {"V_m": V, "possible": possible, "rank": rank, "predicted_standard_uncertainty": np.asarray([u], float)}
    return xr.Dataset(
        {name: (dims, values) for name, values in fields.items()},
        {"measurement": ["m"], "view": np.arange(V.shape[1])},
    )


def checks_of(views, errors):
    return xr.Dataset(
        {"error": (("measurement", "view", "repeat"), np.asarray([errors], float))},
        {"measurement": ["m"], "view": views},
    )


def test_agreement_of_checked_views():
    scores = scores_of([5, 4, 3, 2, 1], [0.1, 0.1, 0.2, 0.1, np.nan])
    nan = np.nan
    checks = checks_of([4, 3, 2, 1, 0], [[8, -8], [4, nan], [-2, 2], [nan, nan], [0.5, -1.5]])
    found = findings.agreement(scores, checks, "m")
    np.testing.assert_array_equal(found.score, [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(found.error, [8, 4, 2, nan, 1])
    np.testing.assert_array_equal(found.least, [8, 4, 2, nan, 0.5])
    np.testing.assert_array_equal(found.most, [8, 4, 2, nan, 1.5])
    np.testing.assert_array_equal(found.failed, [0, 0.5, 0, 1, 0])
    assert found.count == 4 and found.spearman == pytest.approx(-1)
    assert found.ratio == pytest.approx(np.median([40, 10, 10]))


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=4, max_size=30))
def test_rank_correlation_is_scipys_with_ties(pairs):
    x, y = np.array(pairs, float).T
    mine = findings.spearman(x, y)
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert math.isnan(mine)
    else:
        assert mine == pytest.approx(spearmanr(x, y).statistic, abs=1e-12)


def test_chance_level_is_where_students_test_gives_five_percent():
    rng = np.random.default_rng(3)
    n, level = 10, findings.chance_level(10)
    sizes = [abs(findings.spearman(rng.random(n), rng.random(n))) for _ in range(1500)]
    # 1500 draws: the share scatters by 0.0056, and the approximation is off by 0.002
    assert np.mean(np.array(sizes) > level) == pytest.approx(0.05, abs=0.02)
    assert math.isnan(findings.chance_level(3))


def test_best_view_and_view_for_all():
    scores = scores_of([1, 3, 2], [1, 1, 1])
    assert findings.best_view(scores, "m") == 1
    assert findings.view_for_all(scores) == (1, 1.0)
    none = scores_of([1, 3, 2], [1, 1, 1], [False] * 3)
    assert findings.best_view(none, "m") is None
    assert findings.view_for_all(none) is None
    assert findings.best_view(scores_of([1, 3, 2], [1, 1, 1], [True, False, True]), "m") == 2


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
    [(0.07048, "0.070"), (12.34, "12"), (1.26, "1.3"), (0.0996, "0.10"), (123.4, "120"), (-0.5, "−0.50"), (0, "0"),
     (9.96, "10"), (math.nan, "–")],
)  # fmt: skip
def test_two_digits(value, text):
    assert two_digits(value) == text


@given(st.floats(1e-6, 1e6))
def test_two_digits_are_within_half_of_the_last(value):
    assert float(two_digits(value)) == pytest.approx(value, rel=0.0501)


def test_numbers_in_words():
    assert rounded(-0.2) == "0" and rounded(-12.6) == "−13" and rounded(math.nan) == "–"
    assert percent(0.0001) == "<\N{NO-BREAK SPACE}0.1\N{NO-BREAK SPACE}%"
    assert percent(0.0996) == "10\N{NO-BREAK SPACE}%" and percent(0.054) == "5.4\N{NO-BREAK SPACE}%"
    assert count(16088) == "16\N{NARROW NO-BREAK SPACE}088"
    assert listed([]) == "" and listed(["a"]) == "a" and listed(["a", "b", "c"]) == "a, b and c"
