"""Bound the uncertainty of a measurement after a change of its study, from its budget.

Signal chain: statement with the budget of a measurement -> variance that is left if a change removes or scales some of
its groups -> least standard uncertainty after the change -> whether the tolerance can be reached at all. A change whose
bound misses the tolerance needs no virtual measurement.

The bound is generous: a group that a change removes counts with the high end of its 95 % interval, a group that stays
with the low end, and a change that acts on the bias may remove all of it. Without a budget, nothing is excluded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from characterisation.statements.budget import INTERACTION, NOISE
from characterisation.statements.statement import Statement
from characterisation.tasks.decision_table import BIAS_SUBTRACTED

#: beginning of the names of rules that limit the larger end of the 95 % interval of the error
_BY_INTERVAL = ("ISO 14253-1", "simple acceptance")


@dataclass(frozen=True)
class Effect:
    """Largest effect of a change on an error.

    ``left`` is the share of the standard deviation that is left, by group of the budget; other groups keep theirs.
    ``unbiased``: whether the change may remove the bias.
    """

    left: Mapping[str, float] = field(default_factory=dict)
    unbiased: bool = False


#: groups whose effect depends on the light that the part returns
_OF_LIGHT = ("finish", "light", "unit", "decoder", "beyond_map", INTERACTION, NOISE)

#: a change of the light on the imagers, by the exposure or by the surface
EXPOSURE = Effect(dict.fromkeys(_OF_LIGHT, 0.0), unbiased=True)


def least_uncertainty(stated: Statement, effect: Effect) -> float:
    """Return the least standard uncertainty of a measurement after a change, in its unit; 0 without a budget."""
    if not stated.budget:
        return 0.0
    left = {line.group: effect.left.get(line.group, 1.0) ** 2 for line in stated.budget}
    removed = sum(line.high * (1 - left[line.group]) for line in stated.budget)
    remains = sum(line.low * left[line.group] for line in stated.budget)
    return math.sqrt(max(stated.standard_uncertainty**2 - removed, remains, 0.0))


def can_fit(stated: Statement, uncertainty: float, unbiased: bool) -> bool:
    """Return whether a measurement with another standard uncertainty can fit its tolerance.

    ``stated`` is its statement, with a decision; ``uncertainty`` that after the change, in its unit. The distribution
    of the error keeps its form. The bias stays, unless the change makes the measurement ``unbiased``.
    """
    decided = stated.decided
    if decided is None:
        return False
    if not math.isfinite(stated.standard_uncertainty) or not math.isfinite(decided.needed):
        return unbiased  # no values: only a change of light, surface, view or sensor can give some
    if uncertainty > decided.needed:
        return False
    without_bias = unbiased or decided.rule.endswith(BIAS_SUBTRACTED)
    if without_bias or not decided.rule.startswith(_BY_INTERVAL) or not stated.standard_uncertainty > 0:
        return True
    ratio = uncertainty / stated.standard_uncertainty
    ends = [stated.bias + ratio * end for end in stated.interval_corrected]
    largest = max(abs(end) for end in stated.interval)
    return max(abs(end) for end in ends) * decided.demand <= largest


def least_shares(stated: Statement, group: str, shares: tuple[float, ...]) -> float | None:
    """Return the largest of ``shares`` of the error of a group with which a measurement can fit; None if none does.

    The group counts with its estimate rather than its high end, since a share is asked for that suffices.
    """
    variance = next((line.variance for line in stated.budget if line.group == group), 0.0)
    for share in sorted(shares, reverse=True):
        left = math.sqrt(max(stated.standard_uncertainty**2 - variance * (1 - share**2), 0.0))
        if can_fit(stated, left, unbiased=False):
            return share
    return None
