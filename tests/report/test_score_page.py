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
    pages = [place, *(place.parent / f"{sensor}.md" for sensor in ("sensor-a", "sensor-b"))]
    text = "".join(one.read_text(encoding="utf-8") for one in pages)
    linked = set(re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text))
    there = {path.name for path in place.parent.glob("*.png")}
    assert linked == there and len(there) == 1 + 2 * 5 + 3 * 3
    assert {path.name for path in place.parent.glob("*.md")} == {one.name for one in pages}
    assert (place.parent / "scores.csv").read_text().count("sensor-b") == 2 * 4  # three scores, and the repeats as one


def test_samples_are_told_one_by_one(page):
    lines = page[0].read_text(encoding="utf-8").split("## Sample by sample")[1].split("\n## ")[0].splitlines()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines if line.startswith("| sensor")}
    assert list(rows) == [f"sensor-{one}" for one in ("a, matt white", "a, Ra 0.4", "b, matt white", "b, Ra 0.4")]
    for cells in rows.values():
        mine, theirs = (float(value.strip(" ()")) for value in cells[0].replace("\u2212", "-").split("("))
        assert mine >= 0.95 > theirs
        assert 90 <= int(re.search(r"\d+", cells[-1])[0]) <= 99


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
