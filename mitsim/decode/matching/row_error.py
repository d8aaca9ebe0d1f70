"""By how many rows the rectified right image of a pair is off: what calibration or a shock has left.

Rectified images show a point in the same row. Signal chain: pixels of a patch of the rectified left image -> their
places in the right one, by the disparity that was decoded -> sum of squared differences, less the means, at whole rows
up and down -> the parabola through the smallest and its neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from mitsim.decode.matching.stereo import StereoGeometry

Floats = NDArray[np.float64]

#: rows up and down that are tried
ROWS = 2


def row_error(
    left: Floats,
    right: Floats,
    geometry: StereoGeometry,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    disparity: Floats,
) -> float:
    """Rows [px] by which the right image must be moved to fit a patch best; NaN if more than :data:`ROWS`.

    ``left``, ``right`` (H, W) raw images [DN]; ``rows``, ``columns`` (n,) of the patch's pixels in the rectified left
    image, and their ``disparity`` (n,) [px].
    """
    mine = _at(left, geometry.map_left[:, rows, columns])
    costs = []
    for step in range(-ROWS, ROWS + 1):
        at = [rows + float(step), columns - disparity]
        raw = np.stack([map_coordinates(axis, at, order=1, mode="nearest") for axis in geometry.map_right])
        theirs = _at(right, raw)
        off = mine - mine.mean() - (theirs - theirs.mean())
        costs.append(float(np.mean(off**2)))
    best = int(np.argmin(costs))
    if not 0 < best < 2 * ROWS:
        return float("nan")
    before, here, after = costs[best - 1 : best + 2]
    bend = before - 2 * here + after
    return best - ROWS + (0.5 * (before - after) / bend if bend > 0 else 0.0)


def _at(image: Floats, raw: NDArray[np.floating]) -> Floats:
    return np.asarray(map_coordinates(image, [raw[1], raw[0]], order=1, mode="nearest"))
