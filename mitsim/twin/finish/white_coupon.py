"""Render a white coupon in front of a sensor, with one projected image in place of the patterns.

Signal chain: patterns of the sensor -> their light, averaged -> one image -> radiance of the white coupon at the pose
of the coupon -> electrons per second in each pixel.

The projected pattern of a device may not be that of the sensor file. A uniform image of the same mean level then
replaces it, and the dots count as grain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.differentiable import lambertian_coupon
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.sensor.camera import Camera
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.working_volume import roi_around
from mitsim.twin.finish.specimen import Specimen

#: image in place of a sensor's patterns: the mean of all patterns; a uniform image of their mean level; the first one
Pattern = Literal["mean", "level", "first"]

#: margin around the coupon [px]
_MARGIN_PX = 12


class WhiteCouponRenderer:
    """A sensor that renders white coupons, prepared once; its projector shows one image in place of its patterns."""

    def __init__(self, sensor: Sensor, samples: int = 16) -> None:
        self.sensor, self.samples = sensor, samples
        # white() sets the image; a placeholder here keeps the patterns from being loaded on the device all at once
        self._simulated = SimulatedSensor(replace(sensor, pattern=RandomDots(kind="random_dots", run_length_px=10.0)))
        self._lit: dict[Pattern, ProjectedPatterns] = {}

    def corner_loss(self, camera: str) -> NDArray[np.float32] | None:
        """Return the relative illumination of a camera's lens (H, W) [1], None if it is uniform."""
        return self._simulated.corner_loss[camera]

    def white(self, specimen: Specimen, camera: str, roi: Roi, pattern: Pattern) -> Floats:
        """Return electrons per second (h, w) [e-/s] in a region that shows a Lambertian coupon of reflectance 1.

        Parameters
        ----------
        specimen, camera, roi, pattern
            Pose and size of the coupon, name of the camera, region of its image, and image of the projector.
        """
        if pattern not in self._lit:
            self._lit[pattern] = self._projected(pattern)
        self._simulated.patterns = self._lit[pattern]
        scene = lambertian_coupon(*specimen.size, self.sensor.wavelength_nm)
        rendering = Rendering(samples=self.samples, depth=1)
        radiance = self._simulated.radiance(scene, specimen.world_from_sensor, camera, rendering, seed=0, roi=roi)
        return np.asarray(radiance[0], np.float64) * self.sensor.electrons()

    def _projected(self, pattern: Pattern) -> ProjectedPatterns:
        projector, frames = self.sensor.projector, self.sensor.patterns()
        if pattern == "first":
            frames = frames[:1]
        total = np.zeros(frames.shape[1:])
        for frame in frames:  # summed one by one to save memory
            total += projector.emit(frame)
        sent = np.asarray(total[None] / len(frames), np.float32)
        if pattern == "level":
            sent = np.full_like(sent, sent.mean())
        values = (sent - projector.black_level) / (1.0 - projector.black_level)
        values = np.clip(values, 0.0, 1.0) ** (1.0 / projector.gamma)
        return ProjectedPatterns(values.astype(np.float32), projector)


def coupon_roi(camera: Camera, specimen: Specimen) -> Roi:
    """Return the region of a camera's image that holds a coupon and a margin of 12 px."""
    return roi_around(camera, specimen.corners(), _MARGIN_PX) or Roi.whole(camera.width, camera.height)
