r"""By how much light by way of other surfaces pulls a code in phase: beside a corner, neighbours all to the same side.

Signal chain: three fringes a third of a period apart, of direct light and of light by way of other surfaces
(:mod:`mitsim.predict.interreflection`) -> complex amplitudes A_1 and A_2 -> their ratio z over a window of one face ->
phase that is read too far -> projector coordinate -> depth along the view ray.

Phase shifting reads the argument of what it sees, A_1 + A_2. So a fringe of period P is read too far by

    P arg(1 + z) / 2 pi,    z = <A_2 conj(A_1)> / <|A_1|^2>

A_2 has the code of other places, washed out by the lobe of a rough face, and turns against A_1 from place to place.
Far from a corner that averages out. Near it what is mirrored is near too, its stripes are still sharp, and turn slowly:
beside the foot of a pillar points lie tenths of a millimetre behind along the whole foot, and a fit tilts.

A_2 is found with a few light paths, and their noise would be taken for a pull. It is found twice, of paths A and B, and
what the two do not agree on is left out:

    z = (z_A + z_B) / 2 max(0, Re(z_A conj(z_B))) / |(z_A + z_B) / 2|^2

Left out: what other light does to the coarse orders of a code, and that a point is an average over more than a pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.indirect_light import smoothed
from mitsim.predict.predictor import Ideal
from mitsim.scene.footprint import SecondEye
from mitsim.sensor.light_code import GrayCodePhaseShift, PhaseShift, patterns
from mitsim.sensor.preset import Sensor

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: standard deviation of the window over which the ratio is a mean, in pixels of the sensor
WINDOW_PX = 4.0

#: the three phases of a fringe, which tell its amplitude
_SHIFTS = 2 * np.pi * np.arange(3) / 3


def finest_fringe(sensor: Sensor) -> float | None:
    """Period over focal length [1] of the fringe that a sensor measures with, along its code; None without one."""
    code, matrix = sensor.pattern, sensor.projector.optics.matrix
    if not isinstance(code, PhaseShift | GrayCodePhaseShift):
        return None
    return _period(code) / float(matrix[1, 1] if code.axis == "rows" else matrix[0, 0])


def fringes(sensor: Sensor) -> NDArray[np.float32]:
    """That fringe three times, a third of a period apart: (3, H, W) of values 0..1 in projector pixels.

    None at all, (0, H, W), for a sensor that has none.
    """
    optics, code = sensor.projector.optics, sensor.pattern
    if not isinstance(code, PhaseShift | GrayCodePhaseShift):
        return np.empty((0, optics.height, optics.width), np.float32)
    alone = PhaseShift(
        periods_px=[_period(code)], steps=len(_SHIFTS), axis=code.axis, mean=code.mean, contrast=code.contrast
    )
    return patterns(alone, optics.width, optics.height)


def _period(code: PhaseShift | GrayCodePhaseShift) -> float:
    return code.periods_px[-1] if isinstance(code, PhaseShift) else code.period_px


def amplitude(images: NDArray[np.floating]) -> Complex:
    """Complex amplitude (...) of three images (3, ...) of :func:`fringes`; its argument is the phase."""
    return np.tensordot(np.exp(1j * _SHIFTS), np.asarray(images, float), axes=1)


def phase_read_too_far(
    direct: Complex, others: tuple[Complex, Complex], shape: NDArray[np.integer], step: int
) -> Floats:
    """arg(1 + z) (H, W) [rad] of pixels with A_1 and A_2, found twice, (H, W); 0 where there is no direct light.

    ``shape`` (H, W) that a pixel shows, -1 nothing; ``step`` pixels of the sensor make one.
    """
    layers = [np.abs(direct) ** 2]
    for other in others:
        product = other * direct.conj()
        layers += [product.real, product.imag]
    scale = max(float(layers[0].max()), np.finfo(float).tiny)  # squares of radiances are small for single precision
    power, *parts = smoothed((np.array(layers) / scale).astype(np.float32), shape, WINDOW_PX / step).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = ((parts[2 * k] + 1j * parts[2 * k + 1]) / power for k in range(2))
        middle = (first + second) / 2
        z = middle * np.maximum((first * second.conj()).real, 0.0) / np.abs(middle) ** 2
    return np.asarray(np.angle(1 + np.where(np.isfinite(z), z, 0.0)))


def pulled(phase: Floats, fringe: float, second: SecondEye, ideal: Ideal) -> Floats:
    """Depth (n,) [mm] along their view rays by which points lie too far that are read ``phase`` (n,) [rad] too far.

    ``fringe`` as from :func:`finest_fringe`; the projector's distortion over a period is left out.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        read = second.tangent(ideal.point)[0] + phase / (2 * math.pi) * fringe
        moved = second.reach(read, ideal.point, ideal.ray)
    return np.where(np.isfinite(moved), moved, 0.0)
