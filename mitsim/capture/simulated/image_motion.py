"""Move images of a part to where another pose and calibration show it.

Signal chain: points of the part -> their pixels before and after -> affine map of least squares -> images interpolated
bilinearly, and continued with their border.

Light that trials share is traced at the nominal pose of a view. A part that is placed within 1 mm and 0.3 deg moves by
1.5 px (N10) to 3.7 px (Zivid), root mean square along each axis, and light at edges and reflections with it. The point
of the pattern that lights a surface moves as far in the image of the projector.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.sensor.camera import Camera
from mitsim.sensor.transforms import Transform

#: fewest points that determine an affine map with something to spare
_FEWEST = 4


def image_motion(
    before: Camera,
    world_from_sensor: Transform,
    after: Camera,
    other_world_from_sensor: Transform,
    points: NDArray[np.float64],
    roi: Roi,
) -> NDArray[np.float64] | None:
    """Return the affine map (2, 3) from pixels of a region after a motion to those before it, both within the region.

    It is None if too few points are in sight of both.

    Parameters
    ----------
    before, world_from_sensor, after, other_world_from_sensor
        Camera and pose of the sensor with which images are known, and those with which they are asked for.
    points, roi
        (n, 3) of the part [mm], world frame; region of the images.
    """
    corner = [roi.left, roi.top]
    first, second = (
        camera.project(pose.inverse().points(points)) - corner
        for camera, pose in ((before, world_from_sensor), (after, other_world_from_sensor))
    )
    return _affine(second, first)


def code_motion(
    before: Camera,
    world_from_sensor: Transform,
    after: Camera,
    other_world_from_sensor: Transform,
    points: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """Return the affine map (2, 3) of the texture coordinates [1] of a projector from before to after a motion.

    Light between surfaces carries the code of the surface that the projector lights, and moves on the pattern with it.

    Parameters
    ----------
    before, world_from_sensor
        Projector and pose of the sensor with which light is known.
    after, other_world_from_sensor
        Projector and pose with which it is asked for.
    points
        (n, 3) of the part [mm], world frame.

    See Also
    --------
    image_motion : the motion in an image; None likewise
    """
    first, second = (
        (projector.project(pose.inverse().points(points)) + 0.5) / [projector.width, projector.height]
        for projector, pose in ((before, world_from_sensor), (after, other_world_from_sensor))
    )
    return _affine(first, second)


def _affine(points: NDArray[np.float64], images: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the affine map (2, 3) of points (n, 2) to their images by least squares; None of too few finite pairs."""
    seen = np.isfinite(points).all(axis=1) & np.isfinite(images).all(axis=1)
    if seen.sum() < _FEWEST:
        return None
    known = np.column_stack([points[seen], np.ones(seen.sum())])
    solved, _, rank, _ = np.linalg.lstsq(known, images[seen], rcond=None)
    return np.asarray(solved.T) if rank == known.shape[1] else None


def moved_images(images: NDArray[np.float32], motion: NDArray[np.float64] | None) -> NDArray[np.float32]:
    """Return images (P, h, w) after a motion of :func:`image_motion`; None leaves them as they are."""
    if motion is None or not images.size:
        return images
    size, flags, border = images.shape[:0:-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
    return np.stack([cv2.warpAffine(image, motion, size, flags=flags, borderMode=border) for image in images])
