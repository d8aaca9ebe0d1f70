"""The talk in one command: every figure of its slides, made again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from characterisation.words.progress import say
from mitsim.cli import options
from mitsim.running.time_limit import TimeLimit, ending_in_order, stopped_by_user


def talk(
    context: typer.Context,
    file: Annotated[Path, Argument(metavar="TALK", help="Talk TOML file: sensor, samples, views.")],
    output: options.Out,
    kept: Annotated[bool, Option("--kept", help="Draw from kept results alone, of any version; make nothing.")] = False,
    fresh: Annotated[bool, Option("--fresh", help="Make again what comes with the talk file.")] = False,
    measured: Annotated[
        Path | None,
        Option(
            metavar="FOLDER",
            help="Real captures of the artefact: their errors replace the virtual measurements of their sample.",
        ),
    ] = None,
    minutes: Annotated[float | None, Option(min=0.1, help="Time for the whole command [min].")] = None,
    scheduler: options.Scheduler = None,
    processes: options.Processes = 1,
    variant: options.Variant = None,
) -> None:
    """Make every figure of the talk "Task Specific Viewpoint Optimisation" again, beside the claim of its slide.

    Results that come with the talk file are used while nothing that they depend on has changed. Others are made, and
    kept in the folder: run the same command again to continue. Exit code 1 if results are missing.

    Example: mitsim study talk scenes/talk/talk.toml -o runs/talk --processes 2
    """
    limit = TimeLimit(None if minutes is None else 60 * minutes)
    if kept:
        options.refuse_unused(context, "--kept", "only one of the two", "fresh", "minutes", "scheduler", "processes")
    options.start(variant)
    from mitsim.talk.make import make, missing_results
    from mitsim.talk.measured import measured_errors
    from mitsim.talk.page import write_talk
    from mitsim.talk.results import Results
    from mitsim.talk.talk_file import read_talk

    chosen = read_talk(file)
    options.check_folder(output)
    fallbacks = () if fresh else (chosen.folder / chosen.file.kept,)
    results = Results(output / "kept", fallbacks, any_version=kept)
    errors = {} if measured is None else measured_errors(chosen, measured)
    with ending_in_order():
        if kept:
            missing = missing_results(chosen, results, tuple(errors))
        else:
            workers = options.requested_workers(scheduler, processes)
            missing = make(chosen, results, output, workers, limit, tuple(errors))
        stopped = stopped_by_user()
    page = write_talk(chosen, results, output, missing, errors)
    say(f"page: {page}")
    if stopped:
        raise KeyboardInterrupt  # exit code 130
    if missing:
        say(f"{len(missing)} results are missing: {', '.join(missing[:8])}{', ...' if len(missing) > 8 else ''}")
        raise typer.Exit(1)
