"""Fit the simulator to captures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.commands.options import Defines, Variant, check_file, definitions, start


def fit(
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

    Example: mitsim fit captures/coupon_* --scene scenes/coupon/coupon.xml -o fit.json --figure fit.png
    """
    start(variant)
    from characterisation.whole_files import write_json
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
