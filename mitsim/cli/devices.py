"""Capture with live cameras."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from characterisation.files.errors import InputError
from characterisation.words.progress import say, track
from mitsim.cli import options

_KINDS = "ensenso:SERIAL, depthai or depthai:ID"


def capture(
    output: options.Out,
    device: Annotated[str, typer.Option(help=f"Camera: {_KINDS}.")],
    settings: Annotated[
        Path | None,
        typer.Option(help="TOML file of camera settings, with the keys of [device.settings] in a campaign."),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=10000, help="Number of captures.")] = 1,
) -> None:
    """Capture with a live camera; each capture gets a new numbered folder.

    Example: mitsim capture --device ensenso:150358 --repeats 20 -o captures/sheet
    """
    from mitsim.capture.devices.maker_captures import device_capture, open_device
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


def device_table(device: str, settings: Path | None) -> Any:
    """Return the ``[device]`` table for the options of a command.

    Raises
    ------
    InputError
        For an unknown kind of camera, or settings that the camera does not have.
    """
    from characterisation.files.documents import read_toml, validate
    from mitsim.capture.devices.depthai_settings import DepthaiSettings
    from mitsim.capture.devices.ensenso import EnsensoSettings
    from mitsim.capture.devices.maker_captures import DepthaiTable, EnsensoTable

    kind, _, name = device.partition(":")
    if kind == "ensenso" and name:
        chosen = EnsensoSettings() if settings is None else read_toml(settings, EnsensoSettings)
        return validate("--device", {"kind": kind, "serial": name, "settings": chosen}, EnsensoTable)
    if kind == "depthai":
        set_to = DepthaiSettings() if settings is None else read_toml(settings, DepthaiSettings)
        return validate("--device", {"kind": kind, "id": name, "settings": set_to}, DepthaiTable)
    raise InputError("--device", "", repr(device), _KINDS)


def mount(sample: str, distance: float) -> None:
    """Ask the user to mount a coupon, and to place the stage as calibrated for a distance [mm].

    Raises
    ------
    InputError
        If there is no terminal.
    """
    if not sys.stdin.isatty():
        pending = f"{sample} at {distance:g} mm, which somebody must mount next"
        allowed = "one sample at one distance without a terminal"
        raise InputError("campaign", "samples", pending, allowed, "run the command in a terminal")
    asked = f"{sample} at {distance:g} mm: is the coupon mounted, the stage in place, and its path free?"
    typer.confirm(asked, abort=True, err=True)
