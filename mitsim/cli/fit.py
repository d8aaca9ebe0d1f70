"""Fit a finish or a sensor to captures: ``mitsim fit``.

``mitsim fit CAPTURES`` is short for ``mitsim fit finish CAPTURES``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from characterisation.files.atomic_io import write_json
from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options


def finish(
    captures: Annotated[list[Path], Argument(help="Capture folders of one flat coupon.")],
    sensor: Annotated[
        str | None, Option(help="Name of a preset, or path of a sensor TOML file; default: the preset of the captures.")
    ] = None,
    scene: Annotated[
        Path | None,
        Option(help="Scene of the coupon, with its size, metal and process; default: the one that the captures name."),
    ] = None,
    output: Annotated[Path | None, Option("--output", "-o", help="JSON file to write.")] = None,
    figure: Annotated[
        Path | None, Option(help="PNG picture to write: image, model and residual of the view that fits worst.")
    ] = None,
    block: Annotated[
        int | None,
        Option(
            min=4,
            max=128,
            help="Side of the blocks over which pixels are averaged [px]; default: 8, or 32 for an unknown pattern.",
        ),
    ] = None,
    window: Annotated[
        tuple[int, int, int, int] | None,
        Option(
            metavar="COLUMN ROW WIDTH HEIGHT",
            help="Window of the first camera's image that shows only the coupon [px]; default: from its pose, or from "
            "the plane with most points.",
        ),
    ] = None,
    define: options.Defines = None,
    variant: options.Variant = None,
) -> None:
    """Estimate the width alpha of a coupon's specular lobe, its equivalent Ra, and the projector's power.

    Prints them, and a table for a study that narrows the prior of the finish.

    Example: mitsim fit finish captures/coupon_* --scene scenes/coupon/coupon.xml -o fit.json --figure fit.png
    """
    options.start(variant)
    from characterisation.region_of_interest import Roi
    from mitsim.report.finish_figure import fit_figure, fit_table, remarks
    from mitsim.report.style import write_png
    from mitsim.twin.finish.run import fit_captures

    for file in (output, figure):
        if file is not None:
            options.check_file(file)
    roi = Roi(*window) if window else None
    coupon_fit = fit_captures(captures, sensor, scene, options.definitions(define), block, roi)
    print(fit_table(coupon_fit), end="")
    if coupon_fit.posterior is not None:
        comment = "# for a study whose part has this finish and the Ra of this scene"
        print(f"\n{comment}\n{coupon_fit.posterior.toml()}", end="")
    for remark in remarks(coupon_fit):
        say(remark)
    if output is not None:
        write_json(output, coupon_fit.numbers())
        say(f"fit: {output}")
    if figure is not None:
        write_png(fit_figure(coupon_fit), figure, dpi=90)
        say(f"picture: {figure}")


def sensor_(
    context: typer.Context,
    captures: Annotated[
        list[Path] | None,
        Argument(help="Capture folders of a flat object, with the projector on unless their settings say otherwise."),
    ] = None,
    sensor: Annotated[str, Option(help="Sensor to start from: a preset or a TOML file.")] = "",
    output: Annotated[Path, Option("--output", "-o", help="Sensor TOML file to write.")] = Path("my-camera.toml"),
    off: Annotated[list[Path] | None, Option(help="Capture with the projector off; once for each.")] = None,
    dark: Annotated[list[Path] | None, Option(help="Capture with all light off; once for each.")] = None,
    window: options.ObjectWindow = None,
    study: Annotated[
        Path | None,
        Option(help="Study TOML file: after the fit, also make the map of the sensor, and run the study with both."),
    ] = None,
    campaign: Annotated[
        Path | None, Option(help="With --study: campaign TOML file of the map; default: the one of the study.")
    ] = None,
    minutes: Annotated[float | None, Option(min=0.1, help="With --study: time of the run of the study [min].")] = None,
    yes: options.Yes = False,
    seed: options.Seed = 1,
    variant: options.Variant = None,
) -> None:
    """Fit a sensor file to captures of a flat object by your own camera in your own room.

    Estimates room light, projector power, pattern, noise and row error, each with its uncertainty and its captures.
    A parameter that the captures do not determine keeps its value. Prints a table, and last a verdict: good, fair, bad,
    or not tested. With --study, map and report follow, unless the fit is bad; each step announces its time.

    Example: mitsim fit sensor captures/sheet_* --off captures/no_projector --sensor ensenso-n10 -o my-camera.toml
    """
    options.start(variant)
    from characterisation.region_of_interest import Roi
    from mitsim.cli.fit_journey import map_and_run, read_journey
    from mitsim.twin.sensor.run import fit_sensor
    from mitsim.twin.sensor.write import fit_table, write_sensor

    if not sensor:
        raise InputError("--sensor", "", "none", "the preset of this type of sensor, or a sensor TOML file")
    if output.suffix.lower() != ".toml":
        raise InputError("--output", "", str(output), "a .toml file")
    options.check_file(output)
    if study is None:
        options.refuse_unused(context, "no --study", "--study study.toml", "campaign", "minutes", "yes")
    journey = None if study is None else read_journey(study, campaign, output, minutes, options.asking(yes))
    if journey is not None:
        say("step 1 of 3: the fit; its first message of every capture states the time of a round")
    roi = Roi(*window) if window else None
    sensor_fit = fit_sensor(captures or [], sensor, off=off or [], dark=dark or [], roi=roi, seed=seed)
    write_sensor(sensor_fit, sensor, output)
    print(fit_table(sensor_fit), end="")
    say(f"sensor: {output}, {sensor_fit.count_in_words}")
    say(f"verdict: {sensor_fit.verdict.word}: {sensor_fit.verdict.why}")
    if journey is None:
        return
    if sensor_fit.verdict.word == "bad":
        hint = f"to go on nevertheless: mitsim map make {journey.campaign} --sensor {output}, and mitsim run"
        raise InputError(output, "verdict", "bad", "good or fair, for a map and a report", hint)
    map_and_run(journey, output)
