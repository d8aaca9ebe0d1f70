"""Read Zivid's ``.zdf``: points, colour and signal-to-noise ratio of every pixel, and the camera's matrix, if any.

Signal chain: netCDF-4 file -> the variables by name (:mod:`mitsim.capture.recordings.zdf_worker`) -> arrays.

Zivid's samples (zivid-python-samples, ``read_zdf_without_zivid.py``) state the names in the group ``data``:
``pointcloud`` (H, W, 3) float32 [mm], NaN where missing; ``rgba_image`` (H, W, 4) uint8; ``snr``, before it
``contrast``, (H, W). They do not state where the matrix of the camera is: a matrix of 3 x 3 is taken whose name says
*camera matrix* or *intrinsics*, with a *distortion* beside it, or the numbers FX, FY, CX, CY, and K1, K2, P1, P2, K3 by
which Zivid's own calibration files state it.
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

#: program that reads the variables of a file
_WORKER = Path(__file__).with_name("zdf_worker.py")


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
    """Read a ``.zdf`` file."""
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
    command = [sys.executable, "-I", str(_WORKER), str(path.resolve()), str(_MOST_POINTS)]
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
