"""Find the frame of a chequerboard in a cloud, by the image on the cloud's grid.

Signal chain: image on the grid -> inner corners [px] (OpenCV) -> plane through the points of the board -> view rays of
the corners, intersected with the plane -> rigid transform from the corners of the print, by least squares (Umeyama,
IEEE PAMI 13(4), 1991, without scale).

The origin is the first inner corner, x runs along the rows of corners, y along their columns, and z away from the
sensor. The first corner is beside a bright corner square of the board. Only a board with an odd and an even number of
inner corners has one such corner; for others the origin may be the opposite one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError
from characterisation.point_cloud import PointCloud
from mitsim.decoding.plate import rays_between, turn_and_scale

#: least number of points of the cloud on the board
_LEAST_POINTS = 100

#: largest rms distance of the corners from the print, over the pitch; corners of something else are farther
_LARGEST_SHARE = 0.2


@dataclass(frozen=True)
class BoardCorners:
    """A chequerboard of ``columns`` x ``rows`` inner corners, ``pitch`` [mm] apart."""

    columns: int
    rows: int
    pitch: float


def board_frame(
    board: BoardCorners, cloud: PointCloud, image: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], float, float]:
    """Return the frame of a board (4, 4) from the sensor frame, the scale of the corners, and their rms residual [mm].

    ``image`` (H, W) is grey, on the grid of the organised ``cloud`` that shows the board. Raises FitError if the image
    does not show the board, or the cloud has too few points on it.
    """
    detected, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=cv2.CALIB_CB_ACCURACY)
    if not detected:
        raise FitError(f"no chequerboard of {board.columns} x {board.rows} inner corners in the image")
    pixels = np.asarray(corners, np.float64).reshape(-1, 2)
    hull = cv2.convexHull(pixels.astype(np.float32))
    inside = np.zeros(image.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(hull).astype(np.int32), 1)
    points = cloud.points[(inside > 0) & cloud.valid].astype(np.float64)
    if len(points) < _LEAST_POINTS:
        raise FitError(f"{len(points)} points of the cloud on the board, at least {_LEAST_POINTS} are needed")
    grid = cloud.grid
    plane = fit_plane(points, grid.origin)
    rays = rays_between(grid, pixels)
    distances = ((plane.point - grid.origin) @ plane.normal) / (rays @ plane.normal)
    measured = grid.origin + rays * distances[:, None]
    row, column = np.divmod(np.arange(len(pixels)), board.columns)
    printed = np.column_stack([column, row, np.zeros(len(pixels))]) * board.pitch
    middle, centre = measured.mean(axis=0), printed.mean(axis=0)
    rotation, scale = turn_and_scale(measured - middle, printed - centre)
    residual = measured - middle - (printed - centre) @ rotation.T
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    if rms > _LARGEST_SHARE * board.pitch:
        raise FitError(f"corners {rms:.3g} mm from the print (rms): is its pitch {board.pitch:g} mm?")
    if rotation[:, 2] @ (middle - grid.origin) < 0:  # OpenCV found the corners in the sense of the other side
        raise FitError("corners in a mirrored order: is the image mirrored?")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation.T, centre - rotation.T @ middle
    return out, scale, rms
