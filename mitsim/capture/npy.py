"""Arrays as NumPy's ``.npy`` files, read with suspicion: no pickles, no more bytes than the header may ask for.

The format is described in NEP 1 (numpy.org/neps/nep-0001-npy-format.html).
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from characterisation.errors import InputError
from mitsim.capture.png import LONGEST_SIDE_PX

#: types of the numbers of a map
DTYPES = ("uint8", "uint16", "int16", "float32")

_LONGEST_HEADER = 1000


def encode_npy(values: NDArray[Any]) -> bytes:
    """An array as the bytes of an ``.npy`` file, version 1.0."""
    stream = io.BytesIO()
    npy_format.write_array(stream, np.ascontiguousarray(values), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def decode_npy(data: bytes, where: str | Path) -> NDArray[Any]:
    """Map (H, W) or (H, W, channels) of an ``.npy`` file's bytes.

    Raises
    ------
    InputError
        If the bytes are no whole file of one of :data:`DTYPES`, little-endian, by rows, of a believable size.
    """
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"version {version[0]}.{version[1]}")
        shape, by_columns, dtype = npy_format.read_array_header_1_0(stream, max_header_size=_LONGEST_HEADER)
    except Exception as error:  # a header is Python's text, and fails as variously
        raise InputError(where, "", f"a file that is no .npy ({error})", "a whole .npy, version 1.0") from None
    if dtype.newbyteorder("=").name not in DTYPES or dtype.byteorder == ">" or by_columns:
        raise InputError(where, "dtype", f"{dtype.str}{', by columns' * by_columns}", ", ".join(DTYPES) + ", by rows")
    if len(shape) not in (2, 3) or not all(1 <= side <= LONGEST_SIDE_PX for side in shape):
        raise InputError(where, "shape", shape, f"rows, columns and perhaps channels, up to {LONGEST_SIDE_PX} each")
    body, wanted = data[stream.tell() :], int(np.prod(shape)) * dtype.itemsize
    if len(body) != wanted:
        raise InputError(where, "size", f"{len(body)} bytes of numbers", f"{wanted} bytes, as its header says")
    return np.frombuffer(body, dtype).reshape(shape)
