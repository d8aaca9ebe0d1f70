"""Where the flat specimen of a capture lies, how it is bent, and which pixels show it.

Signal chain: capture -> cloud, by its own decoder -> plane of the points in the region of the image that the user
named, else of most points (:mod:`mitsim.fit.place`) -> its extent, and the bend of its points
(:mod:`mitsim.fit.bend`) -> which pixels and view rays meet it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import FitError
from mitsim.capture.capture import Capture
from mitsim.errors import InputError
from mitsim.fit.bend import Bend, fit_bend
from mitsim.fit.place import Place, found_place, known_place, plane_points
from mitsim.reconstruction.cloud import Settings, capture_cloud, capture_geometry
from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi, roi_around
from mitsim.sensor.transforms import Transform

Floats = NDArray[np.float64]

#: pixels inside the specimen's outline that are not looked at: its edge is blurred, and matched with what is behind
MARGIN_PX = 15.0

#: least points of a plane in the user's region, and most points that it is fitted to
_FEWEST_POINTS, _PLANE_POINTS = 500, 20000

#: cosine to the normal from which on a ray meets the plane
GRAZING = 1e-6

#: cells of the specimen's raster along its longer side
_CELLS = 120

#: points count for the bend that lie off the plane by up to this share of its distance
_NEAR_PLANE = 0.02


def specimen_place(capture: Capture, settings: Settings, roi: Roi | None, where: str) -> Place:
    """Estimate the plane and the outline of the specimen from the capture's decoded cloud.

    ``roi`` of the reference image: all of it is specimen, also where it has no points, and the plane is fitted to its
    points (:func:`characterisation.features.fits.fit_plane`). Without a region, the plane is that of most points of the
    cloud, and the outline is where points are dense (:func:`mitsim.fit.place.found_place`).

    Raises
    ------
    InputError
        If the region is not in the image, or too few points lie in one plane.
    """
    if not capture.images:
        raise InputError(where, "images", "none", "a capture with images, not a device's map alone")
    if roi is None:
        cloud = capture_cloud(capture, settings)
        flat = found_place(cloud, where)
        return replace(flat, bend=_bend_of(flat, cloud.points[cloud.valid].astype(float)))
    camera, geometry = capture.rig.reference, capture_geometry(capture, settings)
    asked = [roi.left, roi.top, roi.width, roi.height]
    if not roi.fits(camera.width, camera.height):
        allowed = f"COLUMN ROW WIDTH HEIGHT within {camera.width} x {camera.height} pixels"
        raise InputError("--window", "", asked, allowed)
    grid = geometry.grid
    low, high = np.array([roi.left, roi.top]), np.array([roi.right, roi.bottom])

    def shown(points: Floats) -> NDArray[np.bool_]:
        pixels = camera.project(points)
        return np.asarray(((pixels >= low) & (pixels < high)).all(axis=-1))

    inside = shown(grid.origin + 1000.0 * grid.rays())
    cloud = capture_cloud(capture, settings, geometry, roi=Roi.around(inside))
    found = cloud.points[inside & cloud.valid].astype(float)
    # a decoder's stray points lie far off, along the rays: a fit that begins with them would be drawn onto the rays
    points = found[plane_points(found)]
    if len(points) < _FEWEST_POINTS:
        told = f"{len(found)} points in {asked}" + (f", {len(points)} of them in one plane" if len(found) else "")
        raise InputError("--window", "", told, f"{_FEWEST_POINTS} or more, to find its plane")
    try:
        plane = fit_plane(points[:: -(-len(points) // _PLANE_POINTS)], camera.centre)
    except FitError as error:
        hint = "name a part that shows a flat specimen, seen less obliquely"
        raise InputError("--window", "", f"{asked}, where {error}", "a plane", hint) from None
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
    place = Place(pose, first, cell, occupied, float(1.482602218505602 * np.median(np.abs(off))))
    return replace(place, bend=_bend_of(place, points))


def place_of(capture: Capture, sensor: Sensor, size: tuple[float, float], where: str, roi: Roi | None = None) -> Place:
    """Place of the coupon: by the region of the image that shows it, else by the pose of the capture, else by the plane
    of its cloud.

    Raises
    ------
    InputError
        If neither is there, or the coupon shows its back.
    """
    if roi is not None:
        return specimen_place(capture, sensor.settings, roi, where)
    if capture.world_from_sensor is None:
        imager = sensor.imager if sensor.imager.bits == capture.bits else None
        return found_place(capture_cloud(capture, sensor.settings, imager=imager), where)
    place = known_place(capture.world_from_sensor, *size)
    if place.world_from_sensor.translation[2] <= 0:
        raise InputError(where, "world_from_sensor", "a sensor behind the coupon", "a place with z over 0")
    return place


def _bend_of(place: Place, points: Floats) -> Bend | None:
    """Bend of the points (n, 3) of the sensor frame that lie on a place's cells."""
    local = place.world_from_sensor.points(points)
    near = np.abs(local[:, 2]) < _NEAR_PLANE * np.linalg.norm(place.world_from_sensor.translation)
    inside = np.zeros(len(local), bool)
    inside[near] = place.holds(local[near, :2], np.zeros(int(near.sum())))
    return fit_bend(local[inside]) if inside.sum() >= _FEWEST_POINTS else None


def on_specimen(place: Place, origin: Floats, rays: Floats, pitch: float, margin_px: float) -> NDArray[np.bool_]:
    """Which view rays (..., 3), unit and in the sensor frame, meet the specimen, a margin [px] inside its outline.

    ``origin`` (3,) of the rays [mm]; ``pitch`` between neighbouring ones [rad].
    """
    points, reach, cosine = feet_of(place.world_from_sensor, origin, rays)
    down = cosine > GRAZING
    inside = np.zeros(rays.shape[:-1], bool)
    margin = margin_px * pitch * reach[down] / cosine[down]
    inside[down] = place.holds(points[down], margin)
    return inside


def feet_of(pose: Transform, origin: Floats, rays: Floats) -> tuple[Floats, Floats, Floats]:
    """Where rays meet the plane z = 0 of a frame (..., 2) [mm], how far along them [mm], cosine to its normal.

    ``pose`` takes the sensor frame, that of ``origin`` (3,) and ``rays`` (..., 3), to that of the plane. NaN for rays
    that miss it.
    """
    start, directions = pose.points(origin), pose.directions(rays)
    cosine = -directions[..., 2]
    reach = start[2] / np.where(cosine > GRAZING, cosine, np.nan)
    return start[:2] + reach[..., None] * directions[..., :2], reach, cosine


def image_mask(place: Place, camera: Camera, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Which pixels (H, W) of a camera's raw image show the specimen."""
    mask = np.zeros((camera.height, camera.width), bool)
    roi = roi_around(camera, place.corners(), 1) or Roi.whole(camera.width, camera.height)
    columns, rows = roi.pixels()
    rays = camera.sensor_from_camera.directions(camera.rays(np.stack([columns, rows], axis=-1).astype(float)))
    pitch = 1.0 / float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    mask[rows, columns] = on_specimen(place, camera.centre, rays, pitch, margin_px)
    return mask
