"""Convert the values of a calibration to arrays: camera matrices by rows, vectors of few lengths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.sensor.transforms import is_rotation

#: longest rotation vector [rad]; that of Rodrigues' formula is up to pi, of an adjustment a little more
_LONGEST_VECTOR = 3.5


@dataclass(frozen=True)
class Composed:
    """A ``value`` in OpenCV's form, the dotted names of its ``sources``, and the ``table`` that qualifies it."""

    value: NDArray[np.float64]
    sources: tuple[str, ...]
    table: dict[str, Any]


def dotted(*names: str) -> str:
    """Return names joined by dots, without the empty ones."""
    return ".".join(name for name in names if name)


def vector(value: Any, size: int | None = None) -> NDArray[np.float64] | None:
    """Return a value as finite numbers (n,), by rows; None if it is anything else, or has another ``size``."""
    if value is None:
        return None
    try:
        numbers = np.asarray(value, float).reshape(-1)
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers if np.isfinite(numbers).all() and (size is None or len(numbers) == size) else None


def number_of(value: Any) -> float:
    """Return a value as a number; NaN of what is none, which the check of the matrix refuses."""
    numbers = vector(value, 1)
    return float("nan") if numbers is None else float(numbers[0])


def numbers_of(value: Any, file: Path, key: str, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """Convert a matrix or lists to an array of one of several shapes; row and column vectors are equivalent.

    Raises InputError if it has another shape, or numbers that are not finite.

    Parameters
    ----------
    value
        As the file has it.
    file, key
        File and name of the value, for messages.
    shapes
        Those that are allowed, the vectors first.
    """
    try:
        values = np.asarray(value, float)
    except (ValueError, TypeError, OverflowError):
        values = np.array(math.nan)
    vector = len(shapes[0]) == 1
    numbers = values.reshape(-1) if vector and values.ndim and values.size == max(values.shape) else values
    if numbers.shape not in shapes or not np.isfinite(numbers).all():
        if vector and values.ndim and values.size == 0 and (0,) in shapes:
            return np.empty(0)
        allowed = " or ".join(" x ".join(map(str, shape)) for shape in shapes) + " finite numbers"
        raise InputError(file, key, _shown(value, values), allowed)
    return numbers


def _shown(value: Any, values: NDArray[np.float64]) -> str:
    """Return a value that cannot be used, for a message: few numbers as they are, the size of many."""
    if isinstance(value, dict):
        return f"a map of {', '.join(list(value)[:6])}"
    if values.ndim and values.size <= 16 and not np.isfinite(values).all():
        return str(values.tolist())
    return f"an array of {' x '.join(map(str, values.shape))}" if values.ndim else "something else"


def by_rows(K: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return K (3, 3) by rows, and whether it is written by columns, as Open3D does.

    ``K`` may have nine numbers, or four: fx, fy, cx, cy.
    """
    if K.size == 4:
        fx, fy, cx, cy = K.ravel()
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), False
    K = K.reshape(3, 3)
    by_columns = bool((K[:, 2] == (0, 0, 1)).all() and K[2, :2].all())
    return (K.T if by_columns else K), by_columns


def skew_beside(table: dict[str, Any], fx: float) -> float:
    """Return the skew [px] that stands beside a camera matrix with the focal length ``fx`` [px]; 0 without one.

    ``alpha_c`` is that of Bouguet's toolbox, skew over fx.
    """
    for name, value in table.items():
        unit = {"skew": 1.0, "s": 1.0, "alpha_c": fx}.get(name.lower())
        if unit is not None and (skew := vector(value, 1)) is not None and skew[0]:
            return float(unit * skew[0])
    return 0.0


def checked_matrix(K: NDArray[np.float64], name: str, file: str, skew: float = 0.0) -> NDArray[np.float64]:
    """Return K (3, 3), the matrix of the eye ``name`` in a ``file``, after a check that it is a camera matrix.

    ``skew``: that beside K [px]. Raises InputError if there is a skew, or K is no camera matrix by rows.
    """
    skew = float(K[0, 1]) or skew
    if abs(skew) > 1e-9 and K[0, 0] > 0:
        hint = "calibrate without skew: est_alpha = 0 in MATLAB's toolbox, no B2 in Metashape"
        raise InputError(file, f"matrix of {name}", f"a skew of {skew:.3g} px", "fx 0 cx, 0 fy cy, 0 0 1", hint)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs([K[1, 0], *(K[2] - [0, 0, 1])]).max() > 1e-9:
        raise InputError(file, f"matrix of {name}", np.round(K, 3).tolist(), "fx 0 cx, 0 fy cy, 0 0 1")
    return K


def rotation_matrix(R: NDArray[np.float64], name: str, file: str, by_columns: bool) -> NDArray[np.float64]:
    """Return R (3, 3) by rows, of a rotation vector or of nine numbers, after a check that it is a rotation.

    - ``R``: as the file has it.
    - ``name``, ``file``: the eye and the file, for messages.
    - ``by_columns``: whether the camera matrix in the file is written by columns. Then the order of R is not known.

    Raises InputError if it is no rotation, or the transposed one is as likely.
    """
    field = f"rotation of {name}"
    if R.size == 3:
        if np.linalg.norm(R) > _LONGEST_VECTOR:
            hint = "write a matrix of nine numbers, or the vector of cv2.Rodrigues"
            raise InputError(file, field, R.reshape(3).tolist(), "a rotation vector in rad, up to pi", hint)
        return np.asarray(Rotation.from_rotvec(R.reshape(3)).as_matrix())
    R = R.reshape(3, 3)
    if not is_rotation(R, 1e-4):
        raise InputError(file, field, np.round(R, 4).tolist(), "a rotation matrix, 3 x 3, by rows")
    if by_columns:
        found = "a rotation of unknown order beside a camera matrix by columns"
        raise InputError(file, field, found, "both by rows", "write both by rows: K[0][2] is cx")
    return R
