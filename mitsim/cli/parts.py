"""Check a scene before rendering, and make a scene from a CAD file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from characterisation.files.atomic_io import write_text
from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options

if TYPE_CHECKING:
    from mitsim.scene.authoring.check import Authored
    from mitsim.scene.visible_surfaces import VisibleSurfaces
    from mitsim.sensor.sensor import Sensor
    from mitsim.sensor.transforms import Transform


def check(
    context: typer.Context,
    scene: options.Scene,
    position: Annotated[
        tuple[float, float, float] | None,
        Option(help="Position of the sensor in the frame of the scene [mm]; default: 45 deg above the part."),
    ] = None,
    target: options.Target = (0.0, 0.0, 0.0),
    roll: options.Roll = 0.0,
    pose: Annotated[
        Path | None,
        Option(
            help="File with the pose of the sensor, in place of --position: pose.json, statement.json, or poses.json "
            "with --view."
        ),
    ] = None,
    view: options.ViewOfPoses = None,
    sensor: options.SensorOption = "ensenso-n10",
    task: Annotated[Path | None, Option(help="Task TOML file; check that the scene has its features.")] = None,
    output: Annotated[Path | None, Option("--output", "-o", help="PNG picture to write.")] = None,
    bounces: Annotated[
        Path | None,
        Option(help="PNG picture to write: the share of interreflected light, and the face that it comes from."),
    ] = None,
    every: Annotated[
        bool, Option("--all", help="Print every shape and finding, not the measured and first shapes only.")
    ] = False,
    json: options.Json = False,
    html: Annotated[
        Path | None, Option(help="HTML page to write: edit names, finishes and measurements, then download the files.")
    ] = None,
    define: options.Defines = None,
    variant: options.Variant = None,
) -> None:
    """List the contents of a scene, warn of likely mistakes, and draw it from the sensor and from above.

    Exit code 1 if a finding is an error.

    Example: mitsim check scenes/two_pillars/two_pillars.xml --task scenes/two_pillars/task.toml -o preview.png
    """
    if position is None:
        options.refuse_unused(context, "no --position", "--position X Y Z", "target")
    if pose is not None:
        options.refuse_unused(context, "--pose", "no such option: the pose has it", "roll")
    else:
        options.refuse_unused(context, "no --pose", "--pose poses.json", "view")
    options.start(variant)
    import json as json_module

    from mitsim.report.scene_table import as_data, as_text
    from mitsim.sensor.preset import load_sensor
    from mitsim.sensor.working_volume import usual_place

    chosen = load_sensor(sensor)
    stand = None if position is None else options.pose_of(position, target, roll, chosen)
    if pose is not None:
        from mitsim.study.task_measurement import read_pose

        if position is not None:
            raise InputError("--pose", "", "--position too", "one of them")
        stand = read_pose(pose, view)
    checked, visible, placed = _inspected(scene, chosen, options.definitions(define), task, stand, roll)
    facts, findings, centre = checked.facts, checked.findings, checked.scene.centre
    if stand is None:
        ends = [" ".join(f"{round(float(v), 1) + 0.0:g}" for v in end) for end in (usual_place(chosen, centre), centre)]
        say(f"no position was given: using --position {ends[0]} --target {ends[1]}")
    measured = checked.task.measured_shapes() if checked.task else ()
    if output:
        from mitsim.report.scene_preview import preview_figure
        from mitsim.report.style import write_png

        options.check_file(output)
        first = list(checked.task.features) if checked.task else []
        write_png(preview_figure(checked.scene, facts, chosen, placed, visible, first, measured), output)
        say(f"picture: {output}")
    if bounces:
        from mitsim.report.bounce_figure import bounce_figure, bounced_light
        from mitsim.report.style import write_png

        options.check_file(bounces)
        light = bounced_light(checked.scene, chosen, placed, visible)
        write_png(bounce_figure(light, checked.scene.names, f"{scene.stem} before {chosen.name}"), bounces)
        say(f"picture: {bounces}")
    if html:
        from mitsim.report.author_page import author_page

        options.check_file(html)
        write_text(html, author_page(checked))
        say(f"page: {html}")
    if json:
        about = {"scene": checked.scene.where, "sensor": chosen.name, "world_from_sensor": placed.matrix().tolist()}
        print(json_module.dumps({**about, **as_data(facts, visible, findings)}, indent=2))
    else:
        print(as_text(facts, visible, findings, measured, every))
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(1)


def _inspected(
    scene: Path, sensor: Sensor, defined: dict[str, str], task: Path | None, stand: Transform | None, roll: float = 0.0
) -> tuple[Authored, VisibleSurfaces, Transform]:
    """Load a scene and look for mistakes; return also the surfaces that the sensor sees, and its pose."""
    from mitsim.scene.authoring.check import Authored, findings
    from mitsim.scene.authoring.check_task import read_features
    from mitsim.scene.inspect import inspect
    from mitsim.scene.load import load_scene
    from mitsim.scene.visible_surfaces import visible_surfaces
    from mitsim.sensor.working_volume import pose_at, usual_place

    wanted = read_features(task) if task else None
    loaded = load_scene(scene, sensor.wavelength_nm, defined)
    pose = stand or pose_at(sensor, usual_place(sensor, loaded.centre), loaded.centre, roll)
    facts, visible = inspect(loaded), visible_surfaces(loaded, sensor.rig, pose)
    scene_findings = findings(facts, sensor, pose, visible, stand is not None, wanted)
    return Authored(loaded, facts, sensor, scene_findings, task, wanted), visible, pose


def part(
    context: typer.Context,
    file: Annotated[Path, Argument(help="STEP file, or a mesh: STL, OBJ, PLY, OFF, 3MF or glTF.")],
    output: Annotated[Path | None, Option("--output", "-o", help="Scene folder to write.")] = None,
    units: Annotated[
        str | None,
        Option(
            help="Unit of a file that states none: um, mm, cm, m, inch or foot; default: that of the file, else mm."
        ),
    ] = None,
    metal: Annotated[str | None, Option(help="Metal of all faces; default aluminium.")] = None,
    process: Annotated[str | None, Option(help="Machining process of all faces; default ground.")] = None,
    roughness: Annotated[
        float | None, Option("--Ra", help="Roughness average Ra of all faces [um]; default 0.8.")
    ] = None,
    finish: Annotated[
        str | None,
        Option(
            help="Plastic, casting or paint in place of metal, process and Ra: black_plastic, grey_plastic, "
            "white_plastic, glossy_black_plastic, iron_casting, aluminium_casting, powder_coat, gloss_paint, "
            "matt_white."
        ),
    ] = None,
    reflectance: Annotated[float | None, Option(help="Diffuse reflectance of a paint or plastic, 0 to 1.")] = None,
    gloss: Annotated[float | None, Option(help="Gloss of a paint or plastic at 60 deg [GU].")] = None,
    angle: Annotated[
        float, Option(help="For a mesh: neighbouring triangles that meet at less than this angle form one face [deg].")
    ] = 20.0,
    sensor: Annotated[
        str | None, Option(help="For a STEP file: mesh it as finely as this sensor resolves (preset or TOML file).")
    ] = None,
    chord: Annotated[float | None, Option(help="For a STEP file: chord error of the mesh [mm]; default 0.01.")] = None,
    edit: Annotated[
        bool,
        Option(
            "--edit",
            help="Serve a page to edit names, finishes and measurements; it saves to the folder. "
            "FILE may also be the XML file of a scene.",
        ),
    ] = False,
    port: Annotated[int, Option(help="Port of --edit on 127.0.0.1; 0: any free port.")] = 0,
) -> None:
    """Convert a STEP file or a mesh to a scene with one named shape per face, and a task with the drawing's dimensions.

    Any finish is possible. If a sensor's map lacks it, `mitsim run` and `mitsim study score` can characterise it.

    Example: mitsim part bracket.step -o scenes/bracket --process milled --Ra 1.6 --sensor ensenso-n10 --edit
    """
    from mitsim.scene.authoring.fineness import fineness_for
    from mitsim.scene.authoring.part_folder import Finishing, described, write_part
    from mitsim.scene.authoring.read_mesh import STEP
    from mitsim.scene.authoring.read_step import Fineness

    if not edit:
        options.refuse_unused(context, "no --edit", "--edit", "port")
    if edit and file.suffix.lower() == ".xml":
        of_a_new_scene = "output", "units", "metal", "process", "roughness", "finish", "reflectance", "gloss"
        allowed = "no such option, or a STEP file or mesh: --edit keeps the folder of a scene"
        options.refuse_unused(context, file.name, allowed, *of_a_new_scene, "angle", "chord")
        _edit(file, sensor, port)
        return
    if output is None:
        raise InputError("--output", "", "nothing", "a folder to write: -o scenes/NAME")
    if file.suffix.lower() in STEP:
        options.refuse_unused(context, file.name, "a mesh: a STEP file has its own faces", "angle")
    else:
        allowed = "a STEP file: a mesh has its own triangles"
        options.refuse_unused(context, file.name, allowed, "chord", *(() if edit else ("sensor",)))
    if sensor is not None and chord is not None:
        raise InputError("--chord", "", f"{chord:g} together with --sensor", "one of the two")
    fine = fineness_for(sensor) if sensor else Fineness() if chord is None else Fineness(chord)
    if finish is not None:
        for option, value in (("--metal", metal), ("--process", process), ("--Ra", roughness)):
            if value is not None:
                raise InputError(option, "", f"{value} together with --finish", "one of the two")
    finishing = Finishing(
        metal or "aluminium", process or "ground", 0.8 if roughness is None else roughness, finish, reflectance, gloss
    )
    options.check_new_folder(output)
    made = write_part(file, output, units, finishing, angle, fine)
    for remark in made.remarks:
        say(remark)
    for face in made.faces:
        print(f"{face.name}\t{described(face)}")
    if made.drawing is not None:
        say("\n".join(made.drawing.remarks()))
    scene = output / f"{output.absolute().name}.xml"
    say(f"scene: {scene}\ntask: {output / 'task.toml'}")
    if edit:
        _edit(scene, sensor, port)
    elif made.drawing is None or not made.drawing.measurements:
        say(f"next: write measurements into task.toml, or choose them on a page: mitsim part {scene} --edit")


def _edit(scene: Path, sensor: str | None, port: int) -> None:
    """Serve the editor page of a scene until the user ends it."""
    options.start(None)
    from mitsim.report.author_page import author_page, findings_data
    from mitsim.report.author_server import AuthorServer
    from mitsim.sensor.preset import load_sensor

    chosen, task = load_sensor(sensor or "ensenso-n10"), scene.parent / "task.toml"
    if not 0 <= port <= 65535:
        raise InputError("--port", "", port, "0 to 65535")

    def authored() -> Authored:
        return _inspected(scene, chosen, {}, task if task.exists() else None, None)[0]

    authored()  # report errors in the scene before serving the page
    names = {"scene": scene.name, "task": task.name, "study": "study.toml"}

    def page(token: str) -> str:
        return author_page(authored(), token)

    try:
        server = AuthorServer(scene.parent, names, page, lambda: findings_data(authored().findings), port)
    except OSError as error:
        raise InputError("--port", "", f"{port} ({error})", "a free port, or 0") from None
    print(server.address, flush=True)
    say("open this address in a browser on this machine; end with 'Save and finish' there, or Ctrl-C here")
    try:
        server.serve()
    except KeyboardInterrupt:
        say("ended")
    say(f"saved {'once' if server.saved == 1 else f'{server.saved} times'} to {scene.parent}")
