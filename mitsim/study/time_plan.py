"""Share the time of a run between its steps before the start, and correct the shares by what the steps take.

Signal chain: time of the whole command, number of views -> seconds of screening, race, statement and report -> limits
of the steps, each from the time that is left when it starts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from mitsim.running.time_limit import TimeLimit

#: expected time of screening for each view [s]; chosen
SCREENING_S = 0.2

#: largest share of the whole that is planned for it; chosen
_SCREENING_SHARE = 0.3

#: share of the time that is left after which screening ends with the views that it has scored
_LONGEST_SCREENING = 0.4

#: share of the whole for pictures and report; chosen
_REPORT_SHARE = 0.15

#: bounds of this time [s]; chosen
_REPORT_S = (5.0, 40.0)

#: processor time of clouds and page without pictures [s]
_PAGE_S = 6.0

#: largest factor by which a busy machine prolongs it; chosen
_BUSIEST = 6.0

#: largest share of what is left that is kept for it; chosen
_PAGE_SHARE = 0.4

#: largest share of the time after the race that is kept for pictures and report, on a machine slower than planned
_LARGEST_REPORT_SHARE = 0.4

#: share of the rest for the race; the statement gets what the race leaves
_RACE_SHARE = 0.45

#: share of the time that is left after the first statement for virtual measurements of a set of views; chosen
_SET_SHARE = 0.4

#: share of the time after the race for changes that would make measurements fit; the rest is that of the statement
_REMEDIES_SHARE = 0.6


@dataclass(frozen=True)
class TimePlan:
    """Planned seconds of a run's steps; ``page_s`` as measured, ``busy`` wall time of a second of processor time."""

    screening: float
    race: float
    statement: float
    report: float
    remedies: float = 0.0
    sets: float = 0.0
    page_s: float = 0.0
    busy: float = 1.0

    @property
    def total(self) -> float:
        """Return the planned time of all steps [s]."""
        return self.screening + self.race + self.statement + self.remedies + self.sets + self.report

    def in_words(self) -> str:
        """Return the plan in one line, like ``about 2 min: 20 s screening, ...``."""
        steps = [
            (self.screening, "screening"),
            (self.race, "comparing views"),
            (self.statement, "statement"),
            *([(self.remedies, "changes that would fit")] if self.remedies else []),
            *([(self.sets, "set of views")] if self.sets else []),
            (self.report, "pictures and report"),
        ]
        return f"about {_in_words(self.total)}: " + ", ".join(f"{_in_words(seconds)} {name}" for seconds, name in steps)

    def screening_limit(self, limit: TimeLimit) -> TimeLimit:
        """Return the limit of the screening, which starts now: on a slow machine it takes longer than planned."""
        return limit.part(_LONGEST_SCREENING)

    def race_limit(self, limit: TimeLimit) -> TimeLimit:
        """Return the limit of the race, which starts now."""
        return limit.part(_RACE_SHARE, self.page(limit))

    def statement_limit(self, limit: TimeLimit) -> TimeLimit:
        """Return the limit of the statement, which starts now."""
        return limit.part(self._share(self.statement), self._pictures(limit))

    def rest_limit(self, limit: TimeLimit) -> TimeLimit:
        """Return the limit of statement and changes, which start now: all time but that of set, pictures and report."""
        return limit.part(self._share(self.statement + self.remedies), self._pictures(limit))

    def last_limit(self, limit: TimeLimit) -> TimeLimit:
        """Return the limit of what starts now and may take all time but that of clouds and page."""
        return limit.part(1.0, self.page(limit))

    def _share(self, seconds: float) -> float:
        """Return the planned share of some steps in the time between race and pictures."""
        after = self.statement + self.remedies + self.sets
        return seconds / after if after > 0 else 1.0

    def _pictures(self, limit: TimeLimit) -> float:
        """Return the time [s] that is kept for pictures and report."""
        return max(self.page(limit), min(self.report, _LARGEST_REPORT_SHARE * limit.left))

    def page(self, limit: TimeLimit) -> float:
        """Return the time [s] of clouds and page, which start at the latest with the end of what starts now."""
        return min(self._page(), _PAGE_SHARE * limit.left)

    def closing(self, limit: TimeLimit) -> bool:
        """Return whether clouds and page have to start now, so that virtual measurements in work are given up."""
        if limit.end is None:
            return limit.over()
        return limit.left <= min(self._page(), _PAGE_SHARE * (limit.end - limit.began))

    def _page(self) -> float:
        """Return the time [s] of clouds and page: as they took before, or as the machine is busy."""
        return max(self.busy * _PAGE_S, self.page_s)


def busyness(elapsed_s: float) -> float:
    """Return the wall time [s] of a second of processor time so far, of the work of this process."""
    return min(max(elapsed_s / max(time.process_time(), 0.1), 0.5), _BUSIEST)


def time_plan(seconds: float, views: int, remedies: bool = False, sets: bool = False) -> TimePlan:
    """Return the plan of a command.

    ``seconds``: of the whole command. ``views``: number of candidate views. ``remedies``, ``sets``: whether it looks
    for changes that would make measurements fit, and measures a set of views virtually.
    """
    report = min(max(_REPORT_SHARE * seconds, _REPORT_S[0]), _REPORT_S[1], seconds / 2)
    screening = min(SCREENING_S * views, _SCREENING_SHARE * seconds)
    rest = max(0.0, seconds - report - screening)
    race, after = _RACE_SHARE * rest, (1 - _RACE_SHARE) * rest
    second = (_REMEDIES_SHARE if remedies else _SET_SHARE if sets else 0.0) * after
    joined = (_SET_SHARE * second if remedies else second) if sets else 0.0
    return TimePlan(screening, race, after - second, report, second - joined, joined)


def _in_words(seconds: float) -> str:
    minutes = seconds / 60
    return f"{seconds:.0f} s" if seconds < 100 else f"{round(minutes, 1 if minutes < 10 else 0):g} min"
