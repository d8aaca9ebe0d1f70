"""Numbers for the directions of later bounces, spread evenly over each small neighbourhood of an image.

Signal chain: pixel (column, row) -> its place along a Z-order curve -> number of the sample -> additive recurrence.

Any square block of 2^k x 2^k pixels is a contiguous part of the Z-order curve, and any contiguous part of the
recurrence R_3 (Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018; Kronecker's sequence with
powers of the root of x^4 = x + 1) fills the unit cube evenly. So what a mean over neighbouring pixels leaves of the
error falls faster than with independent random numbers (Ahmed & Wonka, "Screen-space blue-noise diffusion of Monte
Carlo sampling error via hierarchical ordering of pixels", 2020). A seed shifts the sequence (Cranley & Patterson
1976): each single number is uniform, and every estimate is unbiased over seeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsim.scene.backend import dr, mi

_ROOT = 1.2207440846057596

#: steps of the three coordinates, as whole numbers of 2^-32
_STEPS = [round(2**32 / _ROOT**power) for power in (1, 2, 3)]


def z_order(column: Any, row: Any) -> Any:
    """Place of a pixel along the Z-order curve: the bits of column and row, interleaved; 16 bits of each."""
    return _spread(column) | (_spread(row) << 1)


def evenly(index: Any, seed: Any, stream: int) -> tuple[Any, Any]:
    """Number in [0, 1) and point of the unit square for a sample's index (uint32); ``seed`` an opaque uint32.

    ``stream`` tells uses of one seed apart.
    """
    values = []
    for axis, step in enumerate(_STEPS):
        shift = mi.sample_tea_32(seed, dr.opaque(mi.UInt32, 3 * stream + axis), 6)[0]
        bits = index * mi.UInt32(step) + shift
        values.append(mi.Float(bits >> 8) * np.float32(2**-24))
    return values[0], mi.Point2f(values[1], values[2])


def _spread(value: Any) -> Any:
    """The lower 16 bits of a number, with a zero between any two."""
    value = value & 0xFFFF
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | (value << shift)) & mask
    return value
