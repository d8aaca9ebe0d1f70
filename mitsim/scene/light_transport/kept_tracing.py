"""Trace the candidates of :mod:`mitsim.scene.light_transport.kept_paths`: interreflections as records of whole paths.

Signal chain: pixels that see the part -> camera rays -> surface after surface, each with a connection to the projector;
and photons from the projector, each surface with a connection to the camera -> records.

Sampling, connections and weights are those of :mod:`mitsim.scene.light_transport.path_loop` and
:mod:`mitsim.scene.light_transport.light_tracing`, but a record keeps the directions at each surface in place of the
values of its BSDFs. All lanes take one step together; those that go on are compressed in their order. The same seed
gives the same records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, opaque_index
from mitsim.scene.light_transport.kept_paths import CandidatePaths
from mitsim.scene.light_transport.kept_walks import (
    Tracer,
    Walk,
    density_to_camera,
    place_of,
    split_walk,
    value_and_density,
)
from mitsim.scene.light_transport.low_discrepancy import r3_point, z_order
from mitsim.scene.ray_casting.camera_rays import bilinear, pixel_area
from mitsim.scene.ray_casting.eye import shadow_ray

#: number of paths that are traced together
_AT_ONCE = 1 << 21

#: largest ratio of densities, so that it stays finite
_LARGEST_RATIO = 1e30

#: first index of the random numbers of photons; those below are for camera paths
_PHOTONS_FROM = 1 << 31


def camera_paths(tracer: Tracer, pixels: NDArray[np.integer]) -> Iterator[CandidatePaths]:
    """Yield the records of camera paths, which begin through pixels (n,) by their indices in the region."""
    tracing = tracer.tracing
    index = mi.UInt32(np.asarray(pixels, np.uint32))
    at_once = max(1, _AT_ONCE // max(1, len(pixels)))
    for first in range(0, tracing.samples, at_once):
        count = min(at_once, tracing.samples - first)
        yield from _records(tracer, _camera_start(tracer, index, first, count), _camera_step)


def _records(
    tracer: Tracer, walk: Walk | None, step: Callable[[Tracer, Walk, int], tuple[Walk | None, CandidatePaths | None]]
) -> Iterator[CandidatePaths]:
    """Yield the records of paths from surface to surface; none start where the projector emits nothing."""
    for number in range(1, tracer.tracing.depth + 1):
        if walk is None or not dr.width(walk.lane):
            return
        walk, record = step(tracer, walk, number)
        if record is not None:
            yield record


def _camera_start(tracer: Tracer, pixels: Any, first: int, count: int) -> Walk:
    rays, tracing = tracer.rays, tracer.tracing
    lanes = dr.arange(mi.UInt32, dr.width(pixels) * count)
    in_row = opaque_index(dr.width(pixels))
    sample = lanes // in_row + opaque_index(first)
    pixel = dr.gather(mi.UInt32, pixels, lanes % in_row)
    column, row = place_of(pixel, tracer.roi)
    x, y = rays.corners(column, row)
    lane = pixel * opaque_index(tracing.samples) + sample
    side = opaque_index(round(np.sqrt(tracing.samples)))
    inside = tracer.random(lane, 0)
    per_cell = 1.0 / mi.Float(side)
    a, b = (mi.Float(sample % side) + inside.x) * per_cell, (mi.Float(sample // side) + inside.y) * per_cell
    local = mi.Vector3f(bilinear(x, a, b), bilinear(y, a, b), 1.0)
    origin = tracer.camera.position
    if tracer.has_aperture:
        in_lens = tracer.disc(lane, 1) * tracer.aperture
        origin = origin + tracer.camera.axes[0] * in_lens.x + tracer.camera.axes[1] * in_lens.y
        local -= mi.Vector3f(in_lens.x, in_lens.y, 0.0) * tracer.inverse_focus
    width = len(lanes)
    return Walk(
        lane,
        pixel,
        mi.Point3f(origin + dr.zeros(mi.Point3f, width)),
        tracer.camera.to_world(dr.normalize(local)),
        dr.ones(mi.Float, width),
        pixel_area(x, y),  # until the first surface
        dr.zeros(mi.Float, width),
        dr.zeros(mi.Point2f, width),
    )


def _camera_step(tracer: Tracer, walk: Walk, number: int) -> tuple[Walk | None, CandidatePaths | None]:
    """Meet surface ``number`` of each path: return the paths that go on, and the records of those that are lit."""
    tracing, context = tracer.tracing, mi.BSDFContext()
    surface = tracer.scene.mitsuba.ray_intersect(mi.Ray3f(walk.origin, walk.direction))
    hit = surface.is_valid()
    length = walk.length + dr.select(hit, surface.t, 0.0)
    bsdf, material = tracer.bsdfs.at(surface), tracer.material(surface, hit)
    toward_camera = mi.Vector3f(surface.wi)
    cosine_in = dr.maximum(dr.abs(dr.dot(surface.n, walk.direction)), 1e-9)
    if number == 1:
        cosine = dr.dot(walk.direction, tracer.camera.axes[2])
        footprint = tracer.photons_per_sample * walk.ratio * dr.square(cosine) * cosine * dr.square(surface.t)
        ratio = footprint / cosine_in
    else:
        ratio = walk.ratio / cosine_in
    lit, record = mi.Bool(False), None
    if number > 1:
        lens = tracer.disc(walk.lane, 4 * number) if tracer.projector.has_aperture else None
        toward, irradiance, uv, distance = tracer.projector.light(
            tracer.scene.mitsuba, surface, walk.direction, lens, None, hit
        )
        toward_projector = surface.to_local(toward)
        value, density = value_and_density(bsdf, surface, toward_projector, toward_camera, hit & (irradiance > 0))
        density *= tracer.projector.density(toward, distance) * dr.abs(dr.dot(surface.n, toward))
        # the finish that was sampled with bounds all that may be drawn: what it does not reflect, none does
        lit = hit & (irradiance > 0) & (value > 0)
        weight = walk.weight * irradiance * tracer.factor(material, value) / (1.0 + ratio * density)
        weight *= opaque(1.0 / tracing.samples)
        record = weight, uv, length + distance, *tracer.kept(surface, material, toward_camera, toward_projector)
    goes_on = mi.Bool(False)
    follower = None
    if number < tracing.depth:
        even1, even2 = tracer.random(walk.lane, 4 * number + 1).x, tracer.random(walk.lane, 4 * number + 2)
        if number == 1:
            samples = opaque_index(tracing.samples)
            first = z_order(*place_of(walk.pixel, tracer.roi)) * samples
            even1, even2 = r3_point(first + walk.lane % samples, tracer.seed, 0)
        sampled, bsdf_weight = bsdf.sample(context, surface, even1, even2, hit)
        goes_on = hit & (bsdf_weight[0] > 0)
        ray = surface.spawn_ray(surface.to_world(sampled.wo))
        cosine_out = dr.abs(dr.dot(surface.n, ray.d))
        reverse = mi.Float(1.0)
        if number > 1:
            reverse = density_to_camera(bsdf, surface, sampled.wo, goes_on)
        is_delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        ratio = dr.minimum(dr.select(is_delta, 0.0, ratio * reverse * cosine_out / sampled.pdf), _LARGEST_RATIO)
        factor = 1.0 / sampled.pdf
        if not tracer.all_drawn:
            factor = dr.select(material < 0, bsdf_weight[0], factor)
        follower = Walk(
            walk.lane,
            walk.pixel,
            ray.o,
            ray.d,
            walk.weight * factor,
            ratio,
            length,
            walk.code,
            [*walk.surfaces, tracer.kept(surface, material, toward_camera, sampled.wo)],
        )
    return split_walk(walk, lit, record, goes_on, follower)


def photon_paths(tracer: Tracer) -> Iterator[CandidatePaths]:
    """Yield the records of photons that reach the region: the other paths of the same light."""
    tracing = tracer.tracing
    for first in range(0, tracing.photons, _AT_ONCE):
        yield from _records(tracer, _photon_start(tracer, first, min(_AT_ONCE, tracing.photons - first)), _photon_step)


def _photon_start(tracer: Tracer, first: int, count: int) -> Walk:
    lane = dr.arange(mi.UInt32, count) + opaque_index(first)
    side = opaque_index(round(np.sqrt(tracer.tracing.photons)))
    in_cell = tracer.random(lane + opaque_index(_PHOTONS_FROM), 0)
    point = (mi.Point2f(lane % side, lane // side) + in_cell) / mi.Float(side)
    lens = tracer.disc(lane + opaque_index(_PHOTONS_FROM), 1) if tracer.projector.has_aperture else None
    origin, direction, flux, uv = tracer.projector.emit_photon(point, lens)
    walk = Walk(
        lane,
        lane,
        mi.Point3f(origin + dr.zeros(mi.Point3f, count)),
        direction,
        flux / opaque(tracer.tracing.photons),
        dr.ones(mi.Float, count),
        dr.zeros(mi.Float, count),
        uv,
    )
    return walk.at(dr.compress(flux > 0))


def _photon_step(tracer: Tracer, walk: Walk, number: int) -> tuple[Walk | None, CandidatePaths | None]:
    """Meet surface ``number`` of each photon: return the photons that go on, and records of those the camera sees."""
    tracing, context, camera, rays = tracer.tracing, mi.BSDFContext(), tracer.camera, tracer.rays
    chance = walk.lane + opaque_index(_PHOTONS_FROM)
    surface = tracer.scene.mitsuba.ray_intersect(mi.Ray3f(walk.origin, walk.direction))
    hit = surface.is_valid()
    length = walk.length + dr.select(hit, surface.t, 0.0)
    bsdf, material = tracer.bsdfs.at(surface), tracer.material(surface, hit)
    toward_projector = mi.Vector3f(surface.wi)
    cosine_in = dr.maximum(dr.abs(dr.dot(surface.n, walk.direction)), 1e-9)
    ratio = walk.ratio
    if number == 1:
        ratio = tracer.samples_per_photon / tracer.projector.density(-walk.direction, surface.t)
    ratio = ratio / cosine_in
    lit, record = mi.Bool(False), None
    if number > 1:
        lens_point = camera.position
        if tracer.has_aperture:
            in_lens = tracer.disc(chance, 4 * number) * tracer.aperture
            lens_point = lens_point + camera.axes[0] * in_lens.x + camera.axes[1] * in_lens.y
        to_camera = lens_point - surface.p
        distance = dr.norm(to_camera)
        toward = to_camera / distance
        local = camera.to_local(-toward)
        in_front = hit & (local.z > 0)
        cosine = dr.select(in_front, local.z, 1.0)
        x, y = local.x / cosine, local.y / cosine
        if tracer.has_aperture:
            x += in_lens.x * tracer.inverse_focus
            y += in_lens.y * tracer.inverse_focus
        u, v, seen = rays.distortion.image(x, y, in_front)
        column, row = mi.UInt32(dr.select(seen, u + 0.5, 0.0)), mi.UInt32(dr.select(seen, v + 0.5, 0.0))
        left, top, width, height = (
            opaque_index(n) for n in (tracer.roi.left, tracer.roi.top, tracer.roi.width, tracer.roi.height)
        )
        seen &= (column - left < width) & (row - top < height)  # unsigned: differences below 0 become very large
        seen &= ~tracer.scene.mitsuba.ray_test(shadow_ray(surface, toward, distance), seen)
        toward_camera = surface.to_local(toward)
        value, density = value_and_density(bsdf, surface, toward_projector, toward_camera, seen, camera=True)
        importance = dr.abs(dr.dot(surface.n, toward)) / (
            pixel_area(*rays.corners(column, row)) * dr.square(cosine) * cosine * dr.square(distance)
        )
        lit = seen & (value > 0)
        weight = walk.weight * tracer.factor(material, value) * importance / cosine_in
        weight /= 1.0 + ratio * density * importance
        walk.pixel = (row - top) * width + column - left
        record = weight, walk.code, length + distance, *tracer.kept(surface, material, toward_camera, toward_projector)
    goes_on = mi.Bool(False)
    follower = None
    if number < tracing.depth:
        even1, even2 = tracer.random(chance, 4 * number + 1).x, tracer.random(chance, 4 * number + 2)
        if number == 1:
            side = opaque_index(round(np.sqrt(tracing.photons)))
            even1, even2 = r3_point(z_order(walk.lane % side, walk.lane // side), tracer.seed, 1)
        sampled, _ = bsdf.sample(context, surface, even1, even2, hit)
        goes_on = hit & (sampled.pdf > 0) & ~mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        outgoing = surface.to_world(sampled.wo)
        if number == 1:  # as at the end of a camera path: the projector must be on the side that is seen
            goes_on &= dr.dot(surface.n, -walk.direction) * dr.dot(surface.n, outgoing) > 0
        value, density = value_and_density(bsdf, surface, toward_projector, sampled.wo, goes_on, camera=True)
        goes_on &= value > 0
        cosine_out = dr.maximum(dr.abs(dr.dot(surface.n, outgoing)), 1e-9)
        ratio = ratio * (1.0 if number == 1 else density) * cosine_out / sampled.pdf
        ray = surface.spawn_ray(outgoing)
        follower = Walk(
            walk.lane,
            walk.pixel,
            ray.o,
            ray.d,
            walk.weight * tracer.factor(material, value) * cosine_out / (sampled.pdf * cosine_in),
            ratio,
            length,
            walk.code,
            [*walk.surfaces, tracer.kept(surface, material, sampled.wo, toward_projector)],
        )
    return split_walk(walk, lit, record, goes_on, follower)
