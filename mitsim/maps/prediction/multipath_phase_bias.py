r"""Bias of a phase code by interreflections: next to a corner, neighbouring points are biased to the same side.

Signal chain: three fringes shifted by a third of a period, in direct and in interreflected light
(:mod:`mitsim.maps.prediction.interreflections`) -> complex amplitudes A_1 and A_2 -> A_2 relative to the phase of A_1,
averaged over a window on one face -> its ratio z to A_1 -> phase bias -> projector coordinate -> depth along the ray.

Phase shifting measures the argument of A_1 + A_2. The coordinate of a fringe of period P is therefore biased by

    P arg(1 + z) / 2 pi,    z = <A_2 conj(A_1) / |A_1|> / |A_1|

A_2 varies little where A_1 approaches 0, at a limb that faces away from the projector, so only A_2 is averaged. A_2
carries the code of other places, blurred by the lobe of a rough face, and its phase relative to A_1 varies from place
to place. Far from a corner this averages out. Next to a corner the mirrored surface is near too: its stripes are sharp
and their phase varies slowly. Along the foot of a pillar all points lie tenths of a millimetre too deep, and a fitted
plane tilts.

A_2 is rendered with few light paths, and their noise would look like a bias. It is therefore rendered twice, as A and
B. The part on which both disagree over a wider window W is removed, as by a Wiener filter:

    z = z_AB <Re(a conj(b))>_W / <|(a + b) / 2|^2>_W,    a, b = <A_2 conj(A_1) / |A_1|>

The windows were chosen in four views of pillars, two in matt white and two in Ra 0.37. Displacements of 87 um (root
mean square over patches of 8 deg by 8 mm) leave 53 um, and 3.5 um are predicted where the bias is close to 0. A window
of 4 px with the agreement of single pixels leaves 100 um and predicts 8 um.

Parts of A_2 that vary faster than the window, and on which both renders agree, scatter the points about that bias. The
standard deviation of the phase is s, with

    s^2 = (<Re(A_2 conj(A_2'))>_W - <Re(a conj(b))>_W) / (2 |A_1|^2)

Not included: the effect of interreflections on the coarse digits of a code, and the averaging of a point over more than
a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.capture.simulated.indirect_light import smoothed
from mitsim.maps.prediction.multipath_range_bias import Complex
from mitsim.maps.prediction.perturbation import Ideal
from mitsim.sensor.light_code import GrayCodePhaseShift, PhaseShift, patterns
from mitsim.sensor.sensor import Sensor

#: standard deviation of the window that averages A_2 [px] of the sensor
WINDOW_PX = 2.0

#: standard deviation of the window over which both renders are compared [px] of the sensor
AGREED_PX = 12.0

#: three phase shifts, the fewest that determine an amplitude
_PHASE_SHIFTS = 2 * np.pi * np.arange(3) / 3


@dataclass(frozen=True)
class Fringe:
    """Fringe of a camera and a projector, with ``period`` relative to the focal length [1].

    The coordinate of a point P is ``along``.(P - ``centre``) / ``optical_axis``.(P - ``centre``) in the sensor
    frame. The change of the projector's distortion over a period is neglected.
    """

    period: float
    centre: Floats
    along: Floats
    optical_axis: Floats

    def range_bias(self, phase: Floats, ideal: Ideal) -> Floats:
        """Return the range bias (n,) [mm] along the rays for a phase bias ``phase`` (n,) [rad]; positive is too far."""
        offset = ideal.point - self.centre
        with np.errstate(divide="ignore", invalid="ignore"):
            read = (offset @ self.along) / (offset @ self.optical_axis) + phase / (2 * math.pi) * self.period
            normal = self.along - read[:, None] * self.optical_axis  # of the plane of points with this coordinate
            moved = -(normal * offset).sum(1) / (normal * ideal.ray).sum(1)
        return np.where(np.isfinite(moved), moved, 0.0)


def finest_fringe(sensor: Sensor) -> Fringe | None:
    """Return the finest fringe of a sensor; None if its depth does not follow from the phase of one camera."""
    code, optics = sensor.pattern, sensor.projector.optics
    if len(sensor.measuring_rig.cameras) > 1 or not isinstance(code, PhaseShift | GrayCodePhaseShift):
        return None
    if code.axis not in ("columns", "rows"):
        return None
    axis = 1 if code.axis == "rows" else 0
    turned = optics.sensor_from_camera.rotation
    return Fringe(_period(code) / float(optics.matrix[axis, axis]), optics.centre, turned[:, axis], turned[:, 2])


def fringes(sensor: Sensor) -> NDArray[np.float32]:
    """Return that fringe with three phase shifts: (3, H, W), 0..1 in projector pixels; (0, H, W) without a fringe."""
    optics, code = sensor.projector.optics, sensor.pattern
    if finest_fringe(sensor) is None:
        return np.empty((0, optics.height, optics.width), np.float32)
    assert isinstance(code, PhaseShift | GrayCodePhaseShift)
    period, steps = _period(code), len(_PHASE_SHIFTS)
    alone = PhaseShift(periods_px=[period], steps=steps, axis=code.axis, mean=code.mean, contrast=code.contrast)
    return patterns(alone, optics.width, optics.height)


def _period(code: PhaseShift | GrayCodePhaseShift) -> float:
    return code.periods_px[-1] if isinstance(code, PhaseShift) else code.period_px


def amplitude(images: NDArray[np.floating]) -> Complex:
    """Return the complex amplitude (...) of three images (3, ...) of :func:`fringes`; its argument is the phase."""
    return np.tensordot(np.exp(1j * _PHASE_SHIFTS), np.asarray(images, float), axes=1)


def phase_bias(
    direct: Complex, indirect: tuple[Complex, Complex], shape: NDArray[np.integer], step: int
) -> tuple[Floats, Floats]:
    """Return the bias arg(1 + z) (H, W) [rad] of each pixel, and the standard deviation of its phase about the bias.

    Both are 0 without direct light. ``direct`` is A_1 (H, W), ``indirect`` two renders of A_2, ``shape`` that of each
    pixel, -1 for none; ``step`` the number of sensor pixels per pixel along an axis.
    """
    size = np.abs(direct)
    # scale first: squares of radiances are too small for single precision
    unit = max(np.finfo(float).tiny, *(float(np.abs(light).max()) for light in (direct, *indirect)))
    back = np.where(size > 0, np.conj(direct) / np.where(size > 0, size, 1.0), 1.0)
    turned = [other / unit * back for other in indirect]

    def mean(layers: list[Floats], width: float) -> Floats:
        return smoothed(np.array(layers, np.float32), shape, width / step).astype(float)

    parts = mean([part for ratio in turned for part in (ratio.real, ratio.imag)], WINDOW_PX)
    first, second = parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]
    middle = (first + second) / 2
    every = (turned[0] * turned[1].conj()).real
    agreed, power, whole = mean([(first * second.conj()).real, np.abs(middle) ** 2, every], AGREED_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = middle * np.clip(agreed / power, 0.0, 1.0) / (size / unit)
        left = np.sqrt(np.maximum(whole - np.maximum(agreed, 0.0), 0.0) / 2) / (size / unit)
    finite = np.isfinite(z) & np.isfinite(left)
    return np.asarray(np.angle(1 + np.where(finite, z, 0.0))), np.where(finite, np.minimum(left, math.pi), 0.0)
