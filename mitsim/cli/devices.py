"""Capture with live cameras."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from characterisation.files.errors import InputError
from characterisation.words.progress import say, track
from mitsim.cli import options


def capture(
    output: options.Out,
    device: Annotated[str, Option(help="Camera: ensenso:SERIAL, depthai or depthai:ID.")],
    settings: Annotated[
        Path | None, Option(help="TOML file of camera settings, with the keys of [device.settings] in a campaign.")
    ] = None,
    repeats: Annotated[int, Option(min=1, max=10000, help="Number of captures.")] = 1,
) -> None:
    """Capture with a live camera; each capture gets a new numbered folder.

    Example: mitsim capture --device ensenso:150358 --repeats 20 -o captures/sheet
    """
    from mitsim.capture.devices.maker_captures import device_capture, device_table, open_device
    from mitsim.capture.folder import write_capture

    table = device_table(device, settings)
    options.check_folder(output)
    taken_before = (int(path.name) for path in output.glob("[0-9][0-9][0-9][0-9]*") if path.name.isdigit())
    first = max(taken_before, default=-1) + 1
    with open_device(table) as camera:
        for number in track(range(first, first + repeats), "capture", repeats):
            taken = device_capture(camera.take())
            folder = write_capture(taken.capture, output / f"{number:04d}", vendor=taken.originals)
            print(folder)
    say(f"captures: {output}")


def mount(sample: str, distance: float) -> None:
    """Ask the user to mount a coupon, and to place the stage as calibrated for a distance [mm]."""
    if not sys.stdin.isatty():
        pending = f"{sample} at {distance:g} mm, which somebody must mount next"
        allowed = "one sample at one distance without a terminal"
        raise InputError("campaign", "samples", pending, allowed, "run the command in a terminal")
    asked = f"{sample} at {distance:g} mm: is the coupon mounted, the stage in place, and its path free?"
    typer.confirm(asked, abort=True, err=True)
