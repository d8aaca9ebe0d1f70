"""Run a study, and write its report."""

from __future__ import annotations

from pathlib import Path

from mitsim.commands.options import Out, Variant, check_folder, start


def run(study: Path, output: Out, variant: Variant = None) -> None:
    """Run a study: characterise, predict, score, check by rendering, report.

    Example: mitsim run scenes/two_pillars/study.toml -o runs/two_pillars
    """
    start(variant)
    from mitsim.progress import say
    from mitsim.report.page import write_report
    from mitsim.study import read_study, run_study

    check_folder(output)
    run_study(read_study(study), output)
    write_report(output)
    say(f"scores: {output / 'scores.csv'}\nreport: {output / 'report.html'}")


def report(folder: Path) -> None:
    """Write the report of a finished run again: one self-contained page.

    Example: mitsim report runs/two_pillars
    """
    from mitsim.progress import say
    from mitsim.report.page import write_report

    say(f"report: {write_report(folder)}")
