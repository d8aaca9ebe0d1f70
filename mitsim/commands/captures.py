"""Simulate captures, import recordings, and decode both."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitsim.commands.folder_lock import sweep_beside
from mitsim.commands.options import (
    Defines,
    Out,
    Processes,
    Roll,
    Scene,
    Seed,
    SensorOption,
    Target,
    Variant,
    check_file,
    check_folder,
    definitions,
    pose_of,
    start,
)
from mitsim.errors import InputError

if TYPE_CHECKING:
    from mitsim.campaign.executor import Executor
    from mitsim.campaign.many import CommonSettings

#: settings of an imported capture that the user should check
SETTINGS_TO_CHECK = (
    "image_set",
    "unit_of_file",
    "axes_of_file",
    "fitted_camera_rms_px",
    "off_the_rays_px",
    "depth_scale_mm",
    "measured_from",
    "baseline_mm",
    "spec_baseline_mm",
    "subpixel_bits",
    "subpixel_bits_from",
    "bits_from",
    "channel",
)


def render(
    scene: Scene,
    output: Out,
    position: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Position of the sensor in the world frame [mm]; or use --many."),
    ] = None,
    target: Target = (0.0, 0.0, 0.0),
    roll: Roll = 0.0,
    sensor: SensorOption = "ensenso-n10",
    seed: Seed = 1,
    samples: Annotated[int, typer.Option(min=1, max=65536, help="Light paths per pixel.")] = 16,
    depth: Annotated[
        int, typer.Option(min=1, max=16, help="Largest number of surfaces on a light path; 1: direct light only.")
    ] = 3,
    noise: Annotated[
        str, typer.Option(help="Noise sources: all, none, a list (shot,read), or all but some (no-speckle).")
    ] = "all",
    deviation: Annotated[
        str,
        typer.Option(
            help="Shift the uncertain parameters of the finishes by standard deviations: alpha=1,wide_angle=-1."
        ),
    ] = "",
    truth: Annotated[
        bool, typer.Option("--truth", help="Also write the true geometry at each pixel, as OpenEXR.")
    ] = False,
    many: Annotated[
        Path | None,
        typer.Option(
            help="TOML plan of views and finishes: simulate each one into a folder in OUTPUT; continues an "
            "interrupted plan."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="With --many: address of a Dask scheduler whose workers simulate the captures, tcp://HOST:8786."
        ),
    ] = None,
    processes: Processes = 1,
    define: Defines = None,
    variant: Variant = None,
) -> None:
    """Simulate one capture of a scene, or many of them.

    Example: mitsim render scenes/two_pillars/two_pillars.xml --position 0 -400 300 -o captures/first
    """
    if (position is None) == (many is None):
        raise InputError(
            "--position",
            "",
            "both --position and --many" if many else "neither --position nor --many",
            "one of them: a position, or a plan",
        )
    if (scheduler is not None or processes != 1) and many is None:
        option, given = ("--scheduler", scheduler) if scheduler is not None else ("--processes", str(processes))
        raise InputError(option, "", given, "only with --many", "a single capture runs in this process")
    start(variant)
    if many is not None:
        from mitsim.campaign.executor import executor_of
        from mitsim.campaign.many import CommonSettings
        from mitsim.sensor.imager import Noise

        common = CommonSettings(definitions(define), deviation, seed, samples, depth, Noise.parse(noise), truth)
        _render_many(many, scene, sensor, common, output, executor_of(scheduler, processes))
        return
    assert position is not None
    from dataclasses import asdict
    from math import isfinite

    from mitsim.campaign.many import Job, digest_of, origin_of
    from mitsim.capture.folder import read_capture, refuse_taken, write_capture
    from mitsim.interface import captures as interface
    from mitsim.progress import say
    from mitsim.sensor.imager import Noise
    from mitsim.simulation.render_residual import LIMIT, render_residual
    from mitsim.simulation.rendering import Rendering
    from mitsim.simulation.truth import encode_exr, true_image
    from mitsim.surface.scatter import Deviation

    chosen, moved = interface.load_sensor(sensor), Deviation.parse(deviation)
    loaded = interface.load_scene(scene, chosen, definitions(define), deviation=moved)
    pose = pose_of(position, target, roll, chosen)
    defined = tuple(sorted(definitions(define).items()))
    digest = Job(
        chosen,
        str(scene),
        defined,
        moved,
        "",
        0,
        pose,
        seed,
        samples,
        depth,
        Noise.parse(noise),
        truth,
        origin_of(scene, chosen),
    ).digest()
    sweep_beside(output)
    if digest_of(output, "render") == digest:
        read_capture(output)
        say(f"capture: {output}, finished before")
        return
    refuse_taken(output)
    capture = interface.render(loaded, chosen, pose, seed=seed, samples=samples, depth=depth, noise=noise)
    simulated = interface.laid_out(chosen)
    first = next(iter(chosen.rig.cameras))
    residual = render_residual(simulated, loaded, pose, first, Rendering(samples, depth), seed=seed)
    capture.settings["render_residual"] = asdict(residual) if isfinite(residual.noise) else None
    capture.settings["deviation"] = asdict(moved)
    capture.settings["render"] = {"digest": digest}
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
    say(f"{residual}" + (f"; over {LIMIT}: increase --samples" if residual.worst > LIMIT else ""))
    say(f"capture: {output}")


def _render_many(
    plan: Path, scene: Path, sensor: str, common: CommonSettings, output: Path, workers: Executor | None
) -> None:
    """Simulate the missing captures of a plan, and report their number."""
    from mitsim.campaign.many import in_turn, missing_jobs, read_jobs, render_many, take_job
    from mitsim.progress import say
    from mitsim.sensor.preset import load_sensor
    from mitsim.simulation.simulate import SimulatedSensor

    chosen = load_sensor(sensor)
    jobs = read_jobs(plan, scene, chosen, common)
    check_folder(output)
    missing = missing_jobs(jobs, output)
    if len(missing) < len(jobs):
        say(f"{len(jobs) - len(missing)} of {len(jobs)} captures exist already")
    if not missing:
        say(f"captures: {output}: {len(jobs)}, all of them finished before")
        return
    if workers is None:
        taken = in_turn(missing, SimulatedSensor(chosen))
    else:
        taken = workers.spread(missing, lambda job: job, take_job)
    render_many(taken, output, len(missing))
    say(f"captures: {output}: {len(jobs)}, {len(missing)} of them new")


def import_(
    path: Annotated[Path, typer.Argument(help="File or folder that a device or another program saved.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Capture folder to write; default: named after PATH, in the current folder."
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help="Sensor that took it, a preset or TOML file; it supplies name, cameras and range."),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration of the cameras: TOML, JSON, OpenCV's YAML or XML, DepthAI's JSON.")
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            "--as",
            help="Kind of recording: ensenso, depthai, robi, stereo-pair, images, depth, ply or pcd; "
            "default: detected.",
        ),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="For a depth image or cloud: the name of its camera.")] = None,
    frame: Annotated[
        str | None, typer.Option(help="Image set, pair or frame to import: its number, from 0, or its name.")
    ] = None,
    images: Annotated[
        list[str] | None,
        typer.Option(help="For a folder of images: files of one camera, NAME=PATTERN (left='cam0_*.png'). Repeatable."),
    ] = None,
    channel: Annotated[str | None, typer.Option(help="For colour images: red, green or blue; default green.")] = None,
    exposure: Annotated[float | None, typer.Option(help="Exposure time of every image [s].")] = None,
    pose: Annotated[
        Path | None,
        typer.Option(
            help="Pose of the sensor: pose.json, or a text file with the 4 x 4 matrix world_from_sensor [mm]."
        ),
    ] = None,
    sample: Annotated[
        str | None, typer.Option(help="For a coupon: the label of its sample in a campaign (aluminium/ground Ra 0.4).")
    ] = None,
    projector: Annotated[str | None, typer.Option(help="State of the projector: on or off.")] = None,
    depth_range: Annotated[
        tuple[float, float] | None, typer.Option("--range", help="Nearest and farthest depth to decode [mm].")
    ] = None,
    scale: Annotated[
        float | None, typer.Option(min=1e-6, max=1e4, help="For a depth image: depth per grey level [mm]; default 1.")
    ] = None,
    invalid: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="For a depth image: grey level of pixels without depth; default 0."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of a cloud: um, mm, cm or m; default: m if the median distance is below 20, else mm."),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(help="Axes of a cloud: opencv (y down, z forward) or opengl (y up, z backward); default opencv."),
    ] = None,
    link: Annotated[
        Path | None,
        typer.Option(
            help="For a cloud of an Ensenso: its *_calib.json. Its Link (the transform to a workspace) is undone, so "
            "that points are in the sensor frame."
        ),
    ] = None,
    subpixel_bits: Annotated[
        int | None,
        typer.Option(min=0, max=8, help="For a DepthAI disparity: n if its unit is 1/2^n px; default: detected."),
    ] = None,
) -> None:
    """Import a recording of a device or another program as a capture folder; the kind of recording is detected.

    Example: mitsim import recording.zip -o captures/real
    """
    from mitsim.capture.folder import is_written, write_capture
    from mitsim.progress import say
    from mitsim.recordings.recognise import KINDS, Given, read_recording
    from mitsim.recordings.recording_files import plain_name

    given = Given(
        sensor=sensor,
        calibration=None if calibration is None else str(calibration),
        camera=camera,
        frame=frame,
        range_mm=depth_range,
        scale_mm=scale,
        invalid=invalid,
        unit=unit,
        axes=axes,
        link=None if link is None else str(link),
        subpixel_bits=subpixel_bits,
        images=_by_camera(images),
        channel=channel,
        exposure_s=exposure,
        pose=None if pose is None else str(pose),
        sample=sample,
        projector=projector,
    )
    imported = read_recording(path, given, kind)
    capture = imported.capture
    folder = output or Path(plain_name(path.resolve().stem) + "_capture")
    say(f"{path}: {KINDS[imported.kind].what}, of {capture.sensor}, {capture.technology}, {capture.source}")
    for name in SETTINGS_TO_CHECK:
        if name in capture.settings:
            say(f"  {name}: {capture.settings[name]}")
    for warning in capture.settings.get("warnings", []):
        say(f"warning: {warning}")
    sweep_beside(folder)
    if is_written(capture, folder, imported.originals):
        say(f"capture: {folder}, finished before")
        return
    write_capture(capture, folder, vendor=imported.originals)
    say(f"capture: {folder}")


def _by_camera(given: list[str] | None) -> dict[str, str] | None:
    """Return the patterns of --images by camera."""
    out = {}
    for item in given or []:
        name, mark, pattern = item.partition("=")
        if not mark or not name or not pattern:
            raise InputError("--images", "", repr(item), "NAME=PATTERN, as left='cam0_*.png'")
        out[name] = pattern
    return out or None


def decode(
    capture: Annotated[Path, typer.Argument(help="Capture folder.")],
    output: Out,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Decode with the settings of this sensor (preset or TOML file), not with those in the capture."
        ),
    ] = None,
    depth_range: Annotated[
        tuple[float, float] | None, typer.Option("--range", help="Nearest and farthest depth to decode [mm].")
    ] = None,
    block: Annotated[
        int | None, typer.Option(min=3, max=31, help="For stereo matching: side of a block, odd [px].")
    ] = None,
    contrast: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=255,
            help="Smallest accepted contrast [8-bit DN]: minimum_contrast_dn of stereo matching, "
            "minimum_modulation_dn of structured light.",
        ),
    ] = None,
    points_in: Annotated[
        str, typer.Option(help="Frame of the points in the file: sensor, or workspace (needs the Link of an Ensenso).")
    ] = "sensor",
) -> None:
    """Compute the point cloud of a capture; print how many pixels have a point, and why the others have none.

    Example: mitsim decode captures/real -o cloud.ply
    """
    from characterisation.cloud_files import write_ply
    from mitsim.capture.folder import read_capture
    from mitsim.capture.workspace import written_frame
    from mitsim.capture_checks.sanity import capture_findings, cloud_warnings, pair_row_error, row_error_told
    from mitsim.progress import say
    from mitsim.reconstruction.cloud import (
        capture_cloud,
        decoder_settings,
        range_is_known,
        settings_are_known,
        with_options,
    )
    from mitsim.reconstruction.depth_range import range_warning, surface_beyond
    from mitsim.reconstruction.noise import known_noise, sigma_source
    from mitsim.sensor.preset import presets

    read = read_capture(capture)
    written = written_frame(read, points_in, capture)
    settings, imager = decoder_settings(read, sensor, depth_range)
    settings = with_options(settings, block, contrast)
    assumed = "" if range_is_known(read, sensor, depth_range) else " (assumed: the capture has no range; set --range)"
    by = f"settings of {sensor or read.sensor}"
    if read.source == "simulated" and not settings_are_known(read, sensor):
        by = "default settings, since settings.json has none (add --sensor FILE for those of its sensor)"
    say(f"decoding: {settings.near_mm:g} to {settings.far_mm:g} mm{assumed}; {by}")
    found = capture_findings(read, settings)
    for warning in dict.fromkeys([*read.settings.get("warnings", []), *found.warnings]):
        say(f"warning: {warning}")
    noise = known_noise(read, imager)
    cloud = capture_cloud(read, settings, imager=noise)
    matched = pair_row_error(read, cloud)
    rows = row_error_told(read, settings, found, matched)
    if rows:
        say(rows)
    for warning in cloud_warnings(matched):
        say(f"warning: {warning}")
    source = sigma_source(read, cloud, noise)
    if source:
        say(source)
    beyond = surface_beyond(read, cloud, settings)
    if beyond is not None:
        known = f"a coarse search over a wider range finds it in {100 * beyond.share:.0f} % of the pixels"
        whose = sensor or (read.sensor if read.sensor in presets() else None)
        say(range_warning(f"{capture}: a surface", beyond.depths, settings, whose, known))
    check_file(output)
    write_ply(cloud, output, written)
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")
