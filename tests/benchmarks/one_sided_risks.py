"""Stated and real risks at the limit of a zone, by the errors of parts there and by those of a perfect part.

    python tests/benchmarks/one_sided_risks.py [TRIALS [KIND]]

Errors are normal with a standard deviation of 1 in every direction that the deviations of a kind have; the tolerance is
20. Real risks are those of 200,000 fresh parts at the limit, or of the gamma process of JCGM 106.
"""

import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from characterisation.statements.coverage import coverage_interval
from characterisation.statements.decision import decide
from characterisation.statements.one_sided import OneSidedErrors
from characterisation.statements.tolerance import Tolerance
from characterisation.tasks.decision_table import Decision
from characterisation.tasks.folded import FoldedValue, folded_values
from tests.characterisation.tasks.test_folded_values import CASES, task

LIMIT, FRESH = 20.0, 200_000

RULES = {
    "ISO 14253-1": Decision(),
    "ISO 14253-1, bias subtracted": Decision(subtract_bias=True),
    "simple acceptance": Decision(rule="simple_acceptance", uncertainty_ratio=1.0),
    "JCGM 106, consumer's risk": Decision(
        rule="jcgm_106", consumer_risk=0.002, producer_risk=0.2, process_mean=12.0, process_std=4.0
    ),
}


def drawn(folded: FoldedValue, count: int, rng: np.random.Generator) -> OneSidedErrors:
    """Return normal errors, and parts, in the directions that the deviations of a measurement have."""
    errors, parts = rng.standard_normal((2, count, len(folded.basis)))
    vectors, directions = (np.tensordot(one, folded.basis, axes=1) for one in (errors, parts))
    return OneSidedErrors(vectors, directions, folded.size, LIMIT)


def real_risk(limit: float, bias: float, fresh: OneSidedErrors, tolerance: Tolerance) -> float:
    """Return the share of parts at the limit that are accepted; for JCGM 106, of all parts that wrongly are."""
    if tolerance.rule.rule != "jcgm_106":
        return float((LIMIT + fresh.stated - bias <= limit).mean())
    # parts of the process above the limit alone, with their weight
    share = 1 - tolerance.process.cdf(LIMIT)
    parts = tolerance.process.isf(share * (np.arange(len(fresh)) + 0.5) / len(fresh))
    return float(share * (parts + fresh.at(parts) - bias <= limit).mean())


def compared(folded: FoldedValue, trials: int, rng: np.random.Generator) -> list[list[str]]:
    """Return the rows of a measurement: rule, stated and real risk, coverage of the interval; now and before."""
    errors, fresh = drawn(folded, trials, rng), drawn(folded, FRESH, rng)
    rows = []
    for name, rule in RULES.items():
        tolerance, row = Tolerance(-math.inf, LIMIT, LIMIT, rule), [name]
        for used in (errors, folded.size(errors.vectors)):
            plain = used.stated if isinstance(used, OneSidedErrors) else used
            decided = decide(used, tolerance)
            bias = float(plain.mean()) if rule.subtract_bias else 0.0
            stated = decided.false_accept if decided.consumer_risk is None else decided.consumer_risk
            limit = -math.inf if decided.accepted is None else decided.accepted[1]
            low, high = coverage_interval(plain)
            inside = ((fresh.stated >= low) & (fresh.stated <= high)).mean()
            row += [f"{stated:.4f}", f"{real_risk(limit, bias, fresh, tolerance):.4f}", f"{100 * inside:.1f} %"]
        rows.append(row)
    return rows


def main(trials: int, only: str) -> None:
    """Print one table of all kinds, or of those whose name contains a text."""
    rng, seen = np.random.default_rng(1), set()
    cases = CASES | {"flat": ("flatness", ["top"], "mm", 12), "round": ("cylindricity", ["pin"], "mm", 10)}
    print("| measurement | rule | stated | real | 95 % interval covers | stated before | real | covers |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, folded in folded_values(task(cases, 0)).items():
        kind = f"{cases[name][0]}, {len(folded.basis)} dimensions"
        if kind in seen or only not in kind:
            continue
        seen.add(kind)
        for row in compared(folded, trials, rng):
            print(f"| {kind} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000, sys.argv[2] if len(sys.argv) > 2 else "")
