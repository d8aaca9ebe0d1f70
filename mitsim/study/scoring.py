"""Score all candidate views with the performance map, and choose the fewest views that keep limits of uncertainty.

Signal chain: study, map -> score of every view (:mod:`mitsim.study.virtual.screening`) -> fewest views that measure
together (:mod:`characterisation.scores.task_sets`) -> ``scores.csv``, ``scores.nc``, ``poses/``, ``part.ply``,
``task.json``. After a race, the scores have its ranks, and ``checks.nc`` its errors by trial.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import trimesh
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.atomic_io import atomic_write, write_json
from characterisation.maps.performance_map import PerformanceMap
from characterisation.scores.joining import pose_covariance
from characterisation.scores.task_sets import SetJoining, choose_set
from characterisation.scores.view_score import write_scores
from characterisation.scores.view_sets import ViewSet
from characterisation.tasks.measurement_model import InputQuantity
from characterisation.tasks.task_file import Task
from characterisation.words.numbers import two_digits
from characterisation.words.progress import say
from mitsim.maps.campaign.run import write_netcdf
from mitsim.running.time_limit import TimeLimit
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.study import SetTable, Study
from mitsim.study.run_files import TASK
from mitsim.study.scene_geometry import write_scene_geometry
from mitsim.study.screened_errors import stated_shares
from mitsim.study.session import Session
from mitsim.study.view_sets.confirmed_set import Search, joining_in_words
from mitsim.study.virtual.race import ALL, Raced
from mitsim.views import write_views
from mitsim.views.no_view import TOGETHER, apart_in_words


def score_study(
    session: Session, performance_map: PerformanceMap | None = None, limit: TimeLimit | None = None
) -> tuple[xr.Dataset, ViewSet | None, Search]:
    """Score all views, choose a set if the study asks for one, and write ``scores`` and the inputs.

    The map is by default that of the study. A ``limit`` of time bounds the number of views that are scored. Returns the
    scores, the set, and the function that finds a set for other limits.
    """
    study, folder = session.study, session.folder
    scores, inputs = session.screen(performance_map, limit)
    if apart := apart_in_words(scores):
        say(f"{apart}, by the map" + ("" if study.file.set else f". {TOGETHER}"))
    shares = stated_shares(study.task)
    search = partial(set_within, study, inputs, shares)
    chosen = _chosen_set(study, search)
    write_scores(folder / "scores.csv", scores, pose_columns(scores), order="uncertainty_rank")
    write_netcdf(scores, folder / "scores.nc")
    write_inputs(session)
    return scores, chosen, search


def write_raced(session: Session, scores: xr.Dataset, raced: Raced) -> xr.Dataset:
    """Write the scores with the results of a race, and the errors of its virtual measurements; return the scores."""
    folder, ranked = session.folder, with_race(scores, raced)
    write_scores(folder / "scores.csv", ranked, pose_columns(ranked), order="final_rank")
    write_netcdf(ranked, folder / "scores.nc")
    write_netcdf(raced_errors(raced, session.study.task), folder / "checks.nc")
    return ranked


def with_race(scores: xr.Dataset, raced: Raced) -> xr.Dataset:
    """Add ``measured_risk``, ``trials`` and ``final_rank`` (measurement, view): by risk, the rest as screened."""
    names = [str(name) for name in scores["measurement"].values]
    indices = {int(view): index for index, view in enumerate(scores["view"].values)}
    shape = (len(names), scores.sizes["view"])
    risk, count = np.full(shape, np.nan), np.zeros(shape, int)
    columns = [indices[int(view)] for view in raced.views]
    if columns:
        risk[:, columns] = [raced.standings[name].risk for name in names]
        count[:, columns] = (~np.isinf(raced.errors)).sum(axis=2)
    screened = scores["uncertainty_rank"].transpose("measurement", "view").values
    order = np.lexsort((screened, np.where(np.isfinite(risk), risk, np.inf)), axis=1)
    rank = np.empty(shape, int)
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(1, shape[1] + 1), shape), axis=1)
    by = ("measurement", "view")
    out = scores.copy()
    name = "root mean square error of virtual measurements over the square root of the share with a value"
    out["measured_risk"] = (by, risk, {"long_name": name, "units": "mm or deg"})
    out["trials"] = (by, count, {"long_name": "virtual measurements of the race", "units": "1"})
    out["final_rank"] = (by, rank, {"long_name": "rank by race, then by screening; 1 is best", "units": "1"})
    return out


def raced_errors(raced: Raced, task: Task) -> xr.Dataset:
    """Return the errors of the race (measurement, view, repeat), NaN without a value; the best view comes first.

    ``tried`` distinguishes a trial without a value from one that was not made.
    """
    order = np.argsort(raced.standings[ALL].risk, kind="stable") if len(raced.views) else np.empty(0, int)
    tried = ~np.isinf(raced.errors[:, order])
    errors = np.where(tried, raced.errors[:, order], np.nan)
    dims = ("measurement", "view", "repeat")
    nominal = np.array([measurement.nominal for measurement in task.measurements.values()])[:, None, None]
    return xr.Dataset(
        {
            "error": (dims, errors, {"units": "mm or deg"}),
            "value": (dims, errors + nominal, {"units": "mm or deg"}),
            "tried": (dims, tried.astype(np.int8), {"units": "1"}),
        },
        coords={"measurement": list(task.measurements), "view": raced.views[order]},
    )


def write_inputs(session: Session) -> None:
    """Write part, task and poses of a study into its folder, so that exports need no other file."""
    study, folder = session.study, session.folder
    write_views(folder / "poses", study.candidates, study.file.views, study.sensor.name)
    write_json(folder / TASK, study.task.model_dump(mode="json", exclude_unset=True, exclude_none=True))
    write_scene_geometry(folder, study.scene, study.sensor)
    with atomic_write(folder / "part.ply") as file:
        corners = triangles(study.scene)
        mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=True)
        file.write_bytes(trimesh.exchange.ply.export_ply(mesh))


def set_within(
    study: Study,
    inputs: list[dict[InputQuantity, Any]],
    shares: NDArray[np.float64],
    limits: dict[str, float],
    table: SetTable | None = None,
) -> ViewSet:
    """Return the fewest views that keep the limits according to the map.

    - ``study``: its task, its table ``set`` and the middle of its part.
    - ``inputs``: expected input quantities of every view.
    - ``shares``: (measurements,) of the task: stated over predicted standard uncertainty, from :func:`stated_shares`.
    - ``limits``: stated standard uncertainties by measurement, in its unit; so is the uncertainty of the set.
    - ``table``: how the views are joined, and how long to search; by default as the study says.
    """
    table = table or study.file.set or SetTable()
    joining = SetJoining(
        pose_covariance(*table.pose_known), np.asarray(study.scene.centre, float), table.joining == "best_fit"
    )
    share_of = dict(zip(study.task.measurements, shares.tolist(), strict=True))
    predicted = {name: limit / share_of[name] for name, limit in limits.items()}
    chosen = choose_set(study.task, inputs, predicted, table.least_chance, table.seconds, joining)
    return replace(chosen, uncertainty=chosen.uncertainty * [share_of[name] for name in limits])


def _chosen_set(study: Study, search: Search) -> ViewSet | None:
    table = study.file.set
    if table is None:
        return None
    chosen = search(table.limits)
    for (name, limit), reached in zip(table.limits.items(), chosen.feasible, strict=True):
        if not reached:
            say(f"{name}: {limit:g} {study.task.measurements[name].unit} is unreachable, even with all views together")
    proof = "the fewest" if chosen.exact else "not proven the fewest"
    say(
        f"views that measure together: {', '.join(map(str, chosen.views)) or 'none'} ({proof}), "
        f"{joining_in_words(table)}; the map predicts: {_expected(study, table.limits, chosen)}"
    )
    return chosen


def _expected(study: Study, limits: dict[str, float], chosen: ViewSet) -> str:
    """Like ``pillar1_radius u 0.36 of 0.5 mm``."""
    rows = zip(limits.items(), chosen.uncertainty.tolist(), chosen.feasible, strict=True)
    units = {name: study.task.measurements[name].unit for name in limits}
    parts = [f"{name} u {two_digits(u)} of {limit:g} {units[name]}" for (name, limit), u, able in rows if able]
    return ", ".join(parts) or "nothing"


def pose_columns(scores: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the columns of ``scores.csv`` that are not part of the talk's score."""
    poses = scores["world_from_sensor"].values
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)  # w >= 0
    names = ["uncertainty_rank", "predicted_uncertainty", "chance", "limit", "limiting_feature"]
    names += [name for name in ("final_rank", "measured_risk", "trials") if name in scores]
    out = {name: scores[name].values for name in names}
    out |= {name: scores[name].values for name in ("azimuth_deg", "elevation_deg", "roll_deg", "standoff_mm")}
    out |= {f"position_{axis}_mm": poses[:, k, 3] for k, axis in enumerate("xyz")}
    return out | {f"quaternion_{axis}": turns[:, k] for k, axis in enumerate("xyzw")}
