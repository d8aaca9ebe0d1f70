"""What a view score is held against: sensors, samples, views and repeats, as a TOML file says.

Signal chain: TOML -> for every sensor and sample a study with the map that comes with mitsim, all read and found
possible before the first render.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from characterisation.documents import Document, read_toml
from mitsim.campaign.plan import sensor_checksum
from mitsim.capture.indirect_light import IndirectLight
from mitsim.errors import InputError
from mitsim.sensor.frames import Transform
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor
from mitsim.study import CharacterisationTable, Study, StudyFile, open_study
from mitsim.views import View, ViewsTable

#: part of the digest of kept views: raised when the same view would give another measurement
CHECK_VERSION = 5


class PartSample(Document):
    """The part in one finish: ``name`` of the sample, a ``scene`` and its ``parameters``."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$", max_length=60)]
    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)


class Placement(Document):
    """How far from its place the part is put down: standard deviations along and about each axis through its middle."""

    shift_mm: Annotated[float, Field(ge=0, le=100)] = 1.0
    turn_deg: Annotated[float, Field(ge=0, le=5)] = 0.3


class IndirectLightTable(Document):
    """Rendering of light by way of other surfaces: see :class:`mitsim.capture.indirect_light.IndirectLight`.

    ``samples`` per pixel are 4 where images are matched, and 16 for other sensors, unless told: a phase is read from
    small differences of images, and in matt white a third of its error was noise of 4.
    """

    samples: Annotated[int, Field(ge=1, le=4096)] | None = None
    smoothing_px: Annotated[float, Field(gt=0, le=5)] = 1.5

    def of(self, sensor: Sensor) -> IndirectLight:
        """As a sensor needs it."""
        usual = 4 if isinstance(sensor.settings, MatcherSettings) else 16
        return IndirectLight(self.samples or usual, self.smoothing_px)


class ScoreValidationFile(Document):
    """A validation of view scores; paths in it are relative to it.

    Each of the ``views`` of each of the ``sensors`` at each of the ``samples`` is rendered, decoded and measured
    ``repeats`` times, with ``light_path_depth`` surfaces on a light path (1 is direct light); what comes by way of
    other surfaces is rendered as ``indirect_light`` says. Each time the part is put down anew, turned and shifted by a
    little, and its pose is known: where the pattern falls, and so most of what a matcher gets wrong, would be the same
    otherwise, and ten repeats would tell no more of a view than one. ``maps`` by sensor take the place of those that
    come with mitsim. ``measured`` is a folder with a file SENSOR.nc that an earlier run wrote: what it holds of the
    same views is not measured again.
    """

    task: str
    sensors: Annotated[list[str], Field(min_length=1)]
    maps: dict[str, str] = Field(default_factory=dict)
    measured: str | None = None
    samples: Annotated[list[PartSample], Field(min_length=1)]
    views: ViewsTable
    seed: Annotated[int, Field(ge=0)] = 1
    repeats: Annotated[int, Field(ge=1, le=1000)] = 4
    placement: Placement = Placement()
    samples_per_pixel: Annotated[int, Field(ge=1, le=4096)] = 16
    light_path_depth: Annotated[int, Field(ge=1, le=16)] = 2
    indirect_light: IndirectLightTable = IndirectLightTable()

    @model_validator(mode="after")
    def _once(self) -> ScoreValidationFile:
        for what, names in (("sensors", self.sensors), ("samples", [sample.name for sample in self.samples])):
            if len(set(names)) < len(names):
                raise ValueError(f"{what} that each have a name of their own")
        return self


@dataclass(frozen=True)
class ScoreCheck:
    """One sensor at one sample: the ``study`` that scores the views, and the ``digest`` of what a view's check is.

    ``measured``: the folder in which its ``sensor_file`` may be, with views that were measured before.
    """

    sample: PartSample
    study: Study
    file: ScoreValidationFile
    digest: str
    measured: Path | None = None

    @property
    def folder(self) -> str:
        """Where its views are kept, below the run's folder."""
        return f"{Path(self.study.sensor.name).name}/{self.sample.name.replace(' ', '_')}"

    @property
    def sensor_file(self) -> str:
        """Name of the file of all views that were measured with its sensor."""
        return f"{Path(self.study.sensor.name).name}.nc"

    def seed(self, view: View, repeat: int) -> int:
        """Of one capture."""
        return int(np.random.SeedSequence([self.file.seed, 2, view.number, repeat]).generate_state(1)[0])

    def pose(self, view: View, repeat: int) -> Transform:
        """``world_from_sensor`` of one capture: the world is the part's frame, so the sensor stands a little aside."""
        rng = np.random.default_rng([self.file.seed, 3, view.number, repeat])
        placed, middle = self.file.placement, self.study.scene.centre
        turn = Rotation.from_rotvec(rng.normal(0.0, np.radians(placed.turn_deg), 3)).as_matrix()
        shift = rng.normal(0.0, placed.shift_mm, 3)
        return Transform(turn, middle + shift - turn @ middle) @ view.world_from_sensor


def read_score_validation(path: str | Path) -> list[ScoreCheck]:
    """Read a validation of scores: a check for every sensor and sample, those of one sensor together.

    Raises
    ------
    InputError
        For anything that would stop it later: see :func:`mitsim.study.read_study`.
    """
    path = Path(path)
    file = read_toml(path, ScoreValidationFile)
    if strangers := sorted(set(file.maps) - set(file.sensors)):
        raise InputError(path, f"maps.{strangers[0]}", "no such sensor", ", ".join(file.sensors))
    return list(_checks(path, file))


def _checks(path: Path, file: ScoreValidationFile) -> Iterator[ScoreCheck]:
    for sensor in file.sensors:
        for sample in file.samples:
            one = StudyFile(
                scene=sample.scene, parameters=sample.parameters, task=file.task, sensor=sensor, seed=file.seed,
                characterisation=CharacterisationTable(map=file.maps.get(sensor)), views=file.views,
            )  # fmt: skip
            study = open_study(path, one)
            before = None if file.measured is None else path.parent / file.measured
            yield ScoreCheck(sample, study, file, _digest(path, file, sample, study), before)


def _digest(path: Path, file: ScoreValidationFile, sample: PartSample, study: Study) -> str:
    """Checksum of all that decides what is measured in one repeat of a view; the map is not part of it."""
    told: dict[str, Any] = {
        "version": CHECK_VERSION, "sensor": sensor_checksum(study.sensor), "parameters": sample.parameters,
        "scene": (path.parent / sample.scene).read_text(), "task": (path.parent / file.task).read_text(),
        "seed": file.seed, "placement": file.placement.model_dump(),
        "samples_per_pixel": file.samples_per_pixel,
        "light_path_depth": file.light_path_depth, "indirect_light": asdict(file.indirect_light.of(study.sensor)),
    }  # fmt: skip
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


def told(path: str | Path, checks: list[ScoreCheck]) -> str:
    """What was done, for the head of the page, in Markdown."""
    file = checks[0].file
    sensors = ", ".join(f"{name} ({views} views)" for name, views in
                        {check.study.sensor.name: len(check.study.views) for check in checks}.items())  # fmt: skip
    samples = ", ".join(sample.name for sample in file.samples)
    light = "direct light only" if file.light_path_depth == 1 else f"light of up to {file.light_path_depth} surfaces"
    placed = f"{file.placement.shift_mm:g} mm and {file.placement.turn_deg:g} deg"
    return (
        f"\nMade by `mitsim validate scores {path} -o FOLDER`, which writes this page, its figures and its tables.\n\n"
        f"Sensors: {sensors}. Samples: {samples}. Each view was rendered, decoded and measured {file.repeats} times "
        f"({light}, {file.samples_per_pixel} samples per pixel), each time with the part put down anew, at a place "
        f"that is known and differs by {placed} (standard deviations, each axis), with fresh speckle and noise. Every "
        "number is simulated; what the simulator leaves out (docs/explanation/light.md) is not in the truth either.\n"
    )
