"""Take a capture in a simulated world.

Signal chain: scene and pose -> radiance per camera and pattern (:mod:`mitsim.scene.transport`) -> blur of the lens
-> photo-electrons -> grey levels with noise (:mod:`mitsim.sensor.imager`) -> :class:`~mitsim.capture.capture.Capture`.

One seed goes in; every camera draws from streams of its own, for the render and for the noise. The fixed pattern of
an imager belongs to the device, not to the capture, and follows from the sensor's name.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mitsim.capture.capture import Capture
from mitsim.scene.camera_rays import CameraRays, Window
from mitsim.scene.lamp import LitPatterns
from mitsim.scene.load import Scene
from mitsim.scene.transport import trace
from mitsim.sensor.camera import Camera
from mitsim.sensor.frames import Transform
from mitsim.sensor.imager import FixedPattern, expose, fixed_pattern
from mitsim.sensor.preset import Sensor

#: pixels traced around what must be seen, for the blur of the lens and the reach of the matcher
_MARGIN_PX = 12


@dataclass(frozen=True)
class Noise:
    """Which sources of noise are switched on."""

    temporal: bool = True
    fixed: bool = True


class SimulatedSensor:
    """A sensor laid out on the device, ready to take any number of captures of any scene."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.rays = {name: CameraRays(camera) for name, camera in sensor.rig.cameras.items()}
        self.patterns = LitPatterns(sensor.patterns(), sensor.projector)
        self.fixed = {name: _fixed(sensor, index, name) for index, name in enumerate(sensor.rig.cameras)}

    def radiance(
        self, scene: Scene, world_from_sensor: Transform, camera: str, *, seed: int, samples: int, depth: int,
        window: Window | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Radiance (P, H, W) [W / (mm^2 sr)] that a camera sees, dark outside the window."""
        rays = self.rays[camera]
        part = window or rays.whole
        images = trace(
            scene, rays, self.patterns, world_from_sensor, samples=samples, seed=seed, depth=depth, window=part
        )
        if self.sensor.imager.blur_px > 0:
            images = np.stack([gaussian_filter(image, self.sensor.imager.blur_px) for image in images])
        if part == rays.whole:
            return images
        whole = np.zeros((len(images), rays.camera.height, rays.camera.width), np.float32)
        whole[:, part.row : part.row + part.height, part.column : part.column + part.width] = images
        return whole

    def capture(
        self, scene: Scene, world_from_sensor: Transform, *, seed: int, samples: int = 16, depth: int = 1,
        around: NDArray[np.floating] | None = None, noise: Noise | None = None,
    ) -> Capture:  # fmt: skip
        """Take one capture.

        Parameters
        ----------
        seed
            Same seed, same bytes; give every capture its own.
        around
            (n, 3) points in the *sensor* frame [mm]: trace only their bounding box in each image. The rest is dark.
        """
        noise = noise or Noise()
        images = {}
        scale = self.sensor.electrons()
        for index, (name, camera) in enumerate(self.sensor.rig.cameras.items()):
            window = None if around is None else bounding_window(camera, around, _MARGIN_PX)
            render, draw = np.random.SeedSequence([seed, index]).spawn(2)
            radiance = self.radiance(
                scene, world_from_sensor, name, seed=int(render.generate_state(1)[0]), samples=samples, depth=depth,
                window=window,
            )  # fmt: skip
            fixed = self.fixed[name] if noise.fixed else None
            rng = np.random.default_rng(draw) if noise.temporal else None
            images[name] = expose(radiance * scale, self.sensor.imager, fixed, rng)
        settings = {
            "exposure_s": self.sensor.exposure_s, "exposure_rule": self.sensor.exposure_rule, "scene": scene.where,
            "seed": seed, "samples_per_pixel": samples, "light_path_depth": depth,
            "noise": {"temporal": noise.temporal, "fixed": noise.fixed},
        }  # fmt: skip
        return Capture(
            sensor=self.sensor.name, technology=self.sensor.technology, source="simulated", rig=self.sensor.rig,
            images=images, bits=self.sensor.imager.bits, settings=settings, world_from_sensor=world_from_sensor,
        )  # fmt: skip


def bounding_window(camera: Camera, points: NDArray[np.floating], margin: int) -> Window | None:
    """Part of a camera's image that holds points (n, 3) of the sensor frame; the whole image if one is behind it."""
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return None
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - margin, 0, [camera.width - 1, camera.height - 1])
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, low + 1, [camera.width, camera.height])
    return Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def _fixed(sensor: Sensor, index: int, name: str) -> FixedPattern:
    camera = sensor.rig.cameras[name]
    device = np.random.SeedSequence([zlib.crc32(sensor.name.encode()), index])
    return fixed_pattern(sensor.imager, (camera.height, camera.width), np.random.default_rng(device))
