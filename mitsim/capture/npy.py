"""Read and write arrays as NumPy's ``.npy`` files, and check all that is read.

Pickled objects are rejected, and so are files whose size differs from that in the header. The format is described in
NEP 1 (numpy.org/neps/nep-0001-npy-format.html).
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.png import LONGEST_SIDE_PX

#: allowed types of the values of a map
DTYPES = ("uint8", "uint16", "int16", "float32")

_LONGEST_HEADER = 1000


def encode_npy(values: NDArray[Any]) -> bytes:
    """Return an array as the bytes of an ``.npy`` file, version 1.0."""
    stream = io.BytesIO()
    npy_format.write_array(stream, np.ascontiguousarray(values), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def decode_npy(data: bytes, where: str | Path) -> NDArray[Any]:
    """Return the map (H, W) or (H, W, channels) in the bytes of an ``.npy`` file; messages name ``where``.

    Raises
    ------
    InputError
        If the bytes are not a complete file of version 1.0, or the values are not of :data:`DTYPES`, little-endian and
        by rows. Also if a side is longer than :data:`~mitsim.sensor.png.LONGEST_SIDE_PX`.
    """
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"version {version[0]}.{version[1]}")
        shape, by_columns, dtype = npy_format.read_array_header_1_0(stream, max_header_size=_LONGEST_HEADER)
    except Exception as error:  # NumPy parses the header as Python text, which can fail in many ways
        raise InputError(where, "", f"a file that is not .npy ({error})", "a complete .npy file, version 1.0") from None
    if dtype.newbyteorder("=").name not in DTYPES or dtype.byteorder == ">" or by_columns:
        raise InputError(where, "dtype", f"{dtype.str}{', by columns' * by_columns}", ", ".join(DTYPES) + ", by rows")
    if len(shape) not in (2, 3) or not all(1 <= side <= LONGEST_SIDE_PX for side in shape):
        raise InputError(where, "shape", shape, f"rows, columns and, if any, channels, up to {LONGEST_SIDE_PX} each")
    body, expected = data[stream.tell() :], int(np.prod(shape)) * dtype.itemsize
    if len(body) != expected:
        raise InputError(where, "size", f"{len(body)} bytes of values", f"{expected} bytes, as stated in the header")
    return np.frombuffer(body, dtype).reshape(shape)
