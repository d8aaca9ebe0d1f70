"""Measure the row error of the second camera of a pair by the texture of the surface.

Signal chain: disparities of a decoded cloud, or of a code of columns -> patches of the rectified left image -> for
each, the row offset at which the right image fits best (:mod:`mitsim.decoding.matching.row_error`) -> median.

A column matches in any row, so a row error is hidden in the depth that a code of columns gives. Texture reveals it:
prints, scratches and edges on a surface. Highlights and shading move with the camera, so their patches disagree. If the
patches have no common offset, there is no result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.arrays import MEDIAN_TO_STD, Floats
from characterisation.point_cloud import PointCloud
from mitsim.decoding.checks.code_lines import Levels
from mitsim.decoding.matching.row_error import MAXIMUM_ROWS, row_error
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.decoding.structured_light.two_cameras import find_coordinates
from mitsim.sensor.image_role import Role

#: range of row offsets of a code of columns, which has the disparity whatever they are
_ROWS = 6

#: side of a patch [px]
_PATCH = 40

#: least share of the pixels of a patch that have a disparity
_MATCHED = 0.5

#: least number of patches for a row error; chosen
_LEAST = 8

#: about the largest number of patches of an image that are measured, which bounds the time; chosen
_MOST = 80

#: allowed variation of the row error over the image [px]
LARGEST_SPREAD = 0.5

#: largest standard error of the median of patches [px]; chosen
_OF_ALL = 0.06

#: share of the median that is added to it: a rotated camera has an uneven row error; chosen
_UNEVEN = 0.05


def uniform_light_mean(stack: Levels, image_roles: Sequence[Role], full_scale: float) -> Floats:
    """Return the mean (H, W) [DN] of a code's images that light every place equally; NaN if saturated.

    These are white, every bit with its complement, and the steps of every fringe. NaN everywhere without any.
    """
    where = {
        (role.kind, role.axis, role.index): number for number, role in enumerate(image_roles) if role.kind != "phase"
    }
    chosen = [number for number, role in enumerate(image_roles) if role.kind in ("white", "phase")]
    for kind, axis, index in where:
        if kind == "gray" and ("gray_inverse", axis, index) in where:
            chosen += [where[kind, axis, index], where["gray_inverse", axis, index]]
    if not chosen:
        return np.full(stack.shape[1:], np.nan)
    mean = stack[chosen].mean(axis=0, dtype=np.float64)
    mean[stack[chosen].max(axis=0) >= full_scale] = np.nan
    return np.asarray(mean)


def rectified(values: Floats, positions: NDArray[np.float32], seen: NDArray[np.bool_]) -> Floats:
    """Return values (H, W) at raw ``positions`` (2, h, w), NaN where they are not ``seen`` (h, w)."""
    out = map_coordinates(values, positions[::-1], output=np.float64, order=1, cval=np.nan)
    return np.where(seen, out, np.nan)


def measured_row_error(images: tuple[Levels, Levels], geometry: StereoGeometry, cloud: PointCloud) -> float:
    """Return the median row error [px] of the right image of a decoded pair; NaN with too few patches, or uneven ones.

    ``images`` (H, W) raw left and right [DN], with texture; ``cloud`` on the rectified left grid.
    """
    local = (cloud.points.astype(float) - geometry.grid.origin) @ geometry.grid.rotation
    disparity = np.where(cloud.valid, geometry.rectification.disparity(local[..., 2]), np.nan)
    left, right = (image.astype(float) for image in images)
    errors = _of_patches(left, right, geometry, disparity, MAXIMUM_ROWS)
    return float(np.median(errors)) if len(errors) >= _LEAST and _spread(errors) <= LARGEST_SPREAD else float("nan")


def textured_row_error(
    textures: tuple[Floats, Floats], columns: tuple[Floats, Floats], geometry: StereoGeometry
) -> float:
    """Return the row error [px] of the right image of a pair that sees a code of columns; NaN if patches disagree.

    ``textures`` [DN] and ``columns`` [projector px], (H, W) each: raw left and right, NaN where unknown.
    """
    left, right = (
        np.where(np.isfinite(texture), coordinate, np.nan)
        for texture, coordinate in zip(textures, columns, strict=True)
    )
    left = rectified(left, geometry.map_left, geometry.seen_left)
    right = rectified(right, geometry.map_right, geometry.seen_right)
    right_columns = np.stack(
        [find_coordinates(left_row, right_row)[0] for left_row, right_row in zip(left, right, strict=True)]
    )
    errors = _of_patches(*textures, geometry, np.arange(right_columns.shape[1]) - right_columns, _ROWS)
    if len(errors) < _LEAST:
        return float("nan")
    middle = float(np.median(errors))
    agreed = 1.2533 * _spread(errors) / np.sqrt(len(errors)) <= _OF_ALL + _UNEVEN * abs(middle)
    return middle if agreed else float("nan")


def _spread(errors: Floats) -> float:
    """Return the standard deviation of errors (n,), from the median of their deviations."""
    return MEDIAN_TO_STD * float(np.median(np.abs(errors - np.median(errors))))


def _of_patches(left: Floats, right: Floats, geometry: StereoGeometry, disparity: Floats, reach: int) -> Floats:
    """Return the row errors [px] of patches of raw images whose pixels have a disparity (H, W), NaN for none."""
    matched = np.isfinite(disparity)
    height, width = matched.shape
    corners = [
        (row, column)
        for row in range(0, height - _PATCH + 1, _PATCH)
        for column in range(0, width - _PATCH + 1, _PATCH)
        if matched[row : row + _PATCH, column : column + _PATCH].mean() >= _MATCHED
    ]
    errors = []
    for row, column in corners[:: -(-len(corners) // _MOST) or 1]:
        rows, columns = np.nonzero(matched[row : row + _PATCH, column : column + _PATCH])
        rows, columns = rows + row, columns + column
        errors.append(row_error(left, right, geometry, rows, columns, disparity[rows, columns], reach))
    return np.array(errors, float)[np.isfinite(errors)] if errors else np.empty(0)
