"""Show a capture on the pixels of one pinhole camera: image, depth, status, labels and true depth.

The camera is the cloud's grid: for a stereo sensor its rectified left image, else its camera without distortion. Each
pixel takes depth and status from the nearest pixel of the cloud, carried along the surface's slope to the pixel's own
ray, and grey values by linear interpolation. Nothing is filled in: depth is NaN without a point, and ``status`` gives
the reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import capture_cloud, capture_geometry, decoder_settings
from mitsim.report.export.run_scene import sensor_from_grid
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast, shapes_met
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class Frame:
    """One capture on the pixels of a pinhole camera, (H, W) each.

    - ``grey`` uint8, None if the capture has no images.
    - ``depth`` [mm] along the axis, NaN without a point; ``status``.
    - ``shape``: index into the scene's names, -1 for none, and ``true_depth`` [mm], for the ray through the centre of
      the pixel.
    - ``camera_from_part``.
    - ``masks``: silhouette and visible part of each object, (H, W) bool.
    """

    grid: ViewGrid
    grey: NDArray[np.uint8] | None
    depth: NDArray[np.float64]
    status: NDArray[np.uint8]
    shape: NDArray[np.int16]
    true_depth: NDArray[np.float64]
    camera_from_part: Transform
    masks: tuple[tuple[NDArray[np.bool_], NDArray[np.bool_]], ...]


def bop_frame(capture: Capture, scene: Scene, objects: Sequence[Scene], where: str | Path) -> tuple[Frame, float]:
    """Decode a capture onto a pinhole for BOP, with the scale of its depth [mm]; InputError without pose or points."""
    if capture.world_from_sensor is None:
        raise InputError(where, "pose.json", "no pose", "a capture whose pose in the part frame is known")
    settings, imager = decoder_settings(capture)
    cloud = capture_cloud(capture, settings, capture_geometry(capture, settings), imager=imager)
    grid = replace(cloud.grid, normalised=None)
    depth, status = on_pinhole(cloud, grid)
    rays, there = PixelRays.of_grid(grid), capture.world_from_sensor
    seen, met = cast(scene, rays, there, np.zeros((0, 3))), shapes_met(scene, rays, there)
    numbers = [[scene.names.index(name) for name in part.names] for part in objects]
    silhouettes = [shapes_met(part, rays, there) >= 0 for part in objects]
    masks = tuple((whole, np.isin(met, mine)) for whole, mine in zip(silhouettes, numbers, strict=True))
    along = grid.rays() @ grid.rotation[:, 2]
    pose = (capture.world_from_sensor @ sensor_from_grid(grid)).inverse()
    frame = Frame(grid, _grey(capture, grid), depth, status, seen.shape, seen.distance * along, pose, masks)
    return frame, depth_scale(float(settings.far_mm))


def on_pinhole(cloud: PointCloud, grid: ViewGrid) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return depth [mm] and status (H, W) of a cloud on a pinhole's pixels.

    Both are those of the nearest pixel of the grid. Its depth is carried to the pinhole's ray along a plane, on which
    1/depth is linear, with the slope toward the neighbours on either side.
    """
    depth = (cloud.points.astype(np.float64) - cloud.grid.origin) @ cloud.grid.rotation[:, 2]
    if cloud.grid.normalised is None:
        return depth, cloud.status
    exact = cloud.grid.project(grid.origin + 1000.0 * grid.rays())
    pixel = np.rint(exact)
    last = np.array([grid.width, grid.height]) - 1
    inside = np.asarray(np.isfinite(pixel).all(-1) & (pixel >= 0).all(-1) & (pixel <= last).all(-1))
    column, row = np.moveaxis(np.where(inside[..., None], pixel, 0).astype(np.intp), -1, 0)
    inverse = 1 / depth
    carried = inverse[row, column]
    for k, axis in enumerate((1, 0)):
        carried = carried + (exact - pixel)[..., k] * _slope(inverse, axis)[row, column]
    status = np.where(inside, cloud.status[row, column], np.uint8(Status.NO_SURFACE))
    return np.where(inside, 1 / carried, np.nan), status


def _slope(inverse: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the change of 1/depth per pixel along an axis, the smaller of both sides: one may lead over an edge."""
    steps = np.diff(inverse, axis=axis, prepend=np.nan, append=np.nan)
    before, after = (np.take(steps, range(k, k + inverse.shape[axis]), axis) for k in (0, 1))
    least = np.fmin(np.abs(before), np.abs(after))
    return np.nan_to_num(np.where(np.abs(before) == least, before, after))


def depth_scale(far: float) -> float:
    """Return the step of a depth image [mm]: the least of (1, 2, 5) x 10^n for which 16 bits reach ``far`` [mm]."""
    least = far / 65535
    power = 10.0 ** math.floor(math.log10(least))
    return next(round(k * power, 12) for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-12))


def _grey(capture: Capture, grid: ViewGrid) -> NDArray[np.uint8] | None:
    """Return the mean of the reference camera's lit images on the pinhole's pixels, full scale 255."""
    name, camera = next(iter(capture.rig.cameras.items()))
    if name not in capture.images or not len(capture.images[name]):
        return None
    pixels = camera.project((camera.centre + 1000.0 * grid.rays()).reshape(-1, 3)).reshape(grid.height, grid.width, 2)
    pixels = np.nan_to_num(pixels, nan=-9.0)  # outside the image
    light = capture.brightness(name) * 255 / (2**capture.bits - 1)
    sampled = map_coordinates(light, [pixels[..., 1], pixels[..., 0]], order=1, mode="constant", cval=0.0)
    return np.asarray(np.rint(np.nan_to_num(sampled)).clip(0, 255), np.uint8)
