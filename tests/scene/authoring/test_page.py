"""The page to author with, in a real browser: a bracket from STEP to a study that can be run, without an editor."""

from __future__ import annotations

import json
import os
import re
import signal
import time
import tomllib
import urllib.error
import urllib.request
import xml.etree.ElementTree as ElementTree
from functools import partial

import numpy as np
import pytest

from characterisation.tasks.task_reading import read_task
from mitsim.report.author_page import fair_share
from mitsim.scene.authoring.read_step import step_installed
from mitsim.study import open_study
from tests.quick_process import QuickProcess
from tests.report.chromium import BROWSER
from tests.scene.authoring.author import Author
from tests.scene.authoring.bracket import bracket, edge_at, write_step
from tests.shell import mitsim_here

needs_step = pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")
in_browser = [pytest.mark.browser, pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("bracket")


@pytest.fixture(scope="module")
def step_file(folder):
    return write_step([("bracket", bracket(), None)], folder / "bracket.step")


@pytest.fixture(scope="module")
def served(folder, step_file):
    """The command that serves the page of a bracket, and its address."""
    # what tests start ignores SIGINT where a shell runs them in its background
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    process = QuickProcess(
        "-m", "mitsim", "part", step_file, "-o", folder / "made", "--Ra", "0.4", "--edit", limits=heed
    )
    end = time.monotonic() + 300
    while (told := re.search(r"(?m)^(http://\S+)\n", process.said)) is None:
        assert process.running and time.monotonic() < end, process.said
        time.sleep(0.05)
    yield process, told[1]
    if process.running:
        os.kill(process.pid, signal.SIGINT)
        process.wait(30)


#: boxes of the texts in the picture, and lines, each with the number of its dimension
DRAWN = """(() => {
  const { words, lines } = document.getElementById('author-canvas').drawn;
  const owners = [...new Set([...words, ...lines].map((one) => one.own))], number = (one) => owners.indexOf(one.own);
  return [words.map((one) => [number(one), one.left, one.top, one.right, one.bottom]),
    lines.map((one) => [number(one), ...one.ends[0].slice(0, 2), ...one.ends[1].slice(0, 2)])];
})()"""


def covered(words, lines):
    """Texts that cover another text, or a line of another dimension."""
    inside = np.linspace(0, 1, 400)[:, None]
    found = []
    for k, (own, left, top, right, bottom) in enumerate(words):
        beside = (one for j, one in enumerate(words) if j != k)
        bad = any(a < right and left < c and b < bottom and top < d for _, a, b, c, d in beside)
        for other, *ends in lines:
            places = np.array(ends[:2]) * (1 - inside) + np.array(ends[2:]) * inside
            within = (places > [left, top]) & (places < [right, bottom])
            bad |= other != own and bool(within.all(axis=1).any())
        found += [words[k]] if bad else []
    return found


@needs_step
def test_nobody_else_gets_the_page_or_writes_files(served, folder):
    _, address = served
    before = sorted(path.name for path in (folder / "made").iterdir())
    host = re.match(r"http://127\.0\.0\.1:\d+", address)[0]
    body = json.dumps({"files": {"task": "[features]\n"}}).encode()
    strangers = [
        (f"{host}/", {}, None),
        (f"{host}/save", {}, body),
        (f"{address}save", {"Origin": "https://example.org"}, body),
        (f"{address}save", {"Host": "example.org"}, body),
        (f"{address}../task.toml", {}, None),
    ]
    for url, headers, data in strangers:
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(urllib.request.Request(url, data, headers), timeout=20)
        assert caught.value.code == 403
        caught.value.close()
    for sent, says in (
        (b'{"files": 3}', "hold the files of this page"),
        (b'{"files": {"task": "kind ="}}', "not TOML"),
        (b'{"files": {"scene": "<scene"}}', "made.xml"),
    ):
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(urllib.request.Request(f"{address}save", sent), timeout=60)
        with caught.value as answer:
            assert says in json.loads(answer.read())["fault"]
    assert sorted(path.name for path in (folder / "made").iterdir()) == before
    assert (folder / "made" / "made.xml").read_text().startswith("<!-- Made from bracket.step")


def page_of(made, browser):
    """Write the page of a scene folder by mitsim check, and open it."""
    mitsim_here("check", made / "made.xml", "--task", made / "task.toml", "--html", made.parent / "page.html")
    return Author(browser, (made.parent / "page.html").as_uri())


@needs_step
@pytest.mark.parametrize("scheme", [pytest.param("light", marks=in_browser)])
def test_a_bracket_from_step_to_a_study_without_an_editor(served, folder, browser, scheme):
    process, address = served
    browser.scheme(scheme)
    page = Author(browser, address)
    assert "bore_12mm_left" in page.faces()
    page.choose("bore_12mm_left")
    page.type("#author-name", "datum_bore")
    page.choose("datum_bore")
    page.type("#author-name", "seat_18mm")
    assert "seat_18mm exists already" in page.says
    page.choose("datum_bore", "bore_12mm_right")
    page.measure("axis_distance", "0,1")
    assert page.says == "Added datum_bore_to_bore_12mm_right_distance: 70 ±0.1"
    page.choose("seat_18mm")
    for wrong in ("0.1 0.1", "+0.1 -0.1 0", "wide", "-0.1"):
        page.measure("radius", wrong)
        assert "a number over 0, or two deviations" in page.says
    page.measure("radius", "+0,05 \u22120.1")
    assert page.says == "Added seat_18mm_radius: R9 +0.05 \u22120.1"
    page.type("[aria-label='tolerance of seat_18mm_radius']", "0 -0.1")
    page.choose("front_at_y18mm", "top_at_z12mm")
    offered = browser.tell("[...document.getElementById('author-kind').options].map((one) => one.value)")
    assert offered == ["plane_angle", "perpendicularity"]
    for wrong in ("-1", "-0.1 0.1"):
        page.measure("perpendicularity", wrong)
        assert page.says == f"The tolerance {wrong}: a number over 0, or empty"
    page.measure("perpendicularity", "0.2")
    page.choose("seat_18mm", "boss_20mm")
    page.pick("#author-finish", "+")
    for Ra, remark in (
        ("7", "▲ ground metal usually has Ra"),
        ("1.2", "● the map of ensenso-n10 has aluminium/ground only of Ra"),
    ):
        page.type("[aria-label^='Ra of finish_2']", Ra)
        assert remark in browser.tell("document.getElementById('author-finishes').textContent")
    assert "views are ranked by its nearest finish" in browser.tell(
        "document.getElementById('author-finishes').textContent"
    )
    page.type("[aria-label^='Ra of finish_2']", "0.2")
    browser.tell("document.getElementById('author-done').click()")
    browser.until("document.getElementById('author-status').textContent.startsWith('Done')", 90)
    code, told = process.wait(30)
    assert code == 0
    assert "saved once to" in told
    assert browser.problems == []
    assert {url.split("/")[2] for url in browser.requests if url.startswith("http")} == {address.split("/")[2]}
    made = folder / "made"
    task = tomllib.loads((made / "task.toml").read_text())
    assert task["measurements"]["datum_bore_to_bore_12mm_right_distance"] == {
        "kind": "axis_distance",
        "features": ["datum_bore", "bore_12mm_right"],
        "nominal": 70,
        "unit": "mm",
        "tolerance": 0.1,
    }
    assert task["measurements"]["seat_18mm_radius"]["tolerance"] == [-0.1, 0]
    assert task["measurements"]["front_at_y18mm_to_top_at_z12mm_perpendicularity"]["tolerance"] == 0.2
    root = ElementTree.parse(made / "made.xml").getroot()
    given = {shape.get("id"): shape.find("ref").get("id") for shape in root.iter("shape")}
    assert {name for name, finish in given.items() if finish == "finish_2"} == {"seat_18mm", "boss_20mm"}
    study = open_study(made / "study.toml")
    assert {str(finish) for finish in study.scene.finishes} == {
        "aluminium/ground Ra 0.4 um",
        "aluminium/ground Ra 0.2 um",
    }


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_a_page_by_itself_is_turned_and_clicked_and_needs_no_network(step_file, step_here, browser, tmp_path):
    for arguments in (
        ["part", step_file, "-o", tmp_path / "made"],
        ["check", tmp_path / "made/made.xml", "--task", tmp_path / "made/task.toml", "--html", tmp_path / "page.html"],
    ):
        mitsim_here(*arguments)
    browser.scheme("dark")
    page = Author(browser, (tmp_path / "page.html").as_uri())
    box = browser.box("#author-canvas")
    browser.click(box["x"] + box["width"] / 2, box["y"] + 0.62 * box["height"])
    first = browser.tell("document.getElementById('author-name').value")
    assert first in page.faces()
    before = browser.shot(box)
    browser.press("ArrowLeft")
    browser.press("n")
    browser.rest()
    assert browser.tell("document.getElementById('author-name').value") != first
    assert browser.shot(box) != before
    browser.press("Home")
    for chosen, kind in (
        (("bore_12mm_left", "bore_12mm_right"), "axis_distance"),
        (("boss_20mm",), "diameter"),
        (("bottom",), "flatness"),
    ):
        page.choose(*chosen)
        page.measure(kind, "0.1")
    browser.rest()
    words, lines = browser.tell(DRAWN)
    assert len(words) >= 4 and len(lines) >= 4 and covered(words, lines) == []
    assert [url for url in browser.requests if not url.startswith("file:")] == []
    assert browser.problems == []


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_rules_and_features_that_the_page_does_not_show_are_kept(step_file, step_here, browser, tmp_path):
    made = tmp_path / "made"
    mitsim_here("part", step_file, "-o", made)
    own = (
        "[features.middle]\nkind = 'mid_plane'\nof = ['left', 'right']\n"
        "[decision]\nrule = 'simple_acceptance'\nuncertainty_ratio = 6\n"
        "[measurements.size]\nkind = 'radius'\nfeatures = ['seat_18mm']\nnominal = 9\nunit = 'mm'\n"
        "tolerance = [-0.1, 0]\ndecision = { guard_share = 0.1 }\n"
    )
    (made / "task.toml").write_text((made / "task.toml").read_text() + own)
    page = page_of(made, browser)
    page.choose("left")
    page.type("#author-name", "side")
    written = tomllib.loads(page.downloaded()[1])
    before = tomllib.loads((made / "task.toml").read_text())
    assert written["decision"] == before["decision"]
    assert written["measurements"] == before["measurements"]
    assert written["features"]["middle"] == {"kind": "mid_plane", "of": ["side", "right"]}


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_rims_tolerance_classes_and_a_coat_are_given_by_a_click(step_file, step_here, browser, tmp_path):
    made = tmp_path / "made"
    mitsim_here("part", step_file, "-o", made)
    page = page_of(made, browser)

    page.choose("bore_12mm_left", "top_at_z12mm")
    browser.tell("document.getElementById('author-rim').click()")
    assert page.faces()[-1] == "◯ bore_12mm_left_rim"
    page.measure("diameter", "")
    page.type("#author-name", "hole")
    page.choose("bore_12mm_left", "top_at_z12mm")
    browser.tell("document.getElementById('author-rim').click()")  # it is chosen under its new name, not made again
    assert [name for name in page.faces() if "◯" in name] == ["◯ hole"]
    page.type("#author-name", "bore_12mm_left_rim")
    page.choose("bore_12mm_left", "bottom")
    browser.tell("document.getElementById('author-rim').click()")  # the other end of the same bore
    assert page.faces()[-1] == "◯ bore_12mm_left_rim_bottom"
    page.choose("bore_12mm_left", "left")  # a face along the axis has no rim
    assert browser.tell("document.getElementById('author-rim')") is None

    for names, kind in (
        (("bore_12mm_left", "bore_12mm_right"), "axis_distance"),
        (("bottom", "back"), "plane_angle"),
        (("bottom",), "flatness"),
        (("boss_20mm",), "radius"),
    ):
        page.choose(*names)
        page.measure(kind, "0.5" if kind == "radius" else "")
    page.choose("bore_12mm_right", "bore_12mm_left")
    page.measure("axis_distance", "0.3")
    assert "measures the same" in page.says
    browser.tell("document.getElementById('author-give').click()")
    assert page.says.startswith("4 of 4 measurements")
    browser.tell("document.getElementById('author-spray').click()")
    scene, task, *_ = page.downloaded()
    written = tomllib.loads(task)
    assert written["features"]["bore_12mm_left_rim"] == {
        "kind": "circle", "of": ["top_at_z12mm"], "point_mm": [-35, -8, 12], "radius_mm": 6
    }  # fmt: skip
    tolerances = {one["kind"]: (one["nominal"], one["tolerance"]) for one in written["measurements"].values()}
    # ISO 2768-mK: 12 mm, 70 mm, a shorter leg of 47 mm, a plane of 100 mm; the radius keeps its own
    assert tolerances == {
        "diameter": (12, 0.2),
        "axis_distance": (70, 0.3),
        "plane_angle": (90, 0.5),
        "flatness": (0, 0.2),
        "radius": (10, 0.5),
    }
    root = ElementTree.fromstring(scene)
    assert {one.find("ref").get("id") for one in root.iter("shape")} == {"sprayed_matt_white"}
    (made / "made.xml").write_text(scene)
    (made / "task.toml").write_text(task)
    checked = mitsim_here("check", made / "made.xml", "--task", made / "task.toml")
    assert "matt_white" in checked.stdout
    browser.tell("document.getElementById('author-spray').click()")
    assert "finish" in {one.find("ref").get("id") for one in ElementTree.fromstring(page.downloaded()[0]).iter("shape")}
    assert [one for one in browser.problems if "blob:none" not in one] == []  # downloads are caught, see Author


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_the_plane_midway_between_the_sides_of_a_wall_is_measured(step_file, step_here, browser, tmp_path):
    """The wall lies between y = 18 and 30 mm, and the base between -30 and 30 mm."""
    made = tmp_path / "made"
    mitsim_here("part", step_file, "-o", made)
    page = page_of(made, browser)
    kinds = "[...document.getElementById('author-kind').options].map((one) => one.value)"
    page.choose("front_at_y18mm", "top")
    assert browser.tell("document.getElementById('author-midway')") is None
    for sides in (("front_at_y18mm", "back"), ("back", "front_at_y18mm"), ("left", "right")):
        page.choose(*sides)
        browser.tell("document.getElementById('author-midway').click()")
    wall, base = (name for name in page.faces() if "middle" in name)
    page.choose(wall, "top")
    assert browser.tell(kinds) == ["perpendicularity"]
    page.measure("perpendicularity", "0.1")
    page.choose(wall, "front")
    assert browser.tell(kinds) == ["parallelism"]  # a plane 54 mm away is no plane of symmetry
    page.choose(wall, base)
    assert browser.tell(kinds) == ["perpendicularity"]
    page.choose(wall)
    page.measure("position", "0.2")
    (made / "task.toml").write_text(page.downloaded()[1])
    task = read_task(made / "task.toml")
    assert {(one.kind, len(one.features)) for one in task.measurements.values()} == {
        ("perpendicularity", 2),
        ("position", 1),
    }
    (name,) = {one.features[0] for one in task.measurements.values()}
    assert task.nominal(name).point[1] == 24
    assert {place[1] for place in task.features[name].outline_mm} == {24}


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_general_tolerances_go_by_sides_and_legs_not_by_the_box(step_here, browser, tmp_path):
    """ISO 2768-mK of a plate of 100 x 70 x 8 mm turned by 30 deg, whose box is 122 mm long, with a chamfer of 7 mm."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform
    from OCP.BRepFilletAPI import BRepFilletAPI_MakeChamfer
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Ax1, gp_Dir, gp_Pnt, gp_Trsf

    box = BRepPrimAPI_MakeBox(100, 70, 8).Shape()
    chamfered = BRepFilletAPI_MakeChamfer(box)
    chamfered.Add(5.0, edge_at(box, (50, 70, 8), (1, 0, 0)))
    motion = gp_Trsf()
    motion.SetRotation(gp_Ax1(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), np.deg2rad(30))
    plate = BRepBuilderAPI_Transform(chamfered.Shape(), motion).Shape()
    made = tmp_path / "made"
    mitsim_here("part", write_step([("plate", plate, None)], tmp_path / "plate.step"), "-o", made)
    page = page_of(made, browser)
    normals = {
        name: one["direction"] for name, one in tomllib.loads((made / "task.toml").read_text())["features"].items()
    }
    chamfer = next(name for name, way in normals.items() if abs(way[2]) == pytest.approx(np.sqrt(0.5), abs=1e-3))
    end = next(name for name, way in normals.items() if np.allclose(way, [np.cos(np.pi / 6), 0.5, 0], atol=1e-3))
    for names, kind in (
        ((chamfer, "top"), "plane_angle"),
        (("bottom",), "flatness"),
        ((end, "bottom"), "perpendicularity"),
    ):
        page.choose(*names)
        page.measure(kind, "")
    browser.tell("document.getElementById('author-give').click()")
    written = tomllib.loads(page.downloaded()[1])["measurements"]
    # legs of up to 10 mm; a side of 100 mm; legs of 8 and 100 mm
    assert {one["kind"]: one["tolerance"] for one in written.values()} == {
        "plane_angle": 1.0,
        "flatness": 0.2,
        "perpendicularity": 0.4,
    }


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_general_tolerances_of_radii_go_by_the_edge(step_here, browser, tmp_path):
    """ISO 2768-m: 0.5 mm for an edge of R4 (table 2), 0.2 mm for a fillet of R20, half that of a boss of 20 mm.

    Before, the edge and the fillet had half the tolerance of a diameter: 0.1 and 0.15 mm.
    """
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Fuse
    from OCP.BRepFilletAPI import BRepFilletAPI_MakeFillet
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    solid = BRepPrimAPI_MakeBox(100, 80, 12).Shape()
    solid = BRepAlgoAPI_Fuse(solid, BRepPrimAPI_MakeBox(gp_Pnt(0, 60, 12), gp_Pnt(100, 80, 60)).Shape()).Shape()
    boss = gp_Ax2(gp_Pnt(50, 20, 12), gp_Dir(0, 0, 1))
    solid = BRepAlgoAPI_Fuse(solid, BRepPrimAPI_MakeCylinder(boss, 10, 15).Shape()).Shape()
    for radius, place in ((20.0, (50, 60, 12)), (4.0, (50, 0, 12))):
        rounded = BRepFilletAPI_MakeFillet(solid)
        rounded.Add(radius, edge_at(solid, place, (1, 0, 0)))
        solid = rounded.Shape()
    made = tmp_path / "made"
    mitsim_here("part", write_step([("corner", solid, None)], tmp_path / "corner.step"), "-o", made)
    page = page_of(made, browser)
    for name in ("round_r4mm", "fillet_r20mm", "boss_20mm"):
        page.choose(name)
        page.measure("radius", "")
    browser.tell("document.getElementById('author-give').click()")
    written = tomllib.loads(page.downloaded()[1])["measurements"]
    assert {one["features"][0]: one["tolerance"] for one in written.values()} == {
        "round_r4mm": 0.5,
        "fillet_r20mm": 0.2,
        "boss_20mm": 0.1,
    }


@needs_step
@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_tables_are_whole_on_a_narrow_screen(step_file, step_here, browser, tmp_path):
    mitsim_here("part", step_file, "-o", tmp_path / "made")
    mitsim_here(
        "check", tmp_path / "made/made.xml", "--task", tmp_path / "made/task.toml", "--html", tmp_path / "p.html"
    )
    browser.call("Emulation.setDeviceMetricsOverride", width=400, height=800, deviceScaleFactor=1, mobile=False)
    try:
        page = Author(browser, (tmp_path / "p.html").as_uri())
        for bore in ("bore_12mm_left", "bore_12mm_right"):
            page.choose(bore, "top_at_z12mm")
            browser.tell("document.getElementById('author-rim').click()")
        page.choose("◯ bore_12mm_left_rim", "◯ bore_12mm_right_rim")
        page.measure("point_distance", "0.1")
        assert page.says == "Added bore_12mm_left_rim_to_bore_12mm_right_rim_distance: 70 ±0.1"
        # every cell lies within the page, below its head, and neither page nor table scrolls sideways
        labels = browser.tell("[...document.querySelectorAll('td[data-label]')].map((one) => one.dataset.label)")
        assert {"Name", "Kind", "Faces", "Nominal", "Tolerance", "Metal", "Process", "Ra [um]"} <= set(labels)
        wide = "[...document.querySelectorAll('html, .au-scroll')].map((one) => one.scrollWidth - one.clientWidth)"
        assert max(browser.tell(wide)) <= 0
        cells = "[...document.querySelectorAll('td')].map((one) => one.scrollWidth - one.clientWidth)"
        assert max(browser.tell(cells)) <= 0  # no word reaches into the next column
        browser.call("Emulation.setDeviceMetricsOverride", width=1100, height=800, deviceScaleFactor=1, mobile=False)
        assert max(browser.tell(wide)) <= 0
    finally:
        browser.reset()


@pytest.mark.parametrize(
    ("counts", "most", "share"), [([10, 20, 30], 60, 60), ([10, 200, 300], 110, 50), ([5], 3, 3), ([], 9, 9)]
)
def test_small_shapes_stay_whole_where_triangles_are_saved(counts, most, share):
    assert fair_share(counts, most) == share
    assert sum(min(count, share) for count in counts) <= most
