"""Estimate how much of the light of each pixel has met another face before, and which face that is.

Signal chain: rays through random positions of each pixel -> first surface: direct light of the projector, all of it
lit -> a direction sampled by its BSDF -> second surface: the projector's light there, times both reflectances -> sums
by the shape of the second surface. The estimate is that of camera paths over two surfaces. Light over three and more,
which is weaker, is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.first_hits import numbers_met, shape_indices
from mitsim.scene.light_transport.plain_scene import SceneBsdfs
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.projector_light import ProjectorLight
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.camera_rays import CameraRays, bilinear
from mitsim.scene.ray_casting.eye import Eye
from mitsim.sensor.camera import Camera
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform

#: paths at once
_TOGETHER = 1 << 21


@dataclass(frozen=True)
class LightFromFaces:
    """Radiance [W / (mm^2 sr)] of each pixel with all of the projector lit.

    ``shape`` (H, W) is the shape that most paths of the pixel meet, -1 for none. ``direct`` (H, W) is the light that
    comes from the projector at once, ``by_face`` (shapes, H, W) that which met each shape of the scene before.
    """

    shape: NDArray[np.int64]
    direct: Floats
    by_face: Floats

    @property
    def share(self) -> Floats:
        """Return the share of interreflected light (H, W), 0 to 1; NaN where no light arrives."""
        other = self.by_face.sum(axis=0)
        whole = self.direct + other
        return np.asarray(np.divide(other, whole, out=np.full(whole.shape, np.nan), where=whole > 0))

    def shares_of(self, shape: int) -> Floats:
        """Return the shares (shapes,) of the light of one shape that met each shape before; NaN if it has no light."""
        here = self.shape == shape
        whole = self.direct[here].sum() + self.by_face[:, here].sum()
        return self.by_face[:, here].sum(axis=1) / whole if whole > 0 else np.full(len(self.by_face), np.nan)


def light_from_faces(
    scene: Scene,
    camera: Camera,
    projector: Projector,
    world_from_sensor: Transform,
    samples: int = 256,
    seed: int = 1,
    roi: Roi | None = None,
) -> LightFromFaces:
    """Estimate the light of each pixel of a camera by the face that it met before.

    Parameters
    ----------
    scene
        The scene.
    camera, projector
        Camera, of few large pixels, and projector of the sensor.
    world_from_sensor, samples
        Pose of the sensor, and paths per pixel.
    seed
        Of the paths.
    roi
        Region of the image, by default all of it.
    """
    rays, shapes = CameraRays(camera), len(scene.names)
    region = roi or rays.whole
    pixels = region.width * region.height
    met = np.zeros((shapes, pixels))
    direct, by_face = np.zeros(pixels), np.zeros((shapes, pixels))
    done = 0
    while done < samples:
        now = min(samples - done, max(1, _TOGETHER // pixels))
        first, second, single, double = _traced(scene, rays, projector, world_from_sensor, now, seed + done, region)
        pixel = np.arange(now * pixels) % pixels
        direct += np.bincount(pixel, single, pixels)
        for number, values, sums in ((first, np.ones(len(first)), met), (second, double, by_face)):
            hit = number >= 0
            index = number[hit].astype(np.int64) * pixels + pixel[hit]
            sums += np.bincount(index, values[hit], shapes * pixels).reshape(shapes, pixels)
        done += now
    shape = np.where(met.any(axis=0), met.argmax(axis=0), -1)
    size = (region.height, region.width)
    return LightFromFaces(shape.reshape(size), direct.reshape(size) / samples, by_face.reshape(-1, *size) / samples)


def _traced(
    scene: Scene, rays: CameraRays, projector: Projector, pose: Transform, samples: int, seed: int, roi: Roi
) -> tuple[NDArray[np.int16], NDArray[np.int16], Floats, Floats]:
    """Return, for each path, the first and the second shape, and the light of one and of two surfaces."""
    camera = rays.camera
    optics = projector.optics
    white = ProjectedPatterns(np.ones((1, optics.height, optics.width), np.float32), projector)
    source = ProjectorLight([pose], projector, bounds_of(scene.mitsuba))
    eye = Eye([pose @ camera.sensor_from_camera])
    index = dr.arange(mi.UInt32, samples * roi.width * roi.height)
    pixel = index % (roi.width * roi.height)
    random = mi.PCG32(initstate=dr.opaque(mi.UInt64, seed), initseq=mi.UInt64(index))
    x, y = rays.corners(pixel % roi.width + roi.left, pixel // roi.width + roi.top)
    a, b = random.next_float32(), random.next_float32()
    local = mi.Vector3f(bilinear(x, a, b), bilinear(y, a, b), 1.0)
    bsdfs = SceneBsdfs(scene)

    def lit(surface: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        lens = mi.Point2f(random.next_float32(), random.next_float32())
        lens = mi.warp.square_to_uniform_disk_concentric(lens) if source.has_aperture else None
        toward, irradiance, uv, distance = source.light(scene.mitsuba, surface, direction, lens, None, active)
        there = active & (irradiance > 0)
        reflected = bsdfs.at(surface).eval(mi.BSDFContext(), surface, surface.to_local(toward), there)[0]
        (value,) = white.values(uv, distance, there)
        return dr.select(there, reflected * irradiance * value, 0.0)

    ray = mi.Ray3f(eye.position, eye.to_world(dr.normalize(local)))
    surface = scene.mitsuba.ray_intersect(ray)
    hit = surface.is_valid()
    single = lit(surface, ray.d, hit)
    sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
    sampled, weight = bsdfs.at(surface).sample(mi.BSDFContext(), surface, sample1, sample2, hit)
    next_ray = surface.spawn_ray(surface.to_world(sampled.wo))
    second = scene.mitsuba.ray_intersect(next_ray, hit & (weight[0] > 0))
    double = dr.select(second.is_valid(), weight[0] * lit(second, next_ray.d, second.is_valid()), 0.0)
    numbers = [numbers_met(interaction, interaction.is_valid()) for interaction in (surface, second)]
    dr.eval(single, double, numbers)
    first_shape, second_shape = (shape_indices(scene.mitsuba, number) for number in numbers)
    return first_shape, second_shape, np.array(single, float), np.array(double, float)
