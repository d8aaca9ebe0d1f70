"""Predict every measurement of a task from one view: its standard uncertainty, and the probability that it is possible.

Signal chain: expected points of each shape, part frame -> expected fit of every input quantity of a measurement:
surfaces, figures in a face, forms, the pose of the part (:mod:`characterisation.tasks.covariance`) -> the measurement
as a function of these, propagated as for real fits (:func:`characterisation.tasks.measurement_model.evaluate`) -> u and
the contribution of each.

All fits are small changes about the nominal geometry in the part frame, so those of several views can be joined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial import cKDTree
from scipy.special import ndtr

from characterisation.features.edges import LEAST_CROSSINGS, LEAST_FRACTION
from characterisation.features.figures import Circle, EdgePoint, crossings, edge_covariance
from characterisation.features.fitted import with_covariance
from characterisation.features.form import Form, form_modes
from characterisation.features.pose_fit import PoseFit, pose_jacobian
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cone, Cylinder, Plane
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats
from characterisation.tasks.covariance import ExpectedFit, ExpectedPoints, expected_fit, expected_sums, solved, usable
from characterisation.tasks.measurement_model import InputQuantity, evaluate, measurement_model
from characterisation.tasks.task_file import Task

#: step of the parameters for the quadratic form of a measurement, in units of their standard deviations
STEP = 1e-3

#: number of places of an edge that are tested for whether the face beside them is seen; chosen
PLACES_OF_EDGE = 120

#: distance, in spacings of the rays, within which a place of an edge has a ray on its face, at any angle; chosen
RAYS_APART = 1.5

#: least visible share of an edge; chosen. Fits to drawn clouds of a hole of 22 px under a cover are right with 58 %,
#: off by 2 mm with 55 %, and follow the edge of the cover or fail with 47 %
LEAST_VISIBLE = 0.57

#: number of random steps that give the mean square of a zone: known to a tenth
DRAWS = 200


@dataclass(frozen=True)
class ExpectedInput:
    """One input quantity: its expected ``fit``, and the nominal ``estimate`` with the covariance of that fit."""

    fit: ExpectedFit
    estimate: Any


@dataclass(frozen=True)
class ExpectedMeasurement:
    """Prediction of one measurement.

    ``uncertainty`` u is in the measurement's unit, and NaN where it is not possible, with the ``reason``. ``chance`` is
    the probability that it is possible. ``contributions`` are the u_i of each input quantity alone, in the order of
    ``inputs``. u^2 is the sum of their squares, except for shared errors, which may add up or cancel.
    """

    uncertainty: float
    chance: float
    reason: str
    inputs: tuple[InputQuantity, ...]
    contributions: tuple[float, ...]


def expected_inputs(
    task: Task, expected: Mapping[str, ExpectedPoints], minimum_points: float
) -> dict[InputQuantity, ExpectedInput | FitError]:
    """Predict all input quantities of the task's measurements for one view.

    ``expected`` holds the expected points by shape, part frame.
    """
    out: dict[InputQuantity, ExpectedInput | FitError] = {}
    for name in task.measurements:
        for quantity in measurement_model(task, name).inputs:
            if quantity not in out:
                try:
                    out[quantity] = _expected_input(quantity, task, expected, minimum_points)
                except FitError as error:
                    out[quantity] = error
    return out


def _expected_input(
    quantity: InputQuantity, task: Task, expected: Mapping[str, ExpectedPoints], minimum_points: float
) -> ExpectedInput:
    if quantity.kind == "pose":
        return _pose(quantity, task, expected, minimum_points)
    (name,) = quantity.features
    if not task.features[name].shaped:
        return _figure(name, task, expected)
    surface = task.features[name].nominal()
    if quantity.kind == "form":
        assert isinstance(surface, Plane | Cylinder)
        used = usable(surface, expected[name])
        modes = form_modes(surface, used.point, used.ray)
        fit = solved([expected_sums(modes, used, minimum_points)], "form")
        slope = surface.meet(used.point, used.ray).slope
        nothing = np.zeros(modes.shape[1])
        return ExpectedInput(fit, Form(modes * slope[:, None], nothing, fit.covariance, math.nan, round(fit.count)))
    fit = expected_fit(surface, expected[name], minimum_points)
    return ExpectedInput(fit, with_covariance(surface, fit.covariance))


def _pose(
    quantity: InputQuantity, task: Task, expected: Mapping[str, ExpectedPoints], minimum_points: float
) -> ExpectedInput:
    """Predict the pose about the mean of its features' points, which is the same from every view."""
    about = np.mean([task.features[name].point_mm or (0.0, 0.0, 0.0) for name in quantity.features], axis=0)
    parts = []
    for name in quantity.features:
        surface = task.features[name].nominal()
        used = usable(surface, expected[name])
        parts.append(expected_sums(pose_jacobian(surface, used.point, used.ray, about), used, minimum_points))
    fit = solved(parts, "pose")
    return ExpectedInput(fit, PoseFit(np.eye(4), about, fit.covariance, math.nan, round(fit.count)))


def _figure(name: str, task: Task, expected: Mapping[str, ExpectedPoints]) -> ExpectedInput:
    """Predict a circle or the point of an edge in a face; the only error of the edge is that of sampling by pixels.

    It is possible with enough crossings, if enough of the edge is visible, and with the probability that enough of the
    face beside it is recovered. The part of the edge that is hidden, or outside the image, does not count.
    """
    feature = task.features[name]
    (plane,) = feature.of or ("",)
    around = usable(task.features[plane].nominal(), expected[plane])
    figure = task.nominal(name)
    assert isinstance(figure, Circle | EdgePoint)
    position = figure.centre if isinstance(figure, Circle) else figure.point
    near = int(np.argmin(np.linalg.norm(around.point - position, axis=1)))
    viewpoint = _viewpoint(around)
    figure = figure.seen_from(viewpoint)
    cosine = abs(float(around.ray[near] @ figure.normal))
    distance = float(np.linalg.norm(around.point[near] - viewpoint))
    pitch = distance * around.angular_pitch * math.sqrt((1 + 1 / cosine**2) / 2)
    reach = float(feature.reach_mm or math.nan)
    length = 2 * math.pi * figure.radius if isinstance(figure, Circle) else 2 * reach
    within_mm = RAYS_APART * math.sqrt(around.thinning) * distance * around.angular_pitch / cosine
    visible, places = _visible(figure, reach, around, within_mm)
    whole, fraction = crossings(length, pitch), float(around.fraction[near])
    if visible.mean() < LEAST_VISIBLE:
        found, least = 100 * visible.mean(), 100 * LEAST_VISIBLE
        raise FitError(f"{found:.0f} % of the edge is visible, at least {least:.0f} % are required")
    count = whole * float(visible.mean())
    if count < LEAST_CROSSINGS:
        raise FitError(f"{count:.0f} crossings of the edge are expected, at least {LEAST_CROSSINGS} are required")
    covariance = edge_covariance(figure, pitch, whole, fraction, reach)
    if not visible.all():  # it is proportional to the inverse of J^T J
        jacobian = figure.linearised(np.zeros(len(covariance)), places)[1]
        seen = jacobian[visible]
        covariance = covariance @ (jacobian.T @ jacobian) @ np.linalg.inv(seen.T @ seen)
        covariance = (covariance + covariance.T) / 2
    nothing = np.zeros((len(covariance), 1 + (0 if around.shared is None else around.shared.shape[1])))
    doubt = float(around.fraction_error[near])
    chance = float(ndtr((fraction - LEAST_FRACTION) / doubt)) if doubt > 0 else float(fraction >= LEAST_FRACTION)
    fit = ExpectedFit(covariance, nothing, count * fraction, chance, position, pitch)
    return ExpectedInput(fit, with_covariance(figure, covariance))


def _visible(
    figure: Circle | EdgePoint, reach: float, around: ExpectedPoints, within_mm: float
) -> tuple[NDArray[np.bool_], Floats]:
    """Return which places of an edge have a visible place of the face within a distance [mm], and the places (k, 3).

    ``reach`` [mm] is that of the point of an edge.
    """
    middle = (np.arange(PLACES_OF_EDGE) + 0.5) / PLACES_OF_EDGE
    if isinstance(figure, Circle):
        angle = 2 * np.pi * middle
        offset = figure.radius * np.column_stack([np.cos(angle), np.sin(angle)]) @ tangents(figure.normal)
        places = figure.centre + offset
    else:
        along = np.cross(figure.normal, figure.direction) + figure.slope * figure.direction
        places = figure.point + reach * (2 * middle - 1)[:, None] * along
    shown = around.point if around.shown is None else around.shown
    return np.asarray(cKDTree(shown).query(places)[0] <= within_mm), places


def _viewpoint(expected: ExpectedPoints) -> Floats:
    """Return the viewpoint (3,): the point nearest to all rays."""
    across = np.eye(3) - expected.ray[:, :, None] * expected.ray[:, None, :]
    solution = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, expected.point), rcond=None)[0]
    return np.asarray(solution)


def expected_measurement(
    task: Task, measurement: str, inputs: Mapping[InputQuantity, ExpectedInput | FitError]
) -> ExpectedMeasurement:
    """Predict one measurement from its input quantities."""
    model = measurement_model(task, measurement)
    quantities = model.inputs
    predictions: list[ExpectedInput] = []
    for quantity in quantities:
        expected = inputs[quantity]
        if isinstance(expected, FitError):
            missing = (math.nan,) * len(quantities)
            return ExpectedMeasurement(
                math.nan, 0.0, f"{', '.join(quantity.features)}: {expected}", quantities, missing
            )
        predictions.append(expected)
    scale = _scale(task, measurement)
    parts = [
        scale * evaluate(value, [expected_input.estimate], expected_input.fit.covariance)[1]
        for expected_input, value in zip(predictions, _one_by_one(model.value, predictions), strict=True)
    ]
    chances = {
        name: expected_input.fit.chance
        for quantity, expected_input in zip(quantities, predictions, strict=True)
        for name in quantity.features
    }
    total = parts[0]
    if len(predictions) > 1:
        together = _at_its_points(model.value, [expected_input.fit.middle for expected_input in predictions])
        shared = np.concatenate([expected_input.fit.shared for expected_input in predictions])
        covariance = (
            block_diag(*[expected_input.fit.noise_covariance for expected_input in predictions]) + shared @ shared.T
        )
        total = scale * evaluate(together, [expected_input.estimate for expected_input in predictions], covariance)[1]
    if not math.isfinite(total):
        return ExpectedMeasurement(math.nan, 0.0, "the measurement has no value here", quantities, tuple(parts))
    return ExpectedMeasurement(total, math.prod(chances.values()), "", quantities, tuple(parts))


def joint_quadratic_form(task: Task, measurement: str, inputs: Mapping[InputQuantity, ExpectedInput]) -> Floats:
    """Return G (P, P) over the parameters of all input quantities in their order, with u^2 = tr(G C).

    C is any covariance of the parameters. G is in the measurement's unit squared. Its diagonal blocks weight each input
    alone, the others the errors that inputs share. G follows, by polarisation, from the second moments of the
    measurement over steps of a thousandth of the parameters' standard deviations. It is exact for a linear measurement,
    or for the length of a vector that is nominally 0.

    The square of the largest or the range of several deviations is no quadratic form; polarisation gives it negative
    squares. G is then their sum over all deviations, scaled so that tr(G C) is right for independent parameters.
    """
    model = measurement_model(task, measurement)
    predictions = [inputs[quantity] for quantity in model.inputs]
    middles = [expected_input.fit.middle for expected_input in predictions]
    value = _at_its_points(model.value, middles)
    estimates = [expected_input.estimate for expected_input in predictions]
    best = value(*estimates)
    steps = STEP * np.concatenate([np.sqrt(np.diag(expected_input.fit.covariance)) for expected_input in predictions])

    def moment(step: Floats) -> float:
        changes = [value(*_moved(estimates, sign * step)) - best for sign in (1.0, -1.0)]
        return float(np.mean(np.square(changes)))

    deviations = None if model.deviations is None else _at_its_points(model.deviations, middles)
    if deviations is not None and len(deviations(*estimates)) > 1:
        form = _of_zone(deviations, estimates, steps, moment)
    else:
        form = _polarised(steps, moment)
    return np.asarray(_scale(task, measurement) ** 2 * form / np.outer(steps, steps))


def _moved(estimates: Sequence[Any], step: Floats) -> list[Any]:
    """Return estimates with their parameters, in one row (P,), changed by a step."""
    parts = np.split(step, np.cumsum([estimate.parameter_count for estimate in estimates])[:-1])
    return [estimate.moved(part) if part.any() else estimate for estimate, part in zip(estimates, parts, strict=True)]


def _polarised(steps: Floats, moment: Callable[[Floats], float]) -> Floats:
    """Return the form (P, P) over ``steps`` (P,) whose squares are those of ``moment``."""
    moments = [moment(steps * unit) for unit in np.eye(len(steps))]
    form = np.diag(moments)
    for i in range(len(steps)):
        for j in range(i):
            both = np.zeros(len(steps))
            both[[i, j]] = steps[[i, j]]
            form[i, j] = form[j, i] = (moment(both) - moments[i] - moments[j]) / 2
    return form


def _of_zone(
    deviations: Callable[..., Any], estimates: Sequence[Any], steps: Floats, moment: Callable[[Floats], float]
) -> Floats:
    """Return the form (P, P) of a zone over ``steps`` (P,): the sum of the squares of all of its deviations, scaled.

    The scale makes its trace the mean of ``moment`` over random steps.
    """

    def at(step: Floats) -> Floats:
        return np.asarray(deviations(*_moved(estimates, step)), float).ravel()

    rows = np.array([(at(step) - at(-step)) / 2 for step in np.diag(steps)])
    drawn = np.random.default_rng(0).standard_normal((DRAWS, len(steps))) * steps
    form = rows @ rows.T
    return np.asarray(form * (np.mean([moment(step) for step in drawn]) / np.trace(form)))


def _scale(task: Task, measurement: str) -> float:
    """Return the factor from rad or mm to the measurement's unit."""
    return math.degrees(1.0) if task.measurements[measurement].unit == "deg" else 1.0


def _one_by_one(value: Callable[..., float], predictions: Sequence[ExpectedInput]) -> list[Callable[[Any], float]]:
    """Return the measurement as a function of each of its inputs alone, with the others fixed."""
    middles = [expected_input.fit.middle for expected_input in predictions]
    fixed = [_at_foot(p.estimate, middle) for p, middle in zip(predictions, middles, strict=True)]

    def alone(index: int) -> Callable[[Any], float]:
        return lambda moved: value(*fixed[:index], _at_foot(moved, middles[index]), *fixed[index + 1 :])

    return [alone(index) for index in range(len(predictions))]


def _at_its_points(value: Callable[..., Any], middles: Sequence[Floats]) -> Callable[..., Any]:
    """Return the measurement on planes and axes described at the foot of their measured points, as fits are."""
    return lambda *estimates: value(*map(_at_foot, estimates, middles))


def _at_foot(estimate: Any, middle: Floats) -> Any:
    return estimate.at_foot_of(middle) if isinstance(estimate, (Plane, Cylinder, Cone)) else estimate
