"""Screening judged by known risks: an order that is right, one that is reversed, and verdicts that are wrong."""

import numpy as np
import pytest
import xarray as xr

import tests.proofs.screening_run as screening_run
from characterisation.statements.selection import chance_after
from mitsim.study import session
from tests.proofs import screening_figures as screening
from tests.proofs.known_trials import NAMES, rows
from tests.proofs.part_cases import read_part_cases
from tests.proofs.screening_page import cells_of, described_screening, write_screening_page
from tests.proofs.screening_run import (
    ALONE,
    COSINE,
    POINTS,
    PREDICTED,
    TALK,
    in_order_of,
    measured_cost,
    screen_cases,
)

MORE = 24


def told(u, chance, study, points):
    """Scores of a study with this u and chance (view,) for every measurement, and so many points."""
    count, by = len(study.views), ("measurement", "view")
    each = np.ones((len(NAMES), 1))
    return xr.Dataset(
        {
            "predicted_uncertainty": (by, each * u),
            "chance": (by, each * chance),
            "V_m": (by, each / u),
            "possible": (by, np.ones((len(NAMES), count), bool)),
            "n": (("view", "feature"), np.tile(points[:, None], len(study.task.shapes))),
        },
        {"measurement": NAMES, "view": np.arange(count), "feature": list(study.task.shapes)},
    )


@pytest.fixture
def screen(cases, tmp_path, monkeypatch):
    """Judge a u and a chance (view,) of views whose true risk rises with their number."""
    text = cases.read_text().replace("candidates = 6", f"candidates = {MORE}")
    cases.write_text(text.replace("subdivisions = 1", "subdivisions = 2"))

    def judge(u, chance=1.0, points=None):
        size = np.ones(MORE)
        monkeypatch.setattr(
            session,
            "screen",
            lambda study, *_: (told(u * size, chance * size, study, size if points is None else points), []),
        )
        monkeypatch.setattr(
            screening_run, "seen_by_all", lambda study, predictor: np.ones((MORE, len(study.task.shapes)))
        )
        return screen_cases(read_part_cases(cases), tmp_path / "run")[0]

    return judge


def test_an_order_by_the_true_risks_reaches_the_ceiling(screen):
    rising = np.arange(1.0, MORE + 1)
    found = cells_of(screen(rising, points=-rising), PREDICTED)
    assert [one.recall for one in found] == [1.0] * len(NAMES)
    assert np.mean([one.correlation for one in found]) == pytest.approx(
        np.mean([one.ceiling for one in found]), abs=0.05
    )
    assert np.mean([one.correlation for one in found]) > 0.85
    assert [one.measurable for one in found] == [MORE] * len(NAMES)


def test_a_reversed_order_has_no_recall_and_as_much_correlation_the_other_way(screen):
    judged = screen(np.arange(MORE, 0.0, -1.0), points=np.arange(MORE, 0.0, -1.0))
    found, rival = cells_of(judged, PREDICTED), cells_of(judged, POINTS)
    assert [one.recall for one in found] == [0.0] * len(NAMES)
    assert np.mean([one.correlation for one in found]) < -0.85
    assert np.mean([one.correlation for one in rival]) > 0.85
    assert all(np.isnan(one.correlation) for one in cells_of(judged, COSINE))  # it tells no view from another


def test_views_called_impossible_are_behind_for_every_score_and_counted(screen):
    chance = np.where(np.arange(MORE) < 6, 0.0, 1.0)
    judged = screen(np.arange(1.0, MORE + 1), chance, points=np.arange(MORE, 0.0, -1.0))
    for score in (PREDICTED, TALK, POINTS):
        assert all(np.isinf(one.cost[:6]).all() and np.isfinite(one.cost[6:]).all() for one in judged.cells(score))
        found = cells_of(judged, score)
        assert [one.wrongly_impossible for one in found] == [6] * len(NAMES)
        assert [one.recall for one in found] == [0.0] * len(NAMES)


def test_the_page_has_all_cells_and_takes_the_kept_worlds(screen, cases, tmp_path, monkeypatch):
    monkeypatch.setattr(screening, "_RESAMPLES", 20)
    chosen = read_part_cases(cases)
    judged = screen(np.arange(1.0, MORE + 1))
    page, tables = write_screening_page([judged], tmp_path / "run", described_screening(cases, chosen))
    cells = rows(tmp_path / "run/scores.csv")
    assert len(cells) == (2 * 4 + 1) * len(NAMES)
    assert {cell["score"] for cell in cells if cell["order"] == "map"} == {PREDICTED, TALK, POINTS, COSINE}
    assert {cell["score"] for cell in cells if cell["order"] == "once"} == {PREDICTED, TALK, POINTS, COSINE, ALONE}
    assert "### Open parts" in tables
    assert "### Sealed parts" not in tables
    assert page.read_text().startswith("# How right the screening is")
    for name in ("order.png", "reliability.png"):
        assert (tmp_path / "run" / name).stat().st_size > 1000


def test_a_measurement_of_every_view_mends_a_reversed_order(screen):
    judged = screen(np.arange(MORE, 0.0, -1.0))
    before, after, alone = (
        np.mean([one.correlation for one in cells_of(judged, score, measured)])
        for score, measured in ((PREDICTED, False), (PREDICTED, True), (ALONE, True))
    )
    assert before < -0.85
    assert before < after < alone  # a map that is wrong still counts for something
    right = screen(np.arange(1.0, MORE + 1))
    assert np.mean([one.correlation for one in cells_of(right, PREDICTED, measured=True)]) > alone


def test_one_measurement_orders_equal_views_by_their_errors():
    errors = np.array([[[0.3], [-0.1], [0.2], [np.nan]]])
    cost = measured_cost(np.zeros((1, 4)), np.ones((1, 4)), np.full((1, 4), 0.9), errors, 4)
    assert np.argsort(cost[0]).tolist()[:3] == [1, 2, 0]
    assert cost[0, 3] > cost[0, 2]  # no value: of the risk nothing is known, of the chance that it is less


def test_views_off_the_shortlist_and_impossible_ones_stay_behind():
    cost = np.array([[3.0, 1.0, 2.0, 4.0, np.inf]])
    errors = np.array([[[1e-3], [5.0], [9.0], [1e-3], [1e-3]]])
    order = measured_cost(cost, np.exp(cost), np.full(cost.shape, 0.9), errors, 2)
    assert np.argsort(order[0], kind="stable").tolist() == [1, 2, 0, 3, 4]
    assert np.isinf(order[0, 4])


def test_a_score_without_a_unit_takes_the_values_of_u_in_its_order():
    found = in_order_of(np.array([[0.2, -7.0, np.inf, 0.1]]), np.array([[4.0, 1.0, 9.0, 2.0]]))
    assert found[0, [1, 3, 0]].tolist() == [1.0, 2.0, 4.0]
    assert np.isnan(found[0, 2])


def test_the_chance_moves_toward_what_one_measurement_gave():
    after = chance_after(np.array([[0.5, 0.5]]), np.array([[[1.0], [np.nan]]]))
    assert after[0].tolist() == [2 / 3, 1 / 3]
