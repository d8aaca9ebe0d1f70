"""Render the templates of the pages, and join the scripts that a page contains."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from characterisation.files.atomic_io import write_text
from mitsim.report.card_tables import with_labels
from mitsim.report.first_rows import breakable

_FOLDER = Path(__file__).parent


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
    environment = Environment(
        loader=FileSystemLoader(_FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = breakable
    return environment
