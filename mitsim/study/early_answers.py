"""Answer before the end of a run: write its folder and report, first after a minute and then as they improve."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import xarray as xr

from characterisation.files.atomic_io import write_json
from characterisation.maps.performance_map import PerformanceMap
from characterisation.words.progress import say
from mitsim.running.time_limit import TimeLimit
from mitsim.study.run_record import draw_clouds, write_record
from mitsim.study.scoring import write_raced
from mitsim.study.session import Session
from mitsim.study.statement_document import statement_document
from mitsim.study.time_plan import TimePlan
from mitsim.study.virtual.race import ALL, Raced
from mitsim.study.virtual.stated import StatedView

#: time after which a run writes its first report [s], and at least that between later ones
FIRST_ANSWER_S = 50.0


class StepTimes:
    """Wall time of each step [s]."""

    def __init__(self) -> None:
        self.steps: dict[str, float] = {}
        self.last = time.monotonic()

    def lap(self, step: str) -> None:
        """End a step, or a part of one."""
        now = time.monotonic()
        self.steps[step], self.last = round(self.steps.get(step, 0.0) + now - self.last, 2), now


class Answers:
    """Answers before the end of a run, first after a minute; the longest so far is ``page_s`` of ``plan``."""

    def __init__(
        self,
        session: Session,
        performance_map: PerformanceMap,
        scores: xr.Dataset,
        plan: TimePlan,
        limit: TimeLimit,
        clock: StepTimes,
        report: Callable[[], object] | None,
    ) -> None:
        self.session, self.map, self.scores = session, performance_map, scores
        self.plan, self.limit, self.clock, self.report = plan, limit, clock, report
        self.next_s = FIRST_ANSWER_S
        self.drawn: set[int] = set()

    def improve(self, raced: Raced, stated: StatedView | None = None) -> None:
        """Write the answer so far, if it is time for one, and the last one is not due when this is ready.

        Each takes at most a tenth of the time since the last.
        """
        due = self.report is not None and self.limit.elapsed >= self.next_s
        if not due or self.limit.over() or self.limit.left < 2 * self.plan.page_s:
            return
        assert self.report is not None
        began = time.monotonic()
        session, folder = self.session, self.session.folder
        write_raced(session, self.scores, raced)
        if stated is not None:
            write_json(folder / "statement.json", statement_document(session, stated))
        leader = raced.leader(ALL)
        if leader not in self.drawn:
            draw_clouds(session, self.map, [leader])
            self.drawn.add(leader)
        lacks = ["the run goes on", *([] if stated is not None else ["no statement of uncertainty yet"])]
        record: dict[str, Any] = {"seconds": self.clock.steps, "lacks": lacks, "finished": False}
        write_record(session, self.map, raced, [leader], [], stated=stated is not None, **record)
        self.report()
        first = self.next_s == FIRST_ANSWER_S
        say(f"{'first answer' if first else 'answer'} after {self.limit.elapsed:.0f} s: view {leader}, report.html")
        took = time.monotonic() - began
        self.plan = replace(self.plan, page_s=max(self.plan.page_s, took))
        self.next_s = self.limit.elapsed + max(FIRST_ANSWER_S, 10 * took)
