"""The table ``[calibration]`` of a sensor file: which files calibrate its cameras and projector."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from characterisation.files.documents import Document


class EyeKeys(Document):
    """Names of one camera's or the projector's values in the file; dots step into maps: ``stereo.R``.

    ``file``: the one of several files that contains matrix, distortion and size of this eye alone.
    """

    file: str | None = None
    matrix: str | None = None
    distortion: str | None = None
    size: str | None = None
    rotation: str | None = None
    translation: str | None = None


class CalibrationTable(Document):
    """Source of the geometry of cameras and projector, in place of their own keys.

    - ``file``: one or several, beside the sensor file.
    - ``to_mm``: their unit of length in mm; by default the unit that the file or its format states, else 1 if likely.
    - ``cameras``: names, the reference camera first.
    - ``projector``: whether the files also calibrate it.
    - ``model`` of the cameras' lenses; by default the one that the file states, else perspective.
    - ``keys`` of each camera, and of ``projector``, if the file does not use the usual names.
    """

    file: str | Annotated[list[str], Field(min_length=1, max_length=8)]
    to_mm: Annotated[float, Field(gt=0, le=1e6)] | None = None
    cameras: list[str] = Field(default=["camera"], min_length=1, max_length=2)
    projector: bool = True
    model: Literal["perspective", "fisheye"] | None = None
    keys: dict[str, EyeKeys] = Field(default={})
