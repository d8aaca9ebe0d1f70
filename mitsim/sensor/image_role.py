"""The role of one image of a structured-light code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

Axis = Literal["columns", "rows"]
Share = Annotated[float, Field(ge=0, le=1)]
Period = Annotated[float, Field(ge=3, le=1e6)]
Steps = Annotated[int, Field(ge=3, le=64)]
#: pixels before the first column or row, or "centred": the code is wider than the projector, by as much on both sides
Offset = Literal["centred"] | Annotated[float, Field(ge=0, le=1e6)]
#: where fringes count from: the projector's edge, u = -0.5, or the middle of its first pixel, u = 0
Origin = Literal["edge", "pixel"]
Wave = Literal["cosine", "sine"]
Kind = Literal["white", "black", "gray", "gray_inverse", "phase", "unused"]


@dataclass(frozen=True)
class Role:
    """The role of one image of a code.

    - ``kind`` of the image.
    - ``axis``: None for white, black and images that no decoder needs.
    - ``index``: index of the period, or of the bit (0 is the most significant).
    - ``period`` of the fringe, or width of the stripe that this bit resolves [projector px].
    - ``shift`` delta_k [rad] of a cosine that counts from the projector's edge.
    - ``offset`` of a Gray code: its column c has the code of c + offset [projector px].
    """

    kind: Kind
    axis: Axis | None = None
    index: int = 0
    period: float = 0.0
    shift: float = 0.0
    offset: float = 0.0


def offset_in_pixels(offset: Offset | None, bits: int, stripe: float, extent: int) -> float:
    """Return the offset of a Gray code [px].

    Parameters
    ----------
    offset
        As its file states it; None is 0.
    bits, stripe, extent
        Number of bits, width of the finest stripe [px], and pixels along the axis.

    Notes
    -----
    A centred code has the offset floor((2^bits stripe - extent) / 2), as in the programs of Lanman and Taubin
    (SIGGRAPH 2009 course), and of Moreno and Taubin (3DIMPVT 2012).
    """
    return float(np.floor((2**bits * stripe - extent) / 2)) if offset == "centred" else offset or 0.0


def origin_shift(wave: Wave, at: Origin, period: float) -> float:
    """Return the shift [rad] that a wave and its origin add to that of a cosine that counts from the edge, delta.

    cos(2 pi u / P - delta) = cos(2 pi (u + 0.5) / P - delta - pi / P), and sin(x) = cos(x - pi / 2).
    """
    return (np.pi / 2 if wave == "sine" else 0.0) + (np.pi / period if at == "pixel" else 0.0)
