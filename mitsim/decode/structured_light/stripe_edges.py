"""The edges between the stripes of a Gray code, to a fraction of a pixel, and coordinates that rise between them.

Signal chain: numbers of the stripes along a row -> neighbouring pixels whose stripes are neighbours: an edge of known
coordinate lies between them, where the one bit that changes has as much light as its inverse -> a cubic in between,
whose slope at an edge is that of the parabola through three edges (cubic Hermite interpolation, finite differences).

A stripe's number alone is a staircase. Two cameras that compare staircases match any pixel of a stripe with any other,
which is a bias of up to half a stripe, not noise; edges are the same places on the surface for both.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status

Floats = NDArray[np.float64]

#: signed light of a bit (H, W): over 0 where it is lit, 0 where pattern and inverse are alike; by number, 0 the finest
SignedBit = Callable[[int], NDArray[np.floating]]


def between_edges(
    number: NDArray[np.integer], valid: NDArray[np.bool_], signed: SignedBit, stripe: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return coordinates (H, W) [projector px] that are smooth between the edges of stripes, along rows.

    Parameters
    ----------
    number, valid
        (H, W) of the stripe, and whether it was decoded.
    signed
        Light of a bit, to find where it changes.
    stripe
        Width of a stripe [projector px].

    A pixel whose stripe shows one edge alone, as beside an occlusion, goes on with the slope of the stripe beyond that
    edge, up to the other side of its own stripe. One without an edge, or with no such neighbour, has no place within
    its stripe: it is NaN, and ``False`` in the mask (H, W) that is returned too.
    """
    height, width = number.shape
    pair, place, edge = _edges(number.astype(np.int64), valid, signed, stripe)
    # runs of pixels of one stripe, over the image as one line: a row ends a run
    together = np.zeros((height, width), bool)
    together[:, 1:] = valid[:, 1:] & valid[:, :-1] & (number[:, 1:] == number[:, :-1])
    run = np.cumsum(~together.ravel()) - 1
    first = np.flatnonzero(~together.ravel())
    last = np.append(first[1:], height * width) - 1

    def at(values: Floats, index: NDArray[np.integer], there: NDArray[np.bool_]) -> Floats:
        return np.where(there, values.ravel()[np.where(there, index, 0)], np.nan)

    # the pair before a run begins at its first pixel less one, the pair after it at its last
    has_left = (first % width > 0) & pair.ravel()[np.maximum(first - 1, 0)]
    has_right = pair.ravel()[last]
    left, right = at(place, first - 1, has_left), at(place, last, has_right)
    edge_left, edge_right = at(edge, first - 1, has_left), at(edge, last, has_right)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (edge_right - edge_left) / (right - left)
    slope[~(np.abs(slope) > 0) | ~np.isfinite(slope)] = np.nan  # back over the edge that it came by
    before, after = np.roll(slope, 1), np.roll(slope, -1)
    whole = np.isfinite(slope)
    start = np.where(np.isfinite(left), left, right)
    value = np.where(np.isfinite(left), edge_left, edge_right)
    used = np.where(whole, slope, np.where(np.isfinite(left), before, np.where(np.isfinite(right), after, np.nan)))
    used = np.where(whole | (np.isfinite(left) != np.isfinite(right)), used, np.nan)

    # at an edge between two whole stripes the coordinate has one slope, that of the parabola through three edges
    length = np.where(whole, right - left, np.nan)
    shorter, longer = np.roll(length, 1), np.roll(length, -1)
    with np.errstate(invalid="ignore"):
        slope_left = np.where(has_left, (shorter * slope + length * before) / (shorter + length), np.nan)
        slope_right = np.where(has_right, (longer * slope + length * after) / (longer + length), np.nan)
    bend_left = np.where(whole & np.isfinite(slope_left), (slope_left - slope) * length, 0.0)
    bend_right = np.where(whole & np.isfinite(slope_right), (slope_right - slope) * length, 0.0)

    column = np.broadcast_to(np.arange(width), (height, width)).ravel()
    out = value[run] + used[run] * (column - start[run])
    t = np.nan_to_num((column - start[run]) / length[run])
    out += bend_left[run] * t * (1 - t) ** 2 - bend_right[run] * t**2 * (1 - t)
    centre = (number.ravel().astype(float) + 0.5) * stripe - 0.5
    out = np.clip(out, centre - stripe / 2, centre + stripe / 2)
    out[~valid.ravel()] = np.nan
    return out.reshape(height, width), np.isfinite(out).reshape(height, width)


def _edges(
    number: NDArray[np.int64], valid: NDArray[np.bool_], signed: SignedBit, stripe: float
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Whether an edge lies between a pixel and the next of its row (H, W), its column, and its coordinate."""
    height, width = number.shape
    pair = np.zeros((height, width), bool)
    pair[:, :-1] = valid[:, :-1] & valid[:, 1:] & (np.abs(np.diff(number, axis=1)) == 1)
    gray = number ^ (number >> 1)
    changed = np.zeros((height, width), np.int64)
    changed[:, :-1] = gray[:, :-1] ^ gray[:, 1:]
    share = np.full((height, width), 0.5)
    for bit in range(int(number.max(initial=0)).bit_length()):
        here = pair & (changed == 1 << bit)
        if not here.any():
            continue
        light = signed(bit)
        rows, columns = np.nonzero(here)
        one, other = light[rows, columns].astype(float), light[rows, columns + 1].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            share[rows, columns] = np.where(one == other, 0.5, np.clip(one / (one - other), 0.0, 1.0))
    place = np.arange(width) + share
    edge = np.zeros((height, width))
    edge[:, :-1] = np.maximum(number[:, :-1], number[:, 1:]) * stripe - 0.5
    return pair, place, edge


def refused_without_edge(status: NDArray[np.uint8], placed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Statuses (H, W) of pixels: ``AMBIGUOUS`` for those whose place within their stripe nothing tells."""
    return np.where((status == Status.VALID) & ~placed, np.uint8(Status.AMBIGUOUS), status)
