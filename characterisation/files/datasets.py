"""Read and check netCDF datasets: maps, scores, checks, samples and kept trials.

Signal chain: file -> header without values -> sizes and types checked against a :class:`Schema`, before anything large
is unpacked -> values -> checks of digest, ranges and missing numbers.

Variables that a schema does not name are read without checks, because a later version may add some.
"""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import DIGEST, SEAL, dataset_digest, is_file, read_bounded
from characterisation.files.errors import InputError, in_one_line

if TYPE_CHECKING:
    import xarray as xr

#: largest dataset that may be unpacked [bytes]
LARGEST_DATASET = 1 << 30

#: longest text in an attribute or in an element of a text variable
LONGEST_TEXT = 1 << 20

#: time limit [s] for a separate process that first reads a file without a seal
PATIENCE_S = 15.0

#: program of that process: open the file, then read its header and the first value of every variable
_PROBE = """
import sys, netCDF4
with netCDF4.Dataset(sys.argv[1]) as file:
    for variable in file.variables.values():
        variable.ncattrs(), variable.filters()
        variable[tuple(slice(0, 1) for _ in variable.dimensions)]
"""

Kind = Literal["number", "whole", "truth", "text"]

_IN_WORDS = {"number": "numbers", "whole": "whole numbers", "truth": "0 and 1", "text": "texts"}


@dataclass(frozen=True)
class Variable:
    """Requirements for one variable of a dataset.

    ``dims`` are its dimensions in order; its values lie from ``low`` to ``high``. ``gaps`` allows NaN for a missing
    number; ``needed`` says whether the variable is required.
    """

    dims: tuple[str, ...]
    kind: Kind = "number"
    low: float = -math.inf
    high: float = math.inf
    gaps: bool = False
    needed: bool = True


@dataclass(frozen=True)
class Schema:
    """Requirements for a dataset.

    ``made_by`` describes the dataset and ``hint`` says what to do about another one. ``sizes`` has the smallest and
    largest size of dimensions; ``names`` lists variables whose values must all differ.
    """

    made_by: str
    variables: Mapping[str, Variable]
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    names: Sequence[str] = ()
    hint: str = ""


def read_dataset(path: str | Path, schema: Schema) -> xr.Dataset:
    """Read a netCDF file and check it against a schema.

    Raises InputError if the file is missing, too large, not a plain netCDF file, or changed since it was written; or if
    a variable violates the schema. The error names the file and the variable.
    """
    import xarray as xr  # half a second, which commands without a dataset save

    path = Path(path)
    if not is_file(path):
        found = "something that is no file" if os.path.lexists(str(path)[:4096].replace("\0", "")) else "no such file"
        raise InputError(path, "", found, schema.made_by, schema.hint)
    _check_bytes(path, schema)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # attributes of foreign files may cause warnings
            with xr.open_dataset(path, engine="netcdf4", decode_times=False, decode_timedelta=False) as lazy:
                _check_form(path, lazy, schema)
                data = lazy.load()
    except InputError:
        raise
    except MemoryError:
        raise InputError(path, "", "more than fits into memory", schema.made_by, schema.hint) from None
    except Exception as error:  # a damaged file may raise anything
        raise _unreadable(path, schema, f"({in_one_line(f'{type(error).__name__}: {error}')})") from None
    data = data.drop_encoding()
    written = data.attrs.pop(DIGEST, None)
    if written is not None and written != dataset_digest(data):
        hint = f"copy it again; if it was changed on purpose, remove the attribute {DIGEST}"
        raise InputError(path, DIGEST, "content that differs from what was written", "an unchanged file", hint)
    _check_content(path, data, schema)
    return data


def check_dataset(path: str | Path, data: xr.Dataset, schema: Schema) -> None:
    """Check a dataset that was converted from another kind of file; InputError with the file and the variable."""
    _check_form(Path(path), data, schema)
    _check_content(Path(path), data, schema)


def _check_content(path: Path, data: xr.Dataset, schema: Schema) -> None:
    for name, variable in schema.variables.items():
        if name in data.variables:
            _check_values(path, name, np.asarray(data[name].values), variable)
    for name in schema.names:
        values = data[name].values.tolist()
        if len(set(values)) < len(values):
            raise InputError(path, name, "the same twice", "values that are all different")


def _check_bytes(path: Path, schema: Schema) -> None:
    """Reject a damaged file before this process parses it: HDF5 may hang or crash on such a file.

    A valid seal (:func:`characterisation.files.atomic_io.write_netcdf`) proves that it is as it was written.
    """
    data = read_bounded(path, schema.made_by, schema.hint, LARGEST_DATASET)
    body, seal = data[: -len(SEAL) - 64], data[-len(SEAL) - 64 :]
    if seal.startswith(SEAL):
        if hashlib.sha256(body).hexdigest().encode() != seal[len(SEAL) :]:
            raise _unreadable(path, schema, ": damaged since it was written")
        return
    command = [sys.executable, "-c", _PROBE, str(path.resolve())]
    try:
        done = subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False)
        told = done.stderr.decode("utf-8", "replace").strip().splitlines()
        failure = "" if done.returncode == 0 else told[-1][-200:] if told else "it crashes"
    except subprocess.TimeoutExpired:
        failure = f"its reader did not finish within {PATIENCE_S:g} s"
    if failure:
        raise _unreadable(path, schema, f"({' '.join(failure.split())})")


def _unreadable(path: Path, schema: Schema, cause: str) -> InputError:
    found = f"a file that cannot be read {cause}".replace(" :", ":")
    return InputError(path, "", found, f"netCDF: {schema.made_by}", schema.hint)


def _check_form(path: Path, data: xr.Dataset, schema: Schema) -> None:
    """Check the header of a file before any value is unpacked."""
    missing = [name for name, expected in schema.variables.items() if expected.needed and name not in data.variables]
    if missing:
        raise InputError(path, missing[0], "nothing", f"a variable of this name, as in {schema.made_by}", schema.hint)
    if data.nbytes > LARGEST_DATASET:
        raise InputError(path, "size", f"{data.nbytes:,} bytes unpacked", f"up to {LARGEST_DATASET:,}")
    for name, (least, most) in schema.sizes.items():
        if not least <= data.sizes.get(name, least) <= most:
            raise InputError(path, f"dimension {name}", data.sizes[name], f"{least} to {most}")
    for name, value in data.attrs.items():
        if isinstance(value, str) and len(value) > LONGEST_TEXT:
            raise InputError(path, str(name)[:80], f"{len(value):,} characters", f"up to {LONGEST_TEXT:,}")
    for name, expected in schema.variables.items():
        if name not in data.variables:
            continue
        variable = data.variables[name]
        if variable.dims != expected.dims:
            found = f"dimensions ({', '.join(map(str, variable.dims))})"
            raise InputError(path, name, found, f"({', '.join(expected.dims)})", schema.hint)
        if packed := {"scale_factor", "add_offset"} & variable.encoding.keys():
            raise InputError(path, name, f"packed numbers ({', '.join(sorted(packed))})", "numbers as they are")
        if variable.dtype.kind not in {"number": "fiu", "whole": "iu", "truth": "biu", "text": "OUS"}[expected.kind]:
            raise InputError(path, name, str(variable.dtype), _IN_WORDS[expected.kind], schema.hint)


def _check_values(path: Path, name: str, values: NDArray[Any], variable: Variable) -> None:
    if variable.kind == "text":
        if not all(isinstance(value, str) and len(value) <= LONGEST_TEXT for value in values.ravel().tolist()):
            raise InputError(path, name, "values that are not text", "texts")
        return
    if not values.size:
        return
    unknown = np.isnan(values) if values.dtype.kind == "f" else np.zeros(values.shape, bool)
    if unknown.any() and not variable.gaps:
        raise InputError(path, name, f"{np.count_nonzero(unknown)} values that are not numbers", "numbers")
    low, high = (0, 1) if variable.kind == "truth" else (variable.low, variable.high)
    wrong = ~unknown & ~((values >= low) & (values <= high) & np.isfinite(values))
    if wrong.any():
        allowed = "finite numbers" if math.isinf(low) and math.isinf(high) else f"{low:g} to {high:g}"
        raise InputError(path, name, f"{values[wrong].ravel()[0]}", allowed)
