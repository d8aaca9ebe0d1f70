import csv

import numpy as np
import pytest
import xarray as xr
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from characterisation.scores.view_score import rank_views, score_table, score_views, view_statistics, write_scores
from characterisation.tasks.task_file import Feature, Measurement, Task

TASK = Task(
    features={
        "plane": Feature(kind="plane", point_mm=(0, 0, 0), direction=(0, 0, 1)),
        "pillar": Feature(kind="cylinder", point_mm=(0, 0, 0), direction=(0, 0, 1), radius_mm=20),
    },
    measurements={
        "angle": Measurement(kind="plane_axis_angle", features=("plane", "pillar"), nominal=0, unit="deg"),
        "pillar_radius": Measurement(kind="radius", features=("pillar",), nominal=20, unit="mm"),
    },
)

# three views of a plane and a pillar; in view 1 the pillar is not seen at all, in view 2 in white only
N = np.array([[1000.0, 400.0], [2000.0, 0.0], [1000.0, 20.0]])
SIGMA = np.array([[0.2, 0.1], [0.1, np.nan], [0.4, 0.2]])
N_WHITE = np.array([[2000.0, 800.0], [4000.0, 0.0], [2000.0, 400.0]])
SIGMA_WHITE = np.array([[0.1, 0.1], [0.1, np.nan], [0.2, 0.2]])
N_ONLY = np.array([[4000.0, 800.0], [4000.0, 0.0], [2000.0, 800.0]])


def statistics(**changes):
    given_arrays = {
        "n": N,
        "mean_sigma": SIGMA,
        "n_white": N_WHITE,
        "mean_sigma_white": SIGMA_WHITE,
        "n_only_white": N_ONLY,
    } | changes
    return view_statistics(["plane", "pillar"], **given_arrays)


def test_three_views_by_hand():
    scores = score_views(statistics(), TASK)
    # n^ = n / (4000, 800), sigma^ = sigma / (0.2, 0.2)
    assert scores["S_f"].values == pytest.approx(np.array([[0.25, 1.0], [1.0, 0.0], [0.125, 0.025]]))
    assert scores["S_f_hat"].values == pytest.approx(np.array([[0.25, 1.0], [1.0, 0.0], [0.125, 0.025]]))
    assert scores["R_f"].values == pytest.approx(np.array([[0.5, 1.0], [1.0, 0.0], [1.0, 0.5]]))
    assert scores["S_m"].values == pytest.approx(np.array([[1.25, 1.0, 0.15], [1.0, 0.0, 0.025]]))
    assert scores["R_m"].values == pytest.approx(np.array([[0.5, 0.0, 0.5], [1.0, 0.0, 0.5]]))
    assert scores["V_m"].values == pytest.approx(np.array([[0.625, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert scores["possible"].values.tolist() == [[True, False, False]] * 2
    assert scores["rank"].values.tolist() == [[1, 2, 3]] * 2
    assert scores["limited_by"].values.tolist() == [["", "pillar", "pillar"]] * 2


def test_a_second_hat_divides_by_the_best_view_of_each_feature():
    scores = score_views(statistics(n=N / 2), TASK)
    assert scores["S_f"].values.max(axis=0) == pytest.approx([0.5, 0.5])
    assert scores["S_f_hat"].values.max(axis=0) == pytest.approx([1.0, 1.0])


def test_few_points_are_enough_where_few_are_asked_for():
    scores = score_views(statistics(), TASK, minimum_points=20)
    assert scores["possible"].values.tolist() == [[True, False, True]] * 2
    assert scores["rank"].values.tolist() == [[1, 3, 2]] * 2
    assert scores["V_m"].values[:, 2] == pytest.approx([0.075, 0.0125])


def test_a_feature_that_no_view_sees_scores_nothing():
    hidden = dict.fromkeys(("n", "n_white"), np.array([[100.0, 0.0]])) | {"n_only_white": np.array([[100.0, 0.0]])}
    noise = dict.fromkeys(("mean_sigma", "mean_sigma_white"), np.array([[0.1, np.nan]]))
    scores = score_views(statistics(**hidden, **noise), TASK)
    assert scores["S_f"].values.tolist() == [[1.0, 0.0]]
    assert scores["R_f"].values.tolist() == [[1.0, 0.0]]
    assert not scores["possible"].values.any()


def test_every_variable_says_what_it_is():
    scores = score_views(statistics(), TASK)
    for variable in scores.data_vars.values():
        assert variable.attrs["long_name"]
        assert variable.attrs["units"] == "1"


def test_scores_survive_netcdf(tmp_path):
    scores = score_views(statistics(), TASK)
    scores.to_netcdf(tmp_path / "scores.nc")
    with xr.open_dataset(tmp_path / "scores.nc") as again:
        assert again["limited_by"].values.tolist() == scores["limited_by"].values.tolist()
        assert again["V_m"].values.tolist() == scores["V_m"].values.tolist()


def test_ties_go_to_the_lower_view_and_the_impossible_last():
    rank = rank_views(np.array([0.0, 2.0, 0.0, 2.0, 5.0]), np.array([False, True, True, True, True]))
    assert rank.tolist() == [5, 2, 4, 3, 1]


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"n": N[:2]}, "mean_sigma is"),
        ({"n": -N}, "not negative"),
        ({"n_white": np.full(N.shape, np.nan)}, "n_white"),
        ({"mean_sigma": np.zeros(N.shape)}, "mean_sigma: must be finite and greater than 0"),
        ({"mean_sigma_white": np.full(N.shape, np.nan)}, "mean_sigma_white"),
    ],
)
def test_impossible_numbers_are_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        statistics(**changes)


def test_a_feature_or_variable_that_is_absent_is_named():
    with pytest.raises(ValueError, match="n_only_white"):
        score_views(statistics().drop_vars("n_only_white"), TASK)
    with pytest.raises(ValueError, match="features pillar"):
        score_views(statistics().sel(feature=["plane"]), TASK)


def test_the_table_is_sorted_best_first(tmp_path):
    scores = score_views(statistics(), TASK, minimum_points=20)
    extra = {"azimuth_deg": [10.0, 20.0, 30.0], "expected_error": np.arange(6.0).reshape(2, 3)}
    write_scores(tmp_path / "scores.csv", scores, extra)
    with (tmp_path / "scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "measurement",
        "view",
        "rank",
        "view_score",
        "possible",
        "limited_by",
        "S_m",
        "R_m",
        "n_plane",
        "n_pillar",
        "azimuth_deg",
        "expected_error",
    ]
    assert [(row["measurement"], row["view"], row["rank"]) for row in rows] == [
        ("angle", "0", "1"),
        ("angle", "2", "2"),
        ("angle", "1", "3"),
        ("pillar_radius", "0", "1"),
        ("pillar_radius", "2", "2"),
        ("pillar_radius", "1", "3"),
    ]
    assert [row["azimuth_deg"] for row in rows[:3]] == ["10.0", "30.0", "20.0"]
    assert [row["expected_error"] for row in rows[3:]] == ["3.0", "5.0", "4.0"]
    assert (rows[2]["possible"], rows[2]["limited_by"], rows[2]["n_pillar"]) == ("False", "pillar", "0.0")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scores.csv"]


def test_a_refused_table_leaves_the_old_file(tmp_path):
    path = tmp_path / "scores.csv"
    path.write_text("old")
    scores = score_views(statistics(), TASK)
    with pytest.raises(ValueError, match="'azimuth_deg' is \\(2,\\)"):
        write_scores(path, scores, {"azimuth_deg": [1.0, 2.0]})
    with pytest.raises(ValueError, match="rank: these names are taken"):
        score_table(scores, {"rank": [1, 2, 3]})
    with pytest.raises(OSError):
        write_scores(tmp_path, scores)  # a folder
    assert path.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scores.csv"]


counts = arrays(float, (6, 2), elements=st.one_of(st.just(0.0), st.floats(1, 1e5)))
noises = arrays(float, (6, 2), elements=st.floats(1e-3, 10))
fractions = arrays(float, (6, 2), elements=st.one_of(st.just(0.0), st.floats(1e-6, 1)))


@settings(deadline=None, max_examples=40)  # xarray's first call is slow
@given(counts, noises, counts, noises, counts, st.floats(0, 1000))
def test_scores_are_finite_and_ranks_a_permutation(n, sigma, n_white, sigma_white, n_only, minimum):
    sigma, sigma_white = np.where(n > 0, sigma, np.nan), np.where(n_white > 0, sigma_white, np.nan)
    views = view_statistics(["plane", "pillar"], n, sigma, n_white, sigma_white, n_only)
    scores = score_views(views, TASK, minimum)
    for name in ("S_f", "S_f_hat", "R_f", "S_m", "R_m", "V_m"):
        assert (np.isfinite(scores[name].values) & (scores[name].values >= 0)).all()
    assert scores["S_f_hat"].values.max(initial=0) <= 1.0
    assert (np.sort(scores["rank"].values, axis=1) == np.arange(1, 7)).all()
    for possible, rank, V_m in zip(scores["possible"].values, scores["rank"].values, scores["V_m"].values, strict=True):
        assert rank[possible].max(initial=0) == possible.sum()  # possible views come first
        assert (np.diff(V_m[np.argsort(rank)][: possible.sum()]) <= 0).all()
        assert not V_m[~possible].any()
    assert ((scores["limited_by"].values == "") == scores["possible"].values).all()


@settings(deadline=None, max_examples=40)  # xarray's first call is slow
@given(counts, noises, st.integers(-8, 8))
def test_the_unit_of_sigma_does_not_matter(n, sigma, power):
    """Scaled by powers of 2, so that the floating-point results are the same to the last bit."""
    once, scaled = (
        score_views(view_statistics(["plane", "pillar"], n, s, n, s, n), TASK) for s in (sigma, sigma * 2.0**power)
    )
    assert (once["V_m"].values == scaled["V_m"].values).all()
    assert (once["rank"].values == scaled["rank"].values).all()


@settings(deadline=None, max_examples=40)  # xarray's first call is slow
@given(counts, noises, counts, fractions)
def test_more_occlusion_never_raises_the_occlusion_ratio(n, sigma, n_only, seen):
    assume((n_only > 0).any())
    more = np.linspace(1.0, 0.0, 6)[:, None]
    less_occluded, more_occluded = (
        score_views(view_statistics(["plane", "pillar"], n, sigma, white, sigma, n_only), TASK)
        for white in (n_only * seen, n_only * seen * more)
    )
    assert (more_occluded["R_m"].values <= less_occluded["R_m"].values).all()
    assert (less_occluded["R_f"].values <= 1.0).all()


@settings(deadline=None, max_examples=40)  # xarray's first call is slow
@given(counts, noises)
def test_twice_the_noise_of_a_view_never_lifts_it(n, sigma):
    noisier = sigma.copy()
    noisier[0] *= 2
    before, after = (
        score_views(view_statistics(["plane", "pillar"], n, s, n, sigma, n), TASK) for s in (sigma, noisier)
    )
    assert (after["S_f"].values[0] <= before["S_f"].values[0]).all()
    assert (after["rank"].values[1, 0] >= before["rank"].values[1, 0]).all()
