"""What commands have in common: their options, and checks of what was given."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mitsim.commands.folder_lock import hold, sweep_beside
from mitsim.errors import InputError

Out = Annotated[Path, typer.Option("--output", "-o", help="Folder or file to write.")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant: cuda_ad_mono or llvm_ad_mono.")]
SensorOption = Annotated[str, typer.Option(help="A preset's name, or the path of a sensor TOML file.")]
Defines = Annotated[list[str] | None, typer.Option("-D", help="Set a scene's <default>: name=value. May be repeated.")]
Position = Annotated[tuple[float, float, float], typer.Option(help="Where the sensor stands [mm], world frame.")]
Target = Annotated[tuple[float, float, float], typer.Option(help="What it looks at [mm], world frame.")]
Roll = Annotated[float, typer.Option(help="Turn about the view axis [deg].")]
Seed = Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Same seed, same result.")]


Scheduler = Annotated[str | None, typer.Option(
    help="Address of a Dask scheduler whose workers take the captures: tcp://HOST:8786.")]  # fmt: skip
Processes = Annotated[int, typer.Option(
    min=0, max=1024, help="Processes of this machine that take captures; 0: as many as it has room for.")]  # fmt: skip
Overwrite = Annotated[bool, typer.Option(help="Replace a finished run; its finished trials are used again.")]

Yes = Annotated[bool, typer.Option(
    "--yes", "-y", help="Characterise finishes that the map does not know, without asking.")]  # fmt: skip


def asking(yes: bool, others: str = "") -> Callable[[str], bool] | None:
    """What answers whether a finish may be characterised: yes; the user, at a terminal; or None, where nobody can.

    ``others`` tells what one yes stands for beside the first question: it is asked once.
    """
    if yes:
        return lambda _: True
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    answers = list[bool]()

    def ask(question: str) -> bool:
        if not answers:
            answers.append(typer.confirm(f"{question}{others}", default=False, err=True))
        return answers[0]

    return ask


class Group(TyperGroup):
    """Commands whose first sentence is told whole in the list of ``--help``: click cuts it to one line."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of the commands."""
        named = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, one.get_short_help_str(limit=1000)) for name, one in named if one and not one.hidden]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def start(variant: str | None) -> None:
    """Choose the Mitsuba variant, before anything else of Mitsuba is imported."""
    from mitsim.scene import backend

    backend.activate(variant)


def pose_of(position: tuple[float, float, float], target: tuple[float, float, float], roll: float, sensor: Any) -> Any:
    """``world_from_sensor`` of a sensor whose reference camera stands at a place and looks at another."""
    import numpy as np

    from mitsim.interface.poses import look_at

    distance = float(np.linalg.norm(np.subtract(position, target)))
    if not 50 <= distance <= 20000:
        raise InputError("--position", "", f"{distance:g} mm from the target", "50 to 20000 mm", "positions are in mm")
    return look_at(position, target, roll_deg=roll, sensor=sensor)


def definitions(given: list[str] | None) -> dict[str, str]:
    """Values of -D by name."""
    out = {}
    for item in given or []:
        name, mark, value = item.partition("=")
        if not mark or not name:
            raise InputError("-D", "", repr(item), "name=value")
        out[name] = value
    return out


def check_file(file: Path) -> None:
    """Refuse a file that could not be written, and make its folder."""
    check_folder(file.parent, held=False)
    if file.is_dir():
        raise InputError("--output", "", f"the folder {file}", "a file")
    if file.exists() and not file.is_file():  # writing whole replaces what is there: /dev/null, too
        raise InputError("--output", "", f"{file}, a device or a pipe", "a file")
    sweep_beside(file)


def keep_finished(folder: Path, overwrite: bool, last: str) -> None:
    """Refuse a folder that holds a finished run; ``last`` is the file that a run writes at its end.

    With ``overwrite`` that file is taken away: a run that is cut off must not look finished.

    Raises
    ------
    InputError
        If it is there and may not be replaced.
    """
    if not (folder / last).exists():
        return
    if not overwrite:
        raise InputError(
            "--output", "", f"{folder}, a finished run", "a folder of its own",
            "to do it again there say --overwrite: finished trials are used again; mitsim report writes its page",
        )  # fmt: skip
    (folder / last).unlink()


def check_folder(folder: Path, held: bool = True) -> None:
    """Refuse a folder that could not be written to, and make it; hold it until the command ends.

    ``held`` is false for the folder of a single file: others may write beside it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--output", "", f"{folder} ({error.strerror})", "a folder that can be made") from None
    if not os.access(folder, os.W_OK):
        raise InputError("--output", "", f"{folder}, which cannot be written to", "a folder that can be")
    place = folder.resolve()
    if held and place not in _held:
        _held[place] = hold(folder)


#: folders that the command which runs holds, and what lets each go
_held: dict[Path, Callable[[], None]] = {}


def let_go() -> None:
    """Let all folders go that a command holds: at its end, however it ends."""
    while _held:
        _held.popitem()[1]()
