"""Read YAML into maps, lists, numbers and text, within bounds.

The parser is PyYAML's. The values are built from its events, so that nesting, the number of values and the copies that
aliases make are bounded before they take memory. Numbers, true, false and null are those of the core schema of YAML
1.2 (section 10.3.2): ``1e-05`` is a number, ``on`` and ``12:30`` are text. OpenCV's dialect is read, too: its first
line ``%YAML:1.0``, and its matrices. Tags of other programs are ignored: a Python tuple is a list.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from characterisation.files.errors import InputError, in_one_line

#: deepest nesting of values, far under the depth of Python's recursion; chosen
DEEPEST = 64

#: largest number of values in all documents together, which bounds memory and time; chosen
MOST_VALUES = 2_000_000

_FIRST_LINE = re.compile(r"^%.*$", re.MULTILINE)
_WHOLE = re.compile(r"[-+]?[0-9]{1,18}")
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"([-+]?)\.inf", re.IGNORECASE)
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotYamlError(InputError):
    """Text that the parser refuses."""


def read_yaml(file: Path, data: bytes, allowed: str) -> list[dict[str, Any]]:
    """Return the documents of a YAML file that are maps, with their matrices as arrays.

    ``file``: path of the file, for messages. ``data``: content of the file. ``allowed``: what the file should be, for
    the message. Raises InputError if the text is not YAML, exceeds the bounds, has a key twice, or has no map.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # comments in another encoding
    text = _FIRST_LINE.sub("#", text)
    try:
        documents = _documents(file, text, allowed)
    except (yaml.YAMLError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        mark = getattr(error, "problem_mark", None)
        problem = in_one_line(getattr(error, "problem", None) or error)
        line = "" if mark is None else f" in line {mark.line + 1}"
        raise NotYamlError(file, "", f"text that is not YAML ({problem}{line})", allowed) from None
    maps = [document for document in documents if isinstance(document, dict) and document]
    if not maps:
        # a matrix has no truth value
        there = any(isinstance(document, np.ndarray) or document for document in documents)
        raise InputError(file, "", "text without names" if there else "nothing in it", allowed)
    return maps


def _documents(file: Path, text: str, allowed: str) -> list[Any]:
    """Build the documents from the parser's events."""
    documents: list[Any] = []
    open_nodes: list[_Node] = []
    anchors: dict[str, tuple[Any, int]] = {}
    total = 0

    def put(value: Any, count: int) -> None:
        nonlocal total
        if not open_nodes:
            documents.append(value)
            total += count
        else:
            open_nodes[-1].add(value, count)
        if total + sum(node.count for node in open_nodes) > MOST_VALUES:
            raise InputError(file, "", f"over {MOST_VALUES:,} values", f"up to {MOST_VALUES:,}")

    for event in yaml.parse(text, Loader=_LOADER):
        match event:
            case yaml.ScalarEvent():
                is_key = bool(open_nodes) and open_nodes[-1].expects_key
                is_number = (event.tag or "").endswith((":float", ":int"))
                is_text = is_key or (bool(event.style or event.tag) and not is_number)
                value = event.value if is_text else _scalar(event.value)
                if event.anchor:
                    anchors[event.anchor] = (value, 1)
                put(value, 1)
            case yaml.DocumentStartEvent():
                anchors.clear()
            case yaml.AliasEvent():
                if event.anchor not in anchors:  # unknown, or an alias inside its own value
                    raise InputError(file, "", f"an alias of an unknown value: *{event.anchor}", allowed)
                put(*anchors[event.anchor])
            case yaml.MappingStartEvent() | yaml.SequenceStartEvent():
                if len(open_nodes) >= DEEPEST:
                    raise InputError(file, "", f"values nested over {DEEPEST} deep", allowed)
                is_map = isinstance(event, yaml.MappingStartEvent)
                open_nodes.append(_Node(file, is_map, event.anchor, event.start_mark.line + 1))
            case yaml.MappingEndEvent() | yaml.SequenceEndEvent():
                node = open_nodes.pop()
                value = node.value()
                if node.anchor:
                    anchors[node.anchor] = (value, node.count)
                put(value, node.count)
    return documents


class _Node:
    """A map or list whose end has not been read; ``count`` of the values in it, those of aliases included."""

    def __init__(self, file: Path, is_map: bool, anchor: str | None, line: int) -> None:
        self.file, self.is_map, self.anchor, self.line = file, is_map, anchor, line
        self.items: list[Any] = []
        self.count = 1

    @property
    def expects_key(self) -> bool:
        """Return whether the next value is a key of a map."""
        return self.is_map and len(self.items) % 2 == 0

    def add(self, value: Any, count: int) -> None:
        self.items.append(value)
        self.count += count

    def value(self) -> Any:
        """Return the list, the map, or the array that a map describes."""
        if not self.is_map:
            return self.items
        out: dict[str, Any] = {}
        for key, value in zip(self.items[::2], self.items[1::2], strict=True):
            name = key if isinstance(key, str) else str(key)
            if name in out:
                raise InputError(self.file, name, f"the key twice in the map of line {self.line}", "each key once")
            out[name] = value
        if isinstance(out.get("<<"), dict):  # a merge key: its map's keys come after those of this map
            out = {**out.pop("<<"), **out}
        return matrix_of(out) if {"rows", "cols", "data"} <= set(out) else out


def matrix_of(table: dict[str, Any]) -> Any:
    """Return the array of a map with ``rows``, ``cols`` and ``data``, as OpenCV and ROS write matrices.

    OpenCV's ``dt`` may have several channels: ``2d`` has a last axis of two. Without as many numbers as the size says
    the result is a text that says so, which no reader takes for numbers.
    """
    try:
        channels = int(re.sub(r"\D", "", str(table.get("dt", ""))) or 1)
        shape = int(table["rows"]), int(table["cols"]), *([channels] if channels > 1 else [])
        numbers = np.asarray(table["data"], np.float32 if str(table.get("dt", "")).endswith("f") else float)
        return numbers.astype(float).reshape(shape)
    except (ValueError, TypeError, OverflowError):
        return "a matrix that cannot be read"


def _scalar(text: str) -> Any:
    if _WHOLE.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        return float(text)
    infinite = _INFINITE.fullmatch(text)
    if infinite:
        return float(f"{infinite[1]}inf")
    if text.lower() == ".nan":
        return float("nan")
    return _WORDS.get(text.lower(), text)
