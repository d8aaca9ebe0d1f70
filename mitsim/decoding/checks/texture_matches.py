"""Match the texture of a surface between two cameras over all rows, for codes of columns alone.

Signal chain: texture and projector columns of both raw images -> texture over (row, projector column), where a point of
the surface has the same column in both cameras -> for each block of the first, its correlation with the second at all
row offsets -> blocks with one distinct maximum -> offsets that vary smoothly over the image -> pixels of both images.

The calibration is not used. So the matches can contradict it, however wrong it is: by hundreds of rows, or by
exchanged cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: largest number of rows compared, and of steps of the projector column; larger images are averaged over rows
COMPARED_ROWS, _STEPS = 400, 400

#: side of a block in rows and in steps; share of a block that must have texture in both cameras
_BLOCK, _FILLED = 24, 0.7

#: least correlation of a block; largest correlation at another offset, and largest share of (1 - that) of its 1 - best
_LEAST, _OTHER, _DISTINCT = 0.8, 0.6, 0.5

#: largest deviation of an offset from a plane over the image, as a share of the rows; least share and number of blocks
_SMOOTH, _LEAST_SHARE, LEAST_BLOCKS = 0.03, 0.6, 8


def texture_matches(textures: tuple[Floats, Floats], columns: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return pixels (n, 2) of the first raw image, and (n, 2) of the second that show the same texture.

    ``textures`` [DN] and ``columns`` [projector px], (H, W) each, NaN where unknown. Pixels are (column, row). They are
    empty if fewer than :data:`LEAST_BLOCKS` blocks match, or their offsets do not agree.
    """
    none = np.empty((0, 2)), np.empty((0, 2))
    known = [each[np.isfinite(each)] for each in columns]
    if min(each.size for each in known) < _BLOCK**2:
        return none
    low, high = (max(np.quantile(each, 0.01) for each in known), min(np.quantile(each, 0.99) for each in known))
    per_row = float(np.median([each.size for each in known])) / max(each.shape[0] for each in columns)
    count = int(min(_STEPS, max(per_row, 1)))
    if not high > low or count < _BLOCK:
        return none
    wanted = np.linspace(low, high, count)
    over = [_over_columns(*each, wanted) for each in zip(textures, columns, strict=True)]
    step = max(1, -(-max(each[0].shape[0] for each in over) // COMPARED_ROWS))
    first, second = (_averaged(texture, step) for texture, _ in over)
    rows, steps, offsets = _block_offsets(first, second)
    if len(rows) < LEAST_BLOCKS:
        return none
    kept = _smooth(rows, steps, offsets, _SMOOTH * len(first))
    if kept.sum() < max(LEAST_BLOCKS, _LEAST_SHARE * len(rows)):
        return none
    rows, steps, offsets = rows[kept], steps[kept], offsets[kept]
    pixels = []
    for (_, place), row in zip(over, (rows, rows + offsets), strict=True):
        raw = row * step + (step - 1) / 2
        near = np.clip(np.rint(raw), 0, len(place) - 1).astype(np.intp)
        pixels.append(np.stack([_place_at(place, near, steps), raw], axis=-1))
    usable = np.isfinite(pixels[0]).all(axis=1) & np.isfinite(pixels[1]).all(axis=1)
    return pixels[0][usable], pixels[1][usable]


def _over_columns(texture: Floats, columns: Floats, wanted: Floats) -> tuple[Floats, Floats]:
    """Return texture, and image column, (H, n) at ``wanted`` projector columns (n,) of each row; NaN where unknown."""
    texture_out, place_out = (np.full((len(texture), len(wanted)), np.nan) for _ in range(2))
    largest = 4 * (wanted[1] - wanted[0]) + 8
    for row, (values, own) in enumerate(zip(texture, columns, strict=True)):
        at = np.flatnonzero(np.isfinite(own) & np.isfinite(values))
        if len(at) < _BLOCK:
            continue
        # the columns rise along a row; pixels that step back belong to another surface
        rising = own[at] >= np.maximum.accumulate(own[at])
        at = at[rising]
        found = np.interp(wanted, own[at], at, left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(own[at], wanted), 1, len(at) - 1)
        found[own[at][after] - own[at][after - 1] > largest] = np.nan
        place_out[row] = found
        texture_out[row] = np.interp(found, at, values[at])
    return texture_out, place_out


def _averaged(values: Floats, step: int) -> Floats:
    """Return the means of ``step`` rows each; NaN if one is."""
    rows = len(values) // step * step
    return np.asarray(values[:rows].reshape(-1, step, values.shape[1]).mean(axis=1))


def _block_offsets(first: Floats, second: Floats) -> tuple[Floats, Floats, Floats]:
    """Return row and step of the middles, and row offsets, (k,) each, of blocks of ``first`` (H, n) in ``second``."""
    out = []
    for left in range(0, first.shape[1] - _BLOCK + 1, _BLOCK):
        other = second[:, left : left + _BLOCK]
        if other.shape[0] < _BLOCK:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(other, _BLOCK, axis=0).swapaxes(1, 2)
        strip = _Strip.of(windows.reshape(len(windows), -1))
        enough = strip.known.mean(axis=1) >= _FILLED
        if not enough.any():
            continue
        for top in range(0, first.shape[0] - _BLOCK + 1, _BLOCK // 2):
            own = first[top : top + _BLOCK, left : left + _BLOCK].ravel()
            known = np.isfinite(own)
            if known.mean() < _FILLED:
                continue
            score = strip.correlations(own, known)
            score[~enough] = -1
            best = int(np.argmax(score))
            second_best = max(_beside_maximum(score, best), 0.0)
            if score[best] < _LEAST or second_best > _OTHER or not 0 < best < len(score) - 1:
                continue
            if 1 - score[best] > _DISTINCT * (1 - second_best):
                continue
            before, peak, after = score[best - 1 : best + 2]
            curvature = 2 * peak - before - after
            shift = 0.5 * (after - before) / curvature if curvature > 0 else 0.0
            middle = (_BLOCK - 1) / 2
            out.append((top + middle, left + middle, best + shift - top))
    rows, steps, offsets = np.array(out, float).reshape(-1, 3).T
    return rows, steps, offsets


def _beside_maximum(score: Floats, best: int) -> float:
    """Return the largest score (n,) outside the maximum at ``best``, which ends where the score rises again."""
    falls = np.diff(score)
    rises_after, rises_before = np.flatnonzero(falls[best:] > 0), np.flatnonzero(falls[:best] < 0)
    after = score[best + rises_after[0] :] if rises_after.size else score[:0]
    before = score[: rises_before[-1] + 1] if rises_before.size else score[:0]
    return float(max(after.max(initial=-1.0), before.max(initial=-1.0)))


@dataclass(frozen=True)
class _Strip:
    """Blocks (k, n) at all rows of a strip of columns, ready to be compared with many others.

    ``known``: 1 where a pixel is known, else 0. ``values``: deviations from the mean of the known pixels of a block, 0
    elsewhere; ``squares`` of them.
    """

    known: Floats
    values: Floats
    squares: Floats

    @classmethod
    def of(cls, blocks: Floats) -> _Strip:
        known = np.isfinite(blocks).astype(float)
        values = np.where(known > 0, blocks, 0.0)
        values -= values.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1)
        values *= known
        return cls(known, values, values * values)

    def correlations(self, own: Floats, own_known: NDArray[np.bool_]) -> Floats:
        """Return the correlation coefficients (k,) of a block (n,) with the blocks, over the pixels known in both."""
        known = own_known.astype(float)
        a = np.where(own_known, own - own[own_known].mean(), 0.0)
        count = np.maximum(self.known @ known, 1)
        sum_a, sum_b = self.known @ a, self.values @ known
        covariance = self.values @ a - sum_a * sum_b / count
        variance_a = self.known @ (a * a) - sum_a**2 / count
        variance_b = self.squares @ known - sum_b**2 / count
        with np.errstate(divide="ignore", invalid="ignore"):
            out = covariance / np.sqrt(variance_a * variance_b)
        return np.where(np.isfinite(out) & (count >= 0.5 * len(own)), out, -1.0)


def _smooth(rows: Floats, steps: Floats, offsets: Floats, tolerance: float) -> NDArray[np.bool_]:
    """Return which offsets (n,) lie within ``tolerance`` of the plane over the image that most of them fit."""
    table = np.stack([np.ones_like(rows), rows, steps], axis=1)
    rng = np.random.default_rng(0)
    best = np.zeros(len(rows), bool)
    for _ in range(200):
        chosen = rng.choice(len(rows), 3, replace=False)
        if abs(np.linalg.det(table[chosen])) < 1:
            continue
        fits = np.abs(table @ np.linalg.solve(table[chosen], offsets[chosen]) - offsets) < tolerance
        if fits.sum() > best.sum():
            best = fits
    return best


def _place_at(place: Floats, rows: NDArray[np.intp], steps: Floats) -> Floats:
    """Return the image column (n,) at whole ``rows`` and at ``steps`` between whole steps."""
    low = np.floor(steps).astype(np.intp)
    share = steps - low
    return np.asarray((1 - share) * place[rows, low] + share * place[rows, np.minimum(low + 1, place.shape[1] - 1)])
