"""Compare predictions with measurements: ``mitsim validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from characterisation.files.errors import InputError
from mitsim.cli.devices import mount
from mitsim.cli.options import (
    Group,
    Out,
    Processes,
    Scheduler,
    Seed,
    SensorOption,
    Variant,
    check_folder,
    requested_workers,
    start,
)

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Compare predictions with measurements: maps, simulated captures.",
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
    from mitsim.running.executor import results_of
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
    workers = requested_workers(scheduler, processes)
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
    from mitsim.report.capture_page import write_capture_page
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
    validation = validate_captures(real, simulated, output, sensor, roi, projector, seed)
    page = write_capture_page(output, validation.preamble, validation.table, *validation.sides)
    print(validation.table, end="")
    say(f"page: {page}")
    if not validation.comparison.agrees:
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


for command in (map_, captures):
    app.command(name=command.__name__.rstrip("_"))(command)
