"""The images of a rig that somebody else built, in the order in which it shows them.

Signal chain: groups of images, as the rig's maker listed them -> roles, one for each image -> the same patterns
(:func:`mitsim.sensor.light_code.value`) and the same decoders as for the codes of our own.

The conventions are those of :mod:`mitsim.sensor.light_code`: stripes and fringes count from the projector's edge, at
u = -0.5, and a fringe is mean + contrast cos(2 pi (u + 0.5) / period - delta). A rig whose fringes are sines, or count
from the middle of the first pixel, has other shifts delta: sin(x) = cos(x - 90 deg).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from characterisation.documents import Document
from characterisation.errors import InputError
from mitsim.sensor.image_role import Axis, Period, Role, Share, Steps


class PlainImages(Document):
    """``count`` images without a code: ``white``, ``black``, or ``unused`` ones that no decoder needs."""

    show: Literal["white", "black", "unused"]
    count: int = Field(default=1, ge=1, le=1000)

    @model_validator(mode="after")
    def _single(self) -> PlainImages:
        if self.show != "unused" and self.count != 1:
            raise ValueError(f"one {self.show} image; name the others unused")
        return self


class GrayImages(Document):
    """The bits of a Gray code.

    ``bits``, ``stripe_px`` of the finest stripe: all that the projector needs, of 1 px, unless given; fewer bits have
    wider stripes, and a stripe of half a fringe is the complementary code; ``first``: which bit comes first;
    ``inverse``: the complement of each bit follows it or comes before it, all complements follow all bits, or there are
    none.
    """

    show: Literal["gray"]
    axis: Axis = "columns"
    bits: int | None = Field(default=None, ge=1, le=15)
    stripe_px: Annotated[float, Field(ge=1, le=1e5)] | None = None
    first: Literal["most_significant", "least_significant"] = "most_significant"
    inverse: Literal["none", "each", "before", "all"] = "none"

    def stripes(self, extent: int) -> tuple[int, float]:
        """Bits, and the width of the finest stripe [px], along an axis of ``extent`` pixels.

        Raises
        ------
        InputError
            If so many bits of such stripes do not cover the projector, or 15 bits would not do.
        """
        if self.stripe_px is None:
            needed = max(1, int(np.ceil(np.log2(extent))))
            bits = self.bits or needed
            stripe = float(2.0 ** (needed - bits)) if bits <= needed else 1.0
        else:
            stripe = self.stripe_px
            bits = self.bits or max(1, int(np.ceil(np.log2(np.ceil(extent / stripe)))))
        if 2**bits * stripe < extent or bits > 15:
            raise InputError(
                "pattern",
                "images",
                f"{bits} Gray bits of stripes of {stripe:g} px",
                f"up to 15 bits whose stripes cover all {extent} {self.axis}",
            )
        return bits, stripe

    def roles(self, extent: int) -> list[Role]:
        """One role for each image."""
        bits, stripe = self.stripes(extent)
        order = range(bits) if self.first == "most_significant" else range(bits - 1, -1, -1)
        lit = [Role("gray", self.axis, bit, stripe * 2 ** (bits - 1 - bit)) for bit in order]
        inverse = [replace(role, kind="gray_inverse") for role in lit]
        if self.inverse in ("each", "before"):
            pairs = zip(lit, inverse, strict=True) if self.inverse == "each" else zip(inverse, lit, strict=True)
            return [role for pair in pairs for role in pair]
        return lit + inverse if self.inverse == "all" else lit


class FringeImages(Document):
    """Shifted fringes of one period: ``shifts_deg`` delta of each image, or ``steps`` N for 360 deg k / N."""

    show: Literal["fringes"]
    axis: Axis = "columns"
    period_px: Period
    steps: Steps | None = None
    shifts_deg: Annotated[list[float], Field(min_length=3, max_length=64)] | None = None

    @model_validator(mode="after")
    def _solvable(self) -> FringeImages:
        if (self.steps is None) == (self.shifts_deg is None):
            raise ValueError("steps or shifts_deg, one of the two")
        turns = np.exp(1j * np.radians(self.shifts_deg or [0, 120, 240]))
        if len(np.unique(np.round(turns, 6))) < 3:
            raise ValueError("three shifts or more that differ, 360 deg being the same as 0")
        return self

    @property
    def shifts(self) -> tuple[float, ...]:
        """Shifts delta_k [rad]."""
        if self.shifts_deg is not None:
            return tuple(np.radians(self.shifts_deg).tolist())
        assert self.steps is not None  # the validator's rule
        return tuple(2 * np.pi * k / self.steps for k in range(self.steps))


Group = Annotated[PlainImages | GrayImages | FringeImages, Field(discriminator="show")]


class ImageSequence(Document):
    """All images of a measurement in the order in which they are shown; ``mean``, ``contrast`` of all fringes [1]."""

    kind: Literal["image_sequence"]
    images: list[Group] = Field(min_length=1, max_length=200)
    mean: Share = 0.5
    contrast: Annotated[float, Field(gt=0, le=0.5)] = 0.5

    @model_validator(mode="after")
    def _decodable(self) -> ImageSequence:
        if self.mean - self.contrast < -1e-12 or self.mean + self.contrast > 1 + 1e-12:
            raise ValueError("mean and contrast whose fringes stay within 0 and 1")
        if not self.axes:
            raise ValueError("at least one group of gray or fringes")
        plain = [group.show for group in self.images if isinstance(group, PlainImages)]
        if max(plain.count("white"), plain.count("black")) > 1:
            raise ValueError("white and black once each; name others unused")
        for axis in self.axes:
            gray, fringes = self.gray(axis), self.fringes(axis)
            if len(gray) > 1 or len({group.period_px for group in fringes}) < len(fringes):
                raise ValueError(f"one group of gray for the {axis}, and one of fringes for each period")
            if gray and gray[0].inverse == "none" and not fringes and not {"white", "black"} <= set(plain):
                raise ValueError(f"for the Gray bits of the {axis}: inverse, white and black, or fringes as threshold")
        return self

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Along which axes there is a code."""
        both: tuple[Axis, ...] = ("columns", "rows")
        return tuple(axis for axis in both if self.gray(axis) or self.fringes(axis))

    def gray(self, axis: Axis) -> list[GrayImages]:
        """Groups of Gray bits along an axis; one or none."""
        return [group for group in self.images if isinstance(group, GrayImages) and group.axis == axis]

    def fringes(self, axis: Axis) -> list[FringeImages]:
        """Groups of fringes along an axis, from the longest period down to the shortest."""
        found = [group for group in self.images if isinstance(group, FringeImages) and group.axis == axis]
        return sorted(found, key=lambda group: -group.period_px)

    def roles(self, width: int, height: int) -> list[Role]:
        """One role for each image, in their order; ``width``, ``height`` of the projector [px].

        Raises
        ------
        InputError
            If the Gray bits do not cover the projector.
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
