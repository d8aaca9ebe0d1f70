"""Run the laboratory: state views with the tool, measure the same views in the laboratory's worlds, and keep both.

Signal chain: rows of cases -> statement of each case, view and kind of scene, from the tool's own trials -> worlds that
are not kept yet, in this process or several -> a folder of trials for each row and decoder, with a line for each world.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from characterisation.statements.statement import Statement
from characterisation.tasks.task_file import Task
from characterisation.words.progress import say, track
from mitsim.running.executor import Executor
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.study import StatementTable, Study
from mitsim.study.session import Session
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial
from tests.proofs.kept_trials import errors_of
from tests.proofs.laboratory.cases import Judged
from tests.proofs.laboratory.worlds import Laboratory

#: increased if the same world gives another measurement
VERSION = 2

#: worlds in one order for a worker
_IN_A_ROW = 5


@dataclass(frozen=True)
class Order:
    """Worlds of one row for a worker."""

    row: Judged
    numbers: tuple[int, ...]


#: the kept worlds of a row, by decoder, and worlds of the row to make
_Missing = tuple[dict[str, TrialFolder], Order]


@dataclass(frozen=True)
class Found:
    """Statements and errors of one row and decoder: ``errors`` (measurement, world), NaN without a value.

    Errors of a value that folds are those of parts at the limit of their tolerance, as in the statements.
    """

    row: Judged
    decoder: str
    statements: tuple[Statement, ...]
    errors: np.ndarray


def kept_worlds(rows: Sequence[Judged], folder: Path) -> list[dict[str, TrialFolder]]:
    """Return the finished worlds of every row, by decoder: world ``number`` is ``Trial(number)``."""
    known: dict[tuple[str, int, str], tuple[str, Task]] = {}
    out = []
    for row in rows:
        if row.name not in known:
            study = row.study()
            known[row.name] = world_digest(row, study), study.task
        place = folder / "worlds" / f"{row.case.name}__{row.family}__{row.mask}"
        out.append({decoder: TrialFolder.of(place / decoder, *known[row.name]) for decoder in row.case.decoders})
    return out


def world_digest(row: Judged, study: Study) -> str:
    """Return sixteen hexadecimal digits of what determines the worlds of a case; ``study`` is that of the row."""
    content = {
        "version": VERSION,
        "case": row.case.name,
        "sensor": sensor_checksum(study.sensor),
        "task": study.task.model_dump(mode="json"),
        "scene": row.scene_path.read_text(encoding="utf-8"),
        "parameters": row.scene.parameters,
        "unknowns": study.unknowns.model_dump(mode="json"),
        "covariance": hashlib.sha256(study_unknowns(study).calibration.covariance.tobytes()).hexdigest(),
        "seed": row.file.seed,
        "paths": row.paths,
        "pose": row.view_of(study).world_from_sensor.matrix().round(9).tolist(),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def statement_of(row: Judged, folder: Path, workers: Executor | None = None) -> list[Statement]:
    """Return the tool's statement of a row's view in its scene, and reuse trials in the folder."""
    study = row.study()
    session = Session(study, folder / f"{row.case.name}__{row.name[2]}", workers)
    table = None if row.file.trials is None else StatementTable(trials=row.file.trials)
    return session.state(row.view_of(study), table).statements


def run_rows(rows: Sequence[Judged], folder: Path, workers: Executor | None = None) -> list[Found]:
    """State and measure every row; reuse what the folder has."""
    kept = kept_worlds(rows, folder)
    missing = [
        (trials, Order(row, numbers))
        for row, trials in zip(rows, kept, strict=True)
        for numbers in _in_rows([n for n in range(row.file.worlds) if not _is_kept(trials, row.view, n)])
    ]
    if missing:
        say(f"laboratory: {sum(len(order.numbers) for _, order in missing)} worlds to make")
        done = workers.distribute(missing, _order_of, make_worlds) if workers else _here(missing)
        for (trials, order), outcomes in track(done, "laboratory", len(missing)):
            for number, outcome in zip(order.numbers, outcomes, strict=True):
                for decoder in [one for one in trials if Trial(number) not in trials[one].known(order.row.view)]:
                    trials[decoder].add(order.row.view, Trial(number), outcome[decoder])
    stated: dict[tuple[str, int, str], tuple[Statement, ...]] = {}
    out = []
    for row, trials in zip(rows, kept, strict=True):
        if row.name not in stated:
            stated[row.name] = tuple(statement_of(row, folder, workers))
        worlds = [Trial(number) for number in range(row.file.worlds)]
        out += [
            Found(row, decoder, stated[row.name], errors_of(of_decoder, row.view, worlds))
            for decoder, of_decoder in trials.items()
        ]
    return out


def _is_kept(trials: dict[str, TrialFolder], view: int, number: int) -> bool:
    return all(Trial(number) in one.known(view) for one in trials.values())


def _order_of(missing: _Missing) -> Order:
    return missing[1]


def _in_rows(numbers: Sequence[int]) -> Iterator[tuple[int, ...]]:
    for first in range(0, len(numbers), _IN_A_ROW):
        yield tuple(numbers[first : first + _IN_A_ROW])


def _here(missing: Sequence[_Missing]) -> Iterator[tuple[_Missing, list[dict[str, Outcome]]]]:
    for one in missing:
        yield one, make_worlds(_order_of(one))


_prepared: dict[tuple[str, int, str, str], Laboratory] = {}


def make_worlds(order: Order) -> list[dict[str, Outcome]]:
    """Measure the worlds of an order; workers call this function."""
    from mitsim.scene import backend

    backend.activate(None)
    row = order.row
    key = (row.case.name, row.view, row.family, row.mask)
    if key not in _prepared:
        _prepared.clear()  # Dr.Jit compiles a material call for the materials of every scene in memory
        _prepared[key] = Laboratory(row)
    return [_prepared[key].measure(number, row.case.decoders) for number in order.numbers]
