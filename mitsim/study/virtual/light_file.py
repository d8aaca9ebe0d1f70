"""Pass the traced interreflections of a view to the workers of this machine, in a file of the run's folder.

Signal chain: a view with several orders of trials -> this process traces its paths on all cores, while workers wait ->
file -> every worker reads it, where each would trace the same paths on its share of the cores.

The file's name is that of a partial file (:mod:`characterisation.files.atomic_io`), so the next command removes it if
this one is killed. A worker that cannot read it traces the paths itself; they are the same.
"""

from __future__ import annotations

import weakref
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.atomic_io import beside
from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.kept_light import KeptLight
from mitsim.scene.light_transport.kept_paths import KeptPaths


class LightFile:
    """The file of one view's light, in a folder; that of the view before is removed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._view: int | None = None
        self._path: Path | None = None
        self._remove: Callable[[], object] = lambda: None

    def of(self, view: int, light: Mapping[str, KeptLight]) -> Path | None:
        """Return the file of a view's light by camera, written unless it is the last one; None if it cannot be."""
        if view != self._view:
            self._remove()
            self._view, self._path = view, None
            path = beside(self._folder / "light.npz", "partial")
            self._remove = weakref.finalize(self, path.unlink, missing_ok=True)
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                _write(path, light)
                self._path = path
            except OSError:  # such as a full disk, whose space the trials need
                self._remove()
        return self._path


def _write(path: Path, light: Mapping[str, KeptLight]) -> None:
    arrays = dict[str, NDArray[Any]]()
    for number, kept in enumerate(light.values()):
        arrays |= {f"{number}_{name}": values for name, values in kept.paths.arrays().items()}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # of names that are no argument


def read_light(path: str | None, rois: Mapping[str, Roi]) -> dict[str, KeptPaths] | None:
    """Return the paths of each camera's region from a :class:`LightFile`; None if there is none, or it is damaged."""
    if path is None:
        return None
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            names = [name.removeprefix("0_") for name in arrays.files if name.startswith("0_")]
            return {
                camera: KeptPaths({name: arrays[f"{number}_{name}"] for name in names}, roi)
                for number, (camera, roi) in enumerate(rois.items())
            }
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
