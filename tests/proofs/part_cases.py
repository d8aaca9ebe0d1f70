"""Read the parts, sensors and finishes for the validation of statements and scores from a TOML file.

Signal chain: TOML -> cases -> a study for each, with the defaults of `mitsim run` -> candidate views, drawn at random
from all views of the study.

A case is a part, a sensor and a finish. Its part is *open* or *sealed*. Open parts may be used in development, and for
fitting constants; sealed ones only for validation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import InputError
from mitsim.study import Study, StudyFile, open_study
from mitsim.views import ViewsTable

_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"


class CaseTable(Document):
    """One part with one sensor: the ``parameters`` of its scene, and whether its candidates are ``raced``.

    ``surfaces`` is the number of surfaces on a light path of the truth, if it is larger than that of the tool. A raced
    case has ``raced_worlds`` for its first ``raced_candidates``; other cases have statements only.
    """

    part: Annotated[str, Field(pattern=_NAME, max_length=60)]
    sensor: str
    finish: Annotated[str, Field(pattern=_NAME, max_length=60)]
    parameters: dict[str, str | float] = Field(default_factory=dict)
    raced: bool = False
    surfaces: Annotated[int, Field(ge=1, le=16)] | None = None

    @property
    def name(self) -> str:
        """Return the name of its files."""
        return f"{self.part}__{Path(self.sensor.removesuffix('.toml')).name}__{self.finish}"


class PartCasesFile(Document):
    """Cases for the validation of statements and scores; paths are relative to the file.

    A part NAME has its scene and its task in ``NAME/NAME.xml`` and ``NAME/task.toml``. ``candidates`` are drawn from
    the ``views`` of the study. The truth consists of errors in random worlds:

    - ``worlds`` for every candidate,
    - ``raced_worlds`` for the first ``raced_candidates`` of a raced case, once with finishes of a pool, once with their
      own,
    - ``stated_worlds`` for the ``stated`` views whose statements are judged.

    Statements have ``trials`` virtual measurements, by default as many as a study makes without a time limit.
    ``measured`` is a folder with files of an earlier run, whose measurements are reused.
    """

    sealed: list[str]
    views: ViewsTable
    candidates: Annotated[int, Field(ge=2, le=1000)] = 40
    worlds: Annotated[int, Field(ge=2, le=1000)] = 12
    raced_candidates: Annotated[int, Field(ge=2, le=1000)] = 24
    raced_worlds: Annotated[int, Field(ge=4, le=1000, multiple_of=2)] = 30
    stated: Annotated[int, Field(ge=1, le=100)] = 2
    stated_worlds: Annotated[int, Field(ge=2, le=1000)] = 45
    trials: Annotated[int, Field(ge=2, le=100_000)] | None = None
    seed: Annotated[int, Field(ge=0)] = 1
    measured: str | None = None
    cases: Annotated[list[CaseTable], Field(min_length=1)]

    @model_validator(mode="after")
    def _once(self) -> PartCasesFile:
        names = [(case.part, case.sensor, case.finish) for case in self.cases]
        if len(set(names)) < len(names):
            raise ValueError("cases that each differ in part, sensor or finish")
        return self


@dataclass(frozen=True)
class PartCase:
    """One case of the file at ``path``; ``measured`` is the folder for its earlier trials."""

    file: PartCasesFile
    table: CaseTable
    path: Path
    measured: Path | None

    @property
    def name(self) -> str:
        """Return the name of its files."""
        return self.table.name

    @property
    def sealed(self) -> bool:
        """Return whether its part is reserved for validation."""
        return self.table.part in self.file.sealed

    @property
    def usable_for_fitting(self) -> bool:
        """Return whether constants may be fitted to it: an open part, and a truth with the light paths of the tool."""
        return not self.sealed and self.table.surfaces is None

    def open(self) -> Study:
        """Load the part, with the candidates as its views.

        Open one case at a time: Dr.Jit compiles a material call for the materials of every scene in memory.

        Raises
        ------
        InputError
            For anything that would stop the case later; see :func:`mitsim.study.open_study`.
        """
        file, table = self.file, self.table
        one = StudyFile(
            scene=f"{table.part}.xml",
            parameters=table.parameters,
            task="task.toml",
            sensor=table.sensor,
            seed=file.seed,
            views=file.views,
        )
        study = open_study(self.path.parent / table.part / "study.toml", one)
        order = np.random.default_rng([file.seed, len(study.views)]).permutation(len(study.views))
        drawn = [replace(study.views[i], number=place) for place, i in enumerate(order[: file.candidates])]
        return replace(study, candidates=replace(study.candidates, views=drawn))


def read_part_cases(path: str | Path, only: Sequence[str] = ()) -> list[PartCase]:
    """Read all cases of a file, or those whose name contains one of ``only``, and open each once to find errors.

    Raises
    ------
    InputError
        For anything that would stop a case later.
    """
    path = Path(path)
    file = read_toml(path, PartCasesFile)
    before = None if file.measured is None else path.parent / file.measured
    found = [
        PartCase(file, table, path, before)
        for table in file.cases
        if not only or any(text in table.name for text in only)
    ]
    if not found:
        names = ", ".join(table.name for table in file.cases)
        raise InputError(path, "--only", ", ".join(only), f"text in the name of a case: {names}")
    for case in found:
        case.open()
    return found


def described(path: str | Path, cases: Sequence[PartCase]) -> str:
    """Return the introduction of a page, in Markdown."""
    file = cases[0].file
    sealed = sorted({case.table.part for case in cases if case.sealed})
    parts = sorted({case.table.part for case in cases if not case.sealed})
    return (
        f"\nMade by `python -m tests.proofs statements {path} -o FOLDER`, which writes this page, its figure "
        "and its tables.\n"
        f"\nOpen parts: {', '.join(parts) or 'none'}. Sealed parts, at which nothing but this page looks: "
        f"{', '.join(sealed) or 'none'}.\n\nEvery case has {file.candidates} candidate views, drawn at random from "
        "those of a study. The functions of `mitsim run` screen them, race the first "
        f"{file.raced_candidates} (in the cases that are raced), and state {file.stated} views. Each statement is "
        f"judged by {file.stated_worlds} other worlds, in which all light is rendered anew; each choice by "
        f"{file.raced_worlds} other worlds of every candidate. "
        "Every number is simulated; what the simulator leaves "
        "out ([light](../light.md)) is not in the truth either.\n"
    )
