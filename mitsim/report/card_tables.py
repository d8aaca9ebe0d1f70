"""Label the cells of tables by their columns, so that a narrow page shows each row as a card.

Signal chain: markup of a page -> the head of each table -> an attribute ``data-label`` on every cell of its body, which
``page.css`` writes before the cell where the page has no room for columns.
"""

from __future__ import annotations

import re
from html import unescape

from markupsafe import escape

_TABLE = re.compile(r"<table.*?</table>", re.DOTALL)
_HEAD = re.compile(r"<thead.*?</thead>", re.DOTALL)
_ROW = re.compile(r"<tr.*?</tr>", re.DOTALL)
_HEADING = re.compile(r'<th\b(?:[^>"]|"[^"]*")*>(.*?)</th>', re.DOTALL)
_CELL = re.compile(r'<(t[hd])\b((?:[^>"]|"[^"]*")*)>')


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
    """Return the words of a head."""
    words = re.sub(r"<br>", " ", heading).replace("<small>", ", ")
    words = unescape(re.sub(r"<[^>]*>", "", words))
    return " ".join(words.split()).removeprefix(", ")
