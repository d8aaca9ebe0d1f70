"""Choose the fewest views for the measurements of a task, including the error of joining them.

Signal chain: expected fits of every view -> one row of all parameters that the measurements depend on, their changes by
a motion of a view and by the errors common to all views (:mod:`characterisation.scores.joining`), and the quadratic
form of each measurement -> joint information of every view -> the fewest views
(:mod:`characterisation.scores.view_sets`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.scores.joining import (
    JoinedView,
    invariant,
    joined_covariance,
    joint_information,
    rigid_derivatives,
)
from characterisation.scores.view_sets import FeatureInformation, ViewSet, fewest_views, squares
from characterisation.tasks.measurement_model import InputQuantity, measurement_model
from characterisation.tasks.prediction import ExpectedInput, joint_quadratic_form
from characterisation.tasks.task_file import Task


@dataclass(frozen=True)
class SetJoining:
    """Uncertainty of the poses of joined views.

    ``pose_covariance`` (6, 6) is that of each view's pose, of a motion [w (rad), t (mm)] about the point ``about``
    (3,). With ``best_fit`` it is only the prior, before the views are fitted to one another.
    """

    pose_covariance: Floats
    about: Floats
    best_fit: bool = False


def choose_set(
    task: Task,
    inputs: Sequence[dict[InputQuantity, Any]],
    limits: dict[str, float],
    least_chance: float = 0.95,
    seconds: float = 60.0,
    joining: SetJoining | None = None,
) -> ViewSet:
    """Return the fewest views that together bring the standard uncertainties of measurements below their limits.

    Raises InputError if a measurement does not exist, or depends on a form (whose modes differ from view to view) or on
    a quantity that no view sees. Also if it depends on a pose, and views are not joined exactly.

    Parameters
    ----------
    task, inputs, limits
        Features and measurements; for every view, the expected input quantities of the measurements; limits by
        measurement, in its unit. The other measurements are ignored.
    least_chance, seconds
        A view sees a feature if there are enough points with at least this probability. Time limit of the proof [s];
        after it, the greedy set is returned, marked as not exact.
    joining
        Uncertainty of the poses of the views; exact by default.
    """
    joining = joining or SetJoining(np.zeros((6, 6)), np.zeros(3))
    for name in limits:
        if name not in task.measurements:
            raise InputError("limits", name, "no such measurement", ", ".join(task.measurements))
    best = _best_known(inputs)
    needed_inputs = {name: measurement_model(task, name).inputs for name in limits}
    for name, quantities in needed_inputs.items():
        for quantity in quantities:
            found = allowed = hint = ""
            if quantity.kind == "form":
                found, allowed, hint = "a form", "a measurement of features or of the pose", "choose one view for it"
            elif quantity.kind == "pose" and joining.pose_covariance.any():
                found, allowed = "a pose, from joined views", "a measurement of features"
                hint = 'choose one view for it, or set.joining = "exact"'
            elif quantity not in best:
                found = f"{', '.join(quantity.features)}, which no view sees well enough"
                allowed = "a feature that a view sees"
            if found:
                raise InputError("limits", name, found, allowed, hint)
    whole = _JoinedSet(task, needed_inputs, best, joining)
    views = [whole.view(view_inputs, least_chance) for view_inputs in inputs]
    information = np.array([joint_information(view, whole.rigid, joining.pose_covariance) for view in views])
    features = [FeatureInformation(information, whole.quadratic)]

    def joined(chosen: Floats) -> Floats:
        chosen_views = [view for view, taken in zip(views, chosen, strict=True) if taken]
        covariance = joined_covariance(chosen_views, whole.rigid, joining.pose_covariance, joining.best_fit)
        return np.asarray(np.sqrt(squares(whole.quadratic, covariance)))

    return fewest_views(features, np.array(list(limits.values())), seconds, joined)


class _JoinedSet:
    """All parameters that the chosen measurements depend on, in one row: their motion, and the quadratic forms."""

    def __init__(
        self,
        task: Task,
        needed_inputs: dict[str, tuple[InputQuantity, ...]],
        best: dict[InputQuantity, ExpectedInput],
        joining: SetJoining,
    ) -> None:
        self.quantities = list(dict.fromkeys(quantity for needed in needed_inputs.values() for quantity in needed))
        variances = [np.diag(best[quantity].fit.covariance) for quantity in self.quantities]
        rows = np.split(np.arange(sum(map(len, variances))), np.cumsum([len(part) for part in variances])[:-1])
        self.rigid = [
            np.zeros((len(part), 6)) if of.kind == "pose" else rigid_derivatives(best[of].estimate, joining.about)
            for of, part in zip(self.quantities, variances, strict=True)
        ]
        self.quadratic = np.zeros((len(needed_inputs), *[sum(map(len, variances))] * 2))
        for m, (name, quantities) in enumerate(needed_inputs.items()):
            numbers = [self.quantities.index(quantity) for quantity in quantities]
            at, motion, variance = (np.concatenate([of[k] for k in numbers]) for of in (rows, self.rigid, variances))
            form = invariant(joint_quadratic_form(task, name, best), motion, variance)
            self.quadratic[m][np.ix_(at, at)] = form

    def view(self, inputs: dict[InputQuantity, Any], least_chance: float) -> JoinedView:
        """Return the expected fits of these quantities in one view."""
        fits = [
            expected.fit
            if isinstance(expected := inputs[quantity], ExpectedInput) and expected.fit.chance >= least_chance
            else None
            for quantity in self.quantities
        ]
        causes = max((fit.shared.shape[1] for fit in fits if fit is not None), default=1)
        nothing = [np.zeros((len(motion), causes)) for motion in self.rigid]
        shared = tuple(none if fit is None else fit.shared for fit, none in zip(fits, nothing, strict=True))
        return JoinedView(tuple(None if fit is None else fit.noise_covariance for fit in fits), shared)


def _best_known(inputs: Sequence[dict[InputQuantity, Any]]) -> dict[InputQuantity, ExpectedInput]:
    """Return the expected fit of each quantity in the view with most points, where quadratic forms are evaluated."""
    best: dict[InputQuantity, ExpectedInput] = {}
    for view_inputs in inputs:
        for quantity, expected in view_inputs.items():
            if isinstance(expected, ExpectedInput):
                best[quantity] = max(best.get(quantity, expected), expected, key=lambda one: one.fit.count)
    return best
