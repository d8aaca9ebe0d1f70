"""The reference of the programming interface as Markdown: the names of ``docs/reference/interface.md``, in its order.

That page says what is promised; only these names and members get an entry. The text of an entry comes from the
docstring, through mkdocstrings.
"""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "reference" / "interface.md"

#: the paragraph before a table of names, and the table's rows
TABLE = re.compile(r"^(?:([^|\n][^\n]*)\n\n)?\| name \|[^\n]*\n\|[-|]+\n((?:\|[^\n]*\n?)+)", re.MULTILINE)

#: how the page writes a package before a name
SHORT = {"mitsim": "ms", "characterisation": "characterisation"}


def name_reference(package: str) -> str:
    """Return the entries of a package's public names, as directives of mkdocstrings under headings."""
    blocks = []
    for heading, rows in tables(package):
        blocks.append(f"## {heading}")
        promised = members(rows)
        for cell, _ in rows:
            name = bare(cell).removeprefix(f"{SHORT[package]}.")
            blocks.append(directive(f"{package}.{name}", promised[name] if heading == "Types" else []))
    return "\n\n".join(blocks)


def tables(package: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the tables of a package on the page: heading, and the first two cells of each row."""
    text = PAGE.read_text(encoding="utf-8").split(f"\n## `{package}`\n")[1].split("\n## ")[0]
    found = []
    for before, table in TABLE.findall(text):
        rows = [(first, rest) for first, rest in re.findall(r"^\| `([^`]+)` \| (.*) \|$", table, re.M)]
        types = bare(rows[0][0]).rpartition(".")[2][0].isupper()
        found.append(("Types" if types else before.rstrip(":") if before.endswith(":") else "Functions", rows))
    return found


def members(rows: list[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the promised members of each type: those that its row names, methods with brackets."""
    name = r"`([a-z]\w*|[A-Z_]{2,})(?:\([^`]*\))?`"
    return {bare(cell).rpartition(".")[2]: re.findall(name, told) for cell, told in rows}


def directive(path: str, promised: list[str]) -> str:
    """Return the directive of one name."""
    if not promised:
        return f"::: {path}"
    return f"::: {path}\n    options:\n      members: [{', '.join(promised)}]"


def bare(cell: str) -> str:
    """Return the dotted name at the start of a cell."""
    return re.split(r"[(: ]", cell)[0]
