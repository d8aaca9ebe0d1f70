"""Decode some rows and columns of coded images, to try another description of their code quickly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis, Role
from mitsim.sensor.light_code import LightCode, roles

Levels = NDArray[np.unsignedinteger[Any]]

#: number of lines of pixels evaluated, along rows and along columns
_LINES = 48


@dataclass(frozen=True)
class CodeLines:
    """Some lines of the images of one camera; ``dataclasses.replace`` gives them another code or other settings."""

    lines: tuple[Levels, Levels]  # images (P, n, W) of rows, and (P, H, m) of columns [DN]
    #: ``code``, and ``size`` (width, height) of the projector [px]
    code: LightCode
    size: tuple[int, int]
    settings: DecoderSettings  # limits of the decoder
    full_scale: float  # value of a saturated pixel [DN]

    @cached_property
    def image_roles(self) -> list[Role]:
        """Roles of the P images."""
        return roles(self.code, *self.size)

    def extent(self, axis: Axis) -> int:
        """Return the extent of the projector along an axis [px]."""
        return self.size[0] if axis == "columns" else self.size[1]

    def decoded(self, axis: Axis) -> list[ProjectorCoordinate]:
        """Return the coordinates along an axis of the rows (n, W), and of the columns (H, m).

        Raises InputError if the code is ambiguous over the projector.
        """
        return [
            decode_coordinates(part, self.code, self.size, self.settings, full_scale=self.full_scale, only=axis)[axis]
            for part in self.lines
        ]


def line_slices(shape: tuple[int, ...]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the rows, and the columns, of an image (H, W) that are evaluated."""
    height, width = shape
    down, along = max(1, height // _LINES), max(1, width // _LINES)
    return np.s_[down // 2 :: down, :], np.s_[:, along // 2 :: along]


def lines_of(stack: Levels) -> tuple[Levels, Levels]:
    """Return the evaluated rows (P, n, W) and columns (P, H, m) of images (P, H, W)."""
    rows, columns = (np.ascontiguousarray(stack[:, *way]) for way in line_slices(stack.shape[1:]))
    return rows, columns
