"""Data sheets of sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.cli.options import Out, Processes, Scheduler, Seed, Variant, check_folder, requested_workers, start


def datasheet(
    sensors: Annotated[list[str], typer.Argument(help="Presets or sensor TOML files; default: all presets.")] = [],  # noqa: B006
    output: Out = Path("datasheet"),
    seed: Seed = 1,
    scheduler: Scheduler = None,
    processes: Processes = 1,
    variant: Variant = None,
) -> None:
    """Make data sheets: noise floor, noise over distance, and recovery on metal, from simulated plates and balls.

    Example: mitsim datasheet ensenso-n10 kinect-v2 -o runs/sheets
    """
    start(variant)
    from characterisation.files.atomic_io import write_json
    from mitsim.maps.data_sheet import gallery, measure_sensor
    from mitsim.report.sheet_figures import gallery_figure, noise_figure, residual_figure, sheet_leaves_out, sheet_table
    from mitsim.report.style import write_png
    from mitsim.running.progress import say
    from mitsim.sensor.preset import load_sensor, presets

    chosen = [load_sensor(name) for name in (sensors or presets())]
    check_folder(output)
    workers = requested_workers(scheduler, processes)
    sheets = []
    for sensor in chosen:
        sheets.append(measure_sensor(sensor, seed, workers))
        pictures = gallery_figure(sensor.name, gallery(sensor, seed))
        write_png(pictures, output / f"gallery_{sensor.name}.png", dpi=72)
        write_json(output / f"{sensor.name}.json", sheets[-1].numbers())
    write_png(noise_figure(sheets), output / "noise.png", dpi=90)
    write_png(residual_figure(sheets), output / "residuals.png", dpi=90)
    print(sheet_table(sheets), end="")
    print("\nNot included in these values:\n\n" + sheet_leaves_out(sheets), end="")
    say(f"figures: {output}")
