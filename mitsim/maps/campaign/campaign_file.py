"""The TOML file of a campaign: coupons, distances, orientations, stage and device."""

from __future__ import annotations

import itertools
import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from characterisation.coupon.orientations import Refinement, cap_directions
from characterisation.files.documents import Document
from mitsim.capture.devices.maker_captures import DeviceTable
from mitsim.maps.campaign.stage_pose import StageTable

#: default ratio of neighbouring distances
DISTANCE_RATIO = 1.6


class SampleEntry(Document):
    """One coupon: a scene with one flat shape in the plane z = 0, and values for the scene's parameters.

    ``spread``: whether the map includes the uncertainty of its finish.
    """

    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)
    spread: bool = False


class Band(Document):
    """Normals up to an incidence, with the density of an icosahedron that is subdivided ``subdivisions`` times."""

    up_to_deg: Annotated[float, Field(gt=0, le=80)]
    subdivisions: int = Field(ge=0, le=6)


class CampaignFile(Document):
    """A campaign TOML file.

    The default of ``distances_mm`` covers the sensor's range in equal ratios of at most ``distance_ratio``.
    ``coupon_px`` is the side of a coupon seen face on, in pixels of the reference camera; its scene then needs a
    parameter ``half_size`` [mm]. ``orientations`` are bands of ascending incidence; ``refine`` makes them denser where
    F or sigma changes fast. ``stage`` excludes orientations that it cannot reach. ``keep_images`` keeps the images of
    every capture, not only the metrics. With ``device``, captures are taken with a live camera, of coupons on a live
    ``stage`` (:mod:`mitsim.maps.campaign.live`).
    """

    distances_mm: Annotated[list[Annotated[float, Field(ge=100, le=20000)]], Field(min_length=1)] | None = None
    distance_ratio: float = Field(default=DISTANCE_RATIO, gt=1, le=10)
    coupon_px: Annotated[float, Field(ge=30, le=5000)] | None = None
    orientations: Annotated[list[Band], Field(min_length=1)]
    refine: Refinement | None = None
    stage: StageTable | None = None
    device: DeviceTable | None = None
    samples: Annotated[list[SampleEntry], Field(min_length=1)]
    samples_per_pixel: int = Field(default=16, ge=1, le=4096)
    keep_images: bool = False
    seed: int = Field(default=1, ge=0)

    @field_validator("orientations")
    @classmethod
    def _growing(cls, bands: list[Band]) -> list[Band]:
        edges = [band.up_to_deg for band in bands]
        if any(b <= a for a, b in itertools.pairwise(edges)):
            raise ValueError("bands in ascending order of up_to_deg")
        return bands

    @property
    def largest_deg(self) -> float:
        """Return the largest incidence of the map [deg]."""
        return self.orientations[-1].up_to_deg

    def edge_in_words(self) -> list[str]:
        """Return where the map ends, if its outermost normals lie over 1 deg inside the campaign's limit."""
        outermost = math.degrees(math.acos(min(1.0, float(self.normals()[:, 2].min()))))
        if outermost > self.largest_deg - 1:
            return []
        return [
            f"the map ends at its outermost normals, {outermost:.1f} deg off the view direction, before up_to_deg = "
            f"{self.largest_deg:g}: to have values there, raise up_to_deg or subdivisions of the last band"
        ]

    def normals(self) -> NDArray[np.float64]:
        """Return unit normals (n, 3) in the view frame (z toward the sensor), band by band from the axis outward."""
        parts, inner = [], -1.0
        for band in self.orientations:
            directions = cap_directions(band.subdivisions, math.radians(band.up_to_deg))
            incidence = np.degrees(np.arccos(np.clip(directions[:, 2], -1, 1)))
            parts.append(directions[incidence > inner])
            inner = band.up_to_deg
        return np.concatenate(parts)
