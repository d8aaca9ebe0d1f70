"""Import recordings of devices and other programs as capture folders."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from characterisation.files.errors import InputError
from characterisation.words.progress import say
from mitsim.cli import options
from mitsim.cli.decode import decoding_step

if TYPE_CHECKING:
    from mitsim.capture.capture import Capture

#: settings of an imported capture that the user should check
SETTINGS_TO_CHECK = (
    "image_set topic stamp_s frame_id grid_from unit_of_file axes_of_file fitted_camera_rms_px off_the_rays_px "
    "depth_scale_mm measured_from baseline_mm spec_baseline_mm subpixel_bits subpixel_bits_from bits_from empty_bits "
    "channel"
)


def import_(
    path: Annotated[Path, Argument(help="File or folder that a device or another program saved.")],
    output: Annotated[
        Path | None,
        Option("--output", "-o", help="Capture folder to write; default: named after PATH, in the current folder."),
    ] = None,
    sensor: Annotated[
        str | None, Option(help="Sensor that took it, a preset or TOML file; it supplies name, cameras and range.")
    ] = None,
    calibration: Annotated[
        str | None,
        Option(metavar="FILE", help="Calibration of the cameras: TOML, JSON, OpenCV's YAML or XML, DepthAI's JSON."),
    ] = None,
    kind: Annotated[
        str | None,
        Option(
            "--as",
            help="Kind of recording: ensenso, depthai, ros, robi, stereo-pair, images, depth, ply, pcd, zdf or npy; "
            "default: detected.",
        ),
    ] = None,
    camera: Annotated[str | None, Option(help="For a depth image or cloud: the name of its camera.")] = None,
    frame: Annotated[
        str | None, Option(help="Image set, pair or frame to import: its number, from 0, or its name.")
    ] = None,
    topic: options.Topic = None,
    images: Annotated[
        list[str] | None,
        Option(help="For a folder of images: files of one camera, NAME=PATTERN (left='cam0_*.png'). Repeatable."),
    ] = None,
    channel: Annotated[str | None, Option(help="For colour images: red, green or blue; default green.")] = None,
    exposure_s: Annotated[float | None, Option("--exposure", help="Exposure time of every image [s].")] = None,
    pose: Annotated[
        str | None,
        Option(
            metavar="FILE",
            help="Pose of the sensor: pose.json, or a text file with the 4 x 4 matrix world_from_sensor [mm].",
        ),
    ] = None,
    sample: Annotated[
        str | None, Option(help="For a coupon: the label of its sample in a campaign (aluminium/ground Ra 0.4).")
    ] = None,
    coupon: Annotated[
        tuple[int, int, int, int] | None,
        Option(
            metavar="COLUMN ROW WIDTH HEIGHT",
            help="For a coupon: window of the cloud's pixels that shows only it; its plane gives the pose.",
        ),
    ] = None,
    projector: Annotated[str | None, Option(help="State of the projector: on or off.")] = None,
    range_mm: Annotated[
        tuple[float, float] | None, Option("--range", help="Nearest and farthest depth to decode [mm].")
    ] = None,
    scale_mm: Annotated[
        float | None,
        Option("--scale", min=1e-6, max=1e4, help="For a depth image: depth per grey level [mm]; default 1."),
    ] = None,
    invalid: Annotated[
        int | None, Option(min=0, max=65535, help="For a depth image: grey level of pixels without depth; default 0.")
    ] = None,
    along: Annotated[
        str | None,
        Option(help="For a depth image: its numbers are distances along the axis of the camera, or the ray."),
    ] = None,
    unit: Annotated[
        str | None,
        Option(
            help="Unit of a cloud: um, mm, cm, m, inch or foot; default: m if the median distance is below 20, else mm."
        ),
    ] = None,
    axes: Annotated[
        str | None,
        Option(help="Axes of a cloud: opencv (y down, z forward) or opengl (y up, z backward); default opencv."),
    ] = None,
    link: Annotated[
        str | None,
        Option(
            metavar="FILE",
            help="For a cloud of an Ensenso: its *_calib.json. Its Link (the transform to a workspace) is undone, so "
            "that points are in the sensor frame.",
        ),
    ] = None,
    subpixel_bits: Annotated[
        int | None, Option(min=0, max=8, help="For a DepthAI disparity: n if its unit is 1/2^n px; default: detected.")
    ] = None,
) -> None:
    """Import a recording of a device or another program as a capture folder; the kind of recording is detected.

    Example: mitsim import recording.zip -o captures/real
    """
    arguments = locals()  # by the names of the fields of ReadOptions
    from mitsim.capture.folder import is_written, write_capture
    from mitsim.capture.recordings.any_recording import read_recording
    from mitsim.capture.recordings.read_options import ReadOptions
    from mitsim.capture.recordings.recognise import NAMES
    from mitsim.capture.recordings.recording_files import plain_name
    from mitsim.decoding.checks.sanity import with_warnings

    named = {field.name: arguments[field.name] for field in fields(ReadOptions)}
    reading = ReadOptions(**named | {"topic": tuple(topic) if topic else None, "images": _patterns(images)})
    imported = read_recording(path, reading, kind)
    capture = with_warnings(imported.capture)
    if coupon is not None:
        if pose is not None:
            raise InputError("--coupon", "", "--pose too", "one of both")
        capture = _posed(capture, coupon, str(path))
    folder = output or Path(plain_name(path.resolve().stem) + "_capture")
    say(f"{path}: {NAMES[imported.kind]}, of {capture.sensor}, {capture.technology}, {capture.source}")
    for name in SETTINGS_TO_CHECK.split():
        if name in capture.settings:
            say(f"  {name}: {capture.settings[name]}")
    rig = capture.rig
    reference, *other_eyes = [*rig.cameras.values(), *([rig.projector] if rig.projector else [])]
    if other_eyes and imported.kind in ("stereo-pair", "images"):
        baseline = math.dist(other_eyes[0].centre, reference.centre)
        say(f"  baseline: {baseline:.4g} mm")
    if coupon is not None and capture.world_from_sensor is not None:
        position = capture.world_from_sensor.translation
        distance = math.hypot(*position)
        angle = math.degrees(math.acos(position[2] / distance))
        say(f"  pose: {distance:.1f} mm from the coupon, {angle:.1f} deg off its normal")
    for warning in capture.settings.get("warnings", []):
        say(f"warning: {warning}")
    if is_written(capture, folder, imported.originals):
        say(f"capture: {folder}, finished before")
        return
    options.check_new_folder(folder)
    write_capture(capture, folder, vendor=imported.originals)
    say(f"capture: {folder}; next: {decoding_step(capture, folder, sensor)}")


def _posed(capture: Capture, window: tuple[int, int, int, int], where: str) -> Capture:
    """Return a capture of a coupon with the pose that the plane of its points gives."""
    from characterisation.region_of_interest import Roi
    from mitsim.decoding.cloud import capture_cloud, decoder_settings
    from mitsim.twin.finish.specimen import pose_over_coupon

    settings, imager = decoder_settings(capture, None, None)
    pose = pose_over_coupon(capture_cloud(capture, settings, imager=imager), Roi(*window), where)
    return replace(capture, world_from_sensor=pose)


def _patterns(images: list[str] | None) -> dict[str, str] | None:
    """Return the patterns of --images by camera."""
    allowed = "NAME=PATTERN, as left='cam0_*.png'"
    patterns = options.definitions(images, "--images", allowed)
    if empty := [name for name, pattern in patterns.items() if not pattern]:
        raise InputError("--images", "", repr(f"{empty[0]}="), allowed)
    return patterns or None
