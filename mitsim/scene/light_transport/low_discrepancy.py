"""Low-discrepancy numbers for the directions of later bounces, even over each small neighbourhood of an image.

Signal chain: pixel (column, row) -> position along a Z-order curve -> index of the sample -> additive recurrence.

Any aligned square of 2^k x 2^k pixels is a contiguous part of the Z-order curve. Any contiguous part of the recurrence
R_3 fills the unit cube evenly [1]. R_3 is Kronecker's sequence with powers of the root of x^4 = x + 1. The error of a
mean over neighbouring pixels therefore falls faster than with independent random numbers [2].

A seed shifts the sequence (Cranley and Patterson, SIAM J. Numer. Anal. 13, 1976). Each number is uniform, so every
estimate is unbiased over seeds.

[1] Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
[2] Ahmed and Wonka, "Screen-space blue-noise diffusion of Monte Carlo sampling error via hierarchical ordering of
pixels", 2020.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import mi
from mitsim.scene.device import opaque_index

_ROOT = 1.2207440846057596

#: steps of the three coordinates, in units of 2^-32
_STEPS = [round(2**32 / _ROOT**power) for power in (1, 2, 3)]


def z_order(column: Any, row: Any) -> Any:
    """Return the position of a pixel along the Z-order curve: the lower 16 bits of column and row, interleaved."""
    return _spread(column) | (_spread(row) << 1)


def z_positions(column: NDArray[np.integer], row: NDArray[np.integer]) -> NDArray[np.uint32]:
    """Return the positions of :func:`z_order` for arrays of the host."""
    return np.asarray(_spread(column.astype(np.uint32)) | (_spread(row.astype(np.uint32)) << 1), np.uint32)


def r3_point(index: Any, seed: Any, stream: int) -> tuple[Any, Any]:
    """Return a number in [0, 1) and a point of the unit square; ``seed`` is opaque, ``stream`` tells uses apart."""
    values = []
    for axis, step in enumerate(_STEPS):
        shift = mi.sample_tea_32(seed, opaque_index(3 * stream + axis), 6)[0]
        bits = index * mi.UInt32(step) + shift
        values.append(mi.Float(bits >> 8) * np.float32(2**-24))
    return values[0], mi.Point2f(values[1], values[2])


def _spread(value: Any) -> Any:
    """Return the lower 16 bits of a number, with a zero between any two."""
    value = value & 0xFFFF
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | (value << shift)) & mask
    return value
