"""Read the cases of the laboratory from a TOML file.

A case is a part, a sensor and the views whose statements are judged. Every case names a scene of metal and one that is
matt white, or parameters that make one scene either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import InputError
from mitsim.study import Study, StudyFile, open_study
from mitsim.views import View, ViewsTable
from tests.proofs.laboratory.decoders import Decoder
from tests.proofs.laboratory.finishes import Family

Mask = Literal["preset", "another"]

_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"


class SceneTable(Document):
    """A scene XML with values of its ``<default>`` elements."""

    file: str
    parameters: dict[str, str | float] = Field(default_factory=dict)


class LaboratoryCase(Document):
    """One part before one sensor.

    ``masks`` are those of random dots; fringes have one. ``decoders`` are those of :mod:`.decoders`. ``paths`` replaces
    that of the file.
    """

    name: Annotated[str, Field(pattern=_NAME, max_length=60)]
    metal: SceneTable
    white: SceneTable
    task: str
    sensor: str
    views: Annotated[list[int], Field(min_length=1)]
    families: Annotated[list[Family], Field(min_length=1)]
    masks: list[Mask] = Field(default=["preset"], min_length=1)
    decoders: list[Decoder] = Field(default=["ours"], min_length=1)
    paths: Annotated[int, Field(ge=1, le=1_000_000)] | None = None


class LaboratoryFile(Document):
    """Cases of the laboratory; paths are relative to the file.

    - ``worlds`` of every case, view, family and mask.
    - ``trials`` of the statements that are judged; without them, as many as a study makes by its own rule.
    - ``paths``: light paths for each pixel and pattern.
    - ``grid``: the candidate views that ``views`` of a case number, as in a study.
    """

    seed: Annotated[int, Field(ge=0)] = 1
    worlds: Annotated[int, Field(ge=1, le=100_000)] = 20
    trials: Annotated[int, Field(ge=2, le=100_000)] | None = None
    paths: Annotated[int, Field(ge=1, le=1_000_000)] = 252
    grid: ViewsTable
    cases: Annotated[list[LaboratoryCase], Field(min_length=1)]

    @model_validator(mode="after")
    def _once(self) -> LaboratoryFile:
        if len({case.name for case in self.cases}) < len(self.cases):
            raise ValueError("cases with different names")
        return self


@dataclass(frozen=True)
class Judged:
    """What one row of worlds shares: a case, a view, a family and a mask. ``path`` is that of the cases file."""

    path: Path
    file: LaboratoryFile
    case: LaboratoryCase
    view: int
    family: Family
    mask: Mask

    @property
    def name(self) -> tuple[str, int, str]:
        """Return what its statement and the digest of its worlds belong to: case, view, and kind of scene."""
        return self.case.name, self.view, "white" if self.family == "white" else "metal"

    @property
    def paths(self) -> int:
        """Return the light paths for each pixel and pattern."""
        return self.file.paths if self.case.paths is None else self.case.paths

    @property
    def scene(self) -> SceneTable:
        """Return the scene that the family needs."""
        return self.case.white if self.family == "white" else self.case.metal

    @property
    def scene_path(self) -> Path:
        """Return the path of the scene's XML."""
        return self.path.parent / self.scene.file

    def study(self, seed: int | None = None) -> Study:
        """Open the study whose statement is judged.

        Raises
        ------
        InputError
            As :func:`mitsim.study.open_study`.
        """
        one = StudyFile(
            scene=self.scene.file,
            parameters=self.scene.parameters,
            task=self.case.task,
            sensor=self.case.sensor,
            seed=self.file.seed if seed is None else seed,
            views=self.file.grid,
        )
        return open_study(self.path.parent / "study.toml", one, mapped=False)

    def view_of(self, study: Study) -> View:
        """Return the view by its number.

        Raises
        ------
        InputError
            If the study has no view of this number.
        """
        by_number = {view.number: view for view in study.views}
        if self.view not in by_number:
            raise InputError(self.path, f"cases.{self.case.name}.views", self.view, f"0 to {max(by_number)}")
        return by_number[self.view]


def read_cases(path: str | Path, only: Sequence[str] = ()) -> list[Judged]:
    """Read the rows of a cases file, or those of cases and families whose names contain one of ``only``.

    Raises
    ------
    InputError
        If the file is invalid, or nothing is left.
    """
    path = Path(path)
    file = read_toml(path, LaboratoryFile)
    rows = [
        Judged(path, file, case, view, family, mask)
        for case in file.cases
        for view in case.views
        for family in case.families
        for mask in case.masks
    ]
    left = [row for row in rows if not only or any(text in f"{row.case.name}__{row.family}" for text in only)]
    if not left:
        raise InputError(path, "--only", ", ".join(only), "text in CASE__FAMILY")
    return left
