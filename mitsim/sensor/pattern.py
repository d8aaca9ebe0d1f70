"""Make the patterns of projectors of dots: random blobs of a mask, spots of a diffractive element.

Signal chain, random dots: white noise -> Gaussian low pass -> threshold at the quantile that leaves the bright share ->
blur of the projection lens. The result is smooth blobs rather than cells, as in recordings of real projectors. Several
frames show the same mask shifted.

Gaussian noise filtered with standard deviation s has the autocorrelation exp(-tau^2 / 4 s^2). It crosses its median
1 / (pi s sqrt 2) times per pixel (Rice 1944), so the mean run length is pi sqrt(2) s.

Signal chain, diffraction spots: field -> square cells -> one of the possible positions in each cell -> Gaussian spot
there. A diffractive optical element lights a selection from a grid of diffraction orders. How manufacturers choose the
selection is not published; one spot in each cell keeps spots apart and their density uniform.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import correlate1d, gaussian_filter

from characterisation.files.documents import Document
from mitsim.sensor.point_spread import point_spread

Shift = Annotated[float, Field(ge=-1000, le=1000)]

#: mean run length of thresholded Gaussian noise per standard deviation of its filter
RUN_LENGTH_PER_SIGMA = np.pi * np.sqrt(2.0)

#: radius of a spot in standard deviations
_SPOT_REACH = 4.0


class RandomDots(Document):
    """Random pattern of an active-stereo projector, in projector pixels.

    ``seed`` selects the mask. Each device has its own, with the same statistics (:func:`another_mask`).

    ``shifts_px``: one frame for each, with the pattern shifted right and down by these amounts; empty is one frame.
    """

    kind: Literal["random_dots"]
    run_length_px: Annotated[float, Field(gt=0, le=1000)]
    bright_share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    blur_px: Annotated[float, Field(ge=0)] = 0.0
    seed: int = 0
    shifts_px: list[tuple[Shift, Shift]] = Field(default=[], max_length=16)

    @property
    def frames(self) -> int:
        """Return the number of images of a measurement."""
        return max(len(self.shifts_px), 1)


class DiffractionSpots(Document):
    """Bright spots on a dark field, as a diffractive optical element (DOE) projects them, in projector pixels.

    - ``cell_px``: side of the square cells; each contains one spot, whose centre has the value 1.
    - ``places``: number of possible positions along a cell's side (the orders of the element).
    - ``spot_px``: standard deviation of a spot.
    - ``tiles`` (across, down): number of repetitions of the pattern in the field.
    - ``seed`` of the random choice.
    """

    kind: Literal["diffraction_spots"]
    cell_px: Annotated[float, Field(ge=2, le=500)]
    places: int = Field(default=3, ge=2, le=100)
    spot_px: Annotated[float, Field(ge=0.3, le=50)]
    tiles: tuple[Annotated[int, Field(ge=1, le=20)], Annotated[int, Field(ge=1, le=20)]] = (1, 1)
    seed: int = 0

    @property
    def frames(self) -> int:
        """Return the number of images of a measurement."""
        return 1


DotPattern = RandomDots | DiffractionSpots


def another_mask(pattern: DotPattern, seed: int) -> DotPattern:
    """Return the pattern of another device of the same type: another realisation with the same statistics."""
    return pattern.model_copy(update={"seed": seed})


def dot_frames(pattern: DotPattern, width: int, height: int) -> NDArray[np.float32]:
    """Return every frame of a pattern, (frames, height, width), values 0..1."""
    if isinstance(pattern, DiffractionSpots):
        spots = diffraction_spots(
            width, height, pattern.cell_px, pattern.places, pattern.spot_px, pattern.tiles, pattern.seed
        )
        return spots[None].copy()
    arguments = (pattern.run_length_px, pattern.bright_share, pattern.blur_px, pattern.seed)
    if not pattern.shifts_px:
        return random_blobs(width, height, *arguments)[None]
    # the mask exceeds the field, so that a shift does not wrap around
    margin = int(np.ceil(np.abs(pattern.shifts_px).max())) + 1
    mask = random_blobs(width + 2 * margin, height + 2 * margin, *arguments)
    return np.stack([_cut(mask, margin - right, margin - down, width, height) for right, down in pattern.shifts_px])


def random_blobs(
    width: int, height: int, run_length_px: float, bright_share: float, blur_px: float, seed: int
) -> NDArray[np.float32]:
    """Return one pattern (height, width), values 0..1.

    ``width``, ``height``: of the projector [px]. ``run_length_px``, ``bright_share``: mean length of a bright or dark
    run along a row before the blur [projector px], and share of bright pixels [1]. ``blur_px``: standard deviation of
    the lens's point spread function [projector px]. ``seed``: selects the pattern.
    """
    binary = _sharp_blobs(width, height, run_length_px, bright_share, seed)
    for axis in (0, 1) if blur_px > 0 else ():
        binary = correlate1d(binary, point_spread(blur_px), axis, mode="wrap")
    return np.array(binary, np.float32)


@lru_cache(maxsize=8)  # a fit of a blur asks for the same masks, one for each draw, a hundred times
def _sharp_blobs(width: int, height: int, run_length_px: float, bright_share: float, seed: int) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    smooth = gaussian_filter(noise, run_length_px / RUN_LENGTH_PER_SIGMA, mode="wrap")
    return np.asarray(smooth > np.quantile(smooth, 1.0 - bright_share), np.float32)


@lru_cache(maxsize=2)  # the projector of a unit shows the mask that its decoder stores
def diffraction_spots(
    width: int, height: int, cell_px: float, places: int, spot_px: float, tiles: tuple[int, int], seed: int
) -> NDArray[np.float32]:
    """Return one pattern (height, width), values 0..1: a Gaussian spot with peak 1 in each cell of ``cell_px``.

    Cells are counted from the field's upper left corner.

    ``width``, ``height``: of the field [projector px]. ``cell_px``, ``places``, ``spot_px``: side of a cell, number of
    positions of its spot along each axis, and standard deviation of the spot. ``tiles``: (across, down) tiles of whole
    cells in which the pattern repeats; the last tile ends at the field's edge. ``seed``: selects the pattern.
    """
    down, across = int(np.ceil(height / cell_px)), int(np.ceil(width / cell_px))
    tile = (int(np.ceil(down / tiles[1])), int(np.ceil(across / tiles[0])))
    order = np.random.default_rng(seed).integers(0, places, (2, *tile))
    order = np.tile(order, (1, tiles[1], tiles[0]))[:, :down, :across]
    rows = cell_px * (np.arange(down)[:, None] + (order[0] + 0.5) / places) - 0.5
    columns = cell_px * (np.arange(across)[None] + (order[1] + 0.5) / places) - 0.5

    reach = int(np.ceil(_SPOT_REACH * spot_px))
    field = np.zeros((height + 2 * reach + 2, width + 2 * reach + 2), np.float32)
    near_row, near_column = np.rint(rows).astype(int), np.rint(columns).astype(int)
    steps = np.arange(-reach, reach + 1)
    inside = (near_row <= height) & (near_column <= width)
    near_row, near_column, rows, columns = (array[inside] for array in (near_row, near_column, rows, columns))
    pixels = near_row * field.shape[1] + near_column
    apart = len(np.unique(pixels)) == len(pixels)  # then indices do not repeat, which is faster
    falls = [np.exp(-0.5 * ((near_column + j - columns) / spot_px) ** 2) for j in steps]
    for i in steps:
        fall = np.exp(-0.5 * ((near_row + i - rows) / spot_px) ** 2)
        for j, across in zip(steps, falls, strict=True):
            index = (near_row + i + reach, near_column + j + reach)
            value = (fall * across).astype(np.float32)
            if apart:
                field[index] += value
            else:
                np.add.at(field, index, value)
    return np.minimum(field[reach : reach + height, reach : reach + width], 1.0)


def _cut(mask: NDArray[np.float32], left: float, top: float, width: int, height: int) -> NDArray[np.float32]:
    """Interpolate a part of a mask bilinearly; its pixel (0, 0) is at (left, top) of the mask."""
    column, row = int(np.floor(left)), int(np.floor(top))
    right_share, lower_share = np.float32(left - column), np.float32(top - row)
    part = mask[row : row + height + 1, column : column + width + 1]
    part = (1 - right_share) * part[:, :-1] + right_share * part[:, 1:]
    return np.asarray((1 - lower_share) * part[:-1] + lower_share * part[1:])
