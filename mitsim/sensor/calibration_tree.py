"""Read calibration files of the usual programs into one tree of names and numbers.

Signal chain: files (YAML of any program, XML and JSON of OpenCV, MATLAB's .mat, NumPy's .npz) -> names and arrays of
each document of each file -> values of other programs in OpenCV's form (:mod:`mitsim.sensor.calibration_programs`) ->
one tree that records which values were read, so that unread values can be reported.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import cv2
import numpy as np
from scipy.io.matlab import MatlabOpaque

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError, nearest
from mitsim.sensor.calibration_programs import Composed, with_usual_names
from mitsim.sensor.inflated import GZIP, inflated
from mitsim.sensor.mat_structure import read_mat
from mitsim.sensor.yaml_values import NotYamlError, read_yaml

#: names of quantities derived from the rest of a calibration, or that state its quality
_DERIVED = re.compile(
    r"E|F|Q|[RPH][12]|.*(err|std|rms|reproj).*|active.*|rvecs?|tvecs?|.*per_?view.*|(rectification|projection)_matrix",
    re.IGNORECASE,
)

_SUFFIXES = (".yml", ".yaml", ".xml", ".json", ".mat", ".npz")
_KINDS = "a calibration: YAML, .xml or .json of OpenCV, .mat of MATLAB, .npz of NumPy"


#: largest file [bytes]; calibrations are small
_LARGEST = 64 * 1024**2

#: most numbers in a file of MATLAB or NumPy, unpacked
_MOST_NUMBERS = 16 * 1024**2

#: files of OpenCV above this size [bytes] contain maps of pixels; OpenCV reads them ten times as fast
_OF_OPENCV = 2 * 1024**2

#: deepest allowed nesting of values in OpenCV's files, and the marks that nest
_DEEPEST = 64
_NESTING = re.compile(rb"<!--.*?-->|<[^<>]*>|[][{}]", re.DOTALL)
_INDENT = re.compile(rb"^([ \t]+)", re.MULTILINE)
_DASHES = re.compile(rb"(?:[-?:][ \t]+){40}")


@dataclass(frozen=True)
class Found:
    """A value of a tree, its file, and the ``table`` that qualifies the value: the map in which it stands."""

    file: Path
    value: Any
    table: dict[str, Any]


@dataclass
class CalibrationTree:
    """Values of one or several files by name: one map for each document of a file.

    ``seen`` holds the document and the dotted name of each value that was read.
    """

    files: list[Path]
    values: list[dict[str, Any]]
    seen: set[tuple[int, str]] = field(default_factory=set)

    def find(self, key: str) -> Found | None:
        """Return the value of a name; dots step into maps, and ``file.yml:name`` searches one file only.

        Raises
        ------
        InputError
            If several files, or several documents of a file, give different values.
        """
        file, mark, name = key.rpartition(":")
        found: list[tuple[Path, Any, dict[str, Any]]] = []
        for i, path in enumerate(self.files):
            if mark and path.parts[-len(Path(file).parts) :] != Path(file).parts:
                continue
            value, table = _stepped(self.values[i], name)
            if value is None:
                continue
            self.seen.add((i, name))
            if isinstance(value, Composed):
                self.seen.update((i, source) for source in value.sources)
                found.append((path, value.value, value.table))
            else:
                found.append((path, value, table))
        if not found:
            return None
        first, value, _ = found[0]
        for path, other, _ in found[1:]:
            if not _same(value, other):
                if path == first:
                    raise InputError(path, name, "other values in a later document of the file", "one document")
                both = f"other values in {first.name} than in {path.name}"
                hint = f'name the file to use: file = "{first.name}" in [calibration.keys.NAME]'
                raise InputError(path, name, both, "a value of one file, or the same in all", hint)
        return Found(*found[0])

    def names(self) -> list[str]:
        """Return the names in all files; those in maps are dotted."""
        return list(dict.fromkeys(name for tree in self.values for name, _ in _leaves(tree)))

    def unread(self) -> list[str]:
        """Return the names of values that look like optics and were not read."""
        return [
            name
            for i, tree in enumerate(self.values)
            for name, value in _leaves(tree)
            if not any((i, name[:end]) in self.seen for end in _ends(name))
            and not _DERIVED.fullmatch(name.rpartition(".")[2])
            and _is_optics(value)
        ]


def read_tree(files: list[Path]) -> CalibrationTree:
    """Read calibration files.

    Raises
    ------
    InputError
        If a file is missing or cannot be read.
    """
    read = [(file, with_usual_names(document)) for file in files for document in _read(file)]
    return CalibrationTree([file for file, _ in read], [values for _, values in read])


def tree_of(tables: dict[str, dict[str, Any]]) -> CalibrationTree:
    """Return the tree of tables that have been read from a recording, by the names of their sources."""
    return CalibrationTree([Path(name) for name in tables], [with_usual_names(table) for table in tables.values()])


def _read(file: Path) -> list[dict[str, Any]]:
    """Return the names and values of each document of a file."""
    data = read_bounded(file, _KINDS, "" if file.exists() else _beside(file), largest=_LARGEST)
    if file.suffix.lower() == ".mat":
        values = read_mat(file, data, _MOST_NUMBERS, simplify_cells=True)
        plain = {name: value for name, value in values.items() if not isinstance(value, MatlabOpaque)}
        if values and not plain:
            hint = "save it as a structure: s = toStruct(stereoParams); save('stereo.mat', 's', '-v7')"
            raise InputError(file, "", "an object that only MATLAB can read", "numbers and structures", hint)
        return [plain]
    if file.suffix.lower() == ".npz":
        try:
            with ZipFile(BytesIO(data)) as packed:
                unpacked = sum(entry.file_size for entry in packed.infolist())
            if unpacked > 8 * _MOST_NUMBERS:
                raise InputError(file, "size", f"{unpacked:,} bytes unpacked", f"up to {8 * _MOST_NUMBERS:,}")
            with np.load(BytesIO(data), allow_pickle=False) as arrays:
                return [{name: arrays[name] for name in arrays.files}]
        except InputError:
            raise
        except Exception as error:
            raise InputError(file, "", f"a file that NumPy cannot read ({error})", _KINDS) from None
    data = _unpacked(file, data)
    ending = file.with_suffix("").suffix.lower() if file.suffix.lower() == ".gz" else file.suffix.lower()
    of_opencv = data.lstrip().startswith(b"%YAML:1.0")
    if ending not in (".yml", ".yaml") and not of_opencv:
        return [_of_opencv(file, data)]
    if of_opencv and (b"!!binary" in data or len(data) > _OF_OPENCV):  # numbers in base 64, or whole images of numbers
        return [_of_opencv(file, data)]
    try:
        return read_yaml(file, data, _KINDS)
    except NotYamlError as fault:
        if of_opencv:
            with suppress(InputError):  # OpenCV's parser allows more than YAML does
                return [_of_opencv(file, data)]
        raise fault from None


def _of_opencv(file: Path, data: bytes) -> dict[str, Any]:
    """Read a file by OpenCV."""
    _check_layout(file, data)
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        fault = "" if storage.isOpened() and storage.root().isMap() else "nothing in it"
    except (cv2.error, SystemError) as error:
        fault = _last_line(error)
    if fault:
        raise InputError(file, "", f"a file that OpenCV cannot read ({fault})", _KINDS)
    try:
        return {name: _plain(storage.root().getNode(name)) for name in storage.root().keys()}  # noqa: SIM118 not a dict
    except (cv2.error, SystemError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(file, "", f"a file that OpenCV cannot read ({_last_line(error)})", _KINDS) from None
    finally:
        storage.release()


def _last_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1][:200]


def _unpacked(file: Path, data: bytes) -> bytes:
    """Return the bytes of a file, unpacked if it is gzip's."""
    if data[:2] != b"\x1f\x8b":
        return data
    try:
        data = inflated(data, _LARGEST, GZIP)
    except zlib.error as error:
        raise InputError(file, "", f"a packed file that is damaged ({error})", _KINDS) from None
    if len(data) > _LARGEST:
        raise InputError(file, "size", f"over {_LARGEST} bytes unpacked", f"up to {_LARGEST}")
    return data


def _check_layout(file: Path, data: bytes) -> None:
    """Reject text on which OpenCV's parsers would crash the process or never return."""
    depth = deepest = 0
    for mark in _NESTING.finditer(data):
        text = mark.group()
        if text[:2] in (b"<!", b"<?") or text[-2:] == b"/>":
            continue
        depth = depth - 1 if text[:1] in b"]}" or text[:2] == b"</" else depth + 1
        depth = max(depth, 0)
        deepest = max(deepest, depth)
    indented = max((len(mark.group(1)) for mark in _INDENT.finditer(data)), default=0)
    if _is_outdented(data):
        raise InputError(file, "", "a line that is indented less than the first", _KINDS)
    if deepest > _DEEPEST or indented > 4 * _DEEPEST or _DASHES.search(data):
        raise InputError(file, "", f"values nested over {_DEEPEST} deep", _KINDS)


def _is_outdented(data: bytes) -> bool:
    """Return whether a line of a YAML document is left of its first key: OpenCV would read it over and over."""
    if data.lstrip()[:1] in (b"<", b"{"):  # XML or JSON
        return False
    first: int | None = None
    for line in data.splitlines():
        text = line.lstrip(b" ")
        if line.startswith((b"---", b"...")):
            first = None  # of the next document
        elif text.strip() and not text.startswith((b"#", b"%")):
            indent = len(line) - len(text)
            first = indent if first is None else first
            if indent < first:
                return True
    return False


def _plain(node: Any) -> Any:
    """Convert an OpenCV node to a dict, list, array, number or text."""
    if node.isMap():
        names = set(node.keys())
        if {"rows", "cols", "data"} <= names:
            return _matrix(node, "dt" in names)
        return {name: _plain(node.getNode(name)) for name in names}
    if node.isSeq():
        return [_plain(node.at(index)) for index in range(node.size())]
    return node.real() if node.isReal() or node.isInt() else node.string() if node.isString() else None


def _matrix(node: Any, of_opencv: bool) -> Any:
    try:
        if of_opencv:
            return node.mat()
        shape = int(node.getNode("rows").real()), int(node.getNode("cols").real())
        return np.asarray(_plain(node.getNode("data")), float).reshape(shape)
    except (cv2.error, ValueError, TypeError):
        return "a matrix that cannot be read"


def _leaves(tree: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted names and values of a tree, without composed values."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{before}{name}.")
        elif not isinstance(value, Composed):
            yield f"{before}{name}", value


def _ends(name: str) -> list[int]:
    """Return the ends of a dotted name and of the maps in which it stands."""
    return [*(at for at, letter in enumerate(name) if letter == "."), len(name)]


def _is_optics(value: Any) -> bool:
    """Return whether a value looks like a camera matrix, distortion coefficients, or a rotation."""
    try:
        numbers = np.asarray(value, float)
    except (ValueError, TypeError):
        return False
    if not numbers.size or not np.isfinite(numbers).all():
        return False
    if numbers.shape == (3, 3):
        matrix = numbers[0, 0] > 0 and np.abs(numbers[2] - [0, 0, 1]).max() < 1e-9 and numbers[0, 2] > 0
        return bool(matrix or np.abs(numbers @ numbers.T - np.eye(3)).max() < 1e-4)
    vector = numbers.ndim and numbers.size == max(numbers.shape)
    return bool(vector and numbers.size in (4, 5, 8, 12, 14) and np.abs(numbers).max() < 100 and numbers.any())


def _stepped(tree: dict[str, Any], name: str) -> tuple[Any, dict[str, Any]]:
    """Return the value of a dotted name, and the map in which it stands; None and an empty map without it."""
    table: Any = tree
    parts = [name] if name in tree else name.split(".")
    for part in parts[:-1]:
        table = table.get(part) if isinstance(table, dict) else None
    return (table.get(parts[-1]), table) if isinstance(table, dict) else (None, {})


def _same(one: Any, other: Any) -> bool:
    try:
        return bool(np.array_equal(np.asarray(one, float), np.asarray(other, float)))
    except (ValueError, TypeError):
        return bool(one == other)


def _beside(file: Path) -> str:
    """Suggest calibration files in the folder of a missing one, the most similar first."""
    try:
        there = sorted(path.name for path in file.parent.iterdir() if path.suffix.lower() in _SUFFIXES)
    except OSError:
        return f"the folder {file.parent} does not exist either"
    return nearest(file.name, there) or (f"the folder has: {', '.join(there[:6])}" if there else "")
