"""Read PLY files of other programs: the points of the element ``vertex``, and the grid if the file states one.

Signal chain: header -> elements and their properties -> x, y, z of every vertex -> rows and columns, if stated.

PLY has no grid of its own. Two kinds of file state one. Range grids of Stanford's scans have ``obj_info num_cols`` and
``num_rows``, and lists ``range_grid`` for the filled pixels. PCL has ``viewportx`` and ``viewporty`` of an element
``camera``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.capture.recordings.cloud_numbers import number_words, unit_in

#: NumPy's types by PLY's names, an old and a new one of each
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

#: largest number of lists of an element that are read
_MOST_LISTS = 20_000_000


@dataclass(frozen=True)
class Ply:
    """``points`` (n, 3) float32 as in the file, and the ``lines`` of its header.

    ``size`` (width, height) of the grid and ``unit`` of length are None if the file does not state them.

    Points are in row order, missing ones as NaN or zeros. Points of a range grid, which omits missing ones, have been
    put on their pixels.
    """

    points: NDArray[np.float32]
    size: tuple[int, int] | None
    lines: tuple[str, ...]
    unit: str | None = None


@dataclass(frozen=True)
class _Property:
    """A number, or a list of them if ``count`` is the type of its length; types are NumPy's."""

    name: str
    kind: str
    count: str = ""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def add(self, name: str, kind: str, count: str = "") -> None:
        """Add a property; a name that is there gets a number."""
        taken = {entry.name for entry in self.properties}
        name = name.lower() if name in "XYZ" else name
        self.properties.append(_Property(name if name not in taken else f"{name} {len(taken)}", kind, count))


def decode_ply(data: bytes, where: str | Path) -> Ply:
    """Return points and grid from the bytes of a PLY file, whose vertices must have x, y and z."""
    mark = re.search(rb"\nend_header[ \t]*\r?\n", data[:100_000])
    if not re.match(rb"ply[ \t]*\r?\n", data) or mark is None:
        raise InputError(where, "", "a file without the header of a PLY", "a PLY file")
    lines = tuple(line.strip() for line in data[: mark.start()].decode("ascii", "replace").splitlines())
    order, elements = _elements(lines, where)
    try:
        tables = _tables(data[mark.end() :], order, elements)
    except (ValueError, OverflowError) as error:
        raise InputError(where, "", f"data that do not fit the header ({error})", "a complete PLY") from None
    vertices = tables.get("vertex")
    if not isinstance(vertices, dict) or not set("xyz") <= set(vertices):
        raise InputError(where, "element vertex", ", ".join(tables) or "nothing", "vertices with x, y and z")
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float32)
    size, camera = _stated_size(lines), tables.get("camera")
    if size is None and isinstance(camera, dict) and {"viewportx", "viewporty"} <= set(camera):
        sides = [camera[key] for key in ("viewportx", "viewporty")]
        if all(len(side) == 1 and 0 < side[0] < 1e6 for side in sides):
            size = int(sides[0][0]), int(sides[1][0])
    grid = tables.get("range_grid")
    if size is not None and isinstance(grid, list):
        points = _placed(points, grid, size, where)
    return Ply(points, size, lines, unit_in(line for line in lines if line.startswith(("comment", "obj_info"))))


def _elements(lines: tuple[str, ...], where: str | Path) -> tuple[str, list[_Element]]:
    order: str | None = None
    elements: list[_Element] = []
    for line in lines[1:]:
        match line.split():
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 9:
                elements.append(_Element(name, int(count)))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].add(name, _TYPES[kind])
            case ["property", "list", count, kind, name] if count in _TYPES and kind in _TYPES and elements:
                if _TYPES[count][0] == "f":
                    raise InputError(where, f"element {elements[-1].name}", line, "a whole number of items")
                elements[-1].add(name, _TYPES[kind], _TYPES[count])
            case ["comment" | "obj_info", *_] | []:
                continue
            case _:
                raise InputError(where, "", f"the line {line[:60]!r}", "the header of a PLY 1.0")
    if order is None:
        raise InputError(where, "format", "nothing", " | ".join(_ORDERS))
    return order, elements


#: elements that are used
_USEFUL = ("vertex", "range_grid", "camera")

#: largest text [bytes]; reading takes ten times as much memory
_LARGEST_TEXT = 96 * 1024**2

Table = dict[str, NDArray[np.generic]] | list[list[float]]


def _tables(body: bytes, order: str, elements: list[_Element]) -> dict[str, Table]:
    """Read every element up to the last useful one: lists after it, such as faces, are skipped.

    An element with lists gives those of its first; vertices always give their numbers.
    """
    if order == "" and len(body) > _LARGEST_TEXT:
        raise ValueError(f"{len(body):,} bytes of text, at most {_LARGEST_TEXT:,}: save it as binary PLY")
    words = number_words(body) if order == "" else []
    last = max((number for number, entry in enumerate(elements) if entry.name in _USEFUL), default=-1)
    out: dict[str, Table] = {}
    at = 0
    for element in elements[: last + 1]:
        if any(entry.count for entry in element.properties):
            if element.count > _MOST_LISTS:
                raise ValueError(f"{element.count} lists")
            numbers, rows, at = _rows(body, words, at, order, element)
            out[element.name] = numbers if element.name == "vertex" else rows
        elif order == "":
            columns = len(element.properties)
            size = columns * element.count
            part = words[at : at + size]
            if len(part) < size:
                raise ValueError(f"{len(part)} numbers of {element.name}, {size} expected")
            table = np.array(part, np.float64).reshape(element.count, columns)
            out[element.name] = {entry.name: table[:, column] for column, entry in enumerate(element.properties)}
            at += size
        else:
            dtype = np.dtype([(entry.name, order + entry.kind) for entry in element.properties])
            size = dtype.itemsize * element.count
            if len(body) - at < size:
                raise ValueError(f"{len(body) - at} bytes of {element.name}, {size} expected")
            packed = np.frombuffer(body, dtype, element.count, at)
            out[element.name] = {entry.name: packed[entry.name] for entry in element.properties}
            at += size
    return out


def _rows(
    body: bytes, words: list[str], at: int, order: str, element: _Element
) -> tuple[dict[str, NDArray[np.generic]], list[list[float]], int]:
    """Read an element with lists: its numbers by name, the items of its first list, and the position after it."""
    plain = [entry for entry in element.properties if not entry.count]
    first = next(entry for entry in element.properties if entry.count)
    numbers: dict[str, list[float]] = {entry.name: [] for entry in plain}
    rows: list[list[float]] = []

    def items(kind: str, length: int) -> list[float]:
        nonlocal at
        if not order:
            row = [float(word) for word in words[at : at + length]]
            at += length
        else:
            dtype = np.dtype(order + kind)
            whole = length * dtype.itemsize <= len(body) - at
            row = np.frombuffer(body, dtype, length, at).astype(float).tolist() if whole else []
            at += length * dtype.itemsize
        if len(row) != length:
            raise ValueError(f"lists of {element.name} that end too early")
        return row

    for _ in range(element.count):
        for entry in element.properties:
            if not entry.count:
                numbers[entry.name] += items(entry.kind, 1)
                continue
            length = items(entry.count, 1)[0]
            if not (length.is_integer() and 0 <= length <= len(body)):
                raise ValueError(f"a list of {length:g} in {element.name}")
            row = items(entry.kind, int(length))
            if entry is first:
                rows.append(row)
    return {name: np.array(values) for name, values in numbers.items()}, rows, at


def _stated_size(lines: tuple[str, ...]) -> tuple[int, int] | None:
    wanted = re.compile(r"(?:obj_info|comment)\s+(num_cols|num_rows|width|height)\s*[:= ]\s*(\d{1,6})")
    stated = {match[1]: int(match[2]) for line in lines if (match := wanted.fullmatch(line))}
    for wide, high in (("num_cols", "num_rows"), ("width", "height")):
        if stated.get(wide, 0) > 0 and stated.get(high, 0) > 0:
            return stated[wide], stated[high]
    return None


def _placed(
    points: NDArray[np.float32], grid: list[list[float]], size: tuple[int, int], where: str | Path
) -> NDArray[np.float32]:
    """Return the points (width * height, 3) of a range grid; each pixel has an empty list or the number of a vertex."""
    if len(grid) != size[0] * size[1]:
        raise InputError(where, "element range_grid", len(grid), f"{size[0] * size[1]}, num_cols times num_rows")
    filled = np.array([index for index, row in enumerate(grid) if row], np.intp)
    numbers = np.array([row[0] for row in grid if row], float)
    if len(numbers) and not (numbers.min() >= 0 and numbers.max() < len(points)):
        raise InputError(where, "element range_grid", "a vertex number out of range", f"0 to {len(points) - 1}")
    out = np.full((size[0] * size[1], 3), np.nan, np.float32)
    out[filled] = points[numbers.astype(np.intp)]
    return out
