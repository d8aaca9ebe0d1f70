"""Light on the imagers of a sensor, and its exposure: radiance to the grey levels of every image.

The fixed pattern of an imager belongs to the device, not to the capture, and follows from the sensor's name. Every
image has a stream of noise of its own.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.threads import in_threads
from mitsim.sensor.image_formation import FixedPattern, converter, expose, fixed_pattern
from mitsim.sensor.modulation import AmplitudeModulation, delay_pattern, delayed, expose_taps
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class LightOnImagers:
    """Light that reaches the imagers from one pose: all that a capture needs but the noise of the imagers.

    ``radiance`` (P, h, w) of every camera [W / (mm^2 sr)] in its ``rois``; the ``exposures`` [s]; which ``noise`` is
    on; ``rendered`` how: scene, samples_per_pixel, light_path_depth, and indirect_light where that is apart.
    """

    radiance: dict[str, NDArray[np.float32]]
    rois: dict[str, Roi]
    exposures: tuple[float, ...]
    noise: Noise
    world_from_sensor: Transform
    rendered: dict[str, Any]


@dataclass(frozen=True)
class UnitPatterns:
    """Patterns of one unit's imager.

    ``fixed`` pattern of its pixels; ``delays`` (H, W) that the pixels of a time-of-flight camera add to the optical
    path [mm], None without any.
    """

    fixed: FixedPattern
    delays: NDArray[np.float32] | None

    @classmethod
    def of(cls, sensor: Sensor, index: int, name: str) -> UnitPatterns:
        """Draw the patterns of a sensor's camera, number ``index``; they follow from the sensor's name."""
        camera, code = sensor.rig.cameras[name], sensor.pattern
        size, device = (camera.height, camera.width), [zlib.crc32(sensor.name.encode()), index]
        fixed = fixed_pattern(sensor.imager, size, np.random.default_rng(np.random.SeedSequence(device)))
        if not isinstance(code, AmplitudeModulation) or code.delay_pattern_mm == 0:
            return cls(fixed, None)
        return cls(fixed, delay_pattern(code, size, np.random.default_rng(np.random.SeedSequence([*device, 1]))))

    def moved(self, rows: int, columns: int) -> UnitPatterns:
        """Return the patterns moved round by some rows and columns, as good as another unit's."""
        fixed, step = self.fixed, (rows, columns)
        moved = FixedPattern(
            np.roll(fixed.offset, step, (0, 1)),
            np.roll(fixed.response, step, (0, 1)),
            np.roll(fixed.column, columns),
        )
        return UnitPatterns(moved, None if self.delays is None else np.roll(self.delays, step, (0, 1)))


def brightest(sensor: Sensor, radiance: dict[str, NDArray[np.float32]]) -> NDArray[np.float32] | None:
    """Electrons per second of the brightest image of every camera, flat; None if the exposure does not depend on it."""
    if sensor.exposure.base_s is not None:
        return None
    flat = []
    for name, stack in radiance.items():
        camera, image = sensor.rig.cameras[name], stack[np.argmax(stack.mean(axis=(1, 2)))]
        # the rule asks for shares of the whole image: pixels that are not read out count as dark
        flat += [image.ravel(), np.zeros(camera.width * camera.height - image.size, np.float32)]
    return np.concatenate(flat) * np.float32(sensor.electrons())


def exposed(
    sensor: Sensor, light: LightOnImagers, camera: str, patterns: UnitPatterns, stream: np.random.SeedSequence
) -> NDArray[np.unsignedinteger[Any]]:
    """Expose the imager of a camera: grey levels of every image at every exposure, all at the shortest first.

    Pixels outside of the region that is read out are 0.
    """
    imager, scale, noise, inside = sensor.imager, sensor.electrons(), light.noise, light.rois[camera].slices
    radiance, exposures = light.radiance[camera], light.exposures
    device, eye = patterns.fixed, sensor.rig.cameras[camera]
    fixed = FixedPattern(device.offset[inside], device.response[inside], device.column[inside[1]])
    code, delays = sensor.pattern, patterns.delays
    levels = np.uint8 if converter(imager, noise).bits <= 8 else np.uint16
    count = len(radiance) if isinstance(code, AmplitudeModulation) else len(exposures) * len(radiance)
    out = np.zeros((count, eye.height, eye.width), levels)  # memory that is not written to costs nothing
    if isinstance(code, AmplitudeModulation):
        seconds = exposures[0]
        taps = radiance if delays is None or not noise.dsnu else delayed(radiance, code, delays[inside])
        electrons = taps * np.float32(scale * seconds)
        rng = np.random.default_rng(stream)
        out[:, *inside] = expose_taps(electrons, code, imager, fixed, noise, rng, seconds)
        return out

    def expose_image(image: tuple[int, np.random.SeedSequence]) -> None:
        index, own = image
        seconds = exposures[index // len(radiance)]
        electrons = radiance[index % len(radiance)] * np.float32(scale * seconds)
        rng = np.random.Generator(np.random.SFC64(own))  # a quarter faster than the default
        out[index][inside] = expose(electrons, imager, fixed, noise, rng, seconds)

    in_threads(expose_image, enumerate(stream.spawn(count)))  # every image has a stream of its own
    return out
