"""Run the laboratory: state views with the tool, measure the same views in the laboratory's worlds, and keep both.

Signal chain: rows of cases -> statement of each case, view and kind of scene, from the tool's own trials -> worlds that
are not kept yet, in this process or several -> one line of ``worlds.jsonl`` for each world and decoder.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.statements.statement import Statement
from mitsim.maps.campaign.plan import sensor_checksum
from mitsim.running.executor import Executor
from mitsim.running.progress import say, track
from mitsim.study import StatementTable
from mitsim.study.session import Session
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import Outcome
from tests.proofs.laboratory.cases import Judged
from tests.proofs.laboratory.worlds import Laboratory

#: increased if the same world gives another measurement
VERSION = 1

#: worlds in one order for a worker
_IN_A_ROW = 5

Key = tuple[str, int, str, str, int, str]


@dataclass(frozen=True)
class Order:
    """Worlds of one row for a worker."""

    row: Judged
    numbers: tuple[int, ...]


@dataclass(frozen=True)
class Found:
    """Statements and errors of one row and decoder: ``errors`` (measurement, world), NaN without a value."""

    row: Judged
    decoder: str
    statements: tuple[Statement, ...]
    errors: np.ndarray


class KeptWorlds:
    """The finished worlds of a folder, in ``worlds.jsonl``; from the first invalid line on, lines are dropped."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "worlds.jsonl"
        self.known: dict[Key, dict[str, float]] = {}
        text = self.path.read_text(encoding="utf-8") if self.path.exists() else ""
        whole = ""
        for line in text[: text.rfind("\n") + 1].splitlines(keepends=True):
            try:
                one = json.loads(line)
                errors = {name: math.nan if value is None else float(value) for name, value in one["errors"].items()}
                key = (one["digest"], one["view"], one["family"], one["mask"], one["world"], one["decoder"])
            except (ValueError, KeyError, TypeError, AttributeError):
                break  # lines after an invalid line are not trusted either
            self.known[key] = errors
            whole += line
        if whole != text:
            partial = self.path.with_suffix(".partial")
            partial.write_text(whole, encoding="utf-8")
            partial.replace(self.path)

    def add(self, row: Judged, digest: str, number: int, outcomes: dict[str, Outcome]) -> None:
        """Keep a finished world; it is on the disk when this function returns."""
        with self.path.open("a", encoding="utf-8") as stream:
            for decoder, outcome in outcomes.items():
                errors = {name: value if math.isfinite(value) else None for name, value in outcome.errors.items()}
                line: dict[str, Any] = {"digest": digest, "case": row.case.name, "view": row.view}
                line |= {"family": row.family, "mask": row.mask, "world": number, "decoder": decoder, "errors": errors}
                if outcome.reasons:
                    line["reasons"] = dict(outcome.reasons)
                stream.write(json.dumps(line) + "\n")
                self.known[(digest, row.view, row.family, row.mask, number, decoder)] = dict(outcome.errors)
            stream.flush()
            os.fsync(stream.fileno())


def world_digest(row: Judged) -> str:
    """Return sixteen hexadecimal digits of what determines the worlds of a case."""
    study = row.study()
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
    return session.state(row.view_of(study), StatementTable(trials=row.file.trials, pairs=0)).statements


def run_rows(rows: Sequence[Judged], folder: Path, workers: Executor | None = None) -> list[Found]:
    """State and measure every row; reuse what the folder has."""
    kept, digests = KeptWorlds(folder), dict[tuple[str, int, str], str]()
    for row in rows:
        if row.name not in digests:
            digests[row.name] = world_digest(row)
    missing = [
        Order(row, numbers)
        for row in rows
        for numbers in _in_rows([n for n in range(row.file.worlds) if not _is_kept(kept, row, digests[row.name], n)])
    ]
    if missing:
        say(f"laboratory: {sum(len(order.numbers) for order in missing)} worlds to make")
        done = workers.distribute(missing, lambda one: one, make_worlds) if workers else _here(missing)
        for order, outcomes in track(done, "laboratory", len(missing)):
            for number, outcome in zip(order.numbers, outcomes, strict=True):
                kept.add(order.row, digests[order.row.name], number, outcome)
    stated: dict[tuple[str, int, str], tuple[Statement, ...]] = {}
    out = []
    for row in rows:
        if row.name not in stated:
            stated[row.name] = tuple(statement_of(row, folder, workers))
        names = [one.measurement for one in stated[row.name]]
        for decoder in row.case.decoders:
            worlds = [
                kept.known[(digests[row.name], row.view, row.family, row.mask, number, decoder)]
                for number in range(row.file.worlds)
            ]
            errors = np.array([[world[name] for world in worlds] for name in names])
            out.append(Found(row, decoder, stated[row.name], errors))
    return out


def _is_kept(kept: KeptWorlds, row: Judged, digest: str, number: int) -> bool:
    keys = [(digest, row.view, row.family, row.mask, number, decoder) for decoder in row.case.decoders]
    return all(key in kept.known for key in keys)


def _in_rows(numbers: Sequence[int]) -> Iterator[tuple[int, ...]]:
    for first in range(0, len(numbers), _IN_A_ROW):
        yield tuple(numbers[first : first + _IN_A_ROW])


def _here(orders: Sequence[Order]) -> Iterator[tuple[Order, list[dict[str, Outcome]]]]:
    for order in orders:
        yield order, make_worlds(order)


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
