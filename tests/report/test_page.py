"""The page: whole, self-contained, safe against names, and refused in words where a file is missing or broken."""

import html
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from markupsafe import escape

from characterisation.files.atomic_io import write_netcdf
from characterisation.files.errors import InputError
from characterisation.words.numbers import percent, two_digits
from mitsim.report.page import write_report
from mitsim.report.templates import with_labels
from mitsim.study.run_folder import read_run
from tests.plain_pages import without_pictures
from tests.report.conftest import CHECKED, FEATURES, HOSTILE, MEASUREMENTS, plain_pictures, write_run


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


def test_names_the_next_best_views_what_is_missing_and_the_expected_loss(text):
    section = text[text.index('<section id="runners-up">') : text.index('<section id="answer">')]
    rows = [re.sub(r"<[^>]*>", " ", row).split() for row in re.findall(r"<tr>(.*?)</tr>", section, re.DOTALL)[1:]]
    assert [row[0] for row in rows] == [str(CHECKED[0]), str(CHECKED[2])]
    assert [row[1:4] for row in rows] == [["1.04", "5", "1.13"], ["1.27", "3", "\N{EN DASH}"]]
    assert re.search(r"expected to be 3\.4\s%\slarger than the least", text)
    assert "no &lt;b&gt;budget" in text and "no <b>budget" not in text


def test_has_every_picture_each_with_a_text_and_a_caption(text):
    tags = Tags(text)
    # the sensor before the part, twice; fraction, noise, patches; two for each measurement; two views of clouds
    pictures = [a for a in tags.all("svg") if a.get("role") == "img"]
    assert len(pictures) == 2 + 3 + 2 * len(MEASUREMENTS) + 2
    images = tags.all("img")
    assert len(images) == 2 * len(CHECKED)  # left and right
    assert all(len(a["aria-label"]) > 20 for a in pictures)
    assert all(len(a["alt"]) > 20 for a in images)
    assert len(tags.all("figcaption")) == len(tags.all("figure")) == len(pictures) - 1 + len(CHECKED)


def test_asks_for_nothing_outside_itself(text):
    tags = Tags(text)
    references = [a[key] for _, a in tags.tags for key in ("src", "href", "xlink:href", "srcset", "data") if key in a]
    assert len(references) > 10
    assert all(r.startswith(("#", "data:image/png;base64,")) for r in references)
    assert not tags.all("link") and not tags.all("iframe")
    assert not re.search(r"https?://|@import|url\((?!#)", text)
    assert not [a for _, a in tags.tags if any(key.startswith("on") for key in a)]


def test_names_are_text_and_never_markup(text):
    assert f"<dd>{escape(HOSTILE)}</dd>" in text.replace("<wbr>", "")
    assert "<script>alert" not in text and "<u>" not in text and "<b>$" not in text and "plane<i>" not in text


def test_identifiers_of_the_page_are_unique(text):
    mine = re.findall(r'<section id="([^"]+)"', text)
    assert len(mine) == len(set(mine)) == 13
    linked = [a["href"][1:] for a in Tags(text).all("a")]
    assert {one.removesuffix("-in") for one in linked} == set(mine)  # -in: inside what is folded, which a link opens
    assert all(text.count(f'id="{one}"') == 1 for one in linked)


def answers(text: str) -> list[list[str]]:
    """Cells of the first table, plain: measurement, view, azimuth, elevation, roll, position, u, ..."""
    body = re.search(r'<section id="answer">.*?<tbody>(.*?)</tbody>', text, re.DOTALL)[1]
    rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL) for row in body.split("</tr>")[:-1]]
    return [[re.sub("<[^>]*>", " ", cell).strip() for cell in row] for row in rows]


@pytest.fixture
def written():
    """The page of a folder as text, without pictures."""
    with without_pictures():
        yield lambda folder: write_report(folder).read_text(encoding="utf-8")


def plain(text: str) -> str:
    return html.unescape(re.sub(r"\s+", " ", text))


def test_the_best_view_of_each_measurement_is_the_leader_of_its_race(text, run_folder):
    scores = xr.load_dataset(run_folder / "scores.nc")
    for m, row in enumerate(answers(text)):
        here = scores.isel(measurement=m, view=CHECKED[1])
        assert row[1] == str(CHECKED[1])
        unit = ("°", "\N{NO-BREAK SPACE}mm")[m]
        risk, told = row[2].rsplit(" ", 2)[0].strip(), row[2]
        assert risk.startswith(two_digits(float(here["measured_risk"]))) and "8; 87" in told
        assert row[7] == two_digits(float(here["predicted_uncertainty"])) + unit
        assert row[8].split() == [f"{float(here['V_m']):.2f}", "rank", str(int(here["rank"]))]


def test_the_statement_is_told_first_with_its_budget_and_what_it_leaves_out(text):
    section = re.search(r'<section id="statement">(.*?)</section>', text, re.DOTALL)[1]
    assert text.index('id="statement"') < text.index('id="answer"')
    said = plain(re.sub("<[^>]*>", " ", section))
    assert f"Place the sensor at view {CHECKED[1]}" in said and "probability of 87" in said
    cells = said.replace("\N{NO-BREAK SPACE}", " ")
    for figure in ("−0.031 mm", "± 0.018 mm", "0.25 mm", "−0.52 to 0.47 mm", "−0.49 to 0.50 mm", "u = 0.23 mm", "13 %"):
        assert figure in cells, figure
    assert "undecidable" in said and "More virtual measurements would still change" in said
    assert "200 of 200" in said and "3 to 12 points, at least 100 are required" in said
    widths = [float(width) for width in re.findall(r"width:([\d.]+)%", section)]
    assert widths == pytest.approx([64.0, 36.0])
    assert "too few trials 32 to 90 %" in " ".join(cells.split()) and section.count('class="open"') == 1
    assert "0.10 mm" in cells and "36 %; 25 to 48 %" in cells
    assert re.search(r">dirt</th><td[^>]*>no</td>", section) and re.search(r">noise</th><td[^>]*>yes</td>", section)
    assert "Too few virtual measurements have a value for a bar of radius" in text


def test_what_would_make_a_measurement_fit_stands_below_the_result(run_folder, tmp_path, written):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    about = json.loads((folder / "run.json").read_text())
    after = {"bias": 0.0, "standard_uncertainty": 0.02, "demand": 0.8, "verdict": "fits"}
    about["remedies"] = {
        "measurements": {"radius": {"unit": "mm", "standard_uncertainty": 0.25, "needed": 0.03, "fits_by": 0}},
        "tried": [{"change": "spray", "words": "sprayed <white>", "trials": 40, "measurements": {"radius": after}}],
    }
    (folder / "run.json").write_text(json.dumps(about))
    page = plain(written(folder))
    line = "sprayed <white>: radius (u 0.020 mm, before 0.25 mm) fits (40 virtual measurements)"
    assert (
        page.index('id="result"')
        < page.index("What would make it fit?")
        < page.index(line)
        < page.index('id="verdicts"')
    )
    assert "<white>" not in written(folder)  # names are text


def test_a_measurement_of_edges_is_told_by_its_edges_and_counted_on_its_faces(run_folder, tmp_path, written):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    about = json.loads((folder / "run.json").read_text())
    _, entry = next(iter(about["measurements"].items()))
    entry["shapes"], entry["features"] = entry["features"], ["left_edge", "right_edge"]
    (folder / "run.json").write_text(json.dumps(about))
    page = plain(re.sub("<wbr>", "", written(folder)))
    assert "left_edge" in page and f"Points on<br>{entry['shapes'][0]}" in page
    entry["shapes"] = ["no_face"]
    (folder / "run.json").write_text(json.dumps(about))
    with pytest.raises(InputError, match="no_face"):
        written(folder)


def test_a_statement_far_below_the_accuracy_of_the_maker_says_so(run_folder, tmp_path, written):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    document = json.loads((folder / "statement.json").read_text())
    name = next(name for name, one in document["measurements"].items() if one["unit"] == "mm")
    document["measurements"][name]["maker_sigma"] = 11 * document["measurements"][name]["standard_uncertainty"]
    (folder / "statement.json").write_text(json.dumps(document))
    about = json.loads((folder / "run.json").read_text())
    about["files"] = {}
    (folder / "run.json").write_text(json.dumps(about))
    assert "below a tenth of the accuracy that the maker" in plain(written(folder))


@pytest.mark.parametrize("damage", ["[]", "{", '{"schema_version": 2}', '{"schema_version": 1, "view": "x"}'])
def test_a_damaged_statement_is_named(run_folder, tmp_path, damage):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    (folder / "statement.json").write_text(damage)
    with pytest.raises(InputError, match=r"statement\.json"):
        write_report(folder)


def test_a_statement_of_another_task_is_refused(run_folder, tmp_path):
    shutil.copytree(run_folder, tmp_path / "run")
    path = tmp_path / "run" / "statement.json"
    document = json.loads(path.read_text())
    document["measurements"]["of_another_task"] = next(iter(document["measurements"].values()))
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"statement\.json: measurements: found .*of_another_task"):
        read_run(tmp_path / "run")


def test_what_is_left_out_depends_on_what_the_map_knows(run_folder, tmp_path, written):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    known = written(folder)
    assert "the correlated noise of neighbouring points" in known and "60 pixels, 10°" in known
    with xr.open_dataset(folder / "map.nc") as data:
        data = data.load()
    data["noise_area"][:] = np.nan
    write_netcdf(data, folder / "map.nc")
    unknown = written(folder)
    assert "assume independent noise from pixel to pixel" in unknown
    assert "the correlated noise of neighbouring points" not in unknown


def test_says_how_good_the_renders_are_and_nothing_where_that_is_not_known(text, run_folder, tmp_path, written):
    assert "render noise at most 0, quadrature error at most 0.061 of the sensor’s own noise" in text
    assert "one of them exceeds it in 1.3\N{NO-BREAK SPACE}% of the pixels" in text
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps(about | {"render_residual": None}), encoding="utf-8")
    assert "quadrature error" not in written(folder)


def test_features_that_see_others_name_the_command_that_draws_their_light(run_folder, tmp_path, written):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps(about | {"faces_in_sight": {FEATURES[0]: 0.61}}), encoding="utf-8")
    text = written(folder)
    command = f"mitsim check SCENE.xml --sensor {about['sensor']} --pose statement.json --bounces bounced.png"
    assert f"{escape(FEATURES[0])} ({percent(0.61)})" in text and command in text


def test_leaves_nothing_beside_it_and_stays_small(report):
    assert not list(report.parent.glob(".*"))
    assert report.stat().st_size < 6e6


def test_a_run_without_checks_or_coupons_still_has_a_page(tmp_path):
    folder = write_run(tmp_path / "run", checked=[])
    (folder / "samples.nc").unlink()  # the study named a map that was made before
    with plain_pictures():
        text = write_report(folder).read_text(encoding="utf-8")
    assert "so the prediction was not tested" in text
    assert len([a for a in Tags(text).all("svg") if a.get("role") == "img"]) == 2 + len(MEASUREMENTS)


def test_a_broken_run_leaves_the_former_report_alone(run_folder, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    (folder / "report.html").write_text("former")
    (folder / "map.nc").write_bytes(b"garbage")
    with pytest.raises(InputError, match=r"map\.nc"):
        write_report(folder)
    assert (folder / "report.html").read_text() == "former"


def test_marks_whose_direction_is_left_out_are_named_with_their_faces(tmp_path, written):
    folder = write_run(tmp_path / "run")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    lay = {FEATURES[0]: "round", FEATURES[1]: "round"}
    (folder / "run.json").write_text(json.dumps(about | {"lay": lay}), encoding="utf-8")
    text = re.sub(r"\s+", " ", written(folder))
    assert f"on {html.escape(FEATURES[0])}, {html.escape(FEATURES[1])}. Such marks" in text
    assert "does not give their direction" in text


def test_cells_of_tables_are_labelled_by_their_columns():
    head = '<thead><tr><th>Name</th><th scope="col">Bias<small>its <b>u</b></small></th><th>A<br>B</th></tr></thead>'
    body = '<tr><th>a</th><td class="x">1</td><td>2</td></tr><tr><td colspan="3">none</td></tr>'
    table = f"<table>{head}{body}</table>"
    cells = '<td class="x" data-label="Bias, its u">1</td><td data-label="A B">2</td>'
    assert with_labels(f"<p>a</p>{table}") == f"<p>a</p>{table}".replace('<td class="x">1</td><td>2</td>', cells)
    # a name that may break in the head may break in the label as well
    narrow = with_labels("<table><thead><tr><th>bore_<wbr>left</th></tr></thead><tr><td>1</td></tr></table>")
    assert 'data-label="bore_\N{ZERO WIDTH SPACE}left"' in narrow
