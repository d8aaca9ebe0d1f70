"""The page of a score validation: whole, linked, and true to its rows."""

import math
import re

import numpy as np
import pytest

from characterisation.scores.score_validation import UNCERTAINTY, V_M, CheckedViews
from mitsim.report.score_page import write_score_page


def checked(measurement, sample, right=True):
    """120 views, five repeats; the predicted uncertainty is right or four times too small, V_m knows little."""
    draw = np.random.default_rng(len(measurement) + len(sample))
    u = np.exp(np.linspace(-3, 0, 120))
    error = u[:, None] * draw.normal(size=(120, 5))
    error[110:] = np.nan
    seen = np.where(np.arange(120) < 110, u, np.nan)
    score = -np.log(u) + draw.normal(0, 1.5, 120)
    return CheckedViews(measurement, sample, "mm", {V_M: score, "points": score}, error, seen if right else seen / 4)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    every = [checked(m, s) for m in ("radius", "angle") for s in ("matt white", "Ra 0.4")]
    return write_score_page(
        {"sensor-a": every, "sensor-b": every[:2]}, tmp_path_factory.mktemp("page"), "What was done.\n"
    )


def test_every_picture_of_the_page_is_there_and_none_is_left_over(page):
    place, _ = page
    linked = set(re.findall(r"!\[[^\]]+\]\(([^)]+)\)", place.read_text(encoding="utf-8")))
    there = {path.name for path in place.parent.glob("*.png")}
    assert linked == there and len(there) == 1 + 2 * 5 + 3 * 3
    assert (place.parent / "scores.csv").read_text().count("sensor-b") == 2 * 4  # three scores, and the repeats as one


def test_the_aims_are_judged_by_the_numbers_that_stand_beside_them(page):
    _, aims = page
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in aims.splitlines()[2:]]
    assert [row[2].split(", ")[1] for row in rows] == ["reached", "reached", "reached", "reached"]
    decile, roc = (float(row[2].split(",")[0]) for row in rows[:2])
    assert decile >= 0.95 and roc == 1.0
    assert rows[3][2].startswith("2 of 2")


def test_too_small_an_uncertainty_is_told(tmp_path):
    _, aims = write_score_page({"s": [checked("radius", "matt white", right=False)]}, tmp_path, "")
    line = next(line for line in aims.splitlines() if "inside 2 u" in line)
    # within half a standard deviation lie 38 % of normal errors
    share = float(re.search(r"(\d+)\D+%, \*\*missed", line).group(1)) / 100
    assert share == pytest.approx(math.erf(0.5 / math.sqrt(2)), abs=0.1)
    assert UNCERTAINTY in aims
