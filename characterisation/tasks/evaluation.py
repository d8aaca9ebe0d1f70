"""Evaluate the measurements of a task in a labelled cloud, or in points of its shapes, with standard uncertainties.

Signal chain: labelled cloud -> points per feature -> fit from the nominal geometry, once per feature -> measurement
model, a function of the fits (:mod:`characterisation.tasks.measurement_model`) -> error against the nominal value, and
the standard uncertainty propagated from the covariances of the fits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.credibility import PLACES, check_surface, places_seen
from characterisation.features.edges import fit_circle, fit_edge_point
from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.fits import LEAST_BELONGING, belonging, fit_surface
from characterisation.features.fitted import CylinderFit, Fit, PlaneFit
from characterisation.features.form import Form, fit_form, zone_uncertainty
from characterisation.features.pose_fit import PoseFit, fit_pose
from characterisation.features.robust_fit import FitError, UndeterminedError
from characterisation.features.surfaces import Surface
from characterisation.files.errors import InputError, nearest
from characterisation.point_cloud import PointCloud
from characterisation.tasks.measurement_model import (
    Estimate,
    InputQuantity,
    MeasurementModel,
    evaluate,
    measurement_model,
)
from characterisation.tasks.result import Result, failed
from characterisation.tasks.task_file import DERIVED, Task

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Selected:
    """Points (n, 3) [mm] of a shape that can lie on it, of ``point_count`` with its label; or why they are too few.

    ``positions`` (k, 3) [mm] on the nominal surface are those that its pixels show, with or without a point.
    """

    points: Array | FitError
    point_count: int
    positions: Array


def _fits(
    cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, selected: Mapping[str, _Selected]
) -> dict[str, Fit | FitError]:
    """Fit every feature of a task once: shapes to their selected points, then the figures in their planes.

    A feature that cannot be fitted has a :class:`FitError` in place of a fit. Derived features have none.
    """
    fits: dict[str, Fit | FitError] = {}
    for name, selection in selected.items():
        try:
            surface = task.features[name].nominal(sensor_from_part)
            fits[name] = _credible_fit(_points(selection), surface, selection.positions, cloud.grid.origin)
        except FitError as error:
            fits[name] = error
    for name, feature in task.features.items():
        if feature.shaped or feature.kind in DERIVED:
            continue
        (parent,) = feature.of or ("",)
        plane, nominal = fits[parent], task.nominal(name, sensor_from_part)
        try:
            if not isinstance(plane, PlaneFit):
                raise FitError(f"{parent}: {plane}")
            if isinstance(nominal, Circle):
                fits[name] = fit_circle(cloud, plane, nominal)
            elif isinstance(nominal, EdgePoint):
                fits[name] = fit_edge_point(cloud, plane, nominal, float(feature.reach_mm or 0.0))
        except FitError as error:
            fits[name] = error
    return {name: fits[name] for name in task.features if name in fits}


def _credible_fit(points: Array, nominal: Surface, positions: Array, viewpoint: Array | None = None) -> Fit:
    """Return the fit of a surface, or raise the error that says why there is none."""
    fit = fit_surface(points, nominal, viewpoint)
    check_surface(fit, nominal, points, positions, viewpoint)
    return fit


def _selected(cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, minimum_points: int) -> dict[str, _Selected]:
    """Return the points of every shape [mm], sensor frame: those with its label that can lie on it."""
    selected = {}
    for name in task.shapes:
        if name not in cloud.feature_names:
            names = list(cloud.feature_names)
            labels = f"labels of the cloud: {', '.join(names) or 'there are none'}"
            raise InputError("task", f"features.{name}", repr(name), labels, nearest(name, names))
        points, nominal = cloud.of_feature(name), task.features[name].nominal(sensor_from_part)
        near = points[belonging(points, nominal, cloud.grid.origin)]
        positions = places_seen(nominal, cloud.rays_of_feature(name, PLACES), cloud.grid.origin, near)
        selected[name] = _Selected(near, len(points), positions)
        if len(near) < minimum_points:
            few = FitError(f"{len(near)} points, at least {minimum_points} are required")
            selected[name] = _Selected(few, len(points), positions)
        elif len(near) < LEAST_BELONGING * len(points):
            share = f"{100 * len(near) / len(points):.0f} % of {len(points)} points"
            least = f"at least {100 * LEAST_BELONGING:.0f} % are required"
            few = FitError(f"only {share} lie near the nominal surface, {least}")
            selected[name] = _Selected(few, len(points), positions)
    return selected


def _points(selected: _Selected) -> Array:
    """Return the points of a shape, or raise the error that says why they are too few."""
    if isinstance(selected.points, FitError):
        raise selected.points
    return selected.points


def measure(
    cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, minimum_points: int = 100, propagated: bool = True
) -> dict[str, Result]:
    """Evaluate all measurements of a task in one labelled cloud, seen from the origin of its grid.

    Each measured feature is fitted once. Shapes are fitted to their points in the labelled cloud, without those too far
    from the nominal surface (:func:`characterisation.features.fits.belonging`); circles and points of edges to the
    places where the points of their plane end (:mod:`characterisation.features.edges`). A measurement has no value if a
    shape has fewer than ``minimum_points`` points, or less than a quarter of the recovered points near it, or if a fit
    is not credible (:mod:`characterisation.features.credibility`).

    Parameters
    ----------
    cloud
        Organised cloud with the labels of the task's shapes.
    task
        Features and measurements.
    sensor_from_part
        (4, 4) places the nominal geometry.
    minimum_points
        Least number of points of a shape.
    propagated
        Whether to propagate the uncertainty from the fits; it is NaN otherwise.

    Raises
    ------
    InputError
        If the cloud has no label with the name of a shape.

    See Also
    --------
    measure_points : points of several views
    """
    task, motion = task.with_measured_features(), np.asarray(sensor_from_part, float)
    selected = _selected(cloud, task, motion, minimum_points)
    fits = _fits(cloud, task, motion, selected)
    estimate_of: dict[InputQuantity, Estimate | FitError] = {
        InputQuantity("feature", (name,)): fit for name, fit in fits.items()
    }
    results = {}
    for name in task.measurements:
        model = measurement_model(task, name, motion)
        for quantity in model.inputs:
            if quantity not in estimate_of:
                estimate_of[quantity] = _estimate(quantity, cloud, task, fits, selected, motion)
        point_count = sum(selected[shape].point_count for shape in task.shapes_for(name))
        results[name] = _result(task, name, model, estimate_of, fits, point_count, propagated)
    return results


def measure_points(
    points: Mapping[str, ArrayLike], task: Task, minimum_points: int = 100, propagated: bool = True
) -> dict[str, Result]:
    """Evaluate all measurements of a task from points of its shapes, of one or several views.

    Points of several views have no single viewpoint, so distances are orthogonal, as in coordinate metrology. Circles
    and points of edges, forms and poses require one organised cloud, and are not possible.

    Parameters
    ----------
    points
        Points (n, 3) [mm], part frame, by name of the shape.
    task
        Features and measurements.
    minimum_points
        Least number of points of a shape.
    propagated
        Whether to propagate the uncertainty from the fits; it is NaN otherwise.

    See Also
    --------
    measure : a single organised cloud
    """
    fits: dict[str, Fit | FitError] = {}
    task = task.with_measured_features()
    arrays = {name: np.asarray(points.get(name, np.empty((0, 3))), float) for name in task.shapes}
    for name, array in arrays.items():
        try:
            if len(array) < minimum_points:
                raise FitError(f"{len(array)} points, at least {minimum_points} are required")
            nominal = task.features[name].nominal()
            finite = array[np.isfinite(array).all(axis=1)]
            fits[name] = _credible_fit(finite, nominal, nominal.meet(finite, None).foot)
        except FitError as error:
            fits[name] = error
    estimate_of: dict[InputQuantity, Estimate | FitError] = {
        InputQuantity("feature", (name,)): fit for name, fit in fits.items()
    }
    results = {}
    for name in task.measurements:
        model = measurement_model(task, name)
        for quantity in model.inputs:
            estimate_of.setdefault(quantity, FitError("it requires one cloud, not the joined points of several views"))
        count = sum(len(arrays[shape]) for shape in task.shapes_for(name))
        results[name] = _result(task, name, model, estimate_of, fits, count, propagated)
    return results


def _estimate(
    quantity: InputQuantity,
    cloud: PointCloud,
    task: Task,
    fits: Mapping[str, Fit | FitError],
    selected: Mapping[str, _Selected],
    motion: Array,
) -> Form | PoseFit | FitError:
    """Fit an input quantity that is not a feature: a form, or a pose."""
    origin = cloud.grid.origin
    try:
        for name in quantity.features:
            undetermined = quantity.kind == "pose" and isinstance(fits[name], UndeterminedError)
            if isinstance(fit := fits[name], FitError) and not undetermined:
                raise FitError(f"{name}: {fit}")
        points = {name: _points(selected[name]) for name in quantity.features}
        if quantity.kind == "form":
            (name,) = quantity.features
            return fit_form(points[name], cast(PlaneFit | CylinderFit, fits[name]), origin)
        nominal: dict[str, Surface] = {name: task.features[name].nominal() for name in quantity.features}
        return fit_pose(points, nominal, motion, origin)
    except FitError as error:
        return error


def _result(
    task: Task,
    name: str,
    model: MeasurementModel,
    estimate_of: Mapping[InputQuantity, Estimate | FitError],
    fits: Mapping[str, Fit | FitError],
    point_count: int,
    propagated: bool,
) -> Result:
    """Evaluate one measurement from its input quantities."""
    measurement, estimates = task.measurements[name], list[Estimate]()
    for quantity in model.inputs:
        estimate = estimate_of[quantity]
        if isinstance(estimate, FitError):
            prefix = f"{quantity.features[0]}: " if quantity.kind == "feature" else ""
            return failed(name, measurement.unit, f"{prefix}{estimate}", points_given=point_count)
        estimates.append(estimate)
    form, value, uncertainty = estimates[0], model.value(*estimates), math.nan
    if propagated:
        uncertainty = zone_uncertainty(form) if isinstance(form, Form) else evaluate(model.value, estimates)[1]
    if not np.isfinite([value, uncertainty] if propagated else value).all():
        why = "an axis lies in a plane, or planes or axes that must intersect are parallel"
        return failed(name, measurement.unit, f"{measurement.kind} has no value: {why}", points_given=point_count)
    scale = np.rad2deg(1.0) if measurement.unit == "deg" else 1.0
    rows = None if model.deviations is None else scale * model.deviations(*estimates)
    used = [fit.count for feature in task.fitted_for(name) if not isinstance(fit := fits.get(feature), FitError | None)]
    return Result(
        name,
        measurement.unit,
        value * scale,
        uncertainty * scale,
        "fit" if propagated else "none",
        sum(used),
        point_count,
        measurement.nominal,
        deviations=rows,
    )
