"""Make light on imagers with stock Mitsuba: its ``path`` integrator, its ``projector`` emitter, its shapes and BSDFs.

Signal chain: camera with distortion -> a bundle of rays through every pixel; projector with distortion, aperture and
loss toward the corners -> ideal pinhole projectors at points of the aperture -> ``path`` integrator -> radiance of
every pattern in every pixel [W / (mm^2 sr)].

Mitsuba's ``projector`` is a pinhole without distortion, whose axis is the middle of its image. Distortion, principal
point, black level and corner loss therefore go into its image, which is resampled at twice the resolution. A lens of
diameter D is seven pinholes of equal variance. From a pinhole beside the axis by a, the image is shifted by
f a / focus, so that all seven images agree in the plane of focus.

A flux Phi of an all-white frame gives the irradiance E_1 = Phi fx fy / (W H) on the plane at unit distance. Mitsuba's
plugin emits pi times its image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.ndimage import gaussian_filter

from characterisation.region_of_interest import Roi
from mitsim.sensor.camera import Camera
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform
from tests.proofs.laboratory.part import LaboratoryPart
from tests.stock_mitsuba import mitsuba_to_world

Images = NDArray[np.float32]

#: points of an aperture of radius 1: the centre and six around it, with the variance of the disc
_RING = np.sqrt(7 / 12) * np.exp(1j * np.pi / 3 * np.arange(6))
APERTURE = [(0.0, 0.0), *((float(z.real), float(z.imag)) for z in _RING)]

#: pixels of the ideal projector's image per pixel of the real one, along each axis
_FINER = 2

#: margin of the ideal projector's image on each side, as a share of its half width
_MARGIN = 0.04

#: surfaces on a light path
SURFACES = 4

#: light paths traced at once
_AT_ONCE = 1 << 22

#: light paths a pixel for the light of the room
_ROOM_PATHS = 16

#: standard deviation of the mean over noisy interreflections [px]
_SMOOTHING_PX = 1.2

#: patterns that are sums of others within this, relative to white, are not rendered
_SUM_ERROR = 1e-6


@dataclass(frozen=True)
class IdealProjector:
    """Pinhole whose axis is the middle of its image, of ``width`` x ``height`` pixels.

    ``across`` and ``down`` are half the extents of its image in the plane at unit distance.
    """

    across: float
    down: float
    width: int
    height: int

    @classmethod
    def around(cls, optics: Camera) -> IdealProjector:
        """Return a pinhole that contains the image of real optics, with a margin for changes of its calibration."""
        edge = np.linspace(-0.5, 0.5, 9)
        frame = [(x, y) for x in edge for y in edge if max(abs(x), abs(y)) == 0.5]
        pixels = (np.array(frame) + 0.5) * [optics.width, optics.height] - 0.5
        across, down = (1 + _MARGIN) * np.abs(tangents(optics, pixels)).max(axis=0)
        width = int(np.ceil(2 * across * optics.matrix[0, 0] * _FINER))
        height = int(np.ceil(width * down / across))
        return cls(float(across), float(across * height / width), width, height)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Return its matrix K (3, 3) [px]."""
        focal = self.width / (2 * self.across)
        return np.array([[focal, 0, (self.width - 1) / 2], [0, focal, (self.height - 1) / 2], [0, 0, 1]])

    def description(self) -> dict[str, Any]:
        """Return the Mitsuba emitter, still dark."""
        import mitsuba as mi

        dark = mi.TensorXf(np.zeros((self.height, self.width, 1), np.float32))
        image = {"type": "bitmap", "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp", "data": dark}
        return {
            "type": "projector",
            "fov": float(np.degrees(2 * np.arctan(self.across))),
            "fov_axis": "x",
            "irradiance": image,
        }

    def image(self, emitted: Images, optics: Camera, offset: NDArray[np.float64]) -> Images:
        """Return the image of this pinhole for light (H, W) of real optics.

        ``offset`` (2,) is that of its place from the axis, over the distance of the plane of focus [1].
        """
        shifted = self.matrix
        shifted[:2, 2] -= offset * shifted[0, 0]
        size = (self.width, self.height)
        column, row = cv2.initUndistortRectifyMap(
            optics.matrix, optics.distortion, np.eye(3), shifted, size, cv2.CV_32FC1
        )
        return cv2.remap(emitted, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def emitted_light(projector: Projector, optics: Camera, patterns: Images) -> Images:
    """Return what a projector emits of patterns (P, H, W), values 0..1: the image of Mitsuba's emitter [W]."""
    values = patterns if projector.gamma == 1 else patterns**projector.gamma
    y, x = np.mgrid[: optics.height, : optics.width]
    centre = optics.matrix[:2, 2]
    farthest = np.hypot(*np.maximum(centre, [optics.width - 1, optics.height - 1] - centre))
    share = np.hypot(x - centre[0], y - centre[1]) / farthest
    loss = (1 + (projector.corner_illumination**-0.5 - 1) * share**2) ** -2
    white = (projector.plane_irradiance / np.pi * loss).astype(np.float32)
    return np.asarray((projector.black_level + (1 - projector.black_level) * values) * white, np.float32)


def tangents(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x/z and y/z (n, 2) of the rays of pixels (n, 2), by iteration of OpenCV's projection.

    Raises
    ------
    ValueError
        For a fisheye lens.
    """
    if camera.model != "perspective":
        raise ValueError("the laboratory has no fisheye lenses")
    focal = camera.matrix.diagonal()[:2]
    ideal = (pixels - camera.matrix[:2, 2]) / focal
    for _ in range(40):
        points = np.column_stack([ideal, np.ones(len(ideal))])
        shown, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
        step = (pixels - shown[:, 0]) / focal
        ideal = ideal + step
        if np.abs(step).max() < 1e-9:
            break
    return ideal


@dataclass(frozen=True)
class RayBundle:
    """Rays of the pixels of a region: ``origin`` (3,) [mm] and the direction (n, 3) of each pixel's first corner.

    ``right`` and ``below`` (n, 3) change it by one pixel. World frame.
    """

    origin: NDArray[np.float64]
    corner: NDArray[np.float32]
    right: NDArray[np.float32]
    below: NDArray[np.float32]

    def only(self, chosen: NDArray[np.bool_]) -> RayBundle:
        """Return the rays of some pixels (n,)."""
        return RayBundle(self.origin, self.corner[chosen], self.right[chosen], self.below[chosen])

    @property
    def middle(self) -> NDArray[np.float32]:
        """Return the directions (n, 3) of the pixels' centres."""
        return np.asarray(self.corner + 0.5 * self.right + 0.5 * self.below)

    @classmethod
    def of(cls, camera: Camera, world_from_sensor: Transform, roi: Roi) -> RayBundle:
        """Return the rays of a region of a camera's image."""
        columns, rows = np.meshgrid(
            np.arange(roi.left, roi.right + 1) - 0.5, np.arange(roi.top, roi.top + roi.height + 1) - 0.5
        )
        flat = tangents(camera, np.column_stack([columns.ravel(), rows.ravel()]))
        world_from_camera = world_from_sensor @ camera.sensor_from_camera
        rays = world_from_camera.directions(np.column_stack([flat, np.ones(len(flat))]))
        rays = rays.reshape(*columns.shape, 3)
        parts = rays[:-1, :-1], rays[:-1, 1:] - rays[:-1, :-1], rays[1:, :-1] - rays[:-1, :-1]
        return cls(world_from_camera.translation, *(part.reshape(-1, 3).astype(np.float32) for part in parts))


def mean_radiance(scene: Any, rays: RayBundle, paths: int, surfaces: int, seed: int) -> NDArray[np.float32]:
    """Return the radiance (n,) of pixels: the mean over ``paths`` light paths of each, stratified over its area.

    Paths of one seed begin alike, so that the difference between two numbers of ``surfaces`` has only the light that
    more surfaces add.
    """
    import drjit as dr
    import mitsuba as mi

    side = max(round(np.sqrt(paths)), 1)
    if not len(rays.corner):
        return np.zeros(0, np.float32)
    integrator = mi.load_dict({"type": "path", "max_depth": surfaces + 1, "rr_depth": 100})
    count, spp = len(rays.corner), side * side
    total = np.zeros(count, np.float32)
    at_once = max(_AT_ONCE // spp, 1)
    for first in range(0, count, at_once):
        part = slice(first, first + at_once)
        corner, right, below = (mi.Vector3f(each[part].T) for each in (rays.corner, rays.right, rays.below))
        size = (min(first + at_once, count) - first) * spp
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed + first), size)  # a number would be compiled into the kernel
        lane = dr.arange(mi.UInt32, size)
        per_pixel, per_side = dr.opaque(mi.UInt32, spp), dr.opaque(mi.UInt32, side)
        pixel = lane // per_pixel
        cell = lane - pixel * per_pixel
        place = (mi.Vector2f(cell % per_side, cell // per_side) + sampler.next_2d()) / mi.Float(per_side)
        along = dr.gather(mi.Vector3f, corner, pixel)
        along += dr.gather(mi.Vector3f, right, pixel) * place.x + dr.gather(mi.Vector3f, below, pixel) * place.y
        origin = mi.Point3f(*(dr.opaque(mi.Float, float(one)) for one in rays.origin))
        radiance, valid, _ = integrator.sample(scene, sampler, mi.Ray3f(origin, dr.normalize(along)))
        total[part] = np.array(dr.block_sum(dr.select(valid, radiance[0], 0.0), spp)) / spp
    return total


def independent(patterns: Images) -> tuple[list[int], NDArray[np.float64]]:
    """Return the indices of patterns (P, H, W) of which all are sums, and the weights (P, chosen) of the sums.

    Light is linear in the image of the projector. Fringes of one period, and a Gray code and its inverse, are sums of
    few images.
    """
    thin = patterns.reshape(len(patterns), -1)[:, ::7].astype(float)
    order = qr(thin.T, mode="economic", pivoting=True)[2]
    for size in range(1, len(patterns)):
        chosen = sorted(order[:size].tolist())
        weights = np.linalg.lstsq(thin[chosen].T, thin.T, rcond=None)[0].T
        if np.abs(weights @ thin[chosen] - thin).max() < _SUM_ERROR * thin.max():
            return chosen, weights
    return list(range(len(patterns))), np.eye(len(patterns))


@dataclass(frozen=True)
class Lamp:
    """A projector of a world: its ``optics``, and its ``patterns`` (P, H, W), values 0..1."""

    projector: Projector
    optics: Camera
    patterns: Images


def light_on(
    part: LaboratoryPart,
    ideal: IdealProjector,
    lamp: Lamp,
    rays: Mapping[str, RayBundle],
    world_from_sensor: Transform,
    paths: int,
    seed: int,
) -> dict[str, tuple[Images, Images]]:
    """Return the light of each camera's pixels under each pattern: direct, and interreflected, (P, n) of each name.

    In W / (mm^2 sr). All patterns have the same light paths. ``paths`` is their number for each pixel, over the whole
    aperture.
    """
    import mitsuba as mi

    emitted = emitted_light(lamp.projector, lamp.optics, lamp.patterns)
    chosen, weights = independent(emitted) if len(emitted) > 1 else ([0], np.eye(1))
    points = APERTURE if lamp.projector.aperture_mm > 0 else APERTURE[:1]
    each = max(round(paths / len(points)), 1)
    world_from_lamp = world_from_sensor @ lamp.optics.sensor_from_camera
    out = {name: np.zeros((2, len(chosen), len(one.corner)), np.float32) for name, one in rays.items()}
    for number, point in enumerate(points):
        beside = (point[0] * lamp.projector.aperture_mm / 2, point[1] * lamp.projector.aperture_mm / 2)
        place = world_from_lamp @ Transform(np.eye(3), np.array([*beside, 0.0]))
        part.light["projector.to_world"] = mi.AffineTransform4f(mitsuba_to_world(place))
        for index, pattern in enumerate(chosen):
            image = ideal.image(emitted[pattern], lamp.optics, np.array(beside) / lamp.projector.focus_mm)
            part.light["projector.irradiance.data"] = mi.TensorXf(image[..., None])
            part.light.update()
            for camera, (name, bundle) in enumerate(rays.items()):
                stream = int(np.random.SeedSequence([seed, number, camera]).generate_state(1)[0] >> 1)
                direct = mean_radiance(part.lit, bundle, each, 1, stream)
                every = mean_radiance(part.lit, bundle, each, SURFACES, stream)
                out[name][0, index] += direct / len(points)
                out[name][1, index] += (every - direct) / len(points)
    return {name: tuple(np.float32(weights) @ images for images in both) for name, both in out.items()}


def room_light_on(part: LaboratoryPart, rays: Mapping[str, RayBundle], seed: int) -> dict[str, NDArray[np.float32]]:
    """Return the radiance (n,) of each camera's pixels in a room of the irradiance 1 [1/sr].

    The room is equally bright on all sides. What is not the part is dark.
    """
    out = {}
    for camera, (name, bundle) in enumerate(rays.items()):
        met = part.shapes_met(bundle.origin, bundle.middle) >= 0
        out[name] = mean_radiance(part.room, bundle, _ROOM_PATHS, 2, seed + 97 * camera) * met
    return out


def smoothed(light: Images, shape: NDArray[np.intp]) -> Images:
    """Return interreflections (P, h, w) as the mean with a Gaussian over the pixels of one shape (h, w), -1 for none.

    Two rough faces have spread this light over many pixels, save beside the edge that they share. Unlike direct light
    it is noisy.
    """
    out = light.copy()
    for index in range(shape.max(initial=-1) + 1):
        mask = shape == index
        weight = gaussian_filter(mask.astype(np.float32), _SMOOTHING_PX)
        for image, source in zip(out, light, strict=True):
            image[mask] = (gaussian_filter(np.where(mask, source, 0), _SMOOTHING_PX)[mask]) / weight[mask]
    return out


def bounding_region(camera: Camera, points: NDArray[np.float64], margin: int) -> Roi:
    """Return the region of an image that contains points (n, 3) [mm] of the sensor frame, with a margin [px]."""
    local = camera.sensor_from_camera.inverse().points(points)
    shown, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    low = np.floor(shown[:, 0].min(axis=0)).astype(int) - margin
    high = np.ceil(shown[:, 0].max(axis=0)).astype(int) + margin + 1
    left, top = np.clip(low, 0, [camera.width - 1, camera.height - 1])
    right, bottom = np.clip(high, [left + 1, top + 1], [camera.width, camera.height])
    return Roi(int(left), int(top), int(right - left), int(bottom - top))


def box_corners(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the eight corners (8, 3) of a box (2, 3)."""
    return np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def regions(
    cameras: Mapping[str, Camera], bounds: NDArray[np.float64], world_from_sensor: Transform, margin: int
) -> dict[str, Roi]:
    """Return the region of each camera's image that shows a part with these bounds (2, 3) [mm], world frame."""
    points = world_from_sensor.inverse().points(box_corners(bounds))
    return {name: bounding_region(camera, points, margin) for name, camera in cameras.items()}
