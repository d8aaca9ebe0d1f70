"""Light transport: every image of one camera from one tracing of the light paths.

Signal chain, per pixel and sample: a place inside the pixel, a place in the lens -> camera ray -> surface -> a place
in the projector's aperture and the coordinate (u, v) that lights the surface from there, if no shadow -> BSDF ->
radiance per unit of code value, optical length L -> one accumulator per image.

An image's code is a function of (u, v) or of L (:mod:`mitsim.scene.light_transport.projector_light`), so all images of
a capture are looked up on the same paths: one kernel, one thread per pixel, the loop over samples inside, no film and
no atomics. Direct light from a projector carries no light-sampling noise, and the places inside a pixel stand on a
raster, those in the two apertures are a fixed set: direct light is rendered without noise that could be mistaken for
the sensor's. What is left is the error of a quadrature rule, the same in every capture of a pose. ``jitter`` takes the
places at random, for comparison with other renderers. Later bounces go through the same loop: a lane whose path has
ended starts its next sample. Of their light, part is left to photons from the projector
(:mod:`mitsim.scene.light_transport.light_tracing`), which find what camera paths find badly. Emitters in the scene
(:mod:`mitsim.scene.light_transport.ambient`) add the same light to every image.

Radiometry: code value x plane irradiance E_1 [W] -> radiance [W / (mm^2 sr)], see :mod:`mitsim.sensor.projector`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport.ambient import aimed, has_emitters, met
from mitsim.scene.light_transport.aperture_samples import aperture_samples
from mitsim.scene.light_transport.light_tracing import Photons, add_photons
from mitsim.scene.light_transport.low_discrepancy import evenly, z_order
from mitsim.scene.light_transport.plain_scene import lone_bsdf, lone_plane, meet
from mitsim.scene.light_transport.projector_light import Light, ProjectorLight
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays, between, pixel_area
from mitsim.scene.ray_casting.eye import Eye
from mitsim.sensor.roi import Roi
from mitsim.sensor.transforms import Transform

#: floats that the images of one launch may fill; a larger capture is traced in bands of rows. 64 MiB, and the device
#: holds a few times that
LARGEST_LAUNCH = 1 << 24

#: photons for each sample of the whole image, unless told otherwise
PHOTONS_PER_SAMPLE = 0.25

#: odds over this are cut: they must stay finite
_CERTAIN = 1e30


@dataclass(frozen=True)
class LightPaths:
    """Which light paths :func:`trace` follows.

    Attributes
    ----------
    samples
        Per pixel; rounded up to a square number, because they stand on a raster.
    seed
        Of the directions of later bounces, and of the jitter; give every camera and pose its own.
    depth
        Surfaces on a light path: 1 is direct light, 3 adds two interreflections.
    jitter
        Place the samples at random within their cells and lenses, rather than at fixed places.
    photons
        That the projector sends for light of two and more surfaces; by default in proportion to the samples of the
        *whole* image, whatever the region; rounded up to a square number. 0 leaves all of it to paths from the camera.
    only_later
        Leave out direct light, and render light that has met two surfaces or more, on the same paths.
    with_ambient
        Give one more image, the last: the light of the scene's own emitters alone, with the projector off.
    """

    samples: int
    seed: int
    depth: int = 1
    jitter: bool = False
    photons: int | None = None
    only_later: bool = False
    with_ambient: bool = False

    @property
    def side(self) -> int:
        """Samples along one side of a pixel's raster."""
        return int(np.ceil(np.sqrt(self.samples)))

    def sent(self, pixels: int) -> int:
        """Photons to send for an image of so many pixels; a square number."""
        if self.depth == 1:
            return 0
        photons = int(PHOTONS_PER_SAMPLE * self.side**2 * pixels) if self.photons is None else self.photons
        return int(np.ceil(np.sqrt(photons))) ** 2


def trace(
    scene: Scene,
    rays: CameraRays,
    light: Light,
    world_from_sensor: Transform,
    paths: LightPaths,
    roi: Roi | None = None,
    shift: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """Radiance that one camera sees in each image of a capture.

    Parameters
    ----------
    light
        The projector with its codes: :class:`~mitsim.scene.light_transport.projector_light.LitPatterns` or
        :class:`~mitsim.scene.light_transport.projector_light.ModulatedLight`.
    roi
        Trace only this region of the image. Its pixels come out as they would in the whole image.
    shift
        (2, height, width) [rad] of the region, along the camera's x and y: how far beside the surface point, seen from
        the camera, its direct light is read from the code. Speckle does that.

    Returns
    -------
    numpy.ndarray
        (P, height, width), or (P + 1, height, width), of the region, float32 [W / (mm^2 sr)].
    """
    roi = roi or rays.whole
    photons = paths.sent(rays.camera.width * rays.camera.height)
    images = np.empty((light.count + paths.with_ambient, roi.height, roi.width), np.float32)
    rows = max(1, LARGEST_LAUNCH // (roi.width * (light.count + 1)))
    for first in range(0, roi.height, rows):
        band = Roi(roi.left, roi.top + first, roi.width, min(rows, roi.height - first))
        moved = None if shift is None else shift[:, first : first + band.height]
        traced = _launch(scene, rays, light, world_from_sensor, paths, band, moved)
        for image, values in zip(images, traced, strict=False):  # the ambient image is the last, wanted or not
            image[first : first + band.height] = np.asarray(values).reshape(band.height, band.width)
    if photons:
        sent = Photons(photons, paths.depth, paths.seed, paths.side**2)
        add_photons(images[: light.count], scene, rays, light, world_from_sensor, sent, roi)
    return images


def _launch(
    scene: Scene,
    rays: CameraRays,
    light: Light,
    world_from_sensor: Transform,
    paths: LightPaths,
    roi: Roi,
    shift: NDArray[np.floating] | None,
) -> list[Any]:
    """All images, and the ambient one, of a region, as arrays on the device; one kernel."""
    side, depth, seed, jitter = paths.side, paths.depth, paths.seed, paths.jitter
    photons = paths.sent(rays.camera.width * rays.camera.height)
    camera = Eye(world_from_sensor @ rays.camera.sensor_from_camera)
    lamp = ProjectorLight(world_from_sensor, light.projector, scene.bounds)

    count = roi.width * roi.height
    index = dr.arange(mi.UInt32, count)
    width = dr.opaque(mi.UInt32, roi.width)
    column = index % width + dr.opaque(mi.UInt32, roi.left)
    row = index // width + dr.opaque(mi.UInt32, roi.top)
    pixel = row * rays.camera.width + column
    x, y = rays.corners(column, row)
    displacement = None if shift is None else _displacement(shift, camera, index)

    random = mi.PCG32(initstate=dr.opaque(mi.UInt64, seed), initseq=mi.UInt64(pixel))
    shuffle, order = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), z_order(column, row)
    total = dr.opaque(mi.UInt32, side * side)
    # n midpoints in a row have a second moment too small by 1/n^2; spread that much wider they are exact to the third
    # order, and of two they make Gauss's rule
    stretch = 1.0 if jitter or side == 1 else float(1.0 / np.sqrt(1.0 - side**-2))
    thin = rays.aperture_mm > 0
    pupils = _Pupils(side * side, jitter)
    lit_by_author = has_emitters(scene)
    plane, finish = lone_plane(scene), lone_bsdf(scene)
    blockers = scene.mitsuba if plane is None else None
    rival = dr.opaque(mi.Float, photons / side**2)
    area = pixel_area(x, y)
    sums = [dr.zeros(mi.Float, count) for _ in range(light.codes + 1)]  # the last: ambient light
    start_of_all = _Path(
        sample=mi.UInt32(dr.zeros(mi.UInt32, count)),
        bounce=mi.UInt32(dr.zeros(mi.UInt32, count)),
        origin=dr.zeros(mi.Point3f, count),
        direction=dr.zeros(mi.Vector3f, count),
        weight=dr.ones(mi.Float, count),
        pdf=dr.ones(mi.Float, count),
        length=dr.zeros(mi.Float, count),
        odds=dr.zeros(mi.Float, count),
        random=random,
        sums=sums,
    )

    def running(path: _Path) -> Any:
        return path.sample < total

    def step(path: _Path) -> tuple[_Path]:
        sample, bounce, origin, direction = path.sample, path.bounce, path.origin, path.direction
        weight, pdf, length, odds, random, sums = path.weight, path.pdf, path.length, path.odds, path.random, path.sums
        # a lane at bounce 0 begins a path in the next cell of its pixel's side x side raster
        fresh = bounce == 0
        a = 0.5 + stretch * ((mi.Float(sample % side) + (random.next_float32() if jitter else 0.5)) / side - 0.5)
        b = 0.5 + stretch * ((mi.Float(sample // side) + (random.next_float32() if jitter else 0.5)) / side - 0.5)
        local = mi.Vector3f(between(x, a, b), between(y, a, b), 1.0)
        start = camera.position
        if thin:
            place = pupils.camera(sample, random) * (0.5 * rays.aperture_mm)
            start = start + camera.axes[0] * place.x + camera.axes[1] * place.y
            local -= mi.Vector3f(place.x, place.y, 0.0) * (1.0 / rays.focus_mm)
        origin = dr.select(fresh, start, origin)
        direction = dr.select(fresh, camera.turn(dr.normalize(local)), direction)
        weight = dr.select(fresh, 1.0, weight)

        ray = mi.Ray3f(origin, direction)
        surface = scene.mitsuba.ray_intersect(ray) if plane is None else meet(plane, ray)
        if lit_by_author:
            ambient = weight * met(scene, surface, origin, pdf, fresh)
            if paths.only_later:  # what is met behind the first surface is direct light of it
                ambient = dr.select(bounce > 1, ambient, 0.0)
        hit = surface.is_valid() & (bounce < depth)
        length = dr.select(fresh, 0.0, length) + dr.select(hit, surface.t, 0.0)
        context = mi.BSDFContext()
        bsdf = surface.bsdf() if finish is None else finish
        counts = hit & ~fresh if paths.only_later else hit

        lens = pupils.projector(sample, random) if lamp.radius > 0 else None
        moved = None if displacement is None else displacement * dr.select(fresh, surface.t, 0.0)
        toward, lit, uv, distance = lamp.light(blockers, surface, direction, lens, moved, counts)
        reflected = bsdf.eval(context, surface, surface.to_local(toward), counts & (lit > 0))[0]
        radiance = weight * reflected * lit
        if photons:  # odds: n_L p_L over n_C p_C of the surfaces so far
            seen = dr.abs(dr.dot(surface.n, direction))
            cosine = dr.dot(direction, camera.axes[2])
            footprint = rival * area * dr.square(cosine) * cosine * dr.square(surface.t)
            odds = dr.select(fresh, footprint, odds) / dr.maximum(seen, 1e-9)
            back = _toward_camera(bsdf, surface, surface.to_local(toward), hit & ~fresh & (lit > 0))
            back *= lamp.density(toward, distance) * dr.abs(dr.dot(surface.n, toward))
            radiance *= dr.select(fresh, 1.0, 1.0 / (1.0 + odds * back))
        values = light.values(uv, length + distance, counts & (radiance > 0))
        added = [dr.select(radiance > 0, radiance * value, 0.0) for value in values]
        if lit_by_author:
            ambient += dr.select(counts, weight * aimed(scene, surface, bsdf, random, counts), 0.0)
        sums = [s + a for s, a in zip(sums, [*added, ambient if lit_by_author else 0.0], strict=True)]

        if depth == 1 and not lit_by_author:
            return (_Path(sample + 1, bounce, origin, direction, weight, pdf, length, odds, random, sums),)
        pick, place = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        if not jitter:  # the first bounce decides most of what is left
            first, where = evenly(order * total + sample, shuffle, 0)
            pick, place = dr.select(fresh, first, pick), dr.select(fresh, where, place)
        # the author's emitters may be met one ray after the last surface
        alive = hit & (bounce + 1 < (depth + 1 if lit_by_author else depth))
        further, factor = bsdf.sample(context, surface, pick, place, alive)
        alive &= factor[0] > 0
        onward = surface.spawn_ray(surface.to_world(further.wo))
        if photons:  # none follows a delta lobe
            back = dr.select(fresh, 1.0, _toward_camera(bsdf, surface, further.wo, alive & ~fresh))
            narrow = mi.has_flag(further.sampled_type, mi.BSDFFlags.Delta)
            odds *= dr.select(narrow, 0.0, back * dr.abs(dr.dot(surface.n, onward.d)) / further.pdf)
            odds = dr.select(alive, dr.minimum(odds, _CERTAIN), 0.0)
        onward_path = _Path(
            sample=dr.select(alive, sample, sample + 1),
            bounce=dr.select(alive, bounce + 1, 0),
            origin=dr.select(alive, onward.o, origin),
            direction=dr.select(alive, onward.d, direction),
            weight=dr.select(alive, weight * factor[0], 1.0),
            pdf=further.pdf,
            length=length,
            odds=odds,
            random=random,
            sums=sums,
        )
        return (onward_path,)

    (ended,) = dr.while_loop((start_of_all,), running, step, labels=("path",), label="transport")
    sums = ended.sums
    scale = dr.opaque(mi.Float, 1.0 / (side * side))
    *code_sums, ambient_sum = sums
    images = [(s + ambient_sum) * scale for s in light.images(code_sums)] + [ambient_sum * scale]
    dr.eval(images)  # all at once: one kernel, whatever the number of images
    return images


@dataclass
class _Path:
    """State of the light paths of one launch, a lane per pixel, as Dr.Jit's loop carries it.

    ``sample`` of the pixel, ``bounce`` on its path; ``origin`` and ``direction`` of the next ray; ``weight`` of its
    light; ``pdf`` of its direction; optical ``length`` so far; ``odds`` of photons against paths of the camera;
    ``random`` numbers; ``sums`` of the light of each code, the last of ambient light.
    """

    sample: Any
    bounce: Any
    origin: Any
    direction: Any
    weight: Any
    pdf: Any
    length: Any
    odds: Any
    random: Any
    sums: Any


def _toward_camera(bsdf: Any, surface: Any, lampward: Any, active: Any) -> Any:
    """Density with which a photon that came from ``lampward``, local, goes on toward the camera [1/sr]."""
    view = mi.SurfaceInteraction3f(surface)
    view.wi = lampward
    return bsdf.pdf(mi.BSDFContext(), view, surface.wi, active)


class _Pupils:
    """Where the rays of a sample pass through the lenses of camera and projector, in the unit disc."""

    def __init__(self, count: int, jitter: bool) -> None:
        self.jitter = jitter
        self.tables = [mi.Point2f(places) for places in aperture_samples(count)]

    def camera(self, sample: Any, random: Any) -> Any:
        """Place in the camera's lens."""
        return self._place(0, sample, random)

    def projector(self, sample: Any, random: Any) -> Any:
        """Place in the projector's lens."""
        return self._place(1, sample, random)

    def _place(self, which: int, sample: Any, random: Any) -> Any:
        if self.jitter:
            return mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random.next_float32(), random.next_float32()))
        return dr.gather(mi.Point2f, self.tables[which], sample)


def _displacement(shift: NDArray[np.floating], camera: Eye, index: Any) -> Any:
    """Displacement of the code in the world for each pixel of a region, per distance from the camera [rad]."""
    # gathered, not loaded: a kernel that loads is compiled anew for each alignment that an array of NumPy may have
    along = mi.Float(np.ravel(shift).astype(np.float32))
    below = index + dr.opaque(mi.UInt32, shift[0].size)
    return camera.axes[0] * dr.gather(mi.Float, along, index) + camera.axes[1] * dr.gather(mi.Float, along, below)
