"""Light transport: every image of one camera from one tracing of the light paths.

Signal chain, per pixel and sample: a place inside the pixel -> camera ray -> surface -> the projector coordinate
(u, v) that lights it, if no shadow -> BSDF -> radiance per unit of pattern value -> one accumulator per pattern.

A pattern is a function of (u, v), so all patterns of a capture are looked up on the same paths: one kernel, one
thread per pixel, the loop over samples inside, no film and no atomics. Direct light from a projector carries no
light-sampling noise, and the places inside a pixel are the middles of a raster of cells: direct light is rendered
without noise that could be mistaken for the sensor's. What is left is the error of a midpoint rule, the same in every
capture of a pose. ``jitter`` moves the places at random within their cells, for comparison with other renderers.
Later bounces go through the same loop: a lane whose path has ended starts its next sample. Emitters in the scene
(:mod:`mitsim.scene.ambient`) add the same light to every image.

The camera is any smooth map from pixels to rays: the kernel sees directions at pixel corners and interpolates inside
the pixel (error under 3e-4 px for the strongest distortion of our presets, in the corners of the image).

Radiometry: pattern value x plane irradiance E_1 [W] -> radiance [W / (mm^2 sr)], see :mod:`mitsim.sensor.projector`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.errors import InputError
from mitsim.scene.ambient import aimed, has_emitters, met
from mitsim.scene.backend import dr, mi
from mitsim.scene.eye import Eye, shadow_ray
from mitsim.scene.load import Scene
from mitsim.sensor.camera import Camera
from mitsim.sensor.frames import Transform
from mitsim.sensor.projector import Projector


@dataclass(frozen=True)
class Window:
    """Part of an image: columns ``column`` to ``column + width``, rows ``row`` to ``row + height`` [px]."""

    column: int
    row: int
    width: int
    height: int


class CameraRays:
    """A camera prepared for tracing: its ray table lies on the device, and is laid there once."""

    def __init__(self, camera: Camera) -> None:
        columns, rows = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
        rays = camera.rays(np.stack([columns, rows], axis=-1))
        self.camera = camera
        self.x = mi.Float(np.ravel(rays[..., 0] / rays[..., 2]).astype(np.float32))
        self.y = mi.Float(np.ravel(rays[..., 1] / rays[..., 2]).astype(np.float32))

    @property
    def whole(self) -> Window:
        """The whole image."""
        return Window(0, 0, self.camera.width, self.camera.height)


class LitPatterns:
    """Patterns laid on the device: (P, H, W) values relative to white, bilinear between projector pixels."""

    def __init__(self, patterns: NDArray[np.floating], projector: Projector) -> None:
        optics = projector.optics
        if patterns.ndim != 3 or patterns.shape[1:] != (optics.height, optics.width):
            raise InputError("patterns", "shape", patterns.shape, f"(P, {optics.height}, {optics.width})")
        if optics.model != "perspective" or np.any(optics.distortion[8:]):
            raise InputError("projector", "distortion", optics.distortion, "perspective, up to k6")
        self.count = patterns.shape[0]
        self.projector = projector
        stack = np.moveaxis(projector.emit(patterns), 0, -1)
        self.texture = mi.Texture2f(mi.TensorXf(np.ascontiguousarray(stack)), wrap_mode=dr.WrapMode.Clamp)


def trace(
    scene: Scene,
    rays: CameraRays,
    patterns: LitPatterns,
    world_from_sensor: Transform,
    *,
    samples: int,
    seed: int,
    depth: int = 1,
    window: Window | None = None,
    jitter: bool = False,
    with_ambient: bool = False,
) -> NDArray[np.float32]:
    """Radiance that one camera sees under each pattern.

    Parameters
    ----------
    samples
        Per pixel; rounded up to a square number, because they stand on a raster.
    seed
        Of the directions of later bounces, and of the jitter; give every camera and pose its own.
    depth
        Surfaces on a light path: 1 is direct light, 3 adds two interreflections.
    window
        Trace only this part of the image.
    jitter
        Place the samples at random within their cells, rather than in their middles.
    with_ambient
        Give one more image, the last: the light of the scene's own emitters alone, with the projector off.

    Returns
    -------
    numpy.ndarray
        (P, height, width), or (P + 1, height, width), of the window, float32 [W / (mm^2 sr)].
    """
    window = window or rays.whole
    side = int(np.ceil(np.sqrt(samples)))
    camera = Eye(world_from_sensor @ rays.camera.sensor_from_camera)
    lamp = _Lamp(world_from_sensor, patterns)

    count = window.width * window.height
    index = dr.arange(mi.UInt32, count)
    width = dr.opaque(mi.UInt32, window.width)
    column = index % width + dr.opaque(mi.UInt32, window.column)
    row = index // width + dr.opaque(mi.UInt32, window.row)
    corner = row * (rays.camera.width + 1) + column
    corners = [corner, corner + 1, corner + rays.camera.width + 1, corner + rays.camera.width + 2]
    x = [dr.gather(mi.Float, rays.x, c) for c in corners]
    y = [dr.gather(mi.Float, rays.y, c) for c in corners]

    random = mi.PCG32(size=count, initstate=dr.opaque(mi.UInt64, seed), initseq=mi.UInt64(index))
    total = dr.opaque(mi.UInt32, side * side)
    lit_by_author = has_emitters(scene)
    sums = [dr.zeros(mi.Float, count) for _ in range(patterns.count + 1)]  # the last: ambient light
    state = (
        mi.UInt32(dr.zeros(mi.UInt32, count)), mi.UInt32(dr.zeros(mi.UInt32, count)),
        dr.zeros(mi.Point3f, count), dr.zeros(mi.Vector3f, count), dr.ones(mi.Float, count), dr.ones(mi.Float, count),
        random, sums,
    )  # fmt: skip

    def running(sample: Any, *_: Any) -> Any:
        return sample < total

    def step(
        sample: Any, bounce: Any, origin: Any, direction: Any, weight: Any, pdf: Any, random: Any, sums: Any
    ) -> Any:  # fmt: skip
        # a lane at bounce 0 begins a path in the next cell of its pixel's side x side raster
        fresh = bounce == 0
        a = (mi.Float(sample % side) + (random.next_float32() if jitter else 0.5)) / side
        b = (mi.Float(sample // side) + (random.next_float32() if jitter else 0.5)) / side
        local = mi.Vector3f(_bilinear(x, a, b), _bilinear(y, a, b), 1.0)
        origin = dr.select(fresh, camera.position, origin)
        direction = dr.select(fresh, camera.turn(dr.normalize(local)), direction)
        weight = dr.select(fresh, 1.0, weight)

        surface = scene.mitsuba.ray_intersect(mi.Ray3f(origin, direction))
        if lit_by_author:
            ambient = weight * met(scene, surface, origin, pdf, fresh)
        hit = surface.is_valid() & (bounce < depth)
        context = mi.BSDFContext()
        bsdf = surface.bsdf()

        toward, lit, uv = lamp.light(scene.mitsuba, surface, direction, hit)
        reflected = bsdf.eval(context, surface, surface.to_local(toward), hit & (lit > 0))[0]
        radiance = weight * reflected * lit
        values = patterns.texture.eval(uv, hit & (radiance > 0))
        added = [dr.select(radiance > 0, radiance * value, 0.0) for value in values]
        if lit_by_author:
            ambient += dr.select(hit, weight * aimed(scene, surface, bsdf, random, hit), 0.0)
        sums = [s + a for s, a in zip(sums, [*added, ambient if lit_by_author else 0.0], strict=True)]

        if depth == 1 and not lit_by_author:
            return sample + 1, bounce, origin, direction, weight, pdf, random, sums
        pick, place = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        further, factor = bsdf.sample(context, surface, pick, place, hit)
        # the author's emitters may be met one ray after the last surface
        alive = hit & (bounce + 1 < (depth + 1 if lit_by_author else depth)) & (factor[0] > 0)
        onward = surface.spawn_ray(surface.to_world(further.wo))
        return (
            dr.select(alive, sample, sample + 1), dr.select(alive, bounce + 1, 0),
            dr.select(alive, onward.o, origin), dr.select(alive, onward.d, direction),
            dr.select(alive, weight * factor[0], 1.0), further.pdf, random, sums,
        )  # fmt: skip

    labels = ("sample", "bounce", "origin", "direction", "weight", "pdf", "random", "sums")
    *_, sums = dr.while_loop(state, running, step, labels=labels, label="transport")
    scale = dr.opaque(mi.Float, 1.0 / (side * side))
    *pattern_sums, ambient_sum = sums
    images = [(s + ambient_sum) * scale for s in pattern_sums]
    if with_ambient:
        images.append(ambient_sum * scale)
    dr.eval(images)  # all at once: one kernel, whatever the number of patterns
    return np.stack([np.array(image).reshape(window.height, window.width) for image in images])


class _Lamp(Eye):
    """The projector, seen from a surface."""

    def __init__(self, world_from_sensor: Transform, patterns: LitPatterns) -> None:
        optics = patterns.projector.optics
        super().__init__(world_from_sensor @ optics.sensor_from_camera)
        k = optics.matrix
        self.focal = (float(k[0, 0]), float(k[1, 1]))
        self.principal = (float(k[0, 2]), float(k[1, 2]))
        self.size = (optics.width, optics.height)
        self.distortion = np.concatenate([optics.distortion, np.zeros(8)])[:8].tolist()
        self.irradiance = dr.opaque(mi.Float, patterns.projector.plane_irradiance)

    def light(self, scene: Any, surface: Any, ray_direction: Any, active: Any) -> tuple[Any, Any, Any]:
        """Unit direction to the lamp, radiant intensity / r^2 [W/mm^2] that arrives (0 in shadow), texture (u, v)."""
        to_lamp = self.position - surface.p
        distance = dr.norm(to_lamp)
        toward = to_lamp / distance
        local = self.local(-to_lamp)
        in_front = active & (local.z > 0)
        z = dr.select(in_front, local.z, 1.0)
        u, v = self._project(local.x / z, local.y / z)
        inside = in_front & (u > -0.5) & (u < self.size[0] - 0.5) & (v > -0.5) & (v < self.size[1] - 0.5)
        facing = inside & (dr.dot(surface.n, toward) * dr.dot(surface.n, -ray_direction) > 0)
        blocked = scene.ray_test(shadow_ray(surface, toward, distance), facing)
        cosine = z / distance
        arriving = self.irradiance / (dr.square(cosine) * cosine * dr.square(distance))
        uv = mi.Point2f((u + 0.5) / self.size[0], (v + 0.5) / self.size[1])
        return toward, dr.select(facing & ~blocked, arriving, 0.0), uv

    def _project(self, x: Any, y: Any) -> tuple[Any, Any]:
        """OpenCV's forward distortion, k1 k2 p1 p2 k3 k4 k5 k6, then the matrix."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self.distortion
        if any(self.distortion):
            r2 = x * x + y * y
            radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            x, y = (
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            )
        return self.focal[0] * x + self.principal[0], self.focal[1] * y + self.principal[1]


def _bilinear(corners: list[Any], a: Any, b: Any) -> Any:
    return dr.lerp(dr.lerp(corners[0], corners[1], a), dr.lerp(corners[2], corners[3], a), b)
