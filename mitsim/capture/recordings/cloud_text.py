"""Read the points of a text: lines of x, y and z with any separators, a decimal point or comma, and names of columns.

Signal chain: bytes -> text -> comments and names of columns -> separators and decimal mark -> numbers -> x, y, z.

Names of columns, in a line before the numbers or a comment, tell which columns are x, y and z; without names they are
the first three. A comma is the decimal mark if other separators stand between the numbers and no number has a point:
programs write so in countries with a decimal comma. An empty field is a missing number.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.capture.recordings.number_text import number_words

#: largest text [bytes]; reading takes ten times as much memory
_LARGEST = 256 * 1024**2

_SPACES = bytes.maketrans(b",;\t", b"   ")
_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}

#: a name of a column: x, y or z, which a word may precede, and a unit may follow
_NAME = re.compile(r"(?:points?|pos(?:ition)?|coord(?:inate)?)?[_.:]?([xyz])(?:_?(?:mm|m|cm|um))?")

#: lines from which separators and decimal mark are found
_SAMPLE = 200


def points_of_text(data: bytes, path: Path) -> NDArray[np.float64]:
    """Return the points (n, 3) of a text.

    Parameters
    ----------
    data
        Content of the file.
    path
        The file, for messages.

    Raises
    ------
    InputError
        If the lines are not equally many numbers, three or more, or their names lack x, y or z.
    """
    if len(data) > _LARGEST:
        raise InputError(path, "", f"{len(data):,} bytes of text", f"at most {_LARGEST:,}", "save it as PLY")
    encoding = next((one for mark, one in _MARKS.items() if data.startswith(mark)), None)
    if encoding is not None:
        data = data.decode(encoding, "replace").encode("ascii", "replace")
    lines = [line.strip(b" \r\n") for line in data.replace(b'"', b"").splitlines()]
    rows = [line for line in lines if line.strip() and not _is_comment(line)]
    names = next((found for line in lines[:100] if _is_comment(line) and (found := _names(line))), [])
    try:
        if rows and len(number_words(rows[0].translate(_SPACES))) == 1:  # the number of points
            rows = rows[1:]
        rows = _with_points(rows)
        columns = len(number_words(rows[0].translate(_SPACES))) if rows else 0
        words = number_words(b"\n".join(rows).translate(_SPACES))
        if columns < 3 or len(words) != columns * len(rows):
            raise ValueError(f"{len(words)} numbers in {len(rows)} lines")
        table = np.array(words, np.float64).reshape(len(rows), columns)
    except ValueError as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            path, "", f"text that is no cloud ({reason})", "lines of x, y and z, and equal columns"
        ) from None
    if not names:
        return table[:, :3]
    if len(names) != columns or not set("xyz") <= set(names):
        shown = f"the names {', '.join(names)[:80]} of {columns} columns"
        raise InputError(path, "", shown, "names of all columns, among them x, y and z")
    return table[:, [names.index(axis) for axis in "xyz"]]


def _is_comment(line: bytes) -> bool:
    """Return whether a line is a comment or the names of the columns; NaN is a number."""
    return line.startswith((b"#", b"/")) or (line[:1].isalpha() and not line[:3].lower().startswith((b"nan", b"inf")))


def _names(line: bytes) -> list[str]:
    """Return the names of columns in small letters, without units; none if the line does not name x, y or z."""
    without_units = re.sub(r"[\[(][^\])]*[\])]", "", line.decode("ascii", "replace"))
    words = re.split(r"[,;\t ]+", without_units.strip("#/ \t").lower())
    names = [found[1] if (found := _NAME.fullmatch(each)) else each for each in words]
    return names if len(set("xyz") & set(names)) >= 2 else []


def _with_points(rows: list[bytes]) -> list[bytes]:
    """Return rows with decimal points and with ``nan`` in empty fields, whatever the separators."""
    sample = rows[:_SAMPLE]
    if _has_decimal_commas(sample):
        rows = [row.replace(b",", b".") for row in rows]
    mark = next((each for each in (b";", b",", b"\t") if any(each in row for row in rows[:_SAMPLE])), None)
    if mark is None or not any(mark + mark in row or row.startswith(mark) or row.endswith(mark) for row in rows):
        return rows
    count = max(row.rstrip(mark).count(mark) for row in sample)
    return [mark.join(one.strip() or b"nan" for one in (row.split(mark) + [b""] * count)[: count + 1]) for row in rows]


def _has_decimal_commas(rows: list[bytes]) -> bool:
    """Return whether each field between other separators has at most one comma, inside it, and no row has a point."""
    if not any(b"," in row for row in rows) or any(b"." in row for row in rows):
        return False
    fields = [[one for one in re.split(rb"[;\t ]+", row) if one] for row in rows]
    inside = all(re.fullmatch(rb"[^,]+(?:,[^,]+)?", one) for each in fields for one in each)
    return inside and max(map(len, fields)) >= 3
