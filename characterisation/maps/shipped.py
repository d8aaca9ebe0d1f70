"""The performance maps that come with the software: one file for each sensor, in ``characterisation/maps``.

A command that wants a map takes the path of one, or the name of a sensor whose map is there.
"""

from __future__ import annotations

from pathlib import Path

from characterisation.checked_files import is_file
from characterisation.errors import InputError, nearest

FOLDER = Path(__file__).parent


def shipped_maps() -> dict[str, Path]:
    """Files of the maps by the names of their sensors."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.nc"))}


def map_path(name: str | Path, here: str | Path = ".") -> Path:
    """The file that is meant: a path, relative to ``here``, or the name of a sensor with a map of its own.

    Raises
    ------
    InputError
        If there is neither.
    """
    path = Path(here) / name
    if is_file(path):
        return path
    known = shipped_maps()
    if str(name) in known:
        return known[str(name)]
    allowed = f"a performance map (map.nc) made by mitsim characterise, or one of {', '.join(known) or 'none'}"
    raise InputError(path, "", "no such file", allowed, nearest(str(name), list(known)))
