"""Define the result of decoding a code: the projector coordinate that each camera pixel sees, and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status


@dataclass(frozen=True)
class ProjectorCoordinate:
    """Projector column or row seen by each pixel of a camera, (H, W)."""

    value: NDArray[np.float64]  # coordinate [projector px], float64, with pixel centres at integers; NaN if rejected
    #: standard deviation by noise, or by the width of a stripe [projector px], float32; NaN if unknown
    sigma: NDArray[np.float32]
    modulation: NDArray[np.float32]  # half of white minus black, or the amplitude of the weakest fringe [DN], float32
    #: uint8 of :class:`~characterisation.point_cloud.Status`: VALID, SATURATED, LOW_MODULATION, PHASE_INCONSISTENT, or
    #: AMBIGUOUS after interpolation between stripes
    status: NDArray[np.uint8]

    @property
    def lit(self) -> NDArray[np.bool_]:
        """(H, W) whether the pixel shows the code, although its bits or phases may contradict one another."""
        return np.isin(self.status, [Status.VALID, Status.PHASE_INCONSISTENT])

    def part(self, region: tuple[slice, slice]) -> ProjectorCoordinate:
        """Return the coordinate of a region (rows, columns), without copying it."""
        value, sigma = self.value[region], self.sigma[region]
        return ProjectorCoordinate(value, sigma, self.modulation[region], self.status[region])

    def placed(self, shape: tuple[int, int], region: tuple[slice, slice]) -> ProjectorCoordinate:
        """Return the coordinate of a region (rows, columns) as that of its image (H, W), which is dark elsewhere."""
        value, sigma = np.full(shape, np.nan), np.full(shape, np.nan, np.float32)
        modulation, status = np.zeros(shape, np.float32), np.full(shape, Status.LOW_MODULATION, np.uint8)
        value[region], sigma[region] = self.value, self.sigma
        modulation[region], status[region] = self.modulation, self.status
        return ProjectorCoordinate(value, sigma, modulation, status)
