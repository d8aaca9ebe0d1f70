"""Read Zivid's ``.zdf``: points, colour and signal-to-noise ratio of every pixel, and the camera's matrix, if any.

Signal chain: netCDF-4 file -> in a process of its own, the variables by name -> arrays.

Zivid's samples (zivid-python-samples, ``read_zdf_without_zivid.py``) state the names in the group ``data``:
``pointcloud`` (H, W, 3) float32 [mm], NaN where missing; ``rgba_image`` (H, W, 4) uint8; ``snr``, before it
``contrast``, (H, W). They do not state where the matrix of the camera is: a matrix of 3 x 3 is taken whose name says
*camera matrix* or *intrinsics*, with a *distortion* beside it, or the numbers FX, FY, CX, CY, and K1, K2, P1, P2, K3 by
which Zivid's own calibration files state it. HDF5 may hang or crash on a damaged file; the process of
its own ends alone.
"""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError

#: first bytes of a netCDF-4 file, which is HDF5
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"

#: time limit [s] of the process that reads a file
PATIENCE_S = 60.0

#: largest cloud [points]
_MOST_POINTS = 1 << 25

_PROGRAM = r"""
import sys, netCDF4, numpy as np
most, found, matrices, lenses, numbers = int(sys.argv[2]), {}, [], [], {}
names = "pointcloud xyz x y z snr contrast rgba_image rgb_image".split()

def values(one, name):
    if int(np.prod(one.shape, dtype=float)) > most * 4:
        sys.exit(f"TOO LARGE {name}: {' x '.join(map(str, one.shape))}")
    return np.asarray(one[...])

def search(group):
    for name, one in group.variables.items():
        low = name.lower()
        if one.dtype is str or one.dtype.kind not in "fiu":
            continue
        if low in names and low not in found:
            found[low] = values(one, name)
        elif one.shape == (3, 3) and ("matrix" in low or "intrinsic" in low) and "transform" not in low:
            matrices.append(values(one, name))
        elif "distortion" in low and one.ndim == 1 and one.shape[0] in (4, 5, 8, 12, 14):
            lenses.append(values(one, name))
        elif one.ndim == 0:
            numbers.setdefault(low, float(one[...]))
    for name in group.ncattrs():
        value = np.asarray(group.getncattr(name))
        if value.size == 1 and value.dtype.kind in "fiu":
            numbers.setdefault(name.lower(), float(value.ravel()[0]))
    for inner in group.groups.values():
        search(inner)

with netCDF4.Dataset(sys.argv[1]) as file:
    file.set_auto_maskandscale(False)
    search(file)
if not matrices and {"fx", "fy", "cx", "cy"} <= set(numbers):
    fx, fy, cx, cy = (numbers[name] for name in ("fx", "fy", "cx", "cy"))
    matrices.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    lenses.append(np.array([numbers.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]))
if matrices:
    found["matrix"] = matrices[0]
if lenses:
    found["distortion"] = lenses[0]
np.savez(sys.stdout.buffer, **found)
"""


@dataclass(frozen=True)
class Zdf:
    """Content of a ``.zdf``.

    - ``points`` (H, W, 3) as in the file, NaN where missing.
    - ``colour`` (H, W, 3) uint8, red first, and ``snr`` (H, W); None without.
    - ``matrix`` (3, 3) [px] and ``distortion`` (n,) of the camera; None without.
    """

    points: NDArray[np.float32]
    colour: NDArray[np.uint8] | None = None
    snr: NDArray[np.float32] | None = None
    matrix: NDArray[np.float64] | None = None
    distortion: NDArray[np.float64] | None = None


def read_zdf(path: Path) -> Zdf:
    """Read a ``.zdf`` file.

    Raises
    ------
    InputError
        If it is no netCDF-4 file, is damaged or too large, or has no point cloud.
    """
    expected = "a .zdf file of Zivid"
    if read_bounded(path, expected, first=len(HDF5_MAGIC)) != HDF5_MAGIC:
        raise InputError(path, "", "a file that is not netCDF-4", expected, "save it again in Zivid Studio")
    arrays = _arrays(path, expected)
    points = arrays.get("pointcloud", arrays.get("xyz"))
    if points is None and {"x", "y", "z"} <= set(arrays):
        axes = [arrays[axis] for axis in "xyz"]
        points = np.stack(axes, axis=-1) if len({array.shape for array in axes}) == 1 else None
    if points is None or points.ndim != 3 or points.shape[2] != 3 or points.dtype.kind != "f":
        shapes = ", ".join(f"{name} {' x '.join(map(str, array.shape))}" for name, array in arrays.items())
        raise InputError(path, "data/pointcloud", shapes or "nothing", "points of rows x columns x 3")
    size = points.shape[:2]
    colour = arrays.get("rgba_image", arrays.get("rgb_image"))
    snr = arrays.get("snr", arrays.get("contrast"))
    matrix, lens = arrays.get("matrix"), arrays.get("distortion")
    with np.errstate(over="ignore", invalid="ignore"):
        return Zdf(
            points.astype(np.float32),
            None if colour is None or colour.dtype != np.uint8 or colour.shape[:2] != size else colour[..., :3],
            None if snr is None or snr.shape != size else snr.astype(np.float32),
            None if matrix is None else matrix.astype(np.float64),
            None if lens is None else lens.astype(np.float64),
        )


def _arrays(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    command = [sys.executable, "-I", "-c", _PROGRAM, str(path.resolve()), str(_MOST_POINTS)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        raise InputError(path, "", f"a file that is not read within {PATIENCE_S:g} s", expected) from None
    if done.returncode:
        last = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2][:160]
        if last.startswith("TOO LARGE"):
            raise InputError(path, "size", last.removeprefix("TOO LARGE "), f"up to {_MOST_POINTS} points")
        hint = "copy it again, or save it again in Zivid Studio"
        raise InputError(path, "", f"a file that cannot be read ({last or 'the reader ended'})", expected, hint)
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
