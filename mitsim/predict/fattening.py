"""How semi-global matching draws a surface out over an edge behind which another lies farther away.

Signal chain: distances and shapes of a view, pixel by pixel -> how far away along the rows and columns the next edge is
that has something farther behind it -> by how much the pixel's depth is that of pixels farther from the edge.

Blocks that reach over an edge are given the nearer surface's disparity, and smoothing along paths carries it on
("foreground fattening": of windows, Scharstein and Szeliski, Int. J. Comput. Vis. 47 (2002) 7-42; of paths,
Hirschmueller, IEEE Trans. PAMI 30 (2008) 328-341). What is beyond the edge belongs to no feature. On this side of it a
slanted face, such as the limb of a pillar, takes the depth of what lies a part of a pixel farther in, and comes out too
near:

    b = delta(q) (t(one pixel farther in) - t)

delta(q), q pixels from the edge, was read off 100 rendered views of single pillars of 14 to 40 px radius before a
plate, in matt white, seen by ``ensenso-n10`` (block of 5) from 440 to 720 mm; before nothing at all it was 0 within its
scatter. It is larger at edges on the side of the second camera: beyond the others lies what is hidden from that camera,
and is refused. Left out: how it depends on the block, the penalties and the contrast of the pattern on either side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: delta [px] of edges q = 4, 5, ... px away; nearer pixels belong to no feature. Along the epipolar lines, at edges on
#: the side of the second camera and on the other, and across them. Standard errors 0.05, 0.07, 0.03. *Read off*, above
FIRST_PX = 4
TOWARD = (0.75, 0.70, 0.53, 0.37, 0.25, 0.16)
AWAY = (0.32, 0.35, 0.24, 0.18, 0.07, 0.0)
ACROSS = (0.19, 0.13, 0.09, 0.07, 0.05, 0.02)

#: an edge has something farther behind it if the distance grows by more than this share from pixel to pixel
FARTHER = 0.01


def drawn_out(
    distance: Floats, shape: NDArray[np.integer], step: int = 1, epipolar_axis: int = 1, second_eye: int = 1
) -> Floats:  # fmt: skip
    """By how much points lie too far along their rays, b (h, w) [mm], for the surface is drawn out over edges.

    Parameters
    ----------
    distance, shape
        (h, w) along the rays [mm], and which shape is seen, -1 for none, at every ``step``-th pixel of a grid.
    epipolar_axis, second_eye
        Axis of the image along which disparities are, 1 for its rows; 1 or -1 if the second camera stands toward its
        end or its beginning.
    """
    out = np.zeros(distance.shape)
    along, across = epipolar_axis, 1 - epipolar_axis
    for axis, way, table in ((along, second_eye, TOWARD), (along, -second_eye, AWAY), (across, 1, ACROSS),
                             (across, -1, ACROSS)):  # fmt: skip
        t, one = np.moveaxis(distance, axis, 0)[::way], np.moveaxis(shape, axis, 0)[::way]
        drawn = np.moveaxis(out, axis, 0)[::way]
        drawn += _toward_the_end(t, one, table, step)
    return out


def _toward_the_end(t: Floats, shape: NDArray[np.integer], table: tuple[float, ...], step: int) -> Floats:
    """B [mm] for edges that are met along the first axis, in its direction."""
    length = len(t)
    inward = np.zeros(t.shape)
    known = (shape[1:] == shape[:-1]) & (shape[1:] >= 0)
    inward[1:][known] = (t[:-1] - t[1:])[known] / step
    edge = np.zeros(t.shape, bool)
    edge[:-1] = (shape[:-1] >= 0) & (shape[1:] >= 0) & ~known & (t[1:] > (1 + FARTHER) * t[:-1])
    delta = np.zeros(t.shape)
    same = np.ones(t.shape, bool)
    for number in range(1, -(-(FIRST_PX + len(table) - 1) // step) + 1):
        # the edge is between the pixels number - 1 and number farther on, and up to there all is one shape
        left = length - number + 1
        delta[:left][edge[number - 1 :] & same[:left]] = _share(table, number, step)
        same[: left - 1] &= shape[number:] == shape[: left - 1]
        same[left - 1 :] = False
    return delta * inward


def _share(table: tuple[float, ...], number: int, step: int) -> float:
    """Mean delta of edges that lie between ``number - 1`` and ``number`` steps away."""
    near = np.arange((number - 1) * step + 1, number * step + 1) - FIRST_PX
    known = (near >= 0) & (near < len(table))
    return float(np.array(table)[near[known]].sum() / max(int((near >= 0).sum()), 1))
