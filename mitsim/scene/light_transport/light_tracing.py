"""Interreflections followed from the projector: the half of the light that paths from the camera find badly.

Signal chain: a place in the projector's image and in its aperture -> ray -> surface -> a direction of its BSDF ->
surface, ... -> a place in the camera's lens, if nothing is in between -> pixel -> a record (pixel, radiance, (u, v), L)
-> one accumulator per image.

A path from the camera that leaves a surface by its wide-angle lobe and meets a polished face lights up only if it is in
that face's narrow lobe, which is rare and then very bright. From the projector the same path is easy: the narrow lobe
is sampled, and the wide one connects to the camera. Both ways are taken, and every path is weighed by the balance
heuristic (Veach & Guibas, SIGGRAPH 1995; Veach, thesis 1997, ch. 9 and 10) with the two densities in which n surfaces
x_1 (at the camera) ... x_n (at the lamp) are found,

    n_L p_L   n_L   p_lamp(x_n)          pr_{i+1} cos_i
    ------- = --- * ----------- * prod   --------------    over i = 1 ... n - 1,
    n_C p_C   n_C   p_cam(x_1)           pf_i cos_{i+1}

where pf_i is the density, per solid angle, of leaving x_i for x_{i+1}, pr_{i+1} that of leaving x_{i+1} for x_i, cos_i
the cosine at x_i of the way between them, p_lamp and p_cam densities per area, and n_C, n_L the samples of a pixel and
all photons. Places in apertures are uniform in both and drop out. Direct light (n = 1) comes from the camera alone.

At every surface f and its cosine are evaluated as the camera's paths do it, light coming in at the lamp's side; so the
two agree on meshes with vertex normals, and on BSDFs that are black behind, whatever the direction of travel (the
correction of Veach's section 5.3 is in it). A delta lobe ends a photon: such paths are left to the camera.

Photons write records, which are added up in their order in double precision: same seed, same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport.low_discrepancy import evenly, z_order
from mitsim.scene.light_transport.projector_light import Light, ProjectorLight
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays, pixel_area
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.sensor.roi import Roi
from mitsim.sensor.transforms import Transform

#: photons in one launch; each takes 24 bytes for every surface after its first
LARGEST_LAUNCH = 1 << 21

#: pixels whose images are put together at once
_AT_ONCE = 1 << 18

#: random streams from here on are the photons'; below are those of the pixels
_FIRST_STREAM = 1 << 40


@dataclass(frozen=True)
class Photons:
    """The photons that a projector sends: ``count`` of them, a square number, to at most ``depth`` surfaces each.

    ``seed`` of their directions; ``samples`` that the camera takes per pixel, with which the photons share the light,
    None if they are alone.
    """

    count: int
    depth: int
    seed: int
    samples: int | None = None


def add_photons(
    images: NDArray[np.float32],
    scene: Scene,
    rays: CameraRays,
    light: Light,
    world_from_sensor: Transform,
    photons: Photons,
    roi: Roi,
) -> None:
    """Add to ``images`` what photons bring of light that has met 2 to ``photons.depth`` surfaces.

    Parameters
    ----------
    images
        (P, height, width) of the region [W / (mm^2 sr)]. Photons do not depend on the region: each pixel gets the same
        light as in the whole image.
    """
    sums = np.zeros((light.codes, roi.height * roi.width))
    for first in range(0, photons.count, LARGEST_LAUNCH):
        some = range(first, min(first + LARGEST_LAUNCH, photons.count))
        pixel, radiance, uv, length = _launch(scene, rays, light, world_from_sensor, photons, some, roi)
        if not len(pixel):
            continue
        values = light.values(uv, length, mi.Bool(True))
        dr.eval(values)
        for total, value in zip(sums, values, strict=True):
            total += np.bincount(pixel, radiance * np.asarray(value), total.size)
    sums /= photons.count
    flat = images.reshape(len(images), -1)
    for first in range(0, flat.shape[1], _AT_ONCE):  # all pixels at once would take twice what the images take
        part = slice(first, first + _AT_ONCE)
        for image, total in zip(flat, light.images([one[part] for one in sums]), strict=True):
            image[part] += total.astype(np.float32)


def _launch(
    scene: Scene,
    rays: CameraRays,
    light: Light,
    world_from_sensor: Transform,
    photons: Photons,
    some: range,
    roi: Roi,
) -> tuple[NDArray[np.int32], NDArray[np.float64], Any, Any]:
    """Follow ``some`` of the photons to a region; return in their order its pixels, radiance, (u, v), L."""
    first, count, depth, seed = some.start, len(some), photons.depth, photons.seed
    camera = Eye(world_from_sensor @ rays.camera.sensor_from_camera)
    lamp = ProjectorLight(world_from_sensor, light.projector, scene.bounds)
    aperture, inverse_focus = 0.5 * rays.aperture_mm, 1.0 / rays.focus_mm
    # of the camera's samples of one pixel per photon; none if the photons are alone
    rival = dr.opaque(mi.Float, 0.0 if photons.samples is None else photons.samples / photons.count)

    index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    streams = mi.UInt64(index) + _FIRST_STREAM
    random = mi.PCG32(initstate=dr.opaque(mi.UInt64, seed), initseq=streams)
    side = dr.opaque(mi.UInt32, round(np.sqrt(photons.count)))
    shuffle, order = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), z_order(index % side, index // side)
    place = mi.Point2f(index % side, index // side)
    place = (place + mi.Point2f(random.next_float32(), random.next_float32())) / mi.Float(side)
    lens = _in_disc(random) if lamp.radius > 0 else None
    origin, direction, flux, uv = lamp.send(place, lens)

    records = depth - 1
    pixels, radiances = dr.zeros(mi.UInt32, count * records), dr.zeros(mi.Float, count * records)
    lengths = dr.zeros(mi.Float, count * records)
    slot = dr.arange(mi.UInt32, count) * records
    sent = _Flight(
        active=flux > 0,
        bounce=mi.UInt32(dr.zeros(mi.UInt32, count)),
        origin=mi.Point3f(origin + dr.zeros(mi.Point3f, count)),
        direction=direction,
        weight=mi.Float(flux),
        odds=dr.zeros(mi.Float, count),
        length=dr.zeros(mi.Float, count),
        random=random,
    )

    def running(flight: _Flight) -> Any:
        return flight.active

    def step(flight: _Flight) -> tuple[_Flight]:
        active, bounce, origin, direction = flight.active, flight.bounce, flight.origin, flight.direction
        weight, odds, length, random = flight.weight, flight.odds, flight.length, flight.random
        # odds: n_C p_C over n_L p_L of the surfaces so far, but for what the next direction will tell
        fresh = bounce == 0
        surface = scene.mitsuba.ray_intersect(mi.Ray3f(origin, direction), active)
        hit = active & surface.is_valid()
        length = length + dr.select(hit, surface.t, 0.0)
        bsdf, context = surface.bsdf(), mi.BSDFContext()
        lampward = mi.Vector3f(surface.wi)
        inward = dr.maximum(dr.abs(dr.dot(surface.n, direction)), 1e-9)
        odds = dr.select(fresh, rival / lamp.density(-direction, surface.t), odds) / inward

        # to the camera
        middle = camera.position
        if aperture > 0:
            place = _in_disc(random) * aperture
            middle = middle + camera.axes[0] * place.x + camera.axes[1] * place.y
        to_camera = middle - surface.p
        distance = dr.norm(to_camera)
        toward = to_camera / distance
        local = camera.local(-toward)
        ahead = hit & ~fresh & (local.z > 0)
        cosine = dr.select(ahead, local.z, 1.0)
        x, y = local.x / cosine, local.y / cosine
        if aperture > 0:
            x += place.x * inverse_focus
            y += place.y * inverse_focus
        column, row, seen = rays.bend.image(x, y, ahead)
        column, row = mi.UInt32(dr.select(seen, column + 0.5, 0.0)), mi.UInt32(dr.select(seen, row + 0.5, 0.0))
        seen &= ~scene.mitsuba.ray_test(shadow_ray(surface, toward, distance), seen)
        reflected, onward = _toward_lamp(bsdf, surface, surface.to_local(toward), lampward, seen)
        # mean over the pixel's area on the plane z = 1, as a density on the surface [1/mm^2]
        importance = dr.abs(dr.dot(surface.n, toward)) / (
            pixel_area(*rays.corners(column, row)) * dr.square(cosine) * cosine * dr.square(distance)
        )
        share = 1.0 / (1.0 + odds * onward * importance)
        radiance = weight * reflected * importance / inward * share
        lit = seen & (radiance > 0)
        target = slot + bounce - 1
        dr.scatter(pixels, row * rays.camera.width + column, target, lit)
        dr.scatter(radiances, radiance, target, lit)
        dr.scatter(lengths, length + distance, target, lit)

        # onward
        pick, pair = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        first, where = evenly(order, shuffle, 1)
        pick, pair = dr.select(fresh, first, pick), dr.select(fresh, where, pair)
        alive = hit & (bounce + 1 < depth)
        further, _ = bsdf.sample(context, surface, pick, pair, alive)
        alive &= (further.pdf > 0) & ~mi.has_flag(further.sampled_type, mi.BSDFFlags.Delta)
        away = surface.to_world(further.wo)
        # as at the end of a camera's path: the lamp must be on the side that is seen
        alive &= ~fresh | (dr.dot(surface.n, -direction) * dr.dot(surface.n, away) > 0)
        reflected, onward = _toward_lamp(bsdf, surface, further.wo, lampward, alive)
        alive &= reflected > 0
        outward = dr.maximum(dr.abs(dr.dot(surface.n, away)), 1e-9)
        weight = weight * reflected * outward / (further.pdf * inward)
        odds = odds * dr.select(fresh, 1.0, onward) * outward / further.pdf
        ray = surface.spawn_ray(away)
        return (_Flight(alive, bounce + 1, ray.o, ray.d, weight, odds, length, random),)

    dr.while_loop((sent,), running, step, labels=("flight",), label="photons")
    dr.eval(pixels, radiances, lengths, uv)
    left, top, width, height = (dr.opaque(mi.UInt32, n) for n in (roi.left, roi.top, roi.width, roi.height))
    column, row = pixels % rays.camera.width - left, pixels // rays.camera.width - top
    inside = (column < width) & (row < height)  # unsigned: pixels before the region become very large
    kept = dr.compress((radiances > 0) & inside)
    if not len(kept):
        return np.empty(0, np.int32), np.empty(0), uv, lengths
    place = mi.Int32(dr.gather(mi.UInt32, row * width + column, kept))
    radiance, length = dr.gather(mi.Float, radiances, kept), dr.gather(mi.Float, lengths, kept)
    uv = dr.gather(mi.Point2f, uv, kept // records)
    dr.eval(place, radiance, length, uv)
    return np.asarray(place), np.asarray(radiance, np.float64), uv, length


@dataclass
class _Flight:
    """State of the photons of one launch, a lane each, as Dr.Jit's loop carries it.

    ``active`` until a photon ends; ``bounce`` it is at; ``origin`` and ``direction`` of the next ray; ``weight`` of its
    light; ``odds`` of paths of the camera against photons; optical ``length`` so far; ``random`` numbers.
    """

    active: Any
    bounce: Any
    origin: Any
    direction: Any
    weight: Any
    odds: Any
    length: Any
    random: Any


def _toward_lamp(bsdf: Any, surface: Any, outgoing: Any, lampward: Any, active: Any) -> tuple[Any, Any]:
    """BSDF times cosine, and the density with which a camera path from ``outgoing`` goes on toward the lamp.

    Directions in the local frame.
    """
    view = mi.SurfaceInteraction3f(surface)
    view.wi = outgoing
    reflected, density = bsdf.eval_pdf(mi.BSDFContext(), view, lampward, active)
    return reflected[0], density


def _in_disc(random: Any) -> Any:
    return mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random.next_float32(), random.next_float32()))
