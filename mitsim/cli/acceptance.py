"""Acceptance figures of clouds of planes and spheres."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from characterisation.files.errors import InputError
from mitsim.cli.options import Clouds, DecodedAs, Json


def acceptance(
    clouds: Clouds,
    plane: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COLUMN,ROW,WIDTH,HEIGHT,DISTANCE",
            help="A flat target in a window [px] and its true distance along its normal [mm]; NAME=DISTANCE: the whole "
            "cloud. Without DISTANCE, no depth error.",
        ),
    ] = None,
    sphere: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COLUMN,ROW,WIDTH,HEIGHT,DIAMETER",
            help="A sphere in a window [px] and its calibrated diameter [mm].",
        ),
    ] = None,
    spacing: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME,NAME,DISTANCE", help="Two spheres and the calibrated distance of their centres."),
    ] = None,
    baseline: Annotated[
        float | None, typer.Option(min=1.0, max=10000.0, help="Baseline of a stereo camera [mm]: adds sub-pixel RMS.")
    ] = None,
    as_json: Json = False,
    sensor: DecodedAs = None,
) -> None:
    """Compute acceptance figures of VDI/VDE 2634-2 and of makers' data sheets from clouds of planes and spheres.

    Several clouds of one pose add the figures that need repeats: temporal noise, global planarity trueness, mean depth
    error. Exit code 1 if a figure could not be computed.

    Example: mitsim measure acceptance captures/plate --plane plate=200,150,300,200,600
    """
    from characterisation.tasks.result import repeatability
    from mitsim.cli.acceptance_request import cloud_figures, joint_figures, read_artefacts
    from mitsim.decoding.input_clouds import cloud_paths, read_cloud
    from mitsim.decoding.measured_document import measured_document, result_table, result_tables, result_values, summary
    from mitsim.running.progress import say

    artefacts = read_artefacts(plane or [], sphere or [], spacing or [])
    if not (artefacts.planes or artefacts.spheres):
        command = "mitsim measure acceptance"
        raise InputError(command, "", "no artefact", "--plane or --sphere", f"see {command} --help")
    given = [read_cloud(path, sensor) for path in cloud_paths(clouds)]
    results = [cloud_figures(one.cloud, artefacts, baseline) for one in given]
    several = len(given) > 1
    together = joint_figures([one.cloud for one in given], artefacts) if several else []
    over = repeatability(results) if several else []
    if as_json:
        whose = [(one.path, one.cloud.sensor, one.cloud.source) for one in given]
        document = measured_document(whose, results, over) | {"all_clouds": [result_values(one) for one in together]}
        print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))
    else:
        print(result_tables([one.path for one in given], results, over))
        if together:
            print("\nall clouds\n" + result_table(together))
    say(summary([*results, together] if together else results))
    if not all(result.possible for found in [*results, together] for result in found):
        raise typer.Exit(1)
