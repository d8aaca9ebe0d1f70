"""Decode a capture to a point cloud, and print why pixels have no point."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from characterisation.words.progress import say
from mitsim.cli import options

if TYPE_CHECKING:
    from mitsim.capture.capture import Capture


def decode(
    capture: Annotated[Path, Argument(help="Capture folder.")],
    output: options.OutCloud,
    sensor: Annotated[
        str | None,
        Option(help="Decode with the settings of this sensor (preset or TOML file), not with those in the capture."),
    ] = None,
    depth_range: Annotated[
        tuple[float, float] | None, Option("--range", help="Nearest and farthest depth to decode [mm].")
    ] = None,
    block: Annotated[int | None, Option(min=3, max=31, help="For stereo matching: side of a block, odd [px].")] = None,
    contrast: Annotated[
        float | None,
        Option(
            min=0,
            max=255,
            help="Smallest accepted contrast [8-bit DN]: minimum_contrast_dn of stereo matching, "
            "minimum_modulation_dn of structured light.",
        ),
    ] = None,
    points_in: Annotated[
        str, Option(help="Frame of the points in the file: sensor, or workspace (needs the Link of an Ensenso).")
    ] = "sensor",
) -> None:
    """Compute the point cloud of a capture; print how many pixels have a point, and why the others have none.

    Exit code 1 if no pixel has a point.

    Example: mitsim decode captures/real -o cloud.ply
    """
    from characterisation.cloud_files import write_cloud
    from mitsim.capture.folder import read_capture
    from mitsim.capture.workspace import written_frame
    from mitsim.decoding.checks.checked_cloud import checked_cloud
    from mitsim.decoding.cloud import decoder_settings, settings_in_words, with_options

    read = read_capture(capture)
    options.check_cloud_file(output)
    written = written_frame(read, points_in, capture)
    settings, imager = decoder_settings(read, sensor, depth_range)
    settings = with_options(settings, block, contrast)
    say(f"decoding: {settings_in_words(read, settings, sensor, depth_range)}")
    decoded = checked_cloud(read, settings, imager, where=str(capture), sensor=sensor)
    for warning in decoded.warnings:
        say(f"warning: {warning}")
    for note in decoded.notes:
        say(note)
    write_cloud(decoded.cloud, output, written)
    options.print_reasons(decoded.cloud)
    if not decoded.cloud.valid.any():
        say(f"no pixel has a point, for the reasons above; {output} is empty")
        raise typer.Exit(1)
    say(f"cloud: {output}; next: mitsim measure {shlex.quote(str(output))} --picture look.png")


def decoding_step(capture: Capture, folder: Path, sensor: str | None) -> str:
    """Return what to do next with a capture in a folder, whose sensor file may be known: the command that decodes it.

    mitsim does not know a code of the user's own, and a capture does not hold the user's own mask of one camera.
    """
    named = ""
    if capture.decoding.pattern is not None and capture.decoding.pattern.kind == "images":
        if capture.technology == "structured_light":
            return "ms.triangulate(capture, columns), with the projector columns from your own decoder"
        if capture.technology == "reference_stereo":
            named = f" --sensor {shlex.quote(sensor or 'FILE')}"
    return f"mitsim decode {shlex.quote(str(folder))}{named} -o cloud.ply"
