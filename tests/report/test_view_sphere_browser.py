"""The sphere of views in a real browser, without a network: pointer, keyboard, both colour schemes, no scripts."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr
from jinja2 import Environment, FileSystemLoader
from matplotlib import colormaps

from characterisation.files.atomic_io import write_netcdf
from characterisation.words import numbers
from mitsim.report.view_sphere import view_sphere
from mitsim.study.run_folder import read_run
from tests.report.chromium import BROWSER
from tests.report.conftest import FEATURES, MEASUREMENTS
from tests.report.view_sphere_run import IMPOSSIBLE, SET, WITH_CLOUD

pytestmark = [pytest.mark.browser, pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")]

REPORT = Path(__file__).parents[2] / "mitsim" / "report"


@pytest.fixture
def opened(browser, page):
    browser.problems.clear()
    browser.requests.clear()
    browser.scheme("light")
    browser.open(page)
    browser.until("document.querySelector('#sphere-canvas').places?.length > 5")
    yield browser
    assert browser.problems == []


def words(browser, name: str) -> str:
    return browser.tell(f"document.getElementById('sphere-{name}').textContent")


def chosen(browser) -> int:
    return int(re.match(r"View (\d+)", words(browser, "title"))[1])


def cells(browser, name: str) -> list[list[str]]:
    rows = f"[...document.getElementById('sphere-{name}').rows]"
    return browser.tell(rows + ".map((row) => [...row.cells].map((cell) => cell.textContent))")


def mark(browser, view: int) -> tuple[float, float]:
    """Where a view is seen in the window, once what was last asked for is drawn."""
    browser.rest()
    box = browser.box("#sphere-canvas")
    x, y = browser.tell(
        f"(() => {{ const m = document.getElementById('sphere-canvas').places.find((one) => one.view === {view});"
        " return [m.x, m.y]; })()"
    )
    return box["x"] + x, box["y"] + y


def picture(browser, name: str) -> np.ndarray:
    """What a canvas shows (height, width, 3), RGB."""
    browser.rest()
    box = browser.box(f"#sphere-{name}")
    place = browser.tell("({x: scrollX, y: scrollY})")
    png = browser.shot(box | {"x": box["x"] + place["x"], "y": box["y"] + place["y"]})
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def press(browser, *keys: str, shift: bool = False) -> None:
    for key in keys:
        browser.press(key, shift=shift)


def to_sphere(browser) -> None:
    browser.tell("document.getElementById('sphere-canvas').focus()")


def choose(browser, selector: str, value: str | None = None) -> None:
    """Click a button or radio, or set a select."""
    change = f"e.value = {value!r}; e.dispatchEvent(new Event('change', {{bubbles: true}}))" if value else "e.click()"
    browser.tell(f"(() => {{ const e = document.querySelector({selector!r}); {change}; }})()")


def test_opens_from_a_disk_without_a_network_and_without_complaint(opened, page):
    asked = [address for address in opened.requests if not address.startswith("data:image/png;base64,")]
    assert asked == [page.as_uri()]
    assert chosen(opened) == 0 and "best" in words(opened, "title")
    assert opened.tell("document.querySelectorAll('.vs-alive').length") == 1
    assert opened.tell("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize("width", [420, 800])
def test_fits_a_narrow_window(opened, width):
    size = {"height": 900, "deviceScaleFactor": 1, "mobile": False}
    try:
        opened.call("Emulation.setDeviceMetricsOverride", width=width, **size)
        opened.rest()
        assert opened.tell("document.documentElement.scrollWidth <= innerWidth")
        assert opened.tell("document.getElementById('sphere-canvas').clientWidth") > 300
    finally:
        opened.call("Emulation.setDeviceMetricsOverride", width=1200, **size)


def test_sphere_and_cloud_are_painted_in_light_and_in_dark(opened):
    shown = {}
    for scheme, paper in (("light", [253, 253, 252]), ("dark", [22, 24, 28])):
        opened.scheme(scheme)
        shown[scheme] = both = {name: picture(opened, name) for name in ("canvas", "seen")}
        for image in both.values():
            pixels = image.reshape(-1, 3)
            assert (np.abs(pixels - paper).max(axis=1) <= 1).mean() > 0.3  # the paper shows between
            assert len(np.unique(pixels @ [1, 256, 65536])) > 100
        for end in (0.0, 1.0):  # the most and the least noise, in the colours of the legend
            colour = 255 * np.array(colormaps["cividis"](end)[:3])
            assert (np.abs(both["seen"].reshape(-1, 3) - colour).max(axis=1) <= 2).sum() > 20
    for name in ("canvas", "seen"):
        apart = np.abs(shown["light"][name] - shown["dark"][name]).max(axis=2)
        assert (apart > 60).mean() > 0.3


def test_marks_have_the_colour_of_their_value_and_a_cross_where_they_have_none(opened):
    for scheme, field in (("light", [0xE3, 0xE5, 0xE9]), ("dark", [0x2B, 0x2F, 0x36])):
        opened.scheme(scheme)
        shown = picture(opened, "canvas")
        near = "document.getElementById('sphere-canvas').places.filter((one) => one.near > 0)"
        marks = opened.tell(near + ".map((one) => [one.view, one.x, one.y])")
        assert len(marks) > 4
        for view, x, y in marks:
            if view == 0:
                continue  # the sensor's pyramid is drawn from its middle
            column, row = round(x - 0.5), round(y - 0.5)
            if view in IMPOSSIBLE:
                # between the arms of the cross, and where they meet
                beside = [shown[row + 5 * s, column] for s in (-1, 1)] + [shown[row, column + 5 * s] for s in (-1, 1)]
                assert np.abs(np.array(beside) - field).max() <= 4
                assert np.abs(shown[row, column] - field).max() > 60
                continue
            # u is 0.01 (1 + view), from 0.01 to 0.12, on a logarithmic scale with the least bright
            share = 1 - np.log(1 + view) / np.log(12)
            expected = 255 * np.array(colormaps["viridis"](share)[:3])
            # the script interpolates between 17 colours of the map, which is within 3 of 255
            assert np.abs(shown[row, column] - expected).max() <= 4, view


def test_a_click_on_a_mark_chooses_its_view(opened):
    seen = opened.tell("document.getElementById('sphere-canvas').places.map((one) => [one.view, one.near])")
    views = [view for view, near in seen if near > 0.3]
    assert len(views) > 3
    for view in views:
        opened.click(*mark(opened, view))
        site = {10, 11} if view in (10, 11) else {view}
        assert chosen(opened) in site
        assert words(opened, "status").startswith(f"View {chosen(opened)}, azimuth")


def test_pointing_tells_the_view_and_dragging_turns_without_choosing(opened):
    x, y = mark(opened, 1)
    opened.mouse("mouseMoved", x, y, "none")
    assert words(opened, "hint") == "view 1: 0.020°"
    assert not opened.tell("document.getElementById('sphere-hint').hidden")
    opened.drag((x, y), (x - 80, y + 20))
    assert chosen(opened) == 0
    moved = np.array(mark(opened, 1)) - (x, y)
    assert np.hypot(*moved) > 20


def test_keyboard_goes_to_the_best_to_neighbours_and_through_rolls(opened):
    to_sphere(opened)
    press(opened, "3")
    assert chosen(opened) == 2
    press(opened, "Home")
    assert chosen(opened) == 0 and "number 1 of 10" in words(opened, "status")
    press(opened, "ArrowRight")  # east: the azimuth grows
    assert chosen(opened) == 1
    press(opened, "ArrowLeft", "ArrowLeft")
    assert chosen(opened) == 5
    press(opened, "ArrowRight", "ArrowDown")  # from 60 deg down to 20 deg, at the same azimuth
    assert chosen(opened) == 6
    press(opened, "ArrowDown")
    assert words(opened, "status") == "No view farther down."
    press(opened, "9")
    assert chosen(opened) == 10 and "600\N{NO-BREAK SPACE}mm" in words(opened, "siblings")
    press(opened, "PageDown")
    assert chosen(opened) == 11 and "500\N{NO-BREAK SPACE}mm" in words(opened, "siblings")
    press(opened, "PageUp")
    assert chosen(opened) == 10
    before = mark(opened, 10)
    press(opened, "ArrowLeft", shift=True)
    opened.rest()
    assert chosen(opened) == 10 and np.hypot(*np.subtract(mark(opened, 10), before)) > 5


def test_the_pictures_take_the_focus_and_show_it(opened):
    opened.tell("document.querySelector('input[name=sphere-quantity]').focus()")
    reached = []
    for _ in range(8):
        press(opened, "Tab")
        reached.append(opened.tell("document.activeElement.id || document.activeElement.dataset.act"))
    assert reached[:6] == ["sphere-canvas", "sphere-best", "sphere-in", "sphere-out", "sphere-seen", "seen-home"]
    opened.tell("document.querySelector('input[name=sphere-quantity]').focus()")
    press(opened, "Tab")
    assert opened.tell("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_a_row_of_the_table_chooses_by_keyboard_and_keeps_the_focus(opened):
    opened.tell("document.querySelector('#sphere-best tr:nth-child(4) button').focus()")
    press(opened, "Enter")
    assert chosen(opened) == 3
    assert opened.tell("document.activeElement.dataset.view") == "3"
    assert opened.tell("document.querySelector('#sphere-best tr[aria-current]').rowIndex") == 4


def test_panel_tells_pose_uncertainty_limit_and_features(opened):
    choose(opened, "#sphere-best tr:nth-child(2) button")
    told = words(opened, "pose")
    assert "azimuth 60°, elevation 60°" in told and "125, 217, 433" in told and "500\N{NO-BREAK SPACE}mm" in told
    told = words(opened, "expected")
    assert "0.020°" in told and "26, of a tolerance of 0.52°" in told and "99\N{NO-BREAK SPACE}%" in told
    assert f"{FEATURES[1]}: the noise of its points" in told
    rows = cells(opened, "features")
    assert rows[1] == [FEATURES[1], "yes", "200", "0.16", "40\N{NO-BREAK SPACE}%"]
    choose(opened, "#sphere-measurement", "1")
    assert "no tolerance is stated" in words(opened, "expected")
    first = opened.tell("document.querySelector('#sphere-features tr').textContent")
    assert first.startswith(FEATURES[0] + "not needed here")


def path_rows(browser) -> dict[str, list[str]]:
    return {row[0]: [cell.replace("\N{NO-BREAK SPACE}", " ") for cell in row[1:]] for row in cells(browser, "path")}


def test_path_of_decisions_takes_the_uncertainty_apart(opened):
    choose(opened, "#sphere-best tr:nth-child(2) button")
    rows = path_rows(opened)
    assert rows["Candidate"][:2] == ["view 1", "view 0"]
    assert rows["Pixels in the image"][:3] == ["1\u202f000", "4\u202f000", "× 2.0"]
    assert rows["Pixels in the image"][3] == "4.0 times the pixels: closer or less oblique"
    assert rows["Not occluded by the part"] == ["40 %", "90 %", "× 1.5", "2.3 times the visible share"]
    assert rows["Recovered with this finish"] == ["50 %", "50 %", "× 1.0", "equal"]
    assert rows["Expected points"][:2] == ["200", "1\u202f800"]
    assert rows["Noise σ of a point"] == ["0.16 mm", "0.20 mm", "× 0.80", "better than in the best view"]
    assert rows["Geometry and other causes"][2] == "× 0.83"  # 2 / (2 * 1.5 * 1 * 0.8)
    assert rows["Standard uncertainty"][:3] == ["0.020°", "0.010°", "× 2.0"]
    assert rows["Rank"][0] == "2 of 10"
    assert "2.0 times the uncertainty of view 0" in words(opened, "path-note")
    assert "the size in the image (×\N{NO-BREAK SPACE}2.0) and occlusion by the part" in words(opened, "path-note")


def test_path_stops_where_a_view_fails(opened):
    choose(opened, "#sphere-measurement", "1")
    choose(opened, "[data-set='0']")
    to_sphere(opened)
    stops = {}
    for view in (3, 5):
        opened.tell(
            f"(() => {{ const b = document.createElement('button'); b.dataset.view = {view};"
            " document.getElementById('sphere-siblings').append(b); b.click(); })()"
        )
        stops[view] = [name for name, row in path_rows(opened).items() if "fails here" in row[-1]]
    assert stops == {3: ["Expected points"], 5: []}  # 5 is able here, and fails the first measurement
    choose(opened, "#sphere-measurement", "0")
    assert [name for name, row in path_rows(opened).items() if "fails here" in row[-1]] == ["Not occluded by the part"]
    assert "not possible" in words(opened, "title") and "hides it" in words(opened, "expected")


def test_the_table_is_the_one_that_stands_in_the_page_without_scripts(opened, page):
    body = re.search(r'<tbody id="sphere-best">(.*?)</tbody>', page.read_text(encoding="utf-8"), re.DOTALL)[1]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", body)]
    plain = [[re.sub("<[^>]*>", "", cell) for cell in row] for row in rows]
    assert len(plain) == 10 and cells(opened, "best") == plain


def test_measurement_and_quantity_change_order_and_scale(opened):
    order = "[...document.querySelectorAll('#sphere-best button')].map((b) => Number(b.dataset.view))"
    assert opened.tell(order) == [0, 1, 2, 3, 4, 6, 7, 8, 10, 11]
    assert "tolerance / uncertainty" in words(opened, "legend") and "[°]" in words(opened, "legend")
    choose(opened, "#sphere-measurement", "1")
    assert opened.tell(order) == [11, 10, 9, 8, 7, 6, 5, 4, 2, 1]  # not 3, which has hardly a chance
    assert "[mm]" in words(opened, "legend") and "tolerance" not in words(opened, "legend")
    choose(opened, "[value=points]")
    # 1800 points but in views 1 (200) and 5 (none): equals stay in the order of their uncertainty
    assert opened.tell(order) == [11, 10, 9, 8, 7, 6, 4, 2, 0, 1]
    assert "expected points" in words(opened, "legend")
    choose(opened, "[value=score]")
    assert "view score" in words(opened, "legend")
    marks = "[...document.querySelectorAll('#sphere-legend .vs-ticks span')]"
    ticks = opened.tell(marks + ".map((mark) => parseFloat(mark.style.left))")
    assert ticks[0] == 0 and len(ticks) > 2 and ticks == sorted(ticks)  # bright, on the right, is a high score


def test_a_view_without_its_cloud_offers_the_nearest(opened):
    choose(opened, "#sphere-best tr:nth-child(2) button")  # view 1
    told = words(opened, "cloud-told")
    nearest = int(re.search(r"Show the cloud of view (\d+)", told)[1])
    assert "of view 1 is not on this page" in told and nearest in WITH_CLOUD
    without = picture(opened, "seen")
    choose(opened, "#sphere-cloud-told button")
    assert f"the cloud of view {nearest}" in words(opened, "cloud-told")
    assert (np.abs(picture(opened, "seen") - without).max(axis=2) > 30).mean() > 0.02
    choose(opened, "[value=feature]")
    assert FEATURES[1] in words(opened, "noise")
    pixels = picture(opened, "seen").reshape(-1, 3)
    for colour in ((0xE6, 0x9F, 0x00), (0x56, 0xB4, 0xE9)):  # both features, in the colours of the legend
        assert (np.abs(pixels - colour).max(axis=1) <= 2).sum() > 100


def test_a_set_is_marked_and_says_whether_it_is_proven(opened):
    row = opened.tell("document.querySelector('[data-set]').closest('tr').textContent")
    assert f"{SET['uncertainty'][MEASUREMENTS[1]]:.3f}" in row and "proven" in row
    before = picture(opened, "canvas")
    choose(opened, "[data-set]")
    assert opened.tell("document.querySelector('[data-set]').getAttribute('aria-pressed')") == "true"
    assert not opened.tell("document.getElementById('sphere-set-key').hidden")
    assert (np.abs(picture(opened, "canvas") - before).max(axis=2) > 60).sum() > 40
    choose(opened, "[data-set]")
    assert opened.tell("document.getElementById('sphere-set-key').hidden")


def test_a_measurement_that_no_view_can_make_and_a_run_without_part_or_clouds_are_shown(opened, expecting, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(expecting, folder)
    for path in [folder / "part.ply", *(folder / "clouds").glob("predicted_*")]:
        path.unlink()
    scores = xr.load_dataset(folder / "scores.nc")
    scores["predicted_uncertainty"][0], scores["chance"][0], scores["uncertainty_possible"][0] = np.nan, 0.0, False
    scores["limiting_feature"][1] = "hole"  # no shape, so its points are not told
    write_netcdf(scores, folder / "scores.nc")
    content = view_sphere(read_run(folder))
    section = Environment(loader=FileSystemLoader(REPORT)).get_template("view_sphere.html.j2").render(sphere=content)
    text = f"<!doctype html><meta charset=utf-8>{section}<script>{content['script']}</script>"
    (tmp_path / "alone.html").write_text(text, encoding="utf-8")
    opened.open(tmp_path / "alone.html")
    opened.until("document.querySelector('#sphere-canvas').places?.length > 5")
    assert words(opened, "best") == "no view can make this measurement"
    assert words(opened, "path-note").endswith("No view can make this measurement.")
    assert words(opened, "cloud-told") == "This page has no predicted cloud."
    to_sphere(opened)
    press(opened, "Home")
    assert words(opened, "status") == f"Only 0 views can make {MEASUREMENTS[0]}."
    press(opened, "ArrowRight")
    assert chosen(opened) == 1
    for quantity in ("score", "chance", "points"):
        choose(opened, f"[value={quantity}]")
    choose(opened, "#sphere-measurement", "1")
    assert words(opened, "path-note").startswith(f"For {FEATURES[1]}. 11 times")
    assert "hole: the noise of its points" in words(opened, "expected")


def test_without_scripts_the_table_remains_and_says_so(browser, page):
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.call("Page.navigate", url=page.as_uri())
        browser.until("document.readyState === 'complete'")
        shown = "[...document.querySelectorAll({0!r})].map((e) => e.getBoundingClientRect().height > 0)"
        assert browser.tell(shown.format("canvas")) == [False, False]
        assert browser.tell(shown.format("#sphere noscript p")) == [True]
        assert browser.tell(shown.format("#sphere-best tr")) == [True] * 10
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)


def test_script_writes_numbers_as_the_rest_of_the_page_does(opened):
    values = [0.0996, 0.1, 1.04, 9.96, 99.6, 123456.0, 0.000123, 0.0, -0.25, 1e-7, 3.0]
    source = (REPORT / "view_panel.js").read_text(encoding="utf-8")
    shares, counts = [0.0, 0.0001, 0.05, 0.0994, 0.5, 0.97, 0.9951, 1.0], [0, 12, 1234, 1234567]

    def written(values: list, how: str) -> list:
        return opened.tell(f"(() => {{ {source} return {values}.map((v) => {how}); }})()")

    assert written(values, "twoDigits(v)") == [numbers.two_digits(v) for v in values]
    assert written(values, "quantity(v, 'deg')") == [numbers.quantity(v, "deg") for v in values]
    assert written(values, "quantity(v, 'mm')") == [numbers.quantity(v, "mm") for v in values]
    assert written(values, "rounded(v, 2)") == [numbers.rounded(v, 2) for v in values]
    assert written(shares, "percent(v)") == [numbers.percent(v) for v in shares]
    assert written(counts, "counted(v)") == [numbers.count(v) for v in counts]


def test_the_raster_covers_what_a_square_covers_and_the_nearer_face_hides_the_farther(opened):
    source = (REPORT / "view_scene.js").read_text(encoding="utf-8")
    script = """
      const canvas = document.createElement('canvas');
      Object.assign(canvas.style, {width: '400px', height: '300px', position: 'fixed', top: 0, left: 0});
      document.body.append(canvas);
      // two squares that face the viewer: side 1 at z = 0.5, then side 1.6 at z = 0, in the two orders
      const square = (half, z) => [[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]];
      const found = [[square(0.5, 0.5), square(0.8, 0)], [square(0.8, 0), square(0.5, 0.5)]].map((faces) => {
        const corners = faces.flat(), planes = (all) => [0, 1, 2].flatMap((axis) => all.map((one) => one[axis]));
        const near = faces[0][0][2] > 0 ? 0 : 1; // it is lit from the front, and the other from the side
        const solid = {
          vertices: Float32Array.from(planes(corners)),
          triangles: Uint16Array.from([0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7]),
          normals: Int8Array.from(planes(corners.map((_, i) => (i >> 2 === near ? [0, 0, 127] : [127, 0, 0])))),
        };
        const scene = new Scene(canvas, {solid, greys: Array.from({length: SHADES}, (_, k) => k + 1)});
        scene.draw();
        const count = (test) => scene.pixels.reduce((sum, one, at) => sum + test(one, scene.keys[at]), 0);
        const [x, y, key] = scene.project([0.5, 0.5, 0.5]);
        return {near: count((_, k) => k > 1.05), far: count((_, k) => k > 0 && k < 1.05), fineness: scene.fineness,
                edges: count((one) => one > SHADES), x, y, key,
                hidden: scene.hides(...scene.project([0, 0, -0.1])), free: scene.hides(...scene.project([0, 0, 0.9]))};
      });
      canvas.remove();
      return found;"""
    for found in opened.tell(f"(() => {{ {source} {script} }})()"):
        scale = 0.46 * 300 * found["fineness"]
        key = 5 / (5 - 0.5)
        assert [found["x"], found["y"], found["key"]] == pytest.approx([200 + 138 * key / 2, 150 - 138 * key / 2, key])
        side, whole = scale * key, 1.6 * scale
        # a square covers the pixels whose middles lie in it: its side to less than a pixel
        assert abs(np.sqrt(found["near"]) - side) < 1 and abs(np.sqrt(found["near"] + found["far"]) - whole) < 1
        # edges: a pixel on both sides of the inner outline, one on the inner side of the outer; corners add a few
        assert abs(found["edges"] - (8 * side + 4 * whole)) < 20
        assert found["hidden"] and not found["free"]


def test_names_of_features_do_not_cover_each_other_however_the_part_is_turned(opened):
    """The top of a boss is in the middle of the plate around it."""
    opened.tell("""(() => {
      const draw = CanvasRenderingContext2D.prototype, fill = draw.fillText, measure = draw.measureText;
      window.written = [];
      draw.fillText = function (text, x, y) {
        if (this.canvas.id === 'sphere-seen') window.written.push([text, y]);
        fill.call(this, text, x, y);
      };
      draw.measureText = function (text) { return { width: 1e4 }; };  // names so long that each is beside every other
      document.getElementById('sphere-seen').focus();
    })()""")
    for _ in range(12):
        opened.tell("window.written = []")
        opened.press("ArrowUp")
        opened.rest()
        lines = sorted(y for name, y in opened.tell("window.written") if name in FEATURES)
        assert len(lines) > 1 and min(np.diff(lines)) >= 12  # letters of 12 px
