"""Read the points of a text: lines of x, y and z with any separators, a decimal point or comma, and names of columns.

Names of columns, in a line before the numbers or a comment, tell which columns are x, y and z; without names they are
the first three, unless these seem to count rows. The unit stands with the names (``x [mm]``, ``x_mm``), in a line below
them, or in a line of its own (``units: mm``). A comma is the decimal mark if other separators stand between the numbers
and no number has a point: programs write so in countries with a decimal comma. An empty field is a missing number.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError, in_one_line
from mitsim.capture.recordings.cloud_numbers import check_points_first, number_words, unit_in, unit_named
from mitsim.sensor.calibration_qualifiers import UNITS_MM

#: largest text [bytes]; reading takes ten times as much memory
_LARGEST = 256 * 1024**2

_SPACES = bytes.maketrans(b",;\t", b"   ")
_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}

#: a name of a column: x, y or z, which a word may precede, and a unit may follow
_NAME = re.compile(
    r"(?:points?|pos(?:ition)?|coord(?:inate)?)?[_.:]?([xyz])(?:_?(?:mm|m|cm|um|µm|μm)|_(?:in|inch|ft))?"
)

#: a remark in brackets, such as a unit
_BRACKETS = re.compile(r"[\[(][^\])]*[\])]")

#: the unit of a column x, y or z
_OF_AXIS = re.compile(r"(?<![a-z])[xyz](?:\s*[\[(]\s*(\w+)\s*[\])]|_(\w+))")

#: words before the names in a comment
_BEFORE_NAMES = re.compile(r"^(?:[\w ]*:|columns?|fields?|format)\s+")

#: a comma inside a number of a row whose numbers have other separators: a mark of thousands, say
_OTHER_MARK = re.compile(rb"\S,\S.*[;\t]\s*\S|\S\s*[;\t].*\S,\S|[^\s,] +[^\s,]+,\S|\S,[^\s,]+ +[^\s,]")

#: a comma inside a number in quotes, beside one that separates numbers
_QUOTED_COMMA = re.compile(rb'"[-+]?\d[\d.]*,\d[\d.,]*"\s*,|,\s*"[-+]?\d[\d.]*,\d[\d.,]*"')

#: lines from which separators and decimal mark are found
_SAMPLE = 200


def points_of_text(data: bytes, path: Path) -> tuple[NDArray[np.float64], str | None]:
    """Return the points (n, 3) of a text, and their unit of length if the text states one.

    Raises InputError if lines differ in their numbers, names lack x, y or z, or columns without names seem to count.
    """
    if len(data) > _LARGEST:
        raise InputError(path, "", f"{len(data):,} bytes of text", f"at most {_LARGEST:,}", "save it as PLY")
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), None)
    if encoding is not None:
        data = data.decode(encoding, "replace").encode()
    quoted = _QUOTED_COMMA.search(data)
    lines = [line.strip(b" \r\n") for line in data.replace(b'"', b"").splitlines()]
    rows = [line for line in lines if line.strip() and not _is_comment(line)]
    heads = [line.decode("utf-8", "replace") for line in lines[:100] if _is_comment(line)]
    try:
        if rows and len(number_words(rows[0].translate(_SPACES))) == 1:  # the number of points
            rows = rows[1:]
        rows = _with_points(rows)
        if mixed := next((row for row in rows[:_SAMPLE] if _OTHER_MARK.search(row)), quoted and quoted[0]):
            row = mixed[:60].decode("ascii", "replace")
            raise ValueError(f"{row!r}: a comma that is no separator, as of thousands")
        columns = len(number_words(rows[0].translate(_SPACES))) if rows else 0
        words = number_words(b"\n".join(rows).translate(_SPACES))
        if columns < 3 or len(words) != columns * len(rows):
            raise ValueError(f"{len(words)} numbers in {len(rows)} lines")
        table = np.array(words, np.float64).reshape(len(rows), columns)
    except ValueError as error:
        found = f"text that is no cloud ({in_one_line(error, 120)})"
        raise InputError(path, "", found, "lines of x, y and z, and equal columns") from None
    names = next((titles for line in heads if (titles := _names(line, columns))), [])
    unit = _unit(heads, path)
    if not names:
        check_points_first(table, path, "write the names above: number,x,y,z")
        return table[:, :3], unit
    if len(names) != columns or not set("xyz") <= set(names):
        shown = f"the names {', '.join(names)[:80]} of {columns} columns"
        raise InputError(path, "", shown, "names of all columns, among them x, y and z")
    return table[:, [names.index(axis) for axis in "xyz"]], unit


def _is_comment(line: bytes) -> bool:
    """Return whether a line is a comment, the names of the columns or their units; NaN is a number."""
    low = line[:3].lower()
    return line.startswith((b"#", b"/", b"[", b"(")) or (line[:1].isalpha() and not low.startswith((b"nan", b"inf")))


def _names(line: str, columns: int) -> list[str]:
    """Return the names of columns in small letters, without units; none if the line does not name x, y or z.

    In a comment, words between x, y and z make a sentence about the axes.
    """
    text = _BRACKETS.sub("", line).lower()
    comment = text.startswith(("#", "/"))
    text = text.strip("#/ \t")
    if len(words := _words(text)) != columns and comment:
        words = _words(_BEFORE_NAMES.sub("", text))
    names = [match[1] if (match := _NAME.fullmatch(word)) else word for word in words]
    if len(set("xyz") & set(names)) < 2:
        return []
    at = [index for index, name in enumerate(names) if name in "xyz"]
    sentence = comment and len(names) != columns and at[-1] - at[0] >= len(at)
    return [] if sentence else names


def _words(text: str) -> list[str]:
    return re.split(r"[,;\t ]+", text.strip())


def _unit(heads: list[str], path: Path) -> str | None:
    """Return the unit of length, the same of x, y and z, that the lines before the numbers state; None without one."""
    for line in heads:
        below = [word.strip("[]()") for word in _words(line.lower())]
        of_axes = [remark or suffix for remark, suffix in _OF_AXIS.findall(line.lower())]
        stated = below if set(below) <= set(UNITS_MM) else of_axes
        units = {unit_named(word) for word in stated if word in UNITS_MM}
        if len(units) > 1:
            raise InputError(path, "", f"coordinates in {' and '.join(sorted(units))}", "one unit of length")
        if units:
            return units.pop()
    return unit_in(heads)


def _with_points(rows: list[bytes]) -> list[bytes]:
    """Return rows with decimal points and with ``nan`` in empty fields, whatever the separators."""
    sample = rows[:_SAMPLE]
    if _has_decimal_commas(sample):
        rows = [row.replace(b",", b".") for row in rows]
    separators = (b";", b",", b"\t")
    mark = next((one for one in separators if any(one in row for row in rows[:_SAMPLE])), None)
    if mark is None or not any(mark + mark in row or row.startswith(mark) or row.endswith(mark) for row in rows):
        return rows
    count = max(row.rstrip(mark).count(mark) for row in sample)
    filled = ((row.split(mark) + [b""] * count)[: count + 1] for row in rows)
    return [mark.join(field.strip() or b"nan" for field in fields) for fields in filled]


def _has_decimal_commas(rows: list[bytes]) -> bool:
    """Return whether each field between other separators has at most one comma, inside it, and no row has a point."""
    if not any(b"," in row for row in rows) or any(b"." in row for row in rows):
        return False
    fields = [[word for word in re.split(rb"[;\t ]+", row) if word] for row in rows]
    inside = all(re.fullmatch(rb"[^,]+(?:,[^,]+)?", field) for row in fields for field in row)
    return inside and max(map(len, fields)) >= 3
