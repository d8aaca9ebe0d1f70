"""Limits of a stereo matcher; :mod:`mitsim.decoding` does the matching."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from mitsim.sensor.decoder_settings import DepthSettings


def odd(size: int) -> int:
    """Return a size [px]; raise a ValueError unless it is odd."""
    if size % 2 == 0:
        raise ValueError("an odd number of pixels")
    return size


def _odd_or_none(size: int) -> int:
    if size != 0 and (size % 2 == 0 or size < 5):
        raise ValueError("0, or an odd number of pixels from 5")
    return size


#: cost of a pixel in OpenCV's SGBM over its ``prefilter_cap`` up to which sums must fit; of random grey levels, those
#: that overflow have up to 0.49 (tests/benchmarks/sgbm_overflow.py)
SGBM_COST_PER_CAP = 0.5

#: largest number of 16 bits, the costs of OpenCV's SGBM
SGBM_LARGEST_COST = 32767

OddSum = Annotated[int, Field(ge=1, le=31), AfterValidator(odd)]
ContrastWindow = Annotated[int, Field(ge=0, le=101), AfterValidator(_odd_or_none)]


def sgbm_cost(block_size: int, p2: float, prefilter_cap: int) -> float:
    """Return the largest cost that OpenCV's SGBM may sum."""
    return block_size**2 * (p2 + SGBM_COST_PER_CAP * prefilter_cap)


class MatcherSettings(DepthSettings):
    """Search range, limits and filters of a stereo matcher. Nothing is filled: lost points stay lost.

    - ``near_mm``, ``far_mm``: range of accepted depths along the axis of the rectified left camera.
    - ``method``: ``sgbm`` of one frame; ``census`` (semi-global matching of codes) or ``correlation`` of all frames at
      once. ``contrast_window_px`` and ``prefilter_cap`` apply to ``sgbm`` only; ``p1``, ``p2`` and ``mode`` not to
      ``correlation``.
    - ``mode``: paths of semi-global matching. ``hh``: all eight. ``sgbm``: one pass, five; ``3way``: one pass, three.
    - ``contrast_window_px``: odd window over which local brightness and contrast are equalised before matching; 0 for
      none.
    - ``census_window_px``, odd: side of the window of a census code.
    - ``block_size`` [px], odd, over which costs are summed, from 3; ``census`` also takes 1, for none.
    - ``p1``, ``p2``: smoothness penalties, multiplied by block_size^2. For ``census`` they refer to a code of 62 bits.
    - ``uniqueness_percent``: margin by which the best cost must beat the next.
    - ``left_right_px``: largest difference from the match found from the right image.
    - ``prefilter_cap``: gradients are clipped to it [DN of 8 bit].
    - ``minimum_contrast_dn``: least standard deviation in the neighbourhood of an accepted match [DN of 8 bit, that is
      1/255 of full scale].
    - ``sub_pixel``: fit between whole disparities. ``method`` is that of the method: a parabola, for ``correlation`` a
      closed form. ``parabola`` and ``equiangular`` (two lines) of three costs. ``sgbm`` has the parabola only, with
      corrected steps; ``opencv`` leaves its disparities as OpenCV rounds them.
    - ``median_px``: side of a median filter of the disparities; 0 for none.
    - ``speckle_px``: regions of up to so many pixels are removed, 0 for none; neighbours within ``speckle_range_px`` of
      disparity belong to one region.
    - ``disparity_step`` [px]: disparities are rounded to multiples of it, as in devices with fixed-point output; 0 for
      no rounding.
    - ``reference_mm``: depth of the plane whose image is the reference of a sensor with one camera.
    """

    level_key = "minimum_contrast_dn"

    method: Literal["sgbm", "census", "correlation"] = "sgbm"
    contrast_window_px: ContrastWindow = 0
    census_window_px: Literal[3, 5, 7, 9] = Field(default=7, repr=False)
    block_size: OddSum = 5
    p1: float = Field(default=8, ge=0, le=1000)
    p2: float = Field(default=32, ge=0, le=1000)
    uniqueness_percent: int = Field(default=5, ge=0, le=100)
    left_right_px: float = Field(default=1.0, ge=0)
    mode: Literal["hh", "sgbm", "3way"] = "hh"
    prefilter_cap: int = Field(default=63, ge=1, le=127)
    minimum_contrast_dn: float = Field(default=1.5, ge=0)
    sub_pixel: Literal["method", "parabola", "equiangular", "opencv"] = Field(default="method", repr=False)
    median_px: Literal[0, 3, 5, 7] = Field(default=0, repr=False)
    speckle_px: int = Field(default=0, ge=0, le=100_000, repr=False)
    speckle_range_px: float = Field(default=1.0, gt=0, le=100, repr=False)
    disparity_step: float = Field(default=0.0, ge=0, le=1)
    reference_mm: float | None = Field(default=None, gt=0)

    @property
    def support_px(self) -> int:
        """Return the side of the square of pixels that the cost of one pixel depends on."""
        return self.block_size + (self.census_window_px - 1 if self.method == "census" else 0)

    @model_validator(mode="after")
    def _check_penalties(self) -> MatcherSettings:
        if self.p2 < self.p1:
            raise ValueError("p1 not over p2")
        return self

    @model_validator(mode="after")
    def _check_method(self) -> MatcherSettings:
        if self.block_size < 3 and self.method != "census":
            raise ValueError(f"block_size from 3 for method {self.method}")
        other = ("equiangular",) if self.method == "sgbm" else ("opencv",)
        most = sgbm_cost(self.block_size, self.p2, self.prefilter_cap)
        if self.method == "sgbm" and most > SGBM_LARGEST_COST:
            what = (
                f"block_size^2 (p2 + prefilter_cap / 2) of at most {SGBM_LARGEST_COST} for method sgbm, not {most:.0f}"
            )
            raise ValueError(f"{what}: OpenCV's costs have 16 bits")
        if self.sub_pixel in other:
            raise ValueError(f"another sub_pixel than {self.sub_pixel} for method {self.method}")
        return self
