"""Fit the simulator to captures: ``mitsim fit``, a finish or a sensor.

Without ``finish`` or ``sensor`` behind it, what follows are captures of a coupon: it began as that command.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitsim.commands.options import Defines, Group, Seed, Variant, check_file, definitions, start


class _FinishByDefault(Group):
    """A group whose first command is meant where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put ``finish`` before what is neither a command nor a question for help."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = ["finish", *args]
        return list(super().parse_args(ctx, args))


app = typer.Typer(
    cls=_FinishByDefault, no_args_is_help=True, rich_markup_mode=None,
    help="Fit the simulator to captures: a coupon's finish (mitsim fit CAPTURES), or one's own sensor.",
)  # fmt: skip


def finish(
    captures: Annotated[list[Path], typer.Argument(help="Capture folders of one flat coupon.")],
    sensor: Annotated[str | None, typer.Option(
        help="A preset's name, or the path of a sensor TOML file; if left out, the captures' preset.")] = None,
    scene: Annotated[Path | None, typer.Option(
        help="The coupon's scene: size, metal and process; if left out, the one that the captures name.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="JSON to write.")] = None,
    figure: Annotated[Path | None, typer.Option(
        help="Picture (PNG) of image, model and residual of the worst view.")] = None,
    block: Annotated[int | None, typer.Option(
        min=4, max=128, help="Side of a block of pixels [px]; if left out, 8, or 32 of an unknown pattern.")] = None,
    window: Annotated[tuple[int, int, int, int] | None, typer.Option(
        metavar="COLUMN ROW WIDTH HEIGHT",
        help="Part of the first camera's image that shows the coupon and nothing else [px]; if left out, by its pose, "
             "or by the plane of most points.")] = None,
    define: Defines = None, variant: Variant = None,
) -> None:  # fmt: skip
    """Find the lobe's width alpha and the projector's power that captures of a coupon show; on stdout, a table.

    Example: mitsim fit finish captures/coupon_* --scene scenes/coupon/coupon.xml -o fit.json --figure fit.png
    """
    start(variant)
    from characterisation.atomic_io import write_json
    from mitsim.fit.figure import fit_figure, fit_table, remarks
    from mitsim.fit.run import fit_captures
    from mitsim.progress import say
    from mitsim.report.style import write_png

    for file in (output, figure):
        if file is not None:
            check_file(file)
    found = fit_captures(captures, sensor, scene, definitions(define), block, window)
    print(fit_table(found), end="")
    for remark in remarks(found):
        say(remark)
    if output is not None:
        write_json(output, found.numbers())
        say(f"fit: {output}")
    if figure is not None:
        write_png(fit_figure(found), figure, dpi=90)
        say(f"picture: {figure}")


def sensor_(
    captures: Annotated[list[Path] | None, typer.Argument(
        help="Capture folders of something flat, the projector on unless their settings say otherwise.")] = None,
    sensor: Annotated[str, typer.Option(help="The preset or sensor TOML file that the fit begins with.")] = "",
    output: Annotated[Path, typer.Option("--output", "-o", help="Sensor TOML file to write.")] = Path("my-camera.toml"),
    off: Annotated[list[Path] | None, typer.Option(
        help="A capture with the projector off. May be repeated.")] = None,
    dark: Annotated[list[Path] | None, typer.Option(help="A capture with all light off. May be repeated.")] = None,
    window: Annotated[tuple[int, int, int, int] | None, typer.Option(
        metavar="COLUMN ROW WIDTH HEIGHT",
        help="Part of the first camera's image that shows the flat thing [px]; if left out, all.")] = None,
    seed: Seed = 1, variant: Variant = None,
) -> None:  # fmt: skip
    """Fit a sensor file to captures of something flat by one's own unit in its own room.

    Light of the room, power, pattern, noise and row error, each with its uncertainty and the captures that told it.
    What they do not tell keeps the file's value. On stdout, a table.

    Example: mitsim fit sensor captures/sheet_* --off captures/no_projector --sensor ensenso-n10 -o my-camera.toml
    """
    start(variant)
    from mitsim.errors import InputError
    from mitsim.progress import say
    from mitsim.twin.run import fit_sensor
    from mitsim.twin.write import fit_table, write_sensor

    if not sensor:
        raise InputError("--sensor", "", "none", "the preset of this type of sensor, or a sensor TOML file")
    if output.suffix != ".toml":
        raise InputError("--output", "", str(output), "a .toml file")
    check_file(output)
    found = fit_sensor(captures or [], sensor, off=off or [], dark=dark or [], window=window, seed=seed)
    write_sensor(found, sensor, output)
    print(fit_table(found), end="")
    say(f"sensor: {output}, {len(found.estimates)} numbers fitted, {len(found.untold)} not told by these captures")


app.command(name="finish")(finish)
app.command(name="sensor")(sensor_)
