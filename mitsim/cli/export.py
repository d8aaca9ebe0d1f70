"""Write results as files of other programs: ``mitsim export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from characterisation.files.atomic_io import write_text
from characterisation.files.errors import InputError
from characterisation.words.numbers import how_many
from characterisation.words.progress import say
from mitsim.cli import options

#: file name suffixes that each command accepts
CLOUD_SUFFIXES = (".ply", ".pcd", ".e57", ".mcap")
RUN_SUFFIXES = (".glb", ".usda", ".usdc", ".usdz", ".rrd", ".mcap", ".e57")
RESULT_SUFFIXES = (".qif", ".xml", ".csv", ".json")

Views = Annotated[
    str, Option(help="best (views that are best for a measurement, or have a cloud), all, or numbers: 3,12.")
]


def cloud(
    context: typer.Context,
    cloud: Annotated[Path, Argument(help="PLY file that mitsim wrote.")],
    output: Annotated[Path, Option("--output", "-o", help=f"File to write: {', '.join(CLOUD_SUFFIXES)}.")],
    pose: Annotated[
        Path | None, Option(help="Pose of the sensor: pose.json, statement.json, or poses.json with --view.")
    ] = None,
    view: options.ViewOfPoses = None,
    frame: Annotated[
        str, Option("--in", help="Frame of the points in PLY and PCD: sensor, or part (needs --pose).")
    ] = "sensor",
    unit: Annotated[str, Option(help="Unit of PLY and PCD: mm or m. E57 and MCAP are in metres.")] = "mm",
) -> None:
    """Write a cloud with the covariance of every point as PLY, PCD, E57, or a ROS 2 message in MCAP.

    Example: mitsim export cloud runs/two_pillars/clouds/predicted_0012.ply -o cloud.pcd
    """
    import numpy as np

    from characterisation.cloud_files import read_cloud
    from mitsim.report.export.cloud_points import cloud_points
    from mitsim.report.export.cloud_writers import write_cloud_pcd, write_cloud_ply
    from mitsim.report.export.e57 import write_e57
    from mitsim.report.export.ros_bag import Stamped, write_mcap
    from mitsim.study.task_measurement import read_pose

    suffix = _suffix(output, CLOUD_SUFFIXES)
    for option, choice, allowed in (("--in", frame, ("sensor", "part")), ("--unit", unit, ("mm", "m"))):
        if choice not in allowed:
            raise InputError(option, "", repr(choice), " or ".join(allowed))
    part_from_sensor = None if pose is None else read_pose(pose, view)
    if frame == "part" and part_from_sensor is None:
        raise InputError("--in", "", "part, without --pose", "a JSON file with the sensor's pose", "give --pose FILE")
    if pose is None:
        options.refuse_unused(context, "no --pose", "--pose poses.json", "view")
    if suffix in (".e57", ".mcap"):
        options.refuse_unused(context, suffix, "no such option: it is of .ply and .pcd", "frame", "unit")
    elif suffix == ".ply" and frame == "sensor":
        options.refuse_unused(context, "points in the sensor frame", "--in part", "pose")
    read = read_cloud(cloud)
    options.check_file(output)
    if suffix == ".e57":
        write_e57([(cloud.stem, cloud_points(read), part_from_sensor)], output)
    elif suffix == ".mcap":
        write_mcap([Stamped("/points", "sensor_optical", cloud_points(read), part_from_sensor)], output)
    else:
        points = cloud_points(read, part_from_sensor if frame == "part" else None)
        points = points.in_metres() if unit == "m" else points
        if suffix == ".ply":
            write_cloud_ply(points, output)
        else:
            write_cloud_pcd(points, output, part_from_sensor)
    with_sigma = 0 if read.sigma is None else int(np.isfinite(read.sigma[read.valid]).sum())
    say(f"cloud: {output}: {int(read.valid.sum())} points, {with_sigma} of them with a covariance")


def run(
    folder: Annotated[Path, Argument(help="Folder of mitsim run, or of mitsim study choose (best sensor).")],
    output: Annotated[Path, Option("--output", "-o", help=f"File to write: {', '.join(RUN_SUFFIXES)}.")],
    views: Views = "best",
) -> None:
    """Write part, views and clouds of a run in one frame as glTF, USD, Rerun, MCAP (ROS 2 with tf) or E57.

    glTF and USD hold part and views. MCAP and E57 hold clouds with poses. Rerun holds all of these, and the status of
    every pixel.

    Example: mitsim export run runs/two_pillars -o two_pillars.rrd
    """
    from mitsim.report.export.cloud_points import cloud_points
    from mitsim.report.export.e57 import write_e57
    from mitsim.report.export.gltf import write_glb
    from mitsim.report.export.rerun_recording import write_rrd
    from mitsim.report.export.ros_bag import Stamped, write_mcap
    from mitsim.report.export.run_scene import read_run_scene
    from mitsim.report.export.usd import write_usd

    suffix = _suffix(output, RUN_SUFFIXES)
    folder = _run_in(folder)
    scene = read_run_scene(folder, views)
    scans = [(view, kind, cloud_points(cloud)) for view in scene.views for kind, cloud in view.clouds.items()]
    if suffix in (".mcap", ".e57") and not scans:
        raise InputError("--views", "", f"{views}: none of these views has a cloud", "views with clouds", "see clouds/")
    options.check_file(output)
    if suffix == ".glb":
        write_glb(scene, output)
    elif suffix == ".rrd":
        write_rrd(scene, output, folder.resolve().name)
    elif suffix == ".e57":
        write_e57([(f"{view.name}_{kind}", points, view.part_from_sensor) for view, kind, points in scans], output)
    elif suffix == ".mcap":
        write_mcap(
            [Stamped(f"/{v.name}/{kind}", f"{v.name}_optical", p, v.part_from_sensor) for v, kind, p in scans], output
        )
    else:
        write_usd(scene, output)
    written = [how_many(len(scene.views), "view")]
    written += [how_many(len(scans), "cloud")] if suffix in (".rrd", ".mcap", ".e57") else []
    say(f"run: {output}: {', '.join(written)}")


def results(
    context: typer.Context,
    folder: Annotated[Path, Argument(help="Folder of mitsim run, or of mitsim study choose (best sensor).")],
    output: Annotated[Path, Option("--output", "-o", help=f"File to write: {', '.join(RESULT_SUFFIXES)}.")],
    task: Annotated[Path | None, Option(help="Task TOML file of the run; default: the copy in the folder.")] = None,
    laboratory: Annotated[str, Option(help="For .xml: who issues the certificate.")] = "",
    country: Annotated[str, Option(help="For .xml: its country after ISO 3166-1, two letters.")] = "",
    responsible: Annotated[str, Option(help="For .xml: the person who signs.")] = "",
    customer: Annotated[str, Option(help="For .xml: for whom.")] = "",
    serial: Annotated[str, Option(help="For .xml: serial number of the sensor.")] = "",
) -> None:
    """Write the expected uncertainty of every measurement as QIF 3.0, CSV or JSON, or as DCC (.xml).

    QIF and JSON also have the plan of views. DCC is the digital calibration certificate of PTB.

    Example: mitsim export results runs/two_pillars -o two_pillars.qif
    """
    from mitsim.report.declaration import read_declaration
    from mitsim.report.export.dcc import Issuer, write_dcc
    from mitsim.report.export.qif import write_qif
    from mitsim.report.export.results import read_results, write_results_csv, write_results_json

    suffix = _suffix(output, RESULT_SUFFIXES)
    if suffix != ".xml":
        of_a_certificate = "laboratory", "country", "responsible", "customer", "serial"
        options.refuse_unused(context, suffix, "a certificate: .xml", *of_a_certificate)
    folder = _run_in(folder)
    run_results = read_results(folder, task)
    options.check_file(output)
    if suffix == ".xml":
        issuer = Issuer(laboratory, country, responsible, customer, serial)
        write_dcc(run_results, read_declaration(folder, None), issuer, output)
    else:
        write = {".qif": write_qif, ".csv": write_results_csv, ".json": write_results_json}
        write[suffix](run_results, output)
    views = ", ".join(str(number) for number, *_ in run_results.plan)
    say(f"results: {output}: {how_many(len(run_results.results), 'measurement')}, planned from view {views}")


def targets(
    folder: Annotated[Path, Argument(help="Folder of mitsim run, study score or study choose (best sensor).")],
    output: Annotated[Path, Option("--output", "-o", help="File to write.")],
    robot: Annotated[str, Option(help="Make of the robot: abb, kuka, ur or moveit.")],
    views: Annotated[
        str,
        Option(
            help="best (the set of the run, or the best view of each measurement; the stated view first), all, or "
            "numbers: 3,12."
        ),
    ] = "best",
) -> None:
    """Write views as targets of a robot, in the part frame, in the order and units of its maker.

    Example: mitsim export targets runs/two_pillars --robot kuka -o views.dat
    """
    from mitsim.report.export.robot_targets import ROBOT_FORMATS, read_targets

    if robot not in ROBOT_FORMATS:
        raise InputError("--robot", "", repr(robot), ", ".join(ROBOT_FORMATS))
    target_format = ROBOT_FORMATS[robot]
    if output.suffix.lower() != target_format.suffix:
        allowed = f"a name that ends in {target_format.suffix}: {target_format.description}"
        raise InputError("--output", "", output.name, allowed)
    robot_targets, tool = read_targets(_run_in(folder), views)
    options.check_file(output)
    write_text(output, target_format.write(robot_targets, tool))
    hint = "" if tool == "flange" else "; make the tool frame the sensor frame, or give [views.flange_from_sensor]"
    say(f"targets: {output}: {how_many(len(robot_targets), 'pose')} of the {tool} in the part frame{hint}")


def map_(
    map_file: options.MapFile,
    output: Annotated[Path, Option("--output", "-o", help="Folder to write.")],
    sensor: Annotated[
        str,
        Option(
            help="Sensor of the map, a preset or TOML file; it gives the direction of the baseline. Default: the "
            "preset."
        ),
    ] = "",
) -> None:
    """Write a map with a Python module that evaluates it with numpy alone: F and sigma from depth and normals.

    Example: mitsim export map ensenso-n10 -o kernel
    """
    from characterisation.maps.performance_map import PerformanceMap
    from characterisation.maps.shipped import map_path
    from mitsim.report.export.map_export import write_map_kernel
    from mitsim.sensor.preset import load_sensor, presets

    loaded = PerformanceMap.load(map_path(map_file))
    name = str(loaded.data.attrs.get("sensor", ""))
    if not sensor and name not in presets():
        raise InputError("--sensor", "", "nothing", f"the TOML file of {name or 'the sensor of the map'}, not a preset")
    chosen = load_sensor(sensor or name)
    if chosen.name != name:
        raise InputError("--sensor", "", chosen.name, f"{name}, the sensor of the map")
    options.check_new_folder(output)
    write_map_kernel(loaded, output, chosen.measuring_rig.baseline_direction)
    say(f"kernel: {output / 'sensor_map.py'}, {output / 'map.npz'}: {len(loaded.samples)} surfaces of {name}")


def bop(
    folder: Annotated[Path, Argument(help="Folder of mitsim render --many.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder to write; it must not exist.")],
    split: Annotated[str, Option(help="Name of the split: train, val or test.")] = "train",
    objects: Annotated[
        list[str] | None,
        Option(
            "--object",
            help="Pattern of the shapes that form one object: 'pin_1*'. Repeatable; default: all shapes "
            "are one object.",
        ),
    ] = None,
    variant: options.Variant = None,
) -> None:
    """Write many captures as a BOP data set: images, depth, reasons of missing pixels, masks, poses.

    Example: mitsim export bop captures/bracket -o datasets/bracket
    """
    if split not in ("train", "val", "test"):
        raise InputError("--split", "", repr(split), "train, val or test")
    options.start(variant)
    from mitsim.report.export.bop import find_sources, write_bop

    sources = find_sources(folder)
    options.check_new_folder(output)
    count = write_bop(sources, output, split, objects or ())
    say(f"data set: {output}: {count} images")


def _run_in(folder: Path) -> Path:
    """Return the folder to read: of a comparison of sensors, that of the best one."""
    from mitsim.study.choice_document import winner_folder

    winner = winner_folder(folder)
    if winner != folder:
        say(f"{folder} compares sensors: the export is of the best, {winner.name}")
    return winner


def _suffix(output: Path, allowed: tuple[str, ...]) -> str:
    if output.suffix.lower() not in allowed:
        raise InputError("--output", "", output.name, f"a name that ends in {', '.join(allowed)}")
    return output.suffix.lower()


def report(
    folder: Annotated[Path, Argument(help="Folder of mitsim run or mitsim study choose.")],
    pdf: Annotated[bool, Option("--pdf", help="Write a statement of uncertainty on one A4 sheet, to sign.")] = False,
) -> None:
    """Rewrite the HTML page of a finished run or of a comparison of sensors.

    Example: mitsim report runs/two_pillars --pdf
    """
    from mitsim.report.choice_page import write_choice_page
    from mitsim.report.page import write_report
    from mitsim.report.sheet import write_sheet
    from mitsim.study.choice_document import CHOICE

    if pdf:
        say(f"sheet: {write_sheet(folder)}")
    elif (folder / CHOICE).exists():
        say(f"page: {write_choice_page(folder)}")
    else:
        say(f"report: {write_report(folder)}")
