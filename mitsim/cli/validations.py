"""Compare predictions with measurements: ``mitsim validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from characterisation.files.errors import InputError
from mitsim.cli.devices import mount
from mitsim.cli.options import Group, Out, Processes, Scheduler, Seed, SensorOption, Variant, check_folder, start

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Compare predictions with measurements: maps, view scores, statements, simulated captures.",
)


def map_(
    map_file: Annotated[
        Path, typer.Argument(metavar="MAP", help="A map.nc file, or a sensor whose map comes with mitsim.")
    ],
    campaign: Annotated[Path, typer.Argument(help="Campaign TOML file with the coupons to capture.")],
    output: Out,
    sensor: SensorOption = "ensenso-n10",
    poses: Annotated[int, typer.Option(min=1, max=10000, help="Poses of each sample at each distance.")] = 24,
    repeats: Annotated[
        int,
        typer.Option(
            min=1, max=1000, help="Captures of each pose; up to four times as many where few points are recovered."
        ),
    ] = 1,
    seed: Seed = 1,
    scheduler: Scheduler = None,
    processes: Processes = 1,
    variant: Variant = None,
) -> None:
    """Compare a map with captures at new poses; exit code 1 if the map predicts them wrongly.

    The poses have random surface normals, at the distances of the map and half-way between them. Prints one row per
    sample and distance. A [device] and a [stage] in the campaign take the captures, at the distance of the stage;
    without them, the captures are simulated.

    Example: mitsim validate map runs/n10/map.nc scenes/coupon/campaign.toml -o runs/n10_held_out
    """
    start(variant)
    from contextlib import AbstractContextManager, nullcontext

    from characterisation.files.documents import read_toml
    from characterisation.maps.performance_map import PerformanceMap
    from characterisation.maps.shipped import map_path
    from characterisation.maps.validation import residual_table, within_limits
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.maps.campaign.acquire import CaptureSource, simulated_source
    from mitsim.maps.campaign.hold_out import (
        compare,
        held_out_campaign,
        held_out_live,
        held_out_orders,
        held_out_shots,
        hold_out_order,
    )
    from mitsim.maps.campaign.live import live_source
    from mitsim.maps.campaign.plan import CampaignFile
    from mitsim.maps.campaign.run import write_netcdf
    from mitsim.report.style import write_png
    from mitsim.report.validation_figures import agreement_figure, validation_table
    from mitsim.running.executor import executor_of, results_of
    from mitsim.running.progress import say, track
    from mitsim.sensor.preset import load_sensor

    path = map_path(map_file)
    performance_map = PerformanceMap.load(path)
    file, chosen = read_toml(campaign, CampaignFile), load_sensor(sensor)
    if file.device is not None and (scheduler is not None or processes != 1):
        option, given = ("--scheduler", scheduler) if scheduler is not None else ("--processes", str(processes))
        raise InputError(option, "", given, "not with a [device]", "a device takes one capture at a time")
    live = None if file.device is None else held_out_live(campaign, file, chosen, performance_map)
    plan = held_out_campaign(campaign, chosen, performance_map) if live is None else live.campaign
    shots = held_out_shots(plan, poses, seed)
    check_folder(output)
    workers = executor_of(scheduler, processes)
    if workers is not None:
        pairs = results_of(held_out_orders(plan, shots, path, repeats), hold_out_order, workers, "hold out")
    else:
        source: AbstractContextManager[CaptureSource]
        if live is None:
            source = nullcontext(simulated_source(SimulatedSensor(plan.sensor), plan.file.samples_per_pixel))
        else:
            source = live_source(live, mount)
        with source as take:
            pairs = list(track(compare(plan, performance_map, shots, take, repeats), "hold out", len(shots)))
    table = residual_table(pairs)
    write_netcdf(table, output / "validation.nc")
    for sample in plan.samples:
        mine = [p for p in pairs if (p.finish, str(p.roughness)) == (sample.finish, str(sample.roughness))]
        name = sample.label().replace("/", "-").replace(" ", "_")
        write_png(agreement_figure(mine), output / f"held_out_{name}.png")
    print(validation_table(table), end="")
    say(f"figures: {output}")
    if not within_limits(table).all():
        raise typer.Exit(1)


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

    Continues an interrupted run in the same folder, and shares virtual measurements with `mitsim validate statements`.
    Writes the page scores.md, and prints its tables of sensors.

    Example: mitsim validate scores scenes/parts/validation.toml -o runs/validated
    """
    start(variant)
    from mitsim.running.executor import executor_of
    from mitsim.running.progress import say
    from tests.proofs.part_cases import read_part_cases
    from tests.proofs.screening_page import described_screening, write_screening_page
    from tests.proofs.screening_run import screen_cases

    workers = executor_of(scheduler, processes)
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
) -> None:
    """Compare statements of uncertainty, and choices of views, with independent virtual measurements.

    Continues an interrupted run in the same folder. Writes the page statements.md, and prints its table of sensors.

    Example: mitsim validate statements scenes/parts/validation.toml -o runs/validated
    """
    start(variant)
    from mitsim.running.executor import executor_of
    from mitsim.running.progress import say
    from tests.proofs.part_cases import described, read_part_cases
    from tests.proofs.statement_page import write_statement_page
    from tests.proofs.statement_run import run_cases

    workers = executor_of(scheduler, processes)
    chosen = read_part_cases(cases, only or ())
    check_folder(output)
    page, sensors = write_statement_page(run_cases(chosen, output, workers), output, described(cases, chosen))
    print(sensors, end="")
    say(f"page: {page}")


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

    Example: mitsim validate losses scenes/parts/validation.toml -o mitsim/maps/prediction/interreflections.toml
    """
    start(variant)
    from characterisation.files.atomic_io import atomic_write
    from mitsim.running.progress import say
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
    command = f"mitsim validate losses {cases} -o {output}" + (f" --views {views}" if views != 6 else "")
    with atomic_write(output) as whole:
        whole.write_text(
            losses_document(command, [name for of in seen.values() for name in of], found), encoding="utf-8"
        )
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

    Example: mitsim validate maps scenes/parts/validation.toml -o mitsim/study/virtual/beyond_map.toml
    """
    start(variant)
    import tempfile

    from characterisation.files.atomic_io import atomic_write
    from mitsim.running.progress import say
    from tests.proofs.map_comparison import beyond_map_document, compare_case, judged_table
    from tests.proofs.part_cases import read_part_cases
    from tests.proofs.tables import markdown

    with tempfile.TemporaryDirectory() as folder:
        found = [compare_case(case, Path(folder), views, worlds) for case in read_part_cases(cases, only or ())]
    compared = [one for one in found if one is not None]
    more = "".join(f" --{name} {given}" for name, given in (("views", views), ("worlds", worlds)) if given != 8)
    try:
        text = beyond_map_document(f"mitsim validate maps {cases} -o {output}{more}", compared)
    except ValueError as problem:
        raise InputError(
            cases,
            "cases",
            str(problem),
            "open cases of matching, coded-light and time-of-flight sensors, with kept trials",
            "make the trials first: mitsim validate statements",
        ) from problem
    with atomic_write(output) as whole:
        whole.write_text(text, encoding="utf-8")
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


def captures(
    real: Annotated[
        Path,
        typer.Argument(
            help="Real capture of a flat object: a capture folder, or a recording that mitsim import accepts."
        ),
    ],
    output: Out,
    simulated: Annotated[
        Path | None,
        typer.Argument(help="Simulated capture of the same object; default: simulated from REAL and --sensor."),
    ] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Sensor to simulate, a preset or TOML file; default: the one that REAL names.")
    ] = None,
    window: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(
            metavar="COLUMN ROW WIDTH HEIGHT",
            help="Window of the first camera's image that shows the object [px]; default: the whole image.",
        ),
    ] = None,
    projector: Annotated[
        str | None,
        typer.Option(
            help="State of the projector in REAL, on or off; needed for a stereo pair whose settings do not state it."
        ),
    ] = None,
    frame: Annotated[
        int | None, typer.Option(min=0, help="For a recording: number of the view or image set, from 0.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="For a recording: calibration file of its cameras.")] = None,
    seed: Seed = 1,
    variant: Variant = None,
) -> None:
    """Compare a simulated capture with a real one, quantity by quantity; exit code 1 if some differ.

    Without SIMULATED, the command simulates REAL: a matt object on the same plane, with the same calibration and
    exposure. REAL may also come from a maker's virtual camera. Writes the page index.md, and prints its table.

    Example: mitsim validate captures captures/sheet --sensor ensenso-n35 -o runs/sheet_against_simulated
    """
    start(variant)
    from characterisation.region_of_interest import Roi
    from mitsim.running.progress import say
    from mitsim.twin.compare.captures_run import validate_captures

    if projector not in (None, "on", "off"):
        raise InputError("--projector", "", repr(projector), "on or off")
    check_folder(output)
    if not real.is_dir() or not (real / "capture.json").exists():
        real = _imported(real, output / "recorded", frame, calibration)
    elif frame is not None or calibration is not None:
        raise InputError("--frame" if frame is not None else "--calibration", "", "a capture folder", "a recording")
    roi = Roi(*window) if window else None
    found = validate_captures(real, simulated, output, sensor, roi, projector, seed)
    print(found.table, end="")
    say(f"page: {found.page}")
    if not found.comparison.agrees:
        raise typer.Exit(1)


def _imported(recording: Path, folder: Path, frame: int | None, calibration: Path | None) -> Path:
    """Import a recording into a capture folder."""
    from mitsim.capture.folder import write_capture
    from mitsim.capture.recordings.recognise import ReadOptions, read_recording
    from mitsim.running.progress import say

    options = ReadOptions(frame=frame, calibration=None if calibration is None else str(calibration))
    imported = read_recording(recording, options)
    write_capture(imported.capture, folder, overwrite=True, vendor=imported.originals)
    say(f"{recording}: {imported.kind}, imported to {folder}")
    return folder


for command in (map_, maps, scores, statements, losses, captures):
    app.command(name=command.__name__.rstrip("_"))(command)
