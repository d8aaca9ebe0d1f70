"""A study: a part, a task, a sensor; from the scene to scored views and a report.

Signal chain: study TOML -> performance map (a campaign, or one made before) -> predicted cloud of every candidate view
-> features, measurements and view scores -> some views rendered, decoded and measured -> ``scores.csv``, ``run.json``,
``report.html``. Everything that a user can get wrong is read and checked before the first long step.
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr
from pydantic import Field, model_validator

import mitsim
from characterisation.cloud_files import write_ply
from characterisation.documents import Document, read_toml
from characterisation.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud
from characterisation.shipped_maps import map_path
from characterisation.tasks import Measured, Task, check_features, measure, read_task
from characterisation.view_score import score_views, view_statistics, write_scores
from characterisation.whole_files import written_whole
from mitsim.campaign.plan import Campaign, check_exposure, read_campaign
from mitsim.campaign.run import run_campaign, write_netcdf
from mitsim.campaign.take import coupon_residuals, in_turn, simulated_source
from mitsim.capture.cloud import Geometry, capture_cloud, sensor_geometry
from mitsim.capture.folder import write_capture
from mitsim.capture.render_residual import RenderResidual, render_residual, told, worst_of
from mitsim.capture.simulate import SimulatedSensor
from mitsim.errors import InputError
from mitsim.predict import Ideal, Predictor, feature_statistics, performance
from mitsim.progress import track
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.materials import Finish
from mitsim.scene.triangles import triangles
from mitsim.sensor.frames import Transform
from mitsim.sensor.preset import Sensor, load_sensor
from mitsim.views import Candidates, View, ViewsTable, candidate_views, tell_views
from mitsim.views.standoffs import characterised_range, chosen_standoffs

#: fewer points than this on a feature do not make a measurement
MINIMUM_POINTS = 100

MATT_WHITE = Finish("matt_white", float("nan"))


class CharacterisationTable(Document):
    """Where the performance map comes from: a campaign that is run, or a map that was made before.

    ``map`` is a file, or the name of a sensor whose map comes with mitsim.
    """

    campaign: str | None = None
    map: str | None = None

    @model_validator(mode="after")
    def _one(self) -> CharacterisationTable:
        if (self.campaign is None) == (self.map is None):
            raise ValueError("either campaign or map, and not both")
        return self


class CheckTable(Document):
    """Views that are also rendered, decoded and measured, to hold the prediction against."""

    views: int = Field(default=8, ge=0, le=10000)
    repeats: int = Field(default=4, ge=1, le=1000)
    samples_per_pixel: int = Field(default=16, ge=1, le=4096)
    light_path_depth: int = Field(default=3, ge=1, le=16)


class StudyFile(Document):
    """A study TOML file; paths in it are relative to it."""

    scene: str
    parameters: dict[str, str | float] = Field(default_factory=dict)
    task: str
    sensor: str
    seed: Annotated[int, Field(ge=0)] = 1
    characterisation: CharacterisationTable
    views: ViewsTable
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


def read_study(path: str | Path) -> Study:
    """Read a study and all that it names.

    Raises
    ------
    InputError
        For anything that would stop the study later: also a material, Ra or standoff that will not be characterised,
        an exposure that follows the scene, and views none of which can be had.
    """
    path = Path(path)
    file = read_toml(path, StudyFile)
    here = path.parent
    sensor = load_sensor(here / file.sensor if file.sensor.endswith(".toml") else file.sensor)
    check_exposure(sensor)
    task = read_task(here / file.task)
    scene = load_scene(
        here / file.scene, sensor.wavelength_nm, {name: str(value) for name, value in file.parameters.items()}
    )
    check_features(task, here / file.task, scene.names)
    radius = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2
    standoffs = chosen_standoffs(path, file.views, sensor, radius)
    campaign, performance_map = None, None
    if file.characterisation.campaign:
        near, far = sensor.working_range_mm
        around = [max(math.floor(standoffs[0] - radius), near), min(math.ceil(standoffs[-1] + radius), far)]
        campaign = read_campaign(here / file.characterisation.campaign, sensor, around)
        known = [Finish(s.finish, s.roughness) for s in campaign.samples]
        distances = list(campaign.distances)
    else:
        map_file = map_path(str(file.characterisation.map), here)
        performance_map = PerformanceMap.load(map_file)
        distances = performance_map.data["distance"].values.tolist()
        if (whose := str(performance_map.data.attrs.get("sensor"))) != sensor.name:
            raise InputError(map_file, "sensor", whose, sensor.name, "a map foretells the sensor that it was made with")
        known = [Finish(name, roughness) for name, roughness in performance_map.samples]
    _check_finishes(path, scene, task, known)
    known_mm = characterised_range(path, file.views, sensor, standoffs, distances)
    candidates = candidate_views(file.views, sensor, standoffs, scene.centre, triangles(scene), known_mm, path)
    return Study(path, file, scene, task, sensor, candidates, campaign, performance_map)


def _check_finishes(path: Path, scene: Scene, task: Task, known: Iterable[Finish]) -> None:
    by_name: dict[str, list[float]] = {}
    for one in known:
        by_name.setdefault(one.name, []).append(one.roughness)
    if MATT_WHITE.name not in by_name:
        raise InputError(path, "characterisation", "no matt_white sample", "a campaign that has one",
                         "the view score's normalisers are taken on matt white")  # fmt: skip
    for name, finish in zip(scene.names, scene.finishes, strict=True):
        if finish is None and name not in task.features:
            continue  # a lamp, or a fixture in a stock BSDF: it hides and shades, and gives no predicted points
        if finish is None:
            raise InputError(scene.where, f"shape {name!r}", "a BSDF of no known finish",
                             "machined_metal or matt_white: a map is looked up by finish and Ra")  # fmt: skip
        if finish.name not in by_name:
            allowed = f"{', '.join(sorted(by_name))}: what is characterised"
            raise InputError(scene.where, f"shape {name!r}", f"the finish {finish.name}", allowed)
        low, high = min(by_name[finish.name]), max(by_name[finish.name])
        if finish.roughness < low or finish.roughness > high:
            allowed = f"{low:g} to {high:g} um, the range that is characterised"
            raise InputError(scene.where, f"shape {name!r}: Ra", f"{finish.roughness:g} um", allowed)


class _Clock:
    """Wall time of the steps [s]."""

    def __init__(self) -> None:
        self.steps: dict[str, float] = {}
        self.last = time.monotonic()

    def lap(self, step: str) -> None:
        now = time.monotonic()
        self.steps[step], self.last = round(now - self.last, 2), now


def run_study(study: Study, folder: str | Path) -> None:
    """Run a study into a folder; what a former run of the same study finished there is used again."""
    folder = Path(folder)
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    (folder / "captures").mkdir(exist_ok=True)
    tell_views(folder / "poses", study.candidates, study.file.views, study.sensor.name)
    clock = _Clock()
    simulated = SimulatedSensor(study.sensor)
    geometry = sensor_geometry(study.sensor)
    residuals = [] if study.campaign is None else coupon_residuals(simulated, study.campaign)
    performance_map = _map(study, simulated, folder)
    clock.lap("characterise")

    predictor = Predictor(study.sensor.measuring_rig, geometry.grid, geometry.seen, study.sensor.name)
    scores = _score(study, predictor, performance_map, folder)
    clock.lap("predict and score")
    checked = _pick(scores, study.file.check.views)
    residuals += [_residual(study, simulated, number) for number in checked[:1]]
    checks = _check(study, predictor, simulated, geometry, checked, folder)
    clock.lap("render and measure")

    write_scores(folder / "scores.csv", scores, _pose_columns(study, scores))
    write_netcdf(scores, folder / "scores.nc")
    write_netcdf(checks, folder / "checks.nc")
    write_json(folder / "run.json", _about(study, performance_map, checked, worst_of(residuals), clock))


def _map(study: Study, simulated: SimulatedSensor, folder: Path) -> PerformanceMap:
    if study.performance_map is not None:
        study.performance_map.save(folder / "map.nc")
        return study.performance_map
    assert study.campaign is not None
    take = simulated_source(simulated, study.campaign.file.samples_per_pixel)
    return run_campaign(study.campaign, in_turn(take, study.campaign), folder)


def _residual(study: Study, simulated: SimulatedSensor, number: int) -> RenderResidual:
    """Of a view as it is checked, with its interreflections; it takes as long as three repeats."""
    table, pose = study.file.check, study.views[number].world_from_sensor
    return told(f"view {number}", render_residual(
        simulated, study.scene, pose, next(iter(study.sensor.rig.cameras)), samples=table.samples_per_pixel,
        depth=table.light_path_depth, seed=study.file.seed,
    ))  # fmt: skip


def _score(study: Study, predictor: Predictor, performance_map: PerformanceMap, folder: Path) -> xr.Dataset:
    """Predict every view, fit its features, measure it, and score it by the talk's score."""
    names = list(study.task.features)
    shapes = [study.scene.names.index(name) for name in names]
    alone = [study.scene.only(name) for name in names]
    rows: dict[str, list[Any]] = {key: [] for key in ("n", "sigma", "n_white", "sigma_white", "n_only")}
    predicted = []
    for view in track(study.views, "predict views"):
        surfaces = predictor.surfaces(study.scene, view.world_from_sensor)
        labels, ideal = predictor.labels(surfaces), predictor.ideal(surfaces)
        fraction, sigma = performance(ideal, study.scene, performance_map)
        white = performance(ideal, study.scene, performance_map, MATT_WHITE)
        n, mean_sigma = feature_statistics(ideal, labels, fraction, sigma, shapes)
        n_white, sigma_white = feature_statistics(ideal, labels, *white, shapes)
        rows["n"].append(n)
        rows["sigma"].append(mean_sigma)
        rows["n_white"].append(n_white)
        rows["sigma_white"].append(sigma_white)
        rows["n_only"].append([_white_points_alone(predictor, one, view, performance_map) for one in alone])
        cloud = predictor.draw(
            study.scene, ideal, labels, fraction, sigma, np.random.default_rng([study.file.seed, view.number])
        )
        predicted.append(measure(cloud, study.task, part_pose(view), MINIMUM_POINTS))
        write_ply(cloud, folder / "clouds" / f"predicted_{view.number:04d}.ply")
    statistics = view_statistics(names, rows["n"], rows["sigma"], rows["n_white"], rows["sigma_white"], rows["n_only"])
    scores = score_views(statistics, study.task, MINIMUM_POINTS)
    scores["mean_sigma"] = statistics["mean_sigma"]
    for field in ("value", "error", "standard_uncertainty"):
        values = [[getattr(one[m], field) for one in predicted] for m in study.task.measurements]
        units = {"long_name": f"{field} in the predicted cloud", "units": "mm or deg"}
        scores[f"predicted_{field}"] = (("measurement", "view"), values, units)
    return _with_poses(scores, study)


def _white_points_alone(
    predictor: Predictor, alone: Scene, view: View, performance_map: PerformanceMap
) -> float:  # fmt: skip
    """Expected points in matt white of one feature, were there nothing else of the part."""
    surfaces = predictor.surfaces(alone, view.world_from_sensor)
    ideal: Ideal = predictor.ideal(surfaces)
    fraction, sigma = performance(ideal, alone, performance_map, MATT_WHITE)
    return float(feature_statistics(ideal, predictor.labels(surfaces), fraction, sigma, [0])[0][0])


def part_pose(view: View) -> np.ndarray:
    """``sensor_from_part`` (4, 4) of a view; the part frame is the scene's world."""
    return view.world_from_sensor.inverse().matrix()


def _pick(scores: xr.Dataset, count: int) -> list[int]:
    """Views to check: the best of every measurement, and others spread evenly over the mean rank down to the worst."""
    mean_rank = scores["rank"].values.mean(axis=0)
    possible = scores["possible"].values
    useful = np.flatnonzero(possible.any(axis=0))
    order = useful[np.argsort(mean_rank[useful], kind="stable")]
    best = scores["rank"].values.argmin(axis=1)[possible.any(axis=1)]
    chosen = list(dict.fromkeys(best.tolist()))[:count]
    rest = [int(view) for view in order if view not in chosen]
    more = min(count - len(chosen), len(rest))
    chosen += [rest[place] for place in np.unique(np.rint(np.linspace(0, len(rest) - 1, more)).astype(int))]
    return sorted(chosen, key=lambda view: float(mean_rank[view]))


def _check(
    study: Study, predictor: Predictor, simulated: SimulatedSensor, geometry: Geometry, checked: list[int],
    folder: Path,
) -> xr.Dataset:  # fmt: skip
    """Render, decode and measure some views, several times with fresh noise."""
    table = study.file.check
    shape = (len(study.task.measurements), len(checked), table.repeats)
    values = {field: np.full(shape, np.nan) for field in ("value", "error", "standard_uncertainty")}
    jobs = [(i, number, repeat) for i, number in enumerate(checked) for repeat in range(table.repeats)]
    for i, number, repeat in track(jobs, "render and measure"):
        view = study.views[number]
        seed = int(np.random.SeedSequence([study.file.seed, 1, number, repeat]).generate_state(1)[0])
        capture = simulated.capture(
            study.scene, view.world_from_sensor, seed=seed, samples=table.samples_per_pixel,
            depth=table.light_path_depth,
        )  # fmt: skip
        cloud = label(
            capture_cloud(capture, study.sensor.settings, geometry, imager=study.sensor.imager),
            study.scene,
            view.world_from_sensor,
            predictor,
        )
        for m, measured in enumerate(measure(cloud, study.task, part_pose(view), MINIMUM_POINTS).values()):
            _store(values, (m, i, repeat), measured)
        if repeat == 0:
            write_capture(capture, folder / "captures" / f"view_{number:04d}", overwrite=True)
            write_ply(cloud, folder / "clouds" / f"rendered_{number:04d}.ply")
    dims = ("measurement", "view", "repeat")
    return xr.Dataset(
        {name: (dims, array, {"units": "mm or deg"}) for name, array in values.items()},
        coords={"measurement": list(study.task.measurements), "view": checked},
    )


def _store(values: dict[str, np.ndarray], place: tuple[int, int, int], measured: Measured) -> None:
    for field, array in values.items():
        array[place] = getattr(measured, field)


def label(cloud: PointCloud, scene: Scene, world_from_sensor: Transform, predictor: Predictor) -> PointCloud:
    """Give every pixel of a decoded cloud the feature that the part's geometry has there."""
    labels = predictor.labels(predictor.surfaces(scene, world_from_sensor))
    return PointCloud(
        cloud.points, cloud.status, cloud.grid, cloud.sensor, cloud.source, cloud.baseline, labels, scene.names
    )


def _with_poses(scores: xr.Dataset, study: Study) -> xr.Dataset:
    poses = np.stack([view.world_from_sensor.matrix() for view in study.views])
    scores["world_from_sensor"] = (("view", "i", "j"), poses, {"units": "mm", "long_name": "pose of the sensor"})
    scores["direction"] = (("view", "xyz"), np.stack([view.direction for view in study.views]), {"units": "1"})
    scores["roll_deg"] = (("view",), [view.roll_deg for view in study.views], {"units": "deg"})
    scores["elevation_deg"] = (("view",), [view.elevation_deg for view in study.views], {"units": "deg"})
    scores["azimuth_deg"] = (("view",), [view.azimuth_deg for view in study.views], {"units": "deg"})
    return scores


def _pose_columns(study: Study, scores: xr.Dataset) -> dict[str, np.ndarray]:
    from scipy.spatial.transform import Rotation

    poses = scores["world_from_sensor"].values
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    columns = {name: scores[f"predicted_{name}"].values for name in ("value", "error", "standard_uncertainty")}
    out = {f"predicted_{name}": values for name, values in columns.items()}
    out |= {"azimuth_deg": scores["azimuth_deg"].values, "elevation_deg": scores["elevation_deg"].values}
    out |= {"roll_deg": scores["roll_deg"].values, "standoff_mm": np.array([v.standoff for v in study.views])}
    out |= {f"position_{axis}_mm": poses[:, k, 3] for k, axis in enumerate("xyz")}
    return out | {f"quaternion_{axis}": turns[:, k] for k, axis in enumerate("xyzw")}


def _about(
    study: Study, performance_map: PerformanceMap, checked: list[int], residual: RenderResidual | None, clock: _Clock
) -> dict[str, Any]:
    features = {name: str(study.scene.finishes[study.scene.names.index(name)]) for name in study.task.features}
    return {
        "schema_version": 1, "mitsim": mitsim.__version__, "study": str(study.path), "scene": study.scene.where,
        "sensor": study.sensor.name, "source": "simulated", "map_source": performance_map.data.attrs.get("source", ""),
        "exposure_rule": study.sensor.exposure.rule, "seed": study.file.seed, "views": len(study.views),
        "checked_views": checked, "check_repeats": study.file.check.repeats,
        "light_path_depth": study.file.check.light_path_depth,
        "render_residual": None if residual is None else asdict(residual), "features": features,
        "measurements": {
            name: {"nominal": m.nominal, "unit": m.unit, "features": list(m.features)}
            for name, m in study.task.measurements.items()
        },
        "seconds": clock.steps, "python": platform.python_version(), "machine": platform.machine(),
        "cores": os.cpu_count(),
    }  # fmt: skip


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write JSON whole or not at all."""
    with written_whole(path) as file:
        file.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
