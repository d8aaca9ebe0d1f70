"""Measure in clouds: features in windows, plates of dots, tasks, differences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options

if TYPE_CHECKING:
    from characterisation.point_cloud import PointCloud
    from characterisation.region_of_interest import Roi
    from characterisation.tasks.result import Result
    from mitsim.decoding.input_clouds import InputCloud

_WINDOW = "NAME=COLUMN,ROW,WIDTH,HEIGHT"


def clouds(
    context: typer.Context,
    inputs: options.Clouds,
    plane: Annotated[
        list[str] | None,
        Option(
            metavar=_WINDOW,
            help="Flatness, noise, distance and normal of the plane in a window [px]; NAME alone: the whole cloud.",
        ),
    ] = None,
    sphere: Annotated[
        list[str] | None,
        Option(metavar=_WINDOW, help="Diameter, noise, distance and centre of the sphere in a window."),
    ] = None,
    cylinder: Annotated[
        list[str] | None, Option(metavar=_WINDOW, help="Diameter, cylindricity and noise of the cylinder in a window.")
    ] = None,
    angle: Annotated[
        list[str] | None, Option(metavar="NAME,NAME", help="Angle between two planes or cylinders, 0 to 90 deg.")
    ] = None,
    distance: Annotated[
        list[str] | None,
        Option(metavar="NAME,NAME", help="Distance between planes, cylinders, spheres, or a sphere and a plane [mm]."),
    ] = None,
    dots: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=COLUMN,ROW,WIDTH,HEIGHT,PITCH",
            help="Spacing of the dots of a plate with known PITCH [mm]; NAME=PITCH: the whole image. Captures only.",
        ),
    ] = None,
    bright_dots: Annotated[bool, Option("--bright-dots", help="The dots are brighter than the plate.")] = False,
    task: Annotated[Path | None, Option(help="Task TOML file: measure what it defines; needs --scene.")] = None,
    scene: Annotated[Path | None, Option(help="Scene of the part; it assigns pixels to features.")] = None,
    pose: options.PoseFile = None,
    view: options.ViewOfPoses = None,
    correct: Annotated[
        Path | None,
        Option(
            metavar="STATEMENT",
            help="Subtract the bias in this statement.json, made for the same view, from the values of the task.",
        ),
    ] = None,
    against: Annotated[
        Path | None,
        Option(
            metavar="CLOUD", help="Reference cloud: signed difference of each cloud from it, in the same frame [mm]."
        ),
    ] = None,
    by: Annotated[
        str,
        Option(
            help="Direction of the difference: rays, surface (normal), or auto: rays if both clouds have the same grid."
        ),
    ] = "auto",
    window: Annotated[
        tuple[int, int, int, int] | None,
        Option(metavar="COLUMN ROW WIDTH HEIGHT", help="Window of the difference [px]."),
    ] = None,
    picture: Annotated[
        Path | None,
        Option(help="PNG picture to write: the difference, or the distances and windows; numbered for several clouds."),
    ] = None,
    points_in: Annotated[
        str,
        Option(
            metavar="FRAME",
            help="Frame of centres, axes, normals and perpendicular distances: sensor; workspace (an Ensenso's Link); "
            "board=COLUMNS,ROWS,PITCH, the inner corners of a chequerboard in the images [mm]; or the pose.json of "
            "the sensor in another frame.",
        ),
    ] = "sensor",
    simulated: options.Simulated = None,
    topic: options.Topic = None,
    frame: options.Frame = None,
    unit: options.Unit = None,
    as_json: options.Json = False,
    sensor: options.DecodedAs = None,
    seed: options.Seed = 1,
    define: options.Defines = None,
    variant: options.Variant = None,
) -> None:
    """Measure planes, spheres, cylinders, dots or a task in point clouds, or the difference from another cloud.

    For several clouds, also print mean and standard deviation of each measurement. u is the standard uncertainty from
    the covariance of the fit. The command lists the effects that u does not include. Exit code 1 if a measurement was
    not possible.

    Example: mitsim measure cloud.ply --plane top=100,50,200,150 --plane side=400,60,90,300 --angle top,side
    """
    from characterisation.tasks.result import NOT_INCLUDED, repeatability
    from characterisation.tasks.windows import WindowPlan, measure_windows
    from mitsim.cli.measure_frame import read_frame
    from mitsim.cli.measure_request import read_request
    from mitsim.decoding.input_clouds import cloud_paths, read_cloud, tell_of_copies
    from mitsim.decoding.measured_document import beside_document, measured_document, result_tables, summary

    options.check_unit(unit)
    request = read_request(
        {"plane": plane or [], "sphere": sphere or [], "cylinder": cylinder or []},
        {"angle": angle or [], "distance": distance or []},
        dots or [],
        bright_dots,
        against,
        by,
        window,
    )
    places_in = read_frame(points_in)
    if task is None:
        of_a_task = "scene", "pose", "correct", "define", *(("view",) if places_in.file is None else ())
        options.refuse_unused(context, "no --task", "a task for the scene: --task task.toml", *of_a_task)
    if simulated is None:
        options.refuse_unused(context, "no --simulated", "--simulated SENSOR", "seed")
    if simulated is None and task is None:
        options.refuse_unused(context, "no --task and no --simulated", "one of them", "variant")
    if not dots:
        options.refuse_unused(context, "no --dots", "--dots NAME=PITCH", "bright_dots")
    if not request.plan.features:
        options.refuse_unused(context, "no feature", "--plane, --sphere or --cylinder", "points_in")
    if task is not None and scene is None:
        raise InputError("--scene", "", "none", "the scene of the task's part: --scene part.xml")
    if request.empty and task is None and picture is None:
        allowed = "--plane, --sphere, --cylinder, --dots, --task, --against or --picture"
        raise InputError("mitsim measure", "", "nothing to measure", allowed, "see mitsim measure --help")
    if picture is not None:
        options.check_file(picture)
    of_task = None
    if simulated is not None or (task is not None and scene is not None):
        options.start(variant)
    if task is not None and scene is not None:
        of_task = _task(task, scene, pose, view, correct, options.definitions(define))
    reference = None if against is None else read_cloud(against, sensor, reference=True, unit=unit)
    paths = cloud_paths(inputs)
    beside: tuple[list[Result], list[Result]] | None = None
    targets = {name: feature for name, feature in request.plan.features.items() if feature[0] != "cylinder"}
    if simulated is not None and not targets:
        raise InputError("--simulated", "", "no --plane and no --sphere", "a plane or a sphere to simulate")

    def figures(cloud: PointCloud, name: str, window: Roi | None) -> list[Result]:
        return measure_windows(cloud, WindowPlan({name: (request.plan.features[name][0], window)}))

    whose: list[tuple[Path, str, str]] = []
    results: list[list[Result]] = []
    found: dict[str, Path] = {}
    for number, path in enumerate(paths):
        if len(paths) > 1:
            say(f"{path} ({number + 1}/{len(paths)})")
        input_cloud = read_cloud(path, sensor, topic=tuple(topic) if topic else None, frame=frame, unit=unit)
        tell_of_copies(found, input_cloud)
        if picture is not None and input_cloud.cloud.grid.height == 1:
            raise InputError("--picture", "", f"{path}, a cloud without a grid", "a cloud with rows and columns")
        to_frame, about_frame = places_in.of(input_cloud, view)
        if about_frame:
            say(about_frame)
        cloud_results, drawn = request.measure(input_cloud, reference, to_frame)
        if simulated is not None and beside is None:
            from mitsim.cli.simulated_beside import RecordedTarget, beside_simulated

            recorded = {name: RecordedTarget(*target) for name, target in targets.items()}
            beside = beside_simulated(input_cloud, recorded, simulated, figures, seed)
        if of_task is not None:
            cloud_results += of_task(input_cloud)
        if picture is not None:
            from mitsim.report.style import write_png

            file = picture if len(paths) == 1 else picture.with_stem(f"{picture.stem}_{number + 1}")
            options.check_file(file)
            write_png(drawn(), file, dpi=100)
            say(f"picture: {file}")
        whose.append((path, input_cloud.cloud.sensor, input_cloud.cloud.source))
        results.append(cloud_results)
    over = repeatability(results) if len(results) > 1 else []
    if as_json:
        document = measured_document(whose, results, over)
        if beside is not None:
            document |= {"beside": beside_document(simulated or "", *beside)}
        print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))
    elif not request.empty or of_task is not None:
        print(result_tables(paths, results, over))
        if beside is not None:
            from mitsim.cli.simulated_beside import beside_table

            print(f"\n{paths[0]}, beside a simulation\n" + beside_table(*beside, simulated or ""))
        if any(result.origin == "fit" for cloud_results in results for result in cloud_results):
            left_out = "; ".join(NOT_INCLUDED)
            say(f"u: standard uncertainty (k = 1) from the covariance of the fit; it does not include: {left_out}")
        if correct is not None:
            say(f"u of the task: standard uncertainty after correction, including that of the bias, from {correct}")
    if results and any(results):
        say(summary(results))
    if not all(result.possible for cloud_results in results for result in cloud_results):
        raise typer.Exit(1)


def _task(
    task: Path, scene: Path, pose: Path | None, view: int | None, correct: Path | None, defined: dict[str, str]
) -> Any:
    """Return the function that measures a task in a cloud."""
    from characterisation.tasks.task_reading import check_features, read_task
    from mitsim.scene.load import load_scene
    from mitsim.sensor.preset import load_sensor
    from mitsim.study.task_measurement import measure_task, read_pose, read_view_statement, unit_doubt

    definition = read_task(task)
    # feature positions do not depend on the finish, so any wavelength serves to load the scene
    loaded = load_scene(scene, load_sensor("ensenso-n10").wavelength_nm, defined)
    check_features(definition, task, loaded.names)
    statement = None if correct is None else read_view_statement(correct)
    given_pose = None if pose is None else read_pose(pose, view)

    def measured(cloud: InputCloud) -> list[Result]:
        world_from_sensor = given_pose or (None if cloud.capture is None else cloud.capture.world_from_sensor)
        if world_from_sensor is None:
            raise InputError(cloud.path, "pose", "none", "the pose of the sensor: --pose FILE")
        if doubt := unit_doubt(cloud.cloud, loaded, world_from_sensor):
            say(f"warning: {cloud.path if pose is None else pose}: {doubt}")
        return measure_task(cloud.cloud, definition, loaded, world_from_sensor, statement, cloud.margin_px)

    return measured
