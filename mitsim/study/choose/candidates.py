"""Read the sensors to compare: presets and user files, each with the study adapted to that sensor.

Signal chain: list of names and files -> study with each sensor and its map -> sensors to compare, and excluded ones
with the reason.

A study names one sensor. Part, task, unknowns and views of the study hold for every other sensor too. Each sensor uses
its own map, and its own calibration: the covariance, hand-eye calibration and housing in the study are those of the
study's sensor. Distances of the study are used only if they are possible for the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.maps.shipped import shipped_maps
from mitsim.maps.campaign.missing_finishes import Ask
from mitsim.sensor.preset import presets
from mitsim.study import CharacterisationTable, Study, StudyFile, open_study
from mitsim.views.table import SensorBody

#: means every preset
ALL_PRESETS = "all"


@dataclass(frozen=True)
class CandidateSensor:
    """A sensor to compare: its ``name`` in the table, the ``given`` text of the user, and the ``study`` for it."""

    name: str
    given: str
    study: Study


@dataclass(frozen=True)
class Excluded:
    """A sensor that cannot be compared, with the reason."""

    name: str
    given: str
    reason: str


def read_candidates(
    path: str | Path, sensors: Sequence[str], ask: Ask | None = None
) -> tuple[list[CandidateSensor], list[Excluded]]:
    """Open a study for each of the sensors.

    ``sensors`` are ``all`` for every preset, names of presets, or paths of sensor TOML files. ``=MAP`` after a name or
    path selects a map: a file, or a sensor whose map comes with mitsim. Paths are relative to the working folder.
    ``ask`` answers whether finishes that a sensor's map lacks may be characterised now; None if nobody can answer.
    Raises InputError if the study cannot be read, a sensor is unknown or named twice, or no sensor can be compared.
    """
    path = Path(path)
    file = read_toml(path, StudyFile)
    candidates, excluded = list[CandidateSensor](), list[Excluded]()
    for text in _sensor_texts(sensors):
        opened = open_candidate(path, file, text, ask)
        if isinstance(opened, Excluded):
            excluded.append(opened)
            continue
        if opened.name in {candidate.name for candidate in candidates}:
            raise InputError("--sensors", "", f"{opened.name} twice", "sensors of different names")
        candidates.append(opened)
    if not candidates:
        raise InputError(
            "--sensors", "", "; ".join(row.reason for row in excluded), "at least one sensor that can measure the study"
        )
    return candidates, excluded


def _sensor_texts(sensors: Sequence[str]) -> list[str]:
    out = list[str]()
    for text in (part.strip() for sensor in sensors for part in sensor.split(",")):
        out += presets() if text == ALL_PRESETS else [text] if text else []
    if not out:
        raise InputError("--sensors", "", "nothing", f"{ALL_PRESETS}, or a list of {', '.join(presets())} and files")
    if twice := next((sensor for sensor in out if out.count(sensor) > 1), None):
        raise InputError("--sensors", "", f"{twice} twice", "each sensor once")
    return out


def open_candidate(path: Path, file: StudyFile, text: str, ask: Ask | None) -> CandidateSensor | Excluded:
    """Open a study for one sensor; say why if that is impossible.

    ``path``, ``file``, ``text``: path of the study file, its content, and the sensor, as in :func:`read_candidates`.
    ``ask``: answers whether finishes that its map lacks may be characterised now; None if nobody can answer.
    """
    sensor, _, map_name = text.partition("=")
    is_file = sensor.lower().endswith(".toml")
    if not is_file and sensor not in presets():
        raise InputError("--sensors", "", sensor, f"{', '.join(presets())}, or a sensor TOML")
    mapped = is_file or map_name or sensor in shipped_maps()
    own = sensor == file.sensor
    if is_file:  # relative to the folder of the study there, to the working folder here
        own = Path(sensor).resolve() == (path.parent / file.sensor).resolve()
    if not mapped and (not own or file.characterisation == CharacterisationTable()):
        return Excluded(sensor, text, f"no performance map of it comes with mitsim: make one, and give {sensor}=MAP")
    tables = [file]
    if not own or map_name:
        name = str(Path(sensor).resolve()) if is_file else sensor
        changed = file.model_copy(update={"sensor": name, "characterisation": CharacterisationTable()})
        changed = changed if own else _without_calibration(changed)
        free = changed.views.model_copy(update={"standoff_mm": None, "standoffs_mm": None})
        tables = [changed] if free == changed.views else [changed, changed.model_copy(update={"views": free})]
    study, errors = None, list[InputError]()
    for table in tables:
        try:
            study = open_study(path, table, performance_map=map_name or None, ask=ask)
            break
        except InputError as error:
            if Path(str(error.where)).name == Path(file.task).name:
                raise  # an error in the task concerns every sensor
            errors.append(error)
    if study is None:
        return Excluded(Path(sensor).stem, text, str(errors[0]))
    if study.performance_map is None:
        reason = "its study has a campaign instead of a map: run it, and give its map as SENSOR=MAP"
        return Excluded(study.sensor.name, text, reason)
    return CandidateSensor(study.sensor.name, text, replace(study, path=path))


def _without_calibration(file: StudyFile) -> StudyFile:
    """Return a study without what was calibrated or measured at its own sensor."""
    views = file.views.model_copy(update={"flange_from_sensor": None, "sensor_body": SensorBody()})
    calibration = file.unknowns.calibration.model_copy(update={"covariance": None})
    unknowns = file.unknowns.model_copy(update={"calibration": calibration})
    return file.model_copy(update={"views": views, "unknowns": unknowns})
