r"""How far points lie off because each is an average: of a code over what a pixel sees, of a disparity over a block.

Signal chain: sensor -> footprint and weight -> rays through its nodes at every ideal point -> the light that comes
back from there and the coordinate u by which it is triangulated (:mod:`mitsim.scene.footprint`) -> displacement b.

A pixel does not see one point. To first order a projected code is read as

    <u> = sum_k w_k L_k u_k / sum_k w_k L_k  =  u + s^2 (grad u . grad ln L + laplace u / 2)

over a footprint of standard deviation s, L being the light that comes back. A flat face that is evenly lit gives u
itself. On a curved one the brighter side weighs more: toward the limb that is turned from the projector points lie too
near. The sum is taken over rays, so it holds at a limb too, where part of the footprint misses the surface. With s^2 =
1/12 + blur^2 + c^2/16 px^2, of the pixel, of the point spread, and of a disc of confusion of diameter c, nothing is
left to choose. The projector has an aperture as well. Where it is out of focus, each part of it lights a point with
another u, and a face that is turned away is lit more by the near part: the same sum goes over the aperture.

A matcher compares blocks, and answers by a mean disparity of the block, each pixel weighed by how much it is worth:
the square of its contrast, and so of L. So on a convex face points lie behind it. A block of n pixels has s^2 =
(n^2 - 1)/12. ``sgbm`` takes gradients over three pixels first, which makes a block n + 2 wide, and then smooths along
paths (:mod:`mitsim.predict.fattening`). Where contrast is made equal before over a window that is wider than the block,
little of L is left in the weight: its square root, as was read off 40 rendered views of two pillars in matt white, seen
by ``ensenso-n10``.

Left out: the aperture of a matcher's projector; how unevenly a glossy face fills that of a camera; what lies next to
the shape; a pair of cameras that compares codes; time of flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_chebyu, roots_hermitenorm, roots_legendre

from mitsim.scene.footprint import FootprintLamp, FootprintRays, SecondEye, footprint_displacement
from mitsim.scene.load import Scene
from mitsim.sensor.camera import Rig, stereo_rectification
from mitsim.sensor.frames import Transform
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor

Floats = NDArray[np.float64]

#: nodes along each axis of a quadrature, and where part of a footprint has no light or points move by more than this
#: [mm]. With the light there end both, in a step: 27 nodes for a code and 9 for a block were off by a fifth of it, root
#: mean square, and by 2 to 7 um in the mean of a pillar, which is more than its radius errs by
COARSE, FINE, FAR_MM = 3, 5, 0.02

#: nodes along each axis of a block, which is even to its end
FINE_BLOCK = 7

#: power of L in the weight of a matcher, and of one whose images are made equal in contrast first (see above)
MATCHED, EQUALISED = 2.0, 0.5

#: pixels of a block on either side of which gradients are taken
GRADIENT_REACH = 1


@dataclass(frozen=True)
class Footprint:
    """What a sensor averages: of which coordinate, over how wide a part of the image, weighed by which power of light.

    ``fixed_px`` is the standard deviation along one axis of the image; ``defocus_px`` [px mm] times |1/Z - 1/``focus``|
    the diameter of the disc of confusion, ``focus`` in mm. ``square``: the footprint is a block;
    ``lamp`` that lights it, from an aperture of the standard deviation ``aperture`` [mm] along the code.
    ``smoothed`` along paths, so that surfaces are drawn out over edges.
    """

    second: SecondEye
    lamp: FootprintLamp
    fixed_px: float
    power: float
    square: bool
    defocus_px: float = 0.0
    focus: float = math.inf
    aperture: float = 0.0
    smoothed: bool = False

    def width(self, depth: NDArray[np.floating]) -> Floats:
        """Standard deviation [px] for surfaces at a depth Z [mm] before the camera."""
        disc = self.defocus_px * (1 / np.asarray(depth, float) - 1 / self.focus)
        return np.sqrt(self.fixed_px**2 + disc**2 / 16)

    def nodes(self, fine: bool = False) -> Floats:
        """Nodes (k, 4): column and row, for a standard deviation of 1 px, place in the aperture [mm], weight.

        Of Gauss's rules, along one axis exact for polynomials of degree 2 n - 1; the aperture is an even disc. But
        coarsely nodes of a Gaussian footprint lie aside along one axis at a time, which is exact for the third degree.
        """
        if not (fine or self.square):
            axes = np.diag([1.0, 1.0, self.aperture])[: 3 if self.aperture > 0 else 2]
            place = math.sqrt(3) * np.vstack([axes, -axes, np.zeros(3)])
            share = np.array([1 / 6] * (2 * len(axes)) + [1 - len(axes) / 3])  # three pairs leave nothing to the middle
            return np.column_stack([place, share])[share > 0]
        count = COARSE if not fine else FINE_BLOCK if self.square else FINE
        one = _rule(roots_legendre if self.square else roots_hermitenorm, count)
        lamp = _rule(roots_chebyu, count) if self.aperture > 0 else (np.zeros(1), np.ones(1))
        place, share = (np.stack(np.meshgrid(*each, indexing="ij"), -1).reshape(-1, 3)
                        for each in zip(one, one, lamp, strict=True))  # fmt: skip
        return np.column_stack([place * [1.0, 1.0, self.aperture], share.prod(1)])


@cache
def _rule(roots: Callable[[int], tuple[Floats, Floats]], count: int) -> tuple[Floats, Floats]:
    """Nodes (n,) and weights (n,) of a quadrature, of unit sum and standard deviation."""
    node, weight = roots(count)
    weight = weight / weight.sum()
    return node / math.sqrt(weight @ node**2), weight


def footprint_of(sensor: Sensor) -> Footprint | None:
    """What a sensor's points are averages over; None where this is not known."""
    settings = sensor.settings
    if isinstance(settings, MatcherSettings):
        sgbm = settings.method == "sgbm"
        block = settings.block_size + 2 * GRADIENT_REACH * sgbm
        power = EQUALISED if sgbm and settings.contrast_window_px > 0 else MATCHED
        second, fixed = _matched(sensor.measuring_rig), math.sqrt((block**2 - 1) / 12)
        lamp = FootprintLamp(sensor.projector.optics.centre)
        return Footprint(second, lamp, fixed, power, square=True, smoothed=sgbm)
    projector, code, camera = sensor.projector.optics, sensor.pattern, sensor.rig.reference
    if not isinstance(code, PhaseShift | GrayCode | GrayCodePhaseShift) or code.axis == "both":
        return None
    if len(sensor.measuring_rig.cameras) > 1:
        return None
    axes = projector.sensor_from_camera.rotation
    second = SecondEye(projector.centre, axes[:, 1 if code.axis == "rows" else 0], axes[:, 2], matched=False)
    lamp = FootprintLamp(projector.centre, sensor.projector.focus_mm if sensor.projector.aperture_mm > 0 else math.inf)
    seen = Footprint(
        second, lamp, math.sqrt(1 / 12 + sensor.imager.blur_px**2), 1.0, square=False,
        aperture=sensor.projector.aperture_mm / 4,  # of an even disc, along one axis
    )  # fmt: skip
    if sensor.focus_mm is None:
        return seen
    focal_px = math.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    return replace(seen, defocus_px=sensor.pupil_mm(camera) * focal_px, focus=sensor.focus_mm)


def _matched(rig: Rig) -> SecondEye:
    """The eye whose image is compared with that of the first camera: the second one, or the projector."""
    reference, *others = rig.cameras.values()
    if others:
        rectified = rig.rectification or stereo_rectification(reference, others[0])
        axes = reference.sensor_from_camera.rotation @ rectified.rotation_left.T
        return SecondEye(others[0].centre, axes[:, 0], axes[:, 2], matched=True)
    along = rig.baseline_direction
    ahead = reference.sensor_from_camera.rotation[:, 2]
    ahead = ahead - along * (along @ ahead)
    assert rig.projector is not None  # a reference is taken with one
    return SecondEye(rig.projector.centre, along, ahead / np.linalg.norm(ahead), matched=True)


def displacement(
    footprint: Footprint, rays: FootprintRays, scene: Scene, world_from_sensor: Transform, rig: Rig,
    pixel: NDArray[np.integer], point: Floats,
) -> Floats:  # fmt: skip
    """By how much points lie too far along their rays in the mean, b (n,) [mm]; 0 where no light is on the footprint.

    ``pixel`` (n,) of the grid, and the ``point`` (n, 3) [mm] that it shows, sensor frame.
    """
    if not len(pixel):
        return np.zeros(0)
    width = footprint.width(rig.reference.sensor_from_camera.inverse().points(point)[:, 2])

    def average(some: NDArray[Any], fine: bool) -> tuple[Floats, NDArray[np.bool_]]:
        return footprint_displacement(
            scene, rays, world_from_sensor, pixel[some], footprint.nodes(fine), width[some], footprint.lamp,
            footprint.second, footprint.power,
        )  # fmt: skip

    moved, cut = average(np.ones(len(pixel), bool), fine=False)
    again = cut | (np.abs(moved) > FAR_MM)
    if again.any():
        moved[again] = average(again, fine=True)[0]
    return np.nan_to_num(moved)
