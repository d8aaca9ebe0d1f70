"""What a decoded code says about each pixel of a camera: from where on the projector its light came, and how surely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ProjectorCoordinate:
    """Projector column or row seen by each pixel of a camera (H, W).

    ``value`` float64 [projector px], pixel centres at integers, NaN where refused; ``sigma`` float32 [projector px],
    the standard deviation from noise or the width of a stripe, NaN where unknown; ``modulation`` float32
    [DN], half of what the projector can do at this pixel, from black to white or from crest to trough of the weakest
    fringe; ``status`` uint8 of :class:`~characterisation.point_cloud.Status`: VALID, SATURATED, LOW_MODULATION or
    PHASE_INCONSISTENT.
    """

    value: NDArray[np.float64]
    sigma: NDArray[np.float32]
    modulation: NDArray[np.float32]
    status: NDArray[np.uint8]
