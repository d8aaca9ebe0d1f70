"""Compare a real capture of a flat object with a simulated one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options


def compare(
    context: typer.Context,
    real: Annotated[
        Path,
        Argument(help="Real capture of a flat object: a capture folder, or a recording that mitsim import accepts."),
    ],
    output: options.Out,
    simulated: Annotated[
        Path | None, Argument(help="Simulated capture of the same object; default: simulated from REAL and --sensor.")
    ] = None,
    sensor: Annotated[
        str | None, Option(help="Sensor to simulate, a preset or TOML file; default: the one that REAL names.")
    ] = None,
    window: options.ObjectWindow = None,
    projector: Annotated[
        str | None,
        Option(
            help="State of the projector in REAL, on or off; needed for a stereo pair whose settings do not state it."
        ),
    ] = None,
    frame: Annotated[
        int | None, Option(min=0, help="For a recording: number of the view or image set, from 0.")
    ] = None,
    calibration: Annotated[Path | None, Option(help="For a recording: calibration file of its cameras.")] = None,
    seed: options.Seed = 1,
    variant: options.Variant = None,
) -> None:
    """Compare a simulated capture with a real one, quantity by quantity; exit code 1 if some differ.

    Without SIMULATED, the command simulates REAL: a matt object on the same plane, with the same calibration and
    exposure. REAL may also come from a maker's virtual camera. Writes the page index.md, and prints its table.

    Example: mitsim compare captures/sheet --sensor ensenso-n35 -o runs/sheet_against_simulated
    """
    options.start(variant)
    from characterisation.region_of_interest import Roi
    from mitsim.report.capture_page import write_capture_page
    from mitsim.twin.compare.captures_run import validate_captures

    if projector not in (None, "on", "off"):
        raise InputError("--projector", "", repr(projector), "on or off")
    if simulated is not None:
        options.refuse_unused(context, "a capture SIMULATED", "no such option: nothing is simulated", "sensor")
    options.check_folder(output)
    if not real.is_dir() or not (real / "capture.json").exists():
        real = _imported(real, output / "recorded", frame, calibration)
    elif frame is not None or calibration is not None:
        raise InputError("--frame" if frame is not None else "--calibration", "", "a capture folder", "a recording")
    roi = Roi(*window) if window else None
    validation = validate_captures(real, simulated, output, sensor, roi, projector, seed)
    page = write_capture_page(output, validation.preamble, validation.table, *validation.sides)
    print(validation.table, end="")
    say(f"page: {page}")
    if validation.fitted:
        say(f"warning: {validation.fitted}")
    if not validation.comparison.agrees:
        if simulated is None:
            say(f"next: mitsim fit sensor {shlex.quote(str(real))} fits the sensor file to your own camera")
        raise typer.Exit(1)


def _imported(recording: Path, folder: Path, frame: int | None, calibration: Path | None) -> Path:
    """Import a recording into a capture folder."""
    from mitsim.capture.folder import write_capture
    from mitsim.capture.recordings.any_recording import read_recording
    from mitsim.capture.recordings.read_options import ReadOptions

    reading = ReadOptions(frame=frame, calibration=None if calibration is None else str(calibration))
    imported = read_recording(recording, reading)
    write_capture(imported.capture, folder, overwrite=True, vendor=imported.originals)
    say(f"{recording}: {imported.kind}, imported to {folder}")
    return folder
