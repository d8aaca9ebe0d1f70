"""The page: whole, self-contained, safe against names, and refused in words where a file is missing or broken."""

import html
import json
import re
import shutil
from html.parser import HTMLParser

import pytest
from markupsafe import escape

from characterisation.errors import InputError
from mitsim.report.page import write_report

from .conftest import CHECKED, HOSTILE, MEASUREMENTS, write_run


class Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def all(self, tag: str) -> list[dict]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def text(report) -> str:
    return report.read_text(encoding="utf-8")


def test_holds_every_measurement_and_says_that_it_is_simulated(text):
    for name in MEASUREMENTS:
        assert f'<th class="left" scope="row">{html.escape(name)}<small>' in text  # the answer
        assert f"<h3>{html.escape(name)}</h3>" in text  # its pictures
        assert f"<summary>{html.escape(name)}</summary>" in text  # its ranked views
    assert '<span class="badge">simulated</span>' in text
    assert "fixed at 1 ms" in text


def test_has_every_picture_each_with_a_text_and_a_caption(text):
    tags = Tags(text)
    # fraction, noise, patches; two for each measurement; two views of clouds
    pictures = [a for a in tags.all("svg") if a.get("role") == "img"]
    assert len(pictures) == 3 + 2 * len(MEASUREMENTS) + 2
    images = tags.all("img")
    assert len(images) == 2 * len(CHECKED)  # left and right
    assert all(len(a["aria-label"]) > 20 for a in pictures)
    assert all(len(a["alt"]) > 20 for a in images)
    assert len(tags.all("figcaption")) == len(tags.all("figure")) == len(pictures) + len(CHECKED)


def test_asks_for_nothing_outside_itself(text):
    tags = Tags(text)
    references = [a[key] for _, a in tags.tags for key in ("src", "href", "xlink:href", "srcset", "data") if key in a]
    assert len(references) > 10
    assert all(r.startswith(("#", "data:image/png;base64,")) for r in references)
    assert not tags.all("script") and not tags.all("link") and not tags.all("iframe")
    assert not re.search(r"https?://|@import|url\((?!#)", text)
    assert not [a for _, a in tags.tags if any(key.startswith("on") for key in a)]


def test_names_are_text_and_never_markup(text):
    assert f"<dd>{escape(HOSTILE)}</dd>" in text
    assert "<script" not in text and "<u>" not in text and "<b>$" not in text and "plane<i>" not in text


def test_identifiers_of_the_page_are_unique(text):
    mine = re.findall(r'<section id="([^"]+)"', text)
    assert len(mine) == len(set(mine)) == 10
    assert {a["href"][1:] for a in Tags(text).all("a")} == set(mine)


def test_says_how_good_the_renders_are_and_nothing_where_that_is_not_known(text, run_folder, tmp_path):
    assert "render noise 0 and quadrature error 0.061 of the sensor’s own noise" in text
    assert "over it in 1.3\N{NO-BREAK SPACE}% of the pixels" in text
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps(about | {"render_residual": None}), encoding="utf-8")
    assert "quadrature error" not in write_report(folder).read_text(encoding="utf-8")


def test_leaves_nothing_beside_it_and_stays_small(report):
    assert not list(report.parent.glob(".*"))
    assert report.stat().st_size < 6e6


def test_a_run_without_checks_or_coupons_still_has_a_page(tmp_path):
    folder = write_run(tmp_path / "run", checked=[])
    (folder / "samples.nc").unlink()  # the study named a map that was made before
    text = write_report(folder).read_text(encoding="utf-8")
    assert "nothing here says whether the prediction holds" in text
    assert len([a for a in Tags(text).all("svg") if a.get("role") == "img"]) == 2 + len(MEASUREMENTS)


def test_a_broken_run_leaves_the_former_report_alone(run_folder, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    (folder / "report.html").write_text("former")
    (folder / "map.nc").write_bytes(b"garbage")
    with pytest.raises(InputError, match=r"map\.nc"):
        write_report(folder)
    assert (folder / "report.html").read_text() == "former"
