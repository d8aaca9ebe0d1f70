"""Share the time after the race between the statement and the changes with which its measurements would fit.

Signal chain: statement of the best view from its share of the time -> while a verdict is open, the statement within
half of the time until a measurement is missed, changes of the same sensor within half of the rest, then the statement
until every verdict is decided -> the changes that are left, other sensors the last -> the statement until it is
settled, with the time that is left.

Verdicts come before other sensors, because those need the most time: each is prepared, screened and compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from characterisation.files.atomic_io import write_json
from mitsim.running.time_limit import TimeLimit
from mitsim.study import Study
from mitsim.study.early_answers import StepTimes
from mitsim.study.remedies.change import Shortfall, missed_by
from mitsim.study.remedies.changes import changes
from mitsim.study.remedies.confirm import Remedies, all_changes, find_remedies, of_missed
from mitsim.study.session import Session
from mitsim.study.statement_document import statement_document
from mitsim.study.virtual.stated import StatedView

#: share of the time that is left which changes may take while a verdict is open, and before it the statement if it
#: misses nothing yet; chosen
_SHARE_WHILE_OPEN = 0.5

#: goes on with a statement within a limit, until a function of the statement so far returns that it is enough
Stating = Callable[[TimeLimit, Callable[[StatedView], bool]], StatedView]

#: tries changes, with or without other sensors, for what a statement misses, and adds them to those tried before
Mending = Callable[[StatedView, Remedies | None, TimeLimit, bool], Remedies | None]


def seeks_remedies(study: Study) -> bool:
    """Return whether a run looks for changes that make measurements fit: the study allows it, and has tolerances."""
    tolerances = (measurement.tolerance for measurement in study.task.measurements.values())
    return study.file.remedies.minutes > 0 and any(tolerance is not None for tolerance in tolerances)


def state_and_mend(
    session: Session, now: Shortfall, limit: TimeLimit, clock: StepTimes
) -> tuple[StatedView, Remedies | None]:
    """Try changes for what a statement misses, and go on with the statement in turn with them, within a limit.

    ``session``, ``now``, ``clock``: the study, being measured; the statement of its best view so far; times of the
    steps of the run. ``limit``: time of all of it; without a limit the statement is finished, and changes have a time
    of their own.
    """
    made = _trials(now.stated)
    trial_s = clock.steps.get("state", 0.0) / made if made else 0.0

    def state(within: TimeLimit, enough: Callable[[StatedView], bool]) -> StatedView:
        nonlocal made, trial_s
        before = clock.steps.get("state", 0.0)
        longer = session.state(now.stated.view, None, within, enough)
        write_json(session.folder / "statement.json", statement_document(session, longer))
        clock.lap("state")
        if _trials(longer) > made:  # the first trials had to prepare the view, too
            trial_s = min(trial_s, (clock.steps["state"] - before) / (_trials(longer) - made))
            made = _trials(longer)
        return longer

    def mend(stated: StatedView, before: Remedies | None, within: TimeLimit, sensors: bool) -> Remedies | None:
        shortfall = replace(now, stated=stated)
        if not shortfall.missed or not seeks_remedies(session.study):
            return before
        short = limit.end is not None
        proposed = all_changes(shortfall, within, short) if sensors else changes(shortfall, short)
        tried = find_remedies(shortfall.missed, proposed, table.trials, within, before, trial_s)
        clock.lap("remedies")
        return tried

    table = session.study.file.remedies
    if limit.end is None:
        return now.stated, mend(now.stated, None, TimeLimit(60 * table.minutes), True)
    stated, remedies = in_turn(now.stated, state, mend, limit)
    return stated, remedies if seeks_remedies(session.study) else None


def in_turn(stated: StatedView, state: Stating, mend: Mending, limit: TimeLimit) -> tuple[StatedView, Remedies | None]:
    """Go on with the statement of a view and try changes, in turn, until time is over.

    Parameters
    ----------
    stated, limit
        The statement so far, and time of all of it.
    state, mend
        Make more virtual measurements of the view, and of changes.
    """
    remedies, all_tried = None, False
    if not _decided(stated):
        if not missed_by(stated):
            share = limit.part(_SHARE_WHILE_OPEN)
            stated = state(share, lambda now: _decided(now) or bool(missed_by(now)))
        remedies = mend(stated, None, limit.part(_SHARE_WHILE_OPEN), False)
        if not _decided(stated):
            stated = state(limit, _decided)
    if missed_by(stated) and not limit.over():
        remedies, all_tried = mend(stated, remedies, limit, True), True
    if not limit.over():
        stated = state(limit, lambda _: False)
    return stated, of_missed(remedies, missed_by(stated), all_tried)


def _trials(stated: StatedView) -> int:
    return max((statement.trials for statement in stated.statements), default=0)


def _decided(stated: StatedView) -> bool:
    return all(statement.verdict != "not decided" for statement in stated.statements)
