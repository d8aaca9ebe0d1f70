"""Layout of both pages in a real browser: no column lost, nothing beside the page, in light, dark and print."""

import pytest

from mitsim.report.choice_page import write_choice_page
from mitsim.report.page import write_report

from .choice_run import write_choice
from .chromium import BROWSER, Chromium
from .conftest import write_run

pytestmark = [pytest.mark.browser, pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")]

#: cells that reach beyond the box that shows them, unless that box scrolls; and by how much the page is too wide
LOST = """(() => {
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const lost = [];
  for (const cell of document.querySelectorAll('main th, main td, header th, header td, #result, dd, figcaption')) {
    const box = cell.getBoundingClientRect();
    if (!box.width || getComputedStyle(cell).display === 'none') continue;
    const frame = cell.closest('.scroll');
    const edge = frame ? frame.getBoundingClientRect().right : document.documentElement.clientWidth;
    const scrolls = SCROLLS && frame && getComputedStyle(frame).overflowX === 'auto';
    if (box.right > edge + 1 && !scrolls) lost.push(cell.textContent.trim().slice(0, 40));
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
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("layout")
    run = write_report(write_run(folder / "run"))
    return {"run": run, "choice": write_choice_page(write_choice(folder / "choice"))}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Chromium(tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


def set_size(browser, width: int, medium: str, scheme: str) -> None:
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=1000, deviceScaleFactor=1, mobile=False)
    browser.call(
        "Emulation.setEmulatedMedia", media=medium, features=[{"name": "prefers-color-scheme", "value": scheme}]
    )


@pytest.mark.parametrize("page", ["run", "choice"])
@pytest.mark.parametrize(
    ("width", "medium", "scheme"),
    [(1400, "screen", "light"), (1000, "screen", "dark"), (400, "screen", "light"), (703, "print", "light")],
)
def test_no_column_is_lost_and_no_cell_covers_another(browser, pages, page, width, medium, scheme):
    set_size(browser, width, medium, scheme)
    browser.open(pages[page])
    browser.tell("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    found = browser.tell(LOST.replace("SCROLLS", "true" if width == 400 else "false"))
    assert found == {"wide": 0, "lost": []}
    assert browser.tell(OVERLAPS) == []


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


def test_the_verdicts_fit_a_telephone_without_scrolling(browser, pages):
    set_size(browser, 400, "screen", "light")
    for page in pages.values():
        browser.open(page)
        frame = "document.getElementById('verdicts').closest('.scroll')"
        assert browser.tell(f"{frame}.scrollWidth - {frame}.clientWidth") <= 1


def test_pages_are_small(pages):
    assert all(page.stat().st_size < 4_000_000 for page in pages.values())
