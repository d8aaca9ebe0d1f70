"""The decision rule of a task: how a measured value is judged against its tolerance, as the task file says.

Three rules. ISO 14253-1 takes a guard band as wide as the expanded uncertainty off the tolerance. JCGM 106:2012 moves
the acceptance limits until the consumer's risk is the stated one; it needs to know how the values of the parts are
distributed, the process. Simple acceptance (JCGM 106, 8.2) accepts every reading within the tolerance, and asks for a
test uncertainty ratio. What each does with the errors of trials: :mod:`characterisation.statements.decision`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from characterisation.documents import Document

RuleName = Literal["iso_14253_1", "jcgm_106", "simple_acceptance"]

#: keys that belong to one rule alone
_OWN = {
    "iso_14253_1": ("guard_share",),
    "jcgm_106": ("consumer_risk", "producer_risk", "process_mean", "process_std", "process_capability"),
    "simple_acceptance": ("uncertainty_ratio",),
}

Risk = Annotated[float, Field(gt=0, lt=0.5)]
Positive = Annotated[float, Field(gt=0)]


class Decision(Document):
    """How a measurement is judged against its tolerance.

    ``subtract_bias``: the user subtracts the stated bias from each reading; left out, readings are taken as they come.

    ISO 14253-1: a measurement fits if the guard band takes at most ``guard_share`` of the tolerance (left out, 0.25,
    the 4 : 1 of ANSI/NCSL Z540.3; 1 asks only that some reading be acceptable).

    JCGM 106: acceptance limits are such that a part is accepted and does not conform with at most the probability
    ``consumer_risk``; the measurement fits if then a part conforms and is rejected with at most ``producer_risk``. Both
    are global risks (JCGM 106, 9.5), over the parts that the process makes. Their values are normally distributed with
    ``process_mean`` (left out, the middle between the limits) and ``process_std``, in the measurement's unit, or with
    the standard deviation that ``process_capability`` C_p = half the interval between the limits / (3 standard
    deviations) gives. Those of a zone, which has no negative values, follow a gamma distribution of that mean and
    standard deviation, as in the example of JCGM 106, 9.5.4; both have to be given.

    Simple acceptance: the measurement fits if the tolerance is at least ``uncertainty_ratio`` times the expanded
    uncertainty (left out, 4).
    """

    rule: RuleName = "iso_14253_1"
    subtract_bias: bool = False
    guard_share: Annotated[float, Field(gt=0, le=1)] | None = None
    consumer_risk: Risk | None = None
    producer_risk: Risk | None = None
    process_mean: float | None = None
    process_std: Positive | None = None
    process_capability: Positive | None = None
    uncertainty_ratio: Annotated[float, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _of_the_rule(self) -> Decision:
        for rule, keys in _OWN.items():
            given = [key for key in keys if rule != self.rule and getattr(self, key) is not None]
            if given:
                raise ValueError(f"{given[0]} belongs to the rule {rule}, and the rule here is {self.rule}")
        if self.rule == "jcgm_106":
            lacking = [key for key in ("consumer_risk", "producer_risk") if getattr(self, key) is None]
            if lacking:
                raise ValueError(f"the rule jcgm_106 needs {' and '.join(lacking)}, probabilities below 0.5")
            if self.process_std is not None and self.process_capability is not None:
                raise ValueError("either process_std or process_capability, and not both")
        return self
