"""With how many views, and how many trials of each, a race should begin: raced again from trials that are kept.

    python tests/benchmarks/race_starts.py [--budget TRIALS] [--repeats N]

Open cases of scenes/parts whose truth is in scenes/parts/measured. Of the worlds of a case, drawn anew in every repeat,
eight serve the race and the others judge it: true risk of the view that leads at the end over the middle of the five
least risks. Geometric means over measurements and repeats, by case and over cases. Every measurement is raced alone, to
95 % confidence or until the budget is spent.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from characterisation.statements.selection import judge, posterior, sampled
from mitsim.scene import backend
from tests.proofs.judgement import true_risk
from tests.proofs.part_cases import read_part_cases
from tests.proofs.screening_run import PREDICTED, screen_case

CASES = Path(__file__).parents[2] / "scenes" / "parts" / "validation.toml"

#: views on the shortlist, trials of each at first, trials of one at a time later
STARTS = [(8, 4, 4), (16, 2, 4), (24, 2, 2), (24, 1, 2), (40, 1, 2)]

#: worlds that a race may use, and views beside the leader that get trials in a round
RACED, CHALLENGERS = 8, 4


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=6)
    given = parser.parse_args()
    backend.activate(None)
    rows = []
    print(f"{'case':<40}" + "".join(f"{start!s:>14}" for start in STARTS))
    for case in read_part_cases(CASES):
        if case.sealed or case.measured is None or not (case.measured / f"{case.name}.nc").exists():
            continue
        with tempfile.TemporaryDirectory() as folder:
            judged = screen_case(case, Path(folder))
        found = [
            regret
            for cost, errors in zip(judged.costs[PREDICTED], judged.errors, strict=True)
            for regret in regrets(np.exp(cost), errors, given.budget, given.repeats)
        ]
        if found:
            rows.append(np.mean(found, axis=0))
            print(f"{case.name:<40}" + "".join(f"{np.exp(one[0]):8.2f} {one[1]:5.0f}" for one in rows[-1]), flush=True)
    print(f"{'all':<40}" + "".join(f"{np.exp(one[0]):8.2f} {one[1]:5.0f}" for one in np.mean(rows, axis=0)))


def regrets(risk, errors, budget, repeats):
    """Logarithm of the regret, and trials, of every start and repeat (repeats, starts, 2)."""
    rng = np.random.default_rng(1)
    able = np.flatnonzero(np.isfinite(risk) & (np.isfinite(errors).mean(axis=1) >= 0.5))
    if len(able) < 8:
        return []
    risk, errors = risk[able], errors[able]
    out = []
    for _ in range(repeats):
        order = rng.permutation(errors.shape[1])
        raced, rest = errors[:, order[:RACED]], errors[:, order[RACED:]]
        true = true_risk(rest)
        least = np.median(np.sort(true)[:5])
        ends = [race(risk, raced, *start, budget) for start in STARTS]
        if all(np.isfinite(true[leader]) for leader, _ in ends):
            out.append([(np.log(true[leader] / least), trials) for leader, trials in ends])
    return out


def race(risk, errors, shortlist, first, batch, budget):
    """The view that leads in the end, and the trials that it took."""
    views = np.argsort(risk, kind="stable")[:shortlist]
    counts = np.full(len(views), first)
    while True:
        seen = np.where(np.arange(RACED) < counts[:, None], errors[views], np.inf)
        standing = judge(sampled(*posterior(seen, risk[views], np.full(len(views), 0.98))))
        rivals = [v for v in np.argsort(-standing.gain, kind="stable") if standing.gain[v] > 0.001]
        growing = [v for v in [standing.leader, *rivals[:CHALLENGERS]] if counts[v] < RACED]
        if standing.confidence >= 0.95 or counts.sum() >= budget or not growing:
            return views[standing.leader], counts.sum()
        counts[growing] = np.minimum(counts[growing] + batch, RACED)


if __name__ == "__main__":
    main()
