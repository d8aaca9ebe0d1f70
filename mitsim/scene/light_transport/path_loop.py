"""Trace the light paths of all pixels of a region, in one kernel.

Signal chain, for each pixel and sample: position in the pixel and in the lens -> camera ray -> surface -> position in
the projector's aperture, and coordinate (u, v) whose light arrives from there, if nothing blocks it -> BSDF -> radiance
per unit of code value, optical length L -> one sum per code.

The kernel has one lane per pixel and contains the loop over samples. It needs no film and no atomic additions. Later
bounces use the same loop: a lane whose path has ended starts its next sample.

Direct light from the projector is free of noise, which could be mistaken for the sensor's. The positions inside a pixel
form a raster, and those in the two apertures are a fixed set. The remaining error is that of a quadrature rule, the
same in every capture of a pose.

Light from the emitters that the author of a scene added (lamps, windows, a sky) is the same in all images of a capture,
whatever the projector shows. Two methods estimate it: sampling an emitter, and following the BSDF until it meets one.
The balance heuristic (Veach and Guibas, SIGGRAPH 1995) weights them. Without it, either a small lamp over a matt face
or a large window in a glossy one would be noisy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, opaque_index, to_device
from mitsim.scene.light_transport.aperture_samples import aperture_samples
from mitsim.scene.light_transport.kept_walks import density_to_camera
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.low_discrepancy import r3_point, z_order
from mitsim.scene.light_transport.plain_scene import (
    SceneBsdfs,
    has_emitters,
    intersect_plane,
    single_bsdf,
    single_plane,
)
from mitsim.scene.light_transport.projected_codes import ProjectedLight
from mitsim.scene.light_transport.projector_light import ProjectorLight
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.camera_rays import CameraRays, bilinear, pixel_area
from mitsim.scene.ray_casting.eye import Eye
from mitsim.sensor.transforms import Transform

#: in place of a density, of a ray whose direction no other estimate finds: from the camera, or mirrored
_ALONE = -1.0

#: largest ratio of densities, so that it stays finite
_LARGEST_RATIO = 1e30


def launch(
    scene: Scene,
    rays: CameraRays,
    light: ProjectedLight,
    poses: Sequence[Transform],
    paths: LightPaths,
    roi: Roi,
    shift: NDArray[np.floating] | None,
) -> list[Any]:
    """Return all images of a region, and the ambient one, as arrays on the device, pose after pose; one kernel.

    ``scene``, ``rays``, ``light``, ``poses``, ``paths``: the scene, the camera's rays, the projector's light, the poses
    of the sensor, and the light paths. ``roi``, ``shift``: the region, and the displacement (2, height, width) [rad] of
    its codes, as for :func:`~mitsim.scene.light_transport.transport.trace`.
    """
    side, depth, seed, jitter = paths.side, paths.depth, paths.seed, paths.jitter
    photons = paths.photon_count(rays.camera.width * rays.camera.height)
    count = len(poses) * roi.width * roi.height
    index, lane = dr.arange(mi.UInt32, count), None
    if len(poses) > 1:
        pixels = opaque_index(roi.width * roi.height)
        lane, index = index // pixels, index % pixels
    camera = Eye([pose @ rays.camera.sensor_from_camera for pose in poses], lane)
    projector = ProjectorLight(poses, light.projector, bounds_of(scene.mitsuba), lane)

    width = opaque_index(roi.width)
    column = index % width + opaque_index(roi.left)
    row = index // width + opaque_index(roi.top)
    pixel = row * opaque_index(rays.camera.width) + column
    x, y = rays.corners(column, row)
    displacement = None if shift is None else _displacement(shift, camera, index)

    random = mi.PCG32(initstate=dr.opaque(mi.UInt64, seed), initseq=mi.UInt64(pixel))
    sequence_seed, z_index = opaque_index(seed & 0xFFFFFFFF), z_order(column, row)
    total = opaque_index(side * side)
    # the second moment of n midpoints in a row is too small by the factor 1 - 1/n^2. Stretched to the right moment they
    # integrate cubics exactly, and two of them are Gauss's rule
    stretch = opaque(1.0 if jitter or side == 1 else float(1.0 / np.sqrt(1.0 - side**-2)))
    cells, per_cell = opaque_index(side), opaque(1.0 / side)
    has_aperture = rays.aperture_mm > 0
    aperture, inverse_focus = (opaque(value) for value in (0.5 * rays.aperture_mm, 1.0 / rays.focus_mm))
    pupils = _Pupils(side * side if has_aperture or projector.has_aperture else 0, jitter)
    has_ambient = has_emitters(scene)
    # the ray from the last surface may meet an emitter of the scene
    surfaces, rays_at_most = (opaque_index(n) for n in (depth, depth + 1 if has_ambient else depth))
    plane, shared_bsdf = single_plane(scene), single_bsdf(scene)
    bsdfs = SceneBsdfs(scene) if shared_bsdf is None else None
    occluders = scene.mitsuba if plane is None else None
    photons_per_sample = opaque(photons / side**2)
    area = pixel_area(x, y)
    sums = [dr.zeros(mi.Float, count) for _ in range(light.codes + 1)]  # the last is ambient light
    initial = _PathState(
        sample=mi.UInt32(dr.zeros(mi.UInt32, count)),
        bounce=mi.UInt32(dr.zeros(mi.UInt32, count)),
        origin=dr.zeros(mi.Point3f, count),
        direction=dr.zeros(mi.Vector3f, count),
        weight=dr.ones(mi.Float, count),
        pdf=dr.ones(mi.Float, count),
        length=dr.zeros(mi.Float, count),
        ratio=dr.zeros(mi.Float, count),
        random=random,
        sums=sums,
    )

    def running(path: _PathState) -> Any:
        return path.sample < total

    def step(path: _PathState) -> tuple[_PathState]:
        sample, bounce, origin, direction = path.sample, path.bounce, path.origin, path.direction
        weight, pdf, length, ratio = path.weight, path.pdf, path.length, path.ratio
        random, sums = path.random, path.sums
        # a lane at bounce 0 starts a path in the next cell of its pixel's raster of side x side
        at_first = bounce == 0
        cell_row = mi.UInt32((mi.Float(sample) + 0.5) * per_cell)  # an integer division is slow, and this one is exact
        cell_column = sample - cell_row * cells
        a = 0.5 + stretch * ((mi.Float(cell_column) + (random.next_float32() if jitter else 0.5)) * per_cell - 0.5)
        b = 0.5 + stretch * ((mi.Float(cell_row) + (random.next_float32() if jitter else 0.5)) * per_cell - 0.5)
        local = mi.Vector3f(bilinear(x, a, b), bilinear(y, a, b), 1.0)
        start = camera.position
        if has_aperture:
            in_lens = pupils.position(0, sample, random) * aperture
            start = start + camera.axes[0] * in_lens.x + camera.axes[1] * in_lens.y
            local -= mi.Vector3f(in_lens.x, in_lens.y, 0.0) * inverse_focus
        origin = dr.select(at_first, start, origin)
        direction = dr.select(at_first, camera.to_world(dr.normalize(local)), direction)
        weight = dr.select(at_first, 1.0, weight)

        ray = mi.Ray3f(origin, direction)
        surface = scene.mitsuba.ray_intersect(ray) if plane is None else intersect_plane(plane, ray)
        if has_ambient:
            ambient = weight * _hit_emitter_light(scene, surface, origin, dr.select(at_first, _ALONE, pdf))
            if paths.indirect_only:  # an emitter behind the first surface is its direct light
                ambient = dr.select(bounce > 1, ambient, 0.0)
        hit = surface.is_valid() & (bounce < surfaces)
        length = dr.select(at_first, 0.0, length) + dr.select(hit, surface.t, 0.0)
        context = mi.BSDFContext()
        bsdf: Any = shared_bsdf if bsdfs is None else bsdfs.at(surface)
        contributes = hit & ~at_first if paths.indirect_only else hit

        lens = pupils.position(1, sample, random) if projector.has_aperture else None
        shift_mm = None if displacement is None else displacement * dr.select(at_first, surface.t, 0.0)
        toward, irradiance, uv, distance = projector.light(occluders, surface, direction, lens, shift_mm, contributes)
        reflected = bsdf.eval(context, surface, surface.to_local(toward), contributes & (irradiance > 0))[0]
        radiance = weight * reflected * irradiance
        if photons:  # ratio: n_L p_L / (n_C p_C) of the surfaces so far
            cosine_in = dr.abs(dr.dot(surface.n, direction))
            cosine = dr.dot(direction, camera.axes[2])
            footprint = photons_per_sample * area * dr.square(cosine) * cosine * dr.square(surface.t)
            ratio = dr.select(at_first, footprint, ratio) / dr.maximum(cosine_in, 1e-9)
            reverse_density = density_to_camera(
                bsdf, surface, surface.to_local(toward), hit & ~at_first & (irradiance > 0)
            )
            reverse_density *= projector.density(toward, distance) * dr.abs(dr.dot(surface.n, toward))
            radiance *= dr.select(at_first, 1.0, 1.0 / (1.0 + ratio * reverse_density))
        values = light.values(uv, length + distance, contributes & (radiance > 0))
        added = [dr.select(radiance > 0, radiance * value, 0.0) for value in values]
        if has_ambient:
            ambient += dr.select(
                contributes, weight * _sampled_emitter_light(scene, surface, bsdf, random, contributes), 0.0
            )
        sums = [s + a for s, a in zip(sums, [*added, ambient if has_ambient else 0.0], strict=True)]

        if depth == 1 and not has_ambient:
            return (_PathState(sample + 1, bounce, origin, direction, weight, pdf, length, ratio, random, sums),)
        sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        if not jitter:  # most of the remaining error is that of the first bounce
            even1, even2 = r3_point(z_index * total + sample, sequence_seed, 0)
            sample1, sample2 = dr.select(at_first, even1, sample1), dr.select(at_first, even2, sample2)
        continues = hit & (bounce + 1 < rays_at_most)
        sampled, bsdf_weight = bsdf.sample(context, surface, sample1, sample2, continues)
        continues &= bsdf_weight[0] > 0
        is_delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        # no other estimate finds an emitter that a mirror shows
        direction_pdf = dr.select(is_delta, _ALONE, sampled.pdf) if has_ambient else sampled.pdf
        next_ray = surface.spawn_ray(surface.to_world(sampled.wo))
        if photons:  # photons end at a delta lobe
            reverse_density = dr.select(
                at_first, 1.0, density_to_camera(bsdf, surface, sampled.wo, continues & ~at_first)
            )
            ratio *= dr.select(is_delta, 0.0, reverse_density * dr.abs(dr.dot(surface.n, next_ray.d)) / sampled.pdf)
            ratio = dr.select(continues, dr.minimum(ratio, _LARGEST_RATIO), 0.0)
        next_path = _PathState(
            sample=dr.select(continues, sample, sample + 1),
            bounce=dr.select(continues, bounce + 1, 0),
            origin=dr.select(continues, next_ray.o, origin),
            direction=dr.select(continues, next_ray.d, direction),
            weight=dr.select(continues, weight * bsdf_weight[0], 1.0),
            pdf=direction_pdf,
            length=length,
            ratio=ratio,
            random=random,
            sums=sums,
        )
        return (next_path,)

    (final,) = dr.while_loop((initial,), running, step, labels=("path",), label="transport")
    sums = final.sums
    scale = opaque(1.0 / (side * side))
    *code_sums, ambient_sum = sums
    images = [(s + ambient_sum) * scale for s in light.images(code_sums)] + [ambient_sum * scale]
    dr.eval(images)  # all at once: one kernel for any number of images
    return images


@dataclass
class _PathState:
    """State of the light paths of one launch, one lane per pixel, in Dr.Jit's loop."""

    sample: Any  # index of the sample in its pixel
    bounce: Any  # number of surfaces met before
    origin: Any
    direction: Any
    weight: Any  # of the light of the next ray
    pdf: Any  # density of its direction [1/sr]; with emitters, _ALONE after a delta lobe
    length: Any  # optical length so far [mm]
    ratio: Any  # n_L p_L / (n_C p_C) so far, of photons over camera paths
    random: Any
    sums: Any  # light of each code, and of the emitters as the last


class _Pupils:
    """Positions in the unit discs of the lenses of camera and projector for each of ``count`` samples; 0: no lens."""

    def __init__(self, count: int, jitter: bool) -> None:
        self.jitter = jitter
        if jitter or not count:  # chosen positions take a fraction of a second to find
            return
        # one more entry than is read, as a table of one would be a number of the kernel
        padded = (np.pad(positions, ((0, 0), (0, 1))) for positions in aperture_samples(count))
        self.tables = [mi.Point2f(to_device(x), to_device(y)) for x, y in padded]

    def position(self, lens: int, sample: Any, random: Any) -> Any:
        """Return the position in the lens of the camera, 0, or the projector, 1."""
        if self.jitter:
            return mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random.next_float32(), random.next_float32()))
        return dr.gather(mi.Point2f, self.tables[lens], sample)


def _displacement(shift: NDArray[np.floating], camera: Eye, index: Any) -> Any:
    """Return the displacement of the code at each pixel, world frame, per unit of distance from the camera [rad]."""
    along = to_device(np.ravel(shift))
    below = index + opaque_index(shift[0].size)
    return camera.axes[0] * dr.gather(mi.Float, along, index) + camera.axes[1] * dr.gather(mi.Float, along, below)


def _sampled_emitter_light(scene: Scene, surface: Any, bsdf: Any, random: Any, active: Any) -> Any:
    """Return the reflected radiance of one emitter, chosen at random [W / (mm^2 sr)]."""
    point = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = scene.mitsuba.sample_emitter_direction(surface, point, True, active)
    usable = active & (sample.pdf != 0.0)
    toward = surface.to_local(sample.d)
    reflected, pdf = bsdf.eval_pdf(mi.BSDFContext(), surface, toward, usable)
    heuristic = dr.select(sample.delta, 1.0, sample.pdf / (sample.pdf + pdf))
    return dr.select(usable, reflected[0] * weight[0] * heuristic, 0.0)


def _hit_emitter_light(scene: Scene, surface: Any, origin: Any, pdf: Any) -> Any:
    """Return an emitter's weighted radiance [W / (mm^2 sr)]; ``pdf`` [1/sr] of the ray, or :data:`_ALONE` for 1."""
    emitter = surface.emitter(scene.mitsuba)
    emitted = emitter.eval(surface)[0]
    reference = dr.zeros(mi.Interaction3f)
    reference.p = origin
    sample = mi.DirectionSample3f(scene.mitsuba, surface, reference)
    alone = pdf < 0
    emitter_pdf = scene.mitsuba.pdf_emitter_direction(reference, sample, ~alone)
    heuristic = dr.select(alone, 1.0, pdf / (pdf + emitter_pdf))
    return dr.select(emitted > 0, emitted * heuristic, 0.0)
