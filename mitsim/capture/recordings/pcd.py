"""Read PCD files of the Point Cloud Library, 0.7 and before: ascii, binary and binary_compressed.

Signal chain: header -> fields with their types -> numbers, field after field in a compressed file -> x, y, z on the
grid of WIDTH x HEIGHT, unchanged.

PCL's documentation, *The PCD (Point Cloud Data) file format*, describes the header. VIEWPOINT is not applied.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import LARGEST_FILE
from characterisation.files.errors import InputError
from mitsim.capture.recordings.cloud_numbers import number_words
from mitsim.sensor.png import LONGEST_SIDE_PX

_KINDS = ("ascii", "binary", "binary_compressed")
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


def decode_pcd(data: bytes, where: str | Path) -> tuple[NDArray[np.float32], dict[str, str]]:
    """Return the points (HEIGHT, WIDTH, 3) unchanged, and the header by key; x, y and z are required."""
    header, body = _header(data, where)
    dtype, names = _fields(header, where)
    width, height = (_count(header, key, where) for key in ("WIDTH", "HEIGHT"))
    # an unorganised cloud is one long row; the caller rejects it
    if width * height * dtype.itemsize > LARGEST_FILE or min(width, height) > LONGEST_SIDE_PX:
        raise InputError(where, "WIDTH, HEIGHT", f"{width} x {height}", f"up to {LARGEST_FILE} bytes of numbers")
    if "POINTS" in header and _count(header, "POINTS", where) != width * height:
        raise InputError(where, "POINTS", header["POINTS"], f"{width * height}, WIDTH times HEIGHT")
    try:
        columns = _numbers(header["DATA"], body, dtype, names, width * height)
    except (ValueError, struct.error) as error:
        raise InputError(where, "", f"data that do not fit the header ({error})", "a complete PCD") from None
    points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    return points.reshape(height, width, 3), header


def _header(data: bytes, where: str | Path) -> tuple[dict[str, str], bytes]:
    header: dict[str, str] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at, at + 2000)
        if end < 0:
            raise InputError(where, "", "a file without the header of a PCD", "a PCD file")
        line = data[at:end].decode("ascii", "replace").strip()
        at = end + 1
        if not line or line.startswith("#"):
            continue
        key, _, value = line.partition(" ")
        if key not in _KEYS:
            raise InputError(where, "", f"the line {line[:40]!r}", "the header of a PCD: " + ", ".join(_KEYS))
        header[key] = value.strip()
    for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT"):
        if key not in header:
            raise InputError(where, key, "nothing", "a value: this line is required")
    if header["DATA"] not in _KINDS:
        raise InputError(where, "DATA", repr(header["DATA"]), " | ".join(_KINDS))
    return header, data[at:]


def _count(header: dict[str, str], key: str, where: str | Path) -> int:
    text = header[key]
    if not (text.isascii() and text.isdigit() and len(text) <= 9 and int(text) > 0):
        raise InputError(where, key, repr(text[:40]), "a whole number over 0")
    return int(text)


def _fields(header: dict[str, str], where: str | Path) -> tuple[np.dtype[np.void], list[str]]:
    """Return the type of a point, and its fields in order; a field of several numbers is one subarray."""
    names, sizes, kinds = (header[key].split() for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", " ".join("1" for _ in names)).split()
    if not len(names) == len(sizes) == len(kinds) == len(counts) <= 100:
        raise InputError(where, "FIELDS", header["FIELDS"][:80], "as many as SIZE, TYPE and COUNT have")
    unique = [f"{number}:{name}" if name == "_" or names.count(name) > 1 else name for number, name in enumerate(names)]
    fields = []
    for name, size, kind, count in zip(unique, sizes, kinds, counts, strict=True):
        code = {"F": "f", "I": "i", "U": "u"}.get(kind, "")
        if f"{code}{size}" not in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"):
            raise InputError(where, "TYPE, SIZE", f"{kind} {size} of {name}", "F 4 or 8, I or U 1, 2, 4 or 8")
        if not (count.isascii() and count.isdigit() and 0 < int(count[:6]) <= 4096 and len(count) < 6):
            raise InputError(where, "COUNT", f"{count[:20]} of {name}", "1 to 4096")
        fields.append((name, f"<{code}{size}", (int(count),)) if count != "1" else (name, f"<{code}{size}"))
    missing = [axis for axis in "xyz" if axis not in unique or counts[unique.index(axis)] != "1"]
    if missing:
        raise InputError(where, "FIELDS", header["FIELDS"][:80], "x, y and z, once each")
    return np.dtype(fields), unique


def _numbers(
    kind: str, body: bytes, dtype: np.dtype[np.void], names: list[str], count: int
) -> dict[str, NDArray[np.float32]]:
    """Return the columns x, y and z, (count,) each."""
    with np.errstate(over="ignore", invalid="ignore"):
        if kind == "ascii":
            words = number_words(body)
            *first, stride = np.cumsum([0, *(int(np.prod(dtype[name].shape)) for name in names)]).tolist()
            if len(words) != count * stride:
                raise ValueError(f"{len(words)} numbers, {count * stride} expected")
            return {axis: np.array(words[first[names.index(axis)] :: stride], np.float32) for axis in "xyz"}
        if kind == "binary":
            if len(body) < count * dtype.itemsize:
                raise ValueError(f"{len(body)} bytes, {count * dtype.itemsize} expected")
            table = np.frombuffer(body, dtype, count)
            return {axis: table[axis].astype(np.float32) for axis in "xyz"}
        packed, size = struct.unpack_from("<II", body)
        if size != count * dtype.itemsize or len(body) < 8 + packed:
            raise ValueError(f"{len(body) - 8} bytes for {size}; {packed} for {count * dtype.itemsize} expected")
        plain = decode_lzf(body[8 : 8 + packed], size)
        out, at = {}, 0
        for name in names:
            if name in "xyz":
                out[name] = np.frombuffer(plain, dtype[name], count, at).astype(np.float32)
            at += count * dtype[name].itemsize
        return out


def decode_lzf(data: bytes, size: int) -> bytes:
    """Decompress LZF, that of ``binary_compressed`` files (Marc Lehmann's LibLZF), to ``size`` bytes.

    A control byte c under 32 precedes c + 1 literal bytes. Otherwise its upper three bits are a length; 7 means that a
    byte follows to be added to it. Its lower five bits are the upper bits of a distance, whose lower eight follow. Then
    length + 2 bytes are repeated from distance + 1 bytes before. Raises ValueError if the data do not decode to exactly
    that many bytes.
    """
    out = bytearray()
    at, end = 0, len(data)
    while at < end:
        control = data[at]
        at += 1
        if control < 32:
            literal = data[at : at + control + 1]
            if len(literal) <= control:
                raise ValueError("compressed data end in the middle of a run")
            out += literal
            at += control + 1
        else:
            length = control >> 5
            if at + (length == 7) >= end:
                raise ValueError("compressed data end in the middle of a repetition")
            if length == 7:
                length += data[at]
                at += 1
            begin = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _repeat(out, begin, length + 2)
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes instead of {size}")
    return bytes(out)


def _repeat(out: bytearray, begin: int, count: int) -> None:
    """Append ``count`` bytes from ``begin`` on, which may overlap the appended ones."""
    if not 0 <= begin < len(out):
        raise ValueError("a repetition that starts before the first byte")
    piece = bytes(out[begin : begin + count])
    while len(piece) < count:  # an overlapping run repeats itself
        piece = (piece + piece)[:count]
    out += piece
