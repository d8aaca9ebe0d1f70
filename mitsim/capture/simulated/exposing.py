"""Expose the imagers of a sensor: from radiance to the grey levels of all images, and their capture.

Signal chain: radiance -> electrons per second -> exposure -> fixed pattern of the unit, noise of each image -> grey
levels.

The fixed pattern of an imager belongs to the device, not to the capture; it is drawn from the name of the sensor. Each
image has its own random stream of noise.
"""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.threads import in_threads
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.sensor.fitted_to import records_of
from mitsim.sensor.image_formation import FixedPattern, converter, expose, fixed_pattern
from mitsim.sensor.modulation import AmplitudeModulation, delay_pattern, delayed, expose_taps, fullest_tap
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.projector_images import described
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class LightOnImagers:
    """Light on the imagers from one pose: all inputs of a capture except the noise of the imagers.

    - ``radiance``: (P, h, w) of each camera in its region of ``rois`` [W / (mm^2 sr)].
    - ``exposures``: exposure times [s]; ``noise``: the sources of noise that are on.
    - ``rendered``: settings of the rendering: scene, samples_per_pixel, light_path_depth, and indirect_light if it is
      rendered separately.
    - ``other``: (h, w) of each camera, the part of every image's radiance that is not the projector's: of a scene with
      emitters, or a sensor in a known room.
    """

    radiance: dict[str, NDArray[np.float32]]
    rois: dict[str, Roi]
    exposures: tuple[float, ...]
    noise: Noise
    world_from_sensor: Transform
    rendered: dict[str, Any]
    other: dict[str, NDArray[np.float32]] = field(default_factory=dict)


@dataclass(frozen=True)
class UnitPatterns:
    """Fixed patterns of the imager of one unit.

    ``fixed``: the pattern of its pixels. ``delays`` (H, W) [mm]: optical path that the pixels of a time-of-flight
    camera add; None without any.
    """

    fixed: FixedPattern
    delays: NDArray[np.float32] | None

    @classmethod
    def of(cls, sensor: Sensor, index: int, name: str) -> UnitPatterns:
        """Draw the patterns of a sensor's camera with this index; the seed is the name of the sensor."""
        camera, code = sensor.rig.cameras[name], sensor.pattern
        size, device = (camera.height, camera.width), [zlib.crc32(sensor.name.encode()), index]
        fixed = fixed_pattern(sensor.imager, size, np.random.default_rng(np.random.SeedSequence(device)))
        if not isinstance(code, AmplitudeModulation) or code.delay_pattern_mm == 0:
            return cls(fixed, None)
        return cls(fixed, delay_pattern(code, size, np.random.default_rng(np.random.SeedSequence([*device, 1]))))

    def shifted(self, rows: int, columns: int) -> UnitPatterns:
        """Return the patterns shifted cyclically by some rows and columns.

        Pixels are independent, so this is equivalent to another unit's patterns.
        """
        fixed, step = self.fixed, (rows, columns)
        offset, response = (np.roll(values, step, (0, 1)) for values in (fixed.offset, fixed.response))
        rolled = FixedPattern(offset, response, np.roll(fixed.column, columns))
        return UnitPatterns(rolled, None if self.delays is None else np.roll(self.delays, step, (0, 1)))


def shifted_units(units: dict[str, UnitPatterns], seed: int) -> dict[str, UnitPatterns]:
    """Return the patterns of each camera, shifted by random rows and columns."""
    shifts = np.random.default_rng(seed).integers(1, 10_000, (len(units), 2))
    return {name: unit.shifted(*step) for (name, unit), step in zip(units.items(), shifts, strict=True)}


def brightest_images(sensor: Sensor, radiance: dict[str, NDArray[np.float32]]) -> NDArray[np.float32] | None:
    """Return the electrons per second of the brightest image of each camera, as one flat array.

    For time of flight they are those of the fullest tap of each pixel. None if the exposure is fixed.
    """
    if sensor.exposure.base_s is not None:
        return None
    flat = []
    for name, stack in radiance.items():
        camera, code = sensor.rig.cameras[name], sensor.pattern
        if isinstance(code, AmplitudeModulation):
            image = fullest_tap(stack, code)
        else:
            image = stack[np.argmax(stack.mean(axis=(1, 2)))]
        # the exposure rule refers to the whole image: pixels that are not read out count as dark
        flat += [image.ravel(), np.zeros(camera.width * camera.height - image.size, np.float32)]
    return np.concatenate(flat) * np.float32(sensor.electrons())


def expose_camera(
    sensor: Sensor, light: LightOnImagers, camera: str, patterns: UnitPatterns, stream: np.random.SeedSequence
) -> NDArray[np.unsignedinteger[Any]]:
    """Expose the imager of a camera; return its images as grey levels (count, H, W); ``stream`` seeds the noise.

    All images at the shortest exposure come first, then those at the next. Pixels outside the region that is read out
    are 0.
    """
    imager, scale, noise, inside = sensor.imager, sensor.electrons(), light.noise, light.rois[camera].slices
    radiance, exposures = light.radiance[camera], light.exposures
    unit, view = patterns.fixed, sensor.rig.cameras[camera]
    fixed = FixedPattern(unit.offset[inside], unit.response[inside], unit.column[inside[1]])
    code, delays = sensor.pattern, patterns.delays
    levels = np.uint8 if converter(imager, noise).bits <= 8 else np.uint16
    count = len(radiance) if isinstance(code, AmplitudeModulation) else len(exposures) * len(radiance)
    out = np.zeros((count, view.height, view.width), levels)  # memory that is never written needs no pages
    if isinstance(code, AmplitudeModulation):
        seconds = exposures[0]
        taps = radiance if delays is None or not noise.dsnu else delayed(radiance, code, delays[inside])
        electrons = taps * np.float32(scale * seconds)
        rng = np.random.default_rng(stream)
        out[:, *inside] = expose_taps(electrons, code, imager, fixed, noise, rng, seconds)
        return out

    def expose_image(image: tuple[int, np.random.SeedSequence]) -> None:
        index, image_stream = image
        seconds = exposures[index // len(radiance)]
        electrons = radiance[index % len(radiance)] * np.float32(scale * seconds)
        rng = np.random.Generator(np.random.SFC64(image_stream))  # a quarter faster than the default generator
        out[index][inside] = expose(electrons, imager, fixed, noise, rng, seconds)

    in_threads(expose_image, enumerate(stream.spawn(count)))  # each image has its own stream
    return out


def capture_of(
    sensor: Sensor, light: LightOnImagers, images: dict[str, NDArray[np.unsignedinteger[Any]]], seed: int
) -> Capture:
    """Return the capture of the images of :func:`expose_camera`, with all that decoding needs and records.

    ``seed`` is that of the noise.
    """
    adc, exposures = converter(sensor.imager, light.noise), light.exposures
    whole = {name: Roi.whole(camera.width, camera.height) for name, camera in sensor.rig.cameras.items()}
    decoding = Decoding(
        decoder=sensor.settings,
        imager=adc,
        pattern=described(sensor.pattern),
        exposure_s=exposures[0] if len(exposures) == 1 else tuple(exposures),
        black_level_dn=adc.black_level,
        gamma=adc.gamma,
        ambient_image=sensor.ambient_image,
        read_out={name: roi for name, roi in light.rois.items() if roi != whole[name]},
    )
    records = {"exposure_rule": sensor.exposure.rule, **light.rendered, "seed": seed, "noise": asdict(light.noise)}
    records |= records_of(sensor.fitted_to)
    return Capture(
        sensor=sensor.name,
        technology=sensor.technology,
        source="simulated",
        rig=sensor.rig,
        images=images,
        bits=adc.bits,
        decoding=decoding,
        settings=records,
        world_from_sensor=light.world_from_sensor,
    )
