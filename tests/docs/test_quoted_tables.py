"""Quoted tables are compared with printed ones cell by cell: by the label of the row and the header of the column."""

import sys

import pytest

from tests.docs.test_docs import ROOT

sys.path.insert(0, str(ROOT / "docs" / "site"))

from quoted_tables import names_of, printed_tables, table_faults

PRINTED = """progress: 3 of 3
| quantity | unit | real | simulated | u | verdict |
| --- | --- | --- | --- | --- | --- |
| F | 1 | 0.9789 | 0.9997 | 0.0058 | **differs**: by 3.6 u |
| sigma, median | mm | 3.561 | 1.024 | 0.139 | **differs**: by 18 u |
| distance | mm | 464.7 | 465.1 | 0.3 | agrees: within 2 u |

page: runs/board
"""
QUOTED = """| | recorded | simulated, u | |
|---|---|---|---|
| F | 0.979 | 1.000, u 0.006 | differs |
| sigma along V [mm] | 3.56 | 1.02, u 0.14 | differs |
| distance [mm] | 464.7 | 465.1 | agrees |"""
COLUMNS = names_of("recorded = real; simulated, u = simulated & u; (4) = verdict")
ROWS = names_of("sigma along V = sigma, median")


def faults(quoted: str = QUOTED) -> list[str]:
    """Differences of a quoted table from the printed one above."""
    return table_faults(quoted.splitlines(), PRINTED, COLUMNS, ROWS)


def with_cells(row: int, cells: dict[int, str]) -> str:
    """The quoted table with other cells in one row, the head being row 0."""
    lines = QUOTED.splitlines()
    own = lines[row + 1 if row else 0].split("|")
    for column, cell in cells.items():
        own[column + 1] = f" {cell} "
    lines[row + 1 if row else 0] = "|".join(own)
    return "\n".join(lines)


def test_a_table_that_is_arranged_otherwise_is_the_same():
    assert faults() == []


SWAPPED = {
    "in a column": with_cells(1, {1: "3.56"}).replace("3.56 | 1.02", "0.979 | 1.02"),
    "in a row": with_cells(3, {1: "465.1", 2: "464.7"}),
    "in a cell": with_cells(2, {2: "0.14, u 1.02"}),
    "labels": with_cells(1, {0: "distance"}).replace("| distance [mm] | 464.7", "| F | 464.7"),
    "headers": with_cells(0, {1: "simulated, u", 2: "recorded"}),
    "words": with_cells(1, {3: "agrees"}),
}


@pytest.mark.parametrize("quoted", SWAPPED.values(), ids=SWAPPED.keys())
def test_swapped_cells_labels_headers_and_words_differ_although_all_are_printed(quoted):
    assert quoted != QUOTED
    assert faults(quoted)


def test_two_swapped_cells_are_both_named():
    swapped = SWAPPED["in a column"]
    assert "| F | 3.56 |" in swapped
    assert "| sigma along V [mm] | 0.979 |" in swapped
    assert faults(swapped) == [
        "F | recorded: quoted 3.56, printed 0.9789",
        "sigma along V [mm] | recorded: quoted 0.979, printed 3.561",
    ]


@pytest.mark.parametrize(
    ("cell", "count"),
    [("464.7", 0), ("465", 0), ("464.8", 0), ("464.9", 1), ("464.70", 0), ("464.71", 1), ("-464.7", 1)],
)
def test_numbers_are_compared_with_the_digits_that_are_quoted(cell, count):
    assert len(faults(with_cells(3, {1: cell}))) == count


def test_a_row_or_a_column_of_numbers_that_is_not_printed_is_a_difference():
    assert faults(with_cells(3, {0: "length"})) == [
        "length | recorded: no such row in the output",
        "length | simulated, u: no such row in the output",
        "length | : no such row in the output",
    ]
    assert faults(with_cells(0, {1: "measured"})) == [
        "column 'measured': no table of the output has it with these rows"
    ]


def test_columns_by_others_or_of_words_alone_and_text_in_backticks_are_not_compared():
    quoted = "| | real | by others | why |\n|---|---|---|---|\n| F | 0.979, `0.5` | 0.1 | dark |"
    assert table_faults(quoted.splitlines(), PRINTED) == []
    quoted = quoted.replace("by others", "of a friend")
    assert len(table_faults(quoted.splitlines(), PRINTED)) == 1


def test_a_row_can_have_another_column():
    printed = "| quantity | simulated | difference | u |\n|---|---|---|---|\n"
    printed += "| levels | - | 31 | 12 |\n| F | 0.9 | 0.1 | 0.2 |"
    quoted = "| | simulated, u |\n|---|---|\n| grey levels | 31, u 12 |\n| F | 0.9, u 0.2 |"
    columns = names_of("simulated, u = simulated & u")
    rows = names_of("grey levels = levels with difference for simulated")
    assert table_faults(quoted.splitlines(), printed, columns, rows) == []
    assert len(table_faults(quoted.splitlines(), printed, columns, names_of("grey levels = levels"))) == 1


GROUPED = """### Sealed parts

| sensor | parts | recall: map | once | rank: map | once |
| --- | --- | --- | --- | --- | --- |
| n10 | 2 | 0.80 (0.6 to 0.9) | 0.81 | 0.22 | 0.19 |
| all | 4 | 0.74 (0.6 to 0.8) | 0.80 | 0.39 | 0.41 |

### Open parts

| sensor | parts | recall: map | once | rank: map | once |
| --- | --- | --- | --- | --- | --- |
| n10 | 3 | 0.90 | 0.91 | 0.32 | 0.29 |
| all | 5 | 0.79 | 0.91 | 0.44 | 0.61 |
"""


def test_headers_belong_to_groups_and_rows_to_the_table_that_is_named():
    quoted = (
        "| parts | recall: map | once | rank: once |\n|---|---|---|---|\n"
        "| sealed | 0.74 (0.6 to 0.8) | 0.80 | 0.41 |\n| open | 0.79 | 0.91 | 0.61 |"
    )
    columns, rows = names_of("parts = sensor"), names_of("sealed = all; open = all in 2")
    assert table_faults(quoted.splitlines(), GROUPED, columns, rows) == []
    exchanged = names_of("sealed = all in 2; open = all")
    assert len(table_faults(quoted.splitlines(), GROUPED, columns, exchanged)) == 6
    ranks = quoted.replace("recall: map | once | rank: once", "rank: map | once | recall: once")
    assert len(table_faults(ranks.splitlines(), GROUPED, columns, rows)) == 6


def test_labels_of_several_cells_and_empty_cells_below_a_label():
    printed = "| part | view | u |\n|---|---|---|\n| a | 7 | 1.0 |\n| a | 8 | 2.0 |\n| b | 7 | 3.0 |\n"
    quoted = "| part | view | u |\n|---|---|---|\n| a | 7 | 1.0 |\n| | 8 | 2.0 |\n| b | 7 | 3.0 |"
    assert table_faults(quoted.splitlines(), printed) == []
    assert table_faults(quoted.replace("b | 7", "b | 8").splitlines(), printed) == [
        "b, 8 | u: no such row in the output"
    ]
    single = "| part | u |\n|---|---|\n| a | 1.0 |"
    assert table_faults(single.splitlines(), printed) == ["a | u: several such rows in the output"]


def test_text_tables_and_labels_that_contain_the_header():
    printed = f"{'parameter':<28} {'inside 95 %':>12} {'rms / sigma':>12}\n"
    printed += f"{'left.k1':<28} {0.957:>12.3f} {1.01:>12.3f}\n{'right.k1':<28} {0.954:>12.3f} {1.02:>12.3f}\n"
    printed += f"{'all of 1000 calibrations':<28} {0.9521:>12.3f}\n\n"
    table = printed_tables(printed)[0]
    assert table.heads == ("parameter", "inside 95 %", "rms / sigma")
    assert table.rows[1] == ("right.k1", "0.954", "1.020")
    columns = names_of("left = inside 95 % of left.{}; right = inside 95 % of right.{}")
    quoted = "| parameter | left | right |\n|---|---|---|\n| `k1` | 0.957 | 0.954 |"
    assert table_faults(quoted.splitlines(), printed, columns) == []
    assert len(table_faults(quoted.replace("left | right", "right | left").splitlines(), printed, columns)) == 2
