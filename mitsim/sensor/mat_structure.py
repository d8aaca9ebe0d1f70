"""Read MATLAB files after a check of their structure, since SciPy's C code trusts what a file says.

SciPy looks up the type of a data element in a table without a check of its bounds: one changed bit, such as the mark of
complex numbers, ends the process. After this check every element has a type that its place allows, lies inside its
matrix, and holds as many numbers as the matrix has.

Format: "MAT-File Format", MathWorks, R2023b, level 5; files of level 4 have no nested elements and need no check.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

from scipy.io import loadmat, whosmat

from characterisation.files.errors import InputError, in_one_line
from mitsim.sensor.inflated import ZLIB, inflated


class _Type(IntEnum):
    """Types of data elements (table 1-1 of the format)."""

    INT8 = 1
    UINT8 = 2
    INT16 = 3
    UINT16 = 4
    INT32 = 5
    UINT32 = 6
    SINGLE = 7
    DOUBLE = 9
    INT64 = 12
    UINT64 = 13
    MATRIX = 14
    COMPRESSED = 15
    UTF8 = 16
    UTF16 = 17
    UTF32 = 18


class _Class(IntEnum):
    """Classes of arrays (table 1-3) that are not numeric."""

    CELL = 1
    STRUCT = 2
    OBJECT = 3
    CHAR = 4
    SPARSE = 5
    FUNCTION = 16
    OPAQUE = 17


#: numeric classes of arrays, from double to uint64
_NUMERIC = range(6, 16)

#: bytes of a number, by the type of its element
_BYTES: dict[int, int] = {
    _Type.INT8: 1, _Type.UINT8: 1, _Type.INT16: 2, _Type.UINT16: 2, _Type.INT32: 4, _Type.UINT32: 4,
    _Type.SINGLE: 4, _Type.DOUBLE: 8, _Type.INT64: 8, _Type.UINT64: 8,
}  # fmt: skip

#: bytes of a unit of text, by the type of its element
_TEXT_BYTES: dict[int, int] = {
    _Type.INT8: 1, _Type.UINT8: 1, _Type.INT16: 2, _Type.UINT16: 2, _Type.UTF8: 1, _Type.UTF16: 2, _Type.UTF32: 4,
}  # fmt: skip

#: types of the elements that hold names
_NAMES = (_Type.INT8, _Type.UINT8, _Type.UTF8)

#: types of the elements that hold sizes and indices
_WHOLE = (_Type.INT32, _Type.UINT32)

#: mark of complex numbers in the flags of an array
_COMPLEX = 0x0800

#: deepest nesting of cells and structures
_DEEPEST = 32

_KIND = "a whole file of MATLAB, level 5"


def read_mat(file: Path, data: bytes, most: int, **options: bool) -> dict[str, Any]:
    """Return the variables of a file of version 7 or older, without those of SciPy about the file.

    Raises InputError if the file is damaged, larger, or of version 7.3.

    Parameters
    ----------
    file
        Path of the file, for messages.
    data
        Content of the file.
    most
        Largest number of values in the file.
    options
        Of :func:`scipy.io.loadmat`.
    """
    checked = check_mat(file, data, most)
    try:
        count = 0 if checked else sum(math.prod(shape) for _, shape, _ in whosmat(BytesIO(data)))
        if count <= most:
            read = loadmat(BytesIO(data), **options)
            return {name: value for name, value in read.items() if not name.startswith("__")}
    except NotImplementedError:
        raise InputError(file, "", "a .mat file of version 7.3", "an older version", "save(..., '-v7')") from None
    except Exception as error:  # SciPy raises many types of errors for damaged files
        reason = in_one_line(error, 120)
        raise InputError(file, "", f"an unreadable file ({reason})", "a .mat file", "save(..., '-v7')") from None
    raise InputError(file, "size", f"{count:,} values", f"up to {most:,}")


def check_mat(file: Path, data: bytes, most: int) -> bool:
    """Check the bytes of a file of level 5; return False for files of other levels, which pass unchecked.

    ``file``: path of the file, for messages. ``data``: content of the file. ``most``: largest number of values in the
    file. Raises InputError if an element has a type, size or place that the format does not allow, or is nested too
    deep.
    """
    if len(data) < 128 or 0 in data[:4]:  # level 4 begins with a small number; other files SciPy refuses itself
        return False
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
        return False
    _check_variables(_Bytes(file, order, most), data)
    return True


@dataclass(frozen=True)
class _Bytes:
    """Reads elements of a ``file`` in one ``order`` of bytes; ``most`` values are allowed in it."""

    file: Path
    order: str
    most: int

    def fault(self, damage: str) -> InputError:
        return InputError(self.file, "", f"a damaged file: {damage}", _KIND, "save it again, with the option -v7")

    def element(self, data: memoryview) -> tuple[int, memoryview, memoryview]:
        """Return type and content of the first element, and the bytes after it."""
        if len(data) < 8:
            raise self.fault("an element is cut off")
        kind, size = struct.unpack_from(f"{self.order}II", data)
        if kind >> 16:  # a small element: its size is in the upper half of the type
            kind, size, start, end = kind & 0xFFFF, kind >> 16, 4, 8
            if size > 4:
                raise self.fault(f"a small element of {size} bytes")
        else:
            start = 8
            end = start + size if kind == _Type.COMPRESSED else start + -(-size // 8) * 8
            if start + size > len(data):
                raise self.fault(f"an element of {size} bytes where {len(data) - start} are left")
        return kind, data[start : start + size], data[min(end, len(data)) :]


def _check_variables(read: _Bytes, data: bytes) -> None:
    remainder, total = memoryview(data)[128:], 0
    while len(remainder):
        kind, content, remainder = read.element(remainder)
        if kind == _Type.COMPRESSED:
            try:
                unpacked = inflated(content, 8 * read.most, ZLIB)
            except zlib.error as error:
                raise read.fault(f"packed bytes that do not unpack ({error})") from None
            if len(unpacked) > 8 * read.most:
                raise InputError(read.file, "size", f"over {8 * read.most:,} bytes unpacked", "fewer")
            kind, content, _ = read.element(memoryview(unpacked))
        if kind != _Type.MATRIX:
            raise read.fault(f"an element of type {kind} in place of a variable")
        total += _check_matrix(read, content, 0)
        if total > read.most:
            raise InputError(read.file, "size", f"over {read.most:,} values", f"up to {read.most:,}")


def _check_matrix(read: _Bytes, data: memoryview, depth: int) -> int:
    """Check an array and those in it; return the number of values."""
    if depth > _DEEPEST:
        raise read.fault(f"values nested over {_DEEPEST} deep")
    if not len(data):  # an empty cell
        return 0
    kind, flags, remainder = read.element(data)
    if kind != _Type.UINT32 or len(flags) != 8:
        raise read.fault("a variable without its class")
    word = struct.unpack_from(f"{read.order}I", flags)[0]
    parts = 2 if word & _COMPLEX else 1
    array = word & 0xFF
    if array == _Class.OPAQUE:  # an object: three names, and the bytes that only MATLAB can read
        inside = 0
        while len(remainder):
            kind, content, remainder = read.element(remainder)
            if kind == _Type.MATRIX:
                inside += _check_matrix(read, content, depth + 1)
            elif kind not in _NAMES:
                raise read.fault("an object without a class")
        return inside
    kind, sides, remainder = read.element(remainder)
    if kind not in _WHOLE or len(sides) % 4 or not 8 <= len(sides) <= 128:
        raise read.fault("a variable without its size")
    shape = struct.unpack(f"{read.order}{len(sides) // 4}i", sides)
    if min(shape) < 0 or math.prod(shape) > read.most:
        raise read.fault(f"a variable of {' x '.join(map(str, shape))}")
    kind, _, remainder = read.element(remainder)
    if kind not in _NAMES:
        raise read.fault("a variable without a name")
    count = int(math.prod(shape))
    if array in _NUMERIC:
        for _ in range(parts):
            remainder = _check_numbers(read, remainder, count)
    elif array == _Class.CHAR:
        kind, text, remainder = read.element(remainder)
        if kind not in _TEXT_BYTES or len(text) % _TEXT_BYTES[kind] or len(text) // _TEXT_BYTES[kind] > 4 * count:
            raise read.fault("text of the wrong type or length")
    elif array == _Class.SPARSE:
        _check_sparse(read, remainder, shape, parts)
    elif array in (_Class.CELL, _Class.STRUCT, _Class.OBJECT, _Class.FUNCTION):
        remainder = _check_fields(read, remainder, array)
        while len(remainder):
            kind, content, remainder = read.element(remainder)
            if kind != _Type.MATRIX:
                raise read.fault(f"an element of type {kind} in place of a value")
            count += _check_matrix(read, content, depth + 1)
    else:
        raise read.fault(f"an array of class {array}")
    return count


def _check_numbers(read: _Bytes, data: memoryview, count: int) -> memoryview:
    kind, numbers, remainder = read.element(data)
    if kind not in _BYTES:
        raise read.fault(f"numbers of type {kind}")
    if len(numbers) != count * _BYTES[kind]:
        raise read.fault(f"{len(numbers) / _BYTES[kind]:g} numbers in place of {count}")
    return remainder


def _check_fields(read: _Bytes, data: memoryview, array: int) -> memoryview:
    """Check the class name and the field names of a structure or object; a cell has none."""
    if array == _Class.OBJECT:
        kind, _, data = read.element(data)
        if kind not in _NAMES:
            raise read.fault("an object without a class")
    if array in (_Class.STRUCT, _Class.OBJECT):
        kind, length, data = read.element(data)
        longest = struct.unpack(f"{read.order}i", length)[0] if kind in _WHOLE and len(length) == 4 else 0
        kind, names, data = read.element(data)
        if longest < 1 or kind not in _NAMES or len(names) % longest:
            raise read.fault("a structure without names of its fields")
    return data


def _check_sparse(read: _Bytes, data: memoryview, shape: tuple[int, ...], parts: int) -> None:
    """Check the row indices and the column starts of a sparse matrix: they are addresses in its arrays."""
    if len(shape) != 2:
        raise read.fault("a sparse matrix of more than two dimensions")
    index_arrays = []
    for _ in range(2):
        kind, content, data = read.element(data)
        if kind not in _WHOLE or len(content) % 4:
            raise read.fault("a sparse matrix without its indices")
        index_arrays.append(struct.unpack(f"{read.order}{len(content) // 4}i", content))
    rows, starts = index_arrays
    rising = all(a <= b for a, b in pairwise(starts))
    if len(starts) != shape[1] + 1 or starts[0] != 0 or not rising or starts[-1] > len(rows):
        raise read.fault("a sparse matrix whose columns do not follow one another")
    if not all(0 <= row < shape[0] for row in rows[: starts[-1]]):
        raise read.fault("a sparse matrix with rows outside it")
    for _ in range(parts):
        kind, numbers, data = read.element(data)
        # of true and false MATLAB writes one byte each, whatever type it states
        if kind not in _BYTES or (len(numbers) != starts[-1] and len(numbers) < starts[-1] * _BYTES[kind]):
            raise read.fault("a sparse matrix with too few numbers")
