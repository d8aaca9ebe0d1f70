"""Read the names and values of a calibration file of any format: YAML, JSON, XML, .mat, .npz, or text of devices.

Signal chain: bytes -> parser of the format, within bounds -> for each document a map of names to numbers, texts, lists,
maps and arrays.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import cv2
import numpy as np
from scipy.io.matlab import MatlabOpaque

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError, nearest
from mitsim.sensor.calibration_devices import FORMS, from_azure_kinect, from_metashape, from_text
from mitsim.sensor.inflated import GZIP, inflated
from mitsim.sensor.mat_structure import read_mat
from mitsim.sensor.yaml_values import NotYamlError, matrix_of, read_yaml

#: suffixes of text in a form of its own
_TEXTS = (".txt", ".conf", ".ini", ".cameramodel")

#: suffixes of calibrations
SUFFIXES = (".yml", ".yaml", ".xml", ".json", ".mat", ".npz", *_TEXTS)

_KINDS = f"a calibration: YAML, JSON, .xml of OpenCV or Metashape, .mat of MATLAB, .npz of NumPy; {FORMS}"


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


def read_documents(file: Path, size: tuple[int, int] | None = None) -> list[dict[str, Any]]:
    """Return the names and values of each document of a file.

    ``size`` (width, height) [px] of the images chooses the cameras of a device that has several sizes. Raises
    InputError if the file is missing, damaged, too large, or of no known format.
    """
    data = read_bounded(file, _KINDS, "" if file.exists() else beside(file), largest=_LARGEST)
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
                return [dict(_numbers_of(arrays))]
        except InputError:
            raise
        except Exception as error:
            raise InputError(file, "", f"a file that NumPy cannot read ({error})", _KINDS) from None
    data = _unpacked(file, data)
    own_form = file.suffix.lower() == ".cameramodel" or not data.lstrip().startswith((b"%YAML", b"<", b"{"))
    if file.suffix.lower() in _TEXTS and own_form:
        return [from_text(file, data, size)]
    ending = file.with_suffix("").suffix.lower() if file.suffix.lower() == ".gz" else file.suffix.lower()
    of_opencv = data.lstrip().startswith(b"%YAML:1.0")
    if ending == ".json":
        return [_of_json(file, data, size)]
    if ending not in (".yml", ".yaml") and not of_opencv:
        cameras = from_metashape(file, data) if ending == ".xml" and b"<opencv_storage" not in data else None
        return [_of_opencv(file, data) if cameras is None else cameras]
    if of_opencv and (b"!!binary" in data or len(data) > _OF_OPENCV):  # numbers in base 64, or whole images of numbers
        return [_of_opencv(file, data)]
    try:
        return read_yaml(file, data, _KINDS)
    except NotYamlError as fault:
        if of_opencv:
            with suppress(InputError):  # OpenCV's parser allows more than YAML does
                return [_of_opencv(file, data)]
        raise fault from None


def _numbers_of(arrays: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays and words of an ``.npz``, without Python's objects, which only their program can read."""
    for name in arrays.files:
        try:
            value = arrays[name]
            yield name, value.item() if value.shape == () and value.dtype.kind in "US" else value
        except ValueError as error:
            if "Object arrays" not in str(error):
                raise


def _of_json(file: Path, data: bytes, size: tuple[int, int] | None) -> dict[str, Any]:
    """Read JSON; that of OpenCV may have numbers that JSON does not allow."""
    try:
        table = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        if b"opencv" in data:
            return _of_opencv(file, data)
        reason = f"values nested over {_DEEPEST} deep" if isinstance(error, RecursionError) else str(error)
        raise InputError(file, "", f"text that is not JSON ({reason})", _KINDS) from None
    if not isinstance(table, dict) or not table:
        raise InputError(file, "", "a list" if isinstance(table, list) else "no names", "JSON with names: {...}")
    kinect = from_azure_kinect(file, table.get("CalibrationInformation"), size)
    if kinect is not None:
        return kinect
    return {name: _with_matrices(value, 1) for name, value in table.items()}


def _with_matrices(value: Any, depth: int) -> Any:
    """Return a value of JSON, with arrays in place of maps that describe a matrix."""
    if depth > _DEEPEST:
        return None
    if isinstance(value, list):
        nested = any(isinstance(item, (dict, list)) for item in value)
        return [_with_matrices(item, depth + 1) for item in value] if nested else value
    if not isinstance(value, dict):
        return value
    out = {name: _with_matrices(item, depth + 1) for name, item in value.items()}
    return matrix_of(out) if {"rows", "cols", "data"} <= set(out) else out


def _of_opencv(file: Path, data: bytes) -> dict[str, Any]:
    """Read a file by OpenCV."""
    _check_layout(file, data)
    first = re.search(rb"<([^!?][^\s/>]*)", data) if file.suffix.lower() == ".xml" else None
    if first is not None and first[1] != b"opencv_storage":
        found = f"XML of another program: it begins with <{first[1].decode('utf-8', 'replace')[:60]}>"
        raise InputError(file, "", found, _KINDS, "write its numbers as [cameras.NAME] of a TOML")
    try:
        # not by the name: OpenCV crashes on one that is not UTF-8, and Windows has its own code page for it
        text = data.decode("utf-8-sig", "replace")
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        fault = "" if storage.isOpened() and storage.root().isMap() else "nothing in it"
    except (cv2.error, SystemError) as error:
        fault = _last_line(error) if isinstance(error, cv2.error) else "no YAML, JSON or XML in it"
    if fault:
        named = {suffix.lower() for suffix in file.suffixes} & set(SUFFIXES)
        hint = "" if named else "write its numbers as JSON or YAML under the usual names: cam_K, proj_K, R, T and so on"
        raise InputError(file, "", f"a file that OpenCV cannot read ({fault})", _KINDS, hint)
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


def beside(file: Path) -> str:
    """Suggest calibration files in the folder of a missing one, the most similar first."""
    try:
        there = sorted(path.name for path in file.parent.iterdir() if path.suffix.lower() in SUFFIXES)
    except OSError:
        return f"the folder {file.parent} does not exist either"
    return nearest(file.name, there) or (f"the folder has: {', '.join(there[:6])}" if there else "")
