"""Read arrays of numbers that other programs saved as NumPy's ``.npy``, of any version, type and order."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: first bytes of an ``.npy`` file
NPY_MAGIC = b"\x93NUMPY"


def numbers_of_npy(data: bytes, where: str | Path) -> NDArray[Any]:
    """Return the array in the bytes of an ``.npy`` file, by rows.

    Raises
    ------
    InputError
        If the bytes are not a complete file of numbers.
    """
    try:
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # NumPy raises many types of errors for damaged files
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        hint = "np.save writes such a file, np.savez an archive"
        raise InputError(where, "", f"an unreadable file ({reason})", "a .npy file with numbers", hint) from None
    if array.dtype.kind not in "fiu":
        raise InputError(where, "dtype", str(array.dtype), "real numbers")
    return np.ascontiguousarray(array)
