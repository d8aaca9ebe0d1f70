"""Define the decision rule of a task: how a measured value is compared with its tolerance, as given in the task file.

There are three rules:

- ISO 14253-1 reduces the tolerance by a guard band as wide as the expanded uncertainty.
- JCGM 106:2012 sets the acceptance limits so that the consumer's risk has the stated value. It requires the
  distribution of the values of the parts, the process.
- Simple acceptance (JCGM 106, 8.2) accepts every reading within the tolerance, and requires a test uncertainty ratio.

:mod:`characterisation.statements.decision` applies each rule to the errors of trials.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from characterisation.files.documents import Document

RuleName = Literal["iso_14253_1", "jcgm_106", "simple_acceptance"]

#: keys that only one rule has
_OWN = {
    "iso_14253_1": ("guard_share",),
    "jcgm_106": ("consumer_risk", "producer_risk", "process_mean", "process_std", "process_capability"),
    "simple_acceptance": ("uncertainty_ratio",),
}

#: default for the largest share of the tolerance for the guard band: the 4 : 1 of ANSI/NCSL Z540.3
GUARD_SHARE = 0.25

#: default for the least test uncertainty ratio: the same 4 : 1
UNCERTAINTY_RATIO = 4.0

Risk = Annotated[float, Field(gt=0, lt=0.5)]
Positive = Annotated[float, Field(gt=0)]

#: description of each rule in a decision, with the limits that it sets
WORDS = {
    "iso_14253_1": "ISO 14253-1, guard band of the expanded uncertainty (95 %), at most {share:.3g} % of the tolerance",
    "jcgm_106": "JCGM 106, guard band, consumer's risk up to {consumer:.3g} %, producer's risk up to {producer:.3g} %",
    "simple_acceptance": "simple acceptance, JCGM 106, 8.2, tolerance at least {ratio:g} times expanded uncertainty",
}

#: end of the description of a rule for readings from which the bias is subtracted
BIAS_SUBTRACTED = ", readings minus the bias"


class Decision(Document):
    """How a measurement is compared with its tolerance.

    ``subtract_bias``: the user subtracts the stated bias from each reading. By default, readings are not corrected.

    ISO 14253-1: a measurement is suitable if the guard band takes at most ``guard_share`` of the tolerance. The default
    is 0.25, the 4 : 1 of ANSI/NCSL Z540.3; 1 requires only that some reading be acceptable.

    JCGM 106: the acceptance limits are such that the probability of accepting a part that does not conform is at most
    ``consumer_risk``. The measurement is suitable if the probability of rejecting a conforming part is then at most
    ``producer_risk``. Both are global risks (JCGM 106, 9.5), over the parts that the process makes. Their values are
    normally distributed in the measurement's unit. The mean is ``process_mean``, by default the middle between the
    limits. The standard deviation is ``process_std``, or follows from ``process_capability`` C_p = half the interval
    between the limits / (3 standard deviations). Values of a zone are never negative; they follow a gamma distribution
    with this mean and standard deviation, as in the example of JCGM 106, 9.5.4. For a zone, both must be given.

    Simple acceptance: the measurement is suitable if the tolerance is at least ``uncertainty_ratio`` times the expanded
    uncertainty (default 4).
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
            stray_keys = [key for key in keys if rule != self.rule and getattr(self, key) is not None]
            if stray_keys:
                raise ValueError(f"{stray_keys[0]} is a key of the rule {rule}; the rule here is {self.rule}")
        if self.rule == "jcgm_106":
            lacking = [key for key in ("consumer_risk", "producer_risk") if getattr(self, key) is None]
            if lacking:
                raise ValueError(f"the rule jcgm_106 needs {' and '.join(lacking)}, probabilities below 0.5")
            if self.process_std is not None and self.process_capability is not None:
                raise ValueError("give either process_std or process_capability, not both")
        return self

    @property
    def in_words(self) -> str:
        """Return a description of the rule, which says at its end if the bias is subtracted from the readings."""
        words = WORDS[self.rule].format(
            share=100 * self.largest_share,
            ratio=self.least_ratio,
            consumer=100 * (self.consumer_risk or 0.0),
            producer=100 * (self.producer_risk or 0.0),
        )
        return words + (BIAS_SUBTRACTED if self.subtract_bias else "")

    @property
    def largest_share(self) -> float:
        """Return the largest share of the tolerance that the guard band of ISO 14253-1 takes."""
        return self.guard_share or GUARD_SHARE

    @property
    def least_ratio(self) -> float:
        """Return the least ratio of the tolerance to the expanded uncertainty by simple acceptance."""
        return self.uncertainty_ratio or UNCERTAINTY_RATIO
