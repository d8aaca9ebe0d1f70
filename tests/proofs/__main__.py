"""Prove what mitsim states on cases of parts, sensors and finishes: ``python -m tests.proofs NAME CASES -o DIR``.

The commands work in a checkout with the packages of ``mitsim[test]``. They take hours for all cases, keep every virtual
measurement, and continue where they were stopped.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from characterisation.files.errors import InputError
from mitsim.cli.options import Group, Out, Processes, Scheduler, Variant, check_folder, requested_workers, start
from mitsim.cli.program import run_application

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Compare statements, scores, maps and losses with independent virtual measurements.",
)


def scores(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors and finishes.")],
    output: Out,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Evaluate only cases whose name PART__SENSOR__FINISH contains this text. Repeatable."),
    ] = None,
    scheduler: Scheduler = None,
    processes: Processes = 1,
    variant: Variant = None,
) -> None:
    """Compare the predicted order of views with errors from virtual measurements.

    Continues an interrupted run in the same folder, and shares virtual measurements with `statements`.
    Writes the page scores.md, and prints its tables of sensors.

    Example: python -m tests.proofs scores scenes/parts/validation.toml -o runs/validated
    """
    start(variant)
    from characterisation.words.progress import say
    from tests.proofs.part_cases import read_part_cases
    from tests.proofs.screening_page import described_screening, write_screening_page
    from tests.proofs.screening_run import screen_cases

    workers = requested_workers(scheduler, processes)
    chosen = read_part_cases(cases, only or ())
    check_folder(output)
    page, tables = write_screening_page(
        screen_cases(chosen, output, workers), output, described_screening(cases, chosen)
    )
    print(tables, end="")
    say(f"page: {page}")


def statements(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors and finishes.")],
    output: Out,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Evaluate only cases whose name PART__SENSOR__FINISH contains this text. Repeatable."),
    ] = None,
    scheduler: Scheduler = None,
    processes: Processes = 1,
    variant: Variant = None,
    coverage_only: Annotated[
        bool, typer.Option("--coverage-only", help="Do not judge the choices of races: about half the time.")
    ] = False,
) -> None:
    """Compare statements of uncertainty, and choices of views, with independent virtual measurements.

    Continues an interrupted run in the same folder. Writes the page statements.md, and prints its table of sensors.

    Example: python -m tests.proofs statements scenes/parts/validation.toml -o runs/validated
    """
    start(variant)
    from characterisation.words.progress import say
    from tests.proofs.part_cases import described, read_part_cases
    from tests.proofs.statement_page import write_statement_page
    from tests.proofs.statement_run import run_cases

    workers = requested_workers(scheduler, processes)
    chosen = read_part_cases(cases, only or ())
    check_folder(output)
    page, sensors = write_statement_page(
        run_cases(chosen, output, workers, not coverage_only), output, described(cases, chosen)
    )
    print(sensors, end="")
    say(f"page: {page}")


def budgets(
    rounds: Annotated[int, typer.Option(min=2, max=10_000, help="Statements of each study.")] = 40,
    variant: Variant = None,
) -> None:
    """Compare budgets with variances that are known, and with budgets from pairs of trials.

    Needs no cases: errors are drawn from known functions of drawn numbers. Prints a table.

    Example: python -m tests.proofs budgets
    """
    start(variant)
    from tests.proofs.budgets import budgets_table

    print(budgets_table(rounds), end="")


def losses(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors and finishes.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="TOML file to write.")],
    views: Annotated[int, typer.Option(min=1, max=100, help="Views to render of each open case.")] = 6,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Use only cases whose name PART__SENSOR__FINISH contains this text. Repeatable."),
    ] = None,
    variant: Variant = None,
) -> None:
    """Estimate, from the open parts, the fraction of points that interreflections destroy.

    Renders and decodes a few views of every open case. Writes the constants with which mitsim screens views, each with
    its 95 % interval. Does not use sealed parts, which are reserved for validation.

    Example: python -m tests.proofs losses scenes/parts/validation.toml -o mitsim/maps/prediction/interreflections.toml
    """
    start(variant)
    from characterisation.files.atomic_io import write_text
    from characterisation.words.progress import say
    from tests.proofs.loss_fit import fitted_loss, losses_document, points_of_cases
    from tests.proofs.part_cases import read_part_cases

    chosen = [case for case in read_part_cases(cases, only or ()) if case.usable_for_fitting]
    seen = points_of_cases(chosen, views)
    try:
        found = {kind: fitted_loss(list(of.values())) for kind, of in seen.items()}
    except ValueError as problem:
        raise InputError(
            cases,
            "cases",
            str(problem),
            "open cases of matching and of coded sensors, with parts that have interreflections",
        ) from problem
    command = f"python -m tests.proofs losses {cases} -o {output}" + (f" --views {views}" if views != 6 else "")
    write_text(output, losses_document(command, [name for of in seen.values() for name in of], found))
    for kind, loss in found.items():
        print(
            f"{kind}: half {loss.half} {list(loss.half_interval)}, steepness {loss.steepness} "
            f"{list(loss.steepness_interval)}"
        )
    say(f"constants: {output}")


def maps(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors and finishes.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="TOML file to write.")],
    views: Annotated[int, typer.Option(min=1, max=1000, help="Views of each case.")] = 8,
    worlds: Annotated[
        int, typer.Option(min=4, max=1000, help="Virtual measurements to draw from the map for each view.")
    ] = 8,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Use only cases whose name PART__SENSOR__FINISH contains this text. Repeatable."),
    ] = None,
    variant: Variant = None,
) -> None:
    """Compare measurements drawn from maps with rendered ones, and write the size of effects outside the map.

    Uses the rendered measurements that the cases file names, and skips cases without any. The sizes come from the open
    parts only. The printed table tests each open case with sizes from the other open cases, and each sealed case with
    sizes from all open cases.

    Example: python -m tests.proofs maps scenes/parts/validation.toml -o mitsim/study/virtual/beyond_map.toml
    """
    start(variant)
    import tempfile

    from characterisation.files.atomic_io import write_text
    from characterisation.words.progress import say
    from tests.proofs.map_comparison import beyond_map_document, compare_case, judged_table
    from tests.proofs.part_cases import read_part_cases
    from tests.proofs.tables import markdown

    with tempfile.TemporaryDirectory() as folder:
        found = [compare_case(case, Path(folder), views, worlds) for case in read_part_cases(cases, only or ())]
    compared = [one for one in found if one is not None]
    more = "".join(f" --{name} {given}" for name, given in (("views", views), ("worlds", worlds)) if given != 8)
    try:
        text = beyond_map_document(f"python -m tests.proofs maps {cases} -o {output}{more}", compared)
    except ValueError as problem:
        raise InputError(
            cases,
            "cases",
            str(problem),
            "open cases of matching, coded-light and time-of-flight sensors, with kept trials",
            "make the trials first: python -m tests.proofs statements",
        ) from problem
    write_text(output, text)
    rows = [
        [
            f"{part}{' (sealed)' if sealed else ''}",
            sensor,
            finish,
            f"{ratio:.2g}",
            f"{predicted:.2g}",
            *("-" if share != share else f"{100 * share:.0f} %" for share in (alone, both)),
            str(of),
        ]
        for part, sensor, finish, sealed, ratio, predicted, alone, both, of in judged_table(compared)
    ]
    print(
        markdown(
            [
                "part",
                "sensor",
                "finish",
                "rendered / drawn error",
                "rendered error / predicted u",
                "in interval, map alone",
                "in interval, with effects outside the map",
                "errors",
            ],
            rows,
        ),
        end="",
    )
    say(f"constants: {output}")


def laboratory(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors, finishes, masks and decoders.")],
    output: Out,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Evaluate only rows whose name CASE__FAMILY contains this text. Repeatable."),
    ] = None,
    processes: Processes = 1,
    variant: Variant = None,
) -> None:
    """Compare statements with worlds that an independent renderer, imager and decoder made.

    Continues an interrupted run in the same folder. Writes the page laboratory.md, and prints its table of families.

    Example: python -m tests.proofs laboratory tests/proofs/laboratory/cases.toml -o runs/laboratory
    """
    start(variant)
    from characterisation.words.progress import say
    from tests.proofs.laboratory.cases import read_cases
    from tests.proofs.laboratory.page import write_laboratory_page
    from tests.proofs.laboratory.run import run_rows

    workers = requested_workers(None, processes)
    rows = read_cases(cases, only or ())
    check_folder(output)
    page, table = write_laboratory_page(run_rows(rows, output, workers), output, cases)
    print(table, end="")
    say(f"page: {page}")


def pairs(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors, finishes, masks and decoders.")],
    only: Annotated[
        list[str] | None,
        typer.Option(help="Evaluate only rows whose name CASE__FAMILY contains this text. Repeatable."),
    ] = None,
    variant: Variant = None,
) -> None:
    """Measure the same worlds with the light of mitsim and with that of the laboratory; print how far they differ.

    Rows of the family "mitsim" with the preset's mask are evaluated.

    Example: python -m tests.proofs pairs tests/proofs/laboratory/cases.toml --only david
    """
    start(variant)
    from tests.proofs.laboratory.cases import read_cases
    from tests.proofs.laboratory.pairs import pairs_of, pairs_table

    rows = [row for row in read_cases(cases, only or ()) if (row.family, row.mask) == ("mitsim", "preset")]
    print(pairs_table([pairs_of(row) for row in rows]), end="")


def seeds(
    study: Annotated[Path, typer.Argument(help="Study TOML file.")],
    output: Out,
    view: Annotated[int, typer.Option(min=0, help="Number of the candidate view to state.")],
    seeds: Annotated[int, typer.Option(min=2, max=100, help="Number of seeds, from 1 on.")] = 5,
    trials: Annotated[
        int | None,
        typer.Option(
            min=2, max=1_000_000, help="Trials of each statement; default: as many as the study makes by its own rule."
        ),
    ] = None,
    processes: Processes = 1,
    variant: Variant = None,
) -> None:
    """Compare the statements of one view of a study with different seeds.

    Continues an interrupted run in the same folder. Prints u of every measurement by seed, and the
    kurtosis of its errors.

    Example: python -m tests.proofs seeds scenes/two_pillars/study.toml --view 99 -o runs/seeds
    """
    start(variant)
    import numpy as np

    from mitsim.study import open_study
    from tests.proofs.seeds import seeds_table, statements_of_seeds, tails

    workers = requested_workers(None, processes)
    opened = open_study(study, mapped=False)
    stated_view = opened.view(view, "--view")
    check_folder(output)
    stated = statements_of_seeds(opened, stated_view, range(1, seeds + 1), trials, output, workers)
    print(seeds_table(stated), end="")
    least, middle, most = np.quantile(tails(opened, stated_view, range(1, seeds + 1), output), [0, 0.5, 1])
    print(f"kurtosis less 1 of the errors of all seeds: {least:.1f} to {most:.1f}, median {middle:.1f}")


def finishes(
    folder: Annotated[Path, typer.Argument(help="Folder of real data, with brdf_metals and merl_fits.")],
) -> None:
    """Fit the priors of finishes to measured surfaces, and compare the model of a BSDF with a goniometer.

    Prints tables of the fits, of the priors with their 95 % intervals, and of model against data; takes a minute.

    Example: python -m tests.proofs finishes ../shared/real
    """
    from tests.proofs.finishes.page import finishes_page

    print(finishes_page(folder), end="")


def faces(
    cases: Annotated[Path, typer.Argument(help="TOML file that lists parts, sensors and finishes.")],
    views: Annotated[int, typer.Option(min=1, max=100, help="Views to render of each case.")] = 2,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Evaluate only cases whose name PART__SENSOR__FINISH contains this text. Repeatable."),
    ] = None,
    variant: Variant = None,
) -> None:
    """Compare F of every feature on the map and of the score with F found in rendered captures; print the table.

    Example: python -m tests.proofs faces scenes/parts/validation.toml
    """
    start(variant)
    from tests.proofs.faces import fractions_of_cases, fractions_table
    from tests.proofs.part_cases import read_part_cases

    print(fractions_table(fractions_of_cases(read_part_cases(cases, only or ()), views)), end="")


for command in (maps, scores, statements, budgets, losses, laboratory, pairs, seeds, finishes, faces):
    app.command(name=command.__name__)(command)

if __name__ == "__main__":
    run_application(app)
