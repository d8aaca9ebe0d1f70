"""Run a study, and write its report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.commands.options import Out, Variant, check_folder, start
from mitsim.errors import InputError


def run(study: Path, output: Out, variant: Variant = None) -> None:
    """Run a study: characterise, predict, score, check by rendering, report.

    Example: mitsim run scenes/two_pillars/study.toml -o runs/two_pillars
    """
    start(variant)
    from mitsim.progress import say
    from mitsim.report.page import write_report
    from mitsim.run_study import run_study
    from mitsim.study import read_study

    check_folder(output)
    run_study(read_study(study), output)
    write_report(output)
    say(f"scores: {output / 'scores.csv'}\nreport: {output / 'report.html'}")


def score(
    study: Path, output: Out,
    top: Annotated[int, typer.Option(min=1, max=10000, help="Views that are printed of each measurement.")] = 10,
    measurement: Annotated[list[str] | None, typer.Option(help="Print only this one. May be repeated.")] = None,
    map_file: Annotated[str, typer.Option(
        "--map", help="A map.nc, or a sensor whose map comes with mitsim; if left out, the study's, or its sensor's."
    )] = "",
    variant: Variant = None,
) -> None:  # fmt: skip
    """Score the views of a study by what they let expect, and print the best; nothing is rendered.

    Example: mitsim score scenes/two_pillars/study.toml -o runs/scores
    """
    start(variant)
    from mitsim.capture.cloud import sensor_geometry
    from mitsim.predict import Predictor
    from mitsim.progress import say
    from mitsim.report.best_views import best_views
    from mitsim.run_study import score_study
    from mitsim.study import read_study

    check_folder(output)
    chosen = read_study(study, map_file)
    for name in measurement or ():
        if name not in chosen.task.measurements:
            raise InputError("--measurement", "", name, ", ".join(chosen.task.measurements))
    assert chosen.performance_map is not None
    geometry = sensor_geometry(chosen.sensor)
    predictor = Predictor.of_sensor(chosen.sensor, geometry)
    scores, _ = score_study(chosen, predictor, chosen.performance_map, output)
    for name in measurement or chosen.task.measurements:
        print(best_views(scores, name, top))
    say(f"scores: {output / 'scores.csv'}\nposes: {output / 'poses'}")


def report(folder: Path) -> None:
    """Write the report of a finished run again: one self-contained page.

    Example: mitsim report runs/two_pillars
    """
    from mitsim.progress import say
    from mitsim.report.page import write_report

    say(f"report: {write_report(folder)}")
