"""Decode one camera and a projected pattern by a stored reference image, as PrimeSense's sensors do.

Signal chain, once: pattern that the projector sends -> its image on a plane at a known depth, across the camera's axis
-> reference image.

Signal chain, for each image: raw image -> rectified so that camera and projector lie along the rows -> matched along
the rows to the reference -> disparity d relative to the reference -> depth -> points.

A plane across the axis of the rectified camera shifts along a row by d = f B (1 / Z - 1 / Z0). B is the baseline from
camera to projector, and Z0 the depth of the reference plane (Khoshelham and Elberink, Sensors 12(2), 2012, eq. 1 to 3).
The reference is therefore the image of a camera at the projector, whose principal point is shifted by f B / Z0. A point
follows exactly as in stereo.

Each device stores the image of its own mask. Where the pattern is sampled follows from the rig alone, so that the
reference of another device's mask costs one interpolation (:meth:`ReferenceGeometry.showing`).

Depths follow from geometry alone. A device's own stored reference, its registration to a colour camera and its table of
depths are not modelled. The reference has no noise and no shadow. Its sharpness is that of the pattern and ``blur_px``.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.stereo import Raw, decode_stereo
from mitsim.decoding.matching.stereo_geometry import StereoGeometry, stereo_geometry
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.pattern import DotPattern, dot_frames
from mitsim.sensor.point_spread import point_spread
from mitsim.sensor.projector_images import ImagesDescription, ProjectorImages, described
from mitsim.sensor.transforms import Transform

#: a pattern of dots, or the image of one unit's mask
Mask = DotPattern | ProjectorImages

#: number of samples of the reference along each side of a pixel
_SAMPLES_PER_SIDE = 3

#: largest level of the reference, as a share of full scale; it must not count as saturated
_REFERENCE_LEVEL = 0.9


@dataclass(frozen=True)
class ReferenceGeometry:
    """A camera and its reference image, computed once.

    - ``pair``: the rectified camera, and the reference in place of the right camera.
    - ``reference``: (H, W) 0..1 on the rectified grid.
    - ``pattern``: the mask of dots in the reference.
    - ``samples``: (n, 2, H * W) projector rows and columns [px] that are averaged in each pixel of the reference.
    - ``projector_size``: width and height of the projector [px].
    - ``blur_px``: standard deviation of the blur of the reference by the camera's lens [px].
    """

    pair: StereoGeometry
    reference: NDArray[np.float32]
    pattern: Mask
    samples: NDArray[np.float32]
    projector_size: tuple[int, int]
    blur_px: float

    @property
    def grid(self) -> ViewGrid:
        """Pixels of the cloud: those of the rectified camera."""
        return self.pair.grid

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W) whether the camera has the pixel of the grid."""
        return self.pair.seen

    @property
    def baseline(self) -> NDArray[np.float64]:
        """(3,) unit vector from camera to projector in the sensor frame."""
        return self.pair.baseline

    def showing(self, pattern: DotPattern | ImagesDescription) -> ReferenceGeometry:
        """Return the geometry for another mask of dots: that of another device of the same type.

        Raises
        ------
        InputError
            If the mask is an image of which only the description is known.
        """
        if pattern == described(self.pattern):
            return self
        if isinstance(pattern, ImagesDescription):
            raise unknown_mask()
        image = _reference_image(pattern, self.projector_size, self.samples, self.reference.shape, self.blur_px)
        return replace(self, reference=image, pattern=pattern)


def reference_geometry(rig: Rig, pattern: Mask, reference_mm: float, blur_px: float = 0.5) -> ReferenceGeometry:
    """Rectify the camera of a rig toward its projector, and compute its reference image.

    Parameters
    ----------
    rig, pattern
        The rig with its projector, and the mask of dots: a pattern, or an image of the user's own.
    reference_mm
        Depth Z0 of the reference plane along the axis of the rectified camera [mm].
    blur_px
        Standard deviation of the blur by the camera's lens [px]; the default is assumed.

    Raises
    ------
    InputError
        If the rig has no projector, it is not to the right of the camera, or it lights nothing that the camera sees of
        the reference plane.

    See Also
    --------
    decode_reference : decodes with it
    """
    if rig.projector is None:
        raise InputError("rig", "projector", "none", "a calibrated projector, for one camera and a reference")
    camera, projector = rig.reference, rig.projector
    baseline = projector.centre - camera.centre
    baseline_mm = float(np.linalg.norm(baseline))
    if baseline_mm == 0 or (camera.sensor_from_camera.inverse().directions(baseline))[0] < 0.9 * baseline_mm:
        raise InputError(
            "rig",
            "projector",
            f"at {np.round(baseline, 1).tolist()} mm from the camera",
            "a position to the right (+x) of the camera",
        )
    rotation = rectifying_rotation(baseline / baseline_mm, camera.sensor_from_camera.rotation)
    f = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    matrix = np.array([[f, 0.0, camera.matrix[0, 2]], [0.0, f, camera.matrix[1, 2]], [0.0, 0.0, 1.0]])
    reference_matrix = matrix.copy()
    reference_matrix[0, 2] += f * baseline_mm / reference_mm
    rotation_left = rotation.T @ camera.sensor_from_camera.rotation
    virtual_camera = Camera(
        reference_matrix, np.zeros(5), camera.width, camera.height, Transform(rotation, projector.centre)
    )
    rectification = Rectification(
        matrix, reference_matrix, rotation_left, np.eye(3), baseline_mm, camera.width, camera.height
    )
    cameras = {"camera": camera, "reference": virtual_camera}
    pair = replace(stereo_geometry(Rig(cameras, rectification=rectification)), baseline=baseline / baseline_mm)

    def projector_position(right: float, down: float) -> NDArray[np.float64]:
        """Return the column and row (2, n) in the projector of each pixel's part of the plane; NaN if unlit."""
        column, row = np.meshgrid(np.arange(camera.width) + right, np.arange(camera.height) + down)
        rays = np.stack([(column - matrix[0, 2]) / f, (row - matrix[1, 2]) / f, np.ones_like(column)], axis=-1).reshape(
            -1, 3
        )
        return np.asarray(projector.project(camera.centre + reference_mm * rays @ rotation.T).T)

    offsets = (np.arange(_SAMPLES_PER_SIDE) - (_SAMPLES_PER_SIDE - 1) / 2) / _SAMPLES_PER_SIDE
    samples = np.stack(
        [
            np.nan_to_num(projector_position(right, down), nan=-9.0)[::-1]  # outside the field: dark
            for right, down in itertools.product(offsets, offsets)
        ]
    ).astype(np.float32)
    size, shape = (projector.width, projector.height), (camera.height, camera.width)
    u, v = projector_position(0.0, 0.0)
    lit = (u >= 0) & (u <= projector.width - 1) & (v >= 0) & (v <= projector.height - 1)
    seen = pair.seen_right & lit.reshape(shape)
    if not seen.any():
        raise InputError(
            "rig", "projector", f"nothing lit at {reference_mm:g} mm", "a projector that lights what the camera sees"
        )
    reference = _reference_image(pattern, size, samples, shape, blur_px)
    return ReferenceGeometry(replace(pair, seen_right=seen), reference, pattern, samples, size, blur_px)


def unknown_mask() -> InputError:
    """Return the error that the image of a mask is in the sensor file, not in the capture."""
    return InputError(
        "capture",
        "pattern",
        "an image of the user's own",
        "the mask itself",
        "name the sensor file that has it: --sensor",
    )


def _reference_image(
    pattern: Mask,
    size: tuple[int, int],
    samples: NDArray[np.float32],
    shape: tuple[int, ...],
    blur_px: float,
) -> NDArray[np.float32]:
    """Return the image (H, W) of a pattern at the samples (n, 2, H * W) of each pixel, blurred by the lens."""
    field = pattern.patterns()[0] if isinstance(pattern, ProjectorImages) else dot_frames(pattern, *size)[0]
    image = np.mean([map_coordinates(field, coordinates, order=1, mode="constant") for coordinates in samples], axis=0)
    kernel = point_spread(blur_px)
    blurred = cv2.sepFilter2D(
        image.reshape(shape).astype(np.float64), -1, kernel, kernel, borderType=cv2.BORDER_REFLECT
    )
    return np.asarray(blurred, np.float32)


def decode_reference(
    images: Raw, geometry: ReferenceGeometry, settings: MatcherSettings, context: ImageContext
) -> PointCloud:
    """Decode one raw image.

    Parameters
    ----------
    images
        (H, W) or (1, H, W) raw image [DN] of the camera, uint8 or uint16.
    geometry
        From :func:`reference_geometry`, for the same rig and the mask of the device that took the image.
    settings, context
        As for :func:`mitsim.decoding.matching.stereo.decode_stereo`, for the one camera.

    Returns
    -------
    PointCloud
        On the rectified grid of the camera, points in the sensor frame [mm]. A pixel that matches no pixel of the
        reference is ``SHADOWED``: the projector does not reach it.

    Raises
    ------
    InputError
        If the image does not fit the calibration, or the region of interest does not lie in the grid.

    See Also
    --------
    mitsim.decoding.matching.stereo.decode_stereo : two cameras
    """
    reference_image = np.rint(geometry.reference * (_REFERENCE_LEVEL * context.full_scale)).astype(images.dtype)
    camera_context = replace(context, read_out=(context.read_out[0], None))
    cloud = decode_stereo(images, reference_image, geometry.pair, settings, camera_context, noisy_right=False)
    cloud.status[cloud.status == Status.HIDDEN] = Status.SHADOWED
    return cloud


def rectifying_rotation(direction: NDArray[np.float64], camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from rectified to sensor frame: x along a direction, z close to a camera's axis."""
    z = camera[:, 2] - (camera[:, 2] @ direction) * direction
    z /= np.linalg.norm(z)
    return np.stack([direction, np.cross(z, direction), z], axis=1)
