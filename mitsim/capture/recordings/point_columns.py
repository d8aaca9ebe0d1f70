"""Check that the first three of several columns without names are x, y and z."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: most columns of a point: x, y, z, colour, normal and some values more; a row of depths has more. Chosen
_MOST_COLUMNS = 24


def check_points_first(table: NDArray[Any], path: str | Path, hint: str) -> None:
    """Check that a table (n, columns) without names has x, y and z first.

    Numbers of a row, or of a row and a column, are whole, and three of a colour up to 255; three columns after them
    that are not, or that do not vary, are x, y and z. A table of very many columns is a map of depths. Raises
    InputError if the first one or two columns count, the first three are colours, or the columns are too many. ``hint``
    says what to do about the first two.
    """
    if table.shape[1] > _MOST_COLUMNS:
        found = f"{table.shape[1]} columns without names, as of a map of depths"
        of_maps = "save depths by np.save as rows x columns, and mitsim import them with their camera: --calibration"
        raise InputError(path, "", found, f"x, y and z first, and up to {_MOST_COLUMNS} columns, or names", of_maps)
    sample = table[np.linspace(0, len(table) - 1, min(1000, len(table))).astype(np.intp)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    whole = (sample % 1 == 0).all(axis=0) if len(sample) else np.ones(table.shape[1], bool)
    varies = (sample != sample[:1]).any(axis=0) if len(sample) else ~whole
    for count in (1, 2, 3):
        if table.shape[1] < count + 3:
            continue
        if count == 3 and not (
            ((sample[:, :3] >= 0) & (sample[:, :3] <= 255)).all() and np.abs(sample[:, 3:6]).max() > 1
        ):
            continue  # whole coordinates, or normals after them
        lengths = (~whole)[count : count + 3].sum() >= 2 and not (whole & varies)[count : count + 3].any()
        if whole[:count].all() and varies[:count].any() and lengths:
            counting = ("the first seems to count", "the first two seem to count", "the first three seem to be colours")
            found = f"{table.shape[1]} columns without names, of which {counting[count - 1]}"
            raise InputError(path, "", found, "x, y and z first, or names", hint)
