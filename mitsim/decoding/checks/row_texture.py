"""Measure the row error of the second camera by the texture of the surface, for codes of columns alone.

Signal chain: images of a code that light every column equally -> texture of both cameras on the rectified grids -> for
several row offsets, the place in the right image with the left pixel's column -> correlation of a patch's texture there
with the left one -> from the best offset, least squares for a shift in both directions -> median of the precise
patches, and its standard error.

A column matches in any row, so a row error is hidden in the decoded depth. Texture reveals it: prints, scratches and
edges on a surface. Highlights and shading move with the camera, so their patches disagree. If the patches have no
common offset, there is no result.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from mitsim.decoding.matching.stereo import StereoGeometry
from mitsim.decoding.structured_light.two_cameras import LARGEST_STEP_PX, find_coordinates
from mitsim.sensor.image_role import Role

Levels = NDArray[np.unsignedinteger[Any]]
Floats = NDArray[np.float64]

#: range of row offsets tried; side of a patch [px]; share of its pixels that must be matched at every offset
_ROWS, _PATCH, _MATCHED = 6, 40, 0.3

#: largest standard error [px] of a patch; least number of patches; largest standard error [px] of their median, plus a
#: share of the median, because a rotated camera has an uneven row error
_OF_A_PATCH, _LEAST, _OF_ALL, _UNEVEN = 0.25, 8, 0.06, 0.05

#: largest scatter of the patches about a smooth variation, as a share of the variation
_FOLLOWED = 0.3


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


def textured_row_error(
    textures: tuple[Floats, Floats], columns: tuple[Floats, Floats], geometry: StereoGeometry
) -> tuple[float, float]:
    """Return the row error [px] of the right image of a pair, and its smooth variation over the image (rms) [px].

    The row error is NaN if the texture does not give it. The variation is NaN unless the patches agree on it: they lie
    near a bilinear function of the image position, as with a wrong calibration, but not with highlights that move.

    ``textures`` [DN] and ``columns`` [projector px], (H, W) each: raw left and right, NaN where unknown.
    """
    left, right = (
        [rectified(values, positions, seen) for values in own]
        for own, positions, seen in (
            ((textures[0], columns[0]), geometry.map_left, geometry.seen_left),
            ((textures[1], columns[1]), geometry.map_right, geometry.seen_right),
        )
    )
    place = np.stack([find_coordinates(one, other)[0] for one, other in zip(left[1], right[1], strict=True)])
    place[~np.isfinite(left[0])] = np.nan
    shifts, places = [], []
    for row in range(_ROWS, place.shape[0] - _PATCH - _ROWS, _PATCH):
        for column in range(0, place.shape[1] - _PATCH, _PATCH):
            rows, at = np.nonzero(np.isfinite(place[row : row + _PATCH, column : column + _PATCH]))
            if len(rows) >= _MATCHED * _PATCH**2:
                shifts.append(_of_a_patch(left, right, rows + row, at + column, place[rows + row, at + column]))
                places.append((row, column))
    precise = [number for number, (_, error) in enumerate(shifts) if error < _OF_A_PATCH]
    known = np.array([shifts[number][0] for number in precise])
    if len(known) < _LEAST:
        return float("nan"), float("nan")
    variation = _smooth_variation(np.array(places, float)[precise] / place.shape, known)
    middle = float(np.median(known))
    spread = 1.4826 * float(np.median(np.abs(known - middle)))
    agreed = 1.2533 * spread / np.sqrt(len(known)) <= _OF_ALL + _UNEVEN * abs(middle)
    return (middle if agreed else float("nan")), variation


def _smooth_variation(places: Floats, errors: Floats) -> float:
    """Return the rms [px] of the bilinear function that row errors (n,) at ``places`` (n, 2) follow; NaN if none.

    The function is fitted by least absolute deviations, by reweighting.
    """
    if len(errors) < 2 * _LEAST:
        return float("nan")
    table = np.stack([np.ones(len(errors)), *places.T, places.prod(axis=1)], axis=1)
    weight = np.ones(len(errors))
    for _ in range(20):
        fitted = table @ np.linalg.lstsq(table * weight[:, None], errors * weight)[0]
        weight = 1 / np.sqrt(np.maximum(np.abs(errors - fitted), 0.02))
    left = 1.4826 * float(np.median(np.abs(errors - fitted)))
    varying = float(np.std(fitted))
    return varying if left < _FOLLOWED * varying else float("nan")


def rectified(values: Floats, positions: NDArray[np.float32], seen: NDArray[np.bool_]) -> Floats:
    """Return values (H, W) at raw ``positions`` (2, h, w), NaN where they are not ``seen`` (h, w)."""
    out = map_coordinates(values, positions[::-1], output=np.float64, order=1, cval=np.nan)
    return np.where(seen, out, np.nan)


def _of_a_patch(
    left: Sequence[Floats], right: Sequence[Floats], rows: NDArray[np.intp], columns: NDArray[np.intp], place: Floats
) -> tuple[float, float]:
    """Return the row error of a patch and its standard error [px]; NaN and infinity if no offset in range fits best.

    ``left``, ``right``: texture and projector columns (H, W), rectified; ``place`` (n,): position in the right image of
    the pixels ``rows``, ``columns``.
    """
    wanted, mine = left[1][rows, columns], left[0][rows, columns]
    theirs = np.stack(
        [
            _along(right[0], rows + step, _same_column(right[1], rows + step, wanted, place))
            for step in range(-_ROWS, _ROWS + 1)
        ]
    )
    whole = np.isfinite(theirs).all(axis=0)
    if whole.sum() < _MATCHED * _PATCH**2:
        return float("nan"), float("inf")
    mine, theirs = mine[whole] - mine[whole].mean(), theirs[:, whole]
    theirs -= theirs.mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = 1 - (theirs @ mine) ** 2 / ((theirs**2).sum(axis=1) * (mine @ mine))
    if not np.isfinite(apart).all():
        return float("nan"), float("inf")
    best = int(np.argmin(apart))
    if not 0 < best < 2 * _ROWS:
        return float("nan"), float("inf")
    place = _same_column(right[1], rows + best - _ROWS, wanted, place)
    return _refined(left[0][rows, columns], right[0], rows + float(best - _ROWS), place, float(best - _ROWS))


def _refined(
    mine: Floats, texture: Floats, rows: NDArray[np.floating], columns: Floats, start: float
) -> tuple[float, float]:
    """Return row error and standard error [px] by least squares for gain, offset, and a shift in two directions.

    ``mine`` (n,) is matched to the ``texture`` (H, W) near ``rows``, ``columns``. Without the shift along the rows, an
    error of the coordinate would bias the result for oblique texture.
    """
    across = along = 0.0
    for _ in range(3):
        here, left, right, over, under = (
            map_coordinates(texture, [rows + across + down, columns + along + on], order=1, cval=np.nan)
            for down, on in ((0, 0), (0, -0.5), (0, 0.5), (-0.5, 0), (0.5, 0))
        )
        table = np.stack([here, np.ones_like(here), right - left, under - over], axis=1)
        used = np.isfinite(table).all(axis=1) & np.isfinite(mine)
        if used.sum() < _MATCHED * _PATCH**2:
            return float("nan"), float("inf")
        found, _, rank, _ = np.linalg.lstsq(table[used], mine[used])
        if rank < 4 or found[0] <= 0:
            return float("nan"), float("inf")
        along, across = along + found[2] / found[0], across + found[3] / found[0]
        if not max(abs(along), abs(across)) < 1.5:
            return float("nan"), float("inf")
    off = mine[used] - table[used] @ found
    spread = np.linalg.inv(table[used].T @ table[used])[3, 3] * (off @ off) / (used.sum() - 4)
    return start + across, float(np.sqrt(spread)) / float(found[0])


def _same_column(coordinate: Floats, rows: NDArray[np.intp], wanted: Floats, place: Floats) -> Floats:
    """Return where ``rows`` (n,) of (H, W) have the coordinate ``wanted``, near ``place``: two Newton steps."""
    for _ in range(2):
        low = np.clip(np.nan_to_num(place), 0, coordinate.shape[1] - 2).astype(np.intp)
        one, other = coordinate[rows, low], coordinate[rows, low + 1]
        slope = np.where((other > one) & (other - one <= LARGEST_STEP_PX), other - one, np.nan)
        place = low + (wanted - one) / slope
    return place


def _along(values: Floats, rows: NDArray[np.intp], place: Floats) -> Floats:
    """Interpolate ``rows`` (n,) of (H, W) linearly at one ``place`` each; NaN outside."""
    inside = (place >= 0) & (place < values.shape[1] - 1)
    low = np.where(inside, place, 0).astype(np.intp)
    share = np.where(inside, place, 0) - low
    return np.where(inside, (1 - share) * values[rows, low] + share * values[rows, low + 1], np.nan)
