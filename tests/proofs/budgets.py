"""Compare budgets from the trials of a statement with known variances, and with pairs of trials.

Signal chain: a sensor of known variances by group -> trials of statements -> budgets from these trials
(:mod:`characterisation.statements.budget`), and from pairs that differ by one group (Jansen's estimator of the total
effect, Saltelli et al. 2010) -> averages, scatter and coverage, in Markdown.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from characterisation.statements.budget import INTERACTION, NOISE, budget
from tests.proofs.tables import markdown

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: how many numbers each group draws; those of the finish act through their squares, too
NUMBERS = {"calibration": 39, "finish": 6, "light": 3, "temperature": 2, "pose": 12}

#: groups of these studies, with a line each
LINES = (*NUMBERS, "unit", INTERACTION, NOISE)

#: variances of the groups, in the order of :data:`LINES`, by name of the study
STUDIES = {
    "many causes": (0.30, 0.20, 0.05, 0.10, 0.10, 0.10, 0.05, 0.10),
    "calibration": (0.85, 0.03, 0.0, 0.05, 0.03, 0.01, 0.0, 0.03),
    "noise": (0.05, 0.05, 0.0, 0.0, 0.05, 0.05, 0.0, 0.80),
    "unit": (0.10, 0.10, 0.0, 0.0, 0.05, 0.60, 0.05, 0.10),
}

#: share of trials with a large error where the noise is heavy-tailed, and the share of its variance that they carry
_RARE, _CARRIED = 0.02, 0.9

#: pairs of trials for each line of the former budget
PAIRS = 16


def design(count: int) -> tuple[Ints, Ints]:
    """Return the day and the unit (n,) of trials: every fifth repeats a day, every fourth day keeps a unit."""
    row, place = np.divmod(np.arange(count), 5)
    day = 4 * row + np.where(place == 4, 0, place)
    return day, np.where(day % 4 == 1, day - 1, day)


class KnownStudy:
    """Errors that depend on drawn numbers in a known way; the dependence differs from one ``rng`` to the next."""

    def __init__(self, variances: Mapping[str, float], rng: np.random.Generator, rare: bool = False) -> None:
        self.variances, self.rng, self.rare = dict(variances), rng, rare
        self.weights = {}
        for name, width in NUMBERS.items():
            weights = np.zeros(width)
            weights[rng.choice(width, min(3, width), replace=False)] = rng.standard_normal(min(3, width))
            self.weights[name] = weights / np.linalg.norm(weights)

    def draws(self, count: int) -> dict[str, Floats]:
        """Return what each group draws in independent trials (count,)."""
        out = {name: self.rng.standard_normal((count, width)) for name, width in NUMBERS.items()}
        out["unit"], out[NOISE] = self.rng.standard_normal((2, count))
        if self.rare:
            large = self.rng.random(count) < _RARE
            size = np.where(large, np.sqrt(_CARRIED / _RARE), np.sqrt((1 - _CARRIED) / (1 - _RARE)))
            out[NOISE] = size * out[NOISE]
        return out

    def errors(self, draws: Mapping[str, Floats]) -> Floats:
        """Return the errors (n,) of draws."""
        parts = {name: draws[name] @ self.weights[name] for name in NUMBERS}
        parts["finish"] = 0.8 * parts["finish"] + 0.6 * (draws["finish"][:, 0] ** 2 - 1) / np.sqrt(2)
        parts[INTERACTION] = draws["calibration"][:, 0] * draws["finish"][:, 1]
        parts |= {"unit": draws["unit"], NOISE: draws[NOISE]}
        return np.asarray(sum(np.sqrt(self.variances.get(name, 0.0)) * part for name, part in parts.items()))

    def statement(self, count: int) -> tuple[Floats, dict[str, Floats], dict[str, Ints]]:
        """Return errors, numbers and seeds of the trials of a statement."""
        day, unit = design(count)
        draws = self.draws(count)
        for name in (*NUMBERS, "unit"):
            if name != "pose":
                draws[name] = draws[name][unit if name == "unit" else day]
        numbers = {name: draws[name] for name in NUMBERS}
        for name in ("finish", "light", "temperature"):
            numbers[name] = np.hstack([numbers[name], (numbers[name] ** 2 - 1) / np.sqrt(2)])
        return self.errors(draws), numbers, {"unit": unit, INTERACTION: day}

    def pairs(self, count: int, pairs: int = PAIRS) -> dict[str, float]:
        """Return shares by group from pairs that differ by one group, beside a statement of independent trials."""
        draws, other = self.draws(count), self.draws(pairs)
        errors = self.errors(draws)
        first = {name: one[:pairs] for name, one in draws.items()}
        change = {name: errors[:pairs] - self.errors(first | {name: other[name]}) for name in first}
        return {name: float((one**2).mean()) / 2 / float(errors.var(ddof=1)) for name, one in change.items()}


def budgets_table(rounds: int = 40, trials: int = 200) -> str:
    """Return the shares found by both methods in statements of studies of known variances, in Markdown."""
    body = []
    for rare in (False, True):
        for name, variances in STUDIES.items():
            truth = dict(zip(LINES, variances, strict=True))
            found: dict[str, list[tuple[float, float, bool]]] = {line: [] for line in LINES}
            sums = []
            for number in range(rounds):
                study = KnownStudy(truth, np.random.default_rng([number, rare]), rare)
                paired = study.pairs(trials)
                sums.append(sum(paired.values()))
                for line in budget(*study.statement(trials)):
                    low, high = line.share_interval
                    inside = low - 1e-3 <= truth[line.group] <= high + 1e-3
                    found[line.group].append((line.share, paired.get(line.group, np.nan), inside))
            for line, rows in found.items():
                share, pair, inside = np.array(rows).T
                words = [f"{100 * one.mean():.0f} ± {100 * one.std():.0f} %" for one in (pair, share)]
                body.append(
                    [
                        name + (", rare large errors" if rare else ""),
                        line,
                        f"{100 * truth[line]:.0f} %",
                        "-" if line == INTERACTION else words[0],
                        words[1],
                        f"{100 * inside.mean():.0f} %",
                    ]
                )
            low, high = 100 * min(sums), 100 * max(sums)
            body.append([body[-1][0], "sum", "100 %", f"{low:.0f} to {high:.0f} %", "100 %", ""])
    head = ["study", "line", "truth", f"from {PAIRS} pairs", f"from {trials} trials", "truth inside the interval"]
    return markdown(head, body)
