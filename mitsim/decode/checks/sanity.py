"""Collect warnings about a capture, one sentence each, for import and decoding; its settings keep them.

A warning is not an error: the capture is still written and decoded according to its sensor file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from mitsim.capture.capture import Capture
from mitsim.decode.checks.image_sanity import image_warnings
from mitsim.decode.checks.rig_sanity import (
    LARGEST_ROW_ERROR,
    baseline_warning,
    camera_warnings,
    measured_row_error,
    pair_warnings,
    row_error_warning,
)
from mitsim.decode.cloud import Settings, capture_pattern
from mitsim.decode.decoder_registry import projector_size
from mitsim.decode.matching.stereo import stereo_geometry
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift, roles


@dataclass(frozen=True)
class Findings:
    """Findings about a capture: ``warnings``, and ``row_error`` [px] of the second camera; NaN if unknown.

    ``row_error_source``: the source of the row error, "" if unknown.
    """

    warnings: list[str] = field(default_factory=list)
    row_error: float = float("nan")
    row_error_source: str = ""


def capture_warnings(capture: Capture, settings: Settings) -> list[str]:
    """Return the warnings about a capture, see :func:`capture_findings`."""
    return capture_findings(capture, settings).warnings


def capture_findings(capture: Capture, settings: Settings) -> Findings:
    """Check the images and calibration of a structured-light capture; other captures have no findings.

    A bracket of exposures is not checked. If images do not match their pattern, the calibration is not checked.
    """
    exposures = capture.settings.get("exposure_s")
    if not isinstance(settings, DecoderSettings) or capture.technology != "structured_light":
        return Findings()
    if isinstance(exposures, list) and len(exposures) > 1:
        return Findings()
    code = capture_pattern(capture)
    if not isinstance(code, PhaseShift | GrayCode | GrayCodePhaseShift | ImageSequence):
        return Findings()
    size, full_scale = projector_size(capture), 2.0**capture.bits - 1
    count, matched = len(roles(code, *size)), settings.triangulate == "cameras"
    stacks = [stack[:count] for stack in capture.images.values()][: 2 if matched else 1]
    if any(len(stack) < count for stack in stacks):
        return Findings()  # decoding reports the error
    out = []
    for name, stack in zip(capture.images, stacks, strict=False):
        out += image_warnings(stack, code, size, settings, full_scale, name)
    if out:
        return Findings(out)
    if matched:
        try:
            return Findings(*pair_warnings(stacks[0], stacks[1], capture.rig, code, size, settings, full_scale))
        except InputError as error:
            return Findings([str(error)])
    along = baseline_warning(capture.rig, code)
    return Findings(([along] if along else []) + camera_warnings(stacks[0], capture.rig, code, settings, full_scale))


def pair_row_error(capture: Capture, cloud: PointCloud) -> float:
    """Return the row error [px] of the right image of a matched pair, by its own texture; NaN if unknown."""
    if capture.technology != "active_stereo" or len(capture.images) < 2:
        return float("nan")
    left, right = (stack[0] for stack in list(capture.images.values())[:2])
    return measured_row_error((left, right), stereo_geometry(capture.rig), cloud)


def row_error_in_words(capture: Capture, settings: Settings, found: Findings, matched: float) -> str:
    """Describe the row error of the second camera, or that it is unknown; "" if only one camera measures.

    ``matched``: row error of a pair decoded by a matcher, see :func:`pair_row_error`.
    """
    if np.isfinite(matched):
        return f"row error of the second camera: {matched:+.2f} px"
    if np.isfinite(found.row_error):
        return f"row error of the second camera: {found.row_error:+.2f} px, {found.row_error_source}"
    paired = isinstance(settings, DecoderSettings) and settings.triangulate == "cameras"
    if capture.technology != "structured_light" or not paired or found.warnings:
        return ""
    return (
        "row error of the second camera: unknown; the code has no rows and the surface too little texture. Project "
        "rows too, or take one capture of a printed surface"
    )


def cloud_warnings(offset: float) -> list[str]:
    """Return warnings about a decoded pair with a row error ``offset`` [px]."""
    return [row_error_warning(offset)] if np.isfinite(offset) and abs(offset) > LARGEST_ROW_ERROR else []


def uncalibrated_in_words(cloud: PointCloud) -> str:
    """Describe the pixels without a unique ray or depth by the calibration; "" without such pixels."""
    share = float(np.mean(cloud.status == Status.UNCALIBRATED))
    if not share:
        return ""
    return (
        f"{100 * share:.2g} % of the pixels are left out (uncalibrated): the lens distortion of the calibration folds "
        "over there, so that they have no unique ray or depth. Calibrate with boards that reach the corners, and with "
        "fewer distortion coefficients"
    )
