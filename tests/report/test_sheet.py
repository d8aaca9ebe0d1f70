"""The sheet to sign: complete, on one page, and no text over another, for runs and for comparisons of sensors."""

import json
import os
import re
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.spatial.transform import Rotation

from characterisation.files.atomic_io import write_netcdf
from characterisation.statements.statement import AT_THE_LIMIT
from characterisation.tasks.decision_table import Decision as TaskDecision
from mitsim.report import page_pictures
from mitsim.report.choice_page import write_choice_page
from mitsim.report.declaration import pose_in_full, read_declaration
from mitsim.report.page import write_report
from mitsim.report.sheet import sheet_figures, write_sheet
from mitsim.report.sheet_layout import text_width, wrapped
from mitsim.report.unknowns_words import unknowns_in_words
from mitsim.sensor.unknowns import MeasuredFinish, UnknownsTable
from mitsim.study.choice_document import PoseEntry
from mitsim.study.scene_geometry import read_scene_geometry
from mitsim.study.statement_file import read_statement
from tests.report.choice_run import write_choice
from tests.report.conftest import DECISION, FEATURES


def figures_of(folder):
    geometry = read_scene_geometry(folder)
    return sheet_figures(read_declaration(folder, geometry), geometry)


def boxes_of(figure):
    """Every text of a page with its box [px]."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = canvas.get_renderer()
    texts = [one for one in figure.texts if one.get_text().strip()]
    for part in figure.subfigs:
        texts += [one for axes in part.axes for one in axes.texts if one.get_text()]
        texts += [one for legend in part.legends for one in legend.get_texts()]
    return [(one.get_text(), one.get_window_extent(drawn)) for one in texts]


def with_rows(folder, count, long=False):
    """The same run with a statement of ``count`` measurements, all of which have a value and a tolerance."""
    statement = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    known = next(iter(statement["measurements"].values())) | {"tolerance": 0.4, "verdict": "does not fit"}
    tail = "_to_the_far_end_of_the_guide_rail_left_of_the_bore" if long else ""
    names = [f"distance_{k}{tail}" for k in range(count)]
    statement["measurements"] = dict.fromkeys(names, known)
    (folder / "statement.json").write_text(json.dumps(statement), encoding="utf-8")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    about["measurements"] = dict.fromkeys(names, next(iter(about["measurements"].values())))
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    for path in (folder / "scores.nc", folder / "checks.nc"):
        with xr.open_dataset(path) as data:
            of_rows = data.isel(measurement=[0] * count).assign_coords(measurement=names).load()
        write_netcdf(of_rows, path)


@pytest.mark.parametrize(
    ("rows", "long", "sizes", "pages"),
    [(2, False, 0, 1), (13, True, 0, 1), (20, True, 0, 2), (70, False, 0, 3), (2, False, 600, 5)],
)
def test_no_text_overlaps_another_or_leaves_the_page(run_folder, tmp_path, rows, long, sizes, pages):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    with_rows(folder, rows, long)
    declaration = read_declaration(folder, read_scene_geometry(folder))
    forms = [("Sizes (σ or range)", ", ".join(f"form of the face_{k} of the housing 0.02 mm" for k in range(sizes)))]
    declaration = replace(declaration, facts=[*declaration.facts, *forms])
    figures = sheet_figures(declaration, read_scene_geometry(folder))
    assert len(figures) == pages
    shown = ""
    for figure in figures:
        boxes = boxes_of(figure)
        shown += "\n".join(text for text, _ in boxes)
        page = figure.bbox.padded(-0.5 * figure.dpi)
        assert [text for text, box in boxes if box.x0 < page.x0 or box.x1 > page.x1 or box.y0 < 0.4 * figure.dpi] == []
        # boxes of neighbouring lines may share their ascent
        small = [(text, box.padded(-1.5)) for text, box in boxes]
        assert [(a, b) for k, (a, one) in enumerate(small) for b, other in small[:k] if one.overlaps(other)] == []
    assert all(f"distance_{k}" in shown for k in range(rows)) and "Signature" in shown
    assert all(f"face_{k} " in shown.replace("\n", " ") for k in range(sizes))
    assert "organisation" in shown and shown.count("not traceable") == pages


def test_facts_are_set_smaller_before_a_sheet_gets_a_second_page(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    with_rows(folder, 9)
    geometry = read_scene_geometry(folder)
    declaration = read_declaration(folder, geometry)
    found = []
    for count in range(1, 60):
        more = [(f"fact {k}", "one word after another") for k in range(count)]
        pages = sheet_figures(replace(declaration, facts=more), geometry)
        (name,) = [one for page in pages for one in page.texts if one.get_text() == "fact 0"]
        found.append((len(pages), name.get_fontsize()))
        if len(pages) > 1:
            break
    assert [pages for pages, _ in found[:-1]] == [1] * (len(found) - 1) and found[-1][0] == 2
    sizes = [size for _, size in found[:-1]]
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) > 1 and found[-1][1] == sizes[0]


def test_a_table_of_long_names_is_legible_and_has_its_head_on_each_page(run_folder, tmp_path):
    """Thirteen measurements of long names took two pages, with three rows in 5.5 pt on the first."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    with_rows(folder, 13, long=True)
    (page,) = figures_of(folder)
    sizes = [one.get_fontsize() for one in page.texts if one.get_text().startswith("distance_")]
    assert len(sizes) == 13 and min(sizes) >= 7
    with_rows(shutil.copytree(run_folder, tmp_path / "more"), 40, long=True)
    pages = figures_of(tmp_path / "more")
    texts = [[one.get_text() for one in page.texts] for page in pages]
    rows = [sum(text.startswith("distance_") for text in page) for page in texts]
    assert len(pages) == 2 and sum(rows) == 40 and rows[0] > 15
    assert all("Tolerance" in page for page in texts) and "Sensor" not in texts[0] and "Sensor" in texts[1]


def with_rows_of(folder, *changes):
    """Give a run a row distance_K for each change of its statement."""
    with_rows(folder, len(changes))
    statement = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    rows = zip(statement["measurements"].values(), changes, strict=True)
    statement["measurements"] = {f"distance_{k}": one | change for k, (one, change) in enumerate(rows)}
    (folder / "statement.json").write_text(json.dumps(statement), encoding="utf-8")


def test_notes_on_some_rows_mark_them_and_have_the_names_elsewhere(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    with_rows_of(folder, {"settled": False, "errors_of": AT_THE_LIMIT}, {"settled": True}, {"settled": False})
    declaration = read_declaration(folder, None)
    notes = {note.mark: note.in_full for note in declaration.notes if note.mark}
    assert notes["*"].startswith("distance_0 and distance_2: not settled after JCGM 101")
    shown = [one.get_text().replace("\N{NO-BREAK SPACE}", " ") for one in sheet_figures(declaration, None)[0].texts]
    assert {"distance_0 † *", "distance_1", "distance_2 *"} <= set(shown)
    assert any(text.startswith("† errors for a part at the limit") for text in shown)


def test_a_sheet_says_how_rough_a_number_of_few_virtual_measurements_is(run_folder, tmp_path):
    """It stated u and a verdict of four virtual measurements without a word; the page of a comparison warned."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    rows = [(8, 0.5), (200, 0.1), (10, 0.0)]
    with_rows_of(folder, *({"trials": trials, "without_value": lost} for trials, lost in rows))
    notes = [note.in_full for note in read_declaration(folder, None).notes]
    # the 2.5 % points of chi-square of 3 and 9 degrees are 0.216 and 2.700
    assert "distance_0: 4 virtual measurements only: standard uncertainties may be 3.7 times as large." in notes
    assert "distance_2: 10 virtual measurements only: standard uncertainties may be 1.8 times as large." in notes
    assert not any("distance_1" in note and "only" in note for note in notes)


def test_a_sheet_has_what_iso_ts_15530_4_and_jcgm_101_ask_for(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    statement = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    statement["influences"] = [
        {"name": "noise", "included": True, "how": "drawn", "simulated": True},
        {"name": "form", "included": False, "how": "drawn", "simulated": True},
        {"name": "coatings", "included": False, "how": "clean", "simulated": False},
    ]
    statement["unknowns"] = {"pose": {"placement_mm": 1.0, "told_deg": 0.0}}
    (folder / "statement.json").write_text(json.dumps(statement), encoding="utf-8")
    declaration = read_declaration(folder, None)
    facts = dict(declaration.facts)
    assert facts["Varied"] == "noise" and facts["Fixed"] == "form" and facts["Left out"] == "coatings"
    assert facts["Sizes (σ or range)"] == "pose, for each axis: position of the part 1 mm"
    assert {"Part", "Sensor", "Pose of the sensor", "Method", "Calibration", "Exposure", "Decision rule"} <= set(facts)
    assert "not by a metal part with calibrated values" in facts["Verified by"]
    assert "200 virtual measurements" in facts["Method"] and "seed 7" in facts["Made with"]
    row = declaration.rows[0]
    # U = 0.47 + 0.03 and k = U / 0.25
    assert row.expanded == "0.50\N{NO-BREAK SPACE}mm" and row.factor == "2.00" and row.trials == "200"
    assert row.interval == "−0.52 to 0.47 mm" and row.bias == "−0.03\N{NO-BREAK SPACE}mm"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", declaration.date) and declaration.number in facts["Made with"]


@pytest.mark.parametrize(
    ("measured_by", "lay", "drawn"), [("render", 1.0, True), ("render", 0.0, False), ("map", 1.0, False)]
)
def test_a_direction_of_marks_that_is_drawn_is_not_left_out(run_folder, tmp_path, measured_by, lay, drawn):
    """Sheet and report named it as left out beside the "lay" whose size the sheet gives as drawn."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    for name, more in (
        ("run.json", {"lay": {FEATURES[0]: "round"}}),
        ("statement.json", {"measured_by": measured_by, "unknowns": {"finish": {"lay": lay}}}),
    ):
        document = json.loads((folder / name).read_text(encoding="utf-8")) | more
        (folder / name).write_text(json.dumps(document), encoding="utf-8")
    facts = dict(read_declaration(folder, None).facts)
    assert ("direction of machining marks" in facts["Varied"]) is drawn
    assert ("direction of machining marks" in facts["Left out"]) is not drawn
    page = write_report(folder).read_text(encoding="utf-8")
    assert ("virtual measurements draw a direction" in page) is drawn
    assert ("Prediction and virtual measurements treat the faces" in page) is not drawn


def test_a_sheet_says_which_decision_rule_holds_for_which_row_and_with_which_limits(run_folder, tmp_path):
    """It listed the rules of all rows without a name, and without the ratio or the share that they ask for."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    with_rows(folder, 3)
    strict = TaskDecision(guard_share=0.1, subtract_bias=True).in_words
    simple = TaskDecision(rule="simple_acceptance", uncertainty_ratio=3).in_words
    statement = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    for name, rule in zip(statement["measurements"], (strict, simple, strict), strict=True):
        statement["measurements"][name] = statement["measurements"][name] | {"decision": DECISION | {"rule": rule}}
    statement["influences"] = [{"name": "drift since the calibration", "included": False, "how": "", "simulated": True}]
    (folder / "statement.json").write_text(json.dumps(statement), encoding="utf-8")
    facts = dict(read_declaration(folder, None).facts)
    one, other = facts["Decision rule"].split("; ")
    assert one.startswith("distance_0 and distance_2: ISO 14253-1") and "at most 10 % of the tolerance" in one
    assert one.endswith("readings minus the bias")
    assert other.startswith("distance_1: simple acceptance") and "at least 3 times" in other
    assert facts["Calibration"].endswith("no drift")
    assert f"{one}; {other}" in write_report(folder).read_text(encoding="utf-8")


def test_the_date_is_that_of_the_run(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8")) | {"date": "2025-02-03"}
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    assert read_declaration(folder, None).date == "2025-02-03"


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="time zones of POSIX")
@pytest.mark.parametrize(("zone", "day"), [("UTC", "2025-02-03"), ("Pacific/Kiritimati", "2025-02-04")])
def test_the_date_of_an_older_folder_is_the_day_here(run_folder, tmp_path, monkeypatch, zone, day):
    """Written at 2025-02-03 20:00 UTC, which is ten in the morning of the 4th on Kiritimati, 14 h ahead."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8")) | {"date": ""}
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    os.utime(folder / "run.json", (1738612800, 1738612800))
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        assert read_declaration(folder, None).date == day
    finally:
        monkeypatch.undo()
        time.tzset()


def test_a_sheet_is_one_page_of_pdf_and_the_same_at_every_call(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    first = write_sheet(folder).read_bytes()
    assert first.startswith(b"%PDF") and len(re.findall(rb"/Type /Page\b", first)) == 1
    assert write_sheet(folder).read_bytes() == first


def test_a_sheet_draws_no_picture_of_the_page(run_folder, tmp_path, monkeypatch):
    """Sheet, DCC and QIF drew the first picture of the page twice, and threw it away: 15 of 25 s for a bracket."""
    folder, drawn = shutil.copytree(run_folder, tmp_path / "run"), []
    draw = page_pictures.placement_figure
    monkeypatch.setattr(page_pictures, "placement_figure", lambda *given: drawn.append(given) or draw(*given))
    write_sheet(folder)
    assert not drawn
    write_report(folder)
    assert len(drawn) == 2  # for wide and for narrow windows


def test_a_sheet_without_a_statement_calls_itself_a_prediction_and_cannot_be_signed(run_folder, tmp_path):
    """Five minutes gave u = 0.016 mm by screening, where virtual measurements find 0.48 mm, above lines to sign."""
    folder = shutil.copytree(run_folder, tmp_path / "run")

    def words():
        pages = sheet_figures(read_declaration(folder, None), read_scene_geometry(folder))
        return " ".join(one.get_text() for page in pages for one in page.texts)

    assert "Signature" in words() and "Statement of measurement uncertainty" in words()
    (folder / "statement.json").unlink()
    assert "Signature" not in words() and "Not a statement of measurement uncertainty" in words()
    assert "u is predicted. The same mitsim run continues" in words()


def test_the_sheet_of_a_comparison_has_the_statement_of_the_best_sensor(tmp_path):
    folder = write_choice(tmp_path / "choice")
    declaration = read_declaration(folder, read_scene_geometry(folder))
    facts = dict(declaration.facts)
    assert declaration.title == "sensor-a-of-a-long-name measures part" and facts["Left out"] == "dirt"
    assert "sensor-b (fits 1 of 3)" in facts["Also compared"] and "sensor-d" not in facts["Also compared"]
    assert [row.result.verdict for row in declaration.rows] == ["fits"] * 3
    (figure,) = sheet_figures(declaration, read_scene_geometry(folder))
    assert [text for text, box in boxes_of(figure) if box.x0 < 0.5 * figure.dpi] == []


def test_a_row_from_another_view_has_no_numbers_of_the_stated_one(tmp_path):
    """Its u was that of view 5, beside U, k and interval of view 3; the sheet gave the pose of view 3 alone."""
    folder = write_choice(tmp_path / "choice")
    made = json.loads((folder / "choice.json").read_text(encoding="utf-8"))
    best = made["sensors"][0]
    name = list(best["measurements"])[1]
    best["measurements"][name] = best["measurements"][name] | {"view": 5, "uncertainty": 0.001}
    best["poses"].append(best["poses"][0] | {"view": 5})
    (folder / "choice.json").write_text(json.dumps(made), encoding="utf-8")
    path = folder / best["name"] / "statement.json"
    statement = json.loads(path.read_text(encoding="utf-8"))
    statement["measurements"] = dict.fromkeys(best["measurements"], next(iter(statement["measurements"].values())))
    path.write_text(json.dumps(statement), encoding="utf-8")
    declaration = read_declaration(folder, None)
    facts = dict(declaration.facts)
    assert facts["Pose of the sensor"].startswith("view 3: ") and f"for {name}, view 5: " in facts["Another pose"]
    rows = {row.result.name: row for row in declaration.rows}
    assert rows[name].expanded == rows[name].interval == rows[name].factor == "–"
    assert rows[name].result.about.endswith("from view 5") and "view" not in declaration.rows[0].result.about
    assert any(row.interval != "–" for row in declaration.rows)


def test_a_statement_far_below_the_maker_says_so_on_sheet_and_page_of_a_comparison(tmp_path):
    folder = write_choice(tmp_path / "choice")
    path = folder / "sensor-a-of-a-long-name" / "statement.json"
    statement = json.loads(path.read_text(encoding="utf-8"))
    for one in statement["measurements"].values():
        one["maker_sigma"] = 100.0
    path.write_text(json.dumps(statement), encoding="utf-8")
    notes = [note.in_full for note in read_declaration(folder, None).notes]
    assert "below a tenth of the accuracy that the maker" in notes[-1] and "the influences listed below" in notes[-1]
    assert "below a tenth of the accuracy that the maker" in write_choice_page(folder).read_text(encoding="utf-8")


def test_a_pose_in_full_gives_the_pose_back(run_folder):
    turn = Rotation.from_euler("xyz", [0.3, -1.1, 2.2])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), [1.5, -2.25, 300.0]
    pose = PoseEntry(
        view=3, azimuth_deg=0, elevation_deg=0, roll_deg=0, standoff_mm=300, world_from_sensor=matrix.tolist()
    )
    text = pose_in_full(pose).replace("\N{MINUS SIGN}", "-")
    origin, quaternion = ([float(x) for x in one.split(", ")] for one in re.findall(r"\(([-0-9., ]+)\)", text))
    assert origin == [1.5, -2.25, 300.0]
    assert Rotation.from_quat(quaternion).as_matrix() == pytest.approx(turn.as_matrix(), abs=2e-6)


def test_sizes_of_unknowns_have_units_and_meanings():
    table = {
        "calibration": {"covariance": "rig.nc", "vergence_mrad": 0.24, "scale": 1.0},
        "temperature": {"body_per_kelvin": 2.3e-5, "part_kelvin": 1.0, "expansion_per_kelvin": None},
        "finish": {"alpha": 1.0, "lay": 0.5, "measured": {}},
        "form": {"features": {"plane": 0.02, "pin": 0.0}},
        "light": {"room": "office", "daylight": 0.2},
        "unit": {},
        "decoder": {"known": False, "thresholds": [0.5, 2.0], "methods": ["sgbm", "census"]},
        "coat": {"thickness_um": [5.0, 20.0], "spread": 0.3},
    }
    assert unknowns_in_words(table).split("; ") == [
        "drift since the calibration: vergence 0.24 mrad",
        "finish, each over the known spread of such surfaces: width of the lobe, lay (0.5 of it)",
        "form deviation: plane 0.02 mm",
        "light: room of 500 lx (office), 20 % of it daylight",
        "temperature: part 1 K about 20 °C, expansion of the sensor 23 × 10⁻⁶ per K",
        "coat: mean thickness 5 to 20 µm, 30 % from place to place",
        "decoder: settings within the ranges in statement.json",
    ]
    assert unknowns_in_words({"calibration": {"scale": 0.5}, "decoder": {"known": True}}) == (
        "drift since the calibration: 0.5 times all of these and the errors of the calibration itself"
    )
    plate = MeasuredFinish(alpha=(1.4, 0.2), wide_angle=(-0.5, 0)).model_dump(mode="json")
    assert unknowns_in_words({"finish": {"alpha": 0.0, "measured": {"plate": plate}}}).endswith(
        ": width of the lobe of plate 1.4 ± 0.2 σ, light at wide angles of plate -0.5 ± 0 σ"
    )
    dark = {"room_factor": 1.6, "daylight": 0.2, "power_relative": 0.05}
    assert unknowns_in_words({"light": {"room": 0.0} | dark}) == (
        "light: no light of the room, power of the projector 5 %"
    )
    assert "no light of the room (dark cell), power" in unknowns_in_words({"light": {"room": "dark cell"} | dark})


def test_every_unknown_has_a_size_in_words():
    """The sheet gave keys: "finish, shares of its range: alpha 1", "room factor 1.6", "body 2.3e-05 per K"."""
    table = UnknownsTable().model_dump(mode="json")
    table["calibration"]["path_offset_mm"], table["light"]["exposure_relative"] = 1.0, 0.01
    table["form"]["features"], table["temperature"]["expansion_per_kelvin"] = {"plane": 0.02}, 1e-5
    words = unknowns_in_words(table)
    for group, keys in table.items():
        for key, value in keys.items() if group not in ("decoder", "unit") else ():
            if key != "measured" and value:
                changed = table | {
                    group: keys
                    | {
                        key: 2.0
                        if key == "scale"
                        else [0, 0]
                        if key == "thickness_um"
                        else {}
                        if key == "features"
                        else 0
                    }
                }
                assert (unknowns_in_words(changed) == words) == (key == "covariance"), key
    assert "_" not in words.replace("statement.json", "")


@pytest.mark.parametrize(("spray", "shown"), [("thickness of the spray on the part", True), ("dirt, oil", False)])
def test_a_coat_is_declared_where_the_part_is_sprayed(run_folder, tmp_path, spray, shown):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    statement = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    statement["influences"] = [{"name": spray, "included": True, "how": "drawn", "simulated": True}]
    statement["unknowns"] = {"coat": {"thickness_um": [5.0, 20.0]}}
    (folder / "statement.json").write_text(json.dumps(statement), encoding="utf-8")
    facts = dict(read_declaration(folder, None).facts)
    assert ("5 to 20 µm" in facts["Sizes (σ or range)"]) == facts["Part"].endswith(", sprayed on") == shown


def test_lines_fit_and_lose_no_character():
    text = "the distance_between_the_two_bores_of_the_part is undecidable " + "x" * 90
    lines = wrapped(text, 8.0, 1.2)
    assert max(text_width(line, 8.0) for line in lines) <= 1.2 and len(lines) > 5
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")


def test_u_and_k_of_an_interval_without_ends_are_none(run_folder):
    statement = read_statement(run_folder / "statement.json")
    nothing = list(statement.measurements.values())[1]
    assert nothing.expanded_uncertainty is None and nothing.coverage_factor is None
