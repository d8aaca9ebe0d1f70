"""Keep the results of a talk: one netCDF file for each piece of work, with the digest of all that it depends on.

A result is used if its digest is that of the piece now planned. Results in the output folder come first, then those
that come with the talk's file. ``any_version`` also uses results of other digests, as long as they have this format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from characterisation.files.atomic_io import write_netcdf
from characterisation.files.datasets import Schema, read_dataset

#: version of the format; results of another one are made again
VERSION = 1

_ANY = Schema("a kept result of mitsim study talk", {}, hint="remove it, and run mitsim study talk again")

#: number of values from which an array is compressed
_LONG = 50


class Results:
    """Results of the pieces of a talk by their names, in ``folder`` and, read only, in ``fallbacks``."""

    def __init__(self, folder: Path, fallbacks: tuple[Path, ...] = (), any_version: bool = False) -> None:
        self.folder, self.fallbacks, self.any_version = folder, fallbacks, any_version
        self.digests: dict[str, str] = {}
        self._known: dict[str, xr.Dataset] = {}

    def get(self, name: str) -> xr.Dataset | None:
        """Return the result of a piece, or None if it is missing or depends on something that has changed."""
        if name not in self._known and (result := self._read(name)) is not None:
            self._known[name] = result
        return self._known.get(name)

    def add(self, name: str, data: xr.Dataset) -> None:
        """Keep the result of a piece in the output folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        marked = data.assign_attrs(version=VERSION, digest=self.digests.get(name, ""))
        encoding = {
            variable: {"zlib": True, "complevel": 9, "shuffle": True}
            for variable, values in marked.variables.items()
            if values.dtype.kind in "fiu" and values.size > _LONG
        }
        write_netcdf(_narrow(marked), self.folder / f"{name}.nc", encoding)
        self._known[name] = marked

    def _read(self, name: str) -> xr.Dataset | None:
        for path in (folder / f"{name}.nc" for folder in (self.folder, *self.fallbacks)):
            data = read_dataset(path, _ANY) if path.exists() else xr.Dataset()
            same = self.any_version or data.attrs.get("digest") == self.digests.get(name)
            if same and data.attrs.get("version") == VERSION:
                return data
        return None


def _narrow(data: xr.Dataset) -> xr.Dataset:
    """Return the dataset with long arrays of doubles in single precision."""
    out = data.copy()
    for name, values in data.data_vars.items():
        if values.dtype == np.float64 and values.size > _LONG:
            out[name] = values.astype(np.float32)
    return out
