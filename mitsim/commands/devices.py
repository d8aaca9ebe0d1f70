"""Take captures with live cameras."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from mitsim.commands.options import Out, check_folder
from mitsim.errors import InputError

_KINDS = "ensenso:SERIAL, depthai or depthai:ID"


def capture(
    output: Out,
    device: Annotated[str, typer.Option(help=f"The camera: {_KINDS}.")],
    settings: Annotated[Path | None, typer.Option(
        help="TOML file with what to set; as of a campaign's [device.settings].")] = None,
    repeats: Annotated[int, typer.Option(min=1, max=10000, help="Captures, one after the other.")] = 1,
) -> None:  # fmt: skip
    """Take captures with a live camera, each into a folder of its own; go on where there are some already.

    Example: mitsim capture --device ensenso:150358 --repeats 20 -o captures/sheet
    """
    from mitsim.campaign.devices import open_device
    from mitsim.capture.folder import write_capture
    from mitsim.progress import say, track

    table = device_table(device, settings)
    check_folder(output)
    first = _next_number(output)
    with open_device(table) as camera:
        for number in track(range(first, first + repeats), "capture", repeats):
            taken = camera.take()
            folder = write_capture(taken.capture, output / f"{number:04d}", vendor=taken.originals)
            print(folder)
    say(f"captures: {output}")


def device_table(device: str, settings: Path | None) -> Any:
    """The ``[device]`` table that a command line asks for.

    Raises
    ------
    InputError
        For a camera of no known make, or settings that it does not have.
    """
    from characterisation.documents import read_toml, validate
    from mitsim.campaign.devices import DepthaiTable, EnsensoTable
    from mitsim.hardware.depthai_settings import DepthaiSettings
    from mitsim.hardware.ensenso import EnsensoSettings

    kind, _, name = device.partition(":")
    if kind == "ensenso" and name:
        chosen = EnsensoSettings() if settings is None else read_toml(settings, EnsensoSettings)
        return validate("--device", {"kind": kind, "serial": name, "settings": chosen}, EnsensoTable)
    if kind == "depthai":
        set_to = DepthaiSettings() if settings is None else read_toml(settings, DepthaiSettings)
        return validate("--device", {"kind": kind, "id": name, "settings": set_to}, DepthaiTable)
    raise InputError("--device", "", repr(device), _KINDS)


def mount(sample: str, distance: float) -> None:
    """Have a person put a coupon on the stage, and the stage where it was calibrated for a distance [mm].

    Raises
    ------
    InputError
        If nobody is there to do it.
    """
    if not sys.stdin.isatty():
        raise InputError("campaign", "samples", f"{sample} at {distance:g} mm, to be put there next",
                         "one sample at one distance, where nobody answers", "run it in a terminal")  # fmt: skip
    asked = f"{sample} at {distance:g} mm: is it on the stage, the stage in its place, and nothing in its way?"
    typer.confirm(asked, abort=True, err=True)


def _next_number(folder: Path) -> int:
    """The first number after those of the captures that are there."""
    return max((int(path.name) for path in folder.glob("[0-9][0-9][0-9][0-9]*") if path.name.isdigit()), default=-1) + 1
