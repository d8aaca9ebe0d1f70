"""The projector: a camera that sends light, in radiometric units.

Signal chain: pattern value 0..1 -> black level -> irradiance on the plane at unit distance, constant for a constant
pattern, as for a projector without vignetting -> radiant intensity toward a point -> irradiance there.

With flux Phi [W] of an all-white frame of W x H pixels and focal lengths fx, fy [px], the plane z = 1 receives
E_1 = Phi fx fy / (W H) per unit of its (dimensionless) area; a direction at angle theta to the axis then has the
radiant intensity I = E_1 / cos^3(theta) [W/sr], and a surface at distance r and incidence beta receives
I cos(beta) / r^2 [W/mm^2]. (Mitsuba's own ``projector`` plugin sends pi times that for the same numbers.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera


@dataclass(frozen=True)
class Projector:
    """``optics`` its geometry; ``flux`` [W] of an all-white frame; ``black_level`` light of a black pixel [1]."""

    optics: Camera
    flux: float
    black_level: float = 0.0

    @property
    def plane_irradiance(self) -> float:
        """E_1 [W], irradiance on the plane at unit distance of an all-white frame."""
        optics = self.optics
        return float(self.flux * optics.matrix[0, 0] * optics.matrix[1, 1] / (optics.width * optics.height))

    def emit(self, pattern: NDArray[np.floating]) -> NDArray[np.float32]:
        """What a pattern of values 0..1, shape (..., H, W), sends out relative to white."""
        return (self.black_level + (1.0 - self.black_level) * np.asarray(pattern)).astype(np.float32)
