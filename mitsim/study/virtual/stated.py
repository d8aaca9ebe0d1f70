"""State the uncertainty of every measurement from one view, with its budget.

Signal chain: trials with draws that were not used to choose the view, some of them repeated captures of a day -> their
errors, and what each group of unknowns drew -> :class:`characterisation.statements.statement.Statement` of every
measurement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from characterisation.statements.budget import budget, largest_line
from characterisation.statements.losses import losses, lost_features
from characterisation.statements.one_sided import stated_errors
from characterisation.statements.size_dependence import DrawnNumber, size_dependence
from characterisation.statements.statement import Statement, statement
from characterisation.statements.tolerance import tolerance_of
from characterisation.statements.verdict_words import Judged
from characterisation.tasks.decision_table import BIAS_SUBTRACTED
from characterisation.words.numbers import (
    MINUS,
    NONE,
    SPACE,
    accepted_text,
    aligned,
    beside,
    interval_text,
    percent,
    two_digits,
)
from mitsim.running.time_limit import TimeLimit
from mitsim.sensor.exposure import PlannedExposure
from mitsim.sensor.sensor import Sensor
from mitsim.study import StatementTable, Study, finishes_of_features
from mitsim.study.dependence_words import dependences_in_words
from mitsim.study.virtual.drawn_decoder import decoder_is_drawn
from mitsim.study.virtual.drawn_numbers import drawn_numbers, named_numbers, related, seeds, statement_trials
from mitsim.study.virtual.race import Job, TrialRunner, complete
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import BEYOND, GROUPS, SET_DAYS, STATEMENT_DAYS, Trial, Unknowns
from mitsim.views import View

#: trials after which a statement asks whether it is settled, or time is over
BATCH = 40

#: fewest trials of a statement with which views are compared
LEAST_COMPARED = 20

#: largest number of trials of a statement without a time limit, if the study names none; chosen
MOST = 1000

#: the same within a time limit; chosen
MOST_WITHIN_A_LIMIT = 4000

#: kurtosis less 1 of normal errors: the least that is assumed of errors in the number of trials that determine their
#: standard deviation
_NORMAL_TAIL = 2.0

#: the same for bare metal. A sample without the rare large errors of metal looks normal: of five seeds of view 99 of
#: the two pillars with a Zivid, the one that ended first, after 320 trials, had the least u of six measurements of
#: seven, by up to 60 %. Of all 3,240 trials it is 5.8 to 28, median 9.3: python -m tests.proofs seeds
_METAL_TAIL = 28.0


@dataclass(frozen=True)
class TrialsOfView:
    """What makes the trials of a view's statement and keeps them; ``planned`` None: the sensor's own exposures."""

    runner: TrialRunner
    folder: TrialFolder
    planned: PlannedExposure | None


@dataclass(frozen=True)
class StatedView:
    """Statements of every measurement from a view at its ``planned`` exposures, None for the sensor's own rule."""

    view: View
    statements: list[Statement]
    planned: PlannedExposure | None


@dataclass(frozen=True)
class _Drawn:
    """What trials drew: numbers (n, p) by group, seeds (n,) by group, and the numbers that have names."""

    numbers: Mapping[str, ArrayLike]
    seeds: Mapping[str, ArrayLike]
    named: Sequence[DrawnNumber]


def state_view(
    study: Study,
    unknowns: Unknowns,
    source: TrialsOfView,
    view: View,
    table: StatementTable | None = None,
    limit: TimeLimit | None = None,
    after_batch: Callable[[StatedView], bool | None] | None = None,
) -> StatedView:
    """State every measurement from one view at its exposures, and reuse finished trials.

    Draws of the race are not used: they selected the view, and are biased in its favour. Trials end when they have the
    number of the study, or when time is over. They end before if every verdict is decided, and every measurement is
    settled (JCGM 101:2008, 7.9) or, where the study names no number, every standard uncertainty is known well enough.
    The latter does not count before the default number: few trials of errors with long tails show too little of them.

    - ``study``, ``unknowns``, ``source``, ``view``: the study, what is unknown of it, the maker of the trials, and the
      view.
    - ``table``: replaces the study's number of trials, which are then made whether or not fewer would settle the
      statement.
    - ``limit``: time of the statement. A study that names no number of trials may make :data:`MOST_WITHIN_A_LIMIT`
      within it, and does not end at a known uncertainty; without a limit, :data:`MOST`.
    - ``after_batch``: receives the statement, without a budget, after every :data:`BATCH` trials but the last; ends it
      by True.
    """
    runner, trials, planned = source.runner, source.folder, source.planned
    limit = TimeLimit() if limit is None else limit
    label = f"state view {view.number}"
    made, rules = list[Trial](), table or study.file.statement
    by_known = table is None and limit.end is None and "trials" not in rules.model_fields_set
    least = max(rules.trials, least_trials(study, rules.known_to))
    counts = batches(rules, table is None, limit)
    for count in counts:
        wanted = statement_trials(count)
        complete(trials, runner, [Job(view, trial) for trial in wanted], label, limit.over)
        if limit.over():  # all that an earlier statement made
            wanted = statement_trials(counts[-1])
        made = [trial for trial in wanted if trial in trials.known(view.number)]
        so_far = StatedView(view, _statements(study, trials, view, made), planned)
        if limit.over():
            break
        decided = all(entry.verdict != "not decided" for entry in so_far.statements)
        if table is None and count > BATCH and decided and _settled(so_far.statements):
            break
        if by_known and count >= least and decided and _known_to(so_far.statements, rules.known_to):
            break
        if after_batch is not None and after_batch(so_far):
            break
    groups = budget_groups(unknowns, runner.source, study.sensor)
    numbers = drawn_numbers(study, unknowns, runner.source, made, groups)
    named = named_numbers(study, unknowns, made, groups) if runner.source == "render" else []
    return StatedView(
        view, _statements(study, trials, view, made, _Drawn(numbers, seeds(made, groups), named)), planned
    )


def compared(study: Study, trials: TrialFolder, view: int, other: int) -> float | None:
    """Return the ratio of root mean square errors of two views: the geometric mean over the measurements, as the race.

    With tolerances for all measurements, it is the ratio of the largest errors relative to the tolerance. It is None if
    a view lacks trials of a statement, or a value.

    Parameters
    ----------
    study, trials
        The study, and its finished trials.
    view, other
        Numbers of the two views.
    """
    figures, task = [], study.task
    for number in (view, other):
        made = [trial for trial in trials.known(number) if STATEMENT_DAYS <= trial.day < SET_DAYS]
        if len(made) < LEAST_COMPARED:
            return None
        stated = _statements(study, trials, study.view(number), made)
        figures.append(np.array([entry.root_mean_square for entry in stated]))
    sizes = np.array([measurement.tolerance_size or math.nan for measurement in task.measurements.values()])
    first, second = (errors / sizes if np.isfinite(sizes).all() else errors for errors in figures)
    if not (np.isfinite(first) & np.isfinite(second) & (first > 0) & (second > 0)).all():
        return None
    if np.isfinite(sizes).all():
        return float(first.max() / second.max())
    return float(np.exp(np.log(first / second).mean()))


def batches(table: StatementTable, by_settled: bool, limit: TimeLimit) -> list[int]:
    """Return the numbers of trials at which a statement may end: with ``by_settled`` several, else that of the table.

    A limit replaces the largest number of a table that names none.
    """
    most = table.trials
    if by_settled and "trials" not in table.model_fields_set:
        most = MOST if limit.end is None else MOST_WITHIN_A_LIMIT
    return [*range(BATCH, most, BATCH), most] if by_settled else [most]


def _statements(
    study: Study,
    trials: TrialFolder,
    view: View,
    made: list[Trial],
    drawn: _Drawn | None = None,
) -> list[Statement]:
    """Return the statement of every measurement from finished trials; with what they drew, its budget."""
    days, common, errors = [trial.day for trial in made], related(made), trials.errors_of_parts(view.number, made)
    out = []
    for m, (name, asked) in enumerate(study.task.measurements.items()):
        lines = budget(errors[m], drawn.numbers, drawn.seeds) if drawn is not None else ()
        stated = statement(name, asked.unit, errors[m], tolerance_of(study.task, name), lines, days, common)
        named = [] if drawn is None else drawn.named
        depends = size_dependence(stated_errors(errors[m]), stated.interval, named, days)
        out.append(replace(stated, losses=losses(trials.reasons(view.number, made, name)), size_depends_on=depends))
    return out


def _settled(stated: Sequence[Statement]) -> bool:
    """Return whether all statements are settled but those without values."""
    return all(entry.settled or not math.isfinite(entry.standard_uncertainty) for entry in stated)


def least_trials(study: Study, share: float) -> int:
    """Return the n that gives a standard deviation to a share, by its relative variance (k - 1) / 4 n, kurtosis k."""
    scatters = [finish.scatter for finish in finishes_of_features(study).values() if finish is not None]
    bare = any(scatter is not None and not scatter.depolarising for scatter in scatters)
    return math.ceil((_METAL_TAIL if bare else _NORMAL_TAIL) / (4 * share**2))


def _known_to(stated: Sequence[Statement], share: float) -> bool:
    """Return whether the standard error of every standard uncertainty is at most this share of it."""
    return all(
        entry.moved[1] <= share * entry.standard_uncertainty
        for entry in stated
        if math.isfinite(entry.standard_uncertainty)
    )


def budget_groups(unknowns: Unknowns, source: str, sensor: Sensor) -> list[str]:
    """Return the groups of unknowns with a line in the budget: those that are drawn and can have an effect."""
    table = unknowns.table
    idle = {"light", "unit", "decoder"} if source == "map" else {BEYOND}
    if not decoder_is_drawn(sensor, table.decoder):
        idle.add("decoder")
    if not table.calibration.scale > 0:
        idle.add("calibration")
    if not any(size > 0 for size in table.form.features.values()):
        idle.add("form")
    if source != "map" and not table.finish.varies:
        idle.add("finish")
    return [group for group in GROUPS if group in unknowns.varied and group not in idle]


def statement_table(stated: Sequence[Statement]) -> str:
    """Return the statements as a text table."""
    about_error = ("bias", "u", "95 % interval of the error", "after correction", "no value", "most of it from")
    rows = [("measurement", "unit", *about_error, "accepted readings", "verdict")]
    for entry in stated:
        rows.append(
            (
                entry.measurement,
                entry.unit,
                plain(beside(entry.bias, entry.standard_uncertainty)),
                digits(entry.standard_uncertainty),
                _interval(entry.interval),
                _interval(entry.interval_corrected),
                plain(percent(entry.without_value)),
                _largest(entry),
                _accepted(entry),
                entry.verdict,
            )
        )
    lost = lost_features((entry.measurement, entry.trials, entry.losses) for entry in stated)
    lines = [f"no value in {feature.in_words()}" for feature in lost]
    lines += dependences_in_words(
        (entry.measurement, entry.unit, entry.size_depends_on, None if entry.decided is None else entry.decided.needed)
        for entry in stated
    )
    return "\n".join([*aligned(rows), *lines])


def judged(stated: Sequence[Statement]) -> list[Judged]:
    """Return the verdicts, for their description in words."""
    return [
        Judged(
            entry.measurement,
            entry.unit,
            entry.verdict,
            entry.standard_uncertainty,
            math.nan if entry.decided is None else entry.decided.needed,
            entry.decided is not None and entry.decided.fits_corrected,
            entry.without_value,
            bias=entry.bias,
        )
        for entry in stated
    ]


def _accepted(stated: Statement) -> str:
    if stated.decided is None or (stated.verdict == "not decided" and math.isnan(stated.decided.demand)):
        return "-"  # no tolerance, or too few values to compute them
    if stated.decided.accepted is None:
        return "none"
    text = plain(accepted_text(*stated.decided.accepted, stated.tolerance or 1.0))
    return text + ", bias subtracted" * stated.decided.rule.endswith(BIAS_SUBTRACTED)


def _largest(stated: Statement) -> str:
    """Return the largest line of the budget; none where the trials are too few to tell which."""
    if not stated.budget:
        return ""
    largest = largest_line(stated.budget)
    return "too few trials" if largest is None else f"{largest.group} ({100 * largest.share:.0f} %)"


def plain(text: str) -> str:
    """Return a number of a page for a terminal: with hyphens for a minus and for no number, and plain spaces."""
    return text.replace(MINUS, "-").replace(NONE, "-").replace(SPACE, " ")


def digits(value: float) -> str:
    """Return a number with two digits, or a dash for NaN."""
    return plain(two_digits(value))


def _interval(ends: tuple[float, float]) -> str:
    return "-" if not math.isfinite(ends[0]) else plain(interval_text(*ends))
