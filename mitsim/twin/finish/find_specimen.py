"""Find plane, outline and bend of the flat specimen in a capture, and the pixels that show it.

Signal chain: capture -> cloud, from its own decoder -> plane of the points in the image region that the user gave, or
of most points (:mod:`mitsim.twin.finish.specimen`) -> its outline, and the bend of its points
(:mod:`mitsim.twin.finish.specimen`) -> pixels and view rays that meet it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError, scatter_of
from characterisation.features.starts import rounding_scale, rounding_step
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import Settings, capture_cloud, capture_geometry
from mitsim.sensor.camera import Camera
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.sensor.working_volume import roi_around
from mitsim.twin.finish.specimen import Bend, Specimen, fit_bend, known_specimen, plane_points, specimen_in_cloud

#: margin inside the specimen's outline that is not used [px]: its edge is blurred, and matched with the background;
#: chosen
MARGIN_PX = 15.0

#: least number of points of a plane in the user's region; chosen
_FEWEST_POINTS = 500

#: about the largest number of points for its fit, which bounds the time; chosen
_PLANE_POINTS = 20000

#: least cosine between a ray and the normal with which the ray meets the plane
GRAZING = 1e-6

#: number of cells along the longer side of the specimen
_CELLS = 120

#: largest distance from the plane of points that are used for the bend, as a share of the sensor's distance
_NEAR_PLANE = 0.02


def find_specimen(capture: Capture, settings: Settings, roi: Roi | None, where: str) -> Specimen:
    """Estimate the plane and the outline of the specimen from the capture's decoded cloud; messages name ``where``.

    ``roi`` is a region of the reference image [px] that shows only the specimen, also where it has no points. The plane
    is fitted to its points, and ``off_plane`` of the result is their robust standard deviation. Without a region,
    :func:`specimen_in_cloud` takes the plane of most points, and ``off_plane`` is their rms distance.

    Raises InputError if the capture has no images, the region is not in the image, or too few points lie in one plane.
    """
    if not capture.images:
        raise InputError(where, "images", "none", "a capture with images, not only a map of the device")
    if roi is None:
        cloud = capture_cloud(capture, settings, imager=capture.decoding.imager)
        flat = specimen_in_cloud(cloud, where)
        return replace(flat, bend=_bend_of(flat, cloud.points[cloud.valid].astype(float)))
    camera, geometry = capture.rig.reference, capture_geometry(capture, settings)
    grid, window = geometry.grid, [roi.left, roi.top, roi.width, roi.height]
    if not roi.fits(camera.width, camera.height):
        allowed = f"COLUMN ROW WIDTH HEIGHT within {camera.width} x {camera.height} pixels"
        raise InputError("--window", "", window, allowed)
    low, high = np.array([roi.left, roi.top]), np.array([roi.right, roi.bottom])

    def shown(points: Floats) -> NDArray[np.bool_]:
        pixels = camera.project(points)
        return np.asarray(((pixels >= low) & (pixels < high)).all(axis=-1))

    inside = shown(grid.origin + 1000.0 * grid.rays())
    cloud = capture_cloud(capture, settings, geometry, Roi.around(inside), capture.decoding.imager)
    candidates = cloud.points[inside & cloud.valid].astype(float)
    # outliers of a decoder lie far away along the rays, and a fit that starts with them would follow the rays
    points = candidates[plane_points(candidates)]
    if len(points) < _FEWEST_POINTS:
        coplanar = f", {len(points)} of them in one plane" if len(candidates) else ""
        number = f"{len(candidates)} points in {window}{coplanar}"
        raise InputError("--window", "", number, f"{_FEWEST_POINTS} or more, to find its plane")
    try:
        plane = fit_plane(points[:: -(-len(points) // _PLANE_POINTS)], camera.centre)
    except FitError as error:
        hint = "give a region that shows a flat specimen, from a less oblique view"
        raise InputError("--window", "", f"{window}, where {error}", "a plane", hint) from None
    off = (points - plane.point) @ plane.normal
    across = np.array([1.0, 0.0, 0.0]) - plane.normal[0] * plane.normal
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(plane.normal, across), plane.normal], axis=1)
    pose = Transform(axes, plane.point).inverse()
    ring = np.linspace(0.0, 1.0, 33)[:, None]
    corners = np.array([low, [high[0] - 1, low[1]], high - 1, [low[0], high[1] - 1]], float)
    rim = np.concatenate(
        [(1 - ring) * a + ring * b for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    feet, _, cosine = feet_of(pose, camera.centre, camera.sensor_from_camera.directions(camera.rays(rim)))
    feet = feet[cosine > GRAZING]
    first, extent = feet.min(axis=0), np.ptp(feet, axis=0)
    cell = np.full(2, extent.max() / _CELLS)
    columns, rows = np.ceil(extent / cell).astype(int)
    xs, ys = np.meshgrid(first[0] + (np.arange(columns) + 0.5) * cell[0], first[1] + (np.arange(rows) + 0.5) * cell[1])
    occupied = shown(pose.inverse().points(np.stack([xs, ys, np.zeros_like(xs)], axis=-1)))
    specimen = Specimen(pose, first, cell, occupied, scatter_of(off, rounding_scale(points, plane)))
    return replace(specimen, bend=_bend_of(specimen, points))


def find_coupon(
    capture: Capture, sensor: Sensor, size: tuple[float, float], where: str, roi: Roi | None = None
) -> Specimen:
    """Return the coupon of a ``size`` (width, height) [mm] in a capture, in messages ``where``.

    It follows from the points in ``roi``, else from the capture's pose, else from the plane of its cloud by the decoder
    of the sensor. Raises InputError if no plane is found, or the sensor is behind the coupon.
    """
    if roi is not None:
        return find_specimen(capture, sensor.settings, roi, where)
    if capture.world_from_sensor is None:
        imager = sensor.imager if sensor.imager.bits == capture.bits else None
        return specimen_in_cloud(capture_cloud(capture, sensor.settings, imager=imager), where)
    specimen = known_specimen(capture.world_from_sensor, *size)
    if specimen.world_from_sensor.translation[2] <= 0:
        raise InputError(where, "world_from_sensor", "a sensor behind the coupon", "a sensor position with z over 0")
    return specimen


def _bend_of(specimen: Specimen, points: Floats) -> Bend | None:
    """Return the bend of the points (n, 3) [mm], in the sensor frame, on a specimen's cells; None for too few."""
    local = specimen.world_from_sensor.points(points)
    near = np.abs(local[:, 2]) < _NEAR_PLANE * specimen.distance
    inside = np.zeros(len(local), bool)
    inside[near] = specimen.contains(local[near, :2], np.zeros(int(near.sum())))
    step = rounding_step(points[inside], specimen.world_from_sensor.rotation[2])
    return fit_bend(local[inside], step) if inside.sum() >= _FEWEST_POINTS else None


def on_specimen(specimen: Specimen, origin: Floats, rays: Floats, pitch: float, margin_px: float) -> NDArray[np.bool_]:
    """Return which view rays (..., 3), sensor frame, meet the specimen at least a margin inside its outline.

    ``pitch`` [rad] is the angle of neighbouring rays, ``origin`` (3,) [mm] the origin of all.
    """
    points, reach, cosine = feet_of(specimen.world_from_sensor, origin, rays)
    down = cosine > GRAZING
    inside = np.zeros(rays.shape[:-1], bool)
    margin = margin_px * pitch * reach[down] / cosine[down]
    inside[down] = specimen.contains(points[down], margin)
    return inside


def feet_of(pose: Transform, origin: Floats, rays: Floats) -> tuple[Floats, Floats, Floats]:
    """Return where rays (..., 3) from an origin (3,) [mm] meet the plane z = 0 of the frame to which ``pose`` leads.

    The results are x and y (..., 2) [mm] in the frame of the plane, the distance along the ray [mm], both NaN for rays
    that miss the plane, and the cosine to the normal.
    """
    start, directions = pose.points(origin), pose.directions(rays)
    cosine = -directions[..., 2]
    reach = start[2] / np.where(cosine > GRAZING, cosine, np.nan)
    return start[:2] + reach[..., None] * directions[..., :2], reach, cosine


def image_mask(specimen: Specimen, camera: Camera, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Return which pixels (H, W) of a camera's raw image show the specimen, a margin [px] inside its outline."""
    mask = np.zeros((camera.height, camera.width), bool)
    roi = roi_around(camera, specimen.corners(), 1) or Roi.whole(camera.width, camera.height)
    columns, rows = roi.pixels()
    rays = camera.sensor_from_camera.directions(camera.rays(np.stack([columns, rows], axis=-1).astype(float)))
    pitch = 1.0 / float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    mask[rows, columns] = on_specimen(specimen, camera.centre, rays, pitch, margin_px)
    return mask
