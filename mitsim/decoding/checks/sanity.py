"""Collect warnings about a capture, one sentence each, for import and decoding; its settings keep them.

A warning is not an error: the capture is still written and decoded according to its sensor file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from characterisation.words.numbers import percent
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Settings
from mitsim.decoding.checks.gray_origin import gray_origin_warning
from mitsim.decoding.checks.image_sanity import image_warnings
from mitsim.decoding.checks.pair_sanity import Findings, pair_findings, plain_pair_warning
from mitsim.decoding.checks.rig_sanity import baseline_warning, camera_warnings
from mitsim.decoding.checks.row_texture import measured_row_error
from mitsim.decoding.cloud import decoder_settings
from mitsim.decoding.coded_images import CodedImages
from mitsim.decoding.matching.stereo_geometry import StereoGeometry, stereo_geometry
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings


def with_warnings(capture: Capture) -> Capture:
    """Return the capture with the warnings about it added to those that its settings already have.

    A bracket of exposures is not checked, and images that are missing are reported by decoding.
    """
    if capture.technology != "structured_light":
        return capture
    images = CodedImages.of(capture, *decoder_settings(capture))
    findings = Findings() if images is None else code_findings(images, capture.rig, capture.source == "device")
    warnings = list(dict.fromkeys([*capture.settings.get("warnings", []), *findings.warnings]))
    return replace(capture, settings=capture.settings | ({"warnings": warnings} if warnings else {}))


def code_findings(images: CodedImages, rig: Rig, recorded: bool, geometry: StereoGeometry | None = None) -> Findings:
    """Check coded images and the calibration of their rig; the calibration only if the images match their code.

    ``images``: the images, decoded once. ``rig``: calibration of their cameras and projector. ``recorded``: whether to
    check the origin of the code: a simulation has the pattern that its file states. ``geometry``: of two cameras that
    triangulate, if it is prepared already.
    """
    try:
        coordinates = images.coordinates
    except InputError:
        coordinates = {}  # decoding reports the error
    out = []
    for name in images.stacks:
        out += image_warnings(images, name, coordinates.get(name, {}))
    if out or not coordinates:
        return Findings(out)
    if images.settings.triangulate == "cameras":
        if any("columns" not in by_axis for by_axis in coordinates.values()):
            return Findings()  # decoding reports a code that two cameras cannot be matched by
        try:
            return pair_findings(images, rig, geometry or stereo_geometry(rig))
        except InputError as error:
            return Findings([str(error)])
    name, decoded = next(iter(coordinates.items()))
    if origin := gray_origin_warning(images, rig, recorded):
        return Findings([f"{name}: {origin}"])
    along = baseline_warning(rig, images.code)
    return Findings(([along] if along else []) + camera_warnings(decoded, rig, images.settings))


def pair_row_error(capture: Capture, cloud: PointCloud, geometry: StereoGeometry | None = None) -> float:
    """Return the row error [px] of the right image of a matched pair, by its texture; NaN if unknown."""
    if capture.technology != "active_stereo" or len(capture.images) < 2:
        return float("nan")
    left, right = (stack[0] for stack in list(capture.images.values())[:2])
    return measured_row_error((left, right), geometry or stereo_geometry(capture.rig), cloud)


def pair_contradiction(capture: Capture, geometry: StereoGeometry | None = None) -> str:
    """Warn if the images of a recorded pair contradict its calibration, else ""; see :func:`pair_row_error`."""
    if capture.technology != "active_stereo" or capture.source != "device" or len(capture.images) < 2:
        return ""
    left, right = (np.asarray(stack[0], float) for stack in list(capture.images.values())[:2])
    return plain_pair_warning((left, right), capture.rig, geometry or stereo_geometry(capture.rig))


def row_error_in_words(capture: Capture, settings: Settings, findings: Findings, matched: float) -> str:
    """Describe the row error of the second camera, ``matched`` [px] without a code; "" if only one camera measures."""
    if np.isfinite(matched):
        return f"row error of the second camera: {matched:+.2f} px"
    if np.isfinite(findings.row_error):
        return f"row error of the second camera: {findings.row_error:+.2f} px, {findings.row_error_source}"
    paired = isinstance(settings, DecoderSettings) and settings.triangulate == "cameras"
    if capture.technology != "structured_light" or not paired or findings.warnings:
        return ""
    return (
        "row error of the second camera: unknown; the code has no rows and the surface too little texture. Project "
        "rows too, or take one capture of a printed surface"
    )


def uncalibrated_in_words(cloud: PointCloud) -> str:
    """Describe the pixels without a unique ray or depth by the calibration; "" without such pixels."""
    share = float(np.mean(cloud.status == Status.UNCALIBRATED))
    if not share:
        return ""
    return (
        f"{percent(share)} of the pixels are left out (uncalibrated): the lens distortion of the calibration folds "
        "over there, so that they have no unique ray or depth. Calibrate with boards that reach the corners, and with "
        "fewer distortion coefficients"
    )
