"""Constants of the race and the calibration of its stated probabilities, from trials that are kept.

    python tests/benchmarks/race_probabilities.py kurtosis | prior | races [--sealed] [--repeats N]

*kurtosis*: k - 1 of the errors of stated views of open parts. *prior*: error of the map's u of each view, from the true
risks of raced open cases. *races*: races of the first candidates of raced cases for all measurements. The 60 worlds of
a view in which it was measured to judge choices are the population, from which a race draws its worlds anew; so the
true risks are known. Halves of the open parts: the first three developed, the others test.
"""

from __future__ import annotations

import argparse
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from characterisation.statements.selection import joint_samples, judge
from mitsim.scene import backend
from mitsim.study.virtual.race import BATCH, FIRST
from mitsim.study.virtual.risks import combined_risk, possible_measurements, prior_risk
from tests.proofs.case_trials import trials_by_kind
from tests.proofs.judgement import true_risk
from tests.proofs.part_cases import PartCase, read_part_cases

CASES = Path(__file__).parents[2] / "scenes" / "parts" / "validation.toml"

#: largest number of trials of a view, views beside the leader that get a batch, expected loss that ends a race, margin
MOST, CHALLENGERS, LOSS, MARGIN = 16, 4, 0.05, 0.1

#: edges of the bins of stated probabilities
EDGES = np.array([0.0, 0.3, 0.5, 0.7, 0.85, 0.95, 1.0])


def main() -> None:
    """Print the table that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=["kurtosis", "prior", "races"])
    parser.add_argument("--sealed", action="store_true")
    parser.add_argument("--repeats", type=int, default=8)
    given = parser.parse_args()
    backend.activate(None)
    cases = [case for case in read_part_cases(CASES) if case.sealed == given.sealed]
    if given.table == "kurtosis":
        print_kurtosis(cases)
        return
    raced = [(case, *population(case)) for case in cases if case.table.raced]
    if given.table == "prior":
        for case, errors, u, _ in raced:
            apart = log_risk(errors) - np.log([prior_risk(row) for row in u])
            print(f"{case.name:<40}", np.round(apart.std(axis=1), 2))
        return
    print_races(raced, given.repeats)


def print_kurtosis(cases: list[PartCase]) -> None:
    """Print k - 1 of every measurement, one for each stated view."""
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            trials = trials_by_kind(case, case.open(), Path(folder))["tool"].trials
            for m, name in enumerate(trials.measurements):
                shown = []
                for view in range(case.file.candidates):
                    made = [trial for trial in trials.known(view) if not trial.capture]
                    one = trials.errors(view, made)[m] if made else np.empty(0)
                    square = one[np.isfinite(one)] ** 2
                    if len(square) >= 100:
                        shown.append((square**2).mean() / square.mean() ** 2 - 1)
                if shown:
                    print(f"{case.name:<40} {name:<28}", np.round(shown, 2))


def population(case: PartCase):
    """Errors (measurement, view, world) of the candidates of a race, their u and their chance (measurement, view)."""
    study, count = case.open(), case.file.raced_candidates
    with tempfile.TemporaryDirectory() as folder:
        kinds = trials_by_kind(case, study, Path(folder))
        worlds = {kind: sorted(kinds[kind].trials.known(0), key=lambda one: one.day) for kind in ("truth", "choice")}
        errors = [
            np.stack([kinds[kind].trials.errors(view, some[: case.file.raced_worlds]) for view in range(count)], 1)
            for kind, some in worlds.items()
        ]
        scores, _ = kinds["tool"].screen()
    u, chance = (scores[name].transpose("measurement", "view").values for name in ("predicted_uncertainty", "chance"))
    return np.concatenate(errors, axis=2), u[:, :count], np.nan_to_num(chance[:, :count])


def log_risk(errors):
    """Logarithm of the true risk; a view that never gives a value counts with e^2 times the largest of the others."""
    risk = np.log([true_risk(one) for one in errors])
    for row in risk:
        known = row[np.isfinite(row)]
        row[~np.isfinite(row)] = known.max() + 2 if len(known) else 0.0
    return risk


def print_races(raced, repeats) -> None:
    """Print the trials and the regret of every case, and the calibration of all stated probabilities."""
    states = []
    for case, errors, u, chance in raced:
        true = log_risk(errors)
        ends = []
        for repeat in range(repeats):
            history = race(errors, u, chance, true, np.random.default_rng([repeat, 5]))
            ends.append(history[-1])
            states += history
        trials, said, regret, _ = np.array(ends).T
        print(f"{case.name:<40} trials {trials.mean():4.0f} regret {np.exp(regret.mean()):.3f} said {said.mean():.2f}")
    _, said, regret, loss = np.array(states).T
    for low, high in pairwise(EDGES):
        mine = (said >= low) & (said < high)
        if mine.any():
            within, lost = regret[mine] <= np.log1p(MARGIN), np.expm1(np.minimum(regret[mine], 2))
            print(f"said {said[mine].mean():.2f}: {within.mean():.2f} of {mine.sum()} states; ", end="")
            print(f"expected loss {loss[mine].mean():.3f}: {lost.mean():.3f}")


def race(errors, u, chance, true, rng):
    """Trials, stated probability, logarithm of the regret and expected loss after every round of one race."""
    drawn = errors[:, :, rng.integers(errors.shape[2], size=MOST)]
    prior, counts, history = np.array([prior_risk(row) for row in u]), np.full(u.shape[1], FIRST), []
    tolerances = np.full(len(u), np.nan)
    while True:
        seen = np.where(np.arange(counts.max()) < counts[:, None], drawn[:, :, : counts.max()], np.inf)
        possible = possible_measurements(u, seen)
        one = judge(combined_risk(joint_samples(seen, prior, chance)[possible], tolerances[possible]), MARGIN)
        together = true[possible].mean(axis=0)
        history.append((counts.sum(), one.confidence, together[one.leader] - together.min(), one.loss))
        rivals = [v for v in np.argsort(-one.gain, kind="stable") if one.gain[v] > 0.001][:CHALLENGERS]
        growing = [v for v in [one.leader, *rivals] if counts[v] < MOST]
        if one.loss <= LOSS or not growing:
            return history
        counts[growing] = np.minimum(counts[growing] + BATCH, MOST)


if __name__ == "__main__":
    main()
