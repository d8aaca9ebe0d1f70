"""Pictures and tables of score validation: that they show what they should, by what was drawn."""

import math

import matplotlib
import numpy as np
import pytest

from characterisation.scores.score_table import calibrations, contests
from characterisation.scores.score_validation import REPEATS, UNCERTAINTY, V_M, CheckedViews, decile_errors, score_rows
from mitsim.report import score_tables
from mitsim.report.score_figures import (
    calibration_figure,
    decile_figure,
    mean_rank_figure,
    roc_figure,
    score_styles,
    spearman_figure,
)
from mitsim.report.style import as_svg, write_png

NAN = math.nan
SAMPLES = ("matt white", "shiny | $x$")


def checked(sample, views=60, lost=0, measurement="radius & co"):
    """The uncertainty is right, V_m is random, and the worst views cannot be measured, which both of them know."""
    draw = np.random.default_rng(len(sample))
    u = np.exp(np.linspace(-3, 0, views))
    error = u[:, None] * draw.normal(size=(views, 4))
    error[views - lost :] = np.nan
    impossible = np.arange(views) >= views - lost
    scores = {"random": draw.random(views), V_M: np.where(impossible, NAN, draw.random(views))}
    return CheckedViews(measurement, sample, "deg", scores, error, np.where(impossible, NAN, u), tolerance=0.1)


@pytest.fixture(scope="module")
def every():
    return [checked(SAMPLES[0]), checked(SAMPLES[1], lost=20)]


@pytest.fixture(scope="module")
def rows(every):
    return score_rows([*every, checked(SAMPLES[0], measurement="angle")])


def line(axes, colour, marker=""):
    return next(one for one in axes.lines if one.get_color() == colour and one.get_marker() == marker)


def test_deciles_are_drawn_where_they_lie_and_the_impossible_apart(every):
    figure = decile_figure(every)
    assert [axes.get_title() for axes in figure.axes[:2]] == list(SAMPLES)
    colour = score_styles([UNCERTAINTY])[UNCERTAINTY]["color"]
    for column, one in enumerate(every):
        found = decile_errors(one, UNCERTAINTY)
        for row, values in enumerate((found.mean, found.std, found.measurable)):
            drawn = line(figure.axes[2 * row + column], colour)
            np.testing.assert_array_equal(drawn.get_xdata(), np.arange(1, 11))
            np.testing.assert_array_equal(drawn.get_ydata(), values[:10])
    open_marks = next(one for one in figure.axes[5].lines if one.get_marker() == "s" and one.get_mfc() != colour)
    assert open_marks.get_ydata().tolist() == [0.0] and open_marks.get_xdata()[0] > 10  # of the impossible
    assert figure.axes[0].get_ylabel() == "mean |true error| [°]"
    assert figure.axes[0].get_yscale() == "log"


def test_the_order_of_the_true_errors_is_drawn_with_the_deciles(every):
    dotted = next(one for one in decile_figure(every).axes[0].lines if one.get_linestyle() == ":")
    error = np.sort(np.abs(every[0].error).mean(axis=1))
    np.testing.assert_allclose(dotted.get_ydata(), error.reshape(10, 6).mean(axis=1))


def test_only_the_scores_asked_for_are_drawn(every):
    figure = decile_figure(every, [V_M])
    colours = {one.get_color() for one in figure.axes[0].lines}
    assert score_styles([V_M])[V_M]["color"] in colours
    assert score_styles([UNCERTAINTY])[UNCERTAINTY]["color"] not in colours


def test_errors_within_a_decade_are_drawn_on_a_linear_axis_from_zero():
    one = CheckedViews("radius", "a", "mm", {}, np.linspace(1, 3, 40)[:, None] * [1, -1], np.linspace(1, 3, 40))
    axes = decile_figure([one]).axes[0]
    assert (axes.get_yscale(), axes.get_ylim()[0]) == ("linear", 0)


def test_mean_ranks_of_a_right_score_lie_on_the_line(rows):
    right = [row for row in rows if row.score == UNCERTAINTY]
    axes = mean_rank_figure(rows).axes[0]
    drawn = line(axes, score_styles([UNCERTAINTY])[UNCERTAINTY]["color"], "s")
    np.testing.assert_allclose(drawn.get_ydata(), np.mean([row.decile_ranks for row in right], axis=0))


def test_the_table_of_correlations_shows_every_row(rows):
    axes = spearman_figure(rows).axes[0]
    shown = axes.images[0].get_array()
    assert shown.shape == (4, 3)  # random, V_m, the uncertainty, half of the repeats
    assert [label.get_text() for label in axes.get_yticklabels()] == ["random", V_M, UNCERTAINTY, REPEATS]
    assert shown[2].tolist() == [row.decile_spearman for row in rows if row.score == UNCERTAINTY]
    words = [text.get_text() for text in axes.texts]
    assert {"radius & co", "angle"} <= set(words)
    assert words[8] == f"{shown[2, 0]:.2f}"


def test_an_undefined_correlation_is_a_dash_on_an_empty_cell():
    axes = spearman_figure(score_rows([checked("few", views=6)])).axes[0]
    assert axes.images[0].get_array().mask.all()
    assert {text.get_text() for text in axes.texts} == {"\N{EN DASH}", "radius & co"}


def test_roc_curves_are_drawn_only_where_some_views_cannot_be_measured(every):
    left, right = roc_figure(every).axes
    assert [text.get_text() for text in left.texts] == ["not defined"] and not left.lines
    areas = [text.get_text() for text in right.get_legend().get_texts()]
    assert areas[1:] == ["1.00", "1.00"]
    assert "67 % of 60 measurable" in right.get_title().replace("\N{NO-BREAK SPACE}", " ")
    curve = line(right, score_styles([V_M])[V_M]["color"])
    assert (curve.get_xdata()[0], curve.get_ydata()[-1]) == (0, 1)


def test_calibration_shows_views_deciles_and_the_two_lines(every):
    figure = calibration_figure(every)
    upper, lower = figure.axes[1], figure.axes[3]
    dots = next(one for one in upper.lines if one.get_marker() == ".")
    np.testing.assert_allclose(dots.get_xdata(), every[1].predicted_uncertainty[:40])
    np.testing.assert_allclose(dots.get_ydata(), np.sqrt((every[1].error[:40] ** 2).mean(axis=1)))
    same = next(one for one in upper.lines if one.get_linestyle() == "-" and one.get_marker() == "None")
    twice = next(one for one in upper.lines if one.get_linestyle() == "--")
    np.testing.assert_allclose(same.get_ydata(), same.get_xdata())
    np.testing.assert_allclose(twice.get_ydata(), 2 * twice.get_xdata())
    assert "inside 2 u, rms of z" in upper.get_title()
    assert len(lower.containers[0].lines[0].get_xdata()) == 10


@pytest.mark.parametrize(
    "one",
    [
        CheckedViews("m", "one view", "mm", {V_M: np.zeros(1)}, np.ones((1, 1)), np.ones(1)),
        CheckedViews("m", "nothing measured", "mm", {V_M: np.arange(20.0)}, np.full((20, 2), NAN), np.ones(20)),
        CheckedViews("m", "all impossible", "mm", {V_M: np.full(20, NAN)}, np.ones((20, 2)), np.full(20, NAN)),
        CheckedViews("m", "errors of zero", "mm", {V_M: np.arange(20.0)}, np.zeros((20, 2)), np.ones(20)),
    ],
    ids=lambda one: one.sample,
)
def test_pictures_and_tables_of_next_to_nothing_are_drawn(one, tmp_path):
    rows = score_rows([one])
    figures = [decile_figure([one]), mean_rank_figure(rows), spearman_figure(rows), roc_figure([one])]
    for figure in [*figures, calibration_figure([one])]:
        assert write_png(figure, tmp_path / "figure.png", dpi=40).stat().st_size > 0
    assert score_tables.overall_table(rows).count("\n") == 2 + len({row.score for row in rows})
    assert one.sample in score_tables.calibration_table(calibrations([one]))


def test_drawing_leaves_no_state_behind_and_svg_is_the_same_every_time(every, rows):
    before = dict(matplotlib.rcParams)
    assert as_svg(spearman_figure(rows), "a") == as_svg(spearman_figure(rows), "a")
    assert as_svg(decile_figure(every), "a").startswith('<svg role="img"')
    assert dict(matplotlib.rcParams) == before


def test_many_scores_keep_colours_of_their_own():
    styles = score_styles([*"abcdefg", V_M, UNCERTAINTY])
    assert len({style["color"] for style in styles.values()}) == 9
    assert len({style["marker"] for style in styles.values()}) == 9
    assert list(styles) == [*"abcdefg", V_M, UNCERTAINTY]


def test_tables_escape_bars_and_say_how_many_rows_define_a_figure(rows):
    table = score_tables.measurement_table(rows, "radius & co")
    lines = table.splitlines()
    assert len(lines) == 2 + 8 and "shiny \\| $x$" in table and "angle" not in table
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1
    total = score_tables.overall_table(rows).splitlines()
    mine = next(line for line in total if line.startswith(f"| {UNCERTAINTY}"))
    assert "| 1.00 (1) |" in mine  # the ROC area, of one sample of three rows


def test_tables_of_ranks_contests_and_calibrations(every, rows):
    ranks = score_tables.mean_rank_table(rows).splitlines()
    assert ranks[0].startswith("| score | rows | decile 1 | 2 |") and len(ranks) == 2 + 4
    fought = score_tables.contest_table(contests(rows))
    assert fought.splitlines()[2] == "| radius & co | mean of all | predicted uncertainty | Spearman, deciles |"
    calibrated = score_tables.calibration_table(calibrations(every)).splitlines()
    assert len(calibrated) == 2 + 3 and calibrated[-1].startswith("| all | all | 100 | 400 |")


def test_an_infinite_regret_is_written_as_such():
    error = np.arange(1.0, 21)[:, None] * [1, -1]
    error[:2] = NAN
    one = CheckedViews("m", "s", "mm", {V_M: -np.arange(20.0)}, error, np.ones(20))
    row = next(line for line in score_tables.overall_table(score_rows([one])).splitlines() if V_M in line)
    assert "| ∞ | 100\N{NO-BREAK SPACE}% |" in row
