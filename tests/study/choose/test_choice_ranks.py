"""The order of sensors and the words of it, from made-up screenings and statements; nothing is rendered."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from characterisation.statements.statement import statement
from characterisation.statements.tolerance import plus_minus
from characterisation.statements.verdict_words import in_words
from mitsim.report.choice_page import page_content, write_choice_page
from mitsim.report.declaration import read_declaration
from mitsim.report.first_screen import of_choice
from mitsim.study.choice_document import ChoiceDocument
from mitsim.study.choose import read_candidates, rounds, selection
from mitsim.study.choose.ranking import rank_key, rank_keys, relative_to_least, unpromising
from mitsim.study.choose.sensor_result import SensorResult, ordered
from mitsim.study.choose.table import as_text, best_reasons, document, reasons_of
from mitsim.study.virtual.risks import combined_cost, first_of_each, possible_measurements
from mitsim.study.virtual.stated import StatedView
from tests.report.choice_run import choice as made_choice
from tests.report.choice_run import write_choice
from tests.small_study import MEASUREMENTS, few_measurements, small_study

INF = math.inf

#: no sensor can make the distance; the second one has the smaller error of both radii
FIRST, SECOND = (INF, 0.2, 0.3), (INF, 0.1, 0.15)


@pytest.fixture(scope="module")
def candidates(tmp_path_factory):
    """Two sensors without tolerances."""
    folder = tmp_path_factory.mktemp("ranks")
    (folder / "task.toml").write_text(few_measurements())
    (folder / "study.toml").write_text(small_study("{ }", task="task.toml"))
    return read_candidates(folder / "study.toml", ["ensenso-n10,kinect-v2"])[0]


def with_tolerances(candidate, size):
    task = candidate.study.task
    asked = {name: one.model_copy(update={"tolerance": size}) for name, one in task.measurements.items()}
    return replace(candidate, study=replace(candidate.study, task=task.model_copy(update={"measurements": asked})))


def no_points(candidate):
    """Scores of one view in which no shape has points, so that no measurement is possible."""
    shapes = list(candidate.study.task.shapes)
    none = {key: (("view", "feature"), np.zeros((1, len(shapes)))) for key in ("n", "n_white", "n_only_white")}
    able = {"uncertainty_possible": (("measurement", "view"), np.zeros((len(MEASUREMENTS), 1), bool))}
    places = {"measurement": list(MEASUREMENTS), "feature": shapes, "view": [0]}
    return xr.Dataset(none | able, places, {"minimum_points": 100})


def screened(candidate, demands):
    demands = np.array(demands)
    session = SimpleNamespace(study=candidate.study)
    number = candidate.study.views[0].number
    return SensorResult(candidate, session, no_points(candidate), demands, demands, np.full(len(demands), number))


def measured(candidate, spreads, trials=24, tolerance=None):
    """A sensor with statements of normal quantiles of these standard deviations; no value where one is infinite."""
    one = screened(candidate, spreads)
    errors = np.linspace(-1, 1, trials)
    errors /= errors.std(ddof=1)
    limits = None if tolerance is None else plus_minus(0.0, tolerance)
    statements = [
        statement(name, "mm", errors * spread if math.isfinite(spread) else np.full(trials, np.nan), limits)
        for name, spread in zip(MEASUREMENTS, spreads, strict=True)
    ]
    view = candidate.study.views[0]
    one.stated[view.number] = StatedView(view, statements, None)
    return one


def documented(found) -> ChoiceDocument:
    return document(found[0].candidate.study, ordered(found), [], 1.0, True)


def test_possible_measurements_count_first_then_the_worst_then_the_next_worst():
    rows = [
        [INF, 0.1, 0.1],
        [5.0, 0.1, 0.1],
        [5.0, 0.1, 0.09],
        [4.0, 3.9, 3.9],
        [INF, INF, 0.01],
        [math.nan, 0.09, 0.1],
    ]
    order = sorted(range(len(rows)), key=lambda i: rank_key(rows[i]))
    assert order == [3, 2, 1, 5, 0, 4]
    assert rank_key(rows[5]) == (1, (0.1, 0.09))


def test_without_tolerances_demands_are_relative_to_the_least_of_the_known_sensors():
    rows = [[2.0, INF, 9.0], [1.0, INF, 3.0], [0.5, INF, INF]]
    assert relative_to_least(rows, [True, True, False]).tolist() == [[2, INF, 3], [1, INF, 1], [0.5, INF, INF]]
    assert rank_keys(rows, [False] * 3, [False] * 3) == rank_keys(rows, [False] * 3)  # none is known: the least of all
    assert rank_keys(rows, [False] * 3) == [(1, (4.0, 3.0)), (1, (2.0, 1.0)), (2, (1.0,))]


def test_a_unit_without_a_limit_does_not_hide_a_limit_but_counts_where_impossible():
    """In mm, 50 of the second measurement would be the worst by far."""
    rows = [[0.5, 50.0], [0.6, 0.1], [0.1, INF]]
    assert rank_keys(rows, [True, False]) == [(0, (0.5,)), (0, (0.6,)), (1, (0.1,))]


def test_a_measurement_that_no_sensor_can_make_excludes_none():
    assert unpromising([(1, (2.0, 0.5)), (1, (1.0, 0.5))], True) == ["", ""]
    assert unpromising([(1, (3.1,)), (1, (1.0,))], True) == ["out by far", ""]
    assert unpromising([(1, (5.0,)), (1, (2.0,))], False) == ["", ""]
    assert unpromising([(1, (0.5,)), (0, (2.0, 1.0))], True) == ["fewer measurements possible", ""]
    assert unpromising([(1, (5.0,))], True) == [""]  # the best sensor is measured, however poor it is
    # a tolerance that no sensor comes near: before, all but the best were left out
    assert unpromising([(0, (8.2, 0.5)), (0, (7.5, 2.0)), (0, (23.0, 0.1))], True) == ["", "", "out by far"]
    assert unpromising([(2, ()), (2, ())], True) == ["no measurement possible"] * 2


@pytest.mark.parametrize("make", [screened, measured])
@pytest.mark.parametrize("tolerance", [None, 1.0])
def test_the_better_sensor_leads_where_one_measurement_is_impossible_for_all(candidates, make, tolerance):
    one, other = candidates if tolerance is None else [with_tolerances(each, tolerance) for each in candidates]
    options = {"tolerance": tolerance} if make is measured else {}
    found = [make(one, FIRST, **options), make(other, SECOND, **options)]
    choice = documented(found)
    assert [each.name for each in choice.sensors] == [other.name, one.name]
    assert choice.words.startswith(f"{other.name}: ")
    for entry in choice.sensors:
        assert list(entry.impossible) == [MEASUREMENTS[0]] and not entry.fits_all and entry.ratio is not None
        assert "2 of 3 measurements possible" in entry.words and MEASUREMENTS[0] in entry.words
        assert ("no virtual measurement" in entry.words) == (make is measured)
        assert ("by screening, no view can make it" in entry.words) == (make is screened)
        assert f"{entry.name}: 2 of 3 measurements possible; {MEASUREMENTS[0]} impossible" in as_text(choice)
    if tolerance is None:
        assert [each.ratio for each in choice.sensors] == pytest.approx([1.0, 2.0])
    else:
        worst = [max(cell.demand or 0.0 for cell in each.measurements.values()) for each in choice.sensors]
        assert [each.ratio for each in choice.sensors] == worst
    screen = of_choice(choice, None)
    lost = {row.name: row.without_value for row in screen.rows}[MEASUREMENTS[0]]
    assert ("%" in lost) == (make is measured)
    assert ("100 %" in screen.words()) is False
    if make is screened:
        promising = selection._promising(found)
        assert [each.candidate.name for each in promising] == [other.name, one.name]


def test_a_sensor_that_can_make_more_leads_one_that_is_better_in_the_others(candidates):
    one, other = candidates
    choice = documented([measured(one, (INF, 0.01, 0.01)), measured(other, (5.0, 0.1, 0.1))])
    assert [each.name for each in choice.sensors] == [other.name, one.name]
    assert choice.sensors[0].impossible == {} and choice.sensors[0].possible_in_words == ""
    assert choice.sensors[1].ratio == pytest.approx(1.0)


def test_screening_and_virtual_measurements_are_told_apart(candidates):
    one, other = candidates
    choice = documented([measured(one, FIRST, trials=30), screened(other, SECOND)])
    assert [each.status for each in choice.sensors] == ["stated", "screened"]
    made, unmade = (each.impossible[MEASUREMENTS[0]] for each in choice.sensors)
    assert made == "no virtual measurement of 30 gave a value"
    assert unmade.startswith("by screening, no view can make it: plane has at most 0 points of 100 from any view: too")


def test_screening_says_what_is_expected_and_not_that_nothing_fits(candidates):
    """Of a ratio below 1 the page said "fits 0 of 3"."""
    one, other = (with_tolerances(each, 1.0) for each in candidates)
    choice = documented([measured(one, (0.1, 0.1, 0.1), tolerance=1.0), screened(other, (0.5, 0.9, 1.2))])
    entry = choice.sensors[1]
    assert entry.status == "screened" and entry.fits == 0 and entry.expected_fits == 2
    assert entry.words.startswith("by screening alone: 2 of 3 tolerances are expected to fit; the hardest is ")
    assert "fits 0" not in entry.words and "not decided" not in entry.words
    assert "(2 of 3)" in as_text(choice) and "0 of 3" not in as_text(choice)


def test_every_sensor_that_takes_part_has_its_section(candidates, tmp_path):
    """Also where time was over before any virtual measurement."""
    choice = documented([screened(candidates[0], FIRST), screened(candidates[1], SECOND)])
    content = page_content(choice, tmp_path)
    assert [one["name"] for one in content["sensors"]] == [one.name for one in choice.sensors]
    (tmp_path / "choice.json").write_text(choice.model_dump_json())
    each = write_choice_page(tmp_path).read_text().partition('id="each"')[2]
    assert each.count("<details") == 2 and "By screening alone" in each and "plane has at most 0 points" in each


def test_the_page_says_which_measurement_is_impossible_and_why(candidates, tmp_path):
    one, other = candidates
    choice = documented([measured(one, FIRST, trials=30), screened(other, SECOND)])
    text = json.dumps(page_content(choice, tmp_path), default=str)
    assert "no value in 30 trials" in text and "no view, by screening" in text
    (tmp_path / "choice.json").write_text(choice.model_dump_json())
    page = write_choice_page(tmp_path).read_text()
    assert page.count("<small>2 of 3 measurements possible</small>") == 2
    assert choice.sensors[1].words.startswith("by screening alone: ")


def test_a_measurement_without_a_value_is_tried_from_its_own_best_view(candidates):
    """Without a tolerance, too: it would count as impossible otherwise. The risk elsewhere is hardly lower."""
    one = measured(candidates[0], (INF, 0.2, 0.3))
    view = next(iter(one.stated))
    leaders = dict(zip(MEASUREMENTS, (1, 1, 0), strict=True))
    standings = {name: SimpleNamespace(leader=place, risk=np.array([1.0, 0.9])) for name, place in leaders.items()}
    views = np.array([view, view + 1])
    one.raced = SimpleNamespace(views=views, standings=standings, leader=lambda name: int(views[leaders[name]]))
    assert rounds._own_views(one, view) == [view + 1]
    leaders[MEASUREMENTS[0]] = standings[MEASUREMENTS[0]].leader = 0
    assert rounds._own_views(one, view) == []


def test_sensors_that_can_measure_nothing_are_last_and_none_is_named_best(candidates):
    one, other = candidates
    nothing = (INF,) * 3
    choice = documented([screened(one, nothing), screened(other, FIRST)])
    assert choice.sensors[-1].name == one.name and choice.sensors[-1].ratio is None
    choice = documented([screened(one, nothing), screened(other, nothing)])
    assert choice.words.startswith("no sensor can measure this; ") and "by screening" in choice.words


def test_no_sensor_fits_all_where_one_measurement_is_impossible(candidates):
    """The second sensor of three meets its limits, but not all measurements: it does not fit "also"."""
    one, other = (with_tolerances(each, 1.0) for each in candidates)
    choice = documented([measured(one, (0.01, 0.01, 0.01), tolerance=1.0), measured(other, (INF, 0.01, 0.01), 24, 1.0)])
    assert choice.words == f"{one.name}: fits 3 of 3 tolerances"


def test_a_sensor_with_a_tolerance_that_is_not_decided_does_not_fit_all(candidates):
    """Its demand is below the limit, but more trials may put it above."""
    one, other = (with_tolerances(each, 1.0) for each in candidates)
    choice = documented([measured(each, (0.01, 0.01, 0.01), tolerance=1.0) for each in (one, other)])
    sensors = choice.sensors
    assert choice.words.endswith("; so does 1 other")
    cells = dict(sensors[1].measurements)
    cells[MEASUREMENTS[1]] = cells[MEASUREMENTS[1]].model_copy(update={"verdict": "not decided"})
    open_one = sensors[1].model_copy(update={"measurements": cells})
    assert open_one.ratio < 1 and not open_one.fits_all
    (told,) = best_reasons([sensors[0], open_one], choice.measurements)
    assert told.words == f"{sensors[0].name}: fits 3 of 3 tolerances"


def test_a_later_sensor_that_fits_more_is_named_with_the_reason(candidates, tmp_path):
    """The first fits one tolerance of three and is twice its limit at worst; the second fits two, but not the third."""
    one, other = (with_tolerances(each, 1.0) for each in candidates)
    choice = documented(
        [measured(one, (0.01, 0.01, 2.0), tolerance=1.0), measured(other, (0.01, 0.4, 0.4), tolerance=1.0)]
    )
    assert [(each.name, each.fits) for each in choice.sensors] == [(other.name, 1), (one.name, 2)]
    (words,) = choice.fit_more
    assert words.startswith(f"{one.name} fits 2 of 3; {other.name} fits 1 of 3. {other.name} leads, since its worst ")
    assert f"at {choice.sensors[0].ratio:.2g} times" in words and words.endswith(f"{choice.sensors[1].ratio:.2g} times")
    assert words in as_text(choice) and of_choice(choice, None).doubts == (words,)
    (tmp_path / "choice.json").write_text(choice.model_dump_json())
    page = write_choice_page(tmp_path).read_text()
    assert "Order: sensors with virtual measurements first" in page and f"{one.name} fits 2 of 3" in page
    fewer = documented(
        [measured(one, (INF, 0.01, 0.01), tolerance=1.0), measured(other, (2.0, 2.0, 2.0), tolerance=1.0)]
    )
    assert fewer.fit_more[0].endswith(f"{other.name} leads, since it can make more measurements")
    assert documented([measured(each, (0.01, 0.01, 0.01), tolerance=1.0) for each in (one, other)]).fit_more == []


def test_a_sensor_of_which_nothing_is_decided_is_open_wherever_it_is_named(tmp_path):
    """Sheet and page said "fits 0 of 3" of three verdicts that were not decided, as if the sensor missed all."""
    folder = write_choice(tmp_path / "choice")
    made = json.loads((folder / "choice.json").read_text())
    for entry in made["sensors"][1:2]:
        entry["fits"] = 0
        for cell in entry["measurements"].values():
            cell |= {"by": "statement", "verdict": "not decided", "uncertainty": 0.02}
    (folder / "choice.json").write_text(json.dumps(made))
    choice = ChoiceDocument.model_validate(made)
    open_one = choice.sensors[1]
    facts = dict(read_declaration(folder, None).facts)
    assert f"{open_one.name} (3 of 3 open)" in facts["Also compared"]
    row = page_content(choice, folder)["rows"][1]
    line = in_words(reasons_of(open_one, choice.measurements))
    (of_table,) = [line for line in as_text(choice).splitlines() if line.startswith(open_one.name)]
    for words in (row["fits"], line, of_table):
        assert "open" in words and "0 of" not in words


def test_views_are_raced_for_the_measurements_that_are_possible():
    cost = np.array([[INF, INF, INF], [3.0, 1.0, 1.4], [1.0, 3.0, 1.4]])
    together = combined_cost(np.log(cost), np.full(3, np.nan))
    assert first_of_each(np.vstack([cost, together]), 1) == {0, 1, 2}  # the last is the best for both
    u = np.where(np.isfinite(cost), cost, np.nan)
    errors = np.full((3, 3, 2), np.nan)
    assert possible_measurements(u, errors).tolist() == [False, True, True]
    errors[0, 2, 1] = 0.1  # a trial gave a value that the map had excluded
    assert possible_measurements(u, errors).all()
    assert possible_measurements(np.full((2, 3), np.nan), np.full((2, 3, 1), np.nan)).all()


def test_the_interval_of_a_share_from_few_trials_is_open_and_not_left_out(candidates):
    """The page said "below it, its own 95 % interval" above shares without one, and "not decided" without a reason."""
    one = with_tolerances(candidates[0], 1.0)
    cells = documented([measured(one, [0.1, 0.1, 0.1], trials=2, tolerance=1.0)]).sensors[0].measurements
    for cell in cells.values():
        low, high = cell.demand_interval  # of two trials the upper end is infinite, which JSON lacks
        assert 0 < low < cell.demand and high is None


def test_a_sensor_of_few_trials_is_called_rough(tmp_path):
    """Nine sensors in five minutes: 0.0019 mm from four virtual measurements stood in bold beside one of a hundred."""
    made = made_choice()
    for cell in made["sensors"][0]["measurements"].values():
        cell["trials"] = 4
    choice = ChoiceDocument.model_validate(made)
    few, many = choice.sensors[:2]
    # of normal errors with 4 trials: sqrt(3 / chi2 of 3 degrees at 2.5 %) = sqrt(3 / 0.2158)
    assert few.roughness_in_words == ("4 virtual measurements only: standard uncertainties may be 3.7 times as large")
    assert many.roughness_in_words == ""
    assert f"{few.name}: {few.roughness_in_words}" in as_text(choice)
    rows = page_content(choice, tmp_path)["rows"]
    assert [row["rough"] for row in rows[:2]] == [few.roughness_in_words, ""]
    assert few.roughness_in_words in of_choice(choice, None).doubts


def test_toleranced_measurements_that_no_sensor_can_make_do_not_hide_the_others():
    assert rank_keys([[INF, 0.1], [INF, 0.2]], [True, False]) == [(1, (1.0,)), (1, (2.0,))]
