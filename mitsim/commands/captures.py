"""Take captures, bring others' in, and decode them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.commands.options import (
    Defines,
    Out,
    Position,
    Roll,
    Seed,
    SensorOption,
    Target,
    Variant,
    check_file,
    definitions,
    pose_of,
    start,
)


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
    start(variant)
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
    loaded = load_scene(scene, chosen.wavelength_nm, definitions(define), moved)
    pose = pose_of(position, target, roll, chosen.rig.reference.sensor_from_camera)
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
    check_file(output)
    write_ply(cloud, output)
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")
