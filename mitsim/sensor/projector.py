"""Model a projector, a camera that emits light, in radiometric units.

Signal chain: pattern value 0..1 -> response curve -> black level -> irradiance on the plane at unit distance, less
toward the corners -> a point of the lens's aperture -> radiant intensity toward a surface -> irradiance there.

With flux Phi [W] of an all-white frame of W x H pixels and focal lengths fx, fy [px], the plane z = 1 receives
E_1 = Phi fx fy / (W H) per unit of its (dimensionless) area. Every pixel has the same flux, so a lens with distortion
multiplies E_1 by the area of the distorted image of a small area of the plane. A direction at angle theta to the axis
then has the radiant intensity I = E_1 / cos^3(theta) [W/sr], and a surface at distance r and incidence beta receives
I cos(beta) / r^2 [W/mm^2]. (Mitsuba's own ``projector`` plugin emits pi times that for the same numbers.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera


@dataclass(frozen=True)
class Projector:
    """A projector.

    - ``optics``: OpenCV's camera model, all 14 coefficients or fisheye.
    - ``flux`` of an all-white frame, without the loss toward the corners [W].
    - ``black_level``: light of a black pixel relative to white [1].
    - ``gamma`` of the response curve: a pixel of value p emits p^gamma [1].
    - ``aperture_mm``: diameter of the lens's exit pupil; 0 is a point.
    - ``focus_mm``: distance of the plane of sharp focus along the axis. A point at depth z receives light from the
      projector pixels in a disc of diameter aperture f |1/z - 1/focus| px.
    - ``corner_illumination`` of the image's corner relative to the centre [1], in the form of the cos^4 law.
    - ``pixel_gap``: dark share of the pitch between two pixels [1], as between the mirrors of a DMD; 0 is a continuous
      image.
    """

    optics: Camera
    flux: float
    black_level: float = 0.0
    gamma: float = 1.0
    aperture_mm: float = 0.0
    focus_mm: float = np.inf
    corner_illumination: float = 1.0
    pixel_gap: float = 0.0

    @cached_property
    def is_stretched(self) -> bool:
        """Whether distortion changes the irradiance."""
        return self.optics.model == "fisheye" or bool(self.optics.distortion.any())

    def recalibrated(self, optics: Camera) -> Projector:
        """Return the projector with optics close to its own: without distortion, it keeps its irradiance."""
        other = replace(self, optics=optics)
        vars(other)["is_stretched"] = self.is_stretched  # no field: checksums of sensors contain the fields
        return other

    @property
    def plane_irradiance(self) -> float:
        """Return E_1 [W], the irradiance at the centre of the plane at unit distance for an all-white frame."""
        optics = self.optics
        return float(self.flux * optics.matrix[0, 0] * optics.matrix[1, 1] / (optics.width * optics.height))

    def plate_radiance(self, reflectance: float, distance_mm: float) -> float:
        """Return the radiance [W / (mm^2 sr)] of a matt plate across the axis, in an all-white frame."""
        return float(reflectance / np.pi * self.plane_irradiance / distance_mm**2)

    def emit(self, pattern: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the light that a pattern of values 0..1, shape (..., H, W), emits relative to white."""
        values = np.asarray(pattern, np.float32)
        if self.gamma != 1.0:
            values = np.power(np.clip(values, 0.0, 1.0), np.float32(self.gamma))
        return np.float32(self.black_level) + np.float32(1.0 - self.black_level) * values
