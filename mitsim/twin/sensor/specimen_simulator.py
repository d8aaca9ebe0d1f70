"""Simulate a flat specimen in front of one camera for varying sensor parameters: the forward model of the fit.

Signal chain: pose and bend of the specimen -> light of the projector's pattern on one camera, traced once for each
pattern (:mod:`mitsim.capture.simulated.simulate`) -> power, and light of the room -> blur and corner loss of the lens
-> electrons -> grey levels (:mod:`mitsim.sensor.image_formation`). It is the signal chain of every simulated
capture, except that results which a parameter does not affect are cached.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.lens_blur import blur_by_lens
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.simulated.surface_speckle import draw_speckle
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.load import Scene
from mitsim.sensor.camera import Rig
from mitsim.sensor.image_formation import expose, fixed_pattern
from mitsim.sensor.imager import electrons_per_radiance
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.vignetting import camera_illumination
from mitsim.twin.compare.plate import REFLECTANCE, plate
from mitsim.twin.finish.specimen import Specimen

#: rays per pixel; chosen
_SAMPLES = 16

#: largest number of cached renders, which bounds the memory; chosen
_KEPT = 48

#: pixels around the window, for the reach of the lens blur and of the features
MARGIN_PX = 12


class SpecimenSimulator:
    """The reference camera of a sensor in front of a specimen; ``part`` is the evaluated window of its image."""

    def __init__(self, sensor: Sensor, specimen: Specimen, roi: Roi) -> None:
        name, camera = next(iter(sensor.rig.cameras.items()))
        self.name, self.camera, self.specimen = name, camera, specimen
        left, top = max(roi.left - MARGIN_PX, 0), max(roi.top - MARGIN_PX, 0)
        right, bottom = min(roi.right + MARGIN_PX, camera.width), min(roi.bottom + MARGIN_PX, camera.height)
        self.roi = Roi.between(left, top, right, bottom)
        self.inner = Roi(roi.left - self.roi.left, roi.top - self.roi.top, roi.width, roi.height).slices
        self._scene: Scene = plate(specimen, sensor, None)
        self._kept: dict[Any, NDArray[np.float32]] = {}
        self._device: SimulatedSensor | None = None
        rays = camera.rays_to_fold(np.stack(self.roi.pixels(), axis=-1).astype(float))
        self._directions = np.asarray(camera.sensor_from_camera.directions(rays))
        self._loss = lru_cache(maxsize=1)(self._corner_loss)  # of the light of the room and that of the projector

    def levels(self, sensor: Sensor, seed: int) -> NDArray[Any]:
        """Return the grey levels (h, w) of the part in the first image of a capture by a sensor."""
        lit, gain = self._lit(sensor, seed)
        room = np.float32(REFLECTANCE / np.pi) * sensor.room_irradiance(self._directions)
        light = self._through(sensor, np.asarray(room, np.float32))
        light = light + self._through(sensor, lit * np.float32(sensor.projector.flux)) * gain
        assert sensor.exposure.base_s is not None
        chip, seconds = sensor.imager, sensor.exposure.base_s
        scale = electrons_per_radiance(chip, sensor.wavelength_nm, seconds)
        noise, device = np.random.SeedSequence([seed, 1]).spawn(2)
        varies = chip.dsnu or chip.prnu or chip.column_pattern
        fixed = fixed_pattern(chip, light.shape, np.random.default_rng(device)) if varies else None
        seen = expose(light * np.float32(scale), chip, fixed, Noise(), np.random.default_rng(noise), seconds)
        return np.asarray(seen[self.inner])

    def projector_irradiance(self, sensor: Sensor, seed: int) -> float:
        """Return the mean irradiance [W/mm^2] of the projector, with its pattern, on the specimen."""
        return float(self._lit(sensor, seed)[0][self.inner].mean()) * np.pi / REFLECTANCE * sensor.projector.flux

    def _through(self, sensor: Sensor, image: NDArray[np.float32]) -> NDArray[np.float32]:
        loss = self._loss(sensor.imager.corner_illumination)
        out = blur_by_lens(image, sensor.imager, self.camera, self.roi)
        return out if loss is None else np.asarray(out * loss, np.float32)

    def _corner_loss(self, corner: float | None) -> NDArray[np.float32] | None:
        loss = camera_illumination(corner, self.camera)
        return None if loss is None else loss[self.roi.slices]

    def _lit(self, sensor: Sensor, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the light of the projector at 1 W before the lens, and the gain of speckle behind it."""
        projector = replace(sensor.projector, flux=1.0)
        names = ("black_level", "gamma", "aperture_mm", "focus_mm", "corner_illumination")
        key = (str(sensor.pattern), *(getattr(projector, name) for name in names), seed)
        if key not in self._kept:
            while len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            bare = replace(sensor.imager, blur_px=0.0, corner_blur_px=None, corner_illumination=1.0)
            pattern, rig = sensor.pattern, Rig({self.name: self.camera}, sensor.rig.projector)
            if getattr(pattern, "shifts_px", None):
                pattern = pattern.model_copy(update={"shifts_px": []})  # type: ignore[union-attr]
            bare_sensor = replace(sensor, projector=projector, imager=bare, pattern=pattern, rig=rig)
            bare_sensor = replace(bare_sensor, room=None, ambient_image=False)
            simulated = self._of(bare_sensor)
            pose, rays = self.specimen.world_from_sensor, simulated.pixel_rays(self.name)
            rng = np.random.default_rng(np.random.SeedSequence([seed, 2]))
            speckle = draw_speckle(self._scene, bare_sensor, self.camera, rays, pose, self.roi, rng)
            still = None if speckle is None else replace(speckle, gain=np.ones_like(speckle.gain))
            shown: dict[str, Any] = {"seed": seed, "roi": self.roi, "speckle": still}
            rendering = Rendering(samples=_SAMPLES, depth=1)
            radiance = simulated.radiance(self._scene, pose, self.name, rendering, **shown)[0]
            gain = np.ones_like(radiance) if speckle is None else np.asarray(speckle.gain, np.float32)
            self._kept[key] = np.stack([radiance, gain])
        lit, gain = self._kept[key]
        return lit, gain

    def _of(self, sensor: Sensor) -> SimulatedSensor:
        """Return the simulated sensor; its rays are cached, and only the pattern is new."""
        if self._device is None:
            self._device = SimulatedSensor(sensor)
            return self._device
        other = copy.copy(self._device)
        other.sensor = sensor
        other.patterns = ProjectedPatterns(sensor.patterns(), sensor.projector)
        return other
