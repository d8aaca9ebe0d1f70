"""Many captures of one scene: every view of a table with every finish, each in its own folder.

Signal chain: plan file, scene, sensor -> jobs (finish, view) with a seed each -> captures, in this process or on a
cluster -> a capture folder for each, written completely or not at all. A repeated command makes the missing captures.
The settings of an existing capture must have the digest of its job.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator

from characterisation.files.checked_files import read_json_object
from characterisation.files.documents import Document, read_toml
from characterisation.files.errors import InputError
from characterisation.words.progress import track
from characterisation.words.version import __version__
from mitsim.capture.folder import write_packed
from mitsim.capture.packed_files import packed
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.simulated.truth import true_images
from mitsim.maps.campaign.orders import prepared_sensor
from mitsim.running.executor import check_same_file
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.scene.surface.scatter import Deviation
from mitsim.scene.xml_check import named_digests
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.sensor.transforms import Transform
from mitsim.views import ViewsTable, candidate_views
from mitsim.views.standoffs import chosen_standoffs

#: pattern of partial folders of killed processes
_LEFT_OVER = ".view_*.partial-*"


class ManyFinish(Document):
    """One finish of the part: ``<default>`` values of the scene, and the deviation from its best estimate."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=100)]
    parameters: dict[str, str | float] = Field(default_factory=dict)
    deviation: str = ""


class ManyFile(Document):
    """A plan TOML of ``mitsim render --many``; ``captures`` pairs of view and finish are drawn, by default all."""

    views: ViewsTable
    finishes: list[ManyFinish] = Field(default=[ManyFinish(name="as_drawn")], min_length=1)
    captures: Annotated[int, Field(ge=1)] | None = None

    @field_validator("finishes")
    @classmethod
    def _named_once(cls, finishes: list[ManyFinish]) -> list[ManyFinish]:
        names = [finish.name for finish in finishes]
        if len(set(names)) < len(names):
            raise ValueError("different names, since each finish has a folder of its name")
        return finishes


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture. In those of all captures, a finish may replace ``parameters`` and ``deviation``."""

    parameters: Mapping[str, str]
    deviation: str
    seed: int
    samples: int
    depth: int
    noise: Noise
    truth: bool
    smoothing_px: float = 0.0


@dataclass(frozen=True)
class CaptureJob:
    """One capture as plain values, for any worker with this version of mitsim and access to the scene.

    ``origin`` is a digest of the sensor, the scene's XML and the files that it names.
    """

    sensor: Sensor
    scene: str
    finish: str
    view: int
    world_from_sensor: Transform
    settings: CaptureSettings
    origin: str

    @property
    def folder(self) -> Path:
        """Return its folder, relative to the output."""
        return Path(self.finish) / f"view_{self.view:04d}"

    def digest(self) -> str:
        """Return the SHA-256 of everything that determines the capture: its origin, and the values of the job."""
        settings = self.settings
        content = [
            __version__,
            self.origin,
            sorted(settings.parameters.items()),
            asdict(Deviation.parse(settings.deviation)),
            self.finish,
            self.view,
            self.world_from_sensor.matrix().round(9).tolist(),
            settings.seed,
            settings.samples,
            settings.depth,
            asdict(settings.noise),
            settings.truth,
        ]
        if settings.smoothing_px:
            content.append(settings.smoothing_px)
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_jobs(plan: str | Path, scene: str | Path, sensor: Sensor, common: CaptureSettings) -> list[CaptureJob]:
    """Return all jobs of a plan, finish by finish, views from the zenith down.

    Raises InputError if the plan or the scene is not valid with any of the finishes, or no view is possible.

    Parameters
    ----------
    plan, scene
        Files of the plan and of the scene.
    sensor
        The sensor that takes all captures.
    common
        Settings of all captures; each gets a seed of its own.
    """
    file = read_toml(plan, ManyFile)
    jobs: list[CaptureJob] = []
    for index, finish in enumerate(file.finishes):
        parameters = {**common.parameters, **{name: str(value) for name, value in finish.parameters.items()}}
        deviation = finish.deviation or common.deviation
        parsed = Deviation.parse(deviation, f"{plan}: finishes.{finish.name}")
        loaded = load_scene(scene, sensor.wavelength_nm, parameters, parsed)
        origin = origin_of(Path(scene), sensor, parameters)
        radius = float(np.linalg.norm(loaded.bounds[1] - loaded.bounds[0])) / 2
        standoffs = chosen_standoffs(plan, file.views, sensor, radius)
        candidates = candidate_views(file.views, sensor, standoffs, loaded.centre, triangles(loaded), where=plan)
        for view in candidates.views:
            (seed,) = np.random.SeedSequence([common.seed, index, view.number]).generate_state(1).tolist()
            settings = replace(common, parameters=parameters, deviation=deviation, seed=seed)
            where, pose = str(Path(scene).absolute()), view.world_from_sensor
            jobs.append(CaptureJob(sensor, where, finish.name, view.number, pose, settings, origin))
    if file.captures is None or file.captures >= len(jobs):
        return jobs
    drawn = np.random.default_rng(common.seed).choice(len(jobs), file.captures, replace=False)
    return [jobs[number] for number in sorted(drawn)]


def missing_jobs(jobs: Sequence[CaptureJob], output: str | Path) -> list[CaptureJob]:
    """Return the jobs without a finished folder, and remove partial folders of killed processes.

    Raises InputError if a folder holds the capture of another job.
    """
    output = Path(output)
    missing = []
    for job in jobs:
        folder = output / job.folder
        if not folder.exists():
            missing.append(job)
        elif digest_of(folder) != job.digest():
            raise InputError(
                folder,
                "",
                "a capture made of another scene, sensor or plan",
                "one of this plan, or none",
                "choose another folder with -o, or remove this one",
            )
    for finish in {job.finish for job in jobs}:
        for half in (output / finish).glob(_LEFT_OVER):
            shutil.rmtree(half, ignore_errors=True)
    return missing


def render_many(taken: Iterable[tuple[CaptureJob, dict[str, bytes]]], output: str | Path, total: int) -> None:
    """Write captures as they are finished, with a progress bar; each one completely or not at all."""
    for job, files in track(taken, "render", total):
        folder = Path(output) / job.folder
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_packed(files, folder)


def in_turn(jobs: Sequence[CaptureJob], simulated: SimulatedSensor) -> Iterator[tuple[CaptureJob, dict[str, bytes]]]:
    """Take captures in this process, one after another."""
    for job in jobs:
        yield job, _taken(job, simulated)


def take_job(job: CaptureJob) -> dict[str, bytes]:
    """Take and pack one capture; workers call this function. Packing takes time, but reduces the size to a fifth."""
    simulated = prepared_sensor(job.sensor).simulated
    return _taken(job, simulated)


def _taken(job: CaptureJob, simulated: SimulatedSensor) -> dict[str, bytes]:
    """Return the files of a capture's folder, on request with the truth of its cameras as OpenEXR."""
    settings, pose, parameters = job.settings, job.world_from_sensor, dict(sorted(job.settings.parameters.items()))
    seed, samples, deviation = settings.seed, settings.samples, Deviation.parse(settings.deviation)
    scene = _scene(job, parameters, deviation)
    rendering = Rendering.smoothed(samples, settings.depth, settings.smoothing_px)
    capture = simulated.capture(scene, pose, seed=seed, rendering=rendering, noise=settings.noise)
    capture.settings["deviation"] = asdict(deviation)
    about = {"scene": job.scene, "parameters": parameters, "finish": job.finish, "view": job.view}
    capture.settings["many"] = {"digest": job.digest(), **about}
    truth = (
        true_images(simulated, scene, pose, samples=samples, depth=settings.depth, seed=seed) if settings.truth else {}
    )
    return packed(capture, job.folder, truth=truth)


#: the last scene: jobs come finish by finish, and materials of scenes that are kept are part of every kernel
_scenes: dict[tuple[str, ...], Scene] = {}


def _scene(job: CaptureJob, parameters: dict[str, str], deviation: Deviation) -> Scene:
    """Return the scene of a job; it is kept while the files that it was made from are those of the next job."""
    key = (job.scene, job.origin, repr(parameters), repr(deviation))
    if key not in _scenes:
        check_same_file(job.scene, origin_of(Path(job.scene), job.sensor, parameters), job.origin)
        _scenes.clear()
        _scenes[key] = load_scene(job.scene, job.sensor.wavelength_nm, parameters, deviation)
    return _scenes[key]


def origin_of(scene: Path, sensor: Sensor, parameters: Mapping[str, str]) -> str:
    """Return the digest of a sensor, of a scene's XML, and of the files that the scene names with its parameters."""
    parts = [sensor_checksum(sensor).encode(), scene.read_bytes()]
    parts += [digest.encode() for digest in named_digests(scene, parameters)]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def digest_of(folder: Path, command: str = "many") -> Any:
    """Return the digest of the job whose capture a folder holds; None without a job of ``command``."""
    try:
        return read_json_object(folder / "settings.json")[command]["digest"]
    except (InputError, KeyError, TypeError):
        return None
