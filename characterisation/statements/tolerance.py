"""State the tolerance of a measurement as limits, with the distribution of the parts that JCGM 106 requires."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from scipy.stats import gamma, norm

from characterisation.tasks.decision_table import Decision
from characterisation.tasks.task_file import Task


@dataclass(frozen=True)
class Tolerance:
    """Tolerance of a measurement, in its unit.

    Values from ``lower`` (-inf for a zone, and where it would be 0 or less) to ``upper`` conform. ``size`` is half the
    interval between the limits, the width of the zone, or where values fold the distance of the limit from there.
    ``rule`` is the decision rule for readings.
    """

    lower: float
    upper: float
    size: float
    rule: Decision = field(default_factory=Decision)

    @property
    def middle(self) -> float:
        """Return the middle between the limits, the nominal value if both deviations are equal; 0 for a zone."""
        return 0.0 if math.isinf(self.lower) else (self.lower + self.upper) / 2

    @property
    def process(self) -> Any:
        """Return the distribution of the parts' values (a frozen distribution of scipy), required by JCGM 106."""
        rule = self.rule
        if math.isinf(self.lower):
            assert rule.process_mean is not None and rule.process_std is not None  # checked when the task file is read
            shape = (rule.process_mean / rule.process_std) ** 2
            return gamma(shape, scale=rule.process_mean / shape)
        mean, spread = self.middle if rule.process_mean is None else rule.process_mean, rule.process_std
        if spread is None:
            assert rule.process_capability is not None
            spread = self.size / (3 * rule.process_capability)
        return norm(mean, spread)


def plus_minus(nominal: float, size: float, rule: Decision | None = None) -> Tolerance:
    """Return the tolerance ``nominal`` plus or minus ``size``."""
    return Tolerance(nominal - size, nominal + size, size, rule or Decision())


def tolerance_of(task: Task, measurement: str) -> Tolerance | None:
    """Return the tolerance of a measurement of a task; None if the task gives none."""
    asked = task.measurements[measurement]
    size = asked.tolerance_size
    if size is None:
        return None
    rule = task.decision_of(measurement)
    lower, upper = asked.limits
    return Tolerance(-math.inf if asked.one_sided else lower, upper, size, rule)
