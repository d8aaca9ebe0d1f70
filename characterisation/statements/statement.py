"""State the error of a measurement from trials: bias, standard uncertainty, coverage interval, numerical tolerance.

Signal chain: errors of all trials -> bias and standard deviation -> 95 % coverage interval -> standard errors of these
numbers from the finite number of trials -> whether they are small enough -> verdict against a tolerance, by the task's
rule (:mod:`characterisation.statements.decision`).

An error is the measured value minus the true one. If a user measures y, the true value lies in [y - high, y - low] with
the coverage probability, where [low, high] is the interval of the error (JCGM 101:2008, 5.5). The bias is the mean
error, common to all trials. It may be subtracted as a correction for a recognised systematic effect (JCGM 100:2008,
3.2.3); its own uncertainty is that of a mean.

In the words of the guides for virtual experiments, this is "simulate and analyse": data are simulated and analysed as
real data are. If the error does not depend on the value of the part, so that a reading is the sum of both, the result
equals the propagation of distributions of JCGM 101. A value that folds at 0, such as a zone, is no such sum. Its
errors are stated for a part at the limit of its tolerance, or far from 0 without a tolerance
(:mod:`characterisation.statements.one_sided`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.statements.budget import BudgetLine
from characterisation.statements.coverage import (
    coverage_interval,
    errors_of_ends,
    expanded_interval,
    expanded_uncertainty,
    standard_errors,
)
from characterisation.statements.decision import Decided, Verdict, decide
from characterisation.statements.losses import Loss
from characterisation.statements.one_sided import OneSidedErrors
from characterisation.statements.size_dependence import SizeDependence
from characterisation.statements.tolerance import Tolerance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ErrorsOf = Literal["any part", "part at the limit of the tolerance", "part far from nominal"]

#: parts whose errors are stated
ANY_PART: ErrorsOf = "any part"
AT_THE_LIMIT: ErrorsOf = "part at the limit of the tolerance"
FAR_FROM_NOMINAL: ErrorsOf = "part far from nominal"


@dataclass(frozen=True)
class Statement:
    """The statement of one measurement from one view; in the measurement's unit (mm or deg).

    Parameters
    ----------
    measurement
        Its name.
    unit
        Unit of all values, mm or deg.
    trials
        Number of trials.
    without_value
        Share of the trials without a value.
    bias
        Mean error.
    bias_uncertainty
        Its standard uncertainty from the finite number of trials.
    standard_uncertainty
        Standard deviation of the error about the bias. It remains, together with ``bias_uncertainty``, if the user
        subtracts the bias.
    interval
        95 % coverage interval of the error, (low, high).
    interval_corrected
        The same after subtraction of the bias.
    moved
        Standard errors of bias, standard uncertainty, low and high end from the finite number of trials. Those of the
        ends are the larger of the jackknife's and the order statistics'.
    numerical_tolerance
        delta of JCGM 101, 7.9.2 for one significant digit of the standard uncertainty.
    settled
        Whether twice every one of ``moved`` is at most ``numerical_tolerance``.
    repeatability
        Standard deviation between captures of one day, from days with several; NaN without any.
    budget
        Variance by group of unknowns, largest first; empty if it was not computed.
    tolerance
        Size of the tolerance; None without one.
    share_of_tolerance
        End of the 95 % interval that is larger in absolute value, over the size of the tolerance; of the corrected
        interval if the rule subtracts the bias.
    share_interval
        95 % interval of this share.
    decided
        Decision by the rule of the tolerance; None without one.
    verdict
        ``fits``, ``does not fit``, ``undecidable``, ``not decided``, or ``no tolerance``.
    losses
        Reasons of the trials without a value, most frequent first; empty if none are known.
    errors_of
        Parts whose errors are stated: ``any part``; or where errors depend on the deviation of the part, ``part at the
        limit of the tolerance``, or without a tolerance ``part far from nominal``.
    size_depends_on
        Drawn number on which the size of the error depends most; None if there is none, or it was not looked for.
    """

    measurement: str
    unit: str
    trials: int
    without_value: float
    bias: float
    bias_uncertainty: float
    standard_uncertainty: float
    interval: tuple[float, float]
    interval_corrected: tuple[float, float]
    moved: tuple[float, float, float, float]
    numerical_tolerance: float
    settled: bool
    repeatability: float
    budget: tuple[BudgetLine, ...]
    tolerance: float | None
    share_of_tolerance: float | None
    share_interval: tuple[float, float] | None
    decided: Decided | None
    verdict: Verdict
    losses: tuple[Loss, ...] = ()
    errors_of: ErrorsOf = ANY_PART
    size_depends_on: SizeDependence | None = None

    @property
    def root_mean_square(self) -> float:
        """Return the root mean square error without correction."""
        return math.hypot(self.bias, self.standard_uncertainty)

    def plot(self, ax: Axes | None = None) -> NDArray[np.object_]:
        """Draw the error and the budget of this measurement, as :meth:`Statements.plot` does for several.

        Parameters
        ----------
        ax
            Axes to draw the error alone into; by default those of a new figure.

        Returns
        -------
        numpy.ndarray of matplotlib.axes.Axes
            (1, 2) of error and budget; (1, 1) without a budget, or with ``ax``.

        Examples
        --------
        >>> from characterisation.statements.statement import statement
        >>> stated = statement("radius", "mm", errors=[0.02, 0.05, -0.01, 0.03])
        >>> stated.plot()[0, 0].get_xlabel()
        'measured − true [mm]'
        """
        return Statements([self]).plot(ax)

    def after_repeats(self, captures: int) -> float:
        """Return the standard uncertainty of the mean of several captures of one day.

        Errors that these captures have in common do not average out.
        """
        within = min(self.repeatability**2, self.standard_uncertainty**2)
        return math.sqrt(self.standard_uncertainty**2 - within * (1 - 1 / captures))


class Statements(list[Statement]):
    """Statements of several measurements from one view: a list that can draw itself."""

    def plot(self, ax: Any = None) -> NDArray[np.object_]:
        """Draw the error of each measurement with its 95 % interval, its bias and u, and its budget beside it.

        Parameters
        ----------
        ax
            Axes to draw the errors alone into, one for each unit; by default those of a new figure.

        Returns
        -------
        numpy.ndarray of matplotlib.axes.Axes
            (units, 2): a row for each unit, errors on the left and budgets on the right. (units, 1) if no statement has
            a budget, or with ``ax``.

        Raises
        ------
        InputError
            If there is no statement, or ``ax`` is not one axes for each unit.

        Examples
        --------
        >>> from characterisation.statements.statement import Statements, statement
        >>> errors = {"radius": [0.02, 0.05, -0.01], "height": [0.1, 0.2, 0.1]}
        >>> Statements(statement(name, "mm", values) for name, values in errors.items()).plot().shape
        (1, 1)
        """
        # imported here because a statement alone does not need matplotlib
        from characterisation.plots.statements import (
            MARGIN_IN,
            ROW_IN,
            ErrorRow,
            budget_legend,
            draw_budget,
            draw_errors,
        )
        from characterisation.plots.style import axes_for

        if not self:
            raise InputError("plot", "statements", "none", "at least one")
        rows: dict[str, list[ErrorRow]] = {}
        for entry in self:
            shares = {line.group: line.share for line in entry.budget}
            unsettled = frozenset(line.group for line in entry.budget if not line.settled)
            u = entry.standard_uncertainty
            row = ErrorRow(entry.measurement, entry.bias, u, entry.interval, shares, entry.verdict, unsettled)
            rows.setdefault(entry.unit, []).append(row)
        columns = 2 if ax is None and any(entry.budget for entry in self) else 1
        heights = [ROW_IN * len(of_unit) + MARGIN_IN for of_unit in rows.values()]
        size = (10.0 if columns == 2 else 6.4, sum(heights) + 0.5 * (columns - 1))
        with axes_for(ax, (len(rows), columns), size, height_ratios=heights) as grid:
            for panels, (unit, of_unit) in zip(grid, rows.items(), strict=True):
                draw_errors(panels[0], of_unit, unit)
                if columns == 2:
                    draw_budget(panels[1], of_unit)
            if columns == 2:
                budget_legend(grid[0, 1], [row for of_unit in rows.values() for row in of_unit])
        return grid


def statement(
    measurement: str,
    unit: str,
    errors: ArrayLike | OneSidedErrors,
    tolerance: Tolerance | None = None,
    budget: tuple[BudgetLine, ...] = (),
    days: ArrayLike | None = None,
    related: ArrayLike | None = None,
) -> Statement:
    """State a measurement from the errors (n,) of trials, NaN for trials without a value.

    Parameters
    ----------
    measurement, unit
        Name of the measurement; mm or deg.
    errors
        (n,) of trials, NaN for trials without a value.
    tolerance
        None for a measurement without one.
    budget
        Variance by group of unknowns.
    days
        (n,) day of each trial. Trials of one day are repeated captures of the same part. By default every trial has a
        day of its own.
    related
        (n,) whole numbers: trials with the same number have draws in common. By default those of one day.
    """
    part: ErrorsOf = ANY_PART
    if isinstance(errors, OneSidedErrors):
        part = AT_THE_LIMIT if errors.limit is not None else FAR_FROM_NOMINAL
        every = errors.stated
    else:
        every = np.asarray(errors, float)
    finite = np.isfinite(every)
    values = every[finite]
    count = len(values)
    day = np.arange(count) if days is None else np.asarray(days)[finite]
    common = day if related is None else np.asarray(related)[finite]
    repeatability = _within(values, day)
    decided = None
    if tolerance is not None:
        used = errors.part(errors.known) if isinstance(errors, OneSidedErrors) else values
        decided = decide(used, tolerance, len(every) - count, common)
    nan = math.nan
    bias = spread = bias_uncertainty = delta = low = high = nan
    moved, share, shares = np.full(4, nan), None, None
    if count >= 2:
        bias, spread = float(values.mean()), float(values.std(ddof=1))
        bias_uncertainty, delta = _error_of_mean(values, common), numerical_tolerance(spread)
        low, high = coverage_interval(values)
        moved = standard_errors(
            values, lambda part: np.array([part.mean(), part.std(ddof=1), *coverage_interval(part)]), common
        )
        moved[2:] = np.maximum(moved[2:], errors_of_ends(values))
        if tolerance is not None:
            taken = values - bias if tolerance.rule.subtract_bias else values
            share = expanded_uncertainty(taken) / tolerance.size
            least, most = expanded_interval(taken, common)
            shares = (least / tolerance.size, most / tolerance.size)
    return Statement(
        measurement=measurement,
        unit=unit,
        trials=len(every),
        without_value=1 - count / max(len(every), 1),
        bias=bias,
        bias_uncertainty=bias_uncertainty,
        standard_uncertainty=spread,
        interval=(low, high),
        interval_corrected=(low - bias, high - bias),
        moved=(float(moved[0]), float(moved[1]), float(moved[2]), float(moved[3])),
        numerical_tolerance=delta,
        settled=bool((2 * moved <= delta).all()),
        repeatability=repeatability,
        budget=budget,
        tolerance=None if tolerance is None else tolerance.size,
        share_of_tolerance=share,
        share_interval=shares,
        decided=decided,
        verdict="no tolerance" if decided is None else decided.verdict,
        errors_of=part,
    )


def _within(errors: Floats, day: NDArray[np.int64]) -> float:
    """Return the standard deviation of errors (n,) within days (n,); NaN if no day has two."""
    _, group, several = np.unique(day, return_inverse=True, return_counts=True)
    degrees = len(errors) - len(several)
    if not degrees:
        return math.nan
    mean = np.bincount(group, errors) / several
    return math.sqrt(float(((errors - mean[group]) ** 2).sum()) / degrees)


def _error_of_mean(errors: Floats, related: NDArray[np.int64]) -> float:
    """Return the standard error of the mean of errors (n,), of which those with the same number are not independent.

    It follows from the sums of related errors (Liang and Zeger 1986), which need no model of their dependence, and is
    at least that of independent errors: the sums of two groups cancel, and tell little.
    """
    least = float(errors.std(ddof=1)) / math.sqrt(len(errors))
    sums = np.bincount(np.unique(related, return_inverse=True)[1], errors - errors.mean())
    clusters = len(sums)
    if clusters < 2:
        return least
    return max(least, math.sqrt(clusters / (clusters - 1) * float(sums @ sums)) / len(errors))


def numerical_tolerance(uncertainty: float) -> float:
    """Return the numerical tolerance delta of an uncertainty of one significant digit: half of it (JCGM 101, 7.9.2)."""
    if not uncertainty > 0:
        return 0.0
    power = math.floor(math.log10(uncertainty))
    if round(uncertainty / 10.0**power) >= 10:  # 0.0996 is 0.1
        power += 1
    return float(0.5 * 10.0**power)
