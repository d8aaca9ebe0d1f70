"""Read a TOML file as a table, within bounds of size, nesting and numbers."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from characterisation.files.checked_files import is_file, read_text_bounded
from characterisation.files.errors import InputError, in_one_line, nearest

#: largest TOML file [bytes]; chosen
LARGEST_TOML = 4 * 1024**2

#: deepest nesting of a TOML file
DEEPEST = 32

_BRACKETS = re.compile(r"[][{}]")

_PART = r"(?<![A-Za-z0-9_-])(?:[A-Za-z0-9_-]++|[\"'][^\"'\n]*+[\"'])[ \t]*+\.[ \t]*+"

_LONG_KEY = re.compile(f"(?:{_PART}){{{DEEPEST}}}")

#: a value such as ``0,3``
_DECIMAL_COMMA = re.compile(r"=\s*[+-]?\d+,\d")


def read_toml_table(path: str | Path) -> dict[str, Any]:
    """Read one TOML file as a table, of which nesting and numbers are checked; InputError if missing or not TOML."""
    path = Path(path)
    near = "" if is_file(path) else _neighbours(path)
    text = read_text_bounded(path, "a TOML file", near, LARGEST_TOML).replace("\r\n", "\n")
    _check_nesting(path, text)
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a whole number of thousands of digits
        cause = in_one_line(error)
        line = _line_named(text, cause)
        found = f"text that is not TOML ({cause}{f': {line[:100]}' if line else ''})"
        hint = "a decimal number has a point, not a comma" if _DECIMAL_COMMA.search(line) else ""
        raise InputError(path, "", found, "TOML, see https://toml.io", hint) from None
    _check_numbers(path, table)
    return table


def _line_named(text: str, cause: str) -> str:
    """Return the line of a text that a message of the parser names, or an empty text."""
    number = re.search(r"\bline (\d+)", cause)
    lines = text.split("\n")
    return lines[int(number[1]) - 1].strip() if number and int(number[1]) <= len(lines) else ""


def _check_nesting(path: Path, text: str) -> None:
    """Reject text whose nesting would occupy the parser for minutes; brackets inside strings count too."""
    if _LONG_KEY.search(text):
        raise InputError(path, "", f"a key of over {DEEPEST} parts", f"keys of up to {DEEPEST} parts")
    depth = 0
    for mark in _BRACKETS.findall(text):
        depth = depth + 1 if mark in "[{" else max(depth - 1, 0)
        if depth > DEEPEST:
            raise InputError(path, "", f"tables or arrays nested over {DEEPEST} deep", "less nesting")


def _check_numbers(path: Path, table: Any, field: str = "") -> None:
    """Reject integers outside 64 bits."""
    entries = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    for key, value in entries:
        location = f"{field}.{key}" if field else str(key)
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            digits = value.bit_length() * 3 // 10
            raise InputError(path, location, f"a whole number of {digits} digits", "-2^63 to 2^63 - 1")
        if isinstance(value, (dict, list)):
            _check_numbers(path, value, location)


def _neighbours(path: Path) -> str:
    """List existing files of the same type beside a missing one."""
    try:
        if not path.parent.is_dir():
            return f"the folder {path.parent} does not exist either"
        there = sorted(p.name for p in path.parent.iterdir() if p.suffix == path.suffix)
    except (OSError, ValueError):
        return ""
    return (nearest(path.name, there) or f"there are: {', '.join(there[:6])}") if there else ""
