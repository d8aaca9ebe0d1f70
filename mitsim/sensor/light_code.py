"""Define the codes of a structured-light projector: its sequence of images, and the role of each.

Signal chain: code -> the image sequence that it abbreviates -> roles, the list of its images in display order -> for
each role the value 0..1 at a projector coordinate -> patterns in projector pixels.

A code runs along one axis: with ``columns`` the value changes with the column u, with ``rows`` with the row v. Pixel
centres lie at integers, so the left edge of the projector is at u = -0.5. All codes count from there, unless ``wave``,
``at`` or ``offset_px`` state another origin:

    phase      I_k(u) = mean + contrast cos(2 pi (u + 0.5) / period - delta_k),    delta_k = 2 pi k / N
    Gray bit   I(u) = bit of g = s ^ (s >> 1),    s = floor((u + 0.5 + offset) / stripe),   most significant bit first

The Gray code is the reflected binary code (Gray, US patent 2632058, 1953): one bit changes between two stripes. A Gray
code for the fringe order with a phase inside the fringe: Sansoni et al., Applied Optics 38(31), 1999. The complementary
Gray code adds a bit that keeps the edges of the stripes away from the jumps of the phase: Zhang et al., Optics and
Lasers in Engineering 50(4), 2012.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from characterisation.files.documents import Document
from characterisation.files.errors import InputError
from mitsim.sensor.image_role import Axis, Offset, Origin, Period, Role, Share, Steps, Wave
from mitsim.sensor.image_sequence import FringeImages, GrayImages, Group, ImageSequence, PlainImages, check_displayable


class PhaseShift(Document):
    """N-step phase shifting with one or more periods.

    - ``periods_px``: periods in projector pixels, falling. Either from one that covers the projector to the one that
      measures (hierarchical), or neighbouring periods whose beat covers it (heterodyne).
    - ``steps``: N for each period, or one number for all.
    - ``axis`` along which the fringes change.
    - ``wave`` and ``at``: cosines or sines, counted from the projector's ``edge`` or the middle of its first ``pixel``.
    - ``mean`` and ``contrast`` of the projected cosine [1]. The projector's gamma is not pre-corrected.
    """

    kind: Literal["phase_shift"] = "phase_shift"
    periods_px: list[Period] = Field(min_length=1, max_length=12)
    steps: Steps | list[Steps] = 4
    axis: Axis = "columns"
    wave: Wave = "cosine"
    at: Origin = "edge"
    mean: Share = 0.5
    contrast: Annotated[float, Field(gt=0, le=0.5)] = 0.5

    @field_validator("periods_px")
    @classmethod
    def _falling(cls, periods: list[float]) -> list[float]:
        if any(a <= b for a, b in pairwise(periods)):
            raise ValueError("periods that fall from the longest to the shortest")
        return periods

    @model_validator(mode="after")
    def _consistent(self) -> PhaseShift:
        if isinstance(self.steps, list) and len(self.steps) != len(self.periods_px):
            raise ValueError(f"steps: one number, or as many as there are periods ({len(self.periods_px)})")
        check_displayable(self.mean, self.contrast)
        return self

    def sequence(self) -> ImageSequence:
        """Return the code as an image sequence."""
        steps = self.steps if isinstance(self.steps, list) else [self.steps] * len(self.periods_px)
        fringes = [_fringes(self, period, count) for period, count in zip(self.periods_px, steps, strict=True)]
        return _sequence(fringes, self.mean, self.contrast)


class GrayCode(Document):
    """Gray code of the column, the row, or both.

    - ``bits``: number of bits, from the most significant on; by default all that the projector's size needs. With fewer
      bits the finest stripes are wider than one pixel.
    - ``axis`` along which the code changes.
    - ``offset_px``: column c has the code of c + offset, likewise for rows, or the code is ``"centred"``. None is 0.
    - ``inverse``: each pattern is followed by its complement, which gives the more robust threshold.
    - ``white_black``: a white and a black frame come first.
    """

    kind: Literal["gray_code"] = "gray_code"
    bits: int | None = Field(default=None, ge=1, le=15)
    axis: Axis | Literal["both"] = "columns"
    inverse: bool = True
    white_black: bool = True
    offset_px: Offset | None = None

    @model_validator(mode="after")
    def _has_a_threshold(self) -> GrayCode:
        if not (self.inverse or self.white_black):
            raise ValueError("inverse or white_black (or both): without them bits have no threshold")
        return self

    def sequence(self) -> ImageSequence:
        """Return the code as an image sequence."""
        along: tuple[Axis, ...] = ("columns", "rows") if self.axis == "both" else (self.axis,)
        inverse: Literal["each", "none"] = "each" if self.inverse else "none"
        gray = [
            GrayImages(show="gray", axis=axis, bits=self.bits, inverse=inverse, offset_px=self.offset_px)
            for axis in along
        ]
        return _sequence([*_plain(self.white_black), *gray])


class GrayCodePhaseShift(Document):
    """Gray code for the order of the fringe, phase shifting inside it.

    - ``period_px`` of the fringe [projector px]; ``steps`` N; ``axis``, ``wave`` and ``at`` as for the others.
    - ``complementary``: one more Gray bit than the fringes need, so that stripes half a fringe wide never end where the
      phase jumps.
    - ``inverse`` and ``white_black``: as for :class:`GrayCode`. With neither, the mean of the fringes is the threshold.
    - ``mean`` and ``contrast`` of the fringes [1].
    """

    kind: Literal["gray_code_phase_shift"] = "gray_code_phase_shift"
    period_px: Period
    steps: Steps = 4
    axis: Axis = "columns"
    wave: Wave = "cosine"
    at: Origin = "edge"
    complementary: bool = True
    inverse: bool = False
    white_black: bool = True
    mean: Share = 0.5
    contrast: Annotated[float, Field(gt=0, le=0.5)] = 0.5

    @model_validator(mode="after")
    def _consistent(self) -> GrayCodePhaseShift:
        check_displayable(self.mean, self.contrast)
        return self

    def sequence(self) -> ImageSequence:
        """Return the code as an image sequence."""
        stripe = self.period_px / 2 if self.complementary else self.period_px
        inverse: Literal["each", "none"] = "each" if self.inverse else "none"
        gray = GrayImages(show="gray", axis=self.axis, stripe_px=stripe, inverse=inverse)
        images: list[Group] = [*_plain(self.white_black), gray, _fringes(self, self.period_px, self.steps)]
        return _sequence(images, self.mean, self.contrast)


def _fringes(code: PhaseShift | GrayCodePhaseShift, period_px: float, steps: int) -> FringeImages:
    return FringeImages(show="fringes", axis=code.axis, period_px=period_px, steps=steps, wave=code.wave, at=code.at)


def _plain(shown: bool) -> list[PlainImages]:
    return [PlainImages(show="white"), PlainImages(show="black")] if shown else []


def _sequence(images: Sequence[Group], mean: float = 0.5, contrast: float = 0.5) -> ImageSequence:
    return ImageSequence(kind="image_sequence", images=list(images), mean=mean, contrast=contrast)


LightCode = PhaseShift | GrayCode | GrayCodePhaseShift | ImageSequence


def sequence(code: LightCode) -> ImageSequence:
    """Return a code as an image sequence."""
    return code if isinstance(code, ImageSequence) else code.sequence()


def axes(code: LightCode) -> tuple[Axis, ...]:
    """Return the axes along which a code gives a coordinate."""
    return sequence(code).axes


def has_fringes(code: LightCode, axis: Axis) -> bool:
    """Return whether phases, not only the stripes of a Gray code, give the coordinate along an axis."""
    return bool(sequence(code).fringes(axis))


def roles(code: LightCode, width: int, height: int) -> list[Role]:
    """Return the roles of a code's images in the order in which they are shown and stored.

    White and black come first. Then, for each axis (columns first), the Gray bits from the most significant on, each
    followed by its inverse. Then, for each period from the longest on, its N shifts. An image sequence has its own
    order. Raises InputError if the Gray bits do not cover the projector, or a Gray code has more of them than the
    projector needs.
    """
    if isinstance(code, GrayCode):
        for axis in axes(code):
            extent = width if axis == "columns" else height
            needed = max(1, (extent - 1).bit_length())
            if (code.bits or 0) > needed:
                raise InputError("pattern", "bits", code.bits, f"up to {needed}, which distinguish all {extent} {axis}")
    return sequence(code).roles(width, height)


def value(code: LightCode, role: Role, coordinate: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the values 0..1 that an image of a code emits at projector coordinates (...) [px] along its axis.

    The coordinate may lie between pixel centres. For white and black only its shape matters.
    """
    position = np.asarray(coordinate, np.float64) + 0.5
    match role.kind:
        case "white":
            return np.ones_like(position)
        case "black" | "unused":
            return np.zeros_like(position)
        case "phase":
            assert not isinstance(code, GrayCode)
            return np.asarray(code.mean + code.contrast * np.cos(2 * np.pi * position / role.period - role.shift))
        case _:
            # bit i of s ^ (s >> 1): of every four stripes of bit i, each role.period wide, the middle two are lit
            quarters = (np.floor((position + role.offset) / role.period) + 1) / 4
            lit = quarters - np.floor(quarters) >= 0.5
            return np.asarray(lit if role.kind == "gray" else ~lit, np.float64)


def patterns(code: LightCode, width: int, height: int) -> NDArray[np.float32]:
    """Return all images of a code, (P, height, width), values 0..1 in projector pixels, in the order of :func:`roles`.

    Raises InputError if the code does not fit the projector.
    """
    every = roles(code, width, height)
    out = np.empty((len(every), height, width), np.float32)
    for image, role in zip(out, every, strict=True):
        if role.axis == "rows":
            image[:] = value(code, role, np.arange(height, dtype=float))[:, None]
        else:
            image[:] = value(code, role, np.arange(width, dtype=float))[None, :]
    return out


def check_stack(stack: NDArray[np.generic], roles: Sequence[Role]) -> None:
    """Reject a stack that cannot be the images of a code.

    Raises InputError if it is not (P, H, W) of as many images as the code has, or not of uint8, uint16 or floats.
    """
    if stack.ndim != 3 or len(stack) != len(roles):
        raise InputError("image stack", "shape", stack.shape, f"({len(roles)}, rows, columns), as the code defines")
    if stack.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise InputError("image stack", "dtype", stack.dtype, "uint8, uint16, float32 or float64 grey levels")
