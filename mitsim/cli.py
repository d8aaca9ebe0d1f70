"""The command line: every stage of the pipeline as a command.

Data goes to files or stdout, talk and progress to stderr. Exit codes: 0 done and passed, 1 ran but a check failed,
2 usage or bad input, 3 the machine lacks something. Heavy imports stand inside the commands, so that ``--help`` is
quick.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from mitsim.errors import InputError, MissingEnvironmentError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Simulate 3D vision sensors, characterise them, and find where to put them.",
)

Out = Annotated[Path, typer.Option("--output", "-o", help="Folder or file to write.")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant: cuda_ad_mono or llvm_ad_mono.")]
SensorOption = Annotated[str, typer.Option(help="A preset's name, or the path of a sensor TOML file.")]
Defines = Annotated[list[str] | None, typer.Option("-D", help="Set a scene's <default>: name=value. May be repeated.")]
Position = Annotated[tuple[float, float, float], typer.Option(help="Where the sensor stands [mm], world frame.")]
Target = Annotated[tuple[float, float, float], typer.Option(help="What it looks at [mm], world frame.")]
Roll = Annotated[float, typer.Option(help="Turn about the view axis [deg].")]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same result.")]


@app.command()
def doctor(json: Annotated[bool, typer.Option("--json", help="For machines.")] = False) -> None:
    """Say what is there, what is missing, and how to mend it.

    Example: mitsim doctor
    """
    import json as json_module

    from mitsim.doctor import examine, findings_as_json

    findings = examine()
    if json:
        print(json_module.dumps(findings_as_json(findings), indent=2))
    else:
        for finding in findings:
            print(f"{finding.verdict:8} {finding.what:32} {finding.detail}")
            if finding.fix:
                print(f"{'':8} {'':32} -> {finding.fix}")
    if any(finding.verdict == "missing" for finding in findings):
        raise typer.Exit(3)


@app.command()
def run(study: Path, output: Out, variant: Variant = None) -> None:
    """Run a study: characterise, predict, score, check by rendering, report.

    Example: mitsim run scenes/two_pillars/study.toml -o runs/two_pillars
    """
    _start(variant)
    from mitsim.progress import say
    from mitsim.report.page import write_report
    from mitsim.study import read_study, run_study

    _writable(output)
    run_study(read_study(study), output)
    write_report(output)
    say(f"scores: {output / 'scores.csv'}\nreport: {output / 'report.html'}")


@app.command()
def render(
    scene: Path, output: Out, position: Position, target: Target = (0.0, 0.0, 0.0), roll: Roll = 0.0,
    sensor: SensorOption = "ensenso-n10", seed: Seed = 1,
    samples: Annotated[int, typer.Option(min=1, max=65536, help="Per pixel.")] = 16,
    depth: Annotated[int, typer.Option(min=1, max=16, help="Surfaces on a light path; 1 is direct light.")] = 3,
    noise: Annotated[str, typer.Option(help="all, none, some (shot,read), or all but some (no-speckle).")] = "all",
    deviation: Annotated[str, typer.Option(
        help="Move what is not known of the finishes, in standard deviations: alpha=1,wide_angle=-1.")] = "",
    truth: Annotated[bool, typer.Option("--truth", help="Also write what is true at each pixel, as OpenEXR.")] = False,
    define: Defines = None, variant: Variant = None,
) -> None:  # fmt: skip
    """Take one simulated capture of a scene.

    Example: mitsim render scenes/two_pillars/two_pillars.xml --position 0 -400 300 -o captures/first
    """
    _start(variant)
    from dataclasses import asdict
    from math import isfinite

    from mitsim.capture.folder import write_capture
    from mitsim.capture.render_residual import LIMIT, render_residual
    from mitsim.capture.simulate import SimulatedSensor
    from mitsim.capture.truth import encode_exr, true_image
    from mitsim.progress import say
    from mitsim.scene.load import load_scene
    from mitsim.sensor.imager import Noise
    from mitsim.sensor.preset import load_sensor
    from mitsim.surface.scatter import Deviation

    chosen, moved = load_sensor(sensor), Deviation.parse(deviation)
    loaded = load_scene(scene, chosen.wavelength_nm, _defines(define), moved)
    pose = _pose(position, target, roll, chosen.rig.reference.sensor_from_camera)
    simulated = SimulatedSensor(chosen)
    capture = simulated.capture(loaded, pose, seed=seed, samples=samples, depth=depth, noise=Noise.parse(noise))
    first = next(iter(chosen.rig.cameras))
    residual = render_residual(simulated, loaded, pose, first, samples=samples, depth=depth, seed=seed)
    capture.settings["render_residual"] = asdict(residual) if isfinite(residual.noise) else None
    capture.settings["deviation"] = asdict(moved)
    known = {}
    if truth:
        known = {
            name: encode_exr(true_image(simulated, loaded, pose, name, samples=samples, depth=max(depth, 3), seed=seed))
            for name in chosen.rig.cameras
        }
    write_capture(capture, output, truth=known)
    for told in dict.fromkeys(f"{one}: {one.scatter.provenance}" for one in loaded.finishes if one and one.scatter):
        if deviation:
            say(told)
    say(f"{residual}" + (f"; over {LIMIT}: take more --samples" if residual.worst > LIMIT else ""))
    say(f"capture: {output}")


@app.command()
def check(
    scene: Path,
    position: Annotated[tuple[float, float, float] | None, typer.Option(
        help="Where the sensor stands [mm], world frame; if left out, 45 deg above the part.")] = None,
    target: Target = (0.0, 0.0, 0.0), roll: Roll = 0.0, sensor: SensorOption = "ensenso-n10",
    task: Annotated[Path | None, typer.Option(help="A task TOML whose features are looked for.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Picture (PNG) to write.")] = None,
    json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    define: Defines = None, variant: Variant = None,
) -> None:  # fmt: skip
    """Say what a scene holds and what about it will surprise; draw it from the sensor and from above.

    Example: mitsim check scenes/two_pillars/two_pillars.xml --task scenes/two_pillars/task.toml -o preview.png
    """
    _start(variant)
    import json as json_module

    from mitsim.authoring.check import findings, read_features
    from mitsim.progress import say
    from mitsim.report.scene_preview import preview_figure
    from mitsim.report.scene_table import as_data, as_text
    from mitsim.report.style import write_png
    from mitsim.scene.inspect import inspect, look
    from mitsim.scene.load import load_scene
    from mitsim.sensor.preset import load_sensor
    from mitsim.sensor.working_volume import pose_at, usual_place

    chosen = load_sensor(sensor)
    wanted = read_features(task) if task else None
    loaded = load_scene(scene, chosen.wavelength_nm, _defines(define))
    if position is None:
        place = usual_place(chosen, loaded.centre)
        pose = pose_at(chosen, place, loaded.centre, roll)
        seen = [" ".join(f"{round(float(v), 1) + 0.0:g}" for v in point) for point in (place, loaded.centre)]
        say(f"looking from --position {seen[0]} --target {seen[1]}, since no position was given")
    else:
        pose = _pose(position, target, roll, chosen.rig.reference.sensor_from_camera)
    facts, sight = inspect(loaded), look(loaded, chosen.rig, pose)
    found = findings(facts, chosen, pose, sight, position is not None, wanted)
    if output:
        _parent(output)
        write_png(preview_figure(loaded, facts, chosen, pose, sight, list(wanted.features) if wanted else []), output)
        say(f"picture: {output}")
    if json:
        about = {"scene": loaded.where, "sensor": chosen.name, "world_from_sensor": pose.matrix().tolist()}
        print(json_module.dumps({**about, **as_data(facts, sight, found)}, indent=2))
    else:
        print(as_text(facts, sight, found))
    if any(one.severity == "error" for one in found):
        raise typer.Exit(1)


@app.command()
def part(
    file: Path, output: Out,
    units: Annotated[str | None, typer.Option(help="mm, m or inch, of a file that does not say; default mm.")] = None,
    metal: Annotated[str, typer.Option(help="Of all faces.")] = "aluminium",
    process: Annotated[str, typer.Option(help="Of all faces.")] = "ground",
    roughness: Annotated[float, typer.Option("--Ra", help="Roughness average [um] of all faces.")] = 0.8,
    angle: Annotated[float, typer.Option(help="Triangles that bend by less belong to one face [deg].")] = 20.0,
) -> None:  # fmt: skip
    """Make a scene folder of a STEP file or a mesh: a shape for each face; planes, cylinders and spheres recognised.

    Example: mitsim part bracket.step -o scenes/bracket --process milled --Ra 1.6
    """
    from mitsim.authoring.part_folder import Finishing, described, write_part
    from mitsim.progress import say

    made = write_part(file, output, units, Finishing(metal, process, roughness), angle)
    for remark in made.remarks:
        say(remark)
    for face in made.faces:
        print(f"{face.name}\t{described(face)}")
    say(f"scene: {output / (output.absolute().name + '.xml')}\ntask: {output / 'task.toml'}")


@app.command(name="import")
def import_(
    file: Path, output: Out,
    sensor: Annotated[str | None, typer.Option(
        help="The sensor TOML file of the rig that took a folder of images.")] = None,
) -> None:  # fmt: skip
    """Bring a maker's recording, or with --sensor a folder of images of any rig, into a capture folder.

    Example: mitsim import recording.zip -o captures/real
    """
    from mitsim.capture.ensenso_files import ensenso_originals, read_ensenso
    from mitsim.capture.folder import write_capture
    from mitsim.capture.image_folder import read_image_folder
    from mitsim.progress import say
    from mitsim.sensor.preset import load_sensor

    if sensor is None:
        write_capture(read_ensenso(file), output, vendor=ensenso_originals(file))
    else:
        write_capture(read_image_folder(file, load_sensor(sensor)), output)
    say(f"capture: {output}")


@app.command()
def decode(
    capture: Path, output: Out,
    sensor: Annotated[str | None, typer.Option(help="Decode with the settings of this sensor.")] = None,
) -> None:  # fmt: skip
    """Turn the images of a capture into a point cloud; on stdout, how many pixels have a point, and why others not.

    Example: mitsim decode captures/real -o cloud.ply
    """
    from characterisation.cloud_files import write_ply
    from mitsim.capture.cloud import capture_cloud, decoder_settings
    from mitsim.capture.folder import read_capture
    from mitsim.progress import say

    read = read_capture(capture)
    settings, imager = decoder_settings(read, sensor)
    say(f"decoding: {settings.near_mm:g} to {settings.far_mm:g} mm; settings of {sensor or read.sensor}")
    cloud = capture_cloud(read, settings, imager=imager)
    _parent(output)
    write_ply(cloud, output)
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")


@app.command()
def characterise(
    campaign: Path, output: Out, sensor: SensorOption = "ensenso-n10",
    captures: Annotated[Path | None, typer.Option(
        help="Measure the captures of coupons in this folder, and take none.")] = None,
    scheduler: Annotated[str | None, typer.Option(
        help="Address of a Dask scheduler whose workers take the captures: tcp://HOST:8786.")] = None,
    variant: Variant = None,
) -> None:  # fmt: skip
    """Run a campaign of coupons, or go on with one, and make the sensor's performance map.

    Example: mitsim characterise scenes/coupon/campaign.toml -o runs/n10
    """
    _start(variant)
    from mitsim.campaign.plan import read_campaign
    from mitsim.campaign.run import measure_captures, run_campaign
    from mitsim.campaign.take import coupon_residuals, found_shots, found_source, in_turn, simulated_source
    from mitsim.capture.simulate import SimulatedSensor
    from mitsim.progress import say
    from mitsim.report.figures import write_map_figures
    from mitsim.report.findings import spread_in_words
    from mitsim.sensor.preset import load_sensor

    if captures is not None and scheduler is not None:
        raise InputError("--scheduler", "", scheduler, "not with --captures", "what was taken is measured here")
    plan = read_campaign(campaign, load_sensor(sensor))
    _writable(output)
    if captures is not None:
        found = found_shots(captures, plan)
        source = in_turn(found_source(found), plan)
        performance_map = measure_captures(plan, list(found.values()), source, output)
    else:
        simulated = SimulatedSensor(plan.sensor)
        coupon_residuals(simulated, plan)
        if scheduler is None:
            source = in_turn(simulated_source(simulated, plan.file.samples_per_pixel), plan)
        else:
            from mitsim.campaign.cluster import on_cluster

            source = on_cluster(scheduler, plan)
        performance_map = run_campaign(plan, source, output)
    write_map_figures(performance_map, output)
    for line in spread_in_words(performance_map):
        say(line)
    say(f"map: {output / 'map.nc'}")


@app.command()
def validate(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="A performance map (map.nc).")],
    campaign: Annotated[Path, typer.Argument(help="The campaign TOML whose coupons are shown.")],
    output: Out, sensor: SensorOption = "ensenso-n10",
    captures: Annotated[int, typer.Option(min=1, max=10000, help="Of each sample at each distance.")] = 24,
    seed: Seed = 1, variant: Variant = None,
) -> None:  # fmt: skip
    """Hold a map against captures at poses that it was not made of; exit code 1 if it misses them.

    Random normals, at the map's distances and half-way between them. On stdout, a row for each sample and distance.

    Example: mitsim validate runs/n10/map.nc scenes/coupon/campaign.toml -o runs/n10_held_out
    """
    _start(variant)
    from characterisation.performance_map import PerformanceMap
    from characterisation.validation import holds, residual_table
    from mitsim.campaign.hold_out import compare, held_out_campaign, held_out_shots
    from mitsim.campaign.run import write_netcdf
    from mitsim.campaign.take import simulated_source
    from mitsim.capture.simulate import SimulatedSensor
    from mitsim.progress import say, track
    from mitsim.report.style import write_png
    from mitsim.report.validation_figures import agreement_figure, validation_table
    from mitsim.sensor.preset import load_sensor

    performance_map = PerformanceMap.load(map_file)
    plan = held_out_campaign(campaign, load_sensor(sensor), performance_map)
    shots = held_out_shots(plan, captures, seed)
    _writable(output)
    take = simulated_source(SimulatedSensor(plan.sensor), plan.file.samples_per_pixel)
    pairs = list(track(compare(plan, performance_map, shots, take), "hold out", len(shots)))
    table = residual_table(pairs)
    write_netcdf(table, output / "validation.nc")
    for sample in plan.samples:
        mine = [p for p in pairs if (p.finish, str(p.roughness)) == (sample.finish, str(sample.roughness))]
        name = sample.label().replace("/", "-").replace(" ", "_")
        write_png(agreement_figure(mine), output / f"held_out_{name}.png")
    print(validation_table(table), end="")
    say(f"figures: {output}")
    if not holds(table).all():
        raise typer.Exit(1)


@app.command()
def predict(
    scene: Path, output: Out, map_file: Annotated[Path, typer.Option("--map", help="A performance map (map.nc).")],
    position: Position, target: Target = (0.0, 0.0, 0.0), roll: Roll = 0.0, sensor: SensorOption = "ensenso-n10",
    seed: Seed = 1, define: Defines = None, variant: Variant = None,
) -> None:  # fmt: skip
    """Predict the cloud of a view from a performance map, without rendering.

    Example: mitsim predict scenes/two_pillars/two_pillars.xml --map runs/n10/map.nc --position 0 -400 300 -o cloud.ply
    """
    _start(variant)
    import numpy as np

    from characterisation.cloud_files import write_ply
    from characterisation.performance_map import PerformanceMap
    from mitsim.capture.cloud import sensor_geometry
    from mitsim.predict import Predictor, performance
    from mitsim.scene.load import load_scene
    from mitsim.sensor.preset import load_sensor

    chosen = load_sensor(sensor)
    performance_map = PerformanceMap.load(map_file)
    if performance_map.data.attrs.get("sensor") != chosen.name:
        raise InputError(map_file, "sensor", repr(performance_map.data.attrs.get("sensor")), repr(chosen.name))
    loaded = load_scene(scene, chosen.wavelength_nm, _defines(define))
    pose = _pose(position, target, roll, chosen.rig.reference.sensor_from_camera)
    geometry = sensor_geometry(chosen)
    predictor = Predictor(chosen.measuring_rig, geometry.grid, geometry.seen, chosen.name)
    surfaces = predictor.surfaces(loaded, pose)
    ideal = predictor.ideal(surfaces)
    fraction, sigma = performance(ideal, loaded, performance_map)
    labels = predictor.labels(surfaces)
    cloud = predictor.draw(loaded, ideal, labels, fraction, sigma, np.random.default_rng(seed))
    _parent(output)
    write_ply(cloud, output)
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")


@app.command()
def datasheet(
    sensors: Annotated[list[str], typer.Argument(help="Presets, or sensor TOML files; all presets if none.")] = [],  # noqa: B006
    output: Out = Path("datasheet"), seed: Seed = 1, variant: Variant = None,
) -> None:  # fmt: skip
    """Measure sensors on plates and balls: floor, noise over distance, recovery on metal; tables and pictures.

    Example: mitsim datasheet ensenso-n10 kinect-v2 -o runs/sheets
    """
    _start(variant)
    from mitsim.data_sheet import gallery, measure_sensor
    from mitsim.progress import say
    from mitsim.report.sheet_figures import gallery_figure, noise_figure, residual_figure, sheet_table
    from mitsim.report.style import write_png
    from mitsim.sensor.preset import load_sensor, presets
    from mitsim.study import write_json

    chosen = [load_sensor(name) for name in (sensors or presets())]
    _writable(output)
    sheets = []
    for sensor in chosen:
        sheets.append(measure_sensor(sensor, seed))
        pictures = gallery_figure(sensor.name, gallery(sensor, seed))
        write_png(pictures, output / f"gallery_{sensor.name}.png", dpi=72)
        write_json(output / f"{sensor.name}.json", sheets[-1].numbers())
    write_png(noise_figure(sheets), output / "noise.png", dpi=90)
    write_png(residual_figure(sheets), output / "residuals.png", dpi=90)
    print(sheet_table(sheets), end="")
    say(f"figures: {output}")


@app.command()
def report(folder: Path) -> None:
    """Write the report of a finished run again: one self-contained page.

    Example: mitsim report runs/two_pillars
    """
    from mitsim.progress import say
    from mitsim.report.page import write_report

    say(f"report: {write_report(folder)}")


def _start(variant: str | None) -> None:
    from mitsim.scene import backend

    backend.activate(variant)


def _pose(position: tuple[float, float, float], target: tuple[float, float, float], roll: float, camera: Any) -> Any:
    import numpy as np

    from mitsim.sensor.frames import look_at

    distance = float(np.linalg.norm(np.subtract(position, target)))
    if not 50 <= distance <= 20000:
        raise InputError("--position", "", f"{distance:g} mm from the target", "50 to 20000 mm", "positions are in mm")
    return look_at(position, target, (0.0, 0.0, 1.0), roll) @ camera.inverse()


def _defines(given: list[str] | None) -> dict[str, str]:
    out = {}
    for item in given or []:
        name, mark, value = item.partition("=")
        if not mark or not name:
            raise InputError("-D", "", repr(item), "name=value")
        out[name] = value
    return out


def _parent(file: Path) -> None:
    _writable(file.parent)
    if file.is_dir():
        raise InputError("--output", "", f"the folder {file}", "a file")


def _writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--output", "", f"{folder} ({error.strerror})", "a folder that can be made") from None
    if not os.access(folder, os.W_OK):
        raise InputError("--output", "", f"{folder}, which cannot be written to", "a folder that can be")


def main() -> None:
    """Run the command line; what users can mend ends in a message and an exit code, not in a traceback."""
    try:
        app()
    except InputError as error:
        print(f"mitsim: {error}", file=sys.stderr)
        sys.exit(2)
    except MissingEnvironmentError as error:
        print(f"mitsim: {error}", file=sys.stderr)
        sys.exit(3)
    except KeyboardInterrupt:
        print("mitsim: stopped; what was finished is kept", file=sys.stderr)
        sys.exit(130)
