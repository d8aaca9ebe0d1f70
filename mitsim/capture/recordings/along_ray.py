"""Tell distances along the ray of a pixel from depths along the axis of the camera, and make depths of them.

Signal chain: distance r of a pixel -> the z of its unit view direction -> depth r z.

A plane n . p = d has the inverse depth n . (x, y, 1) / d, linear in the coordinates x, y of the image at depth 1. The
inverse of a distance along the ray is this over s = sqrt(1 + x^2 + y^2). With 1 / (depth s^q), a plane tells q: 0 for
depths, 1 for distances along the ray.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera

#: pixels between those that are compared, as a share of the longer side of the image; chosen
_STEP = 1 / 160

#: tiles along each side of the image, each of which may show one plane; chosen
_TILES = 3

#: least share of a tile's pixels with a depth; chosen
_FULL = 0.7

#: largest residual of a plane, as a share of its depth; chosen: edges and curved faces leave more, noise seldom does
_FLAT = 0.01

#: largest standard error of q in a tile that has a say, with each pixel taken for independent; chosen
_SURE = 0.1

#: largest distance from 1 of q, which distances along the ray have; chosen: in tiles of a sphere q differs by more
_NEAR = 0.2

#: fewest tiles that show a plane, of which :data:`_MOST` have to agree; chosen
_FEWEST = 3

#: share of the tiles with a plane that agree on q; chosen
_MOST = 0.8


def depths_of_ranges(ranges: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Return the depths (H, W) along the camera's axis of distances along the rays of its pixels, in their unit."""
    return (ranges * camera.rays(camera.pixel_grid())[..., 2]).astype(np.float32)


def reads_as_ranges(depth: NDArray[np.float32], camera: Camera) -> bool:
    """Return whether planes are flat only if an image (H, W) has distances along the ray.

    Without planes, or with a narrow field of view, nothing can be told: False.
    """
    step = max(round(_STEP * max(depth.shape)), 1)
    pixels = camera.pixel_grid()[::step, ::step]
    x, y, z = np.moveaxis(camera.rays(pixels), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.stack([x / z, y / z, np.ones_like(z), np.log(z), 1 / depth[::step, ::step]], axis=-1)
    exponents = [
        _exponent(tile.reshape(-1, terms.shape[-1]))
        for rows in np.array_split(terms, _TILES)
        for tile in np.array_split(rows, _TILES, axis=1)
    ]
    known = np.array([exponent for exponent in exponents if exponent is not None])
    return len(known) >= _FEWEST and bool(np.mean(np.abs(known - 1) < _NEAR) >= _MOST)


def _exponent(terms: NDArray[np.float64]) -> float | None:
    """Return the q of a tile from x, y, 1, ln(1 / s) and the inverse depth of its pixels; None if it shows no plane."""
    seen = terms[np.isfinite(terms).all(axis=1)]
    if len(seen) < max(_FULL * len(terms), 30):
        return None
    inverse = seen[:, 4]
    plane = seen[:, :3] @ np.linalg.lstsq(seen[:, :3], inverse, rcond=None)[0]  # without the noise of a pixel
    design = np.column_stack([seen[:, :3], plane * seen[:, 3]])
    solution, _, rank, _ = np.linalg.lstsq(design, inverse, rcond=None)
    residual = inverse - design @ solution
    if rank < design.shape[1] or residual.std() > _FLAT * inverse.mean():
        return None
    error = np.sqrt(np.linalg.inv(design.T @ design)[3, 3] * residual.var())
    return float(solution[3]) if error <= _SURE else None
