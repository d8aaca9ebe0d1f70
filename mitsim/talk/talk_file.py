"""Read the TOML file of a talk: sensor, samples of the artefact, views, and the sizes of its experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from characterisation.files.documents import Document, checked_name, read_toml
from characterisation.files.errors import InputError, nearest
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from characterisation.tasks.task_reading import read_task
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor
from mitsim.study import CharacterisationTable, Study, StudyFile, open_study
from mitsim.study.tables import MeasureTable, ScoreTable
from mitsim.views import View, ViewsTable

Number = Annotated[float, Field(gt=0, le=1e5)]
Tilt = Annotated[float, Field(ge=0, le=80)]


class ArtefactEntry(Document):
    """The artefact in one finish: a scene, and values for its parameters."""

    name: str
    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _named(self) -> ArtefactEntry:
        checked_name(self.key)
        return self

    @property
    def key(self) -> str:
        """Return the name as part of a file name."""
        return sample_key(self.name)


class ExampleEntry(Document):
    """A measurement of a sample whose deciles are shown; ``slide`` is the number of the talk's slide."""

    measurement: str
    sample: str
    slide: str = ""


class CouponsTable(Document):
    """Coupons: their campaign file, the one of slides 2, 3 and 5, and the poses of the validation.

    ``roughness_um`` (Ra) and ``distance_mm`` choose the coupon whose samples are drawn. ``subdivisions`` are those of
    its orientations within 20 deg, one less outside; ``refined`` bounds the added ones. The validation has ``poses`` of
    every sample at each of ``validated_distances_mm``; the clouds of the ``shown_`` coupon are compared.
    """

    campaign: str = "../coupon/maps.toml"
    roughness_um: Number = 0.37
    distance_mm: Number = 600.0
    subdivisions: int = Field(default=3, ge=1, le=4)
    refined: int = Field(default=4, ge=1, le=5)
    tilts_deg: list[Tilt] = Field(default=[0, 10, 20, 30, 40, 50, 60, 70], min_length=1)
    validated_distances_mm: list[Number] = Field(default=[450, 600, 750], min_length=1)
    poses: int = Field(default=8, ge=1, le=1000)
    shown_roughness_um: Number = 0.09
    shown_distance_mm: Number = 600.0


class TalkFile(Document):
    """A talk TOML file; its paths are relative to the file."""

    sensor: str
    map: str | None = None
    task: str
    kept: str = "kept"
    trials: int = Field(default=10, ge=2, le=1000)
    seed: int = Field(default=1, ge=0)
    samples: Annotated[list[ArtefactEntry], Field(min_length=1)]
    finishes: list[ArtefactEntry] = Field(default_factory=list)
    opening_sensors: list[str] = Field(default_factory=list)
    noise_sensors: list[str] = Field(default_factory=list)
    coupons: CouponsTable = CouponsTable()
    views: ViewsTable
    light_path_depth: int = Field(default=2, ge=1, le=16)
    samples_per_pixel: int = Field(default=16, ge=1, le=4096)
    examples: list[ExampleEntry] = Field(default_factory=list)
    sphere: ExampleEntry
    shown_feature: str = "pillar2"


@dataclass(frozen=True)
class Talk:
    """A talk whose file was read and checked."""

    path: Path
    file: TalkFile

    @property
    def folder(self) -> Path:
        """Return the folder of the file, to which its paths are relative."""
        return self.path.absolute().parent

    @cached_property
    def sensor(self) -> Sensor:
        """Return the sensor of the maps and views."""
        return sensor_in(self.folder, self.file.sensor)

    @property
    def map_name(self) -> str:
        """Return the name of the map: that of the file, or the shipped one of the sensor."""
        return self.file.map or self.sensor.name

    def study_file(self, sample: ArtefactEntry, depth: int | None = None) -> StudyFile:
        """Return the study of the artefact in one finish; ``depth`` is that of light paths, by default the talk's."""
        depth = self.file.light_path_depth if depth is None else depth
        return StudyFile(
            scene=sample.scene,
            parameters=sample.parameters,
            task=self.file.task,
            sensor=self.file.sensor,
            seed=self.file.seed,
            characterisation=CharacterisationTable(map=self.file.map),
            views=self.file.views,
            score=ScoreTable(light_path_depth=min(depth, 2)),
            measure=MeasureTable(by="render", light_path_depth=depth, samples_per_pixel=self.file.samples_per_pixel),
        )

    def study(self, sample: ArtefactEntry) -> Study:
        """Return the opened study of the artefact in one finish."""
        return open_study(self.path, self.study_file(sample))

    @cached_property
    def views(self) -> list[View]:
        """Return the candidate views, which the stage reaches and the body of the sensor is free in."""
        return open_study(self.path, self.study_file(self.file.samples[0]), mapped=False).views

    def sample(self, name: str) -> ArtefactEntry:
        """Return the sample of a name."""
        return next(artefact_entry for artefact_entry in self.file.samples if artefact_entry.name == name)


def read_talk(path: str | Path) -> Talk:
    """Read a talk TOML file.

    Raises InputError if a key is wrong, two samples have one name, or a name or distance to show is none of the talk or
    its task.
    """
    path = Path(path)
    file = read_toml(path, TalkFile)
    for table, entries in (("samples", file.samples), ("finishes", file.finishes)):
        keys = [entry.key for entry in entries]
        if twice := next((key for key in keys if keys.count(key) > 1), None):
            raise InputError(path, f"{table}.name", f"{twice}, more than once", "a name of its own for each")
    task, names = read_task(path.absolute().parent / file.task), [sample.name for sample in file.samples]
    asked: list[tuple[str, object, Sequence[object]]] = [
        ("shown_feature", file.shown_feature, task.shapes),
        ("coupons.shown_distance_mm", file.coupons.shown_distance_mm, file.coupons.validated_distances_mm),
    ]
    for where, entry in (("sphere", file.sphere), *(("examples", example) for example in file.examples)):
        asked.append((f"{where}.sample", entry.sample, names))
        asked.append((f"{where}.measurement", entry.measurement, list(task.measurements)))
    for where, value, known in asked:
        if value not in known:
            allowed = [str(one) for one in known]
            raise InputError(path, where, repr(value), ", ".join(allowed), nearest(str(value), allowed))
    return Talk(path, file)


def sample_key(name: str) -> str:
    """Return the name of a sample or finish as part of a file name."""
    return name.replace(" ", "_")


def sensor_key(name: str) -> str:
    """Return the name of a preset or of a sensor file as part of a file name."""
    return Path(name).stem if name.lower().endswith(".toml") else name


def sensor_in(folder: str | Path, name: str) -> Sensor:
    """Return a preset by its name, or the sensor of a TOML file, whose path is relative to ``folder``."""
    return load_sensor(Path(folder) / name if name.lower().endswith(".toml") else name)


def map_in(folder: str | Path, name: str) -> PerformanceMap:
    """Return a map file, whose path is relative to ``folder``, or the shipped map of a sensor."""
    return PerformanceMap.load(map_path(name, folder))
