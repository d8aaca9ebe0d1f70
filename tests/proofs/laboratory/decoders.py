"""Decode the images of a world: by mitsim's decoder, or by OpenCV's stereo matcher as most users call it.

``ours`` is the decoder of the sensor, with its settings. ``sgbm`` draws its block from 5, 7, 9 and 11 px for every
world; ``sgbm5`` to ``sgbm11`` are one block. Its other settings are those of OpenCV's own sample
(samples/python/stereo_match.py): P1 = 8 b^2, P2 = 32 b^2, uniqueness 10 %, left-right check 1 px, speckle window 100
px and range 2 px. It matches the first frame.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from characterisation.point_cloud import PointCloud, Status
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import Geometry, capture_cloud
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.sensor.sensor import Sensor

Decoder = Literal["ours", "sgbm", "sgbm5", "sgbm7", "sgbm9", "sgbm11"]

BLOCKS = (5, 7, 9, 11)


def decoded(capture: Capture, sensor: Sensor, geometry: Geometry, decoder: Decoder, seed: int) -> PointCloud:
    """Return the cloud of a capture with the nominal calibration of its sensor.

    Raises
    ------
    ValueError
        If plain SGBM shall decode images that are no stereo pair.
    """
    if decoder == "ours":
        return capture_cloud(capture, sensor.settings, geometry, imager=sensor.imager)
    if not isinstance(geometry, StereoGeometry):
        raise ValueError(f"{decoder} needs a stereo pair, not the images of a {sensor.technology} sensor")
    block = int(decoder[4:]) if decoder != "sgbm" else int(np.random.default_rng([seed, 5]).choice(BLOCKS))
    return plain_sgbm(capture, sensor, geometry, block)


def plain_sgbm(capture: Capture, sensor: Sensor, geometry: StereoGeometry, block: int) -> PointCloud:
    """Return the cloud of a stereo pair, rectified as its calibration says, by OpenCV's matcher.

    Its pixels are those of the labels: a maker's rectification need not be the one that ``cv2.stereoRectify`` finds.
    """
    settings, grid, rectified = sensor.matcher, geometry.grid, geometry.rectification
    assert settings is not None
    cameras = list(capture.rig.cameras.items())[:2]
    matrices = rectified.matrix_left, rectified.matrix_right
    turns = rectified.rotation_left, rectified.rotation_right
    pair = []
    for (name, camera), turn, matrix in zip(cameras, turns, matrices, strict=True):
        size = (rectified.width, rectified.height)
        maps = cv2.initUndistortRectifyMap(camera.matrix, camera.distortion, turn, matrix, size, cv2.CV_32FC1)
        frame = np.round(capture.images[name][0] * (255 / (2**capture.bits - 1))).astype(np.uint8)
        pair.append(cv2.remap(frame, *maps, cv2.INTER_LINEAR))
    left = cameras[0][1]
    focal, baseline = matrices[0][0, 0], float(np.linalg.norm(cameras[1][1].centre - left.centre))
    offset = matrices[1][0, 2] - matrices[0][0, 2]
    nearest, farthest = (focal * baseline / depth - offset for depth in (settings.near_mm, settings.far_mm))
    first = int(np.floor(farthest)) - 1
    count = 16 * int(np.ceil((nearest - first + 2) / 16))
    # columns beyond the left edge, without which the matcher leaves out as many columns as it has disparities
    border = max(first + count, 0)
    wide = [cv2.copyMakeBorder(image, 0, 0, border, 0, cv2.BORDER_REPLICATE) for image in pair]
    matcher = cv2.StereoSGBM.create(
        minDisparity=first,
        numDisparities=count,
        blockSize=block,
        P1=8 * block**2,
        P2=32 * block**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
    )
    disparity = matcher.compute(*wide)[:, border:].astype(np.float32) / 16
    with np.errstate(divide="ignore"):
        depth = focal * baseline / (disparity + offset)
    valid = (disparity >= first) & (depth >= settings.near_mm) & (depth <= settings.far_mm)
    columns, rows = np.meshgrid(np.arange(rectified.width), np.arange(rectified.height))
    right_down = (np.stack([columns, rows], axis=-1) - matrices[0][:2, 2]) / np.diag(matrices[0])[:2]
    points = np.concatenate([right_down, np.ones_like(depth)[..., None]], axis=-1) * depth[..., None]
    in_sensor = points @ turns[0] @ left.sensor_from_camera.rotation.T + left.centre
    status = np.where(valid, Status.VALID, Status.AMBIGUOUS).astype(np.uint8)
    cloud = np.where(valid[..., None], in_sensor, np.nan).astype(np.float32)
    return PointCloud(cloud, status, grid, sensor.name, "simulated", geometry.baseline)
