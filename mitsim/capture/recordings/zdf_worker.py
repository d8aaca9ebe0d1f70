"""Read the variables of a ``.zdf`` in a process of its own, since HDF5 may hang or crash on a damaged file.

::

    python -I zdf_worker.py CLOUD.zdf MOST_POINTS > OUT.npz

It imports nothing of ``mitsim``, so that it starts quickly.
"""

from __future__ import annotations

import sys
from typing import Any

import netCDF4
import numpy as np
from numpy.typing import NDArray

#: variables of pixels
NAMES = ("pointcloud", "xyz", "x", "y", "z", "snr", "contrast", "rgba_image", "rgb_image")


def _search(group: Any, most: int, arrays: dict[str, NDArray[Any]], numbers: dict[str, float]) -> None:
    """Add the arrays of a group and its groups, the first ``matrix`` and ``distortion``, and the single numbers.

    The process ends if an array has more than 4 ``most`` values.
    """
    for name, variable in group.variables.items():
        low = key = name.lower()
        if variable.dtype is str or variable.dtype.kind not in "fiu":
            continue
        if low not in NAMES or low in arrays:
            if variable.shape == (3, 3) and ("matrix" in low or "intrinsic" in low) and "transform" not in low:
                key = "matrix"
            elif "distortion" in low and variable.ndim == 1 and variable.shape[0] in (4, 5, 8, 12, 14):
                key = "distortion"
            elif variable.ndim == 0:
                numbers.setdefault(low, float(variable[...]))
                continue
            else:
                continue
        if int(np.prod(variable.shape, dtype=float)) > most * 4:
            sys.exit(f"TOO LARGE {name}: {' x '.join(map(str, variable.shape))}")
        arrays.setdefault(key, np.asarray(variable[...]))
    for name in group.ncattrs():
        value = np.asarray(group.getncattr(name))
        if value.size == 1 and value.dtype.kind in "fiu":
            numbers.setdefault(name.lower(), float(value.ravel()[0]))
    for inner in group.groups.values():
        _search(inner, most, arrays, numbers)


def read(path: str, most: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name, and ``matrix`` and ``distortion`` of its camera, if any."""
    arrays: dict[str, NDArray[Any]] = {}
    numbers: dict[str, float] = {}
    with netCDF4.Dataset(path) as file:
        file.set_auto_maskandscale(False)
        _search(file, most, arrays, numbers)
    if "matrix" not in arrays and {"fx", "fy", "cx", "cy"} <= set(numbers):
        fx, fy, cx, cy = (numbers[name] for name in ("fx", "fy", "cx", "cy"))
        arrays["matrix"] = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        lens = np.array([numbers.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
        arrays.setdefault("distortion", lens)
    return arrays


if __name__ == "__main__":
    np.savez(sys.stdout.buffer, **read(sys.argv[1], int(sys.argv[2])))  # type: ignore[arg-type]
