"""Describe the images of an existing rig in the order in which it shows them.

Signal chain: groups of images, as the rig shows them -> roles, one for each image -> the same patterns
(:func:`mitsim.sensor.light_code.value`) and the same decoders as for mitsim's own codes.

The conventions are those of :mod:`mitsim.sensor.light_code`: stripes and fringes count from the projector's edge, at
u = -0.5, and a fringe is mean + contrast cos(2 pi (u + 0.5) / period - delta). Keys of a group state other origins:
``offset_px`` of Gray stripes, ``at`` and ``wave`` of fringes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from characterisation.files.documents import Document
from characterisation.files.errors import InputError
from mitsim.sensor.image_role import (
    Axis,
    Offset,
    Origin,
    Period,
    Role,
    Share,
    Steps,
    Wave,
    offset_in_pixels,
    origin_shift,
)


def check_displayable(mean: float, contrast: float) -> None:
    """Raise a ValueError unless fringes stay within 0 and 1."""
    if mean - contrast < -1e-12 or mean + contrast > 1 + 1e-12:
        raise ValueError("mean and contrast whose fringes stay within 0 and 1")


class PlainImages(Document):
    """``count`` images without a code: ``white``, ``black``, or ``unused`` images that no decoder needs."""

    show: Literal["white", "black", "unused"]
    count: int = Field(default=1, ge=1, le=1000)

    @model_validator(mode="after")
    def _single(self) -> PlainImages:
        if self.show != "unused" and self.count != 1:
            raise ValueError(f"one {self.show} image; list the others as unused")
        return self


class GrayImages(Document):
    """The bits of a Gray code.

    - ``bits``: by default, as many as the projector needs. With fewer bits the stripes are wider.
    - ``stripe_px``: width of the finest stripe, by default 1 px. A stripe of half a fringe gives the complementary
      code.
    - ``first``: the bit that comes first.
    - ``offset_px``: column c has the code of c + offset, or the code is ``"centred"`` on the projector. None is 0.
    - ``inverse``: the complement of ``each`` bit follows it or comes ``before`` it, ``all`` complements follow all
      bits, or there are ``none``.
    """

    show: Literal["gray"]
    axis: Axis = "columns"
    bits: int | None = Field(default=None, ge=1, le=15)
    stripe_px: Annotated[float, Field(ge=1, le=1e6)] | None = None
    first: Literal["most_significant", "least_significant"] = "most_significant"
    inverse: Literal["none", "each", "before", "all"] = "none"
    offset_px: Offset | None = None

    def stripes(self, extent: int) -> tuple[int, float]:
        """Return bits and stripe width [px] along ``extent``; InputError if they leave pixels, or over 15 bits."""
        if self.stripe_px is None:
            needed = max(1, int(np.ceil(np.log2(extent))))
            bits = self.bits or needed
            stripe = float(2.0 ** (needed - bits)) if bits <= needed else 1.0
        else:
            stripe = self.stripe_px
            bits = self.bits or max(1, int(np.ceil(np.log2(np.ceil(extent / stripe)))))
        offset = offset_in_pixels(self.offset_px, bits, stripe, extent)
        if 2**bits * stripe < extent + max(offset, 0.0) or bits > 15:
            behind = f" from an offset of {offset:g} px on" if offset > 0 else ""
            raise InputError(
                "pattern",
                "images",
                f"{bits} Gray bits of stripes of {stripe:g} px{behind}",
                f"up to 15 bits whose stripes cover all {extent} {self.axis}",
            )
        return bits, stripe

    def offset(self, extent: int) -> float:
        """Return the offset of the code along an axis of ``extent`` pixels [px].

        Raises InputError as for :meth:`stripes`.
        """
        return offset_in_pixels(self.offset_px, *self.stripes(extent), extent)

    def roles(self, extent: int) -> list[Role]:
        """Return one role for each image."""
        bits, stripe = self.stripes(extent)
        order = range(bits) if self.first == "most_significant" else range(bits - 1, -1, -1)
        offset = self.offset(extent)
        lit = [Role("gray", self.axis, bit, stripe * 2 ** (bits - 1 - bit), offset=offset) for bit in order]
        inverse = [replace(role, kind="gray_inverse") for role in lit]
        if self.inverse in ("each", "before"):
            pairs = zip(lit, inverse, strict=True) if self.inverse == "each" else zip(inverse, lit, strict=True)
            return [role for pair in pairs for role in pair]
        return lit + inverse if self.inverse == "all" else lit


class FringeImages(Document):
    """Shifted fringes of one period: mean + contrast wave(2 pi x / period_px - delta).

    - ``steps`` N for delta = 360 deg k / N, ``shifts_deg`` delta of each image, or ``phases_deg`` theta = -delta of
      each, as in cos(2 pi x / P + theta).
    - ``wave``: cosine or sine.
    - ``at``: x = u + 0.5 counts from the projector's ``edge``, or x = u from the middle of its first ``pixel``.
    """

    show: Literal["fringes"]
    axis: Axis = "columns"
    period_px: Period
    steps: Steps | None = None
    shifts_deg: Annotated[list[float], Field(min_length=3, max_length=64)] | None = None
    phases_deg: Annotated[list[float], Field(min_length=3, max_length=64)] | None = None
    wave: Wave = "cosine"
    at: Origin = "edge"

    @model_validator(mode="after")
    def _solvable(self) -> FringeImages:
        if [self.steps, self.shifts_deg, self.phases_deg].count(None) != 2:
            raise ValueError("steps or shifts_deg or phases_deg, one of the three")
        turns = np.exp(1j * np.array(self.shifts))
        if len(np.unique(np.round(turns, 6))) < 3:
            raise ValueError("three or more different shifts; 360 deg equals 0 deg")
        return self

    @property
    def shifts(self) -> tuple[float, ...]:
        """Return the shifts delta_k [rad] of the same fringes as cosines that count from the edge."""
        origin = origin_shift(self.wave, self.at, self.period_px)
        if self.steps is not None:
            return tuple(2 * np.pi * k / self.steps + origin for k in range(self.steps))
        listed = np.radians(self.shifts_deg) if self.shifts_deg is not None else -np.radians(self.phases_deg or [])
        return tuple((listed + origin).tolist())


Group = Annotated[PlainImages | GrayImages | FringeImages, Field(discriminator="show")]


class ImageSequence(Document):
    """All images of a measurement in display order; ``mean`` and ``contrast`` apply to all fringes [1]."""

    kind: Literal["image_sequence"]
    images: list[Group] = Field(min_length=1, max_length=200)
    mean: Share = 0.5
    contrast: Annotated[float, Field(gt=0, le=0.5)] = 0.5

    @model_validator(mode="after")
    def _decodable(self) -> ImageSequence:
        check_displayable(self.mean, self.contrast)
        if not self.axes:
            raise ValueError("at least one group of gray or fringes")
        plain = [group.show for group in self.images if isinstance(group, PlainImages)]
        if max(plain.count("white"), plain.count("black")) > 1:
            raise ValueError("white and black once each; list the others as unused")
        for axis in self.axes:
            gray, fringes = self.gray(axis), self.fringes(axis)
            if len(gray) > 1 or len({group.period_px for group in fringes}) < len(fringes):
                raise ValueError(f"one group of gray for the {axis}, and one of fringes for each period")
            if gray and gray[0].inverse == "none" and not fringes and not {"white", "black"} <= set(plain):
                raise ValueError(f"for the Gray bits of the {axis}: inverse, white and black, or fringes as threshold")
        return self

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the axes along which the sequence has a code."""
        both: tuple[Axis, ...] = ("columns", "rows")
        return tuple(axis for axis in both if self.gray(axis) or self.fringes(axis))

    def gray(self, axis: Axis) -> list[GrayImages]:
        """Return the groups of Gray bits along an axis: one or none."""
        return [group for group in self.images if isinstance(group, GrayImages) and group.axis == axis]

    def fringes(self, axis: Axis) -> list[FringeImages]:
        """Return the groups of fringes along an axis, from the longest period to the shortest."""
        groups = [group for group in self.images if isinstance(group, FringeImages) and group.axis == axis]
        return sorted(groups, key=lambda group: -group.period_px)

    def roles(self, width: int, height: int) -> list[Role]:
        """Return one role for each image, in display order; ``width`` and ``height`` are the projector's [px].

        Raises InputError if the Gray bits do not cover the projector.
        """
        out: list[Role] = []
        for group in self.images:
            if isinstance(group, GrayImages):
                out += group.roles(width if group.axis == "columns" else height)
            elif isinstance(group, FringeImages):
                index = self.fringes(group.axis).index(group)
                out += [Role("phase", group.axis, index, group.period_px, shift) for shift in group.shifts]
            else:
                out += [Role(group.show)] * group.count
        return out
