"""Write the record of a run into its folder: ``run.json``, and the predicted clouds of its views.

``mitsim run`` writes them for its study, ``mitsim study choose`` for the sensor that measures best.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import xarray as xr

from characterisation.cloud_files import write_cloud
from characterisation.files.atomic_io import write_json
from characterisation.maps.performance_map import PerformanceMap
from characterisation.words.progress import track
from characterisation.words.version import __version__
from mitsim.maps.prediction import performance
from mitsim.running.time_limit import TimeLimit, stopped_by_user
from mitsim.scene.surface.lay import lay_left_out
from mitsim.study import Study, finishes_of_features
from mitsim.study.run_files import TASK, digests_of
from mitsim.study.scoring import write_inputs, write_raced
from mitsim.study.session import Session
from mitsim.study.view_sets.confirmed_set import TriedSet
from mitsim.study.virtual.race import ALL, Raced, in_words
from mitsim.study.virtual.stated import StatedView, compared
from mitsim.views.scoring_time import not_scored_in_words

#: number of runners-up in the record of a run
RUNNERS_UP = 5


def draw_clouds(
    session: Session, performance_map: PerformanceMap, numbers: list[int], limit: TimeLimit | None = None
) -> list[int]:
    """Write a predicted cloud of each of some views, and return the numbers of those written.

    ``session``, ``performance_map``: the study with its folder, and the map that the clouds are drawn from.
    ``numbers``: of the views, the most important first. ``limit``: time of all but the first, which is written in any
    case; none by default.
    """
    study, predictor, drawn = session.study, session.predictor, list[int]()
    for number in track(numbers, "predict clouds"):
        if drawn and limit is not None and limit.over():
            break
        drawn.append(number)
        pose = study.view(number).world_from_sensor
        surfaces = predictor.surfaces(study.scene, pose)
        labels, ideal = predictor.labels(study.scene, pose, surfaces), predictor.ideal(surfaces)
        fraction, sigma = performance(ideal, study.scene, performance_map)
        rng = np.random.default_rng([study.file.seed, number])
        cloud = predictor.draw(study.scene, ideal, labels, fraction, sigma, rng)
        write_cloud(cloud, session.folder / "clouds" / f"predicted_{number:04d}.ply")
    return drawn


def _runners_up(session: Session, raced: Raced) -> list[dict[str, Any]]:
    """Return the views that come next for all measurements together, best first, relative to the leading view.

    ``ratio`` is the risk by the race over the leader's; ``near`` the probability of being the best or within the margin
    of it; ``stated_ratio`` that of root mean square errors of statements, where trials for one exist, else None.
    """
    if not len(raced.views):
        return []
    standing, trials = raced.standings[ALL], (~np.isinf(raced.errors[0])).sum(axis=1)
    order = [int(v) for v in np.argsort(standing.risk, kind="stable") if v != standing.leader][:RUNNERS_UP]
    out = []
    for v in order:
        number = int(raced.views[v])
        stated = compared(session.study, session.trials, number, raced.leader(ALL))
        out.append(
            {
                "view": number,
                "ratio": float(standing.risk[v] / standing.risk[standing.leader]),
                "near": float(standing.near[v]),
                "trials": int(trials[v]),
                "stated_ratio": stated,
            }
        )
    return out


def write_record(
    session: Session,
    performance_map: PerformanceMap,
    raced: Raced,
    drawn: list[int],
    shown: list[int],
    *,
    stated: bool,
    **more: Any,
) -> None:
    """Write ``run.json``, with the digests of the files that a report or an export of the run reads.

    The index of a capture has the digests of its other files.

    - ``session``: session of the study, with the folder.
    - ``performance_map``: map that screened the views.
    - ``raced``: race of the promising views.
    - ``drawn``: numbers of the views with a predicted cloud.
    - ``shown``: numbers of the views with images and a decoded cloud.
    - ``stated``: whether the run has a statement.
    - ``more``: other entries, and other values of those that this function writes.
    """
    study = session.study
    finishes = finishes_of_features(study)
    lays = {name: lay_left_out(finish.scatter) for name, finish in finishes.items() if finish is not None}
    about = {
        "schema_version": 1,
        "mitsim": __version__,
        "date": datetime.now(UTC).astimezone().date().isoformat(),
        "study": str(study.path),
        "scene": study.scene.where,
        "sensor": study.sensor.name,
        "source": "simulated",
        "map_source": performance_map.data.attrs.get("source", ""),
        "exposure_rule": study.sensor.exposure.rule,
        "seed": study.file.seed,
        "views": len(study.views),
        "view_sets": [],
        "checked_views": shown,
        "raced_views": len(raced.views),
        "race_trials": raced.trials,
        "race_decided": raced.decided,
        "race_margin": raced.margin,
        "finished": True,
        "lacks": [],
        "leaders": raced.leaders(),
        "confidence": {name: standing.confidence for name, standing in raced.standings.items()},
        "losses": {name: standing.loss for name, standing in raced.standings.items()},
        "light_path_depth": study.file.measure.light_path_depth,
        "score_light_path_depth": study.file.score.light_path_depth,
        "render_residual": None,
        "features": {name: str(finish) for name, finish in finishes.items()},
        "lay": {name: left_out for name, left_out in lays.items() if left_out is not None},
        "measurements": {
            name: {key: getattr(measurement, key) for key in ("kind", "nominal", "unit", "features", "tolerance")}
            | {"shapes": list(study.task.shapes_for(name))}
            for name, measurement in study.task.measurements.items()
        },
        "seconds": {},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
    }
    names = ["map.nc", "scores.csv", "scores.nc", "checks.nc", "part.ply", "stand.npz", TASK, "poses/poses.json"]
    names += ["samples.nc"] if study.campaign is not None else []
    names += ["statement.json"] if stated else []
    names += [f"clouds/predicted_{view:04d}.ply" for view in drawn]
    names += [f"clouds/rendered_{view:04d}.ply" for view in shown]
    names += [f"captures/view_{view:04d}/capture.json" for view in shown]
    about |= more | {"runners_up": _runners_up(session, raced), "files": digests_of(session.folder, names)}
    write_json(session.folder / "run.json", about)


def complete_winner(session: Session, scores: xr.Dataset, raced: Raced, leaders: dict[str, int]) -> None:
    """Write everything of a run into the folder of a sensor that has its statement; ``run.json`` last.

    ``session``: the sensor's, with the folder. ``scores``: scores of all views by screening. ``raced``: race of the
    promising views. ``leaders``: best view of every measurement, and of all measurements.
    """
    folder, performance_map = session.folder, session.study.performance_map
    assert performance_map is not None  # sensors are screened with a map
    (folder / "run.json").unlink(missing_ok=True)
    (folder / "clouds").mkdir(exist_ok=True)
    performance_map.save(folder / "map.nc")
    write_inputs(session)
    write_raced(session, scores, raced)
    drawn = sorted(set(leaders.values()))
    draw_clouds(session, performance_map, drawn)
    lacks = list(filter(None, [not_scored_in_words(scores)]))
    write_record(session, performance_map, raced, drawn, [], stated=True, leaders=leaders, lacks=lacks)


def lacking(
    study: Study,
    scores: xr.Dataset,
    raced: Raced,
    stated: StatedView | None,
    tried: Sequence[TriedSet],
    limit: TimeLimit,
) -> list[str]:
    """Return what a run with a limit has not done, each in a few words; nothing for a run that ended by its own rules.

    Parameters
    ----------
    study
        Study of the run.
    scores, raced, stated, tried
        Results of screening, race and statement, and sets of views that were measured, the best last.
    limit
        Time of the run.
    """
    out = list[str]()
    if not limit.over() and limit.end is None:
        return out
    out += filter(None, [not_scored_in_words(scores)])
    if len(raced.views) and not raced.decided:
        raced_by = f"{raced.trials} trial{'s' if raced.trials > 1 else ''}"
        out.append(
            f"views compared by {raced_by}: view {raced.leader(ALL)} leads, "
            f"{in_words(raced.standings[ALL], raced.margin)}"
        )
    if len(raced.views) and stated is None:
        out.append("no statement of uncertainty")
    elif stated is not None:
        open_ones = [statement.measurement for statement in stated.statements if not statement.settled]
        if open_ones:
            trials = stated.statements[0].trials
            by = f"{trials} trial{'s' if trials > 1 else ''}"
            out.append(f"statement from {by}: {len(open_ones)} of {len(stated.statements)} not settled")
        if not any(statement.budget for statement in stated.statements):
            out.append("no budget")
    if study.file.set is not None and tried and tried[-1].trials < study.file.set.trials:
        out.append(f"set of views: {tried[-1].trials} of {study.file.set.trials} trials")
    if limit.over():
        out.append("pictures" if not stopped_by_user() else "stopped by the user")
    return out
