"""Locate the edges between the stripes of a Gray code to sub-pixel accuracy, and interpolate coordinates between them.

Signal chain: numbers of the stripes along a row -> neighbouring pixels in neighbouring stripes, with an edge of known
coordinate between them -> column of the edge, where the changing bit is as bright as its inverse -> cubic interpolation
between the edges.

The slope of the cubic at an edge is that of the parabola through three edges (cubic Hermite interpolation with finite
differences).

The stripe number alone is a staircase. Two cameras that compare staircases match any pixel of a stripe with any other.
This causes a bias of up to half a stripe, not noise. Edges are the same points of the surface for both cameras.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.point_cloud import Status

#: signed light (H, W) of a bit, by its number (0 is the finest): positive where it is lit, 0 where pattern and inverse
#: are equal
SignedBit = Callable[[int], NDArray[np.floating]]


def interpolate_between_edges(
    number: NDArray[np.integer], valid: NDArray[np.bool_], signed: SignedBit, stripe: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Interpolate coordinates along rows between the edges of stripes.

    A pixel whose stripe has only one edge, as beside an occlusion, is extrapolated. It uses the slope of the stripe
    beyond that edge, and stays within its own stripe. A pixel without an edge, or without that neighbouring stripe,
    has no position within its stripe. Its coordinate is NaN.

    ``number``, ``valid``: (H, W) number of the stripe, and whether it was decoded. ``signed``: light of a bit, which
    locates the edges. ``stripe``: width of a stripe [projector px]. Returns ``coordinate``: (H, W) [projector px];
    ``located``: (H, W) whether the coordinate is a number.
    """
    height, width = number.shape
    is_edge, edge_column, edge_coordinate = _stripe_edges(number.astype(np.int64), valid, signed, stripe)
    # runs of pixels of one stripe, in the flattened image; each row ends a run
    continues = np.zeros((height, width), bool)
    continues[:, 1:] = valid[:, 1:] & valid[:, :-1] & (number[:, 1:] == number[:, :-1])
    run_of_pixel = np.cumsum(~continues.ravel()) - 1
    first = np.flatnonzero(~continues.ravel())
    last = np.append(first[1:], height * width) - 1

    def value_at(values: Floats, index: NDArray[np.integer], exists: NDArray[np.bool_]) -> Floats:
        return np.where(exists, values.ravel()[np.where(exists, index, 0)], np.nan)

    # an edge is stored at the pixel to its left: the pixel before a run, and the run's last pixel
    has_left = (first % width > 0) & is_edge.ravel()[np.maximum(first - 1, 0)]
    has_right = is_edge.ravel()[last]
    left, right = value_at(edge_column, first - 1, has_left), value_at(edge_column, last, has_right)
    edge_left, edge_right = value_at(edge_coordinate, first - 1, has_left), value_at(edge_coordinate, last, has_right)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (edge_right - edge_left) / (right - left)
    slope[~(np.abs(slope) > 0) | ~np.isfinite(slope)] = np.nan  # the same edge on both sides of a run
    slope_before, slope_after = np.roll(slope, 1), np.roll(slope, -1)
    two_edges = np.isfinite(slope)
    anchor_column = np.where(np.isfinite(left), left, right)
    anchor_value = np.where(np.isfinite(left), edge_left, edge_right)
    run_slope = np.where(
        two_edges, slope, np.where(np.isfinite(left), slope_before, np.where(np.isfinite(right), slope_after, np.nan))
    )
    run_slope = np.where(two_edges | (np.isfinite(left) != np.isfinite(right)), run_slope, np.nan)

    # at an edge between two runs with two edges each, both have the slope of the parabola through three edges
    length = np.where(two_edges, right - left, np.nan)
    length_before, length_after = np.roll(length, 1), np.roll(length, -1)
    with np.errstate(invalid="ignore"):
        slope_left = np.where(
            has_left, (length_before * slope + length * slope_before) / (length_before + length), np.nan
        )
        slope_right = np.where(
            has_right, (length_after * slope + length * slope_after) / (length_after + length), np.nan
        )
    curve_left = np.where(two_edges & np.isfinite(slope_left), (slope_left - slope) * length, 0.0)
    curve_right = np.where(two_edges & np.isfinite(slope_right), (slope_right - slope) * length, 0.0)

    column = np.broadcast_to(np.arange(width), (height, width)).ravel()
    out = anchor_value[run_of_pixel] + run_slope[run_of_pixel] * (column - anchor_column[run_of_pixel])
    t = np.nan_to_num((column - anchor_column[run_of_pixel]) / length[run_of_pixel])
    out += curve_left[run_of_pixel] * t * (1 - t) ** 2 - curve_right[run_of_pixel] * t**2 * (1 - t)
    centre = (number.ravel().astype(float) + 0.5) * stripe - 0.5
    out = np.clip(out, centre - stripe / 2, centre + stripe / 2)
    out[~valid.ravel()] = np.nan
    return out.reshape(height, width), np.isfinite(out).reshape(height, width)


def _stripe_edges(
    number: NDArray[np.int64], valid: NDArray[np.bool_], signed: SignedBit, stripe: float
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Return whether an edge lies between a pixel and the next in its row, its column, and its coordinate, (H, W)."""
    height, width = number.shape
    is_edge = np.zeros((height, width), bool)
    is_edge[:, :-1] = valid[:, :-1] & valid[:, 1:] & (np.abs(np.diff(number, axis=1)) == 1)
    gray = number ^ (number >> 1)
    changed = np.zeros((height, width), np.int64)
    changed[:, :-1] = gray[:, :-1] ^ gray[:, 1:]
    fraction = np.full((height, width), 0.5)
    for bit in range(int(number.max(initial=0)).bit_length()):
        selected = is_edge & (changed == 1 << bit)
        if not selected.any():
            continue
        light = signed(bit)
        rows, columns = np.nonzero(selected)
        light_here, light_next = light[rows, columns].astype(float), light[rows, columns + 1].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction[rows, columns] = np.where(
                light_here == light_next, 0.5, np.clip(light_here / (light_here - light_next), 0.0, 1.0)
            )
    edge_column = np.arange(width) + fraction
    edge_coordinate = np.zeros((height, width))
    edge_coordinate[:, :-1] = np.maximum(number[:, :-1], number[:, 1:]) * stripe - 0.5
    return is_edge, edge_column, edge_coordinate


def status_without_edges(status: NDArray[np.uint8], located: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the status (H, W) with ``AMBIGUOUS`` for valid pixels whose position within their stripe is unknown."""
    return np.where((status == Status.VALID) & ~located, np.uint8(Status.AMBIGUOUS), status)
