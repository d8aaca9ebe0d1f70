"""Noise of disparity on the dots of an N10's plate, recorded and simulated, dot by dot; and what would raise it.

python tests/benchmarks/plate_dots.py CAPTURE SIMULATED [left or right]

CAPTURE is the imported recording, SIMULATED its twin as `mitsim compare` writes it. The plate is the right
one of the two unless said. Of every dot: disparities
of its pixels about their own plane [px]. `mitsim compare` takes patches of 40 px instead, of which few have
points enough on such a plate. Then the twin's right image is changed, in one thing at a time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.decoding.matching.stereo_geometry import StereoGeometry, stereo_geometry

Floats = NDArray[np.float64]
#: rows and columns of each plate in the rectified left image, and of both plates in the raw right one
PLATES = {"left": np.s_[121:308, 117:303], "right": np.s_[135:325, 362:548]}
BOTH_PLATES = np.s_[60:420, 100:560]


def main(recorded: Path, simulated: Path, plate: str = "right") -> None:
    """Print one row for each."""
    part = PLATES[plate]
    real, twin = read_capture(recorded), read_capture(simulated)
    settings = decoder_settings(real)[0]
    geometry = stereo_geometry(real.rig)
    rng = np.random.default_rng(1)

    def gains(image: Floats) -> Floats:
        out = image.copy()
        for dot in dots_of(image, BOTH_PLATES):
            weight = cv2.GaussianBlur(dot.astype(float), (0, 0), 1.5)
            out += weight * rng.normal(0, 0.054) * (image - np.median(image[dot]))
        return out

    def rows(image: Floats) -> Floats:
        down, along = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
        for dot in dots_of(image, BOTH_PLATES):
            down += cv2.GaussianBlur(dot.astype(np.float32), (0, 0), 2) * np.float32(rng.normal(0, 0.065))
        return np.asarray(cv2.remap(image, along, down, cv2.INTER_CUBIC))

    print("| | dots | within a dot [px] |\n| --- | --- | --- |")
    for name, capture in (
        ("recorded", real),
        ("simulated", twin),
        ("contrast of each dot by 5.4 %", changed(twin, gains)),
        ("rows of each dot by 0.065 px", changed(twin, rows)),
        ("right camera blurred by 0.45 px", changed(twin, lambda image: cv2.GaussianBlur(image, (0, 0), 0.45))),
        ("rows of all by 0.1 px", changed(twin, lambda image: shifted(image, 0.1))),
        ("0.6 DN more noise", changed(twin, lambda image: image + rng.normal(0, 0.6, image.shape))),
    ):
        spread = within_dots(capture, settings, geometry, part)
        error = spread.std() / np.sqrt(len(spread))
        print(f"| {name} | {len(spread)} | {spread.mean():.4f}, u {error:.4f} |", flush=True)


def shifted(image: Floats, rows: float) -> Floats:
    """An image some rows lower."""
    down, along = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    return np.asarray(cv2.remap(image, along, down + np.float32(rows), cv2.INTER_CUBIC))


def dots_of(image: Floats, part: tuple[slice, slice]) -> list[NDArray[np.bool_]]:
    """Pixels of each dark dot of a part, and five around."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    dark = np.zeros(image.shape, bool)
    dark[part] = (smooth < 0.75 * cv2.GaussianBlur(smooth, (0, 0), 12))[part]
    labels, count = label(dark)
    one = [labels == index for index in range(1, count + 1)]
    return [binary_dilation(dot, iterations=5) for dot in one if 60 < dot.sum() < 400]


def changed(capture: Capture, change: Callable[[Floats], Floats]) -> Capture:
    """The capture with another right image."""
    name = list(capture.images)[1]
    image = np.clip(np.rint(change(capture.images[name][0].astype(float))), 0, 255).astype(np.uint8)
    return replace(capture, images=capture.images | {name: image[None]})


def within_dots(capture: Capture, settings: object, geometry: StereoGeometry, part: tuple[slice, slice]) -> Floats:
    """Standard deviation [px] of the disparities of every dot about their plane."""
    cloud = capture_cloud(capture, settings)  # type: ignore[arg-type]
    pair = geometry.rectification
    depth = ((cloud.points - cloud.grid.origin) @ cloud.grid.rotation)[..., 2]
    disparity = pair.matrix_left[0, 0] * pair.baseline / depth
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]] / 100.0
    surface = np.stack([np.ones_like(row), column, row, column**2, column * row, row**2], axis=-1)
    kept = np.zeros(depth.shape, bool)
    kept[part] = np.isfinite(disparity[part])
    for _ in range(6):
        off = disparity - surface @ np.linalg.lstsq(surface[kept], disparity[kept], rcond=None)[0]
        kept &= np.abs(off) < 4 * 1.4826 * np.median(np.abs(off[kept]))
    left = next(iter(capture.images.values()))[0].astype(np.float32)
    shown = cv2.remap(left, geometry.map_left[0], geometry.map_left[1], cv2.INTER_LINEAR)
    out = []
    for dot in dots_of(shown, part):
        own = dot & kept
        if own.sum() >= 80:
            plane = surface[own][:, :3]
            out.append((off[own] - plane @ np.linalg.lstsq(plane, off[own], rcond=None)[0]).std())
    return np.array(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
