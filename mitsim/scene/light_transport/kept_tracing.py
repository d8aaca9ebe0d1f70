"""Trace the candidates of :mod:`mitsim.scene.light_transport.kept_paths`: interreflections as records of whole paths.

Signal chain: pixels that see the part -> camera rays -> surface after surface, each with a connection to the projector;
and photons from the projector, each surface with a connection to the camera -> records.

Sampling, connections and weights are those of :mod:`mitsim.scene.light_transport.path_loop` and
:mod:`mitsim.scene.light_transport.light_tracing`, but a record keeps the directions at each surface in place of the
values of its BSDFs. All lanes take one step together; those that go on are compressed in their order. The same seed
gives the same records.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, opaque_index, vectors_to_host
from mitsim.scene.light_transport.kept_paths import Candidates
from mitsim.scene.light_transport.low_discrepancy import r3_point, z_order
from mitsim.scene.light_transport.plain_scene import SceneBsdfs
from mitsim.scene.light_transport.projector_light import ProjectorLight
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays, bilinear, pixel_area
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.scene.turned_lay import from_z_axis
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform

#: number of paths that are traced together
_AT_ONCE = 1 << 21

#: largest ratio of densities, so that it stays finite
_LARGEST_RATIO = 1e30

#: first index of the random numbers of photons; those below are for camera paths
_PHOTONS_FROM = 1 << 31


@dataclass(frozen=True)
class Tracing:
    """How paths are traced: ``samples`` per pixel (a square number), ``photons``, surfaces (``depth``), ``seed``.

    ``drawn`` is the number of the drawn finish of each BSDF of the scene, in its order, or -1. ``bsdfs`` are those to
    sample with, in the same order. ``turned`` tells whose lay may be drawn: the directions of their paths are in the
    frame of :func:`mitsim.scene.turned_lay.from_z_axis`.
    """

    samples: int
    photons: int
    depth: int
    seed: int
    drawn: Sequence[int]
    bsdfs: Sequence[Any]
    turned: Sequence[bool]


@dataclass
class _Walk:
    """Lanes on their way: one path each."""

    lane: Any  # number of the path, for random numbers
    pixel: Any  # index of the pixel in the region; of photons, unused
    origin: Any
    direction: Any
    weight: Any
    ratio: Any  # of densities, of the other method over this one
    length: Any
    code: Any  # (u, v) of photons
    surfaces: list[Any] = field(default_factory=list)  # of the path so far: material, toward camera, toward projector

    def at(self, index: Any) -> _Walk:
        """Return the lanes with an index."""

        def some(value: Any) -> Any:
            return dr.gather(type(value), value, index)

        return _Walk(
            lane=some(self.lane),
            pixel=some(self.pixel),
            origin=some(self.origin),
            direction=some(self.direction),
            weight=some(self.weight),
            ratio=some(self.ratio),
            length=some(self.length),
            code=some(self.code),
            surfaces=[[some(one) for one in surface] for surface in self.surfaces],
        )


class _Tracer:
    """What camera paths and photons of one launch have in common."""

    def __init__(
        self, scene: Scene, rays: CameraRays, projector: Projector, pose: Transform, roi: Roi, tracing: Tracing
    ) -> None:
        self.scene, self.rays, self.roi, self.tracing = scene, rays, roi, tracing
        self.camera = Eye(pose @ rays.camera.sensor_from_camera)
        self.projector = ProjectorLight(pose, projector, scene.bounds)
        self.bsdfs = SceneBsdfs(scene, tracing.bsdfs)
        self.drawn = mi.Int32(np.asarray([*tracing.drawn, -1], np.int32))
        self.all_drawn = min(tracing.drawn) >= 0
        self.turned = mi.Bool(np.asarray([*tracing.turned, False], bool))
        self.has_aperture = rays.aperture_mm > 0
        self.aperture, self.inverse_focus = opaque(0.5 * rays.aperture_mm), opaque(1.0 / rays.focus_mm)
        self.seed = opaque_index(tracing.seed & 0xFFFFFFFF)
        self.photons_per_sample = opaque(tracing.photons / tracing.samples)
        self.samples_per_photon = opaque(tracing.samples / tracing.photons if tracing.photons else 0.0)

    def random(self, lane: Any, stream: int) -> Any:
        """Return a point of the unit square for each path; ``stream`` numbers the uses."""
        a, b = mi.sample_tea_32(lane, self.seed + opaque_index(0x9E3779B9 * (stream + 1) & 0xFFFFFFFF), 6)
        return mi.Point2f(*[mi.Float(bits >> 8) * np.float32(2**-24) for bits in (a, b)])

    def disc(self, lane: Any, stream: int) -> Any:
        return mi.warp.square_to_uniform_disk_concentric(self.random(lane, stream))

    def material(self, surface: Any, valid: Any) -> Any:
        """Return the number of the drawn finish of each lane, -1 for none."""
        return dr.gather(mi.Int32, self.drawn, self.bsdfs.place(surface, valid), valid)

    def kept(self, surface: Any, material: Any, toward_camera: Any, toward_projector: Any) -> list[Any]:
        """Return material and local directions of a surface as a path keeps them."""
        directions = [mi.Vector3f(toward_camera), mi.Vector3f(toward_projector)]
        if any(self.tracing.turned):
            turned = dr.gather(mi.Bool, self.turned, mi.UInt32(dr.maximum(material, 0)), material >= 0)
            directions = [dr.select(turned, from_z_axis(surface.sh_frame, one), one) for one in directions]
        return [material, *directions]

    def factor(self, material: Any, value: Any) -> Any:
        """Return the part of a BSDF that belongs into the weight: its value if its finish is not drawn, else 1."""
        return mi.Float(1.0) if self.all_drawn else dr.select(material < 0, value, 1.0)


def camera_paths(
    scene: Scene,
    rays: CameraRays,
    projector: Projector,
    pose: Transform,
    roi: Roi,
    pixels: NDArray[np.integer],
    tracing: Tracing,
) -> Iterator[Candidates]:
    """Yield the records of camera paths through ``pixels``, indices in the region ``roi``."""
    one = _Tracer(scene, rays, projector, pose, roi, tracing)
    index = mi.UInt32(np.asarray(pixels, np.uint32))
    at_once = max(1, _AT_ONCE // max(1, len(pixels)))
    for first in range(0, tracing.samples, at_once):
        count = min(at_once, tracing.samples - first)
        walk: _Walk | None = _camera_start(one, index, first, count)
        for number in range(1, tracing.depth + 1):
            if walk is None:
                break
            walk, record = _camera_step(one, walk, number)
            if record is not None:
                yield record


def _camera_start(one: _Tracer, pixels: Any, first: int, count: int) -> _Walk:
    rays, tracing = one.rays, one.tracing
    lanes = dr.arange(mi.UInt32, dr.width(pixels) * count)
    in_row = opaque_index(dr.width(pixels))
    sample = lanes // in_row + opaque_index(first)
    pixel = dr.gather(mi.UInt32, pixels, lanes % in_row)
    column, row = _place(pixel, one.roi)
    x, y = rays.corners(column, row)
    lane = pixel * opaque_index(tracing.samples) + sample
    side = opaque_index(round(np.sqrt(tracing.samples)))
    inside = one.random(lane, 0)
    per_cell = 1.0 / mi.Float(side)
    a, b = (mi.Float(sample % side) + inside.x) * per_cell, (mi.Float(sample // side) + inside.y) * per_cell
    local = mi.Vector3f(bilinear(x, a, b), bilinear(y, a, b), 1.0)
    origin = one.camera.position
    if one.has_aperture:
        in_lens = one.disc(lane, 1) * one.aperture
        origin = origin + one.camera.axes[0] * in_lens.x + one.camera.axes[1] * in_lens.y
        local -= mi.Vector3f(in_lens.x, in_lens.y, 0.0) * one.inverse_focus
    width = len(lanes)
    return _Walk(
        lane,
        pixel,
        mi.Point3f(origin + dr.zeros(mi.Point3f, width)),
        one.camera.to_world(dr.normalize(local)),
        dr.ones(mi.Float, width),
        pixel_area(x, y),  # until the first surface
        dr.zeros(mi.Float, width),
        dr.zeros(mi.Point2f, width),
    )


def _camera_step(one: _Tracer, walk: _Walk, number: int) -> tuple[_Walk | None, Candidates | None]:
    """Meet surface ``number`` of each path: return the paths that go on, and the records of those that are lit."""
    tracing, context = one.tracing, mi.BSDFContext()
    surface = one.scene.mitsuba.ray_intersect(mi.Ray3f(walk.origin, walk.direction))
    hit = surface.is_valid()
    length = walk.length + dr.select(hit, surface.t, 0.0)
    bsdf, material = one.bsdfs.at(surface), one.material(surface, hit)
    toward_camera = mi.Vector3f(surface.wi)
    cosine_in = dr.maximum(dr.abs(dr.dot(surface.n, walk.direction)), 1e-9)
    if number == 1:
        cosine = dr.dot(walk.direction, one.camera.axes[2])
        footprint = one.photons_per_sample * walk.ratio * dr.square(cosine) * cosine * dr.square(surface.t)
        ratio = footprint / cosine_in
    else:
        ratio = walk.ratio / cosine_in
    lit, record = mi.Bool(False), None
    if number > 1:
        lens = one.disc(walk.lane, 4 * number) if one.projector.has_aperture else None
        toward, irradiance, uv, distance = one.projector.light(
            one.scene.mitsuba, surface, walk.direction, lens, None, hit
        )
        toward_projector = surface.to_local(toward)
        value, density = _value_and_density(bsdf, surface, toward_projector, toward_camera, hit & (irradiance > 0))
        density *= one.projector.density(toward, distance) * dr.abs(dr.dot(surface.n, toward))
        # the finish that was sampled with bounds all that may be drawn: what it does not reflect, none does
        lit = hit & (irradiance > 0) & (value > 0)
        weight = walk.weight * irradiance * one.factor(material, value) / (1.0 + ratio * density)
        weight *= opaque(1.0 / tracing.samples)
        record = weight, uv, length + distance, *one.kept(surface, material, toward_camera, toward_projector)
    goes_on = mi.Bool(False)
    follower = None
    if number < tracing.depth:
        even1, even2 = one.random(walk.lane, 4 * number + 1).x, one.random(walk.lane, 4 * number + 2)
        if number == 1:
            samples = opaque_index(tracing.samples)
            even1, even2 = r3_point(z_order(*_place(walk.pixel, one.roi)) * samples + walk.lane % samples, one.seed, 0)
        sampled, bsdf_weight = bsdf.sample(context, surface, even1, even2, hit)
        goes_on = hit & (bsdf_weight[0] > 0)
        ray = surface.spawn_ray(surface.to_world(sampled.wo))
        cosine_out = dr.abs(dr.dot(surface.n, ray.d))
        reverse = mi.Float(1.0)
        if number > 1:
            reverse = _density_to_camera(bsdf, surface, sampled.wo, goes_on)
        is_delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        ratio = dr.minimum(dr.select(is_delta, 0.0, ratio * reverse * cosine_out / sampled.pdf), _LARGEST_RATIO)
        factor = 1.0 / sampled.pdf
        if not one.all_drawn:
            factor = dr.select(material < 0, bsdf_weight[0], factor)
        follower = _Walk(
            walk.lane,
            walk.pixel,
            ray.o,
            ray.d,
            walk.weight * factor,
            ratio,
            length,
            walk.code,
            [*walk.surfaces, one.kept(surface, material, toward_camera, sampled.wo)],
        )
    return _split(walk, lit, record, goes_on, follower)


def photon_paths(
    scene: Scene, rays: CameraRays, projector: Projector, pose: Transform, roi: Roi, tracing: Tracing
) -> Iterator[Candidates]:
    """Yield the records of photons that reach the region ``roi`` of a camera."""
    one = _Tracer(scene, rays, projector, pose, roi, tracing)
    for first in range(0, tracing.photons, _AT_ONCE):
        walk: _Walk | None = _photon_start(one, first, min(_AT_ONCE, tracing.photons - first))
        for number in range(1, tracing.depth + 1):
            if walk is None:
                break
            walk, record = _photon_step(one, walk, number)
            if record is not None:
                yield record


def _photon_start(one: _Tracer, first: int, count: int) -> _Walk:
    lane = dr.arange(mi.UInt32, count) + opaque_index(first)
    side = opaque_index(round(np.sqrt(one.tracing.photons)))
    in_cell = one.random(lane + opaque_index(_PHOTONS_FROM), 0)
    point = (mi.Point2f(lane % side, lane // side) + in_cell) / mi.Float(side)
    lens = one.disc(lane + opaque_index(_PHOTONS_FROM), 1) if one.projector.has_aperture else None
    origin, direction, flux, uv = one.projector.emit_photon(point, lens)
    walk = _Walk(
        lane,
        lane,
        mi.Point3f(origin + dr.zeros(mi.Point3f, count)),
        direction,
        flux / opaque(one.tracing.photons),
        dr.ones(mi.Float, count),
        dr.zeros(mi.Float, count),
        uv,
    )
    return walk.at(dr.compress(flux > 0))


def _photon_step(one: _Tracer, walk: _Walk, number: int) -> tuple[_Walk | None, Candidates | None]:
    """Meet surface ``number`` of each photon: return the photons that go on, and records of those the camera sees."""
    tracing, context, camera, rays = one.tracing, mi.BSDFContext(), one.camera, one.rays
    chance = walk.lane + opaque_index(_PHOTONS_FROM)
    surface = one.scene.mitsuba.ray_intersect(mi.Ray3f(walk.origin, walk.direction))
    hit = surface.is_valid()
    length = walk.length + dr.select(hit, surface.t, 0.0)
    bsdf, material = one.bsdfs.at(surface), one.material(surface, hit)
    toward_projector = mi.Vector3f(surface.wi)
    cosine_in = dr.maximum(dr.abs(dr.dot(surface.n, walk.direction)), 1e-9)
    ratio = walk.ratio
    if number == 1:
        ratio = one.samples_per_photon / one.projector.density(-walk.direction, surface.t)
    ratio = ratio / cosine_in
    lit, record = mi.Bool(False), None
    if number > 1:
        lens_point = camera.position
        if one.has_aperture:
            in_lens = one.disc(chance, 4 * number) * one.aperture
            lens_point = lens_point + camera.axes[0] * in_lens.x + camera.axes[1] * in_lens.y
        to_camera = lens_point - surface.p
        distance = dr.norm(to_camera)
        toward = to_camera / distance
        local = camera.to_local(-toward)
        in_front = hit & (local.z > 0)
        cosine = dr.select(in_front, local.z, 1.0)
        x, y = local.x / cosine, local.y / cosine
        if one.has_aperture:
            x += in_lens.x * one.inverse_focus
            y += in_lens.y * one.inverse_focus
        u, v, seen = rays.distortion.image(x, y, in_front)
        column, row = mi.UInt32(dr.select(seen, u + 0.5, 0.0)), mi.UInt32(dr.select(seen, v + 0.5, 0.0))
        left, top, width, height = (opaque_index(n) for n in (one.roi.left, one.roi.top, one.roi.width, one.roi.height))
        seen &= (column - left < width) & (row - top < height)  # unsigned: differences below 0 become very large
        seen &= ~one.scene.mitsuba.ray_test(shadow_ray(surface, toward, distance), seen)
        toward_camera = surface.to_local(toward)
        value, density = _value_and_density(bsdf, surface, toward_projector, toward_camera, seen, camera=True)
        importance = dr.abs(dr.dot(surface.n, toward)) / (
            pixel_area(*rays.corners(column, row)) * dr.square(cosine) * cosine * dr.square(distance)
        )
        lit = seen & (value > 0)
        weight = walk.weight * one.factor(material, value) * importance / cosine_in
        weight /= 1.0 + ratio * density * importance
        walk.pixel = (row - top) * width + column - left
        record = weight, walk.code, length + distance, *one.kept(surface, material, toward_camera, toward_projector)
    goes_on = mi.Bool(False)
    follower = None
    if number < tracing.depth:
        even1, even2 = one.random(chance, 4 * number + 1).x, one.random(chance, 4 * number + 2)
        if number == 1:
            side = opaque_index(round(np.sqrt(tracing.photons)))
            even1, even2 = r3_point(z_order(walk.lane % side, walk.lane // side), one.seed, 1)
        sampled, _ = bsdf.sample(context, surface, even1, even2, hit)
        goes_on = hit & (sampled.pdf > 0) & ~mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        outgoing = surface.to_world(sampled.wo)
        if number == 1:  # as at the end of a camera path: the projector must be on the side that is seen
            goes_on &= dr.dot(surface.n, -walk.direction) * dr.dot(surface.n, outgoing) > 0
        value, density = _value_and_density(bsdf, surface, toward_projector, sampled.wo, goes_on, camera=True)
        goes_on &= value > 0
        cosine_out = dr.maximum(dr.abs(dr.dot(surface.n, outgoing)), 1e-9)
        ratio = ratio * (1.0 if number == 1 else density) * cosine_out / sampled.pdf
        ray = surface.spawn_ray(outgoing)
        follower = _Walk(
            walk.lane,
            walk.pixel,
            ray.o,
            ray.d,
            walk.weight * one.factor(material, value) * cosine_out / (sampled.pdf * cosine_in),
            ratio,
            length,
            walk.code,
            [*walk.surfaces, one.kept(surface, material, sampled.wo, toward_projector)],
        )
    return _split(walk, lit, record, goes_on, follower)


def _split(
    walk: _Walk, lit: Any, record: Any, goes_on: Any, follower: _Walk | None
) -> tuple[_Walk | None, Candidates | None]:
    """Compress the lanes that go on, and those that are lit."""
    followers = [] if follower is None else _arrays(follower)
    dr.eval(lit, goes_on, record, walk.pixel, walk.surfaces, followers)
    candidates = None
    if record is not None:
        index = dr.compress(lit & (record[0] > 0))
        if len(index):
            candidates = _candidates(walk, record, index)
    if follower is None:
        return None, candidates
    index = dr.compress(goes_on)
    if not len(index):
        return None, candidates
    return follower.at(index), candidates


def _arrays(walk: _Walk) -> list[Any]:
    return [walk.lane, walk.pixel, walk.origin, walk.direction, walk.weight, walk.ratio, walk.length, walk.surfaces]


def _candidates(walk: _Walk, record: Any, index: Any) -> Candidates:
    weight, uv, length, *last = record

    def some(value: Any) -> Any:
        return dr.gather(type(value), value, index)

    surfaces = [*walk.surfaces, last]
    code = np.stack([np.asarray(some(one)) for one in (uv.x, uv.y, length)], axis=-1)
    material = np.stack([np.asarray(some(one[0])).astype(np.int8) for one in surfaces], axis=-1)
    toward = np.stack(
        [np.concatenate([vectors_to_host(some(one[1])), vectors_to_host(some(one[2]))], axis=1) for one in surfaces],
        axis=1,
    )
    return Candidates(
        np.asarray(some(walk.pixel)).astype(np.int32), np.asarray(some(weight), np.float32), code, material, toward
    )


def _place(pixel: Any, roi: Roi) -> tuple[Any, Any]:
    """Return column and row in the whole image."""
    width = opaque_index(roi.width)
    return pixel % width + opaque_index(roi.left), pixel // width + opaque_index(roi.top)


def _value_and_density(
    bsdf: Any, surface: Any, toward_projector: Any, toward_camera: Any, active: Any, camera: bool = False
) -> tuple[Any, Any]:
    """Return the BSDF times cosine, and a density: of a camera path to the projector (``camera``), or of a photon."""
    view = mi.SurfaceInteraction3f(surface)
    view.wi = toward_camera
    if camera:
        value, density = bsdf.eval_pdf(mi.BSDFContext(), view, toward_projector, active)
        return value[0], density
    value = bsdf.eval(mi.BSDFContext(), view, toward_projector, active)
    view.wi = toward_projector
    return value[0], bsdf.pdf(mi.BSDFContext(), view, toward_camera, active)


def _density_to_camera(bsdf: Any, surface: Any, toward_projector: Any, active: Any) -> Any:
    view = mi.SurfaceInteraction3f(surface)
    view.wi = toward_projector
    return bsdf.pdf(mi.BSDFContext(), view, surface.wi, active)
