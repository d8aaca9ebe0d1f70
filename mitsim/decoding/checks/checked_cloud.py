"""Decode a capture and check it: its cloud, warnings about images, rig and range, and notes on the cloud.

Signal chain: capture and settings -> its images, decoded once -> checks of images and calibration -> cloud -> checks of
rows and range. ``mitsim decode`` prints the sentences; :func:`mitsim.decode` issues the warnings.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Settings
from mitsim.decoding.checks.pair_sanity import Findings, row_error_warnings
from mitsim.decoding.checks.sanity import (
    code_findings,
    pair_contradiction,
    pair_row_error,
    row_error_in_words,
    uncalibrated_in_words,
)
from mitsim.decoding.cloud import capture_geometry, stored_geometry
from mitsim.decoding.coded_images import decoded_once
from mitsim.decoding.depth_range import range_warning, surface_beyond
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.decoding.noise import sigma_source
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import presets
from mitsim.sensor.sensor import Sensor


@dataclass(frozen=True)
class CheckedCloud:
    """A ``cloud``; ``warnings``, the capture settings' first, and ``notes`` on rows and sigma, one sentence each."""

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

    Raises InputError if the settings belong to another technology, or the capture is inconsistent.

    Parameters
    ----------
    capture
        The capture.
    settings, imager
        From :func:`mitsim.decoding.cloud.decoder_settings`.
    where
        Name of the capture in warnings.
    sensor
        The sensor that the settings belong to; None if they are those of the capture.
    """
    pair = _pair_geometry(capture, settings)
    geometry = pair or stored_geometry(capture, settings, sensor)
    cloud, images, noise = decoded_once(capture, settings, imager, geometry)
    findings = Findings() if images is None else code_findings(images, capture.rig, capture.source == "device", pair)
    matched = pair_row_error(capture, cloud, pair)
    warnings = [*capture.settings.get("warnings", []), *findings.warnings, *row_error_warnings(matched)]
    if not np.isfinite(matched) and (contradiction := pair_contradiction(capture, pair)):
        warnings.append(contradiction)
    if lost := uncalibrated_in_words(cloud):
        warnings.append(lost)
    beyond = surface_beyond(capture, cloud, settings)
    if beyond is not None:
        reason = f"a coarse search over a wider range finds it in {100 * beyond.share:.0f} % of the pixels"
        whose = capture.sensor if capture.sensor in presets() else None
        if sensor is not None:
            whose = sensor.name if isinstance(sensor, Sensor) else str(sensor)
        warnings.append(range_warning(f"{where}: a surface", beyond.depths, settings, whose, reason))
    notes = row_error_in_words(capture, settings, findings, matched), sigma_source(capture, cloud, noise)
    return CheckedCloud(cloud, tuple(dict.fromkeys(warnings)), tuple(note for note in notes if note))


def _pair_geometry(capture: Capture, settings: Settings) -> StereoGeometry | None:
    """Return the geometry of two cameras that triangulate, which decoding and checks need; None for another sensor."""
    if capture.technology == "active_stereo":
        paired = isinstance(settings, MatcherSettings)
    else:
        coded = settings if isinstance(settings, DecoderSettings) else None
        paired = capture.technology == "structured_light" and coded is not None and coded.triangulate == "cameras"
    if not paired:
        return None
    geometry = capture_geometry(capture, settings)
    return geometry if isinstance(geometry, StereoGeometry) else None
