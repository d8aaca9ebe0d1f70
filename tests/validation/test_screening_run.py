"""Screening judged by known risks: an order that is right, one that is reversed, and verdicts that are wrong."""

import numpy as np
import pytest
import xarray as xr
from known_trials import NAMES, rows

import mitsim.validation.screening_run as screening_run
from mitsim.validation.part_cases import read_part_cases
from mitsim.validation.screening_page import cells_of, described_screening, write_screening_page
from mitsim.validation.screening_run import COSINE, POINTS, PREDICTED, TALK, screen_cases

MORE = 24


def told(u, chance, study, points):
    """Scores of a study with this u and chance (view,) for every measurement, and so many points."""
    count, by = len(study.views), ("measurement", "view")
    each = np.ones((len(NAMES), 1))
    return xr.Dataset(
        {
            "predicted_uncertainty": (by, each * u), "chance": (by, each * chance), "V_m": (by, each / u),
            "possible": (by, np.ones((len(NAMES), count), bool)),
            "n": (("view", "feature"), np.tile(points[:, None], len(study.task.shapes))),
        },
        {"measurement": NAMES, "view": np.arange(count), "feature": list(study.task.shapes)},
    )  # fmt: skip


@pytest.fixture
def screen(cases, tmp_path, monkeypatch):
    """Judge a u and a chance (view,) of views whose true risk rises with their number."""
    text = cases.read_text().replace("candidates = 6", f"candidates = {MORE}")
    cases.write_text(text.replace("subdivisions = 1", "subdivisions = 2"))

    def judge(u, chance=1.0, points=None):
        size = np.ones(MORE)
        monkeypatch.setattr(
            screening_run, "screen",
            lambda study, *_: (told(u * size, chance * size, study, size if points is None else points), []),
        )  # fmt: skip
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


def test_the_page_has_all_cells_and_takes_the_kept_worlds(screen, cases, tmp_path):
    chosen = read_part_cases(cases)
    judged = screen(np.arange(1.0, MORE + 1))
    page, tables = write_screening_page([judged], tmp_path / "run", described_screening(cases, chosen))
    cells = rows(tmp_path / "run/scores.csv")
    assert len(cells) == 4 * len(NAMES)
    assert {cell["score"] for cell in cells} == {PREDICTED, TALK, POINTS, COSINE}
    assert "### Open parts" in tables
    assert "### Sealed parts" not in tables
    assert page.read_text().startswith("# How right the screening is")
    for name in ("order.png", "reliability.png"):
        assert (tmp_path / "run" / name).stat().st_size > 1000
