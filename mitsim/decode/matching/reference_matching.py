"""One camera and a projected pattern against a stored reference image, as PrimeSense's sensors do.

Signal chain, once: pattern, as the projector sends it -> where a plane at a known depth, across the camera's axis,
shows it to every pixel of the camera -> reference image. Then: raw image -> rectified so that camera and projector lie
along its rows -> matched along the rows to the reference -> disparity d to the reference -> depth -> points.

A plane across the axis of the rectified camera moves along a row as d = f B (1 / Z - 1 / Z0), with B the baseline from
camera to projector and Z0 the depth of the reference plane (Khoshelham and Elberink, Sensors 12(2), 2012, eq. 1 to 3).
So the reference is the image of a camera in the projector's place whose principal point is moved by f B / Z0, and a
point follows as in stereo, exactly. Depths follow from geometry alone; the device's own stored reference, its
registration to a colour camera and its lookup of depths are not modelled.

The reference has no noise and no shadow, and is as sharp as pattern and ``blur_px`` make it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decode.image_context import ImageContext
from mitsim.decode.matching.stereo import Raw, StereoGeometry, decode_stereo, stereo_geometry
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.pattern import DotPattern, dot_frames
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.transforms import Transform

#: places across a pixel at which the reference is looked up, each way
_PLACES = 3

#: what the reference spans of full scale: it must not read as saturated
_REFERENCE_LEVEL = 0.9


@dataclass(frozen=True)
class ReferenceGeometry:
    """A camera and its reference image, computed once.

    ``pair``: the rectified camera and, in the place of a right camera, the reference; ``reference`` (H, W) 0..1 on the
    rectified grid.
    """

    pair: StereoGeometry
    reference: NDArray[np.float32]

    @property
    def grid(self) -> ViewGrid:
        """Grid of the cloud: the rectified camera's."""
        return self.pair.grid

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Pixels of the grid that the camera has."""
        return self.pair.seen

    @property
    def baseline(self) -> NDArray[np.float64]:
        """Unit vector from camera to projector in the sensor frame, (3,)."""
        return self.pair.baseline


def reference_geometry(rig: Rig, pattern: DotPattern, reference_mm: float, blur_px: float = 0.5) -> ReferenceGeometry:
    """Rectify the camera of a rig toward its projector, and draw its reference image.

    Parameters
    ----------
    reference_mm
        Depth Z0 of the reference plane, along the axis of the rectified camera.
    blur_px
        Standard deviation of the blur of the camera's lens; the default is assumed.

    Raises
    ------
    InputError
        If the rig has no projector, the projector does not stand to the right of the camera, or it lights nothing of
        the reference plane that the camera sees.
    """
    if rig.projector is None:
        raise InputError("rig", "projector", "none", "a calibrated projector, for one camera and a reference")
    camera, projector = rig.reference, rig.projector
    baseline = projector.centre - camera.centre
    length = float(np.linalg.norm(baseline))
    if length == 0 or (camera.sensor_from_camera.inverse().directions(baseline))[0] < 0.9 * length:
        raise InputError(
            "rig",
            "projector",
            f"at {np.round(baseline, 1).tolist()} mm from the camera",
            "a place to the right (+x) of the camera",
        )
    turn = _along(baseline / length, camera.sensor_from_camera.rotation)
    f = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    K = np.array([[f, 0.0, camera.matrix[0, 2]], [0.0, f, camera.matrix[1, 2]], [0.0, 0.0, 1.0]])
    moved = K.copy()
    moved[0, 2] += f * length / reference_mm
    rotation_left = turn.T @ camera.sensor_from_camera.rotation
    stand_in = Camera(moved, np.zeros(5), camera.width, camera.height, Transform(turn, projector.centre))
    rectification = Rectification(K, moved, rotation_left, np.eye(3), length, camera.width, camera.height)
    both = {"camera": camera, "reference": stand_in}
    pair = replace(stereo_geometry(Rig(both, rectification=rectification)), baseline=baseline / length)

    def lit_at(right: float, down: float) -> NDArray[np.float64]:
        """Column and row (2, n) of the projector that lights each pixel's part of the plane, NaN if none."""
        column, row = np.meshgrid(np.arange(camera.width) + right, np.arange(camera.height) + down)
        rays = np.stack([(column - K[0, 2]) / f, (row - K[1, 2]) / f, np.ones_like(column)], axis=-1).reshape(-1, 3)
        return np.asarray(projector.project(camera.centre + reference_mm * rays @ turn.T).T)

    field = dot_frames(pattern, projector.width, projector.height)[0]
    offsets = (np.arange(_PLACES) - (_PLACES - 1) / 2) / _PLACES
    image = np.zeros(camera.height * camera.width)
    for right, down in itertools.product(offsets, offsets):
        u, v = np.nan_to_num(lit_at(right, down), nan=-9.0)  # beside the field: dark
        image += map_coordinates(field, [v, u], order=1, mode="constant") / _PLACES**2
    spread = point_spread(blur_px)
    reference = cv2.sepFilter2D(
        image.reshape(camera.height, camera.width), -1, spread, spread, borderType=cv2.BORDER_REFLECT
    )
    u, v = lit_at(0.0, 0.0)
    within = (u >= 0) & (u <= projector.width - 1) & (v >= 0) & (v <= projector.height - 1)
    seen = pair.seen_right & within.reshape(reference.shape)
    if not seen.any():
        raise InputError(
            "rig", "projector", f"nothing lit at {reference_mm:g} mm", "a projector that lights what the camera sees"
        )
    return ReferenceGeometry(replace(pair, seen_right=seen), reference.astype(np.float32))


def decode_reference(
    images: Raw, geometry: ReferenceGeometry, settings: MatcherSettings, context: ImageContext
) -> PointCloud:
    """Decode one raw image.

    Parameters
    ----------
    images
        (H, W) or (1, H, W) raw image [DN], uint8 or uint16, of the camera.
    geometry
        By :func:`reference_geometry`, of the same rig and pattern.
    settings, context
        As for :func:`mitsim.decode.matching.stereo.decode_stereo`, of the one camera.

    Returns
    -------
    PointCloud
        On the rectified grid of the camera, points in the sensor frame [mm]. A pixel that no pixel of the reference
        claims is ``SHADOWED``: the projector does not reach it.

    Raises
    ------
    InputError
        If the image is not what the calibration says, or the region of interest does not lie in the grid.
    """
    stored = np.rint(geometry.reference * (_REFERENCE_LEVEL * context.full_scale)).astype(images.dtype)
    alone = replace(context, read_out=(context.read_out[0], None))
    cloud = decode_stereo(images, stored, geometry.pair, settings, alone, noisy_right=False)
    cloud.status[cloud.status == Status.HIDDEN] = Status.SHADOWED
    return cloud


def _along(direction: NDArray[np.float64], camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3), rectified to sensor frame: x along a direction, z as near to a camera's axis as that allows."""
    z = camera[:, 2] - (camera[:, 2] @ direction) * direction
    z /= np.linalg.norm(z)
    return np.stack([direction, np.cross(z, direction), z], axis=1)
