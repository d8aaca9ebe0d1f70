"""Read values of other programs' JSON by their paths; errors name the missing or invalid field."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.documents import shown
from characterisation.files.errors import InputError
from mitsim.sensor.transforms import is_rotation


def parsed_json(
    data: bytes, where: str | Path, expected: str, constant: Callable[[str], Any] = lambda name: None
) -> Any:
    """Return the value of a JSON text in UTF-8.

    Raises InputError if it is not JSON.

    Parameters
    ----------
    data, where, expected
        The text; for messages its file, and what it should be.
    constant
        Returns the value of ``NaN`` and of the infinities, which JSON does not have; by default null.
    """
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=constant)
    except (ValueError, RecursionError) as error:
        raise InputError(where, "", f"text that is not JSON ({error})", expected) from None


class JsonFields:
    """Values below ``root`` by paths of keys; ``base`` precedes the path in messages."""

    def __init__(self, root: Any, where: str | Path, base: str = "", separator: str = ".") -> None:
        self.root, self.where, self.base, self.separator = root, where, base, separator

    def get(self, path: str, default: Any = None) -> Any:
        """Return the value at a path, or ``default`` without one."""
        node = self.root
        for key in path.split(self.separator):
            if not isinstance(node, dict) or key not in node:
                return default
            node = node[key]
        return node

    def has(self, path: str) -> bool:
        """Return whether a path has a value other than null."""
        return self.get(path) is not None

    def text(self, path: str) -> str:
        """Return the text at a path."""
        value = self.get(path)
        if not isinstance(value, str):
            raise self.fault(path, "a text")
        return value

    def integer(self, path: str, low: int, high: int) -> int:
        """Return the whole number at a path, ``low`` to ``high``."""
        value = self.get(path)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self.fault(path, f"a whole number, {low} to {high}")
        return value

    def numbers(self, path: str, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
        """Return the finite numbers at a path, as stored; None in ``shape`` allows any length."""
        try:
            values = np.asarray(self.get(path))
        except ValueError:  # lists of unequal lengths
            values = np.array(None)
        fits = values.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, values.shape, strict=True))
        if values.dtype.kind not in "iuf" or not fits or not (np.abs(values.astype(float)) <= 1e9).all():
            size = " x ".join("n" if n is None else str(n) for n in shape)
            raise self.fault(path, f"{size} finite numbers" if shape else "a finite number")
        return values.astype(np.float64)

    def rotation(self, path: str, tolerance: float, *, by_columns: bool = False) -> NDArray[np.float64]:
        """Return the rotation (3, 3) nearest to the matrix at a path, which is stored with few digits."""
        stored = self.numbers(path, (3, 3))
        matrix = nearest_rotation(stored.T if by_columns else stored, tolerance)
        if matrix is None:
            raise self.fault(path, f"a rotation matrix, by {'columns' if by_columns else 'rows'}")
        return matrix

    def fault(self, path: str, allowed: str) -> InputError:
        """Return an error about a missing or invalid field."""
        value = self.get(path)
        found = "nothing" if value is None else shown(value, self.where)
        return InputError(self.where, self.base + path, found, allowed)


def nearest_rotation(matrix: NDArray[np.float64], tolerance: float) -> NDArray[np.float64] | None:
    """Return the exact rotation nearest to a matrix (3, 3); None if it is farther from one than ``tolerance``."""
    if not is_rotation(matrix, tolerance):
        return None
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)
