"""Find the performance maps that come with the software: one file for each sensor, in ``characterisation/maps``.

A command that needs a map takes the path of one, or the name of a sensor with a map here.
"""

from __future__ import annotations

from pathlib import Path

from characterisation.files.checked_files import is_file
from characterisation.files.errors import InputError, nearest

FOLDER = Path(__file__).parent


def shipped_maps() -> dict[str, Path]:
    """Return the files of the maps by the names of their sensors."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.nc"))}


def map_path(name: str | Path, folder: str | Path = ".") -> Path:
    """Return the file of a map, given as a path relative to ``folder``, or as the name of a sensor with a shipped map.

    Raises InputError if there is neither.
    """
    path = Path(folder) / name
    if is_file(path):
        return path
    maps = shipped_maps()
    if str(name) in maps:
        return maps[str(name)]
    allowed = f"a performance map (map.nc) made by mitsim map make, or one of {', '.join(maps) or 'none'}"
    raise InputError(path, "", "no such file", allowed, nearest(str(name), list(maps)))
