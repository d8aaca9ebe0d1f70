r"""By how much light by way of other surfaces pulls a code in phase: beside a corner, neighbours all to the same side.

Signal chain: three fringes a third of a period apart, of direct light and of light by way of other surfaces
(:mod:`mitsim.prediction.other_light`) -> complex amplitudes A_1 and A_2 -> A_2 as it stands to the fringe of A_1, over
a window of one face -> its ratio z to A_1 -> phase that is read too far -> projector coordinate -> depth along the ray.

Phase shifting reads the argument of what it sees, A_1 + A_2. So a fringe of period P is read too far by

    P arg(1 + z) / 2 pi,    z = <A_2 conj(A_1) / |A_1|> / |A_1|

A_2 changes little where A_1 goes to 0, at a limb that is turned from the projector, so the mean is one of A_2 alone.
A_2 has the code of other places, washed out by the lobe of a rough face, and turns against A_1 from place to place.
Far from a corner that averages out. Near it what is mirrored is near too, its stripes are still sharp, and turn slowly:
beside the foot of a pillar points lie tenths of a millimetre behind along the whole foot, and a fit tilts.

A_2 is found with a few light paths, and their noise would be taken for a pull. It is found twice, of paths A and B, and
what the two do not agree on over a wider window W is left out, as Wiener's filter does:

    z = z_AB <Re(a conj(b))>_W / <|(a + b) / 2|^2>_W,    a, b = <A_2 conj(A_1) / |A_1|>

The windows were chosen in four views of pillars, two in matt white and two in Ra 0.37: of displacements of 87 um (root
mean square over patches of 8 deg by 8 mm) 53 um are left, and 100 um with a window of 4 px and each pixel's own
agreement; where there is hardly a pull, 3.5 um in place of 8 um are said.

What turns faster than the window, where both renders agree on it, scatters the points about that: a phase by

    s^2 = (<Re(A_2 conj(A_2'))>_W - <Re(a conj(b))>_W) / (2 |A_1|^2)

Left out: what other light does to the coarse orders of a code, and that a point is an average over more than a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.prediction.predictor import Ideal
from mitsim.sensor.light_code import GrayCodePhaseShift, PhaseShift, patterns
from mitsim.sensor.preset import Sensor
from mitsim.simulation.indirect_light import smoothed

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: standard deviations of the window over which A_2 is a mean, and of the one in which renders are to agree, in pixels
#: of the sensor
WINDOW_PX, AGREED_PX = 2.0, 12.0

#: the three phases of a fringe, which tell its amplitude
_SHIFTS = 2 * np.pi * np.arange(3) / 3


@dataclass(frozen=True)
class Fringe:
    """The fringe that a camera and a projector measure with: ``period`` over focal length [1].

    Its coordinate is ``along``.(P - ``centre``) / ``ahead``.(P - ``centre``) in the sensor frame; the projector's
    distortion over a period is left out.
    """

    period: float
    centre: Floats
    along: Floats
    ahead: Floats

    def range_bias(self, phase: Floats, ideal: Ideal) -> Floats:
        """Depth (n,) [mm] along their rays by which points lie too far that are read ``phase`` (n,) [rad] too far."""
        place = ideal.point - self.centre
        with np.errstate(divide="ignore", invalid="ignore"):
            read = (place @ self.along) / (place @ self.ahead) + phase / (2 * math.pi) * self.period
            normal = self.along - read[:, None] * self.ahead  # of the plane of points with this coordinate
            moved = -(normal * place).sum(1) / (normal * ideal.ray).sum(1)
        return np.where(np.isfinite(moved), moved, 0.0)


def finest_fringe(sensor: Sensor) -> Fringe | None:
    """The fringe that a sensor measures with; None where one camera and one coordinate do not tell depth by a phase."""
    code, optics = sensor.pattern, sensor.projector.optics
    if len(sensor.measuring_rig.cameras) > 1 or not isinstance(code, PhaseShift | GrayCodePhaseShift):
        return None
    if code.axis not in ("columns", "rows"):
        return None
    axis = 1 if code.axis == "rows" else 0
    turned = optics.sensor_from_camera.rotation
    return Fringe(_period(code) / float(optics.matrix[axis, axis]), optics.centre, turned[:, axis], turned[:, 2])


def fringes(sensor: Sensor) -> NDArray[np.float32]:
    """That fringe three times, a third of a period apart: (3, H, W) of values 0..1 in projector pixels.

    None at all, (0, H, W), for a sensor that has none.
    """
    optics, code = sensor.projector.optics, sensor.pattern
    if finest_fringe(sensor) is None:
        return np.empty((0, optics.height, optics.width), np.float32)
    assert isinstance(code, PhaseShift | GrayCodePhaseShift)
    alone = PhaseShift(
        periods_px=[_period(code)], steps=len(_SHIFTS), axis=code.axis, mean=code.mean, contrast=code.contrast
    )
    return patterns(alone, optics.width, optics.height)


def _period(code: PhaseShift | GrayCodePhaseShift) -> float:
    return code.periods_px[-1] if isinstance(code, PhaseShift) else code.period_px


def amplitude(images: NDArray[np.floating]) -> Complex:
    """Complex amplitude (...) of three images (3, ...) of :func:`fringes`; its argument is the phase."""
    return np.tensordot(np.exp(1j * _SHIFTS), np.asarray(images, float), axes=1)


def phase_bias(
    direct: Complex, others: tuple[Complex, Complex], shape: NDArray[np.integer], step: int
) -> tuple[Floats, Floats]:
    """arg(1 + z) (H, W) [rad] of pixels with A_1 and A_2, found twice, (H, W), and how far phases scatter about it.

    Both are 0 where there is no direct light. ``shape`` (H, W) that a pixel shows, -1 nothing; ``step`` pixels of the
    sensor make one.
    """
    size = np.abs(direct)
    # squares of radiances are small for single precision
    unit = max(np.finfo(float).tiny, *(float(np.abs(one).max()) for one in (direct, *others)))
    turned = [other / unit * np.exp(-1j * np.angle(direct)) for other in others]

    def mean(layers: list[Floats], width: float) -> Floats:
        return smoothed(np.array(layers, np.float32), shape, width / step).astype(float)

    parts = mean([part for one in turned for part in (one.real, one.imag)], WINDOW_PX)
    first, second = parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]
    middle = (first + second) / 2
    every = (turned[0] * turned[1].conj()).real
    agreed, power, whole = mean([(first * second.conj()).real, np.abs(middle) ** 2, every], AGREED_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = middle * np.clip(agreed / power, 0.0, 1.0) / (size / unit)
        left = np.sqrt(np.maximum(whole - np.maximum(agreed, 0.0), 0.0) / 2) / (size / unit)
    known = np.isfinite(z) & np.isfinite(left)
    return np.asarray(np.angle(1 + np.where(known, z, 0.0))), np.where(known, np.minimum(left, math.pi), 0.0)
