"""The measuring of a task: from a labelled cloud to values with standard uncertainties.

Signal chain: labelled cloud -> points per feature -> fit from the nominal geometry, once per feature -> measurement
model, a function of the fits that it rests on -> error against the nominal value, and the standard uncertainty that the
fits' covariances give it.

Features that share a parent are correlated: two circles in one face rise and fall with it. So a measurement is always
evaluated as a function of what was *fitted* (its input quantities in the sense of JCGM 100:2008, 4.1.2), and never of
derived features with covariances of their own: intersections and middle planes are computed anew, and figures
carried along with their plane, for every step of the propagation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from characterisation.errors import InputError, nearest
from characterisation.features.edges import fit_circle, fit_edge_point
from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.fits import (
    LEAST_BELONGING,
    CylinderFit,
    Fit,
    FitError,
    PlaneFit,
    belonging,
    fit_surface,
)
from characterisation.features.form import Form, fit_form
from characterisation.features.pose_fit import PoseFit, fit_pose
from characterisation.features.surfaces import Surface
from characterisation.point_cloud import PointCloud
from characterisation.tasks.definitions import (
    DEFINITIONS,
    axis_angle,
    axis_distance,
    intersection_distance,
    plane_axis_angle,
    radius,
)
from characterisation.tasks.places import intersection, mid_plane
from characterisation.tasks.task_file import DERIVED, Feature, Measurement, Task
from characterisation.tasks.task_reading import check_features, read_task

__all__ = [
    "DEFINITIONS",
    "Estimate",
    "Feature",
    "InputQuantity",
    "Measured",
    "Measurement",
    "MeasurementModel",
    "Task",
    "axis_angle",
    "axis_distance",
    "check_features",
    "evaluate",
    "fit_features",
    "intersection_distance",
    "measure",
    "measurement_model",
    "plane_axis_angle",
    "radius",
    "read_task",
]

Array = NDArray[np.float64]


class Estimate(Protocol):
    """Anything fitted: it has a covariance (p, p), and is changed by p parameters."""

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters."""

    def moved(self, parameters: Array) -> Any:
        """Change by the parameters (p,)."""


@dataclass(frozen=True)
class InputQuantity:
    """What a measurement rests on: the fit or the form of one feature, or the pose by several."""

    kind: Literal["feature", "form", "pose"]
    features: tuple[str, ...]


@dataclass(frozen=True)
class MeasurementModel:
    """A measurement as a function of its input quantities.

    ``value`` takes a fit for each of ``inputs``, in their order, and returns mm or rad: a
    :data:`~characterisation.features.fits.Fit` for a feature, a :class:`~characterisation.features.form.Form`, a
    :class:`~characterisation.features.pose_fit.Pose`.
    """

    inputs: tuple[InputQuantity, ...]
    value: Callable[..., float]


@dataclass(frozen=True)
class Measured:
    """Outcome of one measurement in one cloud, in the measurement's unit.

    ``error`` is value minus nominal; ``standard_uncertainty`` is propagated from the fits. Where the measurement was
    not possible the three are NaN and ``reason`` says why.
    """

    value: float
    error: float
    standard_uncertainty: float
    possible: bool
    reason: str


def measurement_model(task: Task, measurement: str, sensor_from_part: ArrayLike | None = None) -> MeasurementModel:
    """A measurement of a task as a function of what is fitted for it.

    ``sensor_from_part`` (4, 4) takes the nominal geometry to the frame of the fits; left out, they are in the part
    frame.
    """
    asked = task.measurements[measurement]
    definition = DEFINITIONS[asked.kind]
    motion = np.eye(4) if sensor_from_part is None else np.asarray(sensor_from_part, float)
    if definition.of == "form":
        return MeasurementModel((InputQuantity("form", asked.features),), definition.value)
    if definition.of == "pose":
        places = [np.array(task.features[name].point_mm) for name in asked.features]
        point = np.mean(places, axis=0) if asked.point_mm is None else np.array(asked.point_mm)
        value = partial(definition.value, sensor_from_part=motion, point=point)
        return MeasurementModel((InputQuantity("pose", asked.features),), value)
    extra: dict[str, Any] = {}
    if "nominal" in definition.needs:
        extra["nominal"] = [task.nominal(name, motion) for name in asked.features]
    if "outline" in definition.needs:
        outline = np.array(task.features[asked.features[0]].outline_mm or (), float).reshape(-1, 3)
        extra["outline"] = outline @ motion[:3, :3].T + motion[:3, 3]
    fitted = task.fitted_for(measurement)

    def value_of_fits(*fits: Any) -> float:
        by_name = dict(zip(fitted, fits, strict=True))
        features = [_resolved(task.features[name], name, by_name) for name in asked.features]
        return definition.value(*features, **extra)

    return MeasurementModel(tuple(InputQuantity("feature", (name,)) for name in fitted), value_of_fits)


def _resolved(feature: Feature, name: str, fits: Mapping[str, Any]) -> Any:
    """A feature from the fits: itself, carried along with its plane, or made of its parents."""
    if feature.kind == "intersection":
        return intersection([fits[parent] for parent in feature.of or ()])
    if feature.kind == "mid_plane":
        return mid_plane(*[fits[parent] for parent in feature.of or ()])
    if feature.shaped:
        return fits[name]
    (plane,) = feature.of or ("",)
    return fits[name].carried(fits[plane])


def fit_features(
    cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, minimum_points: int = 100
) -> dict[str, Fit | FitError]:
    """Fit every feature of a task that is fitted, seen from the origin of the cloud's grid; intersections are not.

    Shapes are fitted to their points in the labelled cloud, less what lies too far from the nominal surface to belong
    to it (:func:`characterisation.features.fits.belonging`); circles and points of edges to where the points of their
    plane end (:mod:`characterisation.features.edges`). ``sensor_from_part`` (4, 4) places the nominal geometry, from
    which cylinders, cones and figures start. A shape with fewer than ``minimum_points`` points, or less than a quarter
    of those that came back, or anything that its points do not determine, is answered by the :class:`FitError`.

    Raises
    ------
    InputError
        If the cloud knows no feature of that name.
    """
    fits: dict[str, Fit | FitError] = {}
    for name in task.shapes:
        try:
            surface = task.features[name].nominal(sensor_from_part)
            fits[name] = fit_surface(_points(cloud, name, surface, minimum_points), surface, cloud.grid.origin)
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


def _points(cloud: PointCloud, name: str, nominal: Surface, minimum_points: int) -> Array:
    """Points (n, 3) of a shape [mm], sensor frame: those labelled with it that can lie on it."""
    if name not in cloud.feature_names:
        known = list(cloud.feature_names)
        labels = f"labels of the cloud: {', '.join(known) or 'there are none'}"
        raise InputError("task", f"features.{name}", repr(name), labels, nearest(name, known))
    points = cloud.of_feature(name)
    near = points[belonging(points, nominal, cloud.grid.origin)]
    if len(near) < minimum_points:
        raise FitError(f"{len(near)} points, at least {minimum_points} are asked for")
    if len(near) < LEAST_BELONGING * len(points):
        share = f"{100 * len(near) / len(points):.0f} % of {len(points)} points"
        raise FitError(f"only {share} lie near it, at least {100 * LEAST_BELONGING:.0f} % are asked for")
    return near


def measure(
    cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, minimum_points: int = 100, propagated: bool = True
) -> dict[str, Measured]:
    """Measure everything a task asks for in one labelled cloud; arguments and errors of :func:`fit_features`.

    Without ``propagated`` the uncertainty is not propagated from the fits, and is NaN.
    """
    fits = fit_features(cloud, task, sensor_from_part, minimum_points)
    motion = np.asarray(sensor_from_part, float)
    known: dict[InputQuantity, Estimate | FitError] = {
        InputQuantity("feature", (name,)): fit for name, fit in fits.items()
    }
    measured = {}
    for name, measurement in task.measurements.items():
        model = measurement_model(task, name, motion)
        for quantity in model.inputs:
            if quantity not in known:
                known[quantity] = _estimate(quantity, cloud, task, fits, motion, minimum_points)
        measured[name] = _measured(measurement, model, [known[quantity] for quantity in model.inputs], propagated)
    return measured


def measure_points(
    points: Mapping[str, ArrayLike], task: Task, minimum_points: int = 100, propagated: bool = True
) -> dict[str, Measured]:
    """Measure everything a task asks for in points (n, 3) [mm] of its shapes, part frame, from wherever they were seen.

    Points of several views have no one viewpoint: their distances are orthogonal, as in coordinate metrology. Circles
    and points of edges, forms and poses need one organised cloud, and are not possible.
    """
    known: dict[InputQuantity, Estimate | FitError] = {}
    for name in task.shapes:
        some = np.asarray(points.get(name, np.empty((0, 3))), float)
        try:
            if len(some) < minimum_points:
                raise FitError(f"{len(some)} points, at least {minimum_points} are asked for")
            known[InputQuantity("feature", (name,))] = fit_surface(some, task.features[name].nominal())
        except FitError as error:
            known[InputQuantity("feature", (name,))] = error
    measured = {}
    for name, measurement in task.measurements.items():
        model = measurement_model(task, name)
        apart = FitError("it needs one cloud, and cannot be taken from the joined points of several views")
        inputs = [known.get(quantity, apart) for quantity in model.inputs]
        measured[name] = _measured(measurement, model, inputs, propagated)
    return measured


def _estimate(
    quantity: InputQuantity,
    cloud: PointCloud,
    task: Task,
    fits: Mapping[str, Fit | FitError],
    motion: Array,
    minimum_points: int,
) -> Form | PoseFit | FitError:
    """Fit what is no feature: a form, or a pose."""
    origin = cloud.grid.origin
    try:
        for name in quantity.features:
            if isinstance(fit := fits[name], FitError):
                raise FitError(f"{name}: {fit}")
        points = {
            name: _points(cloud, name, task.features[name].nominal(motion), minimum_points)
            for name in quantity.features
        }
        if quantity.kind == "form":
            (name,) = quantity.features
            return fit_form(points[name], cast(PlaneFit | CylinderFit, fits[name]), origin)
        nominal: dict[str, Surface] = {name: task.features[name].nominal() for name in quantity.features}
        return fit_pose(points, nominal, motion, origin)
    except FitError as error:
        return error


def _measured(
    measurement: Measurement, model: MeasurementModel, inputs: Sequence[Estimate | FitError], propagated: bool
) -> Measured:
    estimates: list[Estimate] = []
    for quantity, estimate in zip(model.inputs, inputs, strict=True):
        if isinstance(estimate, FitError):
            what = f"{quantity.features[0]}: " if quantity.kind == "feature" else ""
            return Measured(np.nan, np.nan, np.nan, False, f"{what}{estimate}")
        estimates.append(estimate)
    value, uncertainty = evaluate(model.value, estimates) if propagated else (model.value(*estimates), math.nan)
    if not np.isfinite([value, uncertainty] if propagated else value).all():
        why = "an axis lies in a plane, or planes or axes that should meet are parallel"
        return Measured(np.nan, np.nan, np.nan, False, f"{measurement.kind} has no value: {why}")
    scale = np.rad2deg(1.0) if measurement.unit == "deg" else 1.0
    return Measured(value * scale, value * scale - measurement.nominal, uncertainty * scale, True, "")


def evaluate(
    value: Callable[..., float], fits: Sequence[Estimate], covariance: ArrayLike | None = None
) -> tuple[float, float]:
    """Value of a measurement function on fits, and its standard uncertainty, both in mm or rad.

    u^2 is the second moment of f about f(x) over the points x +- L_k, where L_k are the columns of a square root of
    the fits' joint covariance: sum_k ((f(x + L_k) - f)^2 + (f(x - L_k) - f)^2) / 2. For a linear f that is the law of
    propagation of uncertainty (JCGM 100:2008, 5.1.2 and, correlated, 5.2.2). An angle between nominally parallel
    directions is not linear but the length of a small vector, where a central difference would give 0. This gives the
    root mean square of the vector's error where the value is 0, and that of the component along the vector, at most
    sqrt(2) less, where the value is well above its noise.

    ``covariance`` (P, P) is that of all parameters of all fits in their order, for fits that are correlated; left out,
    it is made of the fits' own, as of independent ones.
    """
    best = value(*fits)
    blocks = [np.asarray(fit.covariance, float) for fit in fits]
    if covariance is None:
        root = block_diag(*[_square_root(block) for block in blocks])
    else:
        root = _square_root(np.asarray(covariance, float))
    ends = np.cumsum([len(block) for block in blocks])
    moment = 0.0
    for column in root.T:
        steps = np.split(column, ends[:-1])
        for sign in (1.0, -1.0):
            moved = [fit.moved(sign * step) if step.any() else fit for fit, step in zip(fits, steps, strict=True)]
            moment += 0.5 * (value(*moved) - best) ** 2
    return best, float(np.sqrt(moment))


def _square_root(covariance: Array) -> Array:
    """L (p, p) with L L^T the covariance."""
    variances, axes = np.linalg.eigh(covariance)
    root: Array = axes * np.sqrt(np.maximum(variances, 0.0))
    return root
