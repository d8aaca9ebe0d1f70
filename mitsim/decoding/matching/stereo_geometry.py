"""Rectify a stereo rig: the raw pixel of each rectified pixel, and the grid of its clouds."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import ViewGrid
from mitsim.sensor.camera import Camera, Rectification, Rig, stereo_rectification
from mitsim.sensor.distortion_fold import before_fold, inverse_fold_radii


@dataclass(frozen=True)
class StereoGeometry:
    """Geometry of a rectified pair, computed once.

    - ``rectification``: matrices and rotations of the rectified pair.
    - ``map_left``, ``map_right``: (2, H, W) float32: raw column and row [px] of each rectified pixel.
    - ``seen_left``, ``seen_right``: (H, W) whether this raw pixel exists.
    - ``raw_size``: (H, W) of the raw left and right images.
    - ``grid``, ``baseline``: pixels of the cloud, and unit vector (3,) from the left to the right camera.
    """

    rectification: Rectification
    map_left: NDArray[np.float32]
    map_right: NDArray[np.float32]
    seen_left: NDArray[np.bool_]
    seen_right: NDArray[np.bool_]
    raw_size: tuple[tuple[int, int], tuple[int, int]]
    grid: ViewGrid
    baseline: NDArray[np.float64]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W) whether the reference camera has the pixel of the grid."""
        return self.seen_left


def stereo_geometry(rig: Rig) -> StereoGeometry:
    """Rectify the first two cameras of a rig, by its own rectification if it has one, else by Bouguet's method.

    Raises
    ------
    InputError
        If the rig has fewer than two cameras, or its second camera is to the left of the first.
    """
    if len(rig.cameras) < 2:
        raise InputError("rig", "cameras", f"{len(rig.cameras)}", "two or more for stereo")
    left, right = list(rig.cameras.values())[:2]
    rectification, to_right = rig.rectification, left.sensor_from_camera.inverse().points(right.centre)
    least = -0.7  # stereo_rectification rolls a pair whose second camera is above or below
    if rectification is not None:
        to_right, least = rectification.rotation_left @ to_right, 0.9
    rectification = rectification or stereo_rectification(left, right)
    if to_right[0] < least * np.linalg.norm(to_right) or rectification.baseline <= 0:
        raise InputError(
            "rig",
            "cameras",
            f"the second camera at {np.round(to_right, 1).tolist()} mm from the first",
            "a second camera to the right (+x) of the first, above or below",
            "name the left camera first; or R and T are inverted: they take points of the first camera to the second",
        )
    map_left, seen_left = _rectifying_map(left, rectification.matrix_left, rectification.rotation_left, rectification)
    map_right, seen_right = _rectifying_map(
        right, rectification.matrix_right, rectification.rotation_right, rectification
    )
    K = rectification.matrix_left
    grid = ViewGrid(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=rectification.width,
        height=rectification.height,
        rotation=left.sensor_from_camera.rotation @ rectification.rotation_left.T,
        origin=left.centre,
    )
    sizes = ((left.height, left.width), (right.height, right.width))
    return StereoGeometry(
        rectification, map_left, map_right, seen_left, seen_right, sizes, grid, rig.baseline_direction
    )


def _rectifying_map(
    camera: Camera, K: NDArray[np.float64], rotation: NDArray[np.float64], rectification: Rectification
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the raw pixel (2, H, W) of each rectified pixel, and whether the camera has it (H, W)."""
    size = (rectification.width, rectification.height)
    if camera.model == "fisheye":
        distortion = camera.distortion.reshape(-1, 1)
        raw = cv2.fisheye.initUndistortRectifyMap(camera.matrix, distortion, rotation, K, size, cv2.CV_32FC1)
    else:
        raw = cv2.initUndistortRectifyMap(camera.matrix, camera.distortion, rotation, K, size, cv2.CV_32FC1)
    column, row = np.asarray(raw[0]), np.asarray(raw[1])
    # Beyond the fold of a distortion the camera has no such pixel; at the fold, the map changes its orientation.
    across, down = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    ideal = np.stack([across, down, np.ones_like(across)], axis=-1).reshape(-1, 3) @ np.linalg.inv(K).T @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (ideal[:, :2] / ideal[:, 2:]).T
    unique = before_fold(x, y, inverse_fold_radii(camera.distortion, camera.model)).reshape(across.shape)
    (column_dy, column_dx), (row_dy, row_dx) = np.gradient(column), np.gradient(row)
    orientation_kept = column_dx * row_dy - column_dy * row_dx > 0
    exists = (column >= -0.5) & (column <= camera.width - 0.5) & (row >= -0.5) & (row <= camera.height - 0.5)
    return np.stack([column, row]), orientation_kept & exists & unique
