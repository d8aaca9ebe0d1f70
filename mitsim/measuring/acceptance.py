"""Acceptance figures of clouds: VDI/VDE 2634-2, and those of makers' data sheets.

Signal chain: texts of the options -> planes, spheres and spacings with their calibrated lengths -> points or pixels of
each window -> figures of each cloud, and those of all clouds together (:mod:`characterisation.acceptance`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from characterisation.acceptance.depth_quality import (
    global_planarity_trueness,
    local_planarity_precision,
    mean_depth_error,
    plane_quality,
    temporal_noise,
)
from characterisation.acceptance.vdi_2634 import flatness_error, probing_error, sphere_spacing_error
from characterisation.coupon.patches import Coupon
from characterisation.errors import InputError, nearest
from characterisation.point_cloud import PointCloud
from mitsim.measuring.request import named_numbers, named_once, window_of
from mitsim.measuring.result import Result, failed
from mitsim.measuring.windows import LEAST_POINTS, window_points, window_slices
from mitsim.sensor.roi import Roi

Answer = TypeVar("Answer")

_PLANE = "NAME, NAME=DISTANCE or NAME=COLUMN,ROW,WIDTH,HEIGHT[,DISTANCE]"
_SPHERE = "NAME=DIAMETER or NAME=COLUMN,ROW,WIDTH,HEIGHT,DIAMETER"
_SPACING = "NAME,NAME,DISTANCE of two spheres"


@dataclass(frozen=True)
class Artefacts:
    """Calibrated artefacts in a cloud.

    ``planes`` by name: window, and distance along the normal from the sensor [mm], None if unknown; ``spheres``:
    window and diameter [mm]; ``spacings``: two spheres and the distance of their centres [mm].
    """

    planes: Mapping[str, tuple[Roi | None, float | None]]
    spheres: Mapping[str, tuple[Roi | None, float]]
    spacings: Sequence[tuple[str, str, float]]


def read_artefacts(planes: Sequence[str], spheres: Sequence[str], spacings: Sequence[str]) -> Artefacts:
    """Read the texts of ``--plane``, ``--sphere`` and ``--spacing``.

    Raises
    ------
    InputError
        If one does not make sense; the option and what is allowed are named.
    """
    flat: dict[str, tuple[Roi | None, float | None]] = {}
    for text in planes:
        name, numbers = named_numbers("--plane", text, (0, 1, 4, 5), _PLANE)
        named_once("--plane", name, flat)
        known = _length("--plane", text, numbers.pop(), _PLANE) if len(numbers) in (1, 5) else None
        flat[name] = window_of("--plane", text, numbers, _PLANE), known
    balls: dict[str, tuple[Roi | None, float]] = {}
    for text in spheres:
        name, numbers = named_numbers("--sphere", text, (1, 5), _SPHERE)
        named_once("--sphere", name, {**flat, **balls})
        diameter = _length("--sphere", text, numbers.pop(), _SPHERE)
        balls[name] = window_of("--sphere", text, numbers, _SPHERE), diameter
    pairs = []
    for text in spacings:
        first, _, rest = text.partition(",")
        second, _, distance = rest.partition(",")
        for name in (first, second):
            if name not in balls:
                allowed = f"{_SPACING}, {', '.join(balls) or 'each a --sphere'}"
                raise InputError("--spacing", "", repr(text), allowed, nearest(name, list(balls)))
        try:
            value = float(distance)
        except ValueError:
            raise InputError("--spacing", "", repr(text), _SPACING) from None
        pairs.append((first, second, _length("--spacing", text, value, _SPACING)))
    return Artefacts(flat, balls, pairs)


def cloud_figures(cloud: PointCloud, artefacts: Artefacts, baseline_mm: float | None) -> list[Result]:
    """Figures of one cloud: of every plane, sphere and spacing; those that need a baseline only if there is one.

    Raises
    ------
    InputError
        If a window does not lie in the grid.
    """
    out: list[Result] = []
    for name, (window, distance) in artefacts.planes.items():
        out += _of_plane(name, cloud, window, distance, baseline_mm)
    for name, (window, diameter) in artefacts.spheres.items():
        points = window_points(window, cloud, name)
        count = cloud.status[window_slices(window, cloud, name)].size
        error = _or_reason(probing_error, points, diameter)
        for label, field in ((f"{name} form error PF", "form"), (f"{name} size error PS", "size")):
            if isinstance(error, str):
                out.append(failed(label, "mm", error, len(points), count))
            else:
                out.append(Result(label, "mm", getattr(error, field), points=len(points), points_given=count))
    for first, second, distance in artefacts.spacings:
        one, other = (window_points(artefacts.spheres[name][0], cloud, name) for name in (first, second))
        label = f"{first}-{second} spacing error SD"
        found = _or_reason(sphere_spacing_error, one, other, distance)
        count = len(one) + len(other)
        out.append(
            failed(label, "mm", found, count) if isinstance(found, str) else Result(label, "mm", found, points=count)
        )
    return out


def joint_figures(clouds: Sequence[PointCloud], artefacts: Artefacts) -> list[Result]:
    """Figures of the planes that makers take from several captures of one pose, two or more.

    Raises
    ------
    InputError
        If the grids of the clouds differ in size.
    """
    out: list[Result] = []
    noise = temporal_noise(clouds) if artefacts.planes else np.empty((0, 0))
    for name, (window, distance) in artefacts.planes.items():
        inside = window_slices(window, clouds[0], name)
        region, seen = _mask(clouds[0], inside), noise[inside][np.isfinite(noise[inside])]
        reason = "no pixel has a point in two clouds"
        out += [
            _figure(f"{name} temporal noise", "mm", float(np.median(seen)) if len(seen) else np.nan, reason),
            _figure(
                f"{name} global planarity trueness",
                "mm",
                global_planarity_trueness(clouds, region),
                "fewer than 4 pixels have a point in every cloud",
            ),
        ]
        if distance is not None:
            error = mean_depth_error(clouds, _square(clouds[0], distance), region)
            out.append(_figure(f"{name} mean depth error", "%", error, "a cloud has too few points"))
    return out


def _of_plane(
    name: str, cloud: PointCloud, window: Roi | None, distance: float | None, baseline_mm: float | None
) -> list[Result]:
    region, points = _mask(cloud, window_slices(window, cloud, name)), window_points(window, cloud, name)
    count = int(region.sum())
    truth = None if distance is None else _square(cloud, distance)
    quality = plane_quality(cloud, region, truth, baseline_mm)
    enough = len(points) >= LEAST_POINTS
    values = {
        ("fill rate", "%"): quality.fill_rate,
        ("flatness error", "mm"): flatness_error(points) if enough else np.nan,
        ("plane-fit RMS", "mm"): quality.plane_fit_rms if enough else np.nan,
        ("plane-fit RMS over distance", "%"): quality.plane_fit_rms_percent if enough else np.nan,
        ("local planarity precision", "mm"): local_planarity_precision(cloud, region),
    }
    if distance is not None:
        values["Z accuracy", "%"] = quality.z_accuracy if enough else np.nan
    if baseline_mm is not None:
        values["sub-pixel RMS", "px"] = quality.subpixel_rms if enough else np.nan
    few = f"{len(points)} points in the window, at least {LEAST_POINTS} are needed"
    holes = "no patch of 9 x 9 pixels without a hole"
    return [
        _figure(f"{name} {what}", unit, value, few if not enough else holes, len(points), count)
        for (what, unit), value in values.items()
    ]


def _figure(name: str, unit: str, value: float, reason: str, points: int = 0, count: int = 0) -> Result:
    """A figure, or why there is none."""
    if np.isfinite(value):
        return Result(name, unit, float(value), points=points, points_given=count)
    return failed(name, unit, reason, points, count)


def _or_reason(of: Callable[..., Answer], *arguments: Any) -> Answer | str:
    try:
        return of(*arguments)
    except InputError as error:
        return str(error)


def _square(cloud: PointCloud, distance: float) -> Coupon:
    """A plane square to the axis of the cloud's grid, at a distance [mm]."""
    axes = cloud.grid.rotation
    return Coupon(cloud.grid.origin + distance * axes[:, 2], -axes[:, 2], axes[:, 0], 1.0, 1.0)


def _mask(cloud: PointCloud, inside: tuple[slice, slice]) -> NDArray[np.bool_]:
    mask = np.zeros(cloud.status.shape, bool)
    mask[inside] = True
    return mask


def _length(option: str, text: str, value: float, allowed: str) -> float:
    if not 0 < value < 1e6:
        raise InputError(option, "", repr(text), f"{allowed}, lengths over 0 mm")
    return value
