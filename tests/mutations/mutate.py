"""Mutations of files, each by a seed: bytes that are flipped, cut, doubled or exchanged, and datasets that are bent."""

import re

import numpy as np
import xarray as xr

#: what may stand in place of a number, and what is put in anywhere
NUMBERS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e308",
    b"-1e308",
    b"1e-320",
    b"0",
    b"-1",
    b"9" * 400,
    b"18446744073709551615",
    b"2147483648",
    b"\xc2\xb2",
    b"0x10",
    b"1e9",
    b"null",
    b"true",
    b'""',
    b"[]",
    b"{}",
)
TOKENS = (
    b"\0",
    b"\xff\xfe",
    b"\x1b[2J",
    b"../../evil",
    b"/dev/zero",
    b"<script>",
    b"[" * 3000,
    b"{" * 3000,
    b"- " * 3000,
    b"a." * 3000,
    b"A" * 5000,
    b"\r\n",
    b"\\u0000",
    b"\xe2\x80\xae",
    b"<!--",
    b'"',
    b"'",
    b"%s%n",
    b"${x}",
    b"\xf0\x9f\x92\xa3",
    b"<bsdf type='twosided'>" * 50,
    b",,,,",
    b"\n\n",
    b"9" * 200_000,
)

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def mutated_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes of a file's bytes."""
    for _ in range(int(rng.integers(1, 4))):
        data = _CHANGES[int(rng.integers(len(_CHANGES)))](data, rng)
    return data


def _place(data, rng):
    return int(rng.integers(0, len(data) + 1))


def _flip(data, rng):
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if out:
            out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _cut(data, rng):
    return data[: _place(data, rng)]


def _drop(data, rng):
    start, end = sorted((_place(data, rng), _place(data, rng)))
    return data[:start] + data[min(end, start + 200) :]


def _double(data, rng):
    start = _place(data, rng)
    part = data[start : start + int(rng.integers(1, 400))]
    return data[:start] + part * int(rng.integers(2, 5)) + data[start:]


def _insert(data, rng):
    at = _place(data, rng)
    return data[:at] + TOKENS[int(rng.integers(len(TOKENS)))] + data[at:]


def _number(data, rng):
    found = list(_NUMBER.finditer(data[:200_000]))
    if not found:
        return _flip(data, rng)
    one = found[int(rng.integers(len(found)))]
    return data[: one.start()] + NUMBERS[int(rng.integers(len(NUMBERS)))] + data[one.end() :]


def _line(data, rng):
    lines = data.split(b"\n")
    at = int(rng.integers(len(lines)))
    if rng.random() < 0.5:
        del lines[at]
    else:
        lines.insert(int(rng.integers(len(lines))), lines[at])
    return b"\n".join(lines)


def _noise(data, rng):
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 64))) + data[at:]


_CHANGES = (_flip, _cut, _drop, _double, _insert, _number, _number, _line, _line, _noise)


def mutated_dataset(data: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """A dataset of which a variable is renamed, gone, transposed, cut, of another type, or has other values."""
    names = [str(name) for name in data.variables]
    name = names[int(rng.integers(len(names)))]
    variable = data[name]
    kind = int(rng.integers(10))
    data = data.copy(deep=True)
    data.attrs.pop("content_sha256", None)
    if kind == 0:
        return data.drop_vars(name)
    if kind == 1:
        return data.rename({name: f"{name}_{int(rng.integers(9))}"})
    if kind == 2:
        return data.transpose(*list(data.sizes)[::-1])
    if kind == 3 and data.sizes:
        side = list(data.sizes)[int(rng.integers(len(data.sizes)))]
        return data.isel({side: slice(0, int(rng.integers(0, max(data.sizes[side], 1))))})
    if kind == 4:
        data[name] = (variable.dims, variable.values.astype(str))
    elif kind == 5:
        data[name] = (variable.dims, np.zeros(variable.shape, ["i1", "f4", "u8", "f8"][int(rng.integers(4))]))
    elif kind in (6, 7) and variable.dtype.kind in "fiu":
        values = variable.values.astype(float)
        wild = [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, 1e-300, 2.0**40]
        flat = values.reshape(-1)
        if flat.size:
            flat[rng.integers(flat.size, size=max(flat.size // 10, 1))] = wild[int(rng.integers(len(wild)))]
        data[name] = (variable.dims, values)
    elif kind == 8:
        keys = list(data.attrs)
        wild = ["", "x" * 5000, 2**40, -1.0, "<script>", "\x1b[2J", [1, 2, 3], "../../evil"]
        key = keys[int(rng.integers(len(keys)))] if keys else "name"
        data.attrs[key] = wild[int(rng.integers(len(wild)))]
    else:
        data[name] = (variable.dims, variable.values[..., ::-1] if variable.ndim else variable.values)
    return data
