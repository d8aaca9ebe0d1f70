"""Fit features to windows of a cloud's grid, and measure the angles and distances between them.

Signal chain: window [px] -> its points -> robust fit along the view rays, seen from the origin of the grid
(:mod:`characterisation.features.fits`) -> value and standard uncertainty, propagated from the covariance of the fit
(:func:`characterisation.tasks.measurement_model.evaluate`).

A window should contain one feature and little else. If fewer than :data:`LEAST_SHARE` of its points lie on the fitted
surface, or they scatter widely about it, the result has no value and states this reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import belonging, fit_plane, fit_surface
from characterisation.features.fitted import CylinderFit, PlaneFit, SphereFit
from characterisation.features.form import fit_form, zone
from characterisation.features.robust_fit import CHOICES, CLIP, FitError, on_one_side, rays_from
from characterisation.features.starts import cylinder_start, sphere_start
from characterisation.features.surfaces import GRAZING_COSINE, Surface, distances
from characterisation.features.vectors import lengths
from characterisation.files.errors import InputError, nearest
from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from characterisation.tasks.definitions import (
    axis_angle,
    axis_distance,
    plane_angle,
    plane_axis_angle,
    plane_distance,
    point_distance,
    point_plane_distance,
)
from characterisation.tasks.measurement_model import evaluate
from characterisation.tasks.places import MOST_ASKEW_DEG, askew_deg
from characterisation.tasks.places_in_frame import PLACE_QUANTITIES, place_functions
from characterisation.tasks.result import Result, failed

Shape = Literal["plane", "sphere", "cylinder"]
PairKind = Literal["angle", "distance"]
ShapeFit = PlaneFit | SphereFit | CylinderFit

#: least share of a window's points on the fitted surface
LEAST_SHARE = 0.5

#: largest noise of a fit over the distance of its points. Points that are all false scatter over the range of a
#: matcher, by 5 % or more; no sensor has noise of 3 %. *Assumed*
MOST_NOISE = 0.03

#: most median distance of the points from a fit over that from its start; chosen: of normal noise it is about 1
MOST_WORSE = 1.2

#: least number of points in a window
LEAST_POINTS = 30


def window_slices(window: Roi | None, cloud: PointCloud, name: str) -> tuple[slice, slice]:
    """Return rows and columns of a window [px] of a cloud's grid; None is the whole grid.

    Raises InputError if the window does not lie in the grid. The error names ``name``, the feature of the window.
    """
    grid = cloud.grid
    if window is None:
        return slice(0, grid.height), slice(0, grid.width)
    if not window.fits(grid.width, grid.height):
        found = f"{window.left},{window.top},{window.width},{window.height}"
        allowed = f"column,row,width,height within {grid.width} x {grid.height} pixels"
        if grid.height == 1:
            hint = "the points are a list, without rows and columns: measure all of them, with the name alone"
            raise InputError("window", name, found, "no window", hint)
        raise InputError("window", name, found, allowed, "--picture shows the cloud with its rows and columns")
    return window.slices


def window_points(window: Roi | None, cloud: PointCloud, name: str) -> NDArray[np.float64]:
    """Return the valid points (n, 3) [mm] of a window, in the sensor frame; raises as :func:`window_slices`."""
    inside = window_slices(window, cloud, name)
    return np.asarray(cloud.points[inside][cloud.valid[inside]], float)


@dataclass(frozen=True)
class WindowPlan:
    """Features to measure in windows, and the angles and distances between pairs of them."""

    features: Mapping[str, tuple[Shape, Roi | None]]  # shape and window by name; a window of None is the whole grid
    pairs: Sequence[tuple[PairKind, str, str]] = ()  # kind of measurement, and the names of two features

    def check(self) -> None:
        """Check that every pair names two different features of the plan that have this measurement.

        Raises InputError for the first pair that does not.
        """
        for kind, first, second in self.pairs:
            for name in (first, second):
                if name not in self.features:
                    names = list(self.features)
                    allowed = ", ".join(names) or "the name of a --plane, --sphere or --cylinder"
                    raise InputError(f"--{kind}", "", repr(name), allowed, nearest(name, names))
            if first == second:
                raise InputError(f"--{kind}", "", f"{first},{second}", "two different features")
            shapes = self.features[first][0], self.features[second][0]
            if _pair_function(kind, *shapes) is None:
                raise InputError(
                    f"--{kind}", "", f"{first} ({shapes[0]}) and {second} ({shapes[1]})", _ALLOWED_SHAPES[kind]
                )


def measure_windows(cloud: PointCloud, plan: WindowPlan, frame: NDArray[np.float64] | None = None) -> list[Result]:
    """Measure every feature of a plan in a cloud, then the angles and distances between features.

    - Plane: flatness, noise, distance from the grid's origin along the ray to the middle of the points.
    - Sphere: diameter, noise, distance of the centre from the grid's origin.
    - Cylinder: diameter, cylindricity, noise.

    Then follow place and direction of each (:mod:`characterisation.tasks.places_in_frame`), in the frame that ``frame``
    (4, 4) gives from the sensor frame; by default in the sensor frame.

    Flatness and cylindricity are ranges of the low-order form (:mod:`characterisation.features.form`). Noise is the
    standard deviation of the residuals along the view rays. Lengths are in mm, angles in deg.

    Standard uncertainties follow from the covariance of the fits by the law of propagation of uncertainty (JCGM 100,
    5.2). That of the noise is s / sqrt(2 nu), with nu degrees of freedom and normal noise (JCGM 100, E.4.3). Raises
    InputError if a window does not lie in the grid, or a pair of features has no such measurement.
    """
    plan.check()
    results: list[Result] = []
    fits: dict[str, ShapeFit | FitError] = {}
    counts: dict[str, int] = {}
    for name, (shape, window) in plan.features.items():
        points = window_points(window, cloud, name)
        counts[name] = len(points)
        fit: ShapeFit | FitError
        try:
            fit = fit_shape(points, shape, cloud.grid.origin)
        except FitError as error:
            fit = FitError(f"{error}: does the window show one {shape}?")
        fits[name] = fit
        if isinstance(fit, FitError):
            quantities = [*((quantity, "mm") for quantity in _QUANTITIES[shape]), *PLACE_QUANTITIES[shape]]
            results += [failed(f"{name} {quantity}", unit, str(fit), 0, len(points)) for quantity, unit in quantities]
        else:
            results += _shape_results(name, fit, points, cloud.grid.origin)
            results += _place_results(name, fit, points, cloud.grid.origin, np.eye(4) if frame is None else frame)
    for kind, first, second in plan.pairs:
        results.append(_pair_result(kind, (first, second), fits, counts, plan))
    return results


_QUANTITIES: dict[Shape, tuple[str, ...]] = {
    "plane": ("flatness", "noise", "distance"),
    "sphere": ("diameter", "noise", "distance"),
    "cylinder": ("diameter", "cylindricity", "noise"),
}

_ALLOWED_SHAPES: dict[PairKind, str] = {
    "angle": "planes and cylinders",
    "distance": "two planes, two cylinders, two spheres, or a sphere and a plane",
}


_PAIR_FUNCTIONS: dict[tuple[PairKind, Shape, Shape], Callable[..., Any]] = {
    ("angle", "plane", "plane"): plane_angle,
    ("angle", "plane", "cylinder"): plane_axis_angle,
    ("angle", "cylinder", "cylinder"): axis_angle,
    ("distance", "plane", "plane"): plane_distance,
    ("distance", "cylinder", "cylinder"): axis_distance,
    ("distance", "sphere", "sphere"): point_distance,
    ("distance", "sphere", "plane"): point_plane_distance,
}


def fit_shape(points: NDArray[np.float64], shape: Shape, viewpoint: NDArray[np.float64]) -> ShapeFit:
    """Fit a shape to the points (n, 3) [mm] of a window, seen from a viewpoint (3,) [mm].

    Raises FitError if the points do not determine it, fewer than :data:`LEAST_SHARE` of them lie on it, or they scatter
    about it by more than :data:`MOST_NOISE` of their distance.
    """
    if len(points) < LEAST_POINTS:
        raise FitError(f"{len(points)} points in the window, at least {LEAST_POINTS} are needed")
    fit, shown = _fit(points, shape, viewpoint), np.ones(len(points), bool)
    for _ in range(CHOICES):
        residual, cosine = distances(fit, points, rays_from(viewpoint, points))
        before, shown = shown, on_one_side(cosine, np.abs(residual) <= CLIP * fit.residual_std)
        if np.array_equal(shown, before):
            break
        fit = _fit(points[shown], shape, viewpoint)
    if fit.count < LEAST_SHARE * len(points):
        grazing = np.abs(distances(fit, points, rays_from(viewpoint, points))[1]) <= GRAZING_COSINE
        if shape == "plane" and grazing.mean() > 1 - LEAST_SHARE:
            which = f"{100 * grazing.mean():.0f} % of the {len(points)} points"
            raise FitError(f"{which} are seen at grazing incidence from the sensor, the origin of their frame")
        share = f"{100 * fit.count / len(points):.0f} % of the {len(points)} points"
        raise FitError(f"only {share} lie on the fitted {shape}")
    distance = float(np.median(lengths(points - viewpoint)))
    if fit.residual_std > MOST_NOISE * distance:
        scatter = f"the {len(points)} points scatter by {fit.residual_std:.3g} mm about the fitted {shape}"
        raise FitError(f"{scatter}, {100 * fit.residual_std / distance:.2g} % of their distance")
    return fit


def _fit(points: NDArray[np.float64], shape: Shape, viewpoint: NDArray[np.float64]) -> ShapeFit:
    """Fit a shape to points (n, 3) [mm] alone; outliers that draw it off its start are left out."""
    if shape == "plane":
        return fit_plane(points, viewpoint)
    start = sphere_start(points) if shape == "sphere" else cylinder_start(points)
    try:
        fit = fit_surface(points, start, viewpoint)
        if _median(fit, points, viewpoint) <= MOST_WORSE * _median(start, points, viewpoint):
            return cast(ShapeFit, fit)
    except FitError:
        pass
    near = belonging(points, start, viewpoint)
    return cast(ShapeFit, fit_surface(points[near], start, viewpoint))


def _median(surface: Surface, points: NDArray[np.float64], viewpoint: NDArray[np.float64]) -> float:
    """Return the median distance [mm] of points (n, 3) from a surface along their rays."""
    return float(np.median(np.abs(distances(surface, points, rays_from(viewpoint, points))[0])))


def _shape_results(
    name: str, fit: ShapeFit, points: NDArray[np.float64], viewpoint: NDArray[np.float64]
) -> list[Result]:
    """Return the results of one fitted feature."""
    result = partial(Result, unit="mm", origin="fit", points=fit.count, points_given=len(points))
    # relative standard uncertainty 1 / sqrt(2 nu) of a standard deviation, normal noise (JCGM 100, E.4.3)
    degrees = fit.count - fit.parameter_count
    noise = result(f"{name} noise", value=fit.residual_std, uncertainty=fit.residual_std / math.sqrt(2 * degrees))

    def evaluated(quantity: str, function: Callable[[Any], float]) -> Result:
        value, uncertainty = evaluate(function, [fit])
        return result(f"{name} {quantity}", value=value, uncertainty=uncertainty)

    if isinstance(fit, SphereFit):
        distance = evaluated("distance", lambda sphere: float(np.linalg.norm(sphere.centre - viewpoint)))
        return [evaluated("diameter", lambda sphere: 2 * float(sphere.radius)), noise, distance]
    form_name = f"{name} cylindricity" if isinstance(fit, CylinderFit) else f"{name} flatness"
    try:
        form = fit_form(points, fit, viewpoint)
        form_result = Result(form_name, "mm", *evaluate(zone, [form]), "fit", form.count, len(points))
    except FitError as error:
        form_result = failed(form_name, "mm", str(error), points_given=len(points))
    if isinstance(fit, CylinderFit):
        return [evaluated("diameter", lambda cylinder: 2 * float(cylinder.radius)), form_result, noise]
    middle = fit.point - viewpoint
    ray = middle / np.linalg.norm(middle)
    distance = evaluated(
        "distance", lambda plane: float((plane.point - viewpoint) @ plane.normal / (ray @ plane.normal))
    )
    return [form_result, noise, distance]


def _place_results(
    name: str, fit: ShapeFit, points: NDArray[np.float64], viewpoint: NDArray[np.float64], frame: NDArray[np.float64]
) -> list[Result]:
    """Return place and direction of one fitted feature in a frame."""
    near = np.abs(distances(fit, points, rays_from(viewpoint, points))[0]) <= CLIP * fit.residual_std
    middle = points[near].mean(axis=0)
    return [
        Result(f"{name} {quantity}", unit, *evaluate(function, [fit]), "fit", fit.count, len(points))
        for quantity, unit, function in place_functions(fit, middle, frame)
    ]


def _pair_result(
    kind: PairKind,
    names: tuple[str, str],
    fits: Mapping[str, ShapeFit | FitError],
    counts: Mapping[str, int],
    plan: WindowPlan,
) -> Result:
    """Return the angle, 0 to 90 deg, or the distance [mm] between two features."""
    label, unit = f"{names[0]}-{names[1]} {kind}", "deg" if kind == "angle" else "mm"
    inputs: list[ShapeFit] = []
    for name in names:
        fit = fits[name]
        if isinstance(fit, FitError):
            return failed(label, unit, f"{name}: {fit}")
        inputs.append(fit)
    selected = _pair_function(kind, plan.features[names[0]][0], plan.features[names[1]][0])
    assert selected is not None  # plan.check()
    function, swapped = selected
    ordered = inputs[::-1] if swapped else inputs
    if function in (plane_distance, axis_distance):
        angle = askew_deg(inputs)
        if angle > MOST_ASKEW_DEG:
            return failed(label, unit, f"they are {angle:.0f} deg apart, so they have no one distance")
    if function is plane_distance:
        value, uncertainty = evaluate(lambda a, b: plane_distance(a, b, nominal=ordered), ordered)
    else:
        value, uncertainty = evaluate(function, ordered)
    if not math.isfinite(value):
        return failed(label, unit, "the features are parallel or coincide")
    scale = math.degrees(1.0) if unit == "deg" else 1.0
    count, total = sum(fitted.count for fitted in inputs), sum(counts[name] for name in names)
    return Result(label, unit, value * scale, uncertainty * scale, "fit", count, total)


def _pair_function(kind: PairKind, first: Shape, second: Shape) -> tuple[Callable[..., Any], bool] | None:
    """Return the function that measures two shapes, and whether it takes them in reverse order; None without one."""
    for ordered, swapped in (((first, second), False), ((second, first), True)):
        if (kind, *ordered) in _PAIR_FUNCTIONS:
            return _PAIR_FUNCTIONS[(kind, *ordered)], swapped
    return None
