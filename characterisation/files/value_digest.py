"""Digest a value with everything that it holds, where a representation leaves fields out or shortens numbers.

Signal chain: models, dataclasses, mappings, sequences and arrays -> their parts, in order -> SHA-256.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import numpy as np
from pydantic import BaseModel


def value_digest(value: object) -> str:
    """Return the SHA-256 of a value: of its fields, items or elements, and of anything else by its ``repr``.

    Equal values of the same types have the same digest, in every process.
    """
    sha = hashlib.sha256()

    def add(part: object) -> None:
        parts: list[object] = []
        if isinstance(part, np.ndarray):
            sha.update(f"{part.dtype} {part.shape}".encode() + part.tobytes())
        elif isinstance(part, BaseModel):  # not its repr, which some fields are left out of
            parts = [(name, getattr(part, name)) for name in type(part).model_fields]
        elif is_dataclass(part):
            parts = [(field.name, getattr(part, field.name)) for field in fields(part)]
        elif isinstance(part, Mapping):
            parts = list(part.items())
        elif isinstance(part, list | tuple):
            parts = list(part)
        else:
            sha.update(repr(part).encode())
        sha.update(f"{type(part).__name__} {len(parts)};".encode())
        for inner in parts:
            add(inner)

    add(value)
    return sha.hexdigest()
