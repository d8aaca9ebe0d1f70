"""Return the measured value of a part with any deviation, for measurements whose values fold at 0 or 90 deg.

Signal chain: task -> possible deviations of the features of a measurement, by small changes of the nominal features ->
random directions among them -> value of a part that deviates in this direction and is measured with a known error.

The directions have the same density in the space of all deviations at the places of the outline: the offset of a point
has every direction in space, and an axis every offset at both of its ends. A rigid plane has no others than those of a
rigid plane.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.features.pose_fit import Pose
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.deviations import Size, deviations, fold_of, form_basis
from characterisation.tasks.measurement_model import measurement_model
from characterisation.tasks.task_file import Task

Array = NDArray[np.float64]

#: first seed of the stream of directions in which parts are moved, beyond every day of a trial
_MOVE = 1 << 40

#: first seed of the stream of directions that give :meth:`FoldedValue.far_share`
_SHARE = 1 << 41

#: number of draws of a share
_DRAWS = 1000

#: size of a deviation far from nominal, over the largest error
_FAR = 1e4

#: step of the parameters of features [mm or rad] whose changes span the possible deviations
STEP = 1e-4

#: least change by a step, over the largest
LEAST_CHANGE = 1e-6

#: least singular value of a possible deviation, over the largest
LEAST_VALUE = 1e-4


@dataclass(frozen=True)
class FoldedValue:
    """The values of one measurement that folds, as sizes of deviations (k, m) in its unit.

    Parameters
    ----------
    name
        Of the measurement.
    fold
        0 or 90: the value is the size, or 90 deg minus the size.
    size
        Size (...) of deviations (..., k, m).
    basis
        Orthonormal deviations (D, k, m) that the features can have.
    nominal
        Deviations (k, m) of a nominal part, to which errors are added.
    limit
        Size of the deviation at the limit of the tolerance; None without a tolerance.
    """

    name: str
    fold: float
    size: Size
    basis: Array
    nominal: Array
    limit: float | None

    @property
    def shape(self) -> tuple[int, int]:
        """Return the shape (k, m) of deviations."""
        return self.basis.shape[1], self.basis.shape[2]

    def direction(self, *seed: int) -> Array:
        """Return a random deviation (k, m) of any length; the same for the same seed."""
        stream = np.random.SeedSequence([zlib.crc32(self.name.encode()), *seed])
        normal = np.random.default_rng(stream).standard_normal(len(self.basis))
        return np.asarray(np.tensordot(normal, self.basis, axes=1))

    def value(self, rows: Array) -> Array:
        """Return the values (...) of deviations (..., k, m), with those of a nominal part included."""
        size = self.size(rows)
        return size if self.fold == 0 else self.fold - size

    def moved(self, rows: Array, size: float, seed: int) -> Array:
        """Return deviations (k, m) with another of the given size added, in a random direction of its own."""
        direction = np.where(np.isnan(rows), np.nan, self.direction(_MOVE, seed))
        return np.asarray(rows + abs(size) / float(self.size(direction)) * direction)

    def error(self, rows: Array) -> float:
        """Return the error of the value of a nominal part that is measured with the deviations (k, m)."""
        return float(self.value(self.nominal + rows) - self.value(self.nominal))

    def far_share(self) -> float:
        """Return the root mean square error far from nominal over that of a nominal part, for errors of equal size.

        An error of equal size in every direction makes the value of a nominal part larger by all of it, and that of a
        part far from nominal larger or smaller by its component. For a point in space the share is 1 / sqrt(3).
        """
        drawn = np.array([self.direction(_SHARE, draw) for draw in range(2 * _DRAWS)])
        vectors, parts = drawn[:_DRAWS], drawn[_DRAWS:]
        far = _FAR * float(self.size(vectors).max()) / self.size(parts)[:, None, None] * parts
        change = self.size(far + vectors) - self.size(far)
        return float(np.sqrt((change**2).mean() / (self.size(vectors) ** 2).mean()))


def folded_values(task: Task) -> dict[str, FoldedValue]:
    """Return the measurements of a task whose values fold, by name."""
    folded = {name: folded_value(task, name) for name in task.measurements}
    return {name: value for name, value in folded.items() if value is not None}


def folded_value(task: Task, measurement: str) -> FoldedValue | None:
    """Return the values of a measurement as sizes of deviations; None if they do not fold."""
    asked = task.measurements[measurement]
    fold = fold_of(asked)
    if fold is None:
        return None
    definition, scale = DEFINITIONS[asked.kind], math.degrees(1.0) if asked.unit == "deg" else 1.0
    limit = None if asked.tolerance is None else asked.limits[1] if fold == 0 else fold - asked.limits[0]
    if definition.of == "form":
        basis = form_basis(task.features[asked.features[0]].kind)
        zone = deviations(asked, np.empty((0, 3)), [None], np.zeros(3))
        return FoldedValue(measurement, fold, zone.size, basis, np.zeros(basis.shape[1:]), limit)
    model = measurement_model(task, measurement)
    assert model.deviations is not None
    points = [np.array(task.features[name].point_mm or (0.0, 0.0, 0.0)) for name in asked.features]
    point = np.mean(points, axis=0) if asked.point_mm is None else np.array(asked.point_mm)
    if definition.of == "pose":
        inputs: list[Any] = [Pose(np.eye(4), point)]
        nominal: list[Any] = [Pose(np.eye(4), point)]
    else:
        inputs = [task.nominal(name) for name in task.fitted_for(measurement)]
        nominal = [task.nominal(name) for name in asked.features]
    outline = np.array(task.features[asked.features[0]].outline_mm or (), float).reshape(-1, 3)
    zone = deviations(asked, outline, nominal, point)
    changes = []
    for i, quantity in enumerate(inputs):
        for step in STEP * np.eye(quantity.parameter_count):
            ends = [
                model.deviations(*inputs[:i], quantity.moved(sign * step), *inputs[i + 1 :]) for sign in (1.0, -1.0)
            ]
            changes.append((ends[0] - ends[1]).ravel() / (2 * STEP))
    lengths = np.linalg.norm(changes, axis=1)
    columns = np.array(changes)[lengths > LEAST_CHANGE * lengths.max()]
    _, values, basis = np.linalg.svd(columns / np.linalg.norm(columns, axis=1, keepdims=True), full_matrices=False)
    basis = basis[values > LEAST_VALUE * values[0]].reshape(-1, *ends[0].shape)
    return FoldedValue(measurement, fold, zone.size, basis, scale * np.asarray(zone.of(nominal, nominal), float), limit)
