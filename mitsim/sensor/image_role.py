"""The role of one image of a structured-light code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

Axis = Literal["columns", "rows"]
Share = Annotated[float, Field(ge=0, le=1)]
Period = Annotated[float, Field(ge=3, le=1e6)]
Steps = Annotated[int, Field(ge=3, le=64)]
Kind = Literal["white", "black", "gray", "gray_inverse", "phase", "unused"]


@dataclass(frozen=True)
class Role:
    """The role of one image of a code.

    - ``kind`` of the image.
    - ``axis``: None for white, black and images that no decoder needs.
    - ``index``: index of the period, or of the bit (0 is the most significant).
    - ``period`` of the fringe, or width of the stripe that this bit resolves [projector px].
    - ``shift`` delta_k [rad].
    """

    kind: Kind
    axis: Axis | None = None
    index: int = 0
    period: float = 0.0
    shift: float = 0.0
