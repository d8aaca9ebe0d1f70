"""Read PLY files of other programs: the points of the element ``vertex``, and the grid if the file states one.

Signal chain: header -> elements and their properties -> x, y, z of every vertex -> rows and columns, if stated.

PLY has no grid of its own. Two kinds of file state one. Range grids of Stanford's scans have ``obj_info num_cols`` and
``num_rows``, and lists ``range_grid`` for the filled places. PCL has ``viewportx`` and ``viewporty`` of an element
``camera``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

#: largest number of lists of an element that are read
_MOST_LISTS = 20_000_000


@dataclass(frozen=True)
class Ply:
    """``points`` (n, 3) float32 as in the file; ``size`` (width, height) of the grid if stated; header ``lines``.

    Points are in row order, missing ones as NaN or zeros. Points of a range grid, which omits missing ones, have been
    put in their places.
    """

    points: NDArray[np.float32]
    size: tuple[int, int] | None
    lines: tuple[str, ...]


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    lists: bool


def decode_ply(data: bytes, where: str | Path) -> Ply:
    """Return points and grid from a PLY file's bytes.

    Raises
    ------
    InputError
        If the bytes are not a complete PLY whose vertices have x, y and z.
    """
    mark = re.search(rb"\nend_header[ \t]*\r?\n", data[:100_000])
    if not re.match(rb"ply\r?\n", data) or mark is None:
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
    return Ply(points, size, lines)


def _elements(lines: tuple[str, ...], where: str | Path) -> tuple[str, list[_Element]]:
    order: str | None = None
    found: list[_Element] = []
    for line in lines[1:]:
        words = line.split()
        match words:
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 9:
                found.append(_Element(name, int(count), (), False))
            case ["property", kind, name] if kind in _TYPES and found and name not in dict(found[-1].properties):
                last = found[-1]
                found[-1] = _Element(last.name, last.count, (*last.properties, (name, _TYPES[kind])), last.lists)
            case ["property", "list", count, kind, _] if count in _TYPES and kind in _TYPES and found:
                last = found[-1]
                pair = (("count", _TYPES[count]), ("item", _TYPES[kind]))
                if last.properties or _TYPES[count][0] == "f":
                    raise InputError(where, f"element {last.name}", line, "one list alone, or numbers")
                found[-1] = _Element(last.name, last.count, pair, True)
            case ["comment" | "obj_info", *_] | []:
                continue
            case _:
                raise InputError(where, "", f"the line {line[:60]!r}", "the header of a PLY 1.0")
    if order is None:
        raise InputError(where, "format", "nothing", " | ".join(_ORDERS))
    if any(element.lists and len(element.properties) != 2 for element in found):
        raise InputError(where, "property list", "beside other properties", "one list alone, or numbers")
    return order, found


#: largest text [bytes]; reading takes ten times as much memory
_LARGEST_TEXT = 96 * 1024**2

Table = dict[str, NDArray[np.generic]] | list[list[float]]


def _tables(body: bytes, order: str, elements: list[_Element]) -> dict[str, Table]:
    """Read every element up to the last useful one; lists after the vertices, such as faces, are skipped."""
    if order == "" and len(body) > _LARGEST_TEXT:
        raise ValueError(f"{len(body):,} bytes of text, at most {_LARGEST_TEXT:,}: save it as binary PLY")
    words = body.decode("ascii").split() if order == "" else []
    out: dict[str, Table] = {}
    at = 0
    for element in elements:
        if element.lists and "vertex" in out and element.name != "range_grid":
            break
        if element.lists:
            if element.count > _MOST_LISTS:
                raise ValueError(f"{element.count} lists")
            rows, at = _lists(body, words, at, order, element)
            out[element.name] = rows
        elif order == "":
            columns = len(element.properties)
            part = words[at : at + columns * element.count]
            if len(part) < columns * element.count:
                raise ValueError(f"{len(part)} numbers of {element.name}, {columns * element.count} expected")
            numbers = np.array(part, np.float64).reshape(element.count, columns)
            out[element.name] = {name: numbers[:, column] for column, (name, _) in enumerate(element.properties)}
            at += columns * element.count
        else:
            dtype = np.dtype([(name, order + kind) for name, kind in element.properties])
            if len(body) - at < dtype.itemsize * element.count:
                raise ValueError(f"{len(body) - at} bytes of {element.name}, {dtype.itemsize * element.count} expected")
            table = np.frombuffer(body, dtype, element.count, at)
            out[element.name] = {name: table[name] for name, _ in element.properties}
            at += dtype.itemsize * element.count
    return out


def _lists(body: bytes, words: list[str], at: int, order: str, element: _Element) -> tuple[list[list[float]], int]:
    rows: list[list[float]] = []
    count_type, item_type = (np.dtype(order + kind) if order else None for _, kind in element.properties)
    for _ in range(element.count):
        if count_type is None or item_type is None:
            if at >= len(words):
                raise ValueError(f"lists of {element.name} that end too early")
            length = int(words[at])
            row = [float(word) for word in words[at + 1 : at + 1 + length]] if length > 0 else []
            at += 1 + length
        else:
            if at + count_type.itemsize > len(body):
                raise ValueError(f"lists of {element.name} that end too early")
            length = int(np.frombuffer(body, count_type, 1, at)[0])
            at += count_type.itemsize
            if not 0 <= length <= (len(body) - at) // item_type.itemsize:
                raise ValueError(f"a list of {length} in {element.name}")
            row = np.frombuffer(body, item_type, length, at).astype(float).tolist()
            at += length * item_type.itemsize
        if len(row) != length:
            raise ValueError(f"a list of {length} in {element.name}")
        rows.append(row)
    return rows, at


def _stated_size(lines: tuple[str, ...]) -> tuple[int, int] | None:
    stated = {}
    for line in lines:
        match = re.fullmatch(r"(?:obj_info|comment)\s+(num_cols|num_rows|width|height)\s*[:= ]\s*(\d{1,6})", line)
        if match:
            stated[match.group(1)] = int(match.group(2))
    for wide, high in (("num_cols", "num_rows"), ("width", "height")):
        if stated.get(wide, 0) > 0 and stated.get(high, 0) > 0:
            return stated[wide], stated[high]
    return None


def _placed(
    points: NDArray[np.float32], grid: list[list[float]], size: tuple[int, int], where: str | Path
) -> NDArray[np.float32]:
    """Return the points (width * height, 3) of a range grid; each place has an empty list or one vertex number."""
    if len(grid) != size[0] * size[1]:
        raise InputError(where, "element range_grid", len(grid), f"{size[0] * size[1]}, num_cols times num_rows")
    filled = np.array([place for place, row in enumerate(grid) if row], np.intp)
    numbers = np.array([row[0] for row in grid if row], float)
    if len(numbers) and not (numbers.min() >= 0 and numbers.max() < len(points)):
        raise InputError(where, "element range_grid", "a vertex number out of range", f"0 to {len(points) - 1}")
    out = np.full((size[0] * size[1], 3), np.nan, np.float32)
    out[filled] = points[numbers.astype(np.intp)]
    return out
