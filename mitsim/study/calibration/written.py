"""Write a calibration from recorded corners: OpenCV's file for sensor files, covariance for statements, table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from characterisation.files.atomic_io import write_text
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.fitted_to import FittedCapture
from mitsim.sensor.rig_covariance import write_rig_covariance
from mitsim.sensor.rig_parameters import parameter_values
from mitsim.study.calibration.halves import CheckedCalibration, in_words
from mitsim.study.calibration.recorded import MOST_NOISE_PX, RecordedCorners

#: distance of a principal point from the middle, as a share of the size, that is unusual: four standard deviations of
#: the prior of cameras
_FAR_OFF = 0.2


def write_calibration(checked: CheckedCalibration, output: Path) -> Path:
    """Write the covariance to ``output`` and the rig beside it, as OpenCV's ``.yml``; return the path of the latter."""
    rig_file = output.with_suffix(".yml")
    rig = checked.calibration.rig
    write_text(rig_file, opencv_text(rig, checked.calibration.covariance.fitted_to))
    write_rig_covariance(output, checked.calibration.covariance, rig)
    return rig_file


def opencv_text(rig: Rig, fitted_to: Sequence[FittedCapture] = ()) -> str:
    """Return a rig as OpenCV's YAML, by the names of its stereo sample; a projector by ``proj_``.

    ``R`` and ``T`` are those of the second camera, or of the projector of a single one.

    Comments name the images that it was ``fitted_to``.
    """
    (_, first), *other_cameras = rig.cameras.items()
    lines = ["%YAML:1.0", "---"]
    lines += [f"# fitted to {json.dumps(image.name)}, SHA-256 {image.images_sha256}" for image in fitted_to]
    if other_cameras:
        lines += _eye(first, "cameraMatrix1", "distCoeffs1", "image_size")
        lines += _eye(other_cameras[0][1], "cameraMatrix2", "distCoeffs2", "image_size_2") + _pose(other_cameras[0][1])
    else:
        lines += _eye(first, "cam_K", "cam_kc", "image_size")
    if rig.projector is not None:
        lines += _eye(rig.projector, "proj_K", "proj_kc", "projector_size")
        lines += _pose(rig.projector, "proj_" if other_cameras else "")
    if rig.projector is not None or other_cameras:
        lines.append('unit: "mm"')
    return "\n".join(lines) + "\n"


def other_size_hints(rig: Rig) -> list[str]:
    """Return a warning for each camera whose principal point is so far off the middle that the size may be wrong."""
    out = []
    for name, camera in rig.cameras.items():
        point, size = camera.matrix[:2, 2], np.array([camera.width, camera.height])
        if (np.abs(point - (size - 1) / 2) > _FAR_OFF * size).any():
            out.append(
                f"the principal point of {name}, {point[0]:.0f}, {point[1]:.0f} px, is far from the middle of "
                f"{size[0]} x {size[1]} px: were the corners found in images of another size, or in a part of them?"
            )
    return out


def noisy_pose_hints(checked: CheckedCalibration, corners: RecordedCorners) -> list[str]:
    """Return a warning for each pose whose corners the calibration does not explain; it has next to no weight."""
    return [
        f"pose {board.name or number}: residuals of {noise:.1f} px, so it has next to no weight: are its corners those "
        "of the board, and its images taken at one time?"
        for number, (board, noise) in enumerate(zip(corners.boards, checked.calibration.camera_px, strict=True))
        if noise > MOST_NOISE_PX
    ]


def calibration_table(checked: CheckedCalibration) -> str:
    """Return noise, halves and the values of all parameters with their standard uncertainties, one per line."""
    calibration = checked.calibration
    names, sigma = calibration.covariance.names, calibration.covariance.one_sigma
    lines = [
        f"{len(calibration.poses)} poses, tilted by up to {checked.tilt_deg:.0f} deg against one another; noise "
        f"of a corner {calibration.camera_px.min():.3f} to {calibration.camera_px.max():.3f} px",
        in_words(checked),
        "",
        f"{'parameter':<28} {'value':>12} {'one sigma':>10}",
    ]
    values = parameter_values(calibration.rig, names)
    lines += [f"{name:<28} {value:>12.6g} {u:>10.3g}" for name, value, u in zip(names, values, sigma, strict=True)]
    return "\n".join(lines) + "\n"


def sensor_lines(rig: Rig, rig_file: Path, covariance_file: Path) -> str:
    """Return the tables of a sensor file that use both files."""
    names = ", ".join(f'"{name}"' for name in rig.cameras)
    projector = "" if rig.projector is not None else "projector = false\n"
    return (
        f'[calibration]\nfile = "{rig_file.name}"\ncameras = [{names}]\n{projector}\n'
        f'[unknowns.calibration]\ncovariance = "{covariance_file.name}"\n'
    )


def _eye(eye: Camera, matrix: str, distortion: str, size: str) -> list[str]:
    return [
        *_matrix(matrix, eye.matrix),
        *_matrix(distortion, np.asarray(eye.distortion).reshape(1, -1)),
        f"{size}: [ {eye.width}, {eye.height} ]",
    ]


def _pose(eye: Camera, prefix: str = "") -> list[str]:
    motion = eye.sensor_from_camera.inverse()
    return [*_matrix(f"{prefix}R", motion.rotation), *_matrix(f"{prefix}T", motion.translation.reshape(3, 1))]


def _matrix(name: str, values: ArrayLike) -> list[str]:
    array = np.asarray(values, float)
    data = ", ".join(f"{value:.16e}" for value in array.ravel())
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {array.shape[0]}",
        f"   cols: {array.shape[1]}",
        "   dt: d",
        f"   data: [ {data} ]",
    ]
