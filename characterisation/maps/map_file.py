"""Write and read the netCDF file of a performance map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.atomic_io import write_netcdf
from characterisation.files.datasets import Schema, Variable, read_dataset
from characterisation.files.errors import InputError
from characterisation.maps.lay import LAY_FIELDS, LAY_NODES
from characterisation.maps.lay import SCHEMA as LAY_SCHEMA
from characterisation.maps.light import SCHEMA as LIGHT_SCHEMA
from characterisation.maps.light import lights_of
from characterisation.maps.tables import FIELDS

#: version of the files
SCHEMA_VERSION = 2

#: bits of the mantissa of values that a compact file keeps: relative errors of at most 2^-11
VALUE_BITS = 10

#: bits of the mantissa of errors that a compact file keeps: relative errors of at most 2^-6
ERROR_BITS = 5

_NODES = ("sample", "distance", "b", "a")

_ROUNDED_FINELY = (*FIELDS[:2], *(LAY_FIELDS[name] for name in FIELDS[:2]))

_SCHEMA = Schema(
    "a performance map (map.nc) made by mitsim map make",
    {
        **{
            name: Variable(_NODES, low=0.0, high=1e9, gaps=True, needed=name in FIELDS[:4])
            for name in (*FIELDS, "false_fraction", "patches", "noise_area", "persistent_share")
        },
        "recovered_fraction": Variable(_NODES, low=0.0, high=1.0 + 1e-6, gaps=True),
        "bias_share": Variable(_NODES, low=-1e9, high=1e9, gaps=True, needed=False),
        "finish": Variable(("sample",), "text"),
        "roughness": Variable(("sample",), low=1e-6, high=1e6, gaps=True),
        "distance": Variable(("distance",), low=1e-3, high=1e9),
        "a": Variable(("a",), low=-2.0, high=2.0),
        "b": Variable(("b",), low=-2.0, high=2.0),
        **LIGHT_SCHEMA,
        **LAY_SCHEMA,
    },
    {"sample": (1, 10_000), "distance": (1, 10_000), "a": (2, 10_000), "b": (2, 10_000), "lay": (2, 180)},
)


def write_map(data: xr.Dataset, path: str | Path, compact: bool) -> None:
    """Write a map atomically.

    With ``compact`` the file is compressed, after rounding values to ``VALUE_BITS`` and errors to ``ERROR_BITS`` of the
    mantissa (Zender, Geosci. Model Dev. 9 (2016) 3199-3211; rounded to nearest). It is read like any other.
    """
    # most samples of a map have no lay, and NaN there
    encoding: dict[str, Any] = {name: {"zlib": True, "complevel": 1} for name in LAY_FIELDS.values() if name in data}
    if compact:
        rounded = data.copy()
        for name, values in data.data_vars.items():
            if values.dims in (_NODES, LAY_NODES):
                bits = VALUE_BITS if name in _ROUNDED_FINELY else ERROR_BITS
                rounded[name] = (values.dims, _rounded(values.values, bits), values.attrs)
                encoding[str(name)] = {"zlib": True, "complevel": 9, "shuffle": True}
        data = rounded
    write_netcdf(data, path, encoding)


def read_map(path: str | Path) -> xr.Dataset:
    """Read the data of a map; raise InputError if the file is missing, damaged, no map, or of another schema."""
    path = Path(path)
    data = read_dataset(path, _SCHEMA)
    version = data.attrs.get("schema_version")
    if str(version) != str(SCHEMA_VERSION):
        hint = "read it with the version of mitsim that wrote it"
        raise InputError(path, "schema_version", repr(version), str(SCHEMA_VERSION), hint)
    _check_axes(path, data)
    return data


def _check_axes(path: Path, data: xr.Dataset) -> None:
    """Reject a map whose distances do not increase, or whose nodes are not equally spaced on both axes."""
    distance, a, b = (data[name].values.astype(float) for name in ("distance", "a", "b"))
    if (np.diff(distance) <= 0).any():
        raise InputError(path, "distance", "distances that do not increase", "increasing distances [mm]")
    step = np.diff(a)
    if len(a) != len(b) or not np.allclose(a, b, atol=1e-6) or not (step > 0).all() or np.ptp(step) > 1e-3 * step[0]:
        allowed = "equally spaced nodes, the same for a and b"
        raise InputError(path, "a", "nodes that are unequally spaced or differ from those of b", allowed)
    if "lay" in data.dims:
        lays = data["lay"].values.astype(float) if "lay" in data.variables else np.full(1, np.nan)
        if not np.allclose(lays, np.arange(len(lays)) * 180.0 / len(lays), atol=1e-6):
            raise InputError(path, "lay", f"directions of {lays} deg", "equally spaced directions, 0 to 180 deg")
    roughness, finish = data["roughness"].values, data["finish"].values
    if len(set(zip(finish, map(str, roughness), map(str, lights_of(data)), strict=True))) < len(finish):
        raise InputError(path, "finish", "a finish and Ra twice", "each sample once")
    for name in finish:
        if len({math.isnan(ra) for ra in roughness[finish == name]}) > 1:
            allowed = "all samples of a finish with Ra, or all without"
            raise InputError(path, "roughness", f"{name} with and without Ra", allowed)


def _rounded(values: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    """Return floats rounded to nearest with ``bits`` of the 23 bits of the mantissa, the rest 0."""
    whole = np.ascontiguousarray(values, np.float32)
    drop = 23 - bits
    kept = ((whole.view(np.uint32) + np.uint32(1 << (drop - 1))) >> np.uint32(drop)) << np.uint32(drop)
    return np.where(np.isfinite(whole), kept.view(np.float32), np.float32(np.nan))
