"""Distribute virtual measurements to workers: processes on this machine, or those of a Dask cluster.

Signal chain: jobs sorted by view -> runs of jobs that share light, as plain values -> a worker, which
prepares the study's sensor once (:class:`mitsim.study.virtual.rendered.RenderedMeasurements`) -> errors of every trial.

A trial depends only on study, view and trial number, so every worker gives the same result. If a worker dies, another
makes its trials. :mod:`mitsim.running.cluster` describes the requirements of a cluster, and who can run code on whose
machine. Workers read the study's scene, task and sensor at the same paths.
"""

from __future__ import annotations

import copy
import os
import statistics
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from mitsim.capture.simulated.rendering import Rendering
from mitsim.running.executor import Executor, available_memory
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import StudyFile, open_study
from mitsim.study.virtual.light_file import LightFile
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.world import Unknowns

#: largest number of jobs in one order; a worker that dies loses at most these, and some workers wait for as many
_IN_A_ROW = 4

#: time of an order that slow trials may take [s]: two orders of each worker can end after a time limit; chosen
_ORDER_S = 6.0

#: number of orders whose time tells that of the next
_REMEMBERED = 20


@dataclass(frozen=True)
class TrialOrder:
    """Jobs of one view as plain values."""

    path: str
    file: StudyFile
    unknowns: Unknowns
    separate_light: bool
    digest: str
    jobs: tuple[Job, ...]
    rendering: Rendering
    planned: PlannedExposure | None = None
    light: str | None = None  # file of the view's interreflections


class SpreadMeasurements:
    """Virtual measurements by workers, which prepare the study anew for another ``digest`` of all of a trial.

    If the workers are on this machine, this process traces the light of a view for all of them, in a ``folder``.
    """

    source = "render"

    def __init__(
        self, workers: Executor, renderer: RenderedMeasurements, digest: str, folder: Path | None = None
    ) -> None:
        self.workers, self.renderer = workers, renderer
        self._light = LightFile(folder) if folder is not None and workers.on_this_machine else None
        self._seconds: deque[float] = deque(maxlen=_REMEMBERED)  # of a trial in the last orders
        path = str(Path(renderer.study.path).absolute())
        self._order = TrialOrder(
            path, renderer.study.file, renderer.unknowns, renderer.separate_light, digest, (), renderer.rendering
        )

    def exposed_as(self, planned: PlannedExposure | None) -> SpreadMeasurements:
        """Return the same measurements with other exposures than the sensor's own."""
        other = copy.copy(self)
        other._order = replace(self._order, planned=planned)
        return other

    def rendered_as(self, rendering: Rendering) -> SpreadMeasurements:
        """Return the same measurements with other light paths."""
        other = copy.copy(self)
        other._order = replace(self._order, rendering=rendering)
        return other

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Outcome]]:
        """Yield the outcome of every virtual measurement, job by job as they arrive."""
        rows = list(self._rows(jobs))
        order = replace(self._order, light=self._light_for(rows))
        orders = [replace(order, jobs=row) for row in rows]
        made = self.workers.distribute(orders, lambda trial_order: trial_order, timed_trials, _light_of)
        for order, (outcomes, seconds) in made:
            self._seconds.append(seconds)
            yield from zip(order.jobs, outcomes, strict=True)

    def _light_for(self, rows: Sequence[tuple[Job, ...]]) -> str | None:
        """Return the file of the light that several orders of one view share; None where each worker traces its own.

        The few paths of a race are not worth it.
        """
        renderer, views = self.renderer, {row[0].view.number for row in rows}
        alone = len(rows) < 2 or len(views) > 1 or self._order.rendering != renderer.rendering
        if self._light is None or alone or not renderer.keeps_paths or renderer.separate_light:
            return None
        view = rows[0][0].view
        path = self._light.of(view.number, renderer.view_light(view).kept)
        return None if path is None else str(path.absolute())

    def _rows(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, ...]]:
        """Yield runs of jobs of one view, each of at most :data:`_IN_A_ROW` or, of slow trials, :data:`_ORDER_S`."""
        longest = _IN_A_ROW
        if self._seconds:
            longest = max(1, min(longest, int(_ORDER_S / max(statistics.median(self._seconds), 1e-3))))
        for _, group in groupby(jobs, key=lambda job: job.view.number):
            row = tuple(group)
            for first in range(0, len(row), longest):
                yield row[first : first + longest]


def _light_of(order: TrialOrder) -> tuple[tuple[str, Rendering], int]:
    """Return the names of the measurements of an order, and of the light that its trials share."""
    return (order.digest, order.rendering), order.jobs[0].view.number


#: memory of a sensor that is prepared with the light of a view [bytes]: up to 2.5e9 (Zivid, two pillars)
_PREPARED = 3 << 30

#: digests of the first study and of the last, and their measurements with the light paths of the last order
_prepared: dict[str, RenderedMeasurements] = {}


def timed_trials(order: TrialOrder) -> tuple[list[Outcome], float]:
    """Make the trials of an order, and return the time [s] of each as well; workers call this function."""
    began = time.monotonic()
    outcomes = make_trials(order)
    return outcomes, (time.monotonic() - began) / len(order.jobs)


def is_room_for_another() -> bool:
    """Return whether every core has memory for another prepared sensor."""
    return available_memory() > _PREPARED * (os.cpu_count() or 1)


def _make_room() -> None:
    """Forget the last study, or all if memory is scarce: changes are tried in turn, then the first study goes on."""
    if len(_prepared) > 1:
        _prepared.popitem()
    if not is_room_for_another():
        _prepared.clear()


def make_trials(order: TrialOrder) -> list[Outcome]:
    """Make the trials of an order; workers call this function."""
    if order.digest not in _prepared:
        from mitsim.scene import backend

        backend.activate(None)
        _make_room()
        study = open_study(order.path, order.file, mapped=False)  # trials are rendered
        _prepared[order.digest] = RenderedMeasurements(study, order.unknowns, order.rendering, order.separate_light)
    if order.rendering != _prepared[order.digest].rendering:
        _prepared[order.digest] = _prepared[order.digest].rendered_as(order.rendering)
    renderer = _prepared[order.digest].exposed_as(order.planned)
    renderer.light_file = order.light
    return [outcome for _, outcome in renderer.run(order.jobs)]
