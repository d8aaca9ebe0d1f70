"""Measure the row error of a rectified pair over the field, and the rotation of the second camera that explains it.

Signal chain: capture -> cloud -> row error of each patch of the right image
(:mod:`mitsim.twin.compare.specimen_patches`) -> line over the columns of the right image, without outliers -> rotation
about its x axis and roll.

A camera rotated by w about x sees a point f w (1 + y^2) rows lower; one that rolls by r about its axis, f r x rows
higher, with x and y the slopes of the ray. One specimen in one part of the field hardly separates the two. Each has a
normal prior about 0, with the standard deviation of ``[unknowns.calibration]`` of the sensor. Rotation toward the other
camera (vergence) causes no row error and cannot be measured here. Vergence is assumed at least as large as these
two, since the mounts are the same (:mod:`mitsim.twin.sensor.write`).
"""

from __future__ import annotations

import numpy as np

from characterisation.files.arrays import MEDIAN_TO_STD, Floats
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import Settings, capture_geometry
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.twin.compare.specimen_patches import patch_rows
from mitsim.twin.finish.specimen import Specimen

#: least number of patches for a line; chosen
_FEWEST = 6

#: outlier limit in standard deviations; chosen
_CLIP = 3.0


def row_turns(
    capture: Capture, settings: Settings, specimen: Specimen, prior: tuple[float, float]
) -> dict[str, tuple[float, float]]:
    """Return the rotations of a pair's second camera [mrad] with standard uncertainties, from its row errors.

    ``row_mrad`` is that about its x axis, ``roll_mrad`` its roll; none for too few patches or no pair. ``prior`` are
    the standard deviations of both before the measurement [mrad].
    """
    geometry = capture_geometry(capture, settings)
    if not isinstance(geometry, StereoGeometry) or capture.technology == "structured_light":
        return {}
    errors, columns, rows = patch_rows(capture, settings, geometry, specimen)
    matrix = geometry.rectification.matrix_right
    focal = float(matrix[0, 0])
    x, y = (columns - matrix[0, 2]) / focal, (rows - matrix[1, 2]) / focal
    used = np.isfinite(errors)
    design = focal * 1e-3 * np.column_stack([1 + y**2, -x])
    for _ in range(3):
        if used.sum() < _FEWEST:
            return {}
        turns, covariance, residual = _line(design[used], errors[used], np.array(prior))
        off = errors - design @ turns
        used &= np.abs(off) <= _CLIP * max(MEDIAN_TO_STD * float(np.median(np.abs(residual))), 1e-3)
    spread = np.sqrt(np.diag(covariance))
    return {name: (float(turns[k]), float(spread[k])) for k, name in enumerate(("row_mrad", "roll_mrad"))}


def _line(design: Floats, values: Floats, prior: Floats) -> tuple[Floats, Floats, Floats]:
    """Return numbers with a normal prior about 0, their covariance, and the residuals of the values."""
    free = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    variance = max(float(free @ free) / max(len(values) - design.shape[1], 1), 1e-12)
    covariance = np.linalg.inv(design.T @ design / variance + np.diag(1 / np.maximum(prior, 1e-6) ** 2))
    solution = covariance @ design.T @ values / variance
    return np.asarray(solution, float), np.asarray(covariance, float), values - design @ solution
