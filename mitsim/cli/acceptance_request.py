"""Compute acceptance figures of clouds, after VDI/VDE 2634-2 and as in makers' data sheets.

Signal chain: texts of the options -> planes, spheres and spacings with their calibrated lengths -> points or pixels of
each window -> figures of each cloud, and those of all clouds together (:mod:`characterisation.acceptance`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.acceptance import depth_quality
from characterisation.acceptance.range_uncertainty import flatness_uncertainty, form_error_uncertainty
from characterisation.acceptance.vdi_2634 import flatness_error, probing_error, sphere_spacing_error
from characterisation.coupon.patches import Coupon
from characterisation.files.errors import InputError, nearest
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from characterisation.tasks.result import Result, failed
from characterisation.tasks.windows import LEAST_POINTS, window_points, window_slices
from mitsim.cli.measure_request import parse_window

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
    """Read the texts of ``--plane``, ``--sphere`` and ``--spacing``; InputError with option and allowed form."""
    targets: dict[str, tuple[Roi | None, float | None]] = {}
    for text in planes:
        name, window, distance = parse_window("--plane", text, (0, 1, 4, 5), _PLANE, targets)
        targets[name] = window, None if distance is None else _checked_length("--plane", text, distance, _PLANE)
    balls: dict[str, tuple[Roi | None, float]] = {}
    for text in spheres:
        name, window, diameter = parse_window("--sphere", text, (1, 5), _SPHERE, {**targets, **balls})
        balls[name] = window, _checked_length("--sphere", text, diameter, _SPHERE)
    pairs = []
    for text in spacings:
        first, _, remainder = text.partition(",")
        second, _, last = remainder.partition(",")
        for name in (first, second):
            if name not in balls:
                allowed = f"{_SPACING}, {', '.join(balls) or 'each a --sphere'}"
                raise InputError("--spacing", "", repr(text), allowed, nearest(name, list(balls)))
        if first == second:
            raise InputError("--spacing", "", repr(text), "two different spheres")
        try:
            value = float(last)
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

    A figure that cannot be computed has no value, but a reason. Raises InputError if a window does not lie in the grid.
    """
    out: list[Result] = []
    for name, (window, distance) in artefacts.planes.items():
        out += _plane_figures(name, cloud, window, distance, baseline_mm)
    for name, (window, diameter) in artefacts.spheres.items():
        points = window_points(window, cloud, name)
        count = cloud.status[window_slices(window, cloud, name)].size
        labels = f"{name} form error PF", f"{name} size error PS"
        try:
            error = probing_error(points, diameter)
        except InputError as unfit:
            out += [failed(label, "mm", str(unfit), len(points), count) for label in labels]
            continue
        uncertainty = form_error_uncertainty(points, error.centre)
        out.append(figure_or_reason(labels[0], "mm", error.form, "", len(points), count, uncertainty))
        out.append(Result(labels[1], "mm", error.size, points=len(points), points_given=count))
    for first, second, distance in artefacts.spacings:
        one, other = (window_points(artefacts.spheres[name][0], cloud, name) for name in (first, second))
        label, count = f"{first}-{second} spacing error SD", len(one) + len(other)
        try:
            out.append(Result(label, "mm", sphere_spacing_error(one, other, distance), points=count))
        except InputError as unfit:
            out.append(failed(label, "mm", str(unfit), count))
    return out


def joint_figures(clouds: Sequence[PointCloud], artefacts: Artefacts) -> list[Result]:
    """Return the figures of every plane that need two or more captures of one pose.

    Temporal noise [mm] over the window; global planarity trueness [mm]; with a distance mean depth error [%]. Raises
    InputError if there are fewer than two clouds, their grids differ in size, or a window does not lie in the grid.
    """
    out: list[Result] = []
    for name, (window, distance) in artefacts.planes.items():
        region = _mask(clouds[0], window_slices(window, clouds[0], name))
        noise = depth_quality.typical_temporal_noise(clouds, region)
        trueness = depth_quality.global_planarity_trueness(clouds, region)
        why = "no pixel has a point in two of the clouds"
        out.append(figure_or_reason(f"{name} temporal noise", "mm", noise, why))
        why = "fewer than 4 pixels have a point in every cloud"
        out.append(figure_or_reason(f"{name} global planarity trueness", "mm", trueness, why))
        if distance is not None:
            error = depth_quality.mean_depth_error(clouds, _perpendicular_plane(clouds[0], distance), region)
            out.append(figure_or_reason(f"{name} mean depth error", "%", error, "a cloud has too few points"))
    return out


def _plane_figures(
    name: str, cloud: PointCloud, window: Roi | None, distance: float | None, baseline_mm: float | None
) -> list[Result]:
    """Return the figures of one plane; those that need many points give their number as the reason."""
    region, points = _mask(cloud, window_slices(window, cloud, name)), window_points(window, cloud, name)
    count = int(region.sum())
    truth = None if distance is None else _perpendicular_plane(cloud, distance)
    quality = depth_quality.plane_quality(cloud, region, truth, baseline_mm)
    enough = len(points) >= LEAST_POINTS
    values = {
        ("fill rate", "%"): quality.fill_rate,
        ("flatness error", "mm"): flatness_error(points) if enough else np.nan,
        ("plane-fit RMS", "mm"): quality.plane_fit_rms if enough else np.nan,
        ("plane-fit RMS over distance", "%"): quality.plane_fit_rms_percent if enough else np.nan,
        ("local planarity precision", "mm"): depth_quality.local_planarity_precision(cloud, region),
    }
    if distance is not None:
        values["Z accuracy", "%"] = quality.z_accuracy if enough else np.nan
    if baseline_mm is not None:
        values["sub-pixel RMS", "px"] = quality.subpixel_rms if enough else np.nan
    reason = f"{len(points)} points in the window, at least {LEAST_POINTS} are needed"
    reasons = {"local planarity precision": "no patch of 9 x 9 pixels has all points"} if enough else {}
    if enough:
        reason = "the least-squares plane of the points stands on edge: too many false matches for these figures"
    uncertainty = {"flatness error": flatness_uncertainty(points)} if enough else {}
    out = []
    for (quantity, unit), value in values.items():
        why, u = reasons.get(quantity, reason), uncertainty.get(quantity, math.nan)
        out.append(figure_or_reason(f"{name} {quantity}", unit, value, why, len(points), count, u))
    return out


def figure_or_reason(
    name: str, unit: str, value: float, reason: str, points: int = 0, count: int = 0, uncertainty: float = math.nan
) -> Result:
    """Return the result of a figure, or the reason why it has no value."""
    if not math.isfinite(value):
        return failed(name, unit, reason, points, count)
    return Result(name, unit, float(value), uncertainty, "fit" if math.isfinite(uncertainty) else "none", points, count)


def _perpendicular_plane(cloud: PointCloud, distance: float) -> Coupon:
    """Return the plane perpendicular to the optical axis of the cloud's grid at a distance [mm]."""
    axes = cloud.grid.rotation
    return Coupon(cloud.grid.origin + distance * axes[:, 2], -axes[:, 2], axes[:, 0], 1.0, 1.0)


def _mask(cloud: PointCloud, inside: tuple[slice, slice]) -> NDArray[np.bool_]:
    mask = np.zeros(cloud.status.shape, bool)
    mask[inside] = True
    return mask


def _checked_length(option: str, text: str, value: float | None, allowed: str) -> float:
    if value is None or not 0 < value < 1e6:
        raise InputError(option, "", repr(text), f"{allowed}, lengths over 0 mm")
    return value
