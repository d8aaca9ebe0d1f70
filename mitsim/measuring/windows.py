"""Features in windows of a cloud's grid, and the angles and distances between them.

Signal chain: window [px] -> its points -> robust fit along the view rays, seen from the origin of the grid
(:mod:`characterisation.features.fits`) -> value and standard uncertainty, propagated from the covariance of the fit
(:func:`characterisation.tasks.evaluation.evaluate`).

A feature's window should hold that feature and little else: fewer than :data:`LEAST_SHARE` of the points on the fitted
surface is an answer that says so, and no value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError, nearest
from characterisation.features.fits import (
    CylinderFit,
    FitError,
    PlaneFit,
    SphereFit,
    fit_cylinder,
    fit_plane,
    fit_sphere,
)
from characterisation.features.form import fit_form, zone
from characterisation.features.starts import cylinder_start
from characterisation.point_cloud import PointCloud
from characterisation.tasks.definitions import (
    axis_angle,
    axis_distance,
    plane_angle,
    plane_axis_angle,
    plane_distance,
    point_distance,
    point_plane_distance,
)
from characterisation.tasks.evaluation import evaluate
from mitsim.measuring.result import Result, failed
from mitsim.sensor.roi import Roi

Shape = Literal["plane", "sphere", "cylinder"]
Between = Literal["angle", "distance"]
ShapeFit = PlaneFit | SphereFit | CylinderFit

#: share of a window's points that must lie on the fitted surface
LEAST_SHARE = 0.5

#: points that a window must have
LEAST_POINTS = 30


def window_slices(window: Roi | None, cloud: PointCloud, name: str) -> tuple[slice, slice]:
    """Return rows and columns of a window of a cloud's grid; of the whole grid if there is none.

    Raises
    ------
    InputError
        If the window does not lie in the grid; ``name`` is that of its feature.
    """
    grid = cloud.grid
    if window is None:
        return slice(0, grid.height), slice(0, grid.width)
    if not window.fits(grid.width, grid.height):
        found = f"{window.left},{window.top},{window.width},{window.height}"
        allowed = f"column,row,width,height within {grid.width} x {grid.height} pixels"
        raise InputError("window", name, found, allowed, "--picture shows the cloud with its rows and columns")
    return window.slices


def window_points(window: Roi | None, cloud: PointCloud, name: str) -> NDArray[np.float64]:
    """Return the valid points (n, 3) [mm] of a window; raises as :func:`window_slices`."""
    inside = window_slices(window, cloud, name)
    return np.asarray(cloud.points[inside][cloud.valid[inside]], float)


@dataclass(frozen=True)
class WindowPlan:
    """Features to measure in windows, and the angles and distances ``between`` them.

    ``features`` name -> shape and window, None for the whole grid; each of ``between`` is a kind of measurement and the
    names of two features.
    """

    features: Mapping[str, tuple[Shape, Roi | None]]
    between: Sequence[tuple[Between, str, str]] = ()

    def check(self) -> None:
        """Reject pairs of features that are not known, or that have no such measurement.

        Raises
        ------
        InputError
            With the first of them.
        """
        for kind, first, second in self.between:
            for name in (first, second):
                if name not in self.features:
                    known = list(self.features)
                    allowed = ", ".join(known) or "the name of a --plane, --sphere or --cylinder"
                    raise InputError(f"--{kind}", "", repr(name), allowed, nearest(name, known))
            shapes = self.features[first][0], self.features[second][0]
            if _between(kind, *shapes) is None:
                raise InputError(f"--{kind}", "", f"{first} ({shapes[0]}) and {second} ({shapes[1]})", _ALLOWED[kind])


def measure_windows(cloud: PointCloud, plan: WindowPlan) -> list[Result]:
    """Measure every feature of a plan in a cloud, then what lies between them.

    Of a plane: flatness (low-order form, :mod:`characterisation.features.form`), noise (standard deviation of the
    residuals along the view rays), distance from the sensor along the ray to its middle. Of a sphere: diameter,
    noise, distance of the centre. Of a cylinder: diameter, cylindricity, noise. All in mm.

    Raises
    ------
    InputError
        If a window does not lie in the grid.
    """
    plan.check()
    results: list[Result] = []
    fits: dict[str, ShapeFit | FitError] = {}
    given: dict[str, int] = {}
    for name, (shape, window) in plan.features.items():
        points = window_points(window, cloud, name)
        given[name] = len(points)
        fits[name] = fit = _fitted(points, shape, cloud.grid.origin)
        if isinstance(fit, FitError):
            results += [failed(f"{name} {what}", "mm", str(fit), 0, len(points)) for what in _QUANTITIES[shape]]
        else:
            results += _of_shape(name, fit, points, cloud.grid.origin)
    for kind, first, second in plan.between:
        results.append(_of_pair(kind, (first, second), fits, given, plan))
    return results


_QUANTITIES: dict[Shape, tuple[str, ...]] = {
    "plane": ("flatness", "noise", "distance"),
    "sphere": ("diameter", "noise", "distance"),
    "cylinder": ("diameter", "cylindricity", "noise"),
}

_ALLOWED: dict[Between, str] = {
    "angle": "planes and cylinders",
    "distance": "two planes, two cylinders, two spheres, or a sphere and a plane",
}


def _fitted(points: NDArray[np.float64], shape: Shape, viewpoint: NDArray[np.float64]) -> ShapeFit | FitError:
    try:
        if len(points) < LEAST_POINTS:
            raise FitError(f"{len(points)} points in the window, at least {LEAST_POINTS} are asked for")
        fit: ShapeFit
        match shape:
            case "plane":
                fit = fit_plane(points, viewpoint)
            case "sphere":
                fit = fit_sphere(points, viewpoint)
            case "cylinder":
                fit = fit_cylinder(points, cylinder_start(points), viewpoint)
        if fit.count < LEAST_SHARE * len(points):
            share = f"{100 * fit.count / len(points):.0f} % of the {len(points)} points"
            raise FitError(f"only {share} lie on one")
        return fit
    except FitError as error:
        return FitError(f"{error}: does the window show one {shape}?")


def _of_shape(name: str, fit: ShapeFit, points: NDArray[np.float64], viewpoint: NDArray[np.float64]) -> list[Result]:
    """Results of one fitted feature."""
    result = partial(Result, unit="mm", origin="fit", points=fit.count, points_given=len(points))
    # of a standard deviation with nu degrees of freedom, for normal noise (JCGM 100, E.4.3)
    freedom = fit.count - fit.parameter_count
    noise = result(f"{name} noise", value=fit.residual_std, uncertainty=fit.residual_std / math.sqrt(2 * freedom))

    def of(what: str, function: Callable[[Any], float]) -> Result:
        value, uncertainty = evaluate(function, [fit])
        return result(f"{name} {what}", value=value, uncertainty=uncertainty)

    if isinstance(fit, SphereFit):
        away = of("distance", lambda ball: float(np.linalg.norm(ball.centre - viewpoint)))
        return [of("diameter", lambda ball: 2 * float(ball.radius)), noise, away]
    form_name = f"{name} cylindricity" if isinstance(fit, CylinderFit) else f"{name} flatness"
    try:
        form = fit_form(points, fit, viewpoint)
        width = Result(form_name, "mm", *evaluate(zone, [form]), "fit", form.count, len(points))
    except FitError as error:
        width = failed(form_name, "mm", str(error), points_given=len(points))
    if isinstance(fit, CylinderFit):
        return [of("diameter", lambda pin: 2 * float(pin.radius)), width, noise]
    middle = fit.point - viewpoint
    ray = middle / np.linalg.norm(middle)
    away = of("distance", lambda plane: float((plane.point - viewpoint) @ plane.normal / (ray @ plane.normal)))
    return [width, noise, away]


def _of_pair(
    kind: Between,
    names: tuple[str, str],
    fits: Mapping[str, ShapeFit | FitError],
    given: Mapping[str, int],
    plan: WindowPlan,
) -> Result:
    """Angle or distance between two features; 0 to 90 deg, and mm."""
    label, unit = f"{names[0]}-{names[1]} {kind}", "deg" if kind == "angle" else "mm"
    inputs: list[ShapeFit] = []
    for name in names:
        fit = fits[name]
        if isinstance(fit, FitError):
            return failed(label, unit, f"{name}: {fit}")
        inputs.append(fit)
    asked = _between(kind, plan.features[names[0]][0], plan.features[names[1]][0])
    assert asked is not None  # plan.check()
    function, swapped = asked
    ordered = inputs[::-1] if swapped else inputs
    if function is plane_distance:
        value, uncertainty = evaluate(lambda a, b: plane_distance(a, b, nominal=ordered), ordered)
    else:
        value, uncertainty = evaluate(function, ordered)
    if not math.isfinite(value):
        return failed(label, unit, "the features are parallel, or lie in one another")
    scale = math.degrees(1.0) if unit == "deg" else 1.0
    count, all_given = sum(one.count for one in inputs), sum(given[name] for name in names)
    return Result(label, unit, value * scale, uncertainty * scale, "fit", count, all_given)


def _between(kind: Between, first: Shape, second: Shape) -> tuple[Callable[..., Any], bool] | None:
    """Function of two features, and whether it takes them in the other order; None where there is none."""
    both = (first, second)
    table: dict[tuple[Between, Shape, Shape], Callable[..., Any]] = {
        ("angle", "plane", "plane"): plane_angle,
        ("angle", "plane", "cylinder"): plane_axis_angle,
        ("angle", "cylinder", "cylinder"): axis_angle,
        ("distance", "plane", "plane"): plane_distance,
        ("distance", "cylinder", "cylinder"): axis_distance,
        ("distance", "sphere", "sphere"): point_distance,
        ("distance", "sphere", "plane"): point_plane_distance,
    }
    for ordered, swapped in ((both, False), (both[::-1], True)):
        if (kind, *ordered) in table:
            return table[(kind, *ordered)], swapped
    return None
