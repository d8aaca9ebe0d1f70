"""Decode a capture to a point cloud, and print why pixels have no point."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.cli.options import OutCloud, check_file


def decode(
    capture: Annotated[Path, typer.Argument(help="Capture folder.")],
    output: OutCloud,
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
    from characterisation.cloud_files import write_cloud
    from mitsim.capture.folder import read_capture
    from mitsim.capture.workspace import written_frame
    from mitsim.decode.checks.sanity import capture_findings, cloud_warnings, pair_row_error, row_error_in_words
    from mitsim.decode.cloud import capture_cloud, decoder_settings, range_is_known, settings_are_known, with_options
    from mitsim.decode.depth_range import range_warning, surface_beyond
    from mitsim.decode.noise import known_noise, sigma_source
    from mitsim.running.progress import say
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
    rows = row_error_in_words(read, settings, found, matched)
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
    write_cloud(cloud, output, written)
    for reason, count in cloud.reasons().items():
        print(f"{reason}\t{count}")
