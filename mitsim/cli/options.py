"""Options that commands share, and checks of their values."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperCommand, TyperGroup

from characterisation.files.atomic_io import pointed_to
from characterisation.files.errors import InputError
from mitsim.cli.folder_lock import create_until_end, lock_until_end, remove_partial_beside
from mitsim.cli.kept_files import refuse_kept

if TYPE_CHECKING:
    from characterisation.point_cloud import PointCloud
    from mitsim.running.executor import Executor, Pool

Out = Annotated[Path, Option("--output", "-o", help="Folder to write.")]
OutCloud = Annotated[Path, Option("--output", "-o", help="Point cloud to write, a PLY file.")]
Scene = Annotated[Path, Argument(help="Scene XML file of the part, in mm.")]
Variant = Annotated[str | None, Option(help="Mitsuba variant: cuda_ad_mono (GPU) or llvm_ad_mono (CPU).")]
SensorOption = Annotated[str, Option(help="Name of a preset, or path of a sensor TOML file.")]
Defines = Annotated[list[str] | None, Option("-D", help="Set a <default> of the scene: name=value. Repeatable.")]
Position = Annotated[tuple[float, float, float], Option(help="Position of the sensor in the frame of the scene [mm].")]
Target = Annotated[
    tuple[float, float, float], Option(help="Point that the sensor looks at, in the frame of the scene [mm].")
]
Roll = Annotated[float, Option(help="Rotation about the view axis [deg].")]
Seed = Annotated[int, Option(min=0, max=2**63 - 1, help="Random seed; the same seed gives the same result.")]


Scheduler = Annotated[
    str | None, Option(help="Distribute the work to a Dask cluster: the address of its scheduler, tcp://HOST:8786.")
]
Processes = Annotated[
    int, Option(min=0, max=1024, help="Worker processes on this machine; 0: as many as its cores and memory allow.")
]
Clouds = Annotated[
    list[Path],
    Argument(
        metavar="CLOUD...",
        help="Point clouds (.ply, .pcd, .zdf, .npy, .mat, .xyz), recordings and capture folders (decoded first), or "
        "folders of these.",
    ),
]
Topic = Annotated[
    list[str] | None,
    Option(help="For a bag of ROS: the topic of depth images or of clouds; twice for the left and the right images."),
]
Unit = Annotated[
    str | None,
    Option(
        help="Unit of clouds of other programs: um, mm, cm, m, inch or foot; default: that of the file, else m if the "
        "median distance is below 20, else mm."
    ),
]
Frame = Annotated[
    str | None, Option(help="For a recording with several: image set, pair or frame, its number or name.")
]
Simulated = Annotated[
    str | None,
    Option(
        metavar="SENSOR",
        help="Sensor to simulate before the same planes and spheres, a preset or TOML file: its figures beside those "
        "of the first cloud, with F and sigma of the planes.",
    ),
]
MapFile = Annotated[str, Argument(metavar="MAP", help="A map.nc file, or a sensor whose map comes with mitsim.")]
ObjectWindow = Annotated[
    tuple[int, int, int, int] | None,
    Option(
        metavar="COLUMN ROW WIDTH HEIGHT",
        help="Window of the first camera's image that shows the object [px]; default: the whole image.",
    ),
]
PoseFile = Annotated[
    Path | None,
    Option(
        help="Pose of the sensor: pose.json, statement.json, or poses.json with --view; default: that of the capture."
    ),
]
ViewOfPoses = Annotated[int | None, Option(min=0, help="Number of the view in poses.json.")]
Json = Annotated[bool, Option("--json", help="Print JSON in place of the table.")]
DecodedAs = Annotated[str | None, Option(help="Decode captures with the settings of this sensor.")]
Overwrite = Annotated[bool, Option(help="Replace a finished run; its finished trials are reused.")]

Yes = Annotated[bool, Option("--yes", "-y", help="Characterise finishes that are missing in the map, without asking.")]

#: the processes that work for this command, none or one pool
_POOLS: list[Pool] = []


def asking(yes: bool, extension: str = "") -> Callable[[str], bool] | None:
    """Return the function that answers whether a missing finish may be characterised; None if nobody can answer.

    With ``yes`` it always agrees. At a terminal it asks the user once. ``extension`` ends the question, and names the
    other cases that the answer covers.
    """
    if yes:
        return lambda _: True
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    answers = list[bool]()

    def ask(question: str) -> bool:
        if not answers:
            answers.append(typer.confirm(f"{question}{extension}", default=False, err=True))
        return answers[0]

    return ask


def print_reasons(cloud: PointCloud) -> None:
    """Print how many pixels of a cloud are valid, and how many have no point for each reason."""
    if not cloud.valid.any():
        print(f"valid\t0 of {cloud.status.size}")
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")


class Command(TyperCommand):
    """A command that refuses numbers that are not finite, and empty paths, which pass options without limits."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, and check their numbers and paths."""
        empty = "." not in args and any(not word or re.fullmatch("--.+=", word) for word in args)
        remaining = list(super().parse_args(ctx, args))
        for parameter in self.params:
            value = ctx.params.get(parameter.name)
            for number in value if isinstance(value, (list, tuple)) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    raise InputError(max(parameter.opts, key=len), "", f"{number}", "a finite number")
                if empty and number == Path():  # of an unset variable of a shell, not meant as the current folder
                    raise InputError(max(parameter.opts, key=len), "", "an empty text", "a path; . is this folder")
        return remaining


class Group(TyperGroup):
    """A group that lists the whole first sentence of each command in ``--help``. Click would cut it to one line."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of the commands."""
        named = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, one.get_short_help_str(limit=1000)) for name, one in named if one and not one.hidden]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


class DefaultCommandGroup(Group):
    """A group that runs its first command if the arguments name none: ``mitsim fit X`` is ``mitsim fit finish X``.

    ``--help`` describes that command, and then lists the others.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the first command before arguments that name no command and do not ask for help."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = [next(iter(self.commands)), *args]
        return list(super().parse_args(ctx, args))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the first command, and the list of all."""
        first = next(iter(self.commands.values()))
        first.format_help(typer.Context(first, parent=ctx.parent, info_name=ctx.info_name), formatter)
        self.format_commands(ctx, formatter)


def command_group(words: str, *commands: Callable[..., None], default: bool = False) -> typer.Typer:
    """Return a group of commands with its help; with ``default``, the first one runs if none is named."""
    kind = DefaultCommandGroup if default else Group
    group = typer.Typer(cls=kind, no_args_is_help=True, rich_markup_mode=None, help=words)
    for command in commands:
        group.command(name=command.__name__.rstrip("_"), cls=Command)(command)
    return group


def start(variant: str | None) -> None:
    """Select the Mitsuba variant; call this before any other import of Mitsuba."""
    from mitsim.scene import backend

    backend.activate(variant)


def refuse_unused(context: typer.Context, found: str, allowed: str, *names: str) -> None:
    """Raise InputError for the first of the parameters ``names`` that is on the command line but has no effect.

    ``found`` and ``allowed`` say why they have no effect, such as ``no --task``, and what gives them one.
    """
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is not None and source.name == "COMMANDLINE":
            raise InputError(max(parameter.opts, key=len), "", found, allowed)


def requested_workers(scheduler: str | None, processes: int) -> Executor | None:
    """Return the workers of a scheduler, or processes on this machine; None if this process works alone.

    ``processes`` of 0 means as many as cores and memory allow, or one on a CUDA device, which it uses completely.
    """
    from mitsim.running import executor
    from mitsim.running.cluster import Cluster
    from mitsim.scene.backend import cuda_devices

    if scheduler is not None:
        if processes > 1:
            raise InputError("--processes", "", processes, "not with --scheduler", "its workers are processes")
        return Cluster(scheduler)
    if processes == 0:
        processes = 1 if cuda_devices() else executor.fitting_processes()
    if processes == 1:
        return None
    end_processes()
    _POOLS.append(executor.Pool(processes))
    return _POOLS[-1]


def end_processes() -> None:
    """Wait for the end of the processes of a command, which Python may not do in time: it then prints a traceback."""
    while _POOLS:
        _POOLS.pop().close()


def pose_of(position: tuple[float, float, float], target: tuple[float, float, float], roll: float, sensor: Any) -> Any:
    """Return ``world_from_sensor`` of a sensor whose reference camera looks from a position at a target [mm]."""
    import numpy as np

    from mitsim.sensor.poses import look_at

    distance = float(np.linalg.norm(np.subtract(position, target)))
    if not 50 <= distance <= 20000:
        raise InputError("--position", "", f"{distance:g} mm from the target", "50 to 20000 mm", "give positions in mm")
    return look_at(position, target, roll_deg=roll, sensor=sensor)


def definitions(items: list[str] | None, option: str = "-D", allowed: str = "name=value") -> dict[str, str]:
    """Return the values of a repeatable option by name; ``allowed`` describes its form in an error."""
    out = {}
    for item in items or []:
        name, mark, value = item.partition("=")
        if not mark or not name:
            raise InputError(option, "", repr(item), allowed)
        out[name] = value
    return out


def check_file(file: Path) -> None:
    """Check that a file can be written and holds nothing that the command reads, and create its folder."""
    check_folder(file.parent, locked=False)
    if file.is_dir():
        raise InputError("--output", "", f"the folder {file}", "a file")
    if file.exists() and not file.is_file():  # an atomic write would replace a device: /dev/null
        raise InputError("--output", "", f"{file}, a device or a pipe", "a file")
    refuse_kept(file)
    remove_partial_beside(file)


#: formats of clouds and parts that a file of the command that writes PLY must not be named after
_OTHER_CLOUDS = frozenset(
    {".pcd", ".e57", ".mcap", ".xyz", ".txt", ".csv", ".asc", ".pts", ".npy", ".npz", ".mat", ".zdf", ".las", ".laz"}
    | {".stl", ".obj", ".off", ".glb", ".3mf", ".png", ".json"}
)


def check_cloud_file(file: Path) -> None:
    """Check that a PLY file can be written, and that its name does not promise another format; create its folder."""
    if file.suffix.lower() in _OTHER_CLOUDS:
        hint = f"then mitsim export cloud {file.stem}.ply -o ... writes .pcd, .e57 and .mcap"
        raise InputError("--output", "", f"{file.name}, of another format", f"a PLY file: {file.stem}.ply", hint)
    check_file(file)


def check_unit(unit: str | None) -> None:
    """Check the unit of length of ``--unit``."""
    from mitsim.sensor.calibration_qualifiers import LENGTHS_MM

    if unit is not None and unit not in LENGTHS_MM:
        raise InputError("--unit", "", repr(unit), " | ".join(LENGTHS_MM))


def keep_finished(folder: Path, overwrite: bool, last: str) -> None:
    """Check that a folder holds no finished run; ``last`` is the file that a run writes at its end.

    A run that ended for lack of time says so in the file, and goes on. The command that writes the new run removes the
    file (:func:`mitsim.study.run_files.claim_folder`): an interrupted run must not look finished.
    """
    if not overwrite and (folder / last).exists() and _is_finished(folder / last):
        hint = "to repeat the run, add --overwrite (it reuses finished trials); to rewrite its page, use mitsim report"
        raise InputError("--output", "", f"{folder}, a finished run", "a folder without one", hint)


def _is_finished(path: Path) -> bool:
    """Return whether the file of a run says that it is finished; a damaged or old one does."""
    from characterisation.files.checked_files import read_json_object

    try:
        return read_json_object(path).get("finished", True) is not False
    except InputError:
        return True


def check_folder(folder: Path, locked: bool = True) -> None:
    """Check that a folder can be written, create it, and lock it until the command ends.

    ``locked`` is false for the folder of a single file: other commands may write to that folder at the same time. A
    folder that is created here is removed at the end of the command if it is still empty.
    """
    whole = str(folder.absolute())
    if locked and whole != whole.encode(errors="replace").decode():
        hint = "rename the folder, or give one elsewhere: -o /tmp/out"
        raise InputError("--output", "", whole, "a path in UTF-8, which netCDF files need", hint)
    try:
        create_until_end(pointed_to(folder))
    except OSError as error:
        raise InputError("--output", "", f"{folder} ({error.strerror})", "a folder that can be created") from None
    if not os.access(folder, os.W_OK):
        raise InputError("--output", "", f"{folder}, which is not writable", "a writable folder")
    if locked:
        lock_until_end(pointed_to(folder).absolute())


def check_new_folder(folder: Path) -> None:
    """Check that a folder can be moved to its place, in one step, and lock it until the command ends."""
    folder = pointed_to(folder).absolute()
    if folder.exists() and not folder.is_dir():
        raise InputError("--output", "", f"{folder}, which is no folder", "a new folder")
    check_folder(folder.parent, locked=False)
    lock_until_end(folder, whole=True)
