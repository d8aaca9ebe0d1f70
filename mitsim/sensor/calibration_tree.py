"""Read calibration files of the usual programs into one tree of names and numbers.

Signal chain: files (OpenCV's FileStorage, YAML of ROS, MATLAB's .mat, NumPy's .npz) -> names and arrays of each file ->
MATLAB's own quantities converted to OpenCV's form -> one tree that records which values were read, so that unread
values can be reported.

Conventions of MATLAB's programs:

- Camera calibration toolbox (Bouguet; ``Calib_Results.mat``, ``Calib_Results_stereo.mat``): K is composed of ``fc``,
  ``cc`` and ``alpha_c``, ``kc`` is in OpenCV's order, ``om`` is a rotation vector, and pixels count from 0.
- Computer Vision Toolbox: a structure made by ``toStruct`` is read. Its matrices act on row vectors, so they are
  transposed. Its sizes are (rows, columns), and its pixels count from 1.
"""

from __future__ import annotations

import math
import re
import zlib
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat

from characterisation.checked_files import read_bounded
from characterisation.errors import InputError, nearest
from mitsim.sensor.mat_structure import check_mat

#: endings of names in MATLAB's toolbox and similar programs: one camera, the cameras of a pair, camera and projector
_ENDINGS = ("", "_left", "_right", "_cam", "_proj", "_camera", "_projector")

#: names of quantities derived from the rest of a calibration, or that state its quality
_DERIVED = re.compile(r"E|F|Q|[RPH][12]|.*(err|std|rms|reproj).*|active.*|rvecs?|tvecs?|.*per_?view.*", re.IGNORECASE)

_SUFFIXES = (".yml", ".yaml", ".xml", ".json", ".mat", ".npz")
_KINDS = "a calibration: .yml, .yaml, .xml or .json of OpenCV, .mat of MATLAB, .npz of NumPy"


#: largest file [bytes] and largest unpacked size; calibrations are small
_LARGEST, _MOST_NUMBERS = 64 * 1024**2, 16 * 1024**2

#: deepest allowed nesting of values in OpenCV's files, and the marks that nest
_DEEPEST = 64
_NESTING = re.compile(rb"<!--.*?-->|<[^<>]*>|[][{}]", re.DOTALL)
_INDENT, _DASHES = re.compile(rb"^([ \t]+)", re.MULTILINE), re.compile(rb"(?:[-?:][ \t]+){40}")


@dataclass
class CalibrationTree:
    """Values of one or several files by name; ``seen`` holds the names of the values that were read."""

    files: list[Path]
    values: list[dict[str, Any]]
    seen: set[tuple[int, str]] = field(default_factory=set)

    def find(self, key: str) -> tuple[Path, Any] | None:
        """Return the file and value of a name; dots step into maps, and ``file.yml:name`` searches one file only.

        Raises
        ------
        InputError
            If several files give different values.
        """
        file, mark, name = key.rpartition(":")
        asked = [i for i, path in enumerate(self.files) if not mark or path.name == Path(file).name]
        found = [(i, value) for i in asked if (value := _stepped(self.values[i], name)) is not None]
        if not found:
            return None
        for i, _ in found:
            self.seen.add((i, name.partition(".")[0]))
        first, value = found[0]
        for i, other in found[1:]:
            if not _same(value, other):
                both = f"other values in {self.files[first].name} than in {self.files[i].name}"
                hint = f'name the file to use: file = "{self.files[first].name}" in [calibration.keys.NAME]'
                raise InputError(self.files[i], name, both, "a value of one file, or the same in all", hint)
        return self.files[first], value

    def names(self) -> list[str]:
        """Return the names in all files."""
        return list(dict.fromkeys(name for tree in self.values for name in tree if not name.startswith("+")))

    def unread(self) -> list[str]:
        """Return the names of values that look like optics and were not read."""
        read = {(i, source) for i, name in self.seen for source in _sources(self.values[i], name)}
        return [
            name
            for i, tree in enumerate(self.values)
            for name, value in tree.items()
            if (i, name) not in read and not name.startswith("+") and not _DERIVED.fullmatch(name) and _is_optics(value)
        ]


def read_tree(files: list[Path]) -> CalibrationTree:
    """Read calibration files.

    Raises
    ------
    InputError
        If a file is missing or cannot be read.
    """
    return CalibrationTree(files, [_with_usual_names(_read(file)) for file in files])


def _read(file: Path) -> dict[str, Any]:
    data = read_bounded(file, _KINDS, "" if file.exists() else _beside(file), largest=_LARGEST)
    if file.suffix.lower() == ".mat":
        check_mat(file, data, 8 * _MOST_NUMBERS)
        try:
            sizes = [math.prod(shape) for _, shape, _ in whosmat(BytesIO(data))]
            if sum(sizes) > _MOST_NUMBERS:
                raise InputError(file, "size", f"{sum(sizes):,} numbers", f"up to {_MOST_NUMBERS:,}")
            read = loadmat(BytesIO(data), simplify_cells=True)
        except NotImplementedError:
            raise InputError(file, "", "a .mat file of version 7.3", "an older version", "save(..., '-v7')") from None
        except InputError:
            raise
        except Exception as error:  # the reader raises any exception on damaged bytes
            raise InputError(file, "", f"a file that is not MATLAB's ({error})", _KINDS) from None
        return {name: value for name, value in read.items() if not name.startswith("__")}
    if file.suffix.lower() == ".npz":
        try:
            with ZipFile(BytesIO(data)) as packed:
                unpacked = sum(entry.file_size for entry in packed.infolist())
            if unpacked > 8 * _MOST_NUMBERS:
                raise InputError(file, "size", f"{unpacked:,} bytes unpacked", f"up to {8 * _MOST_NUMBERS:,}")
            with np.load(BytesIO(data), allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except InputError:
            raise
        except Exception as error:
            raise InputError(file, "", f"a file that NumPy cannot read ({error})", _KINDS) from None
    _check_layout(file, data)
    storage = _opened(file)
    try:
        return {name: _plain(storage.root().getNode(name)) for name in storage.root().keys()}  # noqa: SIM118 not a dict
    except (cv2.error, SystemError, UnicodeDecodeError, RecursionError) as error:
        cause = str(error).strip().splitlines()[-1][:200]
        raise InputError(file, "", f"a file that OpenCV cannot read ({cause})", _KINDS) from None
    finally:
        storage.release()


def _check_layout(file: Path, data: bytes) -> None:
    """Reject text on which OpenCV's parsers would crash the process or never return."""
    if data[:2] == b"\x1f\x8b":  # OpenCV unpacks gzip files itself
        try:
            unpack = zlib.decompressobj(31)
            data = unpack.decompress(data, _LARGEST)
        except zlib.error as error:
            raise InputError(file, "", f"a packed file that is damaged ({error})", _KINDS) from None
        if unpack.unconsumed_tail:
            raise InputError(file, "size", f"over {_LARGEST} bytes unpacked", f"up to {_LARGEST}")
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


def _opened(file: Path) -> Any:
    hint = ""
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        if storage.isOpened() and storage.root().isMap():
            return storage
        fault = "nothing in it"
    except (cv2.error, SystemError) as error:
        fault = str(error).strip().splitlines()[-1]
    if file.suffix in (".yml", ".yaml"):
        try:  # YAML of other programs lacks OpenCV's first line
            text = file.read_text(encoding="utf-8")
            storage = cv2.FileStorage(f"%YAML:1.0\n---\n{text}", cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            if "%YAML" not in text and storage.isOpened() and storage.root().isMap():
                return storage
        except (cv2.error, SystemError, OSError, UnicodeDecodeError):
            pass
        hint = "a YAML file of OpenCV begins with %YAML:1.0"
    raise InputError(file, "", f"a file that OpenCV cannot read ({fault})", _KINDS, hint)


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


def _with_usual_names(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree, with MATLAB's quantities added under names that begin with a plus."""
    out = dict(tree)
    for ending in _ENDINGS:
        fc, cc = (_vector(tree.get(f"{name}{ending}"), 2) for name in ("fc", "cc"))
        if fc is None or cc is None:
            continue
        alpha = np.ravel(tree.get(f"alpha_c{ending}", 0.0))
        skew = float(alpha[0]) * fc[0] if alpha.size == 1 and alpha.dtype.kind in "fiu" else math.nan
        out[f"+K{ending}"] = np.array([[fc[0], skew, cc[0]], [0, fc[1], cc[1]], [0, 0, 1]])
    width, height = (_vector(tree.get(name), 1) for name in ("nx", "ny"))
    if width is not None and height is not None:
        out["+size"] = np.concatenate([width, height])
    for number, name in (("1", "CameraParameters1"), ("2", "CameraParameters2")):
        for holder in (tree, *(value for value in tree.values() if isinstance(value, dict))):
            if isinstance(holder.get(name), dict):
                out |= _vision_toolbox(holder[name], holder, number)
    return out


def _vision_toolbox(camera: dict[str, Any], pair: dict[str, Any], number: str) -> dict[str, Any]:
    """Return the values of one camera in a Computer Vision Toolbox structure, and the pose of the second camera."""
    out: dict[str, Any] = {}
    matrix = np.asarray(camera.get("IntrinsicMatrix", np.nan), float)
    if matrix.shape == (3, 3):
        out[f"+K{number}"] = matrix.T - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    radial, tangential = (_vector(camera.get(name)) for name in ("RadialDistortion", "TangentialDistortion"))
    if radial is not None and 2 <= len(radial) <= 3:
        straight = np.zeros(2) if tangential is None else tangential
        out[f"+D{number}"] = np.concatenate([radial[:2], straight, radial[2:], np.zeros(3 - len(radial))])
    size = _vector(camera.get("ImageSize"), 2)
    if size is not None:
        out["+size" if number == "1" else "+size2"] = size[::-1]
    if number == "2":
        turn, shift = (_vector(pair.get(f"{name}OfCamera2")) for name in ("Rotation", "Translation"))
        if turn is not None and shift is not None and (len(turn), len(shift)) == (9, 3):
            out |= {"+R": turn.reshape(3, 3).T, "+T": shift}
    return out


def _sources(tree: dict[str, Any], name: str) -> list[str]:
    """Return the names in the file from which a read value was made."""
    if not name.startswith("+"):
        return [name]
    if name.startswith("+K_") or name == "+K":
        ending = name.removeprefix("+K")
        return [f"{part}{ending}" for part in ("fc", "cc", "alpha_c", "KK")]
    return ["nx", "ny"]


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


def _stepped(tree: Any, name: str) -> Any:
    for part in [name] if name in tree else name.split("."):
        if not isinstance(tree, dict) or part not in tree:
            return None
        tree = tree[part]
    return tree


def _same(one: Any, other: Any) -> bool:
    try:
        return bool(np.array_equal(np.asarray(one, float), np.asarray(other, float)))
    except (ValueError, TypeError):
        return bool(one == other)


def _vector(value: Any, size: int | None = None) -> NDArray[np.float64] | None:
    try:
        numbers = np.asarray(value, float).reshape(-1)
    except (ValueError, TypeError):
        return None
    return numbers if np.isfinite(numbers).all() and (size is None or len(numbers) == size) else None


def _beside(file: Path) -> str:
    """Suggest calibration files in the folder of a missing one, the most similar first."""
    try:
        there = sorted(path.name for path in file.parent.iterdir() if path.suffix.lower() in _SUFFIXES)
    except OSError:
        return f"the folder {file.parent} does not exist either"
    return nearest(file.name, there) or (f"the folder has: {', '.join(there[:6])}" if there else "")
