"""Turn light into grey levels by an imager of the laboratory's own, written in NumPy after EMVA 1288.

Signal chain: radiance -> lens (Gaussian integrated over each pixel, cos^4) -> speckle of the projector's light, room
light -> electrons -> PRNU -> Poisson -> read and row noise, DSNU, columns -> full well -> companding or gain ->
rounding.

Speckle, by Goodman (Speckle Phenomena in Optics, 2007): contrast C = (1 + 8 pi^2 (dl h / l^2)^2)^(-1/4) / sqrt(M) on a
surface of rms height h (section 6.2, reflection at normal incidence). dl is the full width of the spectrum at 1 / e,
1.201 times that at half maximum. M = 1 + (D_projector / D_camera)^2 is the mean over the pupil of the projector. Paint
depolarises, which doubles M. The light of a pixel is the mean over independent cells of the correlation area
4 (l N)^2 / pi of a circular pupil, with gamma distributed light: a cell on an edge gives to both of its pixels.
Positions do not shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d
from scipy.special import erf

from characterisation.region_of_interest import Roi
from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.sensor.sensor import Sensor

Images = NDArray[np.float32]

_PLANCK_J_S, _LIGHT_M_S = 6.62607015e-34, 299792458.0

#: spread of the path lengths inside white paint [um]; assumed
_PAINT_DEPTH_UM = 30.0


@dataclass(frozen=True)
class Exposed:
    """A region of a camera's image, its exposure [s], and the seeds of the unit's fixed pattern and of the noise."""

    camera: Camera
    roi: Roi
    seconds: float
    unit: int
    noise: int


def grey_levels(
    sensor: Sensor, how: Exposed, projected: Images, room: Images, contrast: NDArray[np.float32]
) -> NDArray[np.unsignedinteger]:
    """Return the images (P, H, W) of a camera from the light (P, h, w) and the room's (h, w) [W / (mm^2 sr)].

    ``contrast`` (h, w) is that of the speckle at a point. Pixels outside the region are 0.
    """
    imager, camera, roi = sensor.imager, how.camera, how.roi
    if imager.corner_blur_px is not None or imager.gamma != 1:
        raise ValueError("the laboratory's imager has an even blur and no gamma")
    fixed, moving = np.random.default_rng([how.unit, 1]), np.random.default_rng([how.noise, 2])
    shape = projected.shape[1:]
    gain = speckle(contrast, grain_px(sensor), moving)
    loss = corner_loss(imager, camera, roi)
    response = 1 + imager.prnu * fixed.standard_normal(shape)
    offset = imager.dsnu * fixed.standard_normal(shape) + imager.column_pattern * fixed.standard_normal(shape[1])
    dark = imager.dark_current * how.seconds
    out = np.zeros((len(projected), camera.height, camera.width), np.uint8 if imager.bits <= 8 else np.uint16)
    for index, image in enumerate(projected):
        light = (blurred(image, imager.blur_px) * gain + blurred(room, imager.blur_px)) * loss
        mean = light * electrons_per_second(sensor) * how.seconds * response
        charge = moving.poisson(np.maximum(mean, 0) + dark) - dark
        charge = charge + imager.read_noise * moving.standard_normal(shape) + offset
        charge = charge + imager.row_noise * moving.standard_normal((shape[0], 1))
        if imager.smoothing_px:
            charge = blurred(charge, imager.smoothing_px)
        out[index][roi.slices] = converted(np.minimum(charge, imager.full_well), imager)
    return out


def electrons_per_second(sensor: Sensor) -> float:
    """Return the electrons per second for a radiance of 1 W / (mm^2 sr)."""
    imager = sensor.imager
    photon = _PLANCK_J_S * _LIGHT_M_S / (sensor.wavelength_nm * 1e-9)
    area = (imager.pixel_um * 1e-3) ** 2
    return float(np.pi / (4 * imager.f_number**2) * area * imager.quantum_efficiency / photon)


def blurred(image: NDArray[np.floating], sigma: float) -> NDArray[np.float64]:
    """Return an image (h, w) under a Gaussian of ``sigma`` [px], integrated over each pixel."""
    if sigma == 0:
        return np.asarray(image, float)
    edges = np.arange(-int(4 * sigma + 2) - 0.5, int(4 * sigma + 2) + 1.0)
    weights = np.diff(erf(edges / (sigma * np.sqrt(2)))) / 2
    return np.asarray(
        correlate1d(correlate1d(image.astype(float), weights, 0, mode="nearest"), weights, 1, mode="nearest")
    )


def corner_loss(imager: Imager, camera: Camera, roi: Roi) -> NDArray[np.float64]:
    """Return the illumination (h, w) relative to the principal point: (1 + q r^2)^-2, the cos^4 law at q = 1 / f^2."""
    x, y = np.meshgrid(np.arange(roi.left, roi.right), np.arange(roi.top, roi.top + roi.height))
    (fx, fy), centre = camera.matrix.diagonal()[:2], camera.matrix[:2, 2]
    squared = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
    factor = 1 / (fx * fy)
    if imager.corner_illumination is not None:
        farthest = np.maximum(centre, [camera.width - 1, camera.height - 1] - centre)
        factor = (imager.corner_illumination**-0.5 - 1) / (farthest @ farthest)
    return np.asarray((1 + factor * squared) ** -2.0)


def speckle_contrast(sensor: Sensor, camera: Camera, height_um: float) -> float:
    """Return the contrast [1] of the speckle of a surface at a point; a height that is not a number is white paint."""
    if sensor.linewidth_nm is None:
        return 0.0
    imager, wavelength = sensor.imager, sensor.wavelength_nm * 1e-3
    paint = not np.isfinite(height_um)
    height = _PAINT_DEPTH_UM if paint else height_um
    linewidth = sensor.linewidth_nm * 1e-3 / np.sqrt(np.log(2))
    coherence = (1 + 8 * np.pi**2 * (linewidth * height / wavelength**2) ** 2) ** -0.25
    pupil = np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]) * imager.pixel_um * 1e-3 / imager.f_number
    averaged = (1 + (sensor.projector.aperture_mm / pupil) ** 2) * (1 + paint)
    return float(coherence / np.sqrt(averaged))


def grain_px(sensor: Sensor) -> float:
    """Return the side [px] of a square of the correlation area 4 (lambda N)^2 / pi of the speckle."""
    return float(np.sqrt(4 / np.pi) * sensor.wavelength_nm * 1e-3 * sensor.imager.f_number / sensor.imager.pixel_um)


def speckle(contrast: NDArray[np.float32], grain: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the gain (h, w) of each pixel: the mean of cells of the side ``grain`` [px], gamma distributed of mean 1."""
    if not contrast.any():
        return np.ones(contrast.shape)
    counts = [int(np.ceil(size / grain)) + 1 for size in contrast.shape]
    rows, columns = (
        np.minimum(((np.arange(count) + 0.5) * grain).astype(int), size - 1)
        for count, size in zip(counts, contrast.shape, strict=True)
    )
    variance = np.maximum(contrast[np.ix_(rows, columns)].astype(float) ** 2, 1e-12)
    light = np.where(variance > 1e-12, rng.gamma(1 / variance, variance), 1.0)
    for axis, size in enumerate(contrast.shape):
        light = np.moveaxis(light, axis, 0)
        total = np.concatenate([np.zeros_like(light[:1]), np.cumsum(light, axis=0)])
        edges = np.arange(size + 1) / grain
        whole = np.minimum(edges.astype(int), len(light) - 1)
        at = total[whole] + (edges - whole)[:, None] * light[whole]
        light = np.moveaxis(np.diff(at, axis=0) * grain, 0, axis)
    return np.asarray(light)


def converted(charge: NDArray[np.float64], imager: Imager) -> NDArray[np.float64]:
    """Return grey levels of charges [e-]."""
    full = 2**imager.bits - 1
    if not imager.companding:
        return np.clip(np.rint(imager.black_level + charge * (full - imager.black_level) / imager.full_well), 0, full)
    knees = np.array([(0.0, 0.0), *imager.companding])
    last = knees[-1, 0] - 1
    black = np.interp(imager.black_level, knees[:, 1], knees[:, 0])
    level = np.clip(np.rint(black + charge * (last - black) / imager.full_well), 0, last)
    return np.asarray(np.floor(np.interp(level, knees[:, 0], knees[:, 1]) + 1e-3))
