"""Render the templates of the pages, and join the scripts that a page contains.

Signal chain: content -> markup of a page -> the head of each table -> an attribute ``data-label`` on every cell of its
body, which ``page.css`` writes before the cell where a narrow page has no room for columns: each row becomes a card.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from characterisation.files.atomic_io import write_text
from mitsim.report.first_rows import breakable

_FOLDER = Path(__file__).parent

_TABLE = re.compile(r"<table.*?</table>", re.DOTALL)
_HEAD = re.compile(r"<thead.*?</thead>", re.DOTALL)
_ROW = re.compile(r"<tr.*?</tr>", re.DOTALL)
_HEADING = re.compile(r'<th\b(?:[^>"]|"[^"]*")*>(.*?)</th>', re.DOTALL)
#: in a label, which has no tags, for <wbr>: a browser may break a line there [zero-width space]
_BREAK = "\N{ZERO WIDTH SPACE}"
_CELL = re.compile(r'<(t[hd])\b((?:[^>"]|"[^"]*")*)>')


def rendered(template: str, content: Mapping[str, Any]) -> str:
    """Return a page; the template escapes all names that a user chose, and an undefined name is an error."""
    return with_labels(_environment().get_template(template).render(content))


def write_page(path: Path, template: str, content: Mapping[str, Any]) -> Path:
    """Write a page atomically, and return its path."""
    write_text(path, rendered(template, content))
    return path


def joined_script(names: Sequence[str]) -> str:
    """Return files of this folder as one script, whose names do not meet those of other scripts."""
    parts = [(_FOLDER / name).read_text(encoding="utf-8") for name in names]
    return "(() => {\n'use strict';\n" + "\n".join(parts) + "})();\n"


def script_content(script: str) -> dict[str, str]:
    """Return a script for its template, and the source by which the page's security policy allows it alone."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return {"script": Markup(script), "policy": f"sha256-{digest}"}


@cache
def _environment() -> Environment:
    environment = Environment(loader=FileSystemLoader(_FOLDER), autoescape=True, undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.filters["breakable"] = breakable
    return environment


def with_labels(markup: str) -> str:
    """Return the markup of a page with a label on every cell of its tables.

    A label is the text of the column's head, its small print after a comma. Cells that have a label, cells that head
    their row, and cells over several columns stay as they are.
    """
    return _TABLE.sub(lambda table: _labelled_table(table[0]), markup)


def _labelled_table(table: str) -> str:
    head = _HEAD.search(table)
    if head is None:
        return table
    labels = [_text(heading) for heading in _HEADING.findall(head[0])]
    body = _ROW.sub(lambda row: _labelled_row(row[0], labels), table[head.end() :])
    return table[: head.end()] + body


def _labelled_row(row: str, labels: list[str]) -> str:
    remaining = iter(labels)

    def labelled(cell: re.Match[str]) -> str:
        tag, attributes = cell.groups()
        label = next(remaining, "")
        if tag == "th" or not label or "data-label" in attributes or "colspan" in attributes:
            return cell[0]
        return f'<{tag}{attributes} data-label="{escape(label)}">'

    return _CELL.sub(labelled, row)


def _text(heading: str) -> str:
    words = re.sub(r"<br>", " ", heading).replace("<wbr>", _BREAK).replace("<small>", ", ")
    words = unescape(re.sub(r"<[^>]*>", "", words))
    return " ".join(words.split()).removeprefix(", ")
