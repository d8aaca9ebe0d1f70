"""Roles of reStructuredText in docstrings, as Markdown: ``:func:`render``` becomes a link or plain code."""

from __future__ import annotations

import re
from typing import Any

import griffe

import characterisation
import mitsim

ROLE = re.compile(r":(?:func|class|meth|data|mod|attr|exc):`~?([^`]+)`")


class Roles(griffe.Extension):
    """Rewrite the docstring of every object that is loaded."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = ROLE.sub(linked, obj.docstring.value)


def linked(found: re.Match[str]) -> str:
    """Return a link to a public name, or code for any other name."""
    name = found.group(1)
    for package in (mitsim, characterisation):
        last = name.removeprefix(f"{package.__name__}.")
        if last.partition(".")[0] in package.__all__:
            return f"[`{name}`][{package.__name__}.{last}]"
    return f"`{name}`"
