"""Render the light that sensors project on the artefact: fringes or dots, for the strip that opens the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from PIL import Image

from mitsim.capture.simulated.rendering import Rendering
from mitsim.maps.campaign.orders import prepared_sensor
from mitsim.scene.load import load_scene
from mitsim.scene.ray_casting.triangles import hull_corners
from mitsim.sensor.poses import look_at
from mitsim.talk.talk_file import sensor_in

#: width of a frame [px]
WIDTH_PX = 280

#: height of a frame [px]
HEIGHT_PX = 210

#: largest number of frames
MOST_FRAMES = 5

#: brightness of a frame that is shown, over that of the brightest
_LIT = 0.1

#: direction of the view, from the part
_FROM = np.array([0.25, -0.72, 0.65])

#: largest number of surfaces on a light path
_DEPTH = 2


def projected_frames(folder: str, scene: str, parameters: tuple[tuple[str, str], ...], sensor: str) -> xr.Dataset:
    """Return frames (frame, row, column) of the artefact in a sensor's projected images, in 8 bits.

    All frames share one scale. Of many frames some are chosen evenly, of those that are not dark. A sensor that
    projects one image has one frame.
    """
    chosen = sensor_in(folder, sensor)
    loaded = load_scene(Path(folder) / scene, chosen.wavelength_nm, dict(parameters))
    near, far = chosen.working_range_mm
    radius = float(np.linalg.norm(loaded.bounds[1] - loaded.bounds[0])) / 2
    distance = min(max(near + radius, 3.2 * radius), far - radius)
    direction = _FROM / np.linalg.norm(_FROM)
    pose = look_at(loaded.centre + distance * direction, loaded.centre, sensor=chosen)
    rendering = Rendering(16, _DEPTH)
    capture = prepared_sensor(chosen).simulated.capture(loaded, pose, seed=1, rendering=rendering)
    name, stack = next(iter(capture.images.items()))
    bright = stack.reshape(len(stack), -1).mean(axis=1, dtype=float)
    lit = stack[bright > _LIT * bright.max()]
    chosen_frames = lit[np.unique(np.linspace(0, len(lit) - 1, MOST_FRAMES).round().astype(int))]
    corners = capture.rig.cameras[name].project(pose.inverse().points(hull_corners(loaded)))
    return xr.Dataset({"frames": (("frame", "row", "column"), _fitted(chosen_frames.astype(float), corners))})


def _fitted(frames: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return frames cut to the part with the proportions of the strip, in 8 bits."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, half = (low + high) / 2, 0.56 * max((high - low)[0], (high - low)[1] * WIDTH_PX / HEIGHT_PX)
    reach = half * np.array([1.0, HEIGHT_PX / WIDTH_PX])
    box = (*(middle - reach).tolist(), *(middle + reach).tolist())
    bright = np.percentile(frames, 99.5)
    out = []
    for frame in frames:
        image = Image.fromarray((255 * np.clip(frame / bright, 0, 1) ** 0.7).astype(np.uint8))
        inside = image.transform((WIDTH_PX, HEIGHT_PX), Image.Transform.EXTENT, box, Image.Resampling.BICUBIC)
        out.append(np.asarray(inside))
    return np.stack(out)
