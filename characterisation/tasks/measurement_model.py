"""Express a measurement of a task as a function of fits, and propagate their covariances to its value.

Signal chain: task, measurement -> the fits that it is a function of, its input quantities in the sense of JCGM
100:2008, 4.1.2 -> its value and what they deviate from nominal -> standard uncertainty from the fits' covariances.

Features with a common parent are correlated: two circles in one face move with it. A measurement is therefore always a
function of the *fitted* features. Derived features have no covariances of their own. In every step of the propagation,
intersections and middle planes are computed again, and figures are carried along with their plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from characterisation.features.pose_fit import Pose
from characterisation.tasks.definitions import DEFINITIONS, Definition
from characterisation.tasks.deviations import deviations, fold_of
from characterisation.tasks.places import intersection, mid_plane
from characterisation.tasks.task_file import Feature, Measurement, Task

Array = NDArray[np.float64]

#: no place
NOWHERE = np.empty((0, 3))

#: origin of a frame [mm]
ORIGIN = np.zeros(3)

#: second differences of a value over its first ones, above which it is not linear; chosen
BENT = 0.1

#: relative difference of u^2 by two roots below which all roots give the same; chosen
SAME = 1e-3

#: number of directions over which the square of a value that is not linear is averaged; chosen: u is known to 3 %
DIRECTIONS = 64


class Estimate(Protocol):
    """Any fit: it has a covariance (p, p), and can be changed by p parameters."""

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters."""

    def moved(self, parameters: Array) -> Any:
        """Change the estimate by the parameters (p,)."""


@dataclass(frozen=True)
class InputQuantity:
    """Input quantity of a measurement: the fit or the form of one feature, or the pose from several."""

    kind: Literal["feature", "form", "pose"]
    features: tuple[str, ...]


@dataclass(frozen=True)
class MeasurementModel:
    """A measurement as a function of its input quantities.

    ``value`` takes a fit for each of ``inputs``, in their order, and returns mm or rad. The fit is a
    :data:`~characterisation.features.fitted.Fit` for a feature, a :class:`~characterisation.features.form.Form`, or a
    :class:`~characterisation.features.pose_fit.Pose`. ``deviations`` takes the same, and returns what they deviate from
    nominal (k, m) [mm or rad], in the part frame: None for values that do not fold
    (:mod:`characterisation.tasks.deviations`).
    """

    inputs: tuple[InputQuantity, ...]
    value: Callable[..., float]
    deviations: Callable[..., Array] | None = None


def measurement_model(task: Task, measurement: str, sensor_from_part: ArrayLike | None = None) -> MeasurementModel:
    """Return a measurement of a task as a function of its fits.

    ``sensor_from_part`` (4, 4) takes the nominal geometry to the frame of the fits; by default, they are in the part
    frame.
    """
    asked = task.measurements[measurement]
    definition = DEFINITIONS[asked.kind]
    motion = np.eye(4) if sensor_from_part is None else np.asarray(sensor_from_part, float)
    points = [np.array(task.features[name].point_mm or (0.0, 0.0, 0.0)) for name in asked.features]
    point = np.mean(points, axis=0) if asked.point_mm is None else np.array(asked.point_mm)
    if definition.of == "form":
        form_of = _deviations(asked, motion, [None])
        return MeasurementModel((InputQuantity("form", asked.features),), definition.value, form_of)
    if definition.of == "pose":
        value = partial(definition.value, sensor_from_part=motion, point=point)
        pose_of = _deviations(asked, motion, [Pose(motion, motion[:3, :3] @ point + motion[:3, 3])], point=point)
        return MeasurementModel((InputQuantity("pose", asked.features),), value, pose_of)
    outline = _outline(task, asked, motion)
    nominal = [task.nominal(name, motion) for name in asked.features]
    extra = _further_arguments(definition, nominal, outline)
    fitted = task.fitted_for(measurement)

    if list(fitted) == list(asked.features) and all(task.features[name].shaped for name in fitted):
        features_of: Callable[[Sequence[Any]], Sequence[Any]] = lambda fits: fits  # noqa: E731
    else:
        features_of = partial(_all_resolved, task, asked.features, fitted)

    def value_of_fits(*fits: Any) -> float:
        return definition.value(*features_of(fits), **extra)

    of_features = _deviations(asked, motion, nominal, outline)
    return MeasurementModel(
        tuple(InputQuantity("feature", (name,)) for name in fitted),
        value_of_fits,
        None if of_features is None else lambda *fits: of_features(*features_of(fits)),
    )


def nominal_value(task: Task, measurement: str) -> float:
    """Return the value [mm or deg] of a measurement on the nominal geometry of its features: 0 for a form or a pose."""
    asked = task.measurements[measurement]
    definition = DEFINITIONS[asked.kind]
    if definition.of != "features":
        return 0.0
    nominal = [task.nominal(name) for name in asked.features]
    value = definition.value(*nominal, **_further_arguments(definition, nominal, _outline(task, asked, np.eye(4))))
    return float(np.rad2deg(value)) if asked.unit == "deg" else value


def _outline(task: Task, asked: Measurement, motion: Array) -> Array:
    """Return the outline (k, 3) [mm] of the first feature of a measurement, moved; empty without an outline."""
    outline = np.array(task.features[asked.features[0]].outline_mm or (), float).reshape(-1, 3)
    return outline @ motion[:3, :3].T + motion[:3, 3]


def _further_arguments(definition: Definition, nominal: Sequence[Any], outline: Array) -> dict[str, Any]:
    """Return the arguments of a measurement beside its features: their nominal places, the outline of the first."""
    extra: dict[str, Any] = {}
    if "nominal" in definition.needs:
        extra["nominal"] = nominal
    if "outline" in definition.needs:
        extra["outline"] = outline
    return extra


def _deviations(
    asked: Measurement, motion: Array, nominal: Sequence[Any], outline: Array = NOWHERE, point: Array = ORIGIN
) -> Callable[..., Array] | None:
    """Return the deviations from nominal, in the part frame, as a function of the measured features, form or pose."""
    if fold_of(asked) is None:
        return None

    def from_nominal(*measured: Any) -> Array:
        deviations_of = deviations(asked, outline, nominal, point).of
        rows = deviations_of(measured, nominal)
        if nominal[0] is not None:
            rows = rows - deviations_of(nominal, nominal)
        return rows @ motion[:3, :3] if rows.shape[1] == 3 else rows

    return from_nominal


def _all_resolved(task: Task, names: Sequence[str], fitted: Sequence[str], fits: Sequence[Any]) -> list[Any]:
    by_name = dict(zip(fitted, fits, strict=True))
    return [_resolved(task.features[name], name, by_name) for name in names]


def _resolved(feature: Feature, name: str, fits: Mapping[str, Any]) -> Any:
    """Return a feature from the fits: itself, carried along with its plane, or derived from its parents."""
    if feature.kind == "intersection":
        return intersection([fits[parent] for parent in feature.of or ()])
    if feature.kind == "mid_plane":
        return mid_plane(*[fits[parent] for parent in feature.of or ()])
    if feature.shaped:
        return fits[name]
    (plane,) = feature.of or ("",)
    return fits[name].on_moved_plane(fits[plane])


def evaluate(
    value: Callable[..., float], fits: Sequence[Estimate], covariance: ArrayLike | None = None
) -> tuple[float, float]:
    """Return the value of a measurement function of fits, and its standard uncertainty, both in mm or rad.

    u^2 is the second moment of f about f(x) over the points x +- L_k. The L_k are the columns of a square root of the
    joint covariance of the fits. In full, u^2 = sum_k ((f(x + L_k) - f)^2 + (f(x - L_k) - f)^2) / 2. For a linear f
    this is the law of propagation of uncertainty (JCGM 100:2008, 5.1.2 and, correlated, 5.2.2).

    An angle between nominally parallel directions is not linear: it is the length of a small vector, and a central
    difference would give 0. The second moment gives the root mean square of the vector's error where the value is 0.
    Where the value is well above its noise, it gives the error of the component along the vector, which is smaller by
    at most sqrt(2).

    Every root L gives the same u of a linear f, and of the length of a vector that is 0. The largest or the range of
    several deviations depends on L near 0. Where f is not linear, u^2 is therefore the mean over rotated roots. Of a
    largest deviation or a range that is 0, it is the mean square for normal errors.

    ``covariance`` (P, P) is that of all parameters of all fits in their order, for correlated fits. By default, the
    fits are independent.
    """
    best = value(*fits)
    blocks = [np.asarray(fit.covariance, float) for fit in fits]
    if covariance is None:
        root = block_diag(*[_square_root(block) for block in blocks])
    else:
        root = _square_root(np.asarray(covariance, float))
    ends = np.cumsum([len(block) for block in blocks])
    parts = [slice(end - len(block), end) for end, block in zip(ends, blocks, strict=True)]

    def changes(columns: Array) -> Array:
        """Return the changes (k, 2) of the value by steps (P, k) forward and back."""
        moves = [(fit, part, (columns[part] != 0).any(axis=0).tolist()) for fit, part in zip(fits, parts, strict=True)]
        moved = [
            [fit.moved(step[part]) if of_columns[k] else fit for fit, part, of_columns in moves]
            for k, column in enumerate(columns.T)
            for step in (column, -column)
        ]
        return np.array([value(*each) - best for each in moved]).reshape(-1, 2)

    change = changes(root)
    moments = [float((change**2).sum()) / 2]
    if (change.sum(axis=1) ** 2).sum() > BENT**2 * (change**2).sum():
        for turn in _turns(root.shape[1]):
            moments.append(float((changes(root @ turn) ** 2).sum()) / 2)
            if math.isclose(*moments[:2], rel_tol=SAME):  # no root differs
                break
    return best, math.sqrt(np.mean(moments))


@lru_cache
def _turns(size: int) -> tuple[Array, ...]:
    """Return random rotations (size, size), the same at every call."""
    rng = np.random.default_rng(0)
    return tuple(np.linalg.qr(rng.standard_normal((size, size)))[0] for _ in range(-(-DIRECTIONS // size)))


def _square_root(covariance: Array) -> Array:
    """Return L (p, p) with L L^T equal to the covariance."""
    variances, axes = np.linalg.eigh(covariance)
    root: Array = axes * np.sqrt(np.maximum(variances, 0.0))
    return root
