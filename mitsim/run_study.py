"""Run a study: from the performance map to scored views, of which some are rendered and measured.

Signal chain: study -> performance map -> what every candidate view lets expect (:mod:`mitsim.score`) -> the fewest
views that do -> predicted clouds of the best -> some views rendered, decoded and measured -> ``scores.csv``,
``scores.nc``, ``poses/``, ``clouds/``, ``checks.nc``, ``run.json``.
"""

from __future__ import annotations

import os
import platform
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import xarray as xr
from scipy.spatial.transform import Rotation

import mitsim
from characterisation.cloud_files import write_ply
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud
from characterisation.scores.view_score import write_scores
from characterisation.scores.view_sets import ViewSet
from characterisation.tasks.measuring import InputQuantity, Measured, measure
from characterisation.whole_files import write_json, written_whole
from mitsim.campaign.run import run_campaign, write_netcdf
from mitsim.campaign.take import coupon_residuals, in_turn, simulated_source
from mitsim.capture.cloud import Geometry, capture_cloud, sensor_geometry
from mitsim.capture.folder import write_capture
from mitsim.capture.render_residual import RenderResidual, render_residual, told, worst_of
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor, performance
from mitsim.predict.interreflection import Interreflections
from mitsim.progress import say, track
from mitsim.scene.load import Scene
from mitsim.scene.triangles import triangles
from mitsim.score import choose_set, score_candidates
from mitsim.sensor.frames import Transform
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.views import View, tell_views

#: of every measurement, so many of the best views have their predicted cloud in the run folder
SHOWN = 3


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
    clock = _Clock()
    simulated = SimulatedSensor(study.sensor)
    geometry = sensor_geometry(study.sensor)
    residuals = [] if study.campaign is None else coupon_residuals(simulated, study.campaign)
    performance_map = _map(study, simulated, folder)
    clock.lap("characterise")

    predictor = Predictor.of_sensor(study.sensor, geometry)
    scores, chosen = score_study(study, predictor, performance_map, folder)
    clock.lap("score")
    checked = _pick(scores, study.file.check.views)
    _draw(
        study, predictor, performance_map, sorted({*checked, *_best(scores), *(chosen.views if chosen else ())}), folder
    )
    clock.lap("predict")
    residuals += [_residual(study, simulated, number) for number in checked[:1]]
    checks = _check(study, predictor, simulated, geometry, checked, folder)
    clock.lap("render and measure")
    write_netcdf(checks, folder / "checks.nc")
    write_json(folder / "run.json", _about(study, performance_map, checked, chosen, worst_of(residuals), clock))


def score_study(
    study: Study, predictor: Predictor, performance_map: PerformanceMap, folder: Path
) -> tuple[xr.Dataset, ViewSet | None]:  # fmt: skip
    """Score all views, choose a set if one is asked for, and write ``scores``, ``poses`` and ``part.ply``."""
    tell_views(folder / "poses", study.candidates, study.file.views, study.sensor.name)
    depth = study.file.score.light_path_depth
    scores, inputs = score_candidates(
        study.scene, study.task, study.views, predictor, performance_map, MINIMUM_POINTS,
        Interreflections(study.sensor, depth) if depth > 1 else None,
    )  # fmt: skip
    chosen = _chosen_set(study, inputs)
    write_scores(folder / "scores.csv", scores, pose_columns(scores), order="uncertainty_rank")
    write_netcdf(scores, folder / "scores.nc")
    with written_whole(folder / "part.ply") as file:
        corners = triangles(study.scene)
        mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=True)
        file.write_bytes(trimesh.exchange.ply.export_ply(mesh))
    return scores, chosen


def _chosen_set(study: Study, inputs: list[dict[InputQuantity, Any]]) -> ViewSet | None:
    table = study.file.set
    if table is None:
        return None
    chosen = choose_set(study.task, inputs, table.limits, table.least_chance, table.seconds)
    for (name, limit), reached in zip(table.limits.items(), chosen.feasible, strict=True):
        if not reached:
            say(f"{name}: {limit:g} {study.task.measurements[name].unit} is out of reach, even with all views together")
    how = "the fewest" if chosen.exact else "not proven the fewest"
    say(f"views that measure together: {', '.join(map(str, chosen.views)) or 'none'} ({how})")
    return chosen


def _best(scores: xr.Dataset) -> list[int]:
    """Numbers of the best views of every measurement, by predicted uncertainty and by V_m."""
    ranks = np.concatenate([scores["uncertainty_rank"].values, scores["rank"].values])
    able = np.concatenate([np.isfinite(scores["predicted_uncertainty"].values), scores["possible"].values])
    return sorted({int(view) for view in np.flatnonzero(((ranks <= SHOWN) & able).any(axis=0))})


def _draw(
    study: Study, predictor: Predictor, performance_map: PerformanceMap, numbers: list[int], folder: Path
) -> None:  # fmt: skip
    """Write a predicted cloud of some views."""
    for number in track(numbers, "predict clouds"):
        view = study.views[number]
        surfaces = predictor.surfaces(study.scene, view.world_from_sensor)
        labels, ideal = predictor.labels(study.scene, view.world_from_sensor, surfaces), predictor.ideal(surfaces)
        fraction, sigma = performance(ideal, study.scene, performance_map)
        rng = np.random.default_rng([study.file.seed, number])
        cloud = predictor.draw(study.scene, ideal, labels, fraction, sigma, rng)
        write_ply(cloud, folder / "clouds" / f"predicted_{number:04d}.ply")


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


def part_pose(view: View) -> np.ndarray:
    """``sensor_from_part`` (4, 4) of a view; the part frame is the scene's world."""
    return view.world_from_sensor.inverse().matrix()


def _pick(scores: xr.Dataset, count: int) -> list[int]:
    """Views to check: the best of every measurement, and others spread evenly over the mean rank down to the worst."""
    rank, possible = scores["uncertainty_rank"].values, np.isfinite(scores["predicted_uncertainty"].values)
    mean_rank = rank.mean(axis=0)
    useful = np.flatnonzero(possible.any(axis=0))
    order = useful[np.argsort(mean_rank[useful], kind="stable")]
    best = rank.argmin(axis=1)[possible.any(axis=1)]
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
    labels = predictor.labels(scene, world_from_sensor, predictor.surfaces(scene, world_from_sensor))
    return PointCloud(
        cloud.points, cloud.status, cloud.grid, cloud.sensor, cloud.source, cloud.baseline, labels, scene.names
    )


def pose_columns(scores: xr.Dataset) -> dict[str, np.ndarray]:
    """Columns of ``scores.csv`` beside those of the talk's score."""
    poses = scores["world_from_sensor"].values
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    names = ("uncertainty_rank", "predicted_uncertainty", "chance", "limit", "limiting_feature")
    out = {name: scores[name].values for name in names}
    out |= {name: scores[name].values for name in ("azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm")}
    out |= {f"position_{axis}_mm": poses[:, k, 3] for k, axis in enumerate("xyz")}
    return out | {f"quaternion_{axis}": turns[:, k] for k, axis in enumerate("xyzw")}


def _about(
    study: Study, performance_map: PerformanceMap, checked: list[int], chosen: ViewSet | None,
    residual: RenderResidual | None, clock: _Clock,
) -> dict[str, Any]:  # fmt: skip
    features = {name: str(study.scene.finishes[study.scene.names.index(name)]) for name in study.task.shapes}
    return {
        "schema_version": 1, "mitsim": mitsim.__version__, "study": str(study.path), "scene": study.scene.where,
        "sensor": study.sensor.name, "source": "simulated", "map_source": performance_map.data.attrs.get("source", ""),
        "exposure_rule": study.sensor.exposure.rule, "seed": study.file.seed, "views": len(study.views),
        "view_sets": [] if chosen is None else [_set_in_words(study, chosen)], "checked_views": checked,
        "check_repeats": study.file.check.repeats,
        "light_path_depth": study.file.check.light_path_depth,
        "score_light_path_depth": study.file.score.light_path_depth,
        "render_residual": None if residual is None else asdict(residual), "features": features,
        "measurements": {
            name: {"nominal": m.nominal, "unit": m.unit, "features": list(m.features)}
            for name, m in study.task.measurements.items()
        },
        "seconds": clock.steps, "python": platform.python_version(), "machine": platform.machine(),
        "cores": os.cpu_count(),
    }  # fmt: skip


def _set_in_words(study: Study, chosen: ViewSet) -> dict[str, Any]:
    assert study.file.set is not None
    limits = study.file.set.limits
    return {
        "limits": limits, "views": list(chosen.views), "exact": chosen.exact,
        "uncertainty": dict(zip(limits, chosen.uncertainty.tolist(), strict=True)),
        "feasible": dict(zip(limits, chosen.feasible.tolist(), strict=True)),
    }  # fmt: skip
