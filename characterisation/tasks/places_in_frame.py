"""State where a fitted surface is, and which way it points, in the frame of the sensor or in another one.

Signal chain: fit in the sensor frame -> rigid transform to the frame -> coordinates, each with its standard uncertainty
from the covariance of the fit. The transform itself is taken as exact.

- Plane: perpendicular distance from the origin of the frame, and the unit normal toward the sensor.
- Sphere: the centre.
- Cylinder: the unit direction of the axis, whose largest component is positive, and the point of the axis nearest the
  middle of its points. Of components that are nearly the largest, the first is positive: at 45 deg between two of
  opposite sign, noise would choose the sense.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.features.surfaces import Cylinder, Plane, Sphere

Array = NDArray[np.float64]

#: least component of an axis over the largest one that counts as equal: axes lie at 45 deg rather than at 42; chosen
NEARLY_LARGEST = 0.9

#: quantities by shape, with their units; "1" is a number without unit
PLACE_QUANTITIES: dict[str, tuple[tuple[str, str], ...]] = {
    "plane": (("perpendicular distance", "mm"), *((f"normal {axis}", "1") for axis in "xyz")),
    "sphere": tuple((f"centre {axis}", "mm") for axis in "xyz"),
    "cylinder": (*((f"axis {axis}", "1") for axis in "xyz"), *((f"axis point {axis}", "mm") for axis in "xyz")),
}


def place_functions(
    fit: Plane | Sphere | Cylinder, middle: Array, frame: Array
) -> list[tuple[str, str, Callable[[Any], float]]]:
    """Return name, unit and function of each quantity of a shape; a function takes the shape or one moved a little.

    The point of an axis slides along it when it tilts, since the ``middle`` of the points lies beside the axis.

    ``fit``: surface in the sensor frame [mm]. ``middle``: (3,) of its points [mm], sensor frame. ``frame``: (4, 4)
    rigid transform from the sensor frame to that of the quantities [mm].
    """
    rotation, shift = frame[:3, :3], frame[:3, 3]
    functions: list[Callable[[Any], float]]
    if isinstance(fit, Plane):

        def distance(plane: Plane) -> float:
            return abs(float((rotation @ plane.point + shift) @ (rotation @ plane.normal)))

        functions = [distance, *(_component(lambda plane: rotation @ plane.normal, k) for k in range(3))]
        kind = "plane"
    elif isinstance(fit, Sphere):
        functions = [_component(lambda sphere: rotation @ sphere.centre + shift, k) for k in range(3)]
        kind = "sphere"
    else:
        along = rotation @ fit.axis
        sizes = np.abs(along)
        sign = 1.0 if along[np.argmax(sizes > NEARLY_LARGEST * sizes.max())] > 0 else -1.0
        functions = [_component(lambda cylinder: sign * rotation @ cylinder.axis, k) for k in range(3)]
        beside = middle - ((middle - fit.point) @ fit.axis) * fit.axis
        functions += [
            _component(lambda cylinder: rotation @ cylinder.at_foot_of(beside).point + shift, k) for k in range(3)
        ]
        kind = "cylinder"
    return [(name, unit, function) for (name, unit), function in zip(PLACE_QUANTITIES[kind], functions, strict=True)]


def _component(vector: Callable[[Any], Array], number: int) -> Callable[[Any], float]:
    return lambda shape: float(vector(shape)[number])
