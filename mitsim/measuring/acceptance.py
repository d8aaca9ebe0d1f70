"""Compute acceptance figures of clouds, after VDI/VDE 2634-2 and as in makers' data sheets.

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
from characterisation.tasks.result import Result, failed
from mitsim.measuring.request import check_unique, parse_numbers, parse_window
from mitsim.measuring.windows import LEAST_POINTS, window_points, window_slices
from mitsim.sensor.roi import Roi

Value = TypeVar("Value")

_PLANE = "NAME, NAME=DISTANCE or NAME=COLUMN,ROW,WIDTH,HEIGHT[,DISTANCE]"
_SPHERE = "NAME=DIAMETER or NAME=COLUMN,ROW,WIDTH,HEIGHT,DIAMETER"
_SPACING = "NAME,NAME,DISTANCE of two spheres"


@dataclass(frozen=True)
class Artefacts:
    """Calibrated artefacts in a cloud, by name. A window [px] of None is the whole grid.

    - ``planes``: window, and distance from the sensor along the plane's normal [mm], None if unknown.
    - ``spheres``: window and diameter [mm].
    - ``spacings``: names of two spheres, and the distance of their centres [mm].
    """

    planes: Mapping[str, tuple[Roi | None, float | None]]
    spheres: Mapping[str, tuple[Roi | None, float]]
    spacings: Sequence[tuple[str, str, float]]


def read_artefacts(planes: Sequence[str], spheres: Sequence[str], spacings: Sequence[str]) -> Artefacts:
    """Read the texts of ``--plane``, ``--sphere`` and ``--spacing``.

    Raises
    ------
    InputError
        If a text cannot be read. The error names the option and the allowed form.
    """
    targets: dict[str, tuple[Roi | None, float | None]] = {}
    for text in planes:
        name, numbers = parse_numbers("--plane", text, (0, 1, 4, 5), _PLANE)
        check_unique("--plane", name, targets)
        known = _checked_length("--plane", text, numbers.pop(), _PLANE) if len(numbers) in (1, 5) else None
        targets[name] = parse_window("--plane", text, numbers, _PLANE), known
    balls: dict[str, tuple[Roi | None, float]] = {}
    for text in spheres:
        name, numbers = parse_numbers("--sphere", text, (1, 5), _SPHERE)
        check_unique("--sphere", name, {**targets, **balls})
        diameter = _checked_length("--sphere", text, numbers.pop(), _SPHERE)
        balls[name] = parse_window("--sphere", text, numbers, _SPHERE), diameter
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
        pairs.append((first, second, _checked_length("--spacing", text, value, _SPACING)))
    return Artefacts(targets, balls, pairs)


def cloud_figures(cloud: PointCloud, artefacts: Artefacts, baseline_mm: float | None) -> list[Result]:
    """Return the figures of every plane, sphere and spacing in one cloud.

    - Plane: fill rate [%], flatness error [mm], plane-fit RMS [mm and % of the distance], local planarity precision
      [mm]. Z accuracy [%] needs a distance, sub-pixel RMS [px] needs ``baseline_mm``.
    - Sphere: form error PF and size error PS [mm].
    - Spacing: spacing error SD [mm].

    Definitions and sources: :mod:`characterisation.acceptance.vdi_2634` and
    :mod:`characterisation.acceptance.depth_quality`. A figure that cannot be computed has no value, but a reason.

    Raises
    ------
    InputError
        If a window does not lie in the grid.
    """
    out: list[Result] = []
    for name, (window, distance) in artefacts.planes.items():
        out += _plane_figures(name, cloud, window, distance, baseline_mm)
    for name, (window, diameter) in artefacts.spheres.items():
        points = window_points(window, cloud, name)
        count = cloud.status[window_slices(window, cloud, name)].size
        error = _value_or_reason(probing_error, points, diameter)
        for label, field in ((f"{name} form error PF", "form"), (f"{name} size error PS", "size")):
            if isinstance(error, str):
                out.append(failed(label, "mm", error, len(points), count))
            else:
                out.append(Result(label, "mm", getattr(error, field), points=len(points), points_given=count))
    for first, second, distance in artefacts.spacings:
        one, other = (window_points(artefacts.spheres[name][0], cloud, name) for name in (first, second))
        label = f"{first}-{second} spacing error SD"
        found = _value_or_reason(sphere_spacing_error, one, other, distance)
        count = len(one) + len(other)
        out.append(
            failed(label, "mm", found, count) if isinstance(found, str) else Result(label, "mm", found, points=count)
        )
    return out


def joint_figures(clouds: Sequence[PointCloud], artefacts: Artefacts) -> list[Result]:
    """Return the figures of every plane that need two or more captures of one pose.

    Temporal noise [mm], the median over the window; global planarity trueness [mm]; with a distance mean depth error
    [%]. Definitions and sources: :mod:`characterisation.acceptance.depth_quality`.

    Raises
    ------
    InputError
        If there are fewer than two clouds, their grids differ in size, or a window does not lie in the grid.
    """
    out: list[Result] = []
    noise = temporal_noise(clouds) if artefacts.planes else np.empty((0, 0))
    for name, (window, distance) in artefacts.planes.items():
        inside = window_slices(window, clouds[0], name)
        region, known_noise = _mask(clouds[0], inside), noise[inside][np.isfinite(noise[inside])]
        reason = "no pixel has a point in two of the clouds"
        out += [
            _figure_or_reason(
                f"{name} temporal noise", "mm", float(np.median(known_noise)) if len(known_noise) else np.nan, reason
            ),
            _figure_or_reason(
                f"{name} global planarity trueness",
                "mm",
                global_planarity_trueness(clouds, region),
                "fewer than 4 pixels have a point in every cloud",
            ),
        ]
        if distance is not None:
            error = mean_depth_error(clouds, _perpendicular_plane(clouds[0], distance), region)
            out.append(_figure_or_reason(f"{name} mean depth error", "%", error, "a cloud has too few points"))
    return out


def _plane_figures(
    name: str, cloud: PointCloud, window: Roi | None, distance: float | None, baseline_mm: float | None
) -> list[Result]:
    """Return the figures of one plane; those that need many points give their number as the reason."""
    region, points = _mask(cloud, window_slices(window, cloud, name)), window_points(window, cloud, name)
    count = int(region.sum())
    truth = None if distance is None else _perpendicular_plane(cloud, distance)
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
    too_few = f"{len(points)} points in the window, at least {LEAST_POINTS} are needed"
    holes = "no patch of 9 x 9 pixels has all points"
    return [
        _figure_or_reason(f"{name} {quantity}", unit, value, too_few if not enough else holes, len(points), count)
        for (quantity, unit), value in values.items()
    ]


def _figure_or_reason(name: str, unit: str, value: float, reason: str, points: int = 0, count: int = 0) -> Result:
    """Return the result of a figure, or the reason why it has no value."""
    if np.isfinite(value):
        return Result(name, unit, float(value), points=points, points_given=count)
    return failed(name, unit, reason, points, count)


def _value_or_reason(function: Callable[..., Value], *arguments: Any) -> Value | str:
    try:
        return function(*arguments)
    except InputError as error:
        return str(error)


def _perpendicular_plane(cloud: PointCloud, distance: float) -> Coupon:
    """Return the plane perpendicular to the optical axis of the cloud's grid at a distance [mm]."""
    axes = cloud.grid.rotation
    return Coupon(cloud.grid.origin + distance * axes[:, 2], -axes[:, 2], axes[:, 0], 1.0, 1.0)


def _mask(cloud: PointCloud, inside: tuple[slice, slice]) -> NDArray[np.bool_]:
    mask = np.zeros(cloud.status.shape, bool)
    mask[inside] = True
    return mask


def _checked_length(option: str, text: str, value: float, allowed: str) -> float:
    if not 0 < value < 1e6:
        raise InputError(option, "", repr(text), f"{allowed}, lengths over 0 mm")
    return value
