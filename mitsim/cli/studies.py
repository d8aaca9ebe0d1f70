"""Commands on a study: run, choose, score, state, exposures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from characterisation.files.atomic_io import write_json
from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options
from mitsim.running.time_limit import TimeLimit, ending_in_order, stopped_by_user

if TYPE_CHECKING:
    from characterisation.statements.statement import Statement
    from mitsim.study.run_document import ViewSetEntry


StudyFile = Annotated[Path, Argument(help="Study TOML file: part, task, sensor and views.")]
PlanExposures = Annotated[
    bool,
    Option(
        "--plan-exposures",
        help="Plan the exposures of the stated view (see `mitsim study exposures`), with the limits in [exposure] "
        "of the study. Views are screened and compared with the sensor's own exposure.",
    ),
]
RequireFit = Annotated[
    bool, Option("--require-fit", help="End with exit code 1 unless every tolerance and limit is kept.")
]
ViewNumber = Annotated[int, Option(min=0, help="Number of the view in scores.csv and poses/.")]


def run(
    study: StudyFile,
    output: options.Out,
    minutes: Annotated[
        float | None,
        Option(
            min=0.1,
            help="Time for the whole command [min], shared among screening, comparing views, statement and report; "
            "default: until the statement is settled or known well enough ([statement] of the study).",
        ),
    ] = None,
    plan: PlanExposures = False,
    require_fit: RequireFit = False,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 0,
    overwrite: options.Overwrite = False,
    yes: options.Yes = False,
    variant: options.Variant = None,
) -> None:
    """Run a study: screen all views, compare the best by virtual measurements, state the uncertainty, write a report.

    Screening predicts uncertainties from the performance map of the sensor. A virtual measurement renders, decodes and
    measures the part once, with random values of all unknown effects. For measurements that do not fit their
    tolerance, the last lines name the cheapest changes with which they do (spray, exposure, view, sensor and others).
    Exit code 1 if no view can make every measurement.

    Example: mitsim run scenes/two_pillars/study.toml -o runs/two_pillars
    """
    limit = TimeLimit(None if minutes is None else 60 * minutes)
    options.start(variant)
    from mitsim.report.page import write_report
    from mitsim.study import open_study, report_doubts, with_plan
    from mitsim.study.remedies.entries import remedies_in_words
    from mitsim.study.run import run_within
    from mitsim.study.run_folder import read_run

    options.check_folder(output)
    options.keep_finished(output, overwrite, "run.json")
    chosen = with_plan(open_study(study, ask=options.asking(yes)), plan)
    report_doubts(chosen)
    workers = options.requested_workers(scheduler, processes)
    with ending_in_order():
        stated = run_within(chosen, output, limit, workers, lambda: write_report(output))
        stopped = stopped_by_user()
    write_report(output)
    about = read_run(output).about
    say(f"scores: {output / 'scores.csv'}\nreport: {output / 'report.html'}")
    if about.lacks:
        say(f"after {limit.elapsed:.0f} s; not done: {'; '.join(about.lacks)}. The same command goes on")
    if stopped:
        raise KeyboardInterrupt  # exit code 130
    _tell_statement(stated, output, require_fit, about.leader, about.view_sets, remedies_in_words(about.remedies))


def choose(
    study: StudyFile,
    output: options.Out,
    sensors: Annotated[
        str,
        Option(
            help="all (presets), or presets and sensor files separated by commas; SENSOR=MAP uses a map of your own."
        ),
    ] = "all",
    minutes: Annotated[float, Option(min=0.1, help="Total time, shared among the sensors [min].")] = 10.0,
    plan: PlanExposures = False,
    require_fit: RequireFit = False,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 1,
    as_json: Annotated[bool, Option("--json", help="Print choice.json in place of the table.")] = False,
    overwrite: options.Overwrite = False,
    yes: options.Yes = False,
    variant: options.Variant = None,
) -> None:
    """Choose a sensor for a study: screen all sensors, and compare the promising ones by virtual measurements.

    Finished work is kept: run the same command again to continue. Exit code 1 if no sensor has a statement.

    Example: mitsim study choose scenes/two_pillars/tolerances.toml --sensors all -o runs/choice
    """
    limit = TimeLimit(60 * minutes)
    options.start(variant)

    from characterisation.statements.verdict_words import fits_all
    from mitsim.report.choice_page import write_choice_page
    from mitsim.study import report_doubts, with_plan
    from mitsim.study.choice_document import CHOICE, judged, read_choice
    from mitsim.study.choose import choose_sensor, read_candidates
    from mitsim.study.choose.sensor_result import SensorResult
    from mitsim.study.choose.table import as_text, document
    from mitsim.study.scene_geometry import write_scene_geometry

    options.check_folder(output)
    done = read_choice(output)
    if done is not None and done.finished:
        options.keep_finished(output, overwrite, CHOICE)
    ask = options.asking(yes, " (and likewise for every other sensor)")
    candidates, excluded = read_candidates(study, [sensors], ask)
    candidates = [replace(candidate, study=with_plan(candidate.study, plan)) for candidate in candidates]
    if done is not None and done.finished:
        (output / CHOICE).unlink()
    report_doubts(candidates[0].study)
    for exclusion in excluded:
        say(f"{exclusion.name} is excluded: {exclusion.reason}")
    if candidates[0].study.file.set is not None:
        say("[set] of the study is not used: sensors are compared by single views; `mitsim run` chooses the set")
    say(f"about {minutes:g} min for {len(candidates)} sensors: screening, then rounds of those that can still win")

    def report_results(results: list[SensorResult], finished: bool) -> None:
        choice = document(candidates[0].study, results, excluded, limit.elapsed, finished and not stopped_by_user())
        write_json(output / CHOICE, choice.model_dump(mode="json"))

    with ending_in_order():
        workers = options.requested_workers(scheduler, processes)
        results = choose_sensor(candidates, output, limit, report_results, workers)
        stopped = stopped_by_user()
    best = results[0].candidate.study
    write_scene_geometry(output, best.scene, best.sensor)
    write_choice_page(output)
    choice = read_choice(output)
    assert choice is not None
    print(json.dumps(choice.model_dump(mode="json"), indent=2) if as_json else as_text(choice))
    say(f"page: {output / 'choice.html'}")
    if not choice.finished and not stopped:
        more = "; with more --minutes, it screens more views" * any(sensor.lacks for sensor in choice.sensors)
        say(f"time was over after {limit.elapsed:.0f} s; the same command goes on{more}")
    say(choice.words)
    if stopped:
        raise KeyboardInterrupt  # exit code 130
    stated = [sensor for sensor in choice.sensors if sensor.status == "stated"]
    if not stated or (require_fit and not any(fits_all(judged(sensor_entry)) for sensor_entry in stated)):
        raise typer.Exit(1)


def state(
    study: StudyFile,
    output: options.Out,
    view: ViewNumber,
    minutes: Annotated[
        float | None,
        Option(
            min=0.1,
            help="Time for the whole command [min]; default: until every measurement is settled or known well enough "
            "([statement] of the study).",
        ),
    ] = None,
    plan: PlanExposures = False,
    require_fit: RequireFit = False,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 0,
    yes: options.Yes = False,
    variant: options.Variant = None,
) -> None:
    """State the uncertainty of every measurement from one view of a study, with a budget of its sources.

    The first Ctrl-C ends it with the statement so far, and the same command goes on from there.

    Example: mitsim study state scenes/two_pillars/study.toml --view 12 -o runs/view_12
    """
    limit = TimeLimit(None if minutes is None else 60 * minutes)
    options.start(variant)
    from mitsim.study import open_study, with_plan
    from mitsim.study.session import Session
    from mitsim.study.statement_document import statement_document

    options.check_folder(output)
    chosen = with_plan(open_study(study, ask=options.asking(yes)), plan)
    seen_from = chosen.view(view, "--view")
    session = Session(chosen, output, options.requested_workers(scheduler, processes))
    session.claim(f"budget of view {view}")
    with ending_in_order():
        stated = session.state(seen_from, None, limit)
        stopped = stopped_by_user()
    write_json(output / "statement.json", statement_document(session, stated))
    if stopped:
        raise KeyboardInterrupt  # exit code 130
    _tell_statement(stated.statements, output, require_fit)


def exposures(
    study: StudyFile,
    output: options.Out,
    view: ViewNumber,
    most: Annotated[
        int | None, Option(min=1, max=7, help="Largest number of exposures to merge; default: from the study.")
    ] = None,
    within: Annotated[
        float | None,
        Option(
            min=0.01,
            max=1,
            help="Fraction by which points and uncertainty may miss their limit; default: from the study.",
        ),
    ] = None,
    minutes: Annotated[
        float | None, Option(min=0.1, help="Time for the whole command [min]; default: until the plan is finished.")
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print exposures.json in place of the table.")] = False,
    variant: options.Variant = None,
) -> None:
    """Find the fewest exposures of one view with which every feature nearly reaches its least possible uncertainty.

    The limits of a feature are the most points and the smallest uncertainty that any exposures reach; --within says how
    near is enough. The command simulates the light once and decodes sets of exposures. If time ends, or with the first
    Ctrl-C, the plan is the best single exposure that was tried. Exit code 1 if a feature that the task needs has too
    few points at every exposure, or if a limit is not met.

    Example: mitsim study exposures scenes/two_pillars/study.toml --view 40 -o runs/exposures
    """
    limit = TimeLimit(None if minutes is None else 60 * minutes)
    options.start(variant)

    from mitsim.study import ExposureTable, open_study
    from mitsim.study.exposures import planned
    from mitsim.study.exposures.exposure_plan import PlanRules
    from mitsim.study.session import Session

    options.check_folder(output)
    chosen = open_study(study, mapped=False)  # the view is rendered
    shown = chosen.view(view, "--view")
    table = chosen.file.exposure or ExposureTable()
    rules = PlanRules(most or table.most, within or table.within)
    with ending_in_order():
        plan = planned.plan_view(planned.rendered(Session(chosen).measurements), shown, rules, limit)
        stopped = stopped_by_user()
    document = planned.plan_document(chosen, plan)
    write_json(output / "exposures.json", document)
    planned.write_plan_csv(output / "exposures.csv", plan)
    print(json.dumps(document, indent=2) if as_json else planned.plan_table(plan))
    say(f"plan: {output / 'exposures.json'}\n{planned.plan_in_words(plan)}")
    if stopped:
        raise KeyboardInterrupt  # exit code 130
    if plan.unseen or not plan.reached:
        raise typer.Exit(1)


def _tell_statement(
    stated: Sequence[Statement],
    output: Path,
    require_fit: bool,
    leader: int | None = None,
    sets: Sequence[ViewSetEntry] = (),
    remedies: Sequence[str] = (),
) -> None:
    """Print the statements, the result of the sets, and the changes with which the other measurements would fit.

    Exit with code 1 without a statement; with ``require_fit`` also if a tolerance or a limit of a set is not kept.
    """
    from characterisation.statements.verdict_words import Reason, fits_all, result_reasons
    from mitsim.report.set_words import with_sets
    from mitsim.study.statement_file import read_statement
    from mitsim.study.virtual.stated import judged, statement_table

    if not stated:
        leads = f"view {leader} leads, but time did not suffice for a statement of uncertainty"
        none = "no view can make every measurement: there is no statement"
        say(with_sets([Reason(none if leader is None else leads)], False, sets).words)
        raise typer.Exit(1)
    print(statement_table(stated))
    result = with_sets(result_reasons(judged(stated)), fits_all(judged(stated)), sets)
    say(f"statement: {output / 'statement.json'}\n{result.words}")
    document = read_statement(output / "statement.json")
    for doubt in document.doubts() if document else ():
        say(f"warning: {doubt}")
    if remedies:
        say("\n".join(["what would make it fit:", *(f"- {line}" for line in remedies)]))
    if require_fit and not result.good:
        raise typer.Exit(1)


def score(
    study: StudyFile,
    output: options.Out,
    top: Annotated[int, Option(min=1, max=10000, help="Number of views to print for each measurement.")] = 10,
    measurement: Annotated[list[str] | None, Option(help="Print only this measurement. Repeatable.")] = None,
    map_file: Annotated[
        str,
        Option(
            "--map",
            metavar="MAP",
            help="A map.nc file, or the name of a sensor whose map comes with mitsim; default: the map of the study.",
        ),
    ] = "",
    yes: options.Yes = False,
    variant: options.Variant = None,
) -> None:
    """Predict the uncertainty of every measurement from each candidate view, without rendering; print the best.

    Example: mitsim study score scenes/two_pillars/study.toml -o runs/scores
    """
    options.start(variant)
    from mitsim.report.best_views import best_views
    from mitsim.study import open_study, report_doubts
    from mitsim.study.scoring import score_study
    from mitsim.study.session import Session

    options.check_folder(output)
    chosen = open_study(study, performance_map=map_file, ask=options.asking(yes))
    report_doubts(chosen)
    for name in measurement or ():
        if name not in chosen.task.measurements:
            raise InputError("--measurement", "", name, ", ".join(chosen.task.measurements))
    session = Session(chosen, output)
    session.claim("score")
    scores, *_ = score_study(session)
    for name in measurement or chosen.task.measurements:
        print(best_views(scores, name, top, chosen.task.shapes_for(name)))
    say(f"scores: {output / 'scores.csv'}\nposes: {output / 'poses'}")
