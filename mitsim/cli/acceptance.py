"""Acceptance figures of clouds of planes and spheres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options

if TYPE_CHECKING:
    from characterisation.point_cloud import PointCloud
    from characterisation.region_of_interest import Roi
    from characterisation.tasks.result import Result


def acceptance(
    context: typer.Context,
    clouds: options.Clouds,
    plane: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=COLUMN,ROW,WIDTH,HEIGHT,DISTANCE",
            help="A flat target in a window of the cloud [px] and its true distance along its normal [mm]; "
            "NAME=DISTANCE: the whole cloud. Without DISTANCE, no depth error.",
        ),
    ] = None,
    sphere: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=COLUMN,ROW,WIDTH,HEIGHT,DIAMETER",
            help="A sphere in a window [px] and its calibrated diameter [mm].",
        ),
    ] = None,
    spacing: Annotated[
        list[str] | None,
        Option(metavar="NAME,NAME,DISTANCE", help="Two spheres and the calibrated distance of their centres."),
    ] = None,
    baseline: Annotated[
        float | None, Option(min=1.0, max=10000.0, help="Baseline of a stereo camera [mm]: adds sub-pixel RMS.")
    ] = None,
    simulated: options.Simulated = None,
    topic: options.Topic = None,
    frame: options.Frame = None,
    unit: options.Unit = None,
    as_json: options.Json = False,
    sensor: options.DecodedAs = None,
    seed: options.Seed = 1,
    variant: options.Variant = None,
) -> None:
    """Compute acceptance figures of VDI/VDE 2634-2 and of makers' data sheets from clouds of planes and spheres.

    Several clouds of one pose add the figures that need repeats: temporal noise, global planarity trueness, mean depth
    error. Exit code 1 if a figure could not be computed.

    Example: mitsim measure acceptance captures/plate --plane plate=200,150,300,200,600 --simulated zivid-2-m70
    """
    from characterisation.tasks.result import repeatability
    from mitsim.cli.acceptance_request import Artefacts, cloud_figures, joint_figures, read_artefacts
    from mitsim.cli.simulated_beside import RecordedTarget, beside_simulated, beside_table
    from mitsim.decoding import measured_document as documents
    from mitsim.decoding.input_clouds import cloud_paths, read_cloud, tell_of_copies

    options.check_unit(unit)
    artefacts = read_artefacts(plane or [], sphere or [], spacing or [])
    if not (artefacts.planes or artefacts.spheres):
        command = "mitsim measure acceptance"
        raise InputError(command, "", "no artefact", "--plane or --sphere", f"see {command} --help")
    if simulated is None:
        options.refuse_unused(context, "no --simulated", "--simulated SENSOR", "seed", "variant")
    if not artefacts.planes:
        options.refuse_unused(context, "no --plane", "a --plane, whose sub-pixel RMS needs it", "baseline")
    chosen = tuple(topic) if topic else None
    input_clouds = [read_cloud(path, sensor, topic=chosen, frame=frame, unit=unit) for path in cloud_paths(clouds)]
    found: dict[str, Path] = {}
    for input_cloud in input_clouds:
        tell_of_copies(found, input_cloud)
    results = [cloud_figures(input_cloud.cloud, artefacts, baseline) for input_cloud in input_clouds]
    several = len(input_clouds) > 1
    together = joint_figures([input_cloud.cloud for input_cloud in input_clouds], artefacts) if several else []
    over = repeatability(results) if several else []
    beside: tuple[list[Result], list[Result]] | None = None
    if simulated is not None:
        options.start(variant)

        def figures(cloud: PointCloud, name: str, window: Roi | None) -> list[Result]:
            if name in artefacts.planes:
                target = Artefacts({name: (window, artefacts.planes[name][1])}, {}, [])
            else:
                target = Artefacts({}, {name: (window, artefacts.spheres[name][1])}, [])
            return cloud_figures(cloud, target, baseline)

        targets = {name: RecordedTarget("plane", *values) for name, values in artefacts.planes.items()}
        targets |= {name: RecordedTarget("sphere", window) for name, (window, _) in artefacts.spheres.items()}
        beside = beside_simulated(input_clouds[0], targets, simulated, figures, seed)
    if as_json:
        whose = [(input_cloud.path, input_cloud.cloud.sensor, input_cloud.cloud.source) for input_cloud in input_clouds]
        document = documents.measured_document(whose, results, over)
        document |= {"all_clouds": [documents.result_values(result) for result in together]}
        if beside is not None:
            document |= {"beside": documents.beside_document(simulated or "", *beside)}
        print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))
    else:
        print(documents.result_tables([input_cloud.path for input_cloud in input_clouds], results, over))
        if together:
            print("\nall clouds\n" + documents.result_table(together))
        if beside is not None:
            print(f"\n{input_clouds[0].path}, beside a simulation\n" + beside_table(*beside, simulated or ""))
    say(documents.summary([*results, together] if together else results))
    if not all(result.possible for cloud_results in [*results, together] for result in cloud_results):
        raise typer.Exit(1)
