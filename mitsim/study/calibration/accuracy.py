"""Measure the accuracy that a calibration leaves: ball-bar lengths and flatness of plates with randomly drawn rigs.

Signal chain: points of an artefact -> pixels of the true rig, drawn from the covariance -> points that the decoder
makes of them with the nominal rig -> sphere-spacing error SD and flatness of VDI/VDE 2634-2
(:mod:`characterisation.acceptance.vdi_2634`). Points are ideal: no noise, no rendering, and a ball is its centre. The
result is the trueness of the sensor, which averaging over points does not improve.

The decoders' geometry is followed exactly:

- A pair of cameras: rectified by the nominal rig, disparity to depth on the left rows, row differences discarded.
- One camera and a stored image: the same with the nominal projector's rays.
- One camera and a code: the depth on the camera's ray at which the nominal projector has the code's coordinate. That is
  :mod:`mitsim.decoding.structured_light.geometry` without its polynomial.
- Time of flight: distance along the ray.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from characterisation.acceptance.vdi_2634 import flatness_error
from characterisation.files.arrays import Floats
from mitsim.decoding.structured_light.geometry import MINIMUM_CHANGE_PX, axis_across
from mitsim.sensor.camera import Camera, Rig, stereo_rectification
from mitsim.sensor.light_code import LightCode, axes
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import moved, path_error
from mitsim.sensor.sensor import Sensor
from mitsim.study.calibration.board import seen_by_all

#: half the depth of the measuring volume, relative to the middle of the working range
_HALF_DEPTH = 0.15
#: ends of ball bars in a cuboid of -1 to 1: the four space diagonals and three transverse bars, the seven positions of
#: VDI/VDE 2634-2
_BARS = 0.8 * np.array(
    [
        [[-1, -1, -1], [1, 1, 1]],
        [[1, -1, -1], [-1, 1, 1]],
        [[-1, 1, -1], [1, -1, 1]],
        [[1, 1, -1], [-1, -1, 1]],
        [[-1, 0, -1], [1, 0, -1]],
        [[-1, 0, 1], [1, 0, 1]],
        [[0, -1, 0], [0, 1, 0]],
    ]
)
#: heights of plates at the ends x = -1 and 1 of the cuboid: transverse at three depths, and inclined both ways
_PLATES = ((-0.8, -0.8), (0.0, 0.0), (0.8, 0.8), (-0.8, 0.8), (0.8, -0.8))
_PLATE_POINTS = 11
_SIDES = (-1.0, -0.5, 0.0, 0.5, 1.0)


@dataclass(frozen=True)
class MeasuringVolume:
    """A cuboid in the sensor frame in view of all eyes: ``middle`` (3,) and ``half`` its half sides (3,) [mm]."""

    middle: Floats
    half: Floats

    @property
    def diagonal(self) -> float:
        """Return the length of its body diagonal [mm]."""
        return float(2 * np.linalg.norm(self.half))

    def points(self, positions: Floats) -> Floats:
        """Return points (..., 3) in the sensor frame of positions (..., 3) from -1 to 1 along each side."""
        return np.asarray(self.middle + positions * self.half)


@dataclass(frozen=True)
class Accuracy:
    """Errors of drawn rigs in a measuring volume.

    - ``bars`` (draws, 7): sphere-spacing errors, measured minus true [mm]; ``lengths`` (7,) of the bars [mm].
    - ``flatness`` (draws, 5): flatness errors of the plates [mm].
    - ``depth`` (draws,): error of the distance to the volume's centre [mm].
    """

    volume: MeasuringVolume
    bars: Floats
    lengths: Floats
    flatness: Floats
    depth: Floats

    def numbers(self) -> dict[str, float]:
        """Return the figures of a table: one sigma over draws and bars, and the 95 % quantile of the rigs [mm]."""
        return {
            "sphere_spacing_sigma_mm": float(np.sqrt((self.bars**2).mean())),
            "sphere_spacing_relative": float(np.sqrt(((self.bars / self.lengths) ** 2).mean())),
            "sphere_spacing_95_mm": float(np.quantile(np.abs(self.bars).max(axis=1), 0.95)),
            "flatness_median_mm": float(np.median(self.flatness.max(axis=1))),
            "flatness_95_mm": float(np.quantile(self.flatness.max(axis=1), 0.95)),
            "depth_sigma_mm": float(np.sqrt((self.depth**2).mean())),
            "middle_mm": float(np.linalg.norm(self.volume.middle)),
            "diagonal_mm": self.volume.diagonal,
        }


def measuring_volume(eyes: Mapping[str, Camera], working_range_mm: tuple[float, float]) -> MeasuringVolume:
    """Return the largest cuboid in view of all eyes about the middle of the range, with the image's aspect ratio.

    It extends 15 % nearer and farther than the geometric mean of the working range, within that range.
    """
    near, far = working_range_mm
    middle = float(np.sqrt(near * far))
    first, last = max(near, middle * (1 - _HALF_DEPTH)), min(far, middle * (1 + _HALF_DEPTH))
    reference = next(iter(eyes.values()))
    shape = np.array([reference.width / reference.matrix[0, 0], reference.height / reference.matrix[1, 1]])
    # check sides and corners: barrel distortion narrows the view at the middle of the sides
    places_on_faces = np.array([[x, y, z] for x in _SIDES for y in _SIDES for z in (-1, 1)], float)
    # transverse centre of each eye's view at the middle distance
    centres = []
    for eye in eyes.values():
        ray = eye.sensor_from_camera.directions(eye.rays(np.array([eye.width - 1, eye.height - 1]) / 2))
        centres.append(eye.centre + ray * (middle - eye.centre[2]) / ray[2])
    centre = np.array([*np.mean(centres, axis=0)[:2], (first + last) / 2])
    low, high = 0.0, middle
    for _ in range(30):
        size = (low + high) / 2
        half = np.array([*(size * shape), (last - first) / 2])
        low, high = (size, high) if seen_by_all(centre + places_on_faces * half, eyes).all() else (low, size)
    return MeasuringVolume(centre, np.array([*(low * shape), (last - first) / 2]))


def accuracy(
    sensor: Sensor, eyes: Mapping[str, Camera], covariance: RigCovariance, draws: int, rng: np.random.Generator
) -> Accuracy:
    """Return the errors of drawn rigs, measured with the sensor's nominal rig.

    Parameters
    ----------
    sensor
        Its decoder and its nominal rig measure.
    eyes
        All eyes that the decoder uses, the reference camera first.
    covariance
        From which ``draws`` rigs are drawn.
    draws
        Number of rigs.
    rng
        Source of the draws; each has its own stream.

    See Also
    --------
    measured_points : the points of one rig
    """
    volume = measuring_volume(eyes, sensor.working_range_mm)
    bars = volume.points(_BARS)
    across = np.linspace(-0.8, 0.8, _PLATE_POINTS)
    x, y = np.meshgrid(across, across)
    plates = np.stack(
        [
            volume.points(np.stack([x, y, left + (right - left) * (x + 0.8) / 1.6], axis=-1)).reshape(-1, 3)
            for left, right in _PLATES
        ]
    )
    lengths = np.linalg.norm(bars[:, 1] - bars[:, 0], axis=1)
    everything = np.concatenate([bars.reshape(-1, 3), plates.reshape(-1, 3), volume.middle[None]])
    nominal = measured_points(sensor, everything, sensor.rig)
    rows = []
    for stream in rng.spawn(draws):
        values = covariance.draw(stream)
        true = moved(sensor.rig, covariance.names, values)
        # with the nominal rig the chain returns the points up to rounding, which is subtracted
        points = measured_points(sensor, everything, true, path_error(covariance.names, values)) - nominal + everything
        ends = points[: bars.shape[0] * 2].reshape(-1, 2, 3)
        flat = [flatness_error(plate, 0.0) for plate in points[bars.shape[0] * 2 : -1].reshape(plates.shape)]
        deeper = np.linalg.norm(points[-1] - sensor.rig.reference.centre)
        deeper -= np.linalg.norm(volume.middle - sensor.rig.reference.centre)
        rows.append([*(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) - lengths), *flat, deeper])
    table = np.array(rows)
    return Accuracy(volume, table[:, : len(bars)], lengths, table[:, len(bars) : -1], table[:, -1])


def measured_points(sensor: Sensor, points: Floats, true: Rig, path: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Return points (n, 3) as the sensor's decoder places them, with its nominal rig, if ``true`` is the real rig.

    Parameters
    ----------
    sensor
        Its decoder's geometry is followed.
    points
        True points (n, 3) in the sensor frame [mm].
    true
        Rig that projects the points.
    path
        Offset [mm] and scale error [1] of a time-of-flight path.

    See Also
    --------
    accuracy : the errors of many rigs
    """
    nominal, eye = sensor.rig, true.reference
    pixels = eye.project(points)
    ray = nominal.reference.sensor_from_camera.directions(nominal.reference.rays(pixels))
    start = nominal.reference.centre
    if sensor.technology == "time_of_flight":
        distance = np.linalg.norm(points - eye.centre, axis=1)
        return np.asarray(start + ray * (path[0] + (1 + path[1]) * distance)[:, None])
    cameras = list(sensor.measuring_rig.cameras)
    if len(cameras) == 2:
        other, other_nominal = true.cameras[cameras[1]], nominal.cameras[cameras[1]]
        return triangulated(nominal.reference, pixels, other_nominal, other_nominal.rays(other.project(points)))[0]
    assert true.projector is not None and nominal.projector is not None
    if sensor.technology == "reference_stereo":
        seen = true.projector.project(points)
        return triangulated(nominal.reference, pixels, nominal.projector, nominal.projector.rays(seen))[0]
    component = _component(sensor)
    coordinate = true.projector.project(points)[:, component]
    return _by_coordinate(start, ray, nominal.projector, coordinate, component, sensor.working_range_mm)


def triangulated(camera: Camera, pixels: Floats, other: Camera, other_rays: Floats) -> tuple[Floats, Floats]:
    """Return points (n, 3) [mm] that two eyes see, on rectified rows of the first, and row errors (n,) [px].

    Parameters
    ----------
    camera, other
        Eyes, in the sensor frame.
    pixels
        (n, 2) [px] of the points in the first.
    other_rays
        Rays (n, 3) of the points in the frame of the other.
    """
    pair = stereo_rectification(camera, other)
    left = camera.rays(pixels) @ pair.rotation_left.T
    right = other_rays @ pair.rotation_right.T
    left, right = left / left[:, 2:], right / right[:, 2:]
    columns = left[:, 0] * pair.matrix_left[0, 0] + pair.matrix_left[0, 2]
    other_columns = right[:, 0] * pair.matrix_right[0, 0] + pair.matrix_right[0, 2]
    depth = pair.depth(columns - other_columns)
    points = camera.sensor_from_camera.points((left * depth[:, None]) @ pair.rotation_left)
    return points, np.asarray(pair.matrix_left[0, 0] * (right[:, 1] - left[:, 1]))


def _by_coordinate(
    start: Floats, ray: Floats, projector: Camera, wanted: Floats, component: int, range_mm: tuple[float, float]
) -> Floats:
    """Return points on rays at which a projector has a given coordinate, by the secant method in inverse distance."""
    inverse = np.full(len(ray), 2 / sum(range_mm))
    before = inverse * 1.01

    def left(w: Floats) -> Floats:
        return np.asarray(projector.project(start + ray / w[:, None])[:, component] - wanted)

    error_before = left(before)
    for _ in range(30):
        error = left(inverse)
        change = error - error_before
        usable = np.abs(change) > 1e-12
        step = np.where(usable, -error * (inverse - before) / np.where(usable, change, 1.0), 0.0)
        before, error_before, inverse = inverse, error, inverse + step
        if np.abs(error).max() < 1e-9 * MINIMUM_CHANGE_PX:
            break
    return np.asarray(start + ray / inverse[:, None])


def _component(sensor: Sensor) -> int:
    """Return the axis of the projector along which the decoder measures: 0 its columns, 1 its rows."""
    pattern, projector = sensor.pattern, sensor.rig.projector
    assert isinstance(pattern, LightCode) and projector is not None
    return 0 if axis_across(sensor.rig.reference, projector, axes(pattern)) == "columns" else 1
