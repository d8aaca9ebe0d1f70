"""Read the entities of a STEP file from its text (ISO 10303-21, the "Part 21" file).

Signal chain: text -> comments removed -> records ``#number = ...;`` -> an entity parsed on request.

Only the text is read, without a schema: an entity is a list of its types with their attributes as written. That is
sufficient to follow dimensions and tolerances, and no intermediate library can lose a value.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from characterisation.files.errors import InputError

#: a record: its number and its text
_RECORD = re.compile(r"\s*#(\d+)\s*=\s*", re.ASCII)
_STOP = re.compile(r"'|/\*|;")
_TOKEN = re.compile(
    r"\s*(?:(?P<string>'(?:[^']|'')*')|#(?P<reference>\d+)|\.(?P<enumeration>[A-Za-z0-9_]+)\."
    r"|(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<word>[A-Za-z_!][A-Za-z0-9_]*)"
    r"|\"(?P<binary>[0-9A-Fa-f]*)\"|(?P<mark>[(),$*]))"
)
_DEEPEST = 60  # nesting of brackets


@dataclass(frozen=True)
class Reference:
    """``#number``: another entity of the file."""

    number: int


@dataclass(frozen=True)
class Enumeration:
    """``.NAME.``, without its dots."""

    name: str


@dataclass(frozen=True)
class Typed:
    """``TYPE(...)``: a value of a named type, such as ``LENGTH_MEASURE(0.2)``; also one type of an entity."""

    type: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Entity:
    """An entity: its number and its types with the attributes of each; a simple entity has one type."""

    number: int
    parts: tuple[Typed, ...]

    def has(self, *types: str) -> bool:
        """Return whether the entity is of one of these types."""
        return any(part.type in types for part in self.parts)

    def of(self, *types: str) -> tuple[Any, ...] | None:
        """Return the attributes of the first of these types that the entity has, or None."""
        for wanted in types:
            for part in self.parts:
                if part.type == wanted:
                    return part.values
        return None

    @property
    def types(self) -> str:
        """Return its types, for messages."""
        return " ".join(part.type for part in self.parts)


@dataclass
class StepText:
    """All records of a file; ``record``: number -> text, in the file's order."""

    record: dict[int, str]
    _read: dict[int, Entity] = field(default_factory=dict, repr=False)

    def entity(self, number: int) -> Entity | None:
        """Parse an entity; None if the file has none of this number, or its text is invalid."""
        if number not in self._read:
            text = self.record.get(number)
            parts = None if text is None else _parts(text)
            if parts is None:
                return None
            self._read[number] = Entity(number, parts)
        return self._read[number]

    def follow(self, value: Any) -> Entity | None:
        """Return the entity to which an attribute refers, None for anything else."""
        return self.entity(value.number) if isinstance(value, Reference) else None

    def all(self, *types: str) -> Iterator[Entity]:
        """Yield all entities of one of these types, in the file's order."""
        wanted = re.compile(r"(?<![A-Z0-9_])(?:" + "|".join(types) + r")\s*\(")
        for number, text in self.record.items():
            if wanted.search(text):
                entity = self.entity(number)
                if entity is not None and entity.has(*types):
                    yield entity


def read_step_text(path: str | Path) -> StepText:
    """Read the records of a STEP file; InputError if it is not a Part-21 file."""
    data = Path(path).read_bytes()
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:  # older programs write the letters of their own language, mostly in this encoding
        text = data.decode("latin-1")
    if "ISO-10303-21" not in text[:2000]:
        raise InputError(path, "", "no ISO-10303-21 in its head", "a STEP file (Part 21)")
    records = {}
    for statement in _statements(text):
        match = _RECORD.match(statement)
        if match is not None:
            records[int(match.group(1))] = statement[match.end() :]
    return StepText(records)


def _statements(text: str) -> Iterator[str]:
    """Yield the text before each semicolon outside strings and comments, without comments, in one pass."""
    pieces: list[str] = []
    start, at, ends = 0, 0, {"'": "'", "/*": "*/"}
    while (stop := _STOP.search(text, at)) is not None:
        mark, at = stop.group(), stop.end()
        if mark == ";":
            yield "".join([*pieces, text[start : stop.start()]])
            pieces, start = [], at
            continue
        end = text.find(ends[mark], at) if mark in ends else -1
        if end < 0:  # unterminated: an ordinary character from here on
            ends.pop(mark, None)
            continue
        at = end + len(ends[mark])
        if mark == "/*":
            pieces += [text[start : stop.start()], " "]
            start = at


def _parts(text: str) -> tuple[Typed, ...] | None:
    """Return types and attributes of a record: ``TYPE(...)``, or ``(TYPE(...) TYPE(...))`` for a complex entity."""
    tokens, at = [], 0
    text = text.strip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None or match.end() == at:
            return None
        tokens.append((str(match.lastgroup), match.group(str(match.lastgroup))))
        at = match.end()
    try:
        if tokens[:1] == [("mark", "(")]:
            parts, position = [], 1
            while tokens[position] != ("mark", ")"):
                value, position = _value(tokens, position, 0)
                parts.append(value)
        else:
            value, position = _value(tokens, 0, 0)
            parts = [value]
    except (IndexError, ValueError):
        return None
    return tuple(parts) if all(isinstance(part, Typed) for part in parts) else None


def _value(tokens: list[tuple[str, str]], at: int, depth: int) -> tuple[Any, int]:
    """Parse one value; also return the position of the next."""
    if depth > _DEEPEST:
        raise ValueError("brackets nested too deeply")
    kind, text = tokens[at]
    if kind == "string":
        return decoded(text[1:-1]), at + 1
    if kind == "reference":
        return Reference(int(text)), at + 1
    if kind == "enumeration":
        return Enumeration(text), at + 1
    if kind == "number":
        return float(text), at + 1
    if kind == "word":
        values, after = _value(tokens, at + 1, depth + 1)
        if not isinstance(values, tuple):
            raise ValueError("a type without brackets")
        return Typed(text.upper(), values), after
    if text == "(":
        values, at = [], at + 1
        while tokens[at] != ("mark", ")"):
            value, at = _value(tokens, at, depth + 1)
            values.append(value)
            if tokens[at] == ("mark", ","):
                at += 1
        return tuple(values), at + 1
    if kind == "mark" and text in "$*":
        return None, at + 1
    raise ValueError(f"{text!r} where a value should be")


def decoded(text: str) -> str:
    r"""Resolve the escapes of a string: '' \X2\...\X0\ \X4\...\X0\ \X\hh \Pa\ \S\c (ISO 10303-21, 6.4.3).

    \Pa\ selects the part of ISO 8859 for \S\, A the first.
    """
    text = text.replace("''", "'")
    if "\\" not in text:
        return text

    def wide(match: re.Match[str]) -> str:
        data = bytes.fromhex(match.group(2)) if len(match.group(2)) % 2 == 0 else b""
        return data.decode("utf-16-be" if match.group(1) == "2" else "utf-32-be", "replace")

    text = re.sub(r"\\X([24])\\([0-9A-Fa-f]*)\\X0\\", wide, text)
    text = re.sub(r"\\X\\([0-9A-Fa-f]{2})", lambda match: chr(int(match.group(1), 16)), text)
    page = 1

    def shifted(match: re.Match[str]) -> str:
        nonlocal page
        if match.group(1):
            page = ord(match.group(1)) - ord("A") + 1
            return ""
        return bytes([ord(match.group(2)) | 0x80]).decode(f"iso8859-{page}", "replace")

    text = re.sub(r"\\P([A-I])\\|\\S\\([\x20-\x7e])", shifted, text)
    return text.replace("\\\\", "\\")
