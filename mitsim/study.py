"""A study: a part, a task, a sensor, and the views to choose from, as a TOML file says.

Signal chain: study TOML -> scene, task, sensor, performance map or the campaign that will make one -> candidate views.
Everything that a user can get wrong is read and checked here, before the first long step (:mod:`mitsim.run_study`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.stats import norm

from characterisation.documents import Document, read_toml
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.samples import Samples
from characterisation.maps.shipped import map_path, shipped_maps
from characterisation.scores.joining import POSE_KNOWN, Joining
from characterisation.statements.decision import needed, tolerance_of
from characterisation.tasks.evaluation import Task, check_features, read_task
from mitsim.campaign.answer import (
    Ask,
    Wanted,
    answering_map,
    samples_of,
    seen_finishes,
    unknown_finishes,
    with_lights,
)
from mitsim.campaign.plan import Campaign, check_exposure, read_campaign, sensor_checksum
from mitsim.errors import InputError
from mitsim.progress import say
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.sensor.preset import Sensor, load_sensor
from mitsim.sensor.unknowns import UnknownsTable, unknowns_of
from mitsim.view_scores import MATT_WHITE
from mitsim.views import Candidates, View, ViewsTable, candidate_views
from mitsim.views.standoffs import characterised_range, chosen_standoffs

#: fewer points than this on a feature do not make a measurement
MINIMUM_POINTS = 100

#: evenly likely values of a standard normal distribution
_NORMAL = norm.ppf((np.arange(400) + 0.5) / 400)


class CharacterisationTable(Document):
    """Where the performance map comes from: a campaign that is run, or a map that was made before.

    ``map`` is a file, or the name of a sensor whose map comes with mitsim; left out both, that of the study's sensor.
    """

    campaign: str | None = None
    map: str | None = None

    @model_validator(mode="after")
    def _one(self) -> CharacterisationTable:
        if self.campaign is not None and self.map is not None:
            raise ValueError("either campaign or map, and not both")
        return self


class CheckTable(Document):
    """How many of the best views are rendered once more, with everything at its best guess, for the report's pictures.

    The other keys are those of studies written before views were measured virtually; they are read and not used.
    """

    views: int = Field(default=4, ge=0, le=10000)
    repeats: int = Field(default=1, ge=1, le=1000)
    samples_per_pixel: int = Field(default=16, ge=1, le=4096)
    light_path_depth: int = Field(default=1, ge=1, le=16)


class ScoreTable(Document):
    """How views are screened: with direct light only, or with light over up to ``light_path_depth`` surfaces.

    A part none of whose faces can see another is screened with direct light, whatever is asked for: nothing else
    reaches it. Only the predicted uncertainty knows of other light; V_m is as in the talk.
    """

    light_path_depth: int = Field(default=2, ge=1, le=16)


class MeasureTable(Document):
    """How virtual measurements are made.

    ``by`` is ``render``, or ``map`` for clouds that are drawn from the performance map; left out, what the map's own
    source calls for. ``samples_per_pixel`` of direct light; ``light_path_depth`` surfaces on a light path.
    """

    by: Literal["render", "map"] | None = None
    samples_per_pixel: int = Field(default=16, ge=1, le=4096)
    light_path_depth: int = Field(default=2, ge=1, le=16)


class RaceTable(Document):
    """Which views are measured virtually, and until when.

    ``shortlist`` views of each measurement, by the map's score; at most ``trials`` of each. A choice is made when its
    view is the best, or its error within ``margin`` of the best, with the probability ``confidence``. ``minutes`` end
    the race wherever it stands.
    """

    shortlist: int = Field(default=24, ge=1, le=1000)
    trials: int = Field(default=16, ge=4, le=100_000)
    margin: Annotated[float, Field(gt=0, le=1)] = 0.1
    confidence: Annotated[float, Field(ge=0.5, lt=1)] = 0.95
    minutes: Annotated[float, Field(gt=0, le=100_000)] | None = None


class StatementTable(Document):
    """How the uncertainty of the chosen view is stated.

    ``trials`` in worlds of their own; ``pairs`` of them for every line of the budget, each a further trial.
    """

    trials: int = Field(default=200, ge=2, le=1_000_000)
    pairs: int = Field(default=16, ge=0, le=100_000)


class ExposureTable(Document):
    """How captures are exposed whose uncertainty is stated, in place of the sensor's own rule.

    ``exposures_s`` [s], merged if there are several, at ``power`` of the projector; left out, they are planned for the
    view: at most ``most`` of them, that bring points and uncertainty of every feature to ``within`` this share of the
    best that any exposure brings.
    """

    most: int = Field(default=3, ge=1, le=7)
    within: Annotated[float, Field(ge=0.01, le=1)] = 0.1
    exposures_s: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=1, max_length=7)] | None = None
    power: Annotated[float, Field(gt=0, le=1)] = 1.0

    @model_validator(mode="after")
    def _one(self) -> ExposureTable:
        if self.exposures_s is None and self.power != 1.0:
            raise ValueError("power belongs to exposures_s; without them it is planned")
        return self


class SetTable(Document):
    """The fewest views that together measure well enough.

    ``limits`` of the standard uncertainty by measurement, in its unit: those named are asked for, all at once; left
    out, every measurement with a tolerance is, with the largest uncertainty that still decides it by its rule. A
    feature counts as seen from a view if it has enough points with at least ``least_chance``; after ``seconds`` of
    searching the best set so far is told, as not proven the fewest.

    ``joining`` is how the poses of the views are known in a common frame, to ``joining_mm`` along and ``joining_deg``
    about each axis, at the middle of the part; left out, what is usual for it. ``trials`` virtual measurements of the
    whole set confirm it in ``mitsim run``.
    """

    limits: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    joining: Joining = "robot"
    joining_mm: Annotated[float, Field(ge=0, le=100)] | None = None
    joining_deg: Annotated[float, Field(ge=0, le=10)] | None = None
    trials: int = Field(default=40, ge=0, le=100_000)
    least_chance: Annotated[float, Field(gt=0, lt=1)] = 0.95
    seconds: Annotated[float, Field(gt=0, le=3600)] = 60.0

    @property
    def pose_known(self) -> tuple[float, float]:
        """How well each view's pose is known: along [mm] and about [deg] each axis."""
        position, angle = POSE_KNOWN[self.joining]
        return (
            position if self.joining_mm is None else self.joining_mm,
            angle if self.joining_deg is None else self.joining_deg,
        )

    @model_validator(mode="after")
    def _joined(self) -> SetTable:
        if self.joining == "exact" and (self.joining_mm or self.joining_deg):
            raise ValueError('joining = "exact" has neither joining_mm nor joining_deg')
        if self.joining == "best_fit" and not all(self.pose_known):
            raise ValueError("a best fit starts from poses that are not exact: joining_mm and joining_deg over 0")
        return self


class StudyFile(Document):
    """A study TOML file; paths in it are relative to it."""

    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)
    task: str
    sensor: str
    seed: Annotated[int, Field(ge=0)] = 1
    characterisation: CharacterisationTable = CharacterisationTable()
    views: ViewsTable
    score: ScoreTable = ScoreTable()
    unknowns: UnknownsTable = UnknownsTable()
    measure: MeasureTable = MeasureTable()
    race: RaceTable = RaceTable()
    statement: StatementTable = StatementTable()
    exposure: ExposureTable | None = None
    set: SetTable | None = None
    check: CheckTable = CheckTable()


@dataclass(frozen=True)
class Study:
    """A study that has been read and found possible."""

    path: Path
    file: StudyFile
    scene: Scene
    task: Task
    sensor: Sensor
    candidates: Candidates
    campaign: Campaign | None
    performance_map: PerformanceMap | None

    @property
    def views(self) -> list[View]:
        """The candidates that can be had."""
        return self.candidates.views

    @property
    def unknowns(self) -> UnknownsTable:
        """What is not known: the study's own figures, the sensor's where it gives none, else the defaults."""
        return unknowns_of(self.sensor.unknowns, self.file.unknowns)


def read_study(path: str | Path, map_name: str | None = None, ask: Ask | None = None, mapped: bool = True) -> Study:
    """Read a study and all that it names.

    ``map_name`` is a map's file, or a sensor whose map comes with mitsim, to be used in place of what the study says;
    an empty one stands for the study's own map, or else that of its sensor, but for no campaign. ``ask`` answers
    whether finishes that the map does not know may be characterised now; None where nobody can be asked. Without
    ``mapped`` the map need not know them.

    Raises
    ------
    InputError
        For anything that would stop the study later: also a finish or standoff that is not characterised, an
        exposure that follows the scene, and views none of which can be had.
    """
    return open_study(path, read_toml(path, StudyFile), map_name, ask, mapped)


def open_study(
    path: str | Path, file: StudyFile, map_name: str | None = None, ask: Ask | None = None, mapped: bool = True
) -> Study:
    """Read all that a study names; ``path`` is where it was written, for errors and for the paths in it.

    Without ``mapped`` the map need not know the scene's finishes: its answers are not wanted.

    Raises
    ------
    InputError
        As :func:`read_study`.
    """
    path = Path(path)
    here = path.parent
    own_sensor = here / file.sensor if file.sensor.endswith(".toml") else file.sensor
    sensor = load_sensor(own_sensor)
    check_exposure(sensor)
    task = read_task(here / file.task)
    scene = load_scene(
        here / file.scene, sensor.wavelength_nm, {name: str(value) for name, value in file.parameters.items()}
    )
    check_features(task, here / file.task, scene.names)
    file = with_limits(path, file, task)
    radius = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2
    standoffs = chosen_standoffs(path, file.views, sensor, radius)
    campaign, performance_map = None, None
    if file.characterisation.campaign and map_name is None:
        near, far = sensor.working_range_mm
        around = [max(math.floor(standoffs[0] - radius), near), min(math.ceil(standoffs[-1] + radius), far)]
        campaign = read_campaign(here / file.characterisation.campaign, sensor, around)
        known = samples_of([(one.finish, one.roughness, one.light) for one in campaign.samples], "the campaign")
        distances = list(campaign.distances)
    else:
        own = file.characterisation.map or sensor.name
        if not map_name and not file.characterisation.map and sensor.name not in shipped_maps():
            raise InputError(
                path,
                "characterisation.map",
                f"none, and no map of {sensor.name} comes with mitsim",
                'map = "map.nc" in [characterisation], or campaign = a campaign that makes one first',
                f"mitsim characterise CAMPAIGN --sensor {own_sensor} -o FOLDER makes FOLDER/map.nc",
            )
        performance_map = read_map(map_name or own, sensor, "." if map_name else here)
        distances = performance_map.data["distance"].values.tolist()
        known = performance_map.known
    _check_finishes(path, scene, task, known)
    if campaign is not None:
        _check_campaign(scene, known)
    reach = characterised_range(path, file.views, sensor, standoffs, distances)
    candidates = candidate_views(file.views, sensor, standoffs, scene.centre, triangles(scene), reach, path)
    if performance_map is not None and mapped:
        stood = [view.standoff for view in candidates.views]
        depths = (min(stood) - radius, max(stood) + radius)
        wanted = Wanted(sensor, scene.where, seen_finishes(scene), depths)
        performance_map = answering_map(performance_map, wanted, ask)
    return Study(path, file, scene, task, sensor, candidates, campaign, performance_map)


def with_plan(study: Study, plan: bool) -> Study:
    """The study itself, or with ``plan`` one whose exposures are planned, if it says nothing of them."""
    if not plan or study.file.exposure is not None:
        return study
    return replace(study, file=study.file.model_copy(update={"exposure": ExposureTable()}))


def read_map(name: str | Path, sensor: Sensor, here: str | Path = ".") -> PerformanceMap:
    """The performance map of a sensor: a file, or one that comes with mitsim.

    Raises
    ------
    InputError
        If there is none, or it is of another sensor.
    """
    file = map_path(name, here)
    performance_map = with_lights(PerformanceMap.load(file))
    attributes = performance_map.data.attrs
    if (whose := str(attributes.get("sensor"))) != sensor.name:
        raise InputError(file, "sensor", whose, sensor.name, "a map predicts the sensor that it was made with")
    if attributes.get("sensor_checksum", sensor_checksum(sensor)) != sensor_checksum(sensor):
        say(f"{file} was made with another version of {sensor.name}: its numbers have changed since")
    return performance_map


def with_limits(path: str | Path, file: StudyFile, task: Task) -> StudyFile:
    """The study with the limits of its set: as written, or those that the tolerances of the task ask for.

    An error is taken as normal and without bias there.

    Raises
    ------
    InputError
        For a limit of a measurement that the task does not have, or no limit and no tolerance.
    """
    if file.set is None:
        return file
    for name in file.set.limits:
        if name not in task.measurements:
            raise InputError(path, f"set.limits.{name}", "no such measurement", ", ".join(task.measurements))
    if file.set.limits:
        return file
    tolerances = {name: tolerance_of(task, name) for name in task.measurements}
    limits = {name: needed(_NORMAL, one) for name, one in tolerances.items() if one is not None}
    if not limits:
        raise InputError(
            path,
            "set.limits",
            "none, and no tolerance in the task",
            "a limit of the uncertainty of one measurement at least, or a tolerance",
        )
    return file.model_copy(update={"set": file.set.model_copy(update={"limits": limits})})


def _check_finishes(path: Path, scene: Scene, task: Task, known: Samples) -> None:
    if MATT_WHITE.name not in known.names:
        raise InputError(
            path,
            "characterisation",
            "no matt_white sample",
            "a campaign that has one",
            "the view score's normalisers are taken on matt white",
        )
    for name, finish in zip(scene.names, scene.finishes, strict=True):
        # a lamp, or a fixture in a stock BSDF, hides and shades, and gives no predicted points
        if finish is None and name in task.shapes:
            raise InputError(
                scene.where,
                f"shape {name!r}",
                "a BSDF of no known finish",
                "machined_metal, gloss_paint, powder_coat or matt_white",
            )


def _check_campaign(scene: Scene, known: Samples) -> None:
    """Refuse a finish that a study's own campaign will not have characterised."""
    for name, finish in unknown_finishes(known, seen_finishes(scene)).items():
        raise InputError(
            scene.where,
            f"shape {name!r}",
            f"the finish {finish}",
            f"what the campaign has: {known.told()}",
            "add a sample to the campaign; or leave [characterisation] out: it is characterised when it is asked for",
        )
