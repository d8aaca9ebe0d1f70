"""The first screen: what its rows, its caption and the colour of its bar say."""

import html
import json
import re
import shutil

import pytest

from characterisation.statements.verdict_words import Judged, Reason
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.words.numbers import with_degree_signs
from mitsim.report.choice_page import write_choice_page
from mitsim.report.first_rows import RowValues, measured_words, tolerance_words
from mitsim.report.first_screen import FirstScreen, of_choice, of_run, sensor_rows, tone_of
from mitsim.report.page import write_report
from mitsim.study.choice_document import read_choice
from mitsim.study.choose.ranking import OUT_BY_FAR
from mitsim.study.run_folder import read_run
from mitsim.study.scene_geometry import read_scene_geometry
from tests.plain_pages import without_pictures
from tests.report.choice_run import NAMES, write_choice
from tests.report.conftest import MEASUREMENTS, write_run
from tests.report.test_sheet import with_rows


def judged(verdict: str, without_value: float = 0.0) -> Judged:
    return Judged("a", "mm", verdict, 0.1, 0.2, without_value=without_value)


@pytest.mark.parametrize(
    ("results", "tone"),
    [
        ([judged("no tolerance")], "plain"),
        ([judged("no tolerance"), judged("no tolerance", 0.19)], "warn"),
        ([judged("fits"), judged("no tolerance", 0.01)], "good"),
        ([judged("fits", 0.17)], "warn"),
        ([judged("fits"), judged("not decided")], "warn"),
        ([judged("fits", 0.5), judged("does not fit")], "bad"),
        ([judged("undecidable")], "bad"),
    ],
)
def test_the_bar_is_green_only_if_something_fits_and_nothing_is_lost(results, tone):
    assert tone_of(results) == tone


def screen(*reasons: Reason) -> FirstScreen:
    return FirstScreen(reasons, "bad")


def test_a_headline_has_four_names_at_most_and_the_fold_has_all():
    """Thirteen measurements of a part had a headline of 16 lines on a telephone."""
    fits, names = Reason("Fits 0 of 13 tolerances"), tuple(f"bore_{k}_diameter" for k in range(9))
    lost, loud = Reason(" are undecidable: no value", names), Reason(" does not fit: u 0.1 deg", ("angle",))
    first = screen(fits, lost, loud)
    assert first.headline == (
        "Fits 0 of 13 tolerances; 9 measurements are undecidable: no value; angle does not fit: u 0.1°"
    )
    assert first.folded == [f"{', '.join(names)} are undecidable: no value"] and first.named == 9
    single = [Reason(" does not fit", (name,)) for name in names]
    many = screen(fits, *single, Reason("the set of 2 views keeps 1 of 2 limits"))
    assert many.headline == (
        "Fits 0 of 13 tolerances; bore_0_diameter does not fit; the set of 2 views keeps 1 of 2 limits; and 8 more"
    )
    assert many.folded == [reason.words for reason in single[1:]] and many.named == 8
    few = screen(fits, *single[:2], Reason(" are undecidable", names[2:4]))
    assert few.headline == few.words() and not few.folded


def test_the_page_has_the_fold_only_if_the_headline_leaves_something_out(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    with without_pictures():
        assert 'id="reasons"' not in write_report(folder).read_text(encoding="utf-8")
    path = folder / "statement.json"
    stated = json.loads(path.read_text(encoding="utf-8"))
    lost = {"verdict": "undecidable", "standard_uncertainty": None, "bias": None, "without_value": 1.0}
    one = next(iter(stated["measurements"].values())) | lost
    with_rows(folder, 6)
    stated["measurements"] = dict.fromkeys(json.loads(path.read_text(encoding="utf-8"))["measurements"], one)
    path.write_text(json.dumps(stated), encoding="utf-8")
    with without_pictures():
        text = write_report(folder).read_text(encoding="utf-8")
    fold = re.search(r'<details id="reasons">(.*?)</details>', text, re.DOTALL)[1]
    said = html.unescape(re.sub(r"<[^>]*>", "", fold))
    assert "6 measurements by name" in said and all(f"distance_{k}" in said for k in range(6))


def values(**changed) -> RowValues:
    known = {"name": "a", "about": "", "unit": "mm", "verdict": "not decided", "nominal": 20.0, "tolerance": 0.15}
    rest = {"bias": None, "uncertainty": 0.018, "without_value": 0.0, "rule": "ISO 14253-1, ..."}
    return RowValues(**(known | rest | changed))


def test_a_share_is_given_with_its_limit_and_its_interval():
    row = values(share=0.33, demand=1.32, demand_interval=(0.88, 5.2)).texts()
    assert (row.share.split()[0], row.share_limit.split()[0]) == ("33", "25")
    assert row.share_interval.replace("\N{NO-BREAK SPACE}", " ") == "22 to 130 %"
    far = values(share=4.0, demand=16.0, demand_interval=(8.0, 1e280)).texts()
    assert far.share_interval.endswith("over 1000\N{NO-BREAK SPACE}%")
    few = values(share=0.61, demand=2.43, demand_interval=(0.88, None)).texts()  # of four trials
    assert few.share_interval.replace("\N{NO-BREAK SPACE}", " ") == "22 to over 1000 %"
    beyond = values(share=172.0, demand=688.0, demand_interval=(520.0, 990.0)).texts()
    assert (beyond.share.replace("\N{NO-BREAK SPACE}", " "), beyond.share_interval) == ("over 1000 %", "")


@pytest.mark.parametrize(
    ("bias", "uncertainty", "written"),
    [
        (0.0312, 0.018, "+0.031 mm"),
        (0.014, 0.112, "+0.01 mm"),
        (-0.00018, 0.086, "0.000 mm"),
        (-0.5, None, "\N{MINUS SIGN}0.50 mm"),
        (None, 0.1, "–"),
    ],
)
def test_a_bias_has_a_sign_and_the_places_of_its_uncertainty(bias, uncertainty, written):
    row = values(bias=bias, uncertainty=uncertainty).texts()
    assert row.bias.replace("\N{NO-BREAK SPACE}", " ") == written


def test_a_rule_that_limits_a_risk_has_no_largest_share():
    row = values(share=0.33, demand=1.32, demand_interval=(0.9, 1.9), rule="JCGM 106, ...").texts()
    assert row.share.startswith("33") and row.share_limit == row.share_interval == ""
    assert values(share=None, demand=None).texts().share_limit == ""


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_a_measurement_is_told_by_its_kind_and_all_its_features(kind):
    features = [f"face{k}" for k in range(len(DEFINITIONS[kind].kinds))]
    told = measured_words(kind, features)
    assert all(name in told for name in features) and "{" not in told and "_" not in told


def test_measurements_of_files_without_kinds_are_told_by_their_features():
    assert measured_words("", ["plane", "pin"]) == "plane and pin"
    assert measured_words("intersection_distance", ["plane", "a", "b"]) == (
        "distance between the points where the axes of a and b meet plane"
    )


@pytest.mark.parametrize(
    ("tolerance", "nominal", "unit", "told"),
    [
        (0.4, 70.0, "mm", "±0.4 mm"),
        (0.6, 0.0, "deg", "up to 0.6°"),
        (0.3, 0.1, "mm", "up to 0.4 mm"),
        ((-0.2, 0.0), 35.0, "mm", "+0 −0.2 mm"),
        ((-0.4, 0.4), 35.0, "mm", "±0.4 mm"),
        ((-0.1, 0.3), 0.1, "mm", "up to 0.4 mm"),  # no value is below 0
        (None, 35.0, "mm", "–"),
    ],
)
def test_a_tolerance_says_on_which_sides_it_lies(tolerance, nominal, unit, told):
    assert tolerance_words(tolerance, nominal, unit).replace("\N{NO-BREAK SPACE}", " ") == told


def test_degrees_have_one_sign_on_the_page():
    assert with_degree_signs("u 0.11 deg, 0.070 deg needed; degree 4 deg_a") == "u 0.11°, 0.070° needed; degree 4 deg_a"


def test_the_caption_tells_the_pose_in_plain_words(run_folder):
    run = read_run(run_folder)
    caption = of_run(run, read_scene_geometry(run_folder)).picture.caption.replace("\N{NO-BREAK SPACE}", " ")
    here = run.scores.sel(view=run.statement.view)
    assert f"view {run.statement.view}, the best of 12 views for all measurements together" in caption
    for name, key in (("distance", "standoff_mm"), ("azimuth", "azimuth_deg"), ("elevation", "elevation_deg")):
        assert f"{name} {float(here[key]):.0f}" in caption
    assert f"roll {float(here['roll_deg']):.0f}°" in caption
    assert caption.count("°") == 3


def test_without_tolerances_there_is_no_column_of_verdicts(tmp_path):
    folder = write_run(tmp_path / "run")
    stated = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    stated["measurements"] = {MEASUREMENTS[0]: stated["measurements"][MEASUREMENTS[0]]}
    (folder / "statement.json").write_text(json.dumps(stated), encoding="utf-8")
    with without_pictures():
        text = write_report(folder).read_text(encoding="utf-8")
    table = re.search(r'<table id="verdicts">(.*?)</table>', text, re.DOTALL)
    said = html.unescape(re.sub(r"<[^>]*>|\s+", " ", table[1]))
    assert "Verdict" not in said and "no tolerance" not in said
    assert re.search(r"Nominal .* No value of 200 virtual measurements", said)
    assert "0 mm" in said and "13 %" in said and re.search(r"noise on \S+ +\d+ points", said)


def test_values_that_are_missing_are_told_of_a_comparison_without_tolerances(tmp_path):
    folder = write_choice(tmp_path / "choice")
    document = json.loads((folder / "choice.json").read_text(encoding="utf-8"))
    for one in document["measurements"].values():
        one["tolerance"] = None
    for one in document["sensors"]:
        for cell in one["measurements"].values():
            cell |= {"verdict": "no tolerance", "without_value": 0.29}
    (folder / "choice.json").write_text(json.dumps(document), encoding="utf-8")
    first = of_choice(read_choice(folder), None)
    assert first.tone == "warn" and "no value in up to 29 % of the virtual measurements" in first.words()
    assert not first.tolerances


def test_screening_alone_says_nothing_of_readings_and_of_losses(tmp_path):
    folder = write_choice(tmp_path / "choice")
    document = json.loads((folder / "choice.json").read_text(encoding="utf-8"))
    document["sensors"] = [document["sensors"][2]]
    for cell in document["sensors"][0]["measurements"].values():
        cell |= {"trials": 0, "without_value": 0.0, "accepted": None, "verdict": "not decided"}
    (folder / "choice.json").write_text(json.dumps(document), encoding="utf-8")
    choice = read_choice(folder)
    assert {(row.accepted, row.without_value) for row in sensor_rows(choice, choice.sensors[0])} == {("–", "–")}
    with without_pictures():
        write_choice_page(folder)
    text = html.unescape(re.sub(r"<[^>]*>|\s+", " ", (folder / "choice.html").read_text(encoding="utf-8")))
    assert "0 virtual measurements" not in text
    # an interval is of virtual measurements; the page has none, and says why the verdict is open
    assert "that interval" not in text and "predicted by screening alone" in text


def test_a_row_names_the_largest_line_of_the_budget_only_if_the_trials_tell_it(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    path = folder / "statement.json"

    def source(**changed):
        document = json.loads(path.read_text())
        document["measurements"][MEASUREMENTS[0]]["budget"][0] |= changed
        path.write_text(json.dumps(document))
        return of_run(read_run(folder), read_scene_geometry(folder)).rows[0].source

    assert source(settled=False) == ""
    assert source(settled=True) == "mostly calibration and drift"
    assert source(share=0.45, low=0.02) == ""  # under half, and the next line may be as large
    assert source(low=0.1) == "mostly calibration and drift"


def test_a_run_without_a_statement_shows_the_leading_view_so_far(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    about = json.loads((folder / "run.json").read_text())
    view = about["leaders"]["all measurements"]
    (folder / "statement.json").unlink()
    first = of_run(read_run(folder), read_scene_geometry(folder))
    assert first.tone == "warn" and first.words().startswith(f"View {view} leads so far, by ")
    assert f"view {view}" in first.picture.caption and len(first.rows) == len(MEASUREMENTS)
    with without_pictures():
        page = write_report(folder).read_text()
    assert "No view can make the measurements" not in page and "by virtual measurements" in page
    (folder / "run.json").write_text(json.dumps(about | {"race_trials": 0}))
    first = of_run(read_run(folder), read_scene_geometry(folder))
    assert first.words().startswith(f"View {view} leads so far, by the performance map alone; ")
    with without_pictures():
        assert "It made no virtual measurement." in write_report(folder).read_text()
    (folder / "run.json").write_text(json.dumps(about | {"leaders": {}}))
    with without_pictures():
        assert "No view can make the measurements" in write_report(folder).read_text()


def test_a_sensor_that_was_not_measured_and_may_fit_more_is_named(tmp_path):
    folder = write_choice(tmp_path / "choice")
    document = json.loads((folder / "choice.json").read_text(encoding="utf-8"))
    best, open_one = document["sensors"] = document["sensors"][1:3]
    assert best["fits"] == 1
    open_one["why"] = "time was over"
    for cell in open_one["measurements"].values():
        cell |= {"demand": 0.5, "accepted": None}
    (folder / "choice.json").write_text(json.dumps(document), encoding="utf-8")
    choice = read_choice(folder)
    best_one, left_out = choice.sensors[0], choice.sensors[1].model_copy(update={"why": OUT_BY_FAR})
    (words,) = of_choice(choice, None).doubts
    assert words.startswith("sensor-c was not measured (time was over), but is expected to fit 3 of 3 tolerances")
    assert words.endswith("allow more minutes")
    (far,) = of_choice(choice.model_copy(update={"sensors": [best_one, left_out]}), None).doubts
    assert "minutes" not in far and far.endswith("to measure it, compare sensor-c alone")
    cell = best_one.measurements[NAMES[0]].model_copy(
        update={"verdict": "not decided", "demand": None, "accepted": None}
    )
    unknown = best_one.model_copy(update={"measurements": best_one.measurements | {NAMES[0]: cell}})
    assert sensor_rows(choice, unknown)[0].accepted == "–"  # of a single value: "none", as if every part were rejected
    accepted = [{row.accepted for row in sensor_rows(choice, one)} for one in choice.sensors]
    assert accepted[1] == {"–"} and "–" not in accepted[0]
