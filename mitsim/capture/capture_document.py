"""Describe ``capture.json``, the index of a capture folder, as a checked document, and write its JSON schema.

``python -m mitsim.capture.capture_document > docs/reference/capture.schema.json`` writes the schema. The schema does
not contain conditions between keys; :func:`mitsim.capture.folder.read_capture` checks them.
"""

from __future__ import annotations

import json
from typing import Any, Literal

from pydantic import Field

from characterisation.files.documents import Document, Name
from mitsim.capture.capture import Source

#: version that is written and read
SCHEMA_VERSION = 2
FRAME = "opencv: x right, y down, z forward, pixel centres at integers"
UNITS = {"length": "mm", "pixel_value": "DN", "angle_in_files": "deg"}

Role = Literal["calibration", "settings", "pose", "image", "derived", "truth", "vendor"]


class FileEntry(Document):
    """One file of a capture folder.

    An ``image`` has ``camera`` and ``frame``; a ``derived`` map has a ``name``. Both have the ``dtype`` and ``shape``
    (rows, columns, channels if more than one) of the stored array. A stored number times ``scale`` is in ``unit``.
    ``invalid`` is the stored number, or "nan", that marks a missing value.
    """

    path: str
    role: Role
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    camera: str | None = None
    frame: int | None = Field(default=None, ge=0, lt=1000)
    name: Literal["depth", "disparity", "points"] | None = None
    dtype: Literal["uint8", "uint16", "int16", "float32"] | None = None
    shape: tuple[int, int] | tuple[int, int, int] | None = None
    unit: Literal["DN", "mm", "px"] | None = None
    scale: float | None = Field(default=None, gt=0, le=1e6)
    invalid: int | Literal["nan"] | None = None


class CaptureDocument(Document):
    """Content of ``capture.json``. Its ``checksum`` covers all other keys.

    See :func:`characterisation.files.checked_files.content_checksum`.
    """

    schema_version: Literal[2]
    sensor: Name
    technology: str
    source: Source
    serial: str
    bits: int = Field(ge=1, le=16)
    units: dict[str, str]
    frame: str
    software: dict[str, str]
    files: tuple[FileEntry, ...] = Field(max_length=10_000)
    checksum: str


def capture_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of ``capture.json``."""
    draft = "https://json-schema.org/draft/2020-12/schema"
    return CaptureDocument.model_json_schema() | {"$schema": draft, "title": "mitsim capture"}


def schema_text() -> str:
    """Return the text of ``docs/reference/capture.schema.json``."""
    return json.dumps(capture_schema(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


if __name__ == "__main__":
    print(schema_text(), end="")
