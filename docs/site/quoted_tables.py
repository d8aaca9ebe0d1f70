"""Compare a quoted table with the tables that a command prints, cell by cell.

A quoted cell is compared with the printed cell of the same row label and the same column header. Its numbers have to be
the first numbers of the printed cell, in this order and with the digits stated (:func:`quoted_numbers.same`). Cells of
words have to begin with the same word.

**Rows.** The label of a row is its first cell. If labels repeat, the following columns belong to the label, as many as
make it unique. An empty cell of a label repeats the one above.

**Columns.** A header with a colon names a group: ``rank: map | once`` are ``rank: map`` and ``rank: once``. A header is
found by this full name, else by its own if the printed table has it once.

Labels and headers are the same without regard to case, emphasis and a unit in brackets at the end. Comments before the
table name those that differ, the quoted name first; ``;`` separates them::

    <!-- rows: sigma along V, median = sigma, median; all = all of 1000 calibrations; open = all in 2 -->
    <!-- columns: recorded = real; simulated, u = simulated & u; (5) = verdict; carpet: recorded = real in 2 -->
    <!-- columns: N10 left = inside 95 % of left.{} in 3 -->
    <!-- rows: Wasserstein distance = grey levels, distance with difference for simulated -->

``&`` joins the cells of several printed columns. ``(5)`` is the fifth quoted column. ``of left.{}`` says how the
printed table writes the first cell of a label. ``in 2``, of a column or a row, is the second printed table that has the
column; without it a cell is that of the first table that has the column and the row. ``with difference for simulated``
takes another printed column in this row.

A column that no printed table has may only hold words. Columns *by others* and text in backticks are not compared.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from quoted_numbers import NUMBER, same


@dataclass(frozen=True)
class Table:
    """A table: its headers with the groups they belong to, and its rows."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Printed:
    """Where a quoted column or row is printed: its names, the label of a row, the number of the table, from 1.

    ``table`` 0 is the first that has it. ``other`` is the column that a row has in place of the column ``usual``.
    """

    names: tuple[str, ...]
    label: str = "{}"
    table: int = 0
    other: str = ""
    usual: str = ""


def row_of(line: str) -> list[str]:
    """Return the cells of a line of a Markdown table."""
    return [cell.strip().replace(r"\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]


def plain(text: str) -> str:
    """Return a label or header as it is compared: without case, emphasis and a unit at its end."""
    return re.sub(r"\s*\[[^\]]*\]$", "", " ".join(re.sub(r"[*`]", "", text).split())).casefold()


def grouped(heads: Sequence[str]) -> tuple[str, ...]:
    """Return headers in full: those after ``group: name`` get the same group."""
    out, group = [], ""
    for head in heads:
        own, colon, _ = head.partition(": ")
        group = own if colon else group
        out.append(head if colon or not group or not head else f"{group}: {head}")
    return tuple(out)


def printed_tables(output: str) -> list[Table]:
    """Return the tables of an output: in Markdown, or as text with two spaces or a tab between columns."""
    tables: list[Table] = []
    block: list[list[str]] = []
    for line in [*output.splitlines(), ""]:
        if line.startswith("|"):
            cells = row_of(line)
        else:
            cells = [cell.strip() for cell in re.split(r" {2,}|\t", line.rstrip())]
        if block and len(cells) != len(block[0]):
            if len(block) > 1:
                tables.append(Table(grouped(block[0]), tuple(map(tuple, block[1:]))))
            block = []
        if len(cells) > 1 and not all(re.fullmatch(":?-+:?", cell) for cell in cells):
            block.append(cells)
    return tables


def names_of(text: str) -> dict[str, str]:
    """Return the names of a comment: printed by quoted."""
    pairs = [one.partition(" = ") for one in re.split(r";\s+", text.strip())]
    return {plain(quoted): printed.strip() for quoted, _, printed in pairs}


def printed_place(text: str) -> Printed:
    """Return what a comment says of a column or row: ``head & head of left.{} in 2``."""
    match = re.fullmatch(r"(.*?)(?: of (\S*\{\}\S*))?(?: in (\d+))?(?: with (.+) for (.+))?", text)
    assert match is not None
    names = tuple(match[1].split(" & "))
    return Printed(names, match[2] or "{}", int(match[3] or 0), match[4] or "", match[5] or "")


def table_faults(
    quoted: Sequence[str], output: str, columns: Mapping[str, str] | None = None, rows: Mapping[str, str] | None = None
) -> list[str]:
    """Return the differences of a quoted Markdown table from the tables of an output."""
    columns, rows = columns or {}, rows or {}
    heads, body = grouped(row_of(quoted[0])), [row_of(line) for line in quoted[2:]]
    labels = _labels(body)
    if not labels:
        return ["rows with equal labels"]
    keys, tables, faults = len(labels[0]), printed_tables(output), []
    places = [_column(heads, at, columns) for at in range(len(heads))]
    for at in range(keys, len(heads)):
        cells = {label: row[at] for label, row in zip(labels, body, strict=True) if row[at]}
        if "by others" in heads[at] or not cells:
            continue
        having = [table for table in tables if None not in [_place(table, head) for head in places[at].names]]
        found = {label: _found(having, places[at], places[:keys], label, rows) for label in cells}
        if not any(found.values()):
            if any(map(_numbers, cells.values())) or places[at].names != (heads[at],):
                faults.append(f"column {heads[at]!r}: no table of the output has it with these rows")
            continue
        for label, cell in cells.items():
            if not found[label]:
                faults.append(f"{', '.join(label)} | {heads[at]}: no such row in the output")
            elif len(found[label]) > 1:
                faults.append(f"{', '.join(label)} | {heads[at]}: several such rows in the output")
            elif not _same_cell(cell, found[label][0]):
                faults.append(f"{', '.join(label)} | {heads[at]}: quoted {cell}, printed {found[label][0]}")
    return faults


def _labels(body: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return the labels of rows, of as many first cells as make them unique; empty if none do."""
    for keys in range(1, len(body[0])):
        labels: list[tuple[str, ...]] = []
        for row in body:
            above = labels[-1] if labels else ("",) * keys
            labels.append(tuple(cell or old for cell, old in zip(row[:keys], above, strict=True)))
        if len({tuple(map(plain, label)) for label in labels}) == len(body):
            return labels
    return []


def _column(heads: Sequence[str], at: int, columns: Mapping[str, str]) -> Printed:
    """Return where a quoted column is printed: as a comment says, else under its own name."""
    named = columns.get(f"({at + 1})", columns.get(plain(heads[at])))
    return Printed((heads[at],)) if named is None else printed_place(named)


def _place(table: Table, head: str) -> int | None:
    """Return the place of a header in a printed table, by its full name or by its own; None if it has none or two."""
    full = [at for at, one in enumerate(table.heads) if plain(one) == plain(head)]
    own = [at for at, one in enumerate(table.heads) if plain(one.rpartition(": ")[2]) == plain(head)]
    places = full or own
    return places[0] if len(places) == 1 and head else None


def _found(
    having: Sequence[Table], where: Printed, keys: Sequence[Printed], label: Sequence[str], rows: Mapping[str, str]
) -> list[str]:
    """Return the different printed cells of a column in rows with a label, of the tables that have the column."""
    named = [printed_place(rows[plain(one)]) if plain(one) in rows else None for one in label]
    wanted = [one if name is None else " & ".join(name.names) for one, name in zip(label, named, strict=True)]
    if named[0] is None:
        wanted[0] = where.label.format(label[0])
    others = {name.usual: name.other for name in named if name is not None and name.other}
    number = max([where.table, *(name.table for name in named if name is not None)])
    for table in having[number - 1 : number] if number else having:
        at = [_place(table, key.names[0]) for key in keys]
        at = [index if place is None else place for index, place in enumerate(at)]
        own = [_place(table, others.get(name, name)) for name in where.names]
        cells = [
            " ".join(row[place] for place in own if place is not None)
            for row in table.rows
            if all(_same_label(one, row[place]) for one, place in zip(wanted, at, strict=True))
        ]
        if cells:
            return list(dict.fromkeys(cells))
    return []


def _same_label(quoted: str, printed: str) -> bool:
    if plain(quoted) == plain(printed):
        return True
    return all(re.fullmatch(NUMBER, one) for one in (quoted, printed)) and same(quoted, printed)


def _numbers(cell: str) -> list[str]:
    return re.findall(NUMBER, re.sub(r"`[^`]*`", "", cell))


def _same_cell(quoted: str, printed: str) -> bool:
    """Return whether the numbers of a quoted cell are the first of the printed one; of words, the first word."""
    numbers, others = _numbers(quoted), _numbers(printed)
    if numbers:
        return len(numbers) <= len(others) and all(same(*pair) for pair in zip(numbers, others, strict=False))
    first, second = (re.findall(r"\w+|-", plain(cell)) for cell in (quoted, printed))
    return first[:1] == second[:1]
