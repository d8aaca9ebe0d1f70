"""Decode a capture and check it: its cloud, warnings about images, rig and range, and notes on the cloud.

Signal chain: capture and settings -> its images, decoded once -> checks of images and calibration -> cloud -> checks of
rows and range. ``mitsim decode`` prints the sentences; :func:`mitsim.decode` issues the warnings.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Settings
from mitsim.capture_checks.sanity import capture_findings, cloud_warnings, pair_row_error, row_error_in_words
from mitsim.reconstruction.cloud import capture_cloud, range_is_known, settings_are_known
from mitsim.reconstruction.coded_images import CodedImages
from mitsim.reconstruction.depth_range import range_warning, surface_beyond
from mitsim.reconstruction.noise import known_noise, sigma_source
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.preset import Sensor, presets


@dataclass(frozen=True)
class CheckedCloud:
    """A decoded ``cloud``; ``warnings`` about its capture, and ``notes`` on its rows and its sigma: one sentence each.

    The warnings that the capture's settings already have come first.
    """

    cloud: PointCloud
    warnings: tuple[str, ...]
    notes: tuple[str, ...]


def checked_cloud(
    capture: Capture,
    settings: Settings,
    imager: Imager | None,
    *,
    where: str = "the capture",
    sensor: Sensor | str | Path | None = None,
) -> CheckedCloud:
    """Decode a capture, and check its images, its calibration and its range.

    Parameters
    ----------
    capture
        The capture.
    settings, imager
        From :func:`mitsim.reconstruction.cloud.decoder_settings`.
    where
        Name of the capture in warnings.
    sensor
        The sensor that the settings belong to; None if they are those of the capture.

    Raises
    ------
    InputError
        If the settings belong to another technology, or the capture is inconsistent.
    """
    noise = known_noise(capture, imager)
    images, coordinates = CodedImages.of(capture, settings), None
    if images is not None and isinstance(settings, DecoderSettings):
        coordinates = images.coordinates(settings, noise)
    found = capture_findings(capture, settings, images, coordinates)
    cloud = capture_cloud(capture, settings, imager=noise, coordinates=coordinates)
    matched = pair_row_error(capture, cloud)
    warnings = [*capture.settings.get("warnings", []), *found.warnings, *cloud_warnings(matched)]
    beyond = surface_beyond(capture, cloud, settings)
    if beyond is not None:
        known = f"a coarse search over a wider range finds it in {100 * beyond.share:.0f} % of the pixels"
        whose = capture.sensor if capture.sensor in presets() else None
        if sensor is not None:
            whose = sensor.name if isinstance(sensor, Sensor) else str(sensor)
        warnings.append(range_warning(f"{where}: a surface", beyond.depths, settings, whose, known))
    notes = row_error_in_words(capture, settings, found, matched), sigma_source(capture, cloud, noise)
    return CheckedCloud(cloud, tuple(dict.fromkeys(warnings)), tuple(note for note in notes if note))


def settings_in_words(
    capture: Capture, settings: Settings, sensor: str | None = None, range_mm: tuple[float, float] | None = None
) -> str:
    """Describe the depths that are decoded, and whose settings are used.

    ``sensor`` and ``range_mm`` are the user's, as for :func:`mitsim.reconstruction.cloud.decoder_settings`.
    """
    known = range_is_known(capture, sensor, range_mm)
    assumed = "" if known else " (assumed: the capture has no range; set --range)"
    by = f"settings of {sensor or capture.sensor}"
    if capture.source == "simulated" and not settings_are_known(capture, sensor):
        by = "default settings, since settings.json has none (add --sensor FILE for those of its sensor)"
    return f"{settings.near_mm:g} to {settings.far_mm:g} mm{assumed}; {by}"
