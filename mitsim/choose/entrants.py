"""The sensors that compete: presets and a user's own files, each with the study as it reads for that sensor.

Signal chain: list of names and files -> study with that sensor and its map -> entrants, and those that cannot take part
with the reason.

A study names one sensor. For another the part, the task, the unknowns and the views are kept; the map is that sensor's
own, and distances are taken from the study only where the sensor can stand there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from characterisation.documents import read_toml
from mitsim.campaign.answer import Ask
from mitsim.errors import InputError
from mitsim.sensor.preset import presets
from mitsim.study import CharacterisationTable, Study, StudyFile, open_study

#: stands for every preset
ALL_PRESETS = "all"


@dataclass(frozen=True)
class Entrant:
    """A sensor that takes part: its ``name`` in the table, what was ``given`` for it, and the ``study`` for it."""

    name: str
    given: str
    study: Study


@dataclass(frozen=True)
class Excluded:
    """A sensor that cannot take part, and why."""

    name: str
    given: str
    why: str


def read_entrants(
    path: str | Path, sensors: Sequence[str], ask: Ask | None = None
) -> tuple[list[Entrant], list[Excluded]]:
    """Open a study for each of the sensors.

    Parameters
    ----------
    sensors
        ``all`` for every preset; a preset's name; the path of a sensor TOML; either with ``=MAP``, a map's file or the
        name of a sensor whose map comes with mitsim. Paths are relative to the working folder.
    ask
        Answers whether finishes that a sensor's map does not know may be characterised now; None if nobody can.

    Raises
    ------
    InputError
        If the study itself cannot be read, a sensor is unknown or named twice, or none can take part.
    """
    path = Path(path)
    file = read_toml(path, StudyFile)
    entrants, excluded = list[Entrant](), list[Excluded]()
    for given in _each(sensors):
        opened = _open(path, file, given, ask)
        if isinstance(opened, Excluded):
            excluded.append(opened)
            continue
        if opened.name in {one.name for one in entrants}:
            raise InputError("--sensors", "", f"{opened.name} twice", "sensors of different names")
        entrants.append(opened)
    if not entrants:
        raise InputError("--sensors", "", "; ".join(one.why for one in excluded), "a sensor that can take part")
    return entrants, excluded


def _each(sensors: Sequence[str]) -> list[str]:
    out = list[str]()
    for given in (part.strip() for one in sensors for part in one.split(",")):
        out += presets() if given == ALL_PRESETS else [given] if given else []
    if not out:
        raise InputError("--sensors", "", "nothing", f"{ALL_PRESETS}, or a list of {', '.join(presets())} and files")
    if twice := next((one for one in out if out.count(one) > 1), None):
        raise InputError("--sensors", "", f"{twice} twice", "each sensor once")
    return out


def _open(path: Path, file: StudyFile, given: str, ask: Ask | None) -> Entrant | Excluded:
    sensor, _, map_name = given.partition("=")
    own = sensor.endswith(".toml")
    if not own and sensor not in presets():
        raise InputError("--sensors", "", sensor, f"{', '.join(presets())}, or a sensor TOML")
    same = sensor == file.sensor and not map_name
    table = (
        file
        if same
        else file.model_copy(
            update={
                "sensor": str(Path(sensor).resolve()) if own else sensor,
                "characterisation": CharacterisationTable(),
            }
        )
    )
    study, first = _try(path, table, map_name, ask)
    if study is None and _has_distance(file) and not same:
        free = file.views.model_copy(update={"standoff_mm": None, "standoffs_mm": None})
        study, _ = _try(path, table.model_copy(update={"views": free}), map_name, ask)
    if study is None:
        assert first is not None
        return Excluded(Path(sensor).stem, given, str(first))
    if study.performance_map is None:
        why = "its study runs a campaign first: run it, and give its map as SENSOR=MAP"
        return Excluded(study.sensor.name, given, why)
    return Entrant(study.sensor.name, given, replace(study, path=path))


def _has_distance(file: StudyFile) -> bool:
    return file.views.standoff_mm is not None or file.views.standoffs_mm is not None


def _try(path: Path, file: StudyFile, map_name: str, ask: Ask | None) -> tuple[Study | None, InputError | None]:
    try:
        return open_study(path, file, map_name or None, ask), None
    except InputError as error:
        if Path(str(error.where)).name == Path(file.task).name:
            raise  # the task is wrong for every sensor
        return None, error
