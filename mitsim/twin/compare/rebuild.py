"""Rebuild a real capture as a simulated one, its twin.

Signal chain: real capture -> plane of the specimen, its extent and its bend (:mod:`mitsim.twin.finish.find_specimen`)
-> a matt white sheet there (:mod:`mitsim.twin.compare.plate`) -> light of the sensor file's projector, pattern and room
on the cameras of the capture (:mod:`mitsim.capture.simulated.simulate`) -> light scaled to the recorded median grey
level of the specimen in the plain image (:mod:`mitsim.twin.compare.plain_image`) -> exposure by the file's imager ->
capture of source ``simulated``.

*Taken from the recording*: cameras and rectification, pose and bend of the sheet, light code and number of frames,
exposure if known, median grey level. *Taken from the sensor file*: projector, dot pattern, imager, blur. The scale is a
factor on power times reflectance, which no image can separate.

*Projector off.* The matcher uses the specimen's own texture. A flat, evenly lit plate gets it from the recorded
reference image, less its noise, so that the noise is not there twice. The light of a sensor's [room] and the blur of
its lens are in the texture, and are not simulated again.

*Print under structured light.* For a single camera, the print is a factor on every pixel: the recorded plain image over
the rebuilt one. Not included: a print under dots, and objects around the specimen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.exposing import LightOnImagers
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_pattern
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.projector_images import ImagesDescription
from mitsim.sensor.sensor import Sensor
from mitsim.twin.compare.plain_image import median_level, plain_image
from mitsim.twin.compare.plate import REFLECTANCE, plate, printed, texture_of
from mitsim.twin.finish.electrons import chip_of, linearised
from mitsim.twin.finish.find_specimen import MARGIN_PX, image_mask
from mitsim.twin.finish.specimen import LARGER, Specimen

#: rays per pixel
SAMPLES = 16

#: range in which the scale of the light is searched; chosen
_SCALES = (1e-4, 1e4)

#: number of bisections of this range: accurate to a few parts in 10^5
_BISECTIONS = 18


def check_technology(real: Capture, sensor: Sensor, where: str) -> None:
    """Raise an InputError if a sensor is of another technology than a recording."""
    if sensor.technology != real.technology:
        found = f"{sensor.name} of {sensor.technology}"
        if not real.images:
            hint = f"compare its cloud: mitsim measure acceptance CLOUD --plane NAME --simulated {sensor.name}"
            raise InputError(where, "images", f"none: a {real.technology} of the device", f"those of {found}", hint)
        raise InputError("--sensor", "technology", found, f"one of technology {real.technology}, as {where}")


def rebuild(
    real: Capture, sensor: Sensor, specimen: Specimen, where: str, *, projector_on: bool = True, seed: int = 1
) -> Capture:
    """Simulate a real capture, in messages ``where``, with a plane in place of its specimen.

    The sensor supplies projector, pattern and imager. If the projector was not on, the plate has even light and the
    texture that the reference camera recorded. Raises InputError if the sensor has another technology, or takes other
    images than the recording.
    """
    check_technology(real, sensor, where)
    twin_sensor = like(real, sensor, where)
    if not projector_on and real.technology == "structured_light":
        raise InputError("--projector", "", "off", f"on: {where} is structured light, which has no code without it")
    name, plain = next(iter(real.rig.cameras)), plain_image(real)
    chip = chip_of(real, sensor.imager, where)  # rejects another number of bits
    if not projector_on:  # the texture contains room light and lens blur of the recording
        sharp = replace(twin_sensor.imager, blur_px=0.0, corner_blur_px=None)
        twin_sensor = replace(twin_sensor, room=None, imager=sharp)
    simulated = SimulatedSensor(twin_sensor)
    if not projector_on:
        size = twin_sensor.projector.optics.height, twin_sensor.projector.optics.width
        simulated.patterns = ProjectedPatterns(np.ones((1, *size), np.float32), twin_sensor.projector)
    pose, around = specimen.world_from_sensor, specimen.corners()
    noise = Noise() if projector_on else Noise.without("speckle")  # room light has no speckle

    def lit(texture: Floats | None) -> LightOnImagers:
        scene = plate(specimen, twin_sensor, texture)
        return simulated.light(scene, pose, rendering=Rendering(samples=SAMPLES), seed=seed, around=around, noise=noise)

    light, with_print = lit(None), projector_on and not plain.has_dots and len(real.rig.cameras) == 1
    with_print &= not isinstance(twin_sensor.pattern, AmplitudeModulation)
    electrons = linearised(plain.of(real.images[name]), chip)
    if with_print:
        light = printed(light, specimen, real.rig.cameras[name], electrons, name, plain)
    if not projector_on:
        texture = texture_of(specimen, real.rig.cameras[name], electrons, light, name)
        light = lit(texture / texture.max())
    scale = _scale(simulated, light, specimen, real, where, seed)
    scaled = replace(light, radiance={key: values * np.float32(scale) for key, values in light.radiance.items()})
    capture = simulated.expose(scaled, seed)
    power = scale * sensor.projector.flux * REFLECTANCE
    taken = {"median grey level": "power times reflectance was fitted to it"}
    if with_print:
        taken["grey levels, distance"] = "the print was taken from the recording"
    if not projector_on:
        capture = replace(capture, decoding=capture.decoding.model_copy(update={"pattern": None}))
        for quantity in ("contrast", "run length", "grey levels, distance"):
            taken[quantity] = "the texture was taken from the recording"
    capture.settings["projector_on"] = projector_on
    capture.settings["rebuilt"] = {
        "recorded_by": real.sensor,
        "serial": real.serial,
        "power_times_reflectance_w": power if projector_on else None,
        "off_plane_mm": specimen.off_plane,
        "taken": taken,
    }
    return capture


def like(real: Capture, sensor: Sensor, where: str) -> Sensor:
    """Return the sensor with the cameras, the number of frames and the exposure of a recording."""
    count = len(next(iter(real.images.values())))
    projector, pattern = sensor.projector, sensor.pattern
    if real.technology == "structured_light":
        recorded = capture_pattern(real)  # the order of the recorded images
        pattern = pattern if recorded is None or isinstance(recorded, ImagesDescription) else recorded
    if real.rig.projector is not None:
        projector = replace(projector, optics=real.rig.projector)
    if isinstance(pattern, RandomDots) and pattern.frames != count:
        if count > pattern.frames:
            raise InputError("--sensor", "pattern.shifts_px", f"{pattern.frames} frames", f"{count}, as {where} holds")
        shifts = pattern.shifts_px[:count] if count > 1 else []
        pattern = pattern.model_copy(update={"shifts_px": shifts})
    exposure, seconds = sensor.exposure, real.decoding.exposure_s
    if isinstance(seconds, tuple):
        raise InputError(
            where, "settings.exposure_s", f"{len(seconds)} exposures", "one exposure: mitsim does not rebuild a bracket"
        )
    if seconds is not None and seconds > 0:
        exposure = replace(exposure, rule=f"as recorded, {seconds:.3g} s", base_s=seconds, control=None, bracket=None)
    rig = replace(real.rig, projector=projector.optics)
    return replace(sensor, rig=rig, projector=projector, pattern=pattern, exposure=exposure, ambient_image=False)


def _scale(
    simulated: SimulatedSensor, light: LightOnImagers, specimen: Specimen, real: Capture, where: str, seed: int
) -> float:
    """Return the factor of the light, by bisection, with which the specimen's median level is the recorded one.

    Levels have their noise: where a pattern has two levels, few pixels are near the median, and noise moves it.
    """
    name, plain = next(iter(real.rig.cameras)), plain_image(real)
    roi, there = light.rois[name], image_mask(specimen, real.rig.cameras[name], MARGIN_PX)
    if not there.any():
        raise InputError("REAL", "specimen", "no pixels", "a specimen in the image", LARGER)
    if not light.radiance[name].any():
        raise InputError("--sensor", "projector", "no light on the specimen", "a projector that illuminates it")
    wanted, full = median_level(np.bincount(plain.of(real.images[name])[there])), 2**real.bits - 1
    if wanted > full - 0.5:
        found = f"a median grey level of {wanted:.0f} on the specimen, in {plain.name}"
        allowed = f"under {full}, since a saturated image does not determine the power"
        raise InputError(where, "images", found, allowed, "repeat the capture with a shorter exposure")

    def too_bright(scale: float) -> bool:
        radiance = light.radiance[name][list(plain.images)] * np.float32(scale)
        seen = simulated.expose(replace(light, radiance={name: radiance}, rois={name: roi}), seed).images[name]
        return median_level(np.bincount(plain.merged(seen)[there])) > wanted

    low, high = _SCALES
    if too_bright(low) or not too_bright(high):
        flux = simulated.sensor.projector.flux
        found = f"{flux:g} W: no reflectance of {low:g} to {high:g} times {REFLECTANCE} gives {wanted:.0f} DN with it"
        allowed = f"a power near that of the device; the imager and exposure of {where}"
        raise InputError("--sensor", "projector.flux_w", found, allowed)
    for _ in range(_BISECTIONS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if too_bright(middle) else (middle, high)
    return float(np.sqrt(low * high))


def projector_was_on(real: Capture, state: Literal["on", "off"] | None, where: str) -> bool:
    """Return whether the projector was on: as stated, else by settings; InputError if unknown for a textured pair."""
    if state is not None:
        return state == "on"
    setting = real.settings.get("projector_on")
    if isinstance(setting, bool):
        return setting
    if real.technology != "active_stereo" or real.source == "simulated":
        return True
    hint = "give --projector on or off, here or for mitsim import"
    raise InputError(f"{where}/settings.json", "projector_on", "nothing", "true or false", hint)
