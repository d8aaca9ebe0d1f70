"""Layout of both pages in a real browser: no column lost, nothing beside the page, in light, dark and print."""

import json
import shutil

import pytest

from characterisation.plots.statements import GROUPS
from characterisation.words.numbers import percent
from mitsim.report.choice_page import write_choice_page
from mitsim.report.page import write_report
from tests.report import choice_run
from tests.report.choice_run import write_choice
from tests.report.chromium import BROWSER
from tests.report.conftest import plain_pictures
from tests.report.test_sheet import with_rows
from tests.report.view_sphere_run import write_expecting_run

pytestmark = [pytest.mark.browser, pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")]

#: cells that reach beyond the box that shows them; and by how much the page is too wide
LOST = """(() => {
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const lost = [];
  for (const cell of document.querySelectorAll('main th, main td, header th, header td, #result, dd, figcaption')) {
    const box = cell.getBoundingClientRect();
    if (!box.width || getComputedStyle(cell).display === 'none') continue;
    const frame = cell.closest('.scroll');
    const edge = frame ? frame.getBoundingClientRect().right : document.documentElement.clientWidth;
    if (box.right > edge + 1) lost.push(cell.textContent.trim().slice(0, 40));
    if (cell.scrollWidth > Math.ceil(box.width) + 1) lost.push('over: ' + cell.textContent.trim().slice(0, 40));
  }
  return {wide, lost};
})()"""

#: pairs of cells of one table that cover each other
OVERLAPS = """(() => {
  const found = [];
  for (const row of document.querySelectorAll('tr')) {
    const boxes = [...row.children].map((cell) => {
      const range = document.createRange();
      range.selectNodeContents(cell);
      return range.getBoundingClientRect();
    }).filter((box) => box.width);
    boxes.slice(1).forEach((box, k) => {
      if (box.left < boxes[k].right - 1 && box.top < boxes[k].bottom - 1) found.push(row.textContent.slice(0, 60));
    });
  }
  return found;
})()"""


@pytest.fixture(scope="module")
def pages(run_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("layout")
    # a set of so many views that they fill several lines, and a bracket of planned exposures
    sets = write_expecting_run(folder / "sets")
    about, statement = (
        json.loads((sets / name).read_text(encoding="utf-8")) for name in ("run.json", "statement.json")
    )
    about["view_sets"][0] |= {
        "views": list(range(12)),
        "joined": "joined by targets: each pose to 0.03 mm and 0.01 deg",
    }
    (sets / "run.json").write_text(json.dumps(about), encoding="utf-8")
    statement["exposure"] = {"exposures_s": [0.000815, 0.00231, 0.0131], "power": 0.5}
    line = {"variance": 1.2345e-4, "low": 1e-5, "high": 9e-3, "share": 1 / len(GROUPS), "share_interval": [0.11, 0.99]}
    lines = [line | {"group": group, "settled": True, "source": "", "fresh": True} for group in GROUPS]
    for one in statement["measurements"].values():
        one["budget"] = lines
    (sets / "statement.json").write_text(json.dumps(statement), encoding="utf-8")
    shutil.copytree(run_folder, folder / "run")
    with plain_pictures():
        choice = write_choice_page(write_choice(folder / "choice"))
        return {"run": write_report(folder / "run"), "choice": choice, "sets": write_report(sets)}


def set_size(browser, width: int, medium: str, scheme: str) -> None:
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=1000, deviceScaleFactor=1, mobile=False)
    browser.call(
        "Emulation.setEmulatedMedia", media=medium, features=[{"name": "prefers-color-scheme", "value": scheme}]
    )


@pytest.mark.parametrize("page", ["run", "choice", "sets"])
@pytest.mark.parametrize(
    ("width", "medium", "scheme"),
    [(1400, "screen", "light"), (1000, "screen", "dark"), (400, "screen", "light"), (703, "print", "light")],
)
def test_no_column_is_lost_and_no_cell_covers_another(browser, pages, page, width, medium, scheme):
    set_size(browser, width, medium, scheme)
    browser.open(pages[page])
    browser.tell("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert browser.tell(LOST) == {"wide": 0, "lost": []}
    assert browser.tell(OVERLAPS) == []


def test_a_name_of_80_letters_stays_within_its_cell_on_a_telephone(browser, pages, monkeypatch, tmp_path):
    """It is the head beside every cell of its column, and an entry of the list of the interactive views."""
    name = "_".join(["bore_10mm_left_rim"] * 4) + "_dist"
    monkeypatch.setattr(choice_run, "NAMES", (name, f"{name}_2", "angle"))
    with plain_pictures():
        choice = write_choice_page(write_choice(tmp_path / "choice"))
    set_size(browser, 400, "screen", "light")
    browser.open(choice)
    assert browser.tell(LOST) == {"wide": 0, "lost": []}
    browser.open(pages["run"])
    browser.tell(f"document.querySelector('#sphere-measurement option').textContent = '{name}'")
    assert browser.tell(LOST)["wide"] == 0
    set_size(browser, 703, "print", "light")  # the bars of the budget left the paper
    browser.tell(f"document.querySelector('.bar-name').innerHTML = '{name.replace('_', '_<wbr>')}'")
    assert browser.tell("document.querySelector('.bar').getBoundingClientRect().right <= 703")


@pytest.mark.parametrize("page", ["run", "choice"])
def test_the_result_is_on_the_first_screen(browser, pages, page):
    set_size(browser, 1400, "screen", "light")
    browser.open(pages[page])
    for name in ("result", "stand", "verdicts"):
        top = browser.tell(f"document.getElementById('{name}').getBoundingClientRect().top")
        assert 0 < top < 1000, name
    ink = browser.tell("getComputedStyle(document.body).color")
    set_size(browser, 1400, "screen", "dark")
    assert browser.tell("getComputedStyle(document.body).color") != ink


#: names in cells and headings that a line breaks elsewhere than after an underscore or a space
BROKEN = """(() => {
  const found = [];
  for (const cell of document.querySelectorAll('th, td, h2, h3, .bar-name, dd, p, figcaption, summary')) {
    const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    for (let node = walker.nextNode(); node; node = walker.nextNode()) {
      for (const word of node.data.matchAll(/[\\p{L}\\p{N}.]+/gu)) {
        const range = document.createRange();
        range.setStart(node, word.index);
        range.setEnd(node, word.index + word[0].length);
        if (new Set([...range.getClientRects()].map((one) => Math.round(one.top))).size > 1) found.push(word[0]);
      }
    }
  }
  return found;
})()"""


@pytest.fixture(scope="module")
def long_report(run_folder, tmp_path_factory):
    """Nine measurements of long names, as the statement of a bracket has."""
    folder = shutil.copytree(run_folder, tmp_path_factory.mktemp("long") / "run")
    with_rows(folder, 9, long=True)
    return write_report(folder)


def test_a_report_of_nine_measurements_is_folded_to_8000_px(browser, long_report):
    set_size(browser, 1400, "screen", "light")
    browser.open(long_report)
    assert 3000 < browser.tell("document.documentElement.scrollHeight") <= 8000
    assert browser.tell("document.querySelectorAll('details.fold:not([open])').length") >= 6
    browser.tell("location.hash = 'map-in'")
    browser.until("document.getElementById('map-in').closest('details').open")  # a link opens what is folded


@pytest.mark.parametrize("width", [1400, 400])
def test_no_word_is_broken(browser, long_report, tmp_path, width):
    far = "/home/someone/measured_parts/brackets/bracket_of_the_gearbox"
    folder = write_choice(tmp_path / "choice")
    choice = json.loads((folder / "choice.json").read_text(encoding="utf-8"))
    choice |= {"study": f"{far}/tolerances.toml", "scene": f"{far}/bracket.xml"}
    (folder / "choice.json").write_text(json.dumps(choice), encoding="utf-8")
    set_size(browser, width, "screen", "light")
    for page in (long_report, write_choice_page(folder)):
        browser.open(page)
        browser.tell("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        assert browser.tell(BROKEN) == []


@pytest.mark.parametrize("width", [1400, 400])
def test_words_of_the_picture_of_the_part_can_be_read(browser, tmp_path, width):
    page = write_choice_page(write_choice(tmp_path / "choice"))
    set_size(browser, width, "screen", "light")
    browser.open(page)
    heights = browser.tell(
        "[...document.querySelectorAll('#stand svg [id^=text_], #stand svg g[transform] > use')]"
        ".map((one) => one.getBoundingClientRect().height).filter((height) => height > 0)"
    )
    assert heights and max(heights) > 7, heights  # of a capital letter, 10 px high text


def test_print_shows_what_is_folded(browser, long_report):
    set_size(browser, 703, "print", "light")
    browser.open(long_report)
    assert browser.tell("document.getElementById('map-in').getBoundingClientRect().height") > 100
    assert browser.tell("document.getElementById('map-in').checkVisibility({contentVisibilityAuto: true})")


def test_a_page_read_in_dark_colours_is_printed_on_white_paper(browser, pages):
    set_size(browser, 703, "screen", "dark")
    browser.open(pages["run"])
    # sums of red, green and blue: of the letters, the paper, and the part in the interactive views
    sums = """(() => {
      const style = getComputedStyle(document.body), sum = (text) => text.match(/\\d+/g).reduce((a, b) => a + +b, 0);
      return [sum(style.color), sum(style.backgroundColor)];
    })()"""
    ink, paper = browser.tell(sums)
    assert ink > 600 and paper < 150
    set_size(browser, 703, "print", "dark")
    ink, paper = browser.tell(sums)
    assert ink < 150 and paper > 600


def test_the_verdicts_fit_a_telephone_without_scrolling(browser, pages):
    set_size(browser, 400, "screen", "light")
    for page in pages.values():
        browser.open(page)
        frame = "document.getElementById('verdicts').closest('.scroll')"
        assert browser.tell(f"{frame}.scrollWidth - {frame}.clientWidth") <= 1


@pytest.mark.parametrize("width", [1400, 400])
def test_a_set_of_many_views_is_read_from_its_top_and_without_scrolling(browser, pages, width):
    set_size(browser, width, "screen", "light")
    browser.open(pages["sets"])
    frame = "document.querySelector('.vs-sets').closest('.scroll')"
    assert browser.tell(f"{frame}.scrollWidth - {frame}.clientWidth") <= 1
    row = "[...document.querySelector('.vs-sets tbody tr').children].map((one) => one.getBoundingClientRect())"
    tops, bottoms = browser.tell(f"{row}.map((box) => box.top)"), browser.tell(f"{row}.map((box) => box.bottom)")
    if width == 1400:
        button = "document.querySelector('.vs-sets [data-set]').getBoundingClientRect()"
        assert len(set(tops)) == 1 and browser.tell(f"{button}.height") < 40  # in one line
    else:
        assert all(top >= above - 1 for above, top in zip(bottoms, tops[1:], strict=False))


def test_planned_exposures_are_told_as_one_list(pages):
    text = pages["sets"].read_text(encoding="utf-8")
    assert f"Expose 0.815, 2.31 and 13.1 ms, merged, at {percent(0.5)} of the projector" in text


def test_pages_are_small(pages):
    assert all(page.stat().st_size < 4_000_000 for page in pages.values())
