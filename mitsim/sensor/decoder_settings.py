"""Limits of a structured-light decoder, and of a device's own maps; :mod:`mitsim.decoding` does the decoding."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from characterisation.files.documents import Document


class DepthSettings(Document):
    """Settings of any decoder: points are accepted between the depths ``near_mm`` and ``far_mm``."""

    #: setting of the least level, which refers to an exposure
    level_key: ClassVar[str] = ""

    near_mm: float = Field(ge=1e-3, le=1e7)
    far_mm: float = Field(ge=1e-3, le=1e7)

    @model_validator(mode="after")
    def _check_depths(self) -> Self:
        if self.near_mm >= self.far_mm:
            raise ValueError("near_mm under far_mm")
        return self

    def at_exposure(self, share: float) -> Self:
        """Return the settings for an exposure shorter by ``share`` than the one to which the limits refer."""
        changed = {self.level_key: getattr(self, self.level_key) * share} if self.level_key else {}
        return self.model_copy(update=changed)


class DecoderSettings(DepthSettings):
    """Limits of a structured-light decoder, and its filter. Nothing is filled: lost points stay lost.

    - ``near_mm``, ``far_mm``: range of accepted depths along the camera's axis.
    - ``minimum_modulation_dn``: least accepted amplitude of fringes, or half the step from black to white [DN of 8 bit,
      that is 1/255 of full scale; the default is assumed].
    - ``consistency_sigma``: number of standard deviations by which the phases of two periods may disagree.
    - ``systematic_rad``: standard deviation [rad] added to the noise of every phase for systematic errors (gamma, blur;
      the default is assumed).
    - ``bit_share``: a Gray bit is undecided if its contrast is under this share of white minus black (assumed).
    - ``epipolar_px``: largest distance, in projector pixels, of the second coordinate of a two-axis code from the
      point that the first coordinate gives (assumed).
    - ``correct_gamma``: estimate the projector's gamma from the images and remove its effect on the phase. Needs five
      or more steps, or a white and a black image.
    - ``smoothing_px``: standard deviation of a Gaussian mean over the distances of neighbouring points, as makers apply
      it; 0 for none.
    - ``triangulate``: between the first camera and the ``projector``, or between two ``cameras``; in the latter case
      the projector only provides the code.
    """

    level_key = "minimum_modulation_dn"

    minimum_modulation_dn: float = Field(default=2.0, ge=0)
    consistency_sigma: float = Field(default=5.0, gt=0)
    systematic_rad: float = Field(default=0.05, ge=0, le=1)
    bit_share: float = Field(default=0.1, ge=0, lt=1)
    epipolar_px: float = Field(default=2.0, gt=0)
    correct_gamma: bool = False
    smoothing_px: float = Field(default=0.0, ge=0, le=10, repr=False)
    triangulate: Literal["projector", "cameras"] = "projector"


class DeviceMapSettings(DepthSettings):
    """Range of depths along the camera's axis in which points are accepted: ``near_mm`` to ``far_mm``."""
