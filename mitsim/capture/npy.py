"""Read and write arrays as NumPy's ``.npy`` files, and check all that is read. Pickled objects are rejected."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError, in_one_line
from mitsim.sensor.png import LONGEST_SIDE_PX

#: first bytes of an ``.npy`` file
NPY_MAGIC = b"\x93NUMPY"

#: allowed types of the values of a map
DTYPES = ("uint8", "uint16", "int16", "float32")


def encode_npy(values: NDArray[Any]) -> bytes:
    """Return an array as the bytes of an ``.npy`` file, version 1.0."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(values), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def numbers_of_npy(data: bytes, where: str | Path, *, tables: bool = False) -> NDArray[Any]:
    """Return the array in the bytes of an ``.npy`` file of any version, type and order, by rows.

    ``tables``: whether its entries may have named fields. Raises InputError if the bytes are not a complete file of
    numbers.
    """
    stream = io.BytesIO(data)
    try:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.tell() != len(data):
            raise ValueError("bytes beyond the array")
    except Exception as error:  # NumPy raises many types of errors for damaged files
        reason = in_one_line(error, 120)
        hint = "np.save writes such a file, np.savez an archive"
        raise InputError(where, "", f"an unreadable file ({reason})", "a .npy file with numbers", hint) from None
    if array.dtype.kind not in "fiu" and not (tables and array.dtype.names):
        raise InputError(where, "dtype", str(array.dtype), "real numbers")
    return np.ascontiguousarray(array)


def decode_npy(data: bytes, where: str | Path) -> NDArray[Any]:
    """Return the map (H, W) or (H, W, channels), of little-endian :data:`DTYPES`, in the bytes of an ``.npy`` file."""
    values = numbers_of_npy(data, where)
    if values.dtype.newbyteorder("=").name not in DTYPES or values.dtype.byteorder == ">":
        raise InputError(where, "dtype", values.dtype.str, ", ".join(DTYPES))
    if values.ndim not in (2, 3) or not all(1 <= side <= LONGEST_SIDE_PX for side in values.shape):
        allowed = f"rows, columns and, if any, channels, up to {LONGEST_SIDE_PX} each"
        raise InputError(where, "shape", values.shape, allowed)
    return values
