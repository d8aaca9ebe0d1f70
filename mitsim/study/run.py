"""Run a study: choose the best views with a performance map and virtual measurements, and state the uncertainty.

Signal chain: study -> performance map -> score of every candidate view (:mod:`mitsim.views.view_scores`), which screens
the views -> race of the promising views by virtual measurements (:mod:`mitsim.study.virtual.race`) -> statement of the
best view (:mod:`mitsim.study.virtual.stated`) -> predicted clouds, and images, of the best views -> ``scores.csv``,
``scores.nc``, ``poses/``, ``trials/``, ``checks.nc``, ``statement.json``, ``clouds/``, ``captures/``, ``run.json``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from characterisation.cloud_files import write_cloud
from characterisation.files.atomic_io import write_json
from characterisation.maps.performance_map import PerformanceMap
from characterisation.scores.view_sets import ViewSet
from characterisation.statements.statement import Statement
from characterisation.words.progress import say, track
from mitsim.capture.folder import write_capture
from mitsim.capture.simulated.render_residual import (
    LIMIT,
    RenderResidual,
    largest_residual,
    warn_above_limit,
)
from mitsim.maps.campaign.acquire import coupon_residuals, in_turn, simulated_source
from mitsim.maps.campaign.run import run_campaign
from mitsim.maps.prediction.faces_in_sight import faces_in_sight
from mitsim.running.executor import Executor, giving_up
from mitsim.running.time_limit import TimeLimit
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import Study
from mitsim.study.early_answers import Answers, StepTimes
from mitsim.study.remedies.change import Shortfall
from mitsim.study.remedies.confirm import Remedies, remedies_document
from mitsim.study.remedies.in_turn import seeks_remedies, state_and_mend
from mitsim.study.run_record import draw_clouds, lacking, write_record
from mitsim.study.scoring import score_study, write_raced
from mitsim.study.session import Session
from mitsim.study.statement_document import statement_document
from mitsim.study.time_plan import busyness, time_plan
from mitsim.study.view_sets.confirmed_set import (
    Search,
    TriedSet,
    confirmed_entry,
    confirmed_set,
    joining_in_words,
    set_table,
    tried_entries,
    write_set_csv,
)
from mitsim.study.virtual.plan import change_rendering, measured_by
from mitsim.study.virtual.race import ALL, Raced
from mitsim.study.virtual.rendered import RenderedMeasurements
from mitsim.study.virtual.stated import StatedView

#: number of best views per measurement whose predicted clouds are written to the run folder
SHOWN = 3

#: time of the render noise of a view, in pictures of it
_RESIDUAL_PICTURES = 8


def run_study(
    study: Study,
    folder: str | Path,
    minutes: float | None = None,
    workers: Executor | None = None,
) -> list[Statement]:
    """Run a study into a folder, and reuse results that an earlier run of the same study finished there.

    Parameters
    ----------
    study
        From :func:`mitsim.open_study`.
    folder
        Where scores, poses, trials, clouds and the statement are kept.
    minutes
        Time limit of the whole run [min]; by default the race and the statement end by their own rules.
    workers
        Processes or cluster that make the trials of the race and of the statement; by default this process makes them.

    Returns
    -------
    list of Statement
        The statement of every measurement from the best view; empty if no view allows every measurement, or time did
        not suffice for one.

    Examples
    --------
    >>> import mitsim as ms
    >>> stated = ms.run_study(ms.open_study("study.toml"), "run")  # doctest: +SKIP
    >>> stated[0].measurement, stated[0].standard_uncertainty  # doctest: +SKIP
    ('point1_point2_distance', 1.9)
    """
    return run_within(study, folder, TimeLimit(None if minutes is None else 60 * minutes), workers)


def run_within(
    study: Study,
    folder: str | Path,
    limit: TimeLimit,
    workers: Executor | None = None,
    report: Callable[[], object] | None = None,
) -> list[Statement]:
    """Run a study as :func:`run_study` within a time limit that may have begun before, and report early.

    Parameters
    ----------
    study, folder, workers
        As of :func:`run_study`.
    limit
        Time of the whole command.
    report
        Writes the report of the folder. Called for the first answer after :data:`FIRST_ANSWER_S`, and as it improves.
    """
    whole = None if limit.end is None else limit.end - limit.began
    plan = time_plan(whole or 0.0, len(study.views), seeks_remedies(study), measures_set(study))
    if whole is not None:
        say(plan.in_words())
    session, clock = Session(study, folder, workers), StepTimes()
    folder = session.folder
    session.claim("run")
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    (folder / "captures").mkdir(exist_ok=True)
    own, renderer = session.study.campaign, session.renderer
    residuals = [] if own is None or renderer is None else coupon_residuals(renderer.simulated, own)
    performance_map = _map(session)
    clock.lap("characterise")

    scores, chosen, search = score_study(session, performance_map, plan.screening_limit(limit))
    clock.lap("score")
    plan = replace(plan, busy=busyness(limit.elapsed))
    answers = Answers(session, performance_map, scores, plan, limit, clock, report)
    with giving_up(workers, lambda: answers.plan.closing(limit)):
        measured = _measure(answers, chosen, search)
    scores, leaders, stated = measured.scores, measured.leaders, measured.stated
    pictured = answers.plan.last_limit(limit)
    first = dict.fromkeys([*leaders, *(measured.chosen.views if measured.chosen else ()), *_best(scores)])
    drawn = sorted(draw_clouds(session, performance_map, list(first), pictured))
    renderer = session.renderer
    shown = leaders[: study.file.check.views] if renderer is not None else []
    if renderer is not None:
        began = time.monotonic()
        shown = _show(renderer, shown, folder, {} if stated is None else {leaders[0]: stated.planned}, pictured)
        picture_s = (time.monotonic() - began) / max(1, len(shown))
        residuals += [
            _residual(renderer, number) for number in shown[:1] if pictured.left > _RESIDUAL_PICTURES * picture_s
        ]
    clock.lap("pictures")
    largest = largest_residual(residuals)
    reported = leaders[:1] or _best(scores)[:1]
    in_sight = {
        name: share
        for number in reported
        for name, share in faces_in_sight(session.predictor, study.scene, study.view(number).world_from_sensor).items()
        if name in study.task.shapes
    }
    lacks = lacking(study, scores, measured.raced, stated, measured.tried, limit)
    write_record(
        session,
        performance_map,
        measured.raced,
        drawn,
        shown,
        stated=stated is not None,
        render_residual=None if largest is None else asdict(largest),
        faces_in_sight=in_sight,
        view_sets=[] if measured.chosen is None else [_set_record(study, measured.chosen, measured.tried)],
        remedies=None if measured.remedies is None else remedies_document(measured.remedies),
        seconds=clock.steps,
        lacks=lacks,
        finished=not lacks and not limit.over(),
    )
    return [] if stated is None else stated.statements


@dataclass(frozen=True)
class _Measured:
    """What virtual measurements of a run have given, and the scores with the results of the race."""

    scores: xr.Dataset
    raced: Raced
    stated: StatedView | None
    remedies: Remedies | None
    chosen: ViewSet | None
    tried: list[TriedSet]

    @property
    def leaders(self) -> list[int]:
        """Numbers of the leading views: for all measurements together, and for each."""
        return list(dict.fromkeys(self.raced.leaders().values()))


def _measure(answers: Answers, chosen: ViewSet | None, search: Search) -> _Measured:
    """Race the views of a scored study, state the best, look for changes that fit, and measure a set of views."""
    session, limit, clock = answers.session, answers.limit, answers.clock
    study, scores = session.study, answers.scores
    minutes_of_race = study.file.race.minutes
    race_limit = TimeLimit(minutes_of_race and 60 * minutes_of_race)
    if limit.end is not None:
        race_limit = min(race_limit, answers.plan.race_limit(limit), key=lambda each: each.left)
    raced = session.race(scores, None, race_limit, answers.improve)
    scores = write_raced(session, scores, raced)
    clock.lap("race")
    plan = answers.plan
    leader = raced.leader(ALL) if len(raced.views) else None
    stated, rest_limit = None, plan.rest_limit(limit)
    if leader is not None and (not plan.closing(limit) or session.trials.known(leader)):  # a trial may take minutes
        stated = session.state(
            study.view(leader),
            None,
            plan.statement_limit(limit),
            lambda stated_view: answers.improve(raced, stated_view),
        )
        stated = stated if len(stated.statements) and stated.statements[0].trials else None
    if stated is not None:
        write_json(session.folder / "statement.json", statement_document(session, stated))
    clock.lap("state")
    remedies = None
    if stated is not None and not limit.over():
        now = Shortfall(session, stated, scores, raced, search)
        stated, remedies = state_and_mend(session, now, rest_limit, clock)
    tried = [] if limit.over() else _confirm(session, chosen, search, plan.last_limit(limit))
    clock.lap("confirm")
    return _Measured(scores, raced, stated, remedies, tried[-1].chosen if tried else chosen, tried)


def measures_set(study: Study) -> bool:
    """Return whether a run measures a set of views virtually: the study asks for it, and renders its trials."""
    return study.file.set is not None and study.file.set.trials >= 2 and measured_by(study) == "render"


def _confirm(session: Session, chosen: ViewSet | None, search: Search, limit: TimeLimit) -> list[TriedSet]:
    """Measure sets of views virtually, if there are any, until one keeps its limits; the best set comes last."""
    table = session.study.file.set
    if table is None or chosen is None or not chosen.views or table.trials < 2:
        return []
    if session.renderer is None:
        say("the set of views is not confirmed: clouds drawn from a map cannot be joined")
        return []
    tried = confirmed_set(session, chosen, search, limit.over)
    if not tried:
        say("the set of views is not confirmed: time is over")
        return []
    best = tried[-1]
    write_set_csv(session.folder / "view_set.csv", table, best)
    kept = "keeps its limits" if best.excess(table.limits) <= 1 else "the best set found, misses a limit"
    views = ", ".join(map(str, best.chosen.views))
    say(
        f"{len(best.chosen.views)} views ({views}), {joining_in_words(table)}, measured together {best.trials} times: "
        f"{kept} (sets measured: {len(tried)})\n"
        f"{set_table(table, best)}"
    )
    return tried


def _best(scores: xr.Dataset) -> list[int]:
    """Return the numbers of the best views of every measurement, by predicted risk and by V_m."""
    ranks = np.concatenate([scores["uncertainty_rank"].values, scores["rank"].values])
    able = np.concatenate([np.isfinite(scores["predicted_uncertainty"].values), scores["possible"].values])
    return sorted({int(view) for view in np.flatnonzero(((ranks <= SHOWN) & able).any(axis=0))})


def _map(session: Session) -> PerformanceMap:
    """Return the map of a study, made now if it has a campaign."""
    study, folder, renderer = session.study, session.folder, session.renderer
    if study.performance_map is not None:
        study.performance_map.save(folder / "map.nc")
        return study.performance_map
    assert study.campaign is not None and renderer is not None
    take = simulated_source(renderer.simulated, study.campaign.file.samples_per_pixel)
    return run_campaign(study.campaign, in_turn(take, study.campaign), folder)


def _residual(renderer: RenderedMeasurements, number: int) -> RenderResidual:
    """Return the render noise of the trials of a view."""
    residual = renderer.residual(renderer.study.view(number))
    if residual.quadrature > max(LIMIT, residual.noise):  # below the noise it is not determined
        return warn_above_limit(f"view {number}", residual)
    if residual.noise > LIMIT:
        say(f"view {number}: {residual}")
    return residual


def _show(
    renderer: RenderedMeasurements,
    numbers: list[int],
    folder: Path,
    planned: dict[int, PlannedExposure | None],
    limit: TimeLimit,
) -> list[int]:
    """Write image and cloud of views, with best estimates of all unknowns, within a limit; return those written.

    Pictures need no more light paths than a change that a remedy tries.
    """
    renderer, shown = renderer.rendered_as(change_rendering(renderer.study)), []
    for number in track(numbers, "render pictures"):
        if limit.over():
            break
        capture, cloud = renderer.exposed_as(planned.get(number)).at_best_estimates(renderer.study.view(number))
        write_capture(capture, folder / "captures" / f"view_{number:04d}", overwrite=True)
        write_cloud(cloud, folder / "clouds" / f"rendered_{number:04d}.ply")
        shown.append(number)
    return shown


def _set_record(study: Study, chosen: ViewSet, tried: list[TriedSet]) -> dict[str, Any]:
    table = study.file.set
    assert table is not None
    limits, pose_sigma = table.limits, table.pose_known
    return {
        "limits": limits,
        "views": list(chosen.views),
        "exact": chosen.exact,
        "uncertainty": dict(zip(limits, chosen.uncertainty.tolist(), strict=True)),
        "feasible": dict(zip(limits, chosen.feasible.tolist(), strict=True)),
        "joining": {"kind": table.joining, "position_mm": pose_sigma[0], "angle_deg": pose_sigma[1]},
        "joined": joining_in_words(table),
        "confirmed": confirmed_entry(tried[-1].stated if tried else ()),
        "tried": tried_entries(tried, limits),
    }
