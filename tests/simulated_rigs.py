"""Folders of images that a rig would have saved: exact projections of a tilted plane with a ball before it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from mitsim.sensor.light_code import roles, value

#: prints in place of waves: without repetition, and lines that repeat every few pixels
SPECKS, LINES = "specks", "lines"


@lru_cache(maxsize=4)
def surface_seen(camera, *, depth=500.0, tilt=0.1, ball=True):
    """Points (H, W, 3), read only, in the sensor frame of a plane z = depth + tilt x, and of a ball before it."""
    rays = camera.sensor_from_camera.directions(camera.rays(camera.pixel_grid()))
    centre = camera.centre
    length = (depth + tilt * centre[0] - centre[2]) / (rays[..., 2] - tilt * rays[..., 0])
    if ball:
        middle, radius = np.array([0.02 * depth, 0.0, 0.92 * depth]), 0.08 * depth
        along = rays @ (middle - centre)
        inside = along**2 - (centre - middle) @ (centre - middle) + radius**2
        length = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), length)
    points = centre + rays * length[..., None]
    points.flags.writeable = False
    return points


def images_seen(code, camera, projector, points, *, full=255, noise=1.0, seed=1, gamma=1.0, texture=0.25):
    """Images (P, H, W) of a code by exact projection on a printed surface, blurred over the footprint of a pixel."""
    place = np.nan_to_num(projector.project(points), nan=-99.0)  # beyond the fold of its distortion: dark
    lit = ((place > -0.5) & (place < [projector.width - 0.5, projector.height - 0.5])).all(axis=-1)
    x, y, _ = np.moveaxis(points, -1, 0)
    if texture is SPECKS:
        print_px = gaussian_filter(np.random.default_rng(0).normal(size=(512, 512)), 2.0, mode="wrap")
        albedo = 0.6 + 0.12 * map_coordinates(print_px / print_px.std(), [y + 256, x + 256], order=1, mode="grid-wrap")
    elif texture is LINES:
        albedo = 0.6 + 0.15 * np.sign(np.sin(1.2 * y))
    else:
        albedo = 0.6 + texture * np.sin(x / 13.5) * np.cos(y / 17.3)
    draw, out = np.random.default_rng(seed), []
    spread = {}
    for axis, component in (("columns", 0), ("rows", 1)):
        down, along = np.gradient(place[..., component])
        spread[axis] = np.clip(np.abs(down) + np.abs(along), 0, 4)
    for role in roles(code, projector.width, projector.height):
        axis = role.axis or "columns"
        at = place[..., 1 if axis == "rows" else 0]
        steps = (-0.375, -0.125, 0.125, 0.375) if role.axis else (0.0,)  # white and black have no stripes to blur
        shown = sum(value(code, role, at + step * spread[axis]) ** gamma for step in steps) / len(steps)
        level = 0.04 + 0.8 * albedo * np.where(lit, shown, 0)
        out.append(np.clip(full * level + draw.normal(0, noise * full / 255, level.shape), 0, full - 1))
    return np.rint(out).astype(np.uint8 if full < 256 else np.uint16)


def save_images(folder: Path, stack, names="image_{:02d}.png", first=0):
    """Write each image under its number."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, image in enumerate(stack):
        path = folder / names.format(index + first)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return folder


def save_calibration(path: Path, **values):
    """Write numbers and matrices as OpenCV's FileStorage."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, number in values.items():
        storage.write(name, np.asarray(number, float) if np.ndim(number) else number)
    storage.release()
    return path
