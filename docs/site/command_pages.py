"""The reference of the command line as Markdown, made from the commands themselves."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from typing import Any

import typer

from mitsim.cli.program import app


def command_reference() -> str:
    """Return a section for each command, in the order of ``mitsim --help``; a group's commands follow it."""
    return "\n\n".join(section(words, command) for words, command in commands_of(typer.main.get_command(app), "mitsim"))


def commands_of(command: Any, words: str) -> Iterator[tuple[str, Any]]:
    """Yield a command and all commands below it, each with its words: ``mitsim export cloud``."""
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield from commands_of(below, f"{words} {name}")


def section(words: str, command: Any) -> str:
    """Return the section of one command: usage, what it does, its arguments and options."""
    context = command.make_context(words, [], resilient_parsing=True)
    usage = " ".join([words, *command.collect_usage_pieces(context)])
    parts = [f"{'#' * (len(words.split()) if words != 'mitsim' else 2)} `{words}`", f"```text\n{usage}\n```"]
    if command.help:
        parts.append(prose(command.help))
    rows = [one.get_help_record(context) for one in command.get_params(context) if not getattr(one, "hidden", False)]
    listed = [(name, told) for name, told in filter(None, rows) if not name.startswith("--help")]
    if listed:
        lines = [f"| {code_cell(name)} | {cell(told)} |" for name, told in listed]
        parts.append("\n".join(["| argument or option | meaning |", "|---|---|", *lines]))
    below = [name for name, one in getattr(command, "commands", {}).items() if not one.hidden]
    if below:
        links = (f"[`{name}`](#{slug(f'{words} {name}')})" for name in below)
        parts.append(f"Commands: {', '.join(links)}")
    return "\n\n".join(parts)


def prose(text: str) -> str:
    """Return a help text as paragraphs of Markdown."""
    paragraphs = re.split(r"\n\s*\n", text.replace("\b", "").strip())
    return "\n\n".join(paragraph(" ".join(one.split())) for one in paragraphs)


def paragraph(text: str) -> str:
    """Return one paragraph; the command of an example stands in a block of code."""
    mark, _, example = text.partition("Example: ")
    return f"```sh\n{example}\n```" if example and not mark else escaped(text)


def escaped(text: str) -> str:
    """Return a text with the characters that Markdown and HTML would take for their own escaped."""
    return re.sub(r"([\\`*_\[\]|])", r"\\\1", html.escape(text, quote=False))


def cell(text: str) -> str:
    """Return a text as the content of a cell of a table; a default and a range stand in code."""
    told, mark, extra = text.partition("  [")
    return escaped(" ".join(told.split())) + (f" {code_cell(mark.strip() + extra)}" if mark else "")


def code_cell(text: str) -> str:
    """Return a text as code in a cell of a table."""
    return "<code>" + html.escape(" ".join(text.split())).replace("|", "&#124;") + "</code>"


def slug(words: str) -> str:
    """Return the anchor of a command's section."""
    return words.replace(" ", "-")
