"""Read a study and all files that it names, and check them before the first long step.

Signal chain: study TOML -> scene, task, sensor, and a performance map or the campaign that makes one -> candidate
views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from characterisation.files.checked_files import is_file
from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.samples import Samples
from characterisation.maps.shipped import map_path, shipped_maps
from characterisation.tasks.task_file import Task
from characterisation.tasks.task_reading import check_features, check_nominal_values, read_task
from characterisation.words.progress import say
from mitsim.maps.campaign.missing_finishes import (
    Ask,
    NeededFinishes,
    map_with_finishes,
    samples_of,
    seen_finishes,
    unknown_finishes,
)
from mitsim.maps.campaign.plan import Campaign, check_exposure, read_campaign
from mitsim.scene.authoring.check_task import report_geometry
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.materials import Finish
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.scene.surface.lay import lays_in_words
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.sensor.unknowns import LightUnknowns, UnknownsTable, unknowns_of
from mitsim.study.screened_errors import needed_by_tolerance
from mitsim.study.tables import CharacterisationTable, ExposureTable, StudyFile
from mitsim.views import Candidates, View, candidate_views
from mitsim.views.standoffs import characterised_range, chosen_standoffs
from mitsim.views.view_scores import MATT_WHITE

#: fewest points on a feature that allow a measurement
MINIMUM_POINTS = 100


@dataclass(frozen=True)
class Study:
    """A study that has been read and checked."""

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
        """Return the candidate views that the sensor can take."""
        return self.candidates.views

    def view(self, number: int, where: str = "view") -> View:
        """Return the candidate view with a number; ``where`` names the argument in the error.

        Raises
        ------
        InputError
            If the study has no such view.
        """
        by_number = {view.number: view for view in self.views}
        if number not in by_number:
            raise InputError(where, "", number, f"{min(by_number)} to {max(by_number)}, the views of this study")
        return by_number[number]

    @property
    def unknowns(self) -> UnknownsTable:
        """Return the unknowns: values of the study, else of the sensor, else the defaults.

        A sensor with the known light of its own room has no unknown room.
        """
        known = (
            UnknownsTable() if self.sensor.room is None else UnknownsTable(light=LightUnknowns(room=0, room_factor=1))
        )
        return unknowns_of(self.sensor.unknowns, self.file.unknowns, known)


def open_study(
    path: str | Path,
    file: StudyFile | None = None,
    *,
    performance_map: str | Path | None = None,
    ask: Ask | None = None,
    mapped: bool = True,
) -> Study:
    """Open a study TOML file with everything it names: part, task, sensor, map and candidate views.

    Parameters
    ----------
    path
        The file; the reference of file formats lists its keys.
    file
        Its content, if it is read already or changed; ``path`` is then the place for errors and relative paths.
    performance_map
        A ``map.nc``, or a sensor whose map is shipped with mitsim, instead of the study's own. ``""`` selects the
        study's own map, or that of its sensor if the study names a campaign.
    ask
        Called with a question if the map lacks a finish of the part; if it returns True, the finish is characterised
        immediately. None if nobody can answer.
    mapped
        Whether the map has to contain the finishes of the part; it need not if nobody queries it.

    Returns
    -------
    Study
        ``views``, each with its ``number``, ``world_from_sensor`` and ``standoff`` [mm]; ``scene``, ``task``,
        ``sensor`` and ``performance_map``.

    Raises
    ------
    InputError
        For anything that would stop the study later. Examples are a finish or standoff that is not characterised, an
        exposure that follows the scene, and candidate views none of which is possible.

    Examples
    --------
    >>> import mitsim as ms
    >>> study = ms.open_study("study.toml")
    >>> study.sensor.name, list(study.task.measurements)[:2]
    ('ensenso-n10', ['point1_point2_distance', 'plane_pillar1_angle'])
    >>> study.views[0].number
    0
    """
    if file is None:
        _check_study_file(Path(path))
        file = read_toml(path, StudyFile)
    if performance_map is not None:
        file = _with_map(file, performance_map)
    path = Path(path)
    folder = path.parent
    own_sensor = folder / file.sensor if file.sensor.lower().endswith(".toml") else file.sensor
    sensor = load_sensor(own_sensor)
    check_exposure(sensor)
    task = read_task(folder / file.task)
    scene = load_scene(
        folder / file.scene,
        sensor.wavelength_nm,
        {name: str(value) for name, value in file.parameters.items()},
        sprayed=file.sprayed,
    )
    check_features(task, folder / file.task, scene.names)
    check_nominal_values(task, folder / file.task)
    task = task.with_measured_features()  # a drawing has a hundred faces and a dozen dimensions
    file = _with_limits(path, file, task)
    radius = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2
    standoffs = chosen_standoffs(path, file.views, sensor, radius)
    campaign, chosen_map = None, None
    if file.characterisation.campaign:
        near, far = sensor.working_range_mm
        around = [max(math.floor(standoffs[0] - radius), near), min(math.ceil(standoffs[-1] + radius), far)]
        campaign = read_campaign(folder / file.characterisation.campaign, sensor, around)
        samples = samples_of(campaign.samples)
        distances = list(campaign.distances)
    else:
        map_name = file.characterisation.map or sensor.name
        if not file.characterisation.map and sensor.name not in shipped_maps():
            raise InputError(
                path,
                "characterisation.map",
                f"none, and no map of {sensor.name} comes with mitsim",
                'map = "map.nc" or campaign = "campaign.toml" in [characterisation]',
                f"mitsim map make CAMPAIGN --sensor {own_sensor} -o FOLDER writes FOLDER/map.nc",
            )
        chosen_map = read_map(map_name, sensor, folder)
        distances = chosen_map.data["distance"].values.tolist()
        samples = chosen_map.known
    _check_finishes(path, scene, task, samples)
    if campaign is not None:
        _check_campaign(scene, samples)
    reach = characterised_range(path, file.views, sensor, standoffs, distances)
    candidates = candidate_views(file.views, sensor, standoffs, scene.centre, triangles(scene), reach, path)
    if chosen_map is not None and mapped:
        view_distances = [view.standoff for view in candidates.views]
        depths = (min(view_distances) - radius, max(view_distances) + radius)
        rendered = file.measure.by != "map" and chosen_map.data.attrs.get("source") in (None, "", "simulated")
        measured = frozenset(task.shapes)
        wanted = NeededFinishes(sensor, scene.where, seen_finishes(scene), depths, measured, rendered)
        chosen_map = map_with_finishes(chosen_map, wanted, ask)
    return Study(path, file, scene, task, sensor, candidates, campaign, chosen_map)


def finishes_of_features(study: Study) -> dict[str, Finish | None]:
    """Return the finish of every feature of the task, None for a shape without one."""
    return {name: study.scene.finishes[study.scene.names.index(name)] for name in study.task.shapes}


def report_doubts(study: Study) -> None:
    """Report features whose machining marks have no direction, or that do not lie on the shapes of the scene."""
    report_geometry(study.task, study.scene)
    finishes = finishes_of_features(study)
    for sentence in lays_in_words({name: finish.scatter for name, finish in finishes.items() if finish is not None}):
        say(sentence)


def with_plan(study: Study, plan: bool) -> Study:
    """Return the study with planned exposures, if ``plan`` is true and the study has no [exposure]."""
    if not plan or study.file.exposure is not None:
        return study
    return replace(study, file=study.file.model_copy(update={"exposure": ExposureTable()}))


def read_map(name: str | Path, sensor: Sensor, folder: str | Path = ".") -> PerformanceMap:
    """Read the performance map of a sensor: a file, or a map that comes with mitsim.

    Raises InputError if there is no map, or it belongs to another sensor.
    """
    file = map_path(name, folder)
    performance_map = PerformanceMap.load(file)
    attributes = performance_map.data.attrs
    if (map_sensor := str(attributes.get("sensor"))) != sensor.name:
        raise InputError(file, "sensor", map_sensor, sensor.name, "a map holds for one sensor only")
    if attributes.get("sensor_checksum", sensor_checksum(sensor)) != sensor_checksum(sensor):
        say(f"{file} was made with another version of {sensor.name}, whose parameters have changed since")
    return performance_map


def _check_study_file(path: Path) -> None:
    """Refuse a folder, a scene, and a file that is missing beside a part without a study; say where a study is made."""
    missing = not path.exists()
    if path.is_file() and path.suffix.lower() != ".xml":
        return
    folder = path if path.is_dir() else path.parent
    studies = sorted(one.name for one in folder.glob("*.toml") if one.name != "task.toml") if folder.is_dir() else []
    if missing and (studies or not (folder / "task.toml").is_file()):
        return  # the reader names the nearest file
    hint = (
        f"there is {', '.join(studies[:3])}"
        if studies
        else "mitsim part SCENE.xml --edit writes study.toml once something is measured; or copy that of "
        "docs/how-to/your-own-part.md"
    )
    found = "no such file" if missing else "a folder" if path.is_dir() else "a scene"
    raise InputError(path, "", found, "a study TOML", hint)


def _with_map(file: StudyFile, performance_map: str | Path) -> StudyFile:
    """Return the study with a map for its campaign or map, by a path that holds for workers and in any folder."""
    name = str(Path(performance_map).resolve()) if is_file(Path(performance_map)) else str(performance_map)
    table = CharacterisationTable(map=name if str(performance_map) else file.characterisation.map)
    return file.model_copy(update={"characterisation": table})


def _with_limits(path: str | Path, file: StudyFile, task: Task) -> StudyFile:
    """Return the study with limits of its set; those from tolerances assume a normal error without bias."""
    if file.set is None:
        return file
    for name in file.set.limits:
        if name not in task.measurements:
            raise InputError(path, f"set.limits.{name}", "no such measurement", ", ".join(task.measurements))
    if file.set.limits:
        return file
    limits = needed_by_tolerance(task)
    if not limits:
        allowed = "a limit for at least one measurement, or a tolerance in the task"
        raise InputError(path, "set.limits", "none, and no tolerance in the task", allowed)
    return file.model_copy(update={"set": file.set.model_copy(update={"limits": limits})})


def _check_finishes(path: Path, scene: Scene, task: Task, samples: Samples) -> None:
    if MATT_WHITE.name not in samples.names:
        hint = "the view score is normalised by the values of matt white"
        raise InputError(path, "characterisation", "no matt_white sample", "a campaign that has one", hint)
    for name, finish in zip(scene.names, scene.finishes, strict=True):
        # lamps, and fixtures with a BSDF of Mitsuba, only hide and shade; they have no predicted points
        if finish is None and name in task.shapes:
            allowed = "machined_metal, gloss_paint, powder_coat or matt_white"
            raise InputError(scene.where, f"shape {name!r}", "a BSDF of no known finish", allowed)


def _check_campaign(scene: Scene, samples: Samples) -> None:
    """Reject a finish that the study's own campaign does not characterise."""
    for name, finish in unknown_finishes(samples, seen_finishes(scene)).items():
        raise InputError(
            scene.where,
            f"shape {name!r}",
            f"the finish {finish}",
            f"the finishes of the campaign: {samples.in_words()}",
            "add a sample to the campaign, or remove [characterisation]: mitsim then offers to characterise it",
        )
