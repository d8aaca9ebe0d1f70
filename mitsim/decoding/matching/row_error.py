"""Measure the row error of the rectified right image of a pair, which a calibration error or a shock causes.

Rectified images show a point in the same row.

Signal chain: pixels of a patch of the rectified left image -> their positions in the right image, by the decoded
disparity -> mean squared difference without the means, at whole rows up and down -> parabola through the least value
and its neighbours -> row error [px].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.arrays import Floats
from mitsim.decoding.matching.stereo_geometry import StereoGeometry

#: largest offset that is tested, up and down [rows]: farther, a matcher finds hardly a point
MAXIMUM_ROWS = 2


def row_error(
    left: Floats,
    right: Floats,
    geometry: StereoGeometry,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    disparity: Floats,
    reach: int = MAXIMUM_ROWS,
) -> float:
    """Return by how many rows [px] a patch lies lower in the right image than in the left one.

    It is NaN if the best offset is not within ``reach``.

    Parameters
    ----------
    left, right
        (H, W) raw images [DN].
    geometry
        Rectifying maps of the pair.
    rows, columns
        (n,) pixels of the patch in the rectified left image.
    disparity
        (n,) of these pixels [px].
    reach
        Largest offset that is tested, up and down [rows].
    """
    left_levels = _sampled(left, geometry.map_left[:, rows, columns])
    steps = np.arange(-reach, reach + 1.0)[:, None]
    positions = np.broadcast_arrays(rows + steps, columns - disparity)
    raw = np.stack([map_coordinates(axis, positions, order=1, mode="nearest") for axis in geometry.map_right])
    right_levels = _sampled(right, raw)
    difference = left_levels - left_levels.mean() - (right_levels - right_levels.mean(axis=1, keepdims=True))
    costs = np.mean(difference**2, axis=1).tolist()
    best = int(np.argmin(costs))
    if not 0 < best < 2 * reach:
        return float("nan")
    before, lowest, after = costs[best - 1 : best + 2]
    curvature = before - 2 * lowest + after
    return best - reach + (0.5 * (before - after) / curvature if curvature > 0 else 0.0)


def _sampled(image: Floats, raw: NDArray[np.floating]) -> Floats:
    return np.asarray(map_coordinates(image, [raw[1], raw[0]], order=1, mode="nearest"))
