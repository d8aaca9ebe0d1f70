"""The figures of the documentation: each says what makes it; those made in seconds are made again and compared."""

import re
import sys
from pathlib import Path

import pytest

from tests.docs.test_docs import PAGES, ROOT, by_page, check_call

sys.path.insert(0, str(ROOT / "docs" / "site"))

from figures import check, selected
from quoted import Figure, cells, compared, figures, holds_figures
from quoted_numbers import same
from quoted_tables import grouped, plain, row_of

#: figures that take no longer are made in this test [s]
QUICK = 5


def quick(page: Path) -> list[Figure]:
    """Figures of a page that are made here: no recordings, a few seconds."""
    return [one for one in selected(page, within=QUICK) if "$MITSIM_REAL_DATA" not in one.source]


@by_page
def test_every_output_picture_and_table_of_figures_says_where_it_comes_from(page):
    assert [f"{one.where}: {one.kind}" for one in figures(page) if not one.marker] == []


@by_page
def test_names_of_columns_and_rows_are_those_of_the_table(page):
    for one in (one for one in figures(page) if one.kind == "table"):
        heads = grouped(row_of(one.text[0]))
        known = {plain(head) for head in heads} | {f"({at})" for at in range(1, len(heads) + 1)}
        assert set(one.columns) <= known, one.where
        assert set(one.rows) <= {plain(cell) for row in one.text[2:] for cell in row_of(row)}, one.where


def test_files_that_pages_quote_and_the_repository_has_are_equal():
    quoted = {one.source: "\n".join(one.text) + "\n" for page in PAGES for one in figures(page) if one.kind == "file"}
    stored = {name: text for name, text in quoted.items() if (ROOT / name).is_file()}
    assert "scenes/two_pillars/set.toml" in stored
    for name, text in stored.items():
        assert (ROOT / name).read_text(encoding="utf-8") == text, name


@by_page
def test_every_fence_has_a_language(page):
    fences = re.findall(r"^```([^\n]*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(fences) % 2 == 0
    assert all(fences[::2]), page
    assert not any(fences[1::2]), page


@by_page
def test_commands_and_tests_that_markers_name_exist(page):
    for one in figures(page):
        assert one.source
        assert "; takes " not in one.source, f"{one.where}: write the time as '; takes 5 min -->'"
        if one.marker == "made by":
            assert one.seconds > 0, f"{one.where}: say how long it takes"
        if one.marker == "held by":
            assert page.name in (ROOT / one.source).read_text(encoding="utf-8"), one.source
        commands = [one.source] if one.marker == "made by" else re.findall(r"`([^`]+)`", one.source)
        for command in commands:
            for call in re.split(r"&&|;|\bdo\b|\(", command):
                check_call(call)
            for script in re.findall(r"python (tests/\S+\.py)", command):
                assert (ROOT / script).is_file(), script
            for module in re.findall(r"python -m (tests\.\S+)", command):
                name = module.replace(".", "/")
                assert (ROOT / f"{name}.py").is_file() or (ROOT / name / "__main__.py").is_file(), module


@pytest.mark.parametrize("page", [page for page in PAGES if quick(page)], ids=lambda page: str(page.relative_to(ROOT)))
def test_figures_that_are_made_in_seconds_are_those_of_the_commands(page):
    assert check(page, quick(page)) == []


def test_quick_figures_are_few_and_not_none():
    every = [one for page in PAGES for one in quick(page)]
    assert every
    assert sum({one.source: one.seconds for one in every}.values()) <= 20


@pytest.mark.parametrize(
    ("quoted", "found", "equal"),
    [
        ("0.83", "0.83", True),
        ("0.83", "0.834", True),
        ("0.83", "0.84", True),  # of 0.835
        ("0.83", "0.85", False),
        ("0.83", "0.836", False),
        ("0.834", "0.83", False),  # a digit that is not printed
        ("0.83", "1", False),
        ("1.10", "1.1", True),
        ("99", "98", False),  # the number of a view
        ("672", "671", False),
        ("24281", "24290", True),  # pixels, another processor
        ("24281", "24218", False),
        ("-0.12", "0.12", False),
        ("−0.12", "-0.12", True),
        ("1e-5", "2e-5", True),
        ("1.0e-5", "2.0e-5", False),
        ("400", "400.4", True),
        ("400", "401.2", False),
    ],
)
def test_two_numbers_are_the_same_if_both_may_be_roundings_of_one(quoted, found, equal):
    assert same(quoted, found) is equal


OUTPUT = """map: 102 views, 17 s left
valid\t24218
rank  u     limited by
   1  0.83  noise
   2  0.91  few points
took 17.3 s in /tmp/a
"""


@pytest.mark.parametrize(
    ("quoted", "faults"),
    [
        (["valid 24218", "...", "1  0.83  noise"], 0),
        (["2  0.91  few points"], 0),
        (["took 9 s in /home/b"], 0),
        (["map: ...", "2 ... points"], 0),
        (["map: 101 ..."], 1),
        (["valid 24500"], 1),
        (["1  0.83  few points"], 1),
        (["1  0.80  noise", "2  0.99  few points"], 2),
        (["2  0.91  few points", "1  0.83  noise"], 1),  # in another order
    ],
)
def test_quoted_lines_are_compared_in_order_by_words_and_numbers(quoted, faults):
    assert len(compared(quoted, OUTPUT)[0]) == faults


def test_changed_numbers_are_put_in_the_quoted_lines():
    assert compared(["...", "   1  0.70  noise"], OUTPUT)[1] == ["...", "   1  0.83  noise"]


def test_a_table_of_figures_is_one_of_numbers():
    table = ["| row | u |", "|---|---|", "| 3 | 0.83 |", "| `view 7` | 0.5, `0.6` |"]
    assert cells(table) == ["0.83", "0.5, `0.6`"]
    assert holds_figures(table)
    assert not holds_figures(["| key | meaning |", "|---|---|", "| a | a length of 3 mm |"])


def test_names_of_a_table_stand_before_it_and_hold_for_it_alone(tmp_path):
    page = tmp_path / "page.md"
    table = "| a | b |\n|---|---|\n| c | 1 |\n\n"
    page.write_text(
        "<!-- made by: mitsim decode a; takes 2 min -->\n<!-- columns: B = other; C = D & E -->\n"
        f"<!-- rows: c = all -->\n{table}<!-- made by: as above -->\n{table}",
        encoding="utf-8",
    )
    first, second = figures(page)
    assert (first.columns, first.rows) == ({"b": "other", "c": "D & E"}, {"c": "all"})
    assert (second.columns, second.rows) == ({}, {})
    assert first.source == second.source == "mitsim decode a"


def test_a_marker_is_needed_by_outputs_tables_and_pictures_alone(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```text\n1\n```\n\n```toml\na = 1\n```\n\n![p](p.png)\n\n| a | b |\n|---|---|\n| c | 1 |\n\n"
        "<!-- made by: mitsim decode a; takes 2 min -->\n```text\n1\n```\n\nwords\n\n```text\n2\n```\n",
        encoding="utf-8",
    )
    found = figures(page)
    assert [(one.kind, one.line, one.marker, one.seconds) for one in found] == [
        ("output", 2, "", 0),
        ("picture", 9, "", 0),
        ("table", 11, "", 0),
        ("output", 17, "made by", 120),
        ("output", 23, "", 0),
    ]
