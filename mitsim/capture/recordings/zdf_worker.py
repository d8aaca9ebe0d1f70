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


class Found:
    """The variables of a file: ``arrays`` of pixels by name, cameras' ``matrices`` and ``lenses``, single ``numbers``.

    An array has at most 4 ``most`` values.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.arrays: dict[str, NDArray[Any]] = {}
        self.matrices: list[NDArray[Any]] = []
        self.lenses: list[NDArray[Any]] = []
        self.numbers: dict[str, float] = {}

    def search(self, group: Any) -> None:
        """Add the variables of a group, and of the groups in it."""
        for name, variable in group.variables.items():
            low = name.lower()
            if variable.dtype is str or variable.dtype.kind not in "fiu":
                continue
            if low in NAMES and low not in self.arrays:
                self.arrays[low] = self.values(variable, name)
            elif variable.shape == (3, 3) and ("matrix" in low or "intrinsic" in low) and "transform" not in low:
                self.matrices.append(self.values(variable, name))
            elif "distortion" in low and variable.ndim == 1 and variable.shape[0] in (4, 5, 8, 12, 14):
                self.lenses.append(self.values(variable, name))
            elif variable.ndim == 0:
                self.numbers.setdefault(low, float(variable[...]))
        for name in group.ncattrs():
            value = np.asarray(group.getncattr(name))
            if value.size == 1 and value.dtype.kind in "fiu":
                self.numbers.setdefault(name.lower(), float(value.ravel()[0]))
        for inner in group.groups.values():
            self.search(inner)

    def values(self, variable: Any, name: str) -> NDArray[Any]:
        """Return the values of a variable; end the process if they are too many."""
        if int(np.prod(variable.shape, dtype=float)) > self.most * 4:
            sys.exit(f"TOO LARGE {name}: {' x '.join(map(str, variable.shape))}")
        return np.asarray(variable[...])


def read(path: str, most: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name, and ``matrix`` and ``distortion`` of its camera, if any."""
    found = Found(most)
    with netCDF4.Dataset(path) as file:
        file.set_auto_maskandscale(False)
        found.search(file)
    numbers = found.numbers
    if not found.matrices and {"fx", "fy", "cx", "cy"} <= set(numbers):
        fx, fy, cx, cy = (numbers[name] for name in ("fx", "fy", "cx", "cy"))
        found.matrices.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        found.lenses.append(np.array([numbers.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]))
    if found.matrices:
        found.arrays["matrix"] = found.matrices[0]
    if found.lenses:
        found.arrays["distortion"] = found.lenses[0]
    return found.arrays


if __name__ == "__main__":
    np.savez(sys.stdout.buffer, **read(sys.argv[1], int(sys.argv[2])))  # type: ignore[arg-type]
