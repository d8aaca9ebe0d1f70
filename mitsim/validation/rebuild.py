"""A real capture once more as a simulated one: its twin.

Signal chain: real capture -> cloud, by its own decoder -> plane of the specimen, and the part of it that the user
named, else what holds points (:mod:`mitsim.fit.specimen`) -> a matt white plate there -> light of the sensor file's
projector and pattern on the capture's own cameras (:mod:`mitsim.capture.simulate`) -> light scaled until the median
grey level of the specimen is the recorded one, in the plain image (:mod:`mitsim.validation.plain_image`) -> exposure by
the file's imager -> capture of source ``simulated``.

*Taken from the recording*: cameras and rectification, place of the plane, light code and number of frames, exposure
where it says so, median grey level. *Taken from the sensor file*: projector, pattern of dots, imager, blur. What is
scaled is power times reflectance: no image can tell the two apart.

*Projector off.* There is no pattern then, and what the matcher holds on to is the specimen's own texture. The plate
gets it from the recorded reference image, smoothed by a Gaussian of 1 px so that its noise is not there twice, and is
lit evenly. The second camera sees the same texture from where it stands, through a calibration that is exact.

Left out: the specimen's bend, its print where the projector is on, light of the room, anything beside the specimen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from mitsim.capture.capture import Capture
from mitsim.capture.cloud import capture_pattern
from mitsim.capture.simulate import LightOnImagers, SimulatedSensor, bounding_window
from mitsim.errors import InputError
from mitsim.fit.electrons import chip_of, linearised
from mitsim.fit.place import Place
from mitsim.fit.specimen import GRAZING, feet_of
from mitsim.scene import backend
from mitsim.scene.camera_rays import Window as CameraWindow
from mitsim.scene.lamp import LitPatterns
from mitsim.scene.load import Scene, scene_from_dict
from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Noise
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.preset import Sensor
from mitsim.validation.plain_image import PlainImage, plain_image

Floats = NDArray[np.float64]

#: of the twin's plate where it has no texture; what is fitted is its product with the power
REFLECTANCE = 0.85

#: rays per pixel
SAMPLES = 16

#: pixels inside the specimen's outline that are not looked at: its edge is blurred, and matched with what is behind
MARGIN_PX = 15.0

#: factors of the light between which the fitted one lies, and halvings of them: to a few parts in 10^5
_SCALES, _BISECTIONS = (1e-4, 1e4), 18

#: smoothing of the recorded texture [px]
_TEXTURE_BLUR_PX = 1.0
#: texels for each pixel's footprint, and along a side at most
_TEXELS_PER_PX, _LARGEST_TEXTURE = 2.0, 4096


@dataclass(frozen=True)
class Twin:
    """A real capture rebuilt: the simulated ``capture``, and the fitted ``power_times_reflectance`` [W]."""

    capture: Capture
    power_times_reflectance: float


def rebuild(
    real: Capture, sensor: Sensor, place: Place, where: str, *, projector_on: bool = True, seed: int = 1
) -> Twin:
    """Take a real capture once more in a simulated world, with a plane in place of its specimen.

    Parameters
    ----------
    sensor
        Whose projector, pattern and imager stand in for those of the device.
    place
        Of the specimen, from :func:`mitsim.fit.specimen.specimen_place`.
    projector_on
        False gives the plate the texture that the reference camera recorded, and even light.

    Raises
    ------
    InputError
        If the sensor is of another technology, or takes other images than the recording holds.
    """
    if sensor.technology != real.technology:
        allowed = f"one of technology {real.technology}, as {where}"
        raise InputError("--sensor", "technology", f"{sensor.name} of {sensor.technology}", allowed)
    like = _like(real, sensor, where)
    if not projector_on and real.technology == "structured_light":
        allowed = f"on: {where} is structured light, which has no code without it"
        raise InputError("--projector", "", "off", allowed)
    name, plain = next(iter(real.rig.cameras)), plain_image(real)
    chip = chip_of(real, sensor.imager, where)  # refuses another number of bits
    simulated = SimulatedSensor(like)
    if not projector_on:
        size = like.projector.optics.height, like.projector.optics.width
        simulated.patterns = LitPatterns(np.ones((1, *size), np.float32), like.projector)
    pose, around = place.world_from_sensor, place.corners()
    noise = Noise() if projector_on else Noise.without("speckle")  # light of a room makes none

    def lit(texture: Floats | None) -> LightOnImagers:
        scene = _plate(place, like, texture)
        return simulated.light(scene, pose, seed=seed, samples=SAMPLES, around=around, noise=noise)

    light = lit(None)
    if not projector_on:
        electrons = linearised(plain.of(real.images[name]), chip)
        texture = _texture(place, real.rig.cameras[name], electrons, light, name)
        light = lit(texture / texture.max())
    scale = _scale(simulated, light, place, real, name, plain, seed, where)
    scaled = replace(light, radiance={key: values * np.float32(scale) for key, values in light.radiance.items()})
    capture = simulated.expose(scaled, seed)
    power = scale * sensor.projector.flux * REFLECTANCE
    taken = {"median grey level": "power times reflectance was fitted to it"}
    if not projector_on:
        capture.settings["pattern"] = None
        for quantity in ("contrast", "run length", "grey levels, distance"):
            taken[quantity] = "the texture was taken from the recording"
    capture.settings["projector_on"] = projector_on
    capture.settings["rebuilt"] = {
        "recorded_by": real.sensor, "serial": real.serial, "power_times_reflectance_w": power if projector_on else None,
        "off_plane_mm": place.off_plane, "taken": taken,
    }  # fmt: skip
    return Twin(capture, power if projector_on else float("nan"))


def on_specimen(place: Place, origin: Floats, rays: Floats, pitch: float, margin_px: float) -> NDArray[np.bool_]:
    """Which view rays (..., 3), unit and in the sensor frame, meet the specimen, a margin [px] inside its outline.

    ``origin`` (3,) of the rays [mm]; ``pitch`` between neighbouring ones [rad].
    """
    points, reach, cosine = feet_of(place.world_from_sensor, origin, rays)
    down = cosine > GRAZING
    inside = np.zeros(rays.shape[:-1], bool)
    margin = margin_px * pitch * reach[down] / cosine[down]
    inside[down] = place.holds(points[down], margin)
    return inside


def _like(real: Capture, sensor: Sensor, where: str) -> Sensor:
    """The sensor with the cameras, the number of frames and the exposure of a recording."""
    count = len(next(iter(real.images.values())))
    projector, pattern = sensor.projector, sensor.pattern
    if real.technology == "structured_light":
        pattern = capture_pattern(real) or pattern  # the images of the recording are in its order
    if real.rig.projector is not None:
        projector = replace(projector, optics=real.rig.projector)
    if isinstance(pattern, RandomDots) and pattern.frames != count:
        if count > pattern.frames:
            raise InputError("--sensor", "pattern.shifts_px", f"{pattern.frames} frames", f"{count}, as {where} holds")
        shifts = pattern.shifts_px[:count] if count > 1 else []
        pattern = pattern.model_copy(update={"shifts_px": shifts})
    exposure, seconds = sensor.exposure, real.settings.get("exposure_s")
    if isinstance(seconds, list):
        raise InputError(where, "settings.exposure_s", f"{len(seconds)} exposures", "one: a bracket is not rebuilt")
    if isinstance(seconds, int | float) and seconds > 0:
        exposure = replace(
            exposure, rule=f"as recorded, {seconds:.3g} s", base_s=float(seconds), control=None, bracket=None
        )
    rig = replace(real.rig, projector=projector.optics)
    return replace(
        sensor, rig=rig, projector=projector, pattern=pattern, exposure=exposure, ambient_image=False,
    )  # fmt: skip


def _plate(place: Place, sensor: Sensor, texture: Floats | None) -> Scene:
    """A rectangle where the specimen is, matt white, or with reflectances (rows, columns) from low x and y on."""
    backend.activate()
    mi = backend.mi
    half = place.cell * place.occupied.shape[::-1] / 2
    middle = place.low + half
    to_world = mi.ScalarTransform4f().translate([*middle, 0.0]).scale([*half, 1.0])
    bsdf: dict[str, Any] = {"type": "matt_white", "reflectance": REFLECTANCE}
    if texture is not None:
        image = mi.TensorXf(np.ascontiguousarray(REFLECTANCE * texture[..., None], np.float32))
        bitmap = {"type": "bitmap", "data": image, "raw": True, "wrap_mode": "clamp"}
        bsdf = {"type": "diffuse", "reflectance": bitmap}
    shapes = {"specimen": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}
    return scene_from_dict(shapes, sensor.wavelength_nm, "the plane of a recording")


def _texture(place: Place, camera: Camera, electrons: Floats, light: LightOnImagers, name: str) -> Floats:
    """Reflectance (rows, columns) of the plate, up to a factor: what was recorded over what a white plate would show.

    Beyond what the reference camera sees the nearest pixel goes on.
    """
    part = light.parts[name]
    inside = slice(part.row, part.row + part.height), slice(part.column, part.column + part.width)
    white = light.radiance[name][0].astype(float)
    lit = white > 0.05 * np.percentile(white, 99)
    ratio = gaussian_filter(electrons[inside], _TEXTURE_BLUR_PX) / np.where(lit, white, np.nan)
    ratio = np.where(np.isfinite(ratio), ratio, np.nanmedian(ratio))
    extent = place.cell * place.occupied.shape[::-1]
    reach = float(np.linalg.norm(place.world_from_sensor.translation))
    texel = reach / float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])) / _TEXELS_PER_PX
    columns, rows = np.minimum(np.ceil(extent / texel).astype(int), _LARGEST_TEXTURE)
    x = place.low[0] + (np.arange(columns) + 0.5) / columns * extent[0]
    y = place.low[1] + (np.arange(rows) + 0.5) / rows * extent[1]
    xs, ys = np.meshgrid(x, y)
    points = place.world_from_sensor.inverse().points(np.stack([xs, ys, np.zeros_like(xs)], axis=-1))
    pixels = np.nan_to_num(camera.project(points)) - [part.column, part.row]
    return np.asarray(map_coordinates(ratio, [pixels[..., 1], pixels[..., 0]], order=1, mode="nearest"))


def _scale(
    simulated: SimulatedSensor, light: LightOnImagers, place: Place, real: Capture, name: str, plain: PlainImage,
    seed: int, where: str,
) -> float:  # fmt: skip
    """Factor of the light that makes the specimen's median level the recorded one, in the plain image; by bisection.

    It is the level with its noise that is compared: where a pattern has two levels, their median lies where few pixels
    are, and noise moves it.
    """
    part, there = light.parts[name], image_mask(place, real.rig.cameras[name], MARGIN_PX)
    if not there.any():
        raise InputError("REAL", "specimen", "no pixel of it", "a larger --window, or a nearer view")
    if not light.radiance[name].any():
        raise InputError("--sensor", "projector", "no light on the specimen", "a projector that reaches it")
    wanted, full = median_level(np.bincount(plain.of(real.images[name])[there])), 2**real.bits - 1
    if wanted > full - 0.5:
        found = f"a median grey level of {wanted:.0f} on the specimen, in {plain.name}"
        allowed = f"under {full}: a saturated image does not tell the power"
        raise InputError(where, "images", found, allowed, "take it with a shorter exposure")
    needed = list(plain.images)
    if isinstance(simulated.sensor.pattern, AmplitudeModulation):  # its taps are exposed together
        needed = list(range(len(light.radiance[name])))

    def too_bright(scale: float) -> bool:
        some = light.radiance[name][needed] * np.float32(scale)
        seen = simulated.expose(replace(light, radiance={name: some}, parts={name: part}), seed).images[name]
        seen = seen[[needed.index(number) for number in plain.images]].max(axis=0)
        return median_level(np.bincount(seen[there])) > wanted

    low, high = _SCALES
    if too_bright(low) or not too_bright(high):
        flux = simulated.sensor.projector.flux
        found = (
            f"{flux:g} W, with which no reflectance of {low:g} to {high:g} times {REFLECTANCE} gives {wanted:.0f} DN"
        )
        allowed = f"a power near that of the device; the imager and exposure of {where}"
        raise InputError("--sensor", "projector.flux_w", found, allowed)
    for _ in range(_BISECTIONS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if too_bright(middle) else (middle, high)
    return float(np.sqrt(low * high))


def median_level(counts: NDArray[Any]) -> float:
    """Median [DN] of how many pixels have each level, as if those of one level were spread evenly over it."""
    total = np.cumsum(counts)
    level = int(np.searchsorted(total, total[-1] / 2))
    below = total[level - 1] if level else 0
    return float(level - 0.5 + (total[-1] / 2 - below) / counts[level])


def image_mask(place: Place, camera: Camera, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Which pixels (H, W) of a camera's raw image show the specimen."""
    mask = np.zeros((camera.height, camera.width), bool)
    part = bounding_window(camera, place.corners(), 1) or CameraWindow(0, 0, camera.width, camera.height)
    columns, rows = np.meshgrid(np.arange(part.width) + part.column, np.arange(part.height) + part.row)
    rays = camera.sensor_from_camera.directions(camera.rays(np.stack([columns, rows], axis=-1).astype(float)))
    pitch = 1.0 / float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    mask[rows, columns] = on_specimen(place, camera.centre, rays, pitch, margin_px)
    return mask


def projector_was_on(real: Capture, told: Literal["on", "off"] | None, where: str) -> bool:
    """Whether the projector was on: as ``told``, else by the settings. A code of light, or a simulation, needs it.

    Raises
    ------
    InputError
        If nobody says it, of a pair that is matched by what it shows.
    """
    if told is not None:
        return told == "on"
    known = real.settings.get("projector_on")
    if isinstance(known, bool):
        return known
    if real.technology != "active_stereo" or real.source == "simulated":
        return True
    raise InputError(f"{where}/settings.json", "projector_on", "nothing", "true or false",
                     "were the dots on? Say --projector on or off, here or at mitsim import")  # fmt: skip
