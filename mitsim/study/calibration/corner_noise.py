"""Compute the noise with which a sensor detects the corners of a board, from its own imager, lens and code.

Signal chain of a camera: crossing of two edges at a random position and angle -> average over each pixel's area ->
defocus and point spread of the lens -> electrons -> noise and converter of the imager -> ``cv2.cornerSubPix`` -> error
against the true position. Positions within a pixel are random, so the detector's bias, which depends on the position,
counts as noise. Its mean over all positions is returned separately.

A projector is calibrated as an inverse camera. At each corner that the camera finds, a local homography is fitted to
the decoded projector coordinates around it (Moreno and Taubin, 3DIMPVT 2012, whose window is 47 px); it gives the
position of the corner on the projector. The error has two parts: that of the camera's corner, mapped by the homography,
and that of the coordinates, averaged over the window (:func:`coordinate_noise`). The errors of the two eyes are
therefore correlated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from characterisation.files.arrays import Floats
from mitsim.decoding.cloud import unknown_code
from mitsim.decoding.grey_levels import grey_level_variance
from mitsim.decoding.matching.reference_matching import reference_geometry
from mitsim.decoding.structured_light.phase_shift import fringe_sigma
from mitsim.sensor.image_formation import expose, fixed_pattern
from mitsim.sensor.light_code import LightCode, roles
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.projector_images import ProjectorImages
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import AutomaticExposure

#: reflectance of the board's white; *assumed* for print on matt paper or ceramic
WHITE = 0.85

#: reflectance of its black; *assumed*, as that of its white
BLACK = 0.05
#: largest half side of the detector's window [px]; OpenCV's tutorials use 5 to 11
WINDOW_PX = 5
#: samples per pixel side of the average over a pixel
_SUPERSAMPLING = 8
#: side of the window of a local homography [px]: Moreno and Taubin 2012
HOMOGRAPHY_WINDOW_PX = 47.0


@dataclass(frozen=True)
class CornerNoise:
    """Error of a detected corner [px]: ``sigma`` the root mean square of one coordinate, ``bias`` its mean."""

    sigma: float
    bias: float


def corner_noise(
    sensor: Sensor,
    distance_mm: float,
    square_px: float,
    seed: int = 1,
    patches: int = 150,
    noise: Noise | None = None,
    window_px: int = WINDOW_PX,
) -> CornerNoise:
    """Return the noise of a corner of the board, seen by a camera of the sensor at a distance.

    The white squares have the level of the sensor's exposure rule (:func:`board_level`), in one image.

    Parameters
    ----------
    sensor
        Sensor whose reference camera sees the board.
    distance_mm
        Distance of the board [mm].
    square_px
        Side of a square in the image [px].
    seed
        Selects positions, angles and noise of the corners.
    patches
        Number of simulated corners.
    noise
        Sources of noise that are on; None is all of them.
    window_px
        The detector's window extends this far to each side, or to the centre of a square [px].

    See Also
    --------
    coordinate_noise : the noise of the projector's coordinate at a corner
    """
    noise = noise or Noise()
    rng = np.random.default_rng(seed)
    imager, camera = sensor.imager, sensor.rig.reference
    window = int(np.clip(square_px / 2 - 1, 2, window_px))
    half = 2 * window + 6
    electrons = board_level(sensor, distance_mm) * imager.full_well
    size = 2 * half + 1
    blur = point_spread(imager.blur_px)
    disc = 0.0
    if sensor.focus_mm is not None:
        pupil = sensor.pupil_mm(camera) * np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
        disc = pupil * abs(1 / distance_mm - 1 / sensor.focus_mm)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-5)
    errors = []
    for _ in range(patches):
        corner = half + rng.uniform(-0.5, 0.5, 2)
        bright = _crossing(size, corner, rng.uniform(0, 2 * np.pi), rng.uniform(np.radians(60), np.radians(120)), disc)
        image = cv2.sepFilter2D(bright, -1, blur, blur, borderType=cv2.BORDER_REFLECT)
        light = electrons * (BLACK + (WHITE - BLACK) * image) / WHITE
        pattern = fixed_pattern(imager, light.shape, rng)
        grey = expose(light, imager, pattern, noise, rng, sensor.exposure.limits_s[0]).astype(np.float32)
        start = np.float32(corner + rng.uniform(-0.7, 0.7, 2)).reshape(1, 1, 2)
        detected = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), criteria)
        errors.append(detected.reshape(2) - corner)
    wrong = np.array(errors)
    # a calibration rejects corners with large residuals, where the detector diverged
    wrong = wrong[np.abs(wrong).max(axis=1) < 1.0]
    return CornerNoise(float(np.sqrt((wrong**2).mean())), float(np.abs(wrong.mean(axis=0)).max()))


def board_level(sensor: Sensor, distance_mm: float) -> float:
    """Return the level of the white squares as a share of a full well.

    With a fixed level or automatic exposure it is that level, since a calibration exposes for its board. A given
    exposure shows the sensor's own light at that distance, up to 0.9.
    """
    control, policy = sensor.exposure.control, sensor.exposure
    if isinstance(control, AutomaticExposure):
        return min(control.level, 0.9)
    radiance = sensor.projector.plate_radiance(WHITE, distance_mm)
    assert policy.base_s is not None
    level = radiance * sensor.electrons() * policy.base_s / sensor.imager.full_well
    middle = float(np.sqrt(np.prod(sensor.working_range_mm)))
    if sensor.technology != "time_of_flight":  # exposed for the board as at the middle of the range
        level *= (distance_mm / middle) ** 2
    return float(np.clip(level, 0.02, 0.9))


def coordinate_noise(sensor: Sensor, distance_mm: float, square_px: float, seed: int = 1) -> float:
    """Return the noise of the projector's coordinate at a corner [projector px], without the camera's own error.

    - A phase: the decoder's formula for its finest period.
    - A Gray code without fringes: a line fitted over the stripes.
    - Matching to a stored image: the Cramer-Rao bound for one block, and the steps of its disparity.

    Each is averaged over the white half of the local homography's window, as far as the squares extend. A code of one
    axis is assumed to be shown along the other axis too during calibration, as is usual for such rigs.

    Parameters
    ----------
    sensor
        Sensor with a projector.
    distance_mm
        Distance of the board [mm].
    square_px
        Side of a square in the image [px].
    seed
        Selects the noise of a simulated line fit, for a Gray code without fringes.

    See Also
    --------
    corner_noise : the noise of the camera's pixel
    """
    window = min(HOMOGRAPHY_WINDOW_PX, 2 * square_px)
    white = window**2 / 2
    pattern, imager = sensor.pattern, sensor.imager
    level = board_level(sensor, distance_mm)
    if sensor.technology == "reference_stereo":
        return float(_matching_noise(sensor, level) / np.sqrt(max(white / _block(sensor) ** 2, 1.0)))
    if isinstance(pattern, ProjectorImages):
        raise unknown_code(f"sensor {sensor.name}", pattern.count)
    assert isinstance(pattern, LightCode)
    optics = sensor.projector.optics
    every = roles(pattern, optics.width, optics.height)
    periods = [role.period for role in every if role.kind == "phase"]
    if not periods:
        stripe = min(role.period for role in every if role.kind == "gray")
        return float(stripe * _stripe_fit(int(window), homography_scale(sensor) / stripe, seed))
    steps = periods.count(min(periods))
    contrast = getattr(pattern, "contrast", 0.5)
    signal = level * imager.full_well * imager.gain
    # a mean over a window has the noise of the pixels before the device smooths them
    level_dn = np.array([signal / 2 + imager.black_level], np.float32)
    variance = grey_level_variance(level_dn, replace(imager, smoothing_px=0.0, gamma=1.0))
    sigma = fringe_sigma(min(periods), steps, variance, np.array([signal * contrast], np.float32), imager)
    return float(sigma[0] / np.sqrt(white))


def homography_scale(sensor: Sensor) -> float:
    """Return projector pixels per camera pixel on a board at normal incidence, by their focal lengths."""
    return float(sensor.projector.optics.matrix[0, 0] / sensor.rig.reference.matrix[0, 0])


def _crossing(size: int, corner: Floats, angle: float, between: float, disc_px: float) -> Floats:
    """Return an image (size, size) of two crossing edges, 0 and 1, averaged over pixels and over a defocus disc."""
    steps = (np.arange(_SUPERSAMPLING) + 0.5) / _SUPERSAMPLING - 0.5
    grid = (np.arange(size)[:, None] + steps).reshape(-1)
    x, y = np.meshgrid(grid - corner[0], grid - corner[1])
    first = x * np.sin(angle) - y * np.cos(angle)
    second = x * np.sin(angle + between) - y * np.cos(angle + between)
    fine = ((first > 0) == (second > 0)).astype(np.float64)
    reach = disc_px * _SUPERSAMPLING / 2
    if reach >= 1:
        across = np.arange(-int(reach), int(reach) + 1)
        kernel = (across[:, None] ** 2 + across**2 <= reach**2).astype(np.float64)
        fine = cv2.filter2D(fine, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
    return np.asarray(fine.reshape(size, _SUPERSAMPLING, size, _SUPERSAMPLING).mean(axis=(1, 3)))


def _stripe_fit(pixels: int, stripes_per_pixel: float, seed: int) -> float:
    """Return the noise at the centre of a line fitted to the stripe centres that a row of pixels decodes [stripes]."""
    rng = np.random.default_rng(seed)
    x = (np.arange(pixels) - (pixels - 1) / 2) * stripes_per_pixel
    line = np.stack([np.ones_like(x), x], axis=1)
    true = rng.uniform(0, 1, (500, 1)) + rng.uniform(0.8, 1.25, (500, 1)) * x
    fitted = np.linalg.lstsq(line, (np.floor(true) + 0.5 - true).T, rcond=None)[0][0]
    return float(np.sqrt(np.mean(fitted**2)))


def _block(sensor: Sensor) -> int:
    assert sensor.matcher is not None
    return sensor.matcher.block_size


def _matching_noise(sensor: Sensor, level: float) -> float:
    """Return the noise of a block matched to a noiseless reference [projector px]: sigma_I / |gradient|, and steps."""
    assert sensor.matcher is not None and sensor.matcher.reference_mm is not None
    assert isinstance(sensor.pattern, DotPattern | ProjectorImages)
    imager = sensor.imager
    reference = reference_geometry(sensor.rig, sensor.pattern, sensor.matcher.reference_mm, imager.blur_px).reference
    electrons = level * imager.full_well * reference.astype(np.float64)
    variance = electrons + imager.read_noise**2 + (0.5 / imager.gain) ** 2 / 3
    slope = np.gradient(electrons, axis=1)
    block = (_block(sensor), _block(sensor))
    information = cv2.boxFilter(slope**2 / variance, -1, block, normalize=False)
    matched = 1 / np.median(information[information > 0])
    return float(np.sqrt(matched + sensor.matcher.disparity_step**2 / 12) * homography_scale(sensor))
