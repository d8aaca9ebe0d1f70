"""Trace interreflections from the projector, on paths that are rarely found from the camera.

Signal chain: position in the projector's image and aperture -> ray -> surface -> direction sampled from its BSDF ->
surface, ... -> position in the camera's lens, if nothing blocks it -> pixel -> record (pixel, radiance, (u, v), L) ->
one sum per image.

Suppose a path from the camera leaves a surface by its wide-angle lobe and meets a polished face. It carries light only
if it lies in the narrow lobe of that face, which is rare and then very bright. From the projector the same path is
found easily: the narrow lobe is sampled, and the wide one connects to the camera. Both methods are used, and the
balance heuristic weights every path (Veach and Guibas, SIGGRAPH 1995; Veach, thesis 1997, chapters 9 and 10). The
surfaces of a path are x_1 (at the camera) ... x_n (at the projector). The densities p_L of photons and p_C of camera
paths have the ratio

    n_L p_L   n_L   p_proj(x_n)          pr_{i+1} cos_i
    ------- = --- * ----------- * prod   --------------    over i = 1 ... n - 1
    n_C p_C   n_C   p_cam(x_1)           pf_i cos_{i+1}

- n_L, n_C: number of photons, and of camera samples per pixel;
- p_proj, p_cam: densities per area of x_n and x_1;
- pf_i: density per solid angle of leaving x_i for x_{i+1};
- pr_{i+1}: density per solid angle of leaving x_{i+1} for x_i;
- cos_i: cosine to the normal at x_i of the segment between the two.

Positions in the apertures are uniform in both methods and cancel. Direct light (n = 1) comes from camera paths alone.

At each surface the BSDF and its cosine are evaluated as on camera paths, with light arriving from the projector's side.
The methods therefore agree on meshes with vertex normals and on BSDFs with a black back, in both directions of travel.
This includes the correction of Veach's section 5.3. A delta lobe ends a photon; its paths are left to the camera.

Photons write records, which are summed in their order in double precision: the same seed gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, opaque_index
from mitsim.scene.light_transport.kept_walks import value_and_density
from mitsim.scene.light_transport.low_discrepancy import r3_point, z_order
from mitsim.scene.light_transport.plain_scene import SceneBsdfs
from mitsim.scene.light_transport.projected_codes import ProjectedLight
from mitsim.scene.light_transport.projector_light import ProjectorLight
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.camera_rays import CameraRays, pixel_area
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.sensor.transforms import Transform

#: number of photons in one launch; each needs 24 bytes for every surface after its first
PHOTONS_AT_ONCE = 1 << 21

#: number of pixels whose images are computed at once
_PIXELS_AT_ONCE = 1 << 18

#: first random stream of the photons; the streams below belong to the pixels
_FIRST_STREAM = 1 << 40


@dataclass(frozen=True)
class Photons:
    """The photons that a projector emits."""

    count: int  # a square number
    depth: int  # largest number of surfaces that a photon meets
    seed: int  # of their directions
    #: of the camera per pixel, with which the photons share the light; None if there are only photons
    samples: int | None = None


def add_photons(
    images: NDArray[np.float32],
    scene: Scene,
    rays: CameraRays,
    light: ProjectedLight,
    poses: Sequence[Transform],
    photons: Photons,
    roi: Roi,
) -> None:
    """Add to ``images`` the light of photons that has met 2 to ``photons.depth`` surfaces.

    - ``images``: (poses, P, height, width) of the region [W / (mm^2 sr)], changed in place. Photons do not depend on
      the region: each pixel receives the same light as in the whole image.
    - ``scene``, ``rays``, ``light``, ``poses``: the scene, the camera's rays, the projector's light, and the poses of
      the sensor.
    - ``photons``: their number at each pose, depth and seed.
    - ``roi``: the region of the image.
    """
    sums = np.zeros((light.codes, len(poses) * roi.height * roi.width))
    at_once = max(1, PHOTONS_AT_ONCE // len(poses))
    for first in range(0, photons.count, at_once):
        batch = range(first, min(first + at_once, photons.count))
        pixel, radiance, uv, length = _launch(scene, rays, light, poses, photons, batch, roi)
        if not len(pixel):
            continue
        values = light.values(uv, length, mi.Bool(True))
        dr.eval(values)
        for total, value in zip(sums, values, strict=True):
            total += np.bincount(pixel, radiance * np.asarray(value), total.size)
    sums /= photons.count
    for pose_images, pose_sums in zip(
        images, np.moveaxis(sums.reshape(light.codes, len(poses), -1), 1, 0), strict=True
    ):
        flat = pose_images.reshape(len(pose_images), -1)
        # all pixels at once would need twice the memory of the images
        for first in range(0, flat.shape[1], _PIXELS_AT_ONCE):
            part = slice(first, first + _PIXELS_AT_ONCE)
            for image, total in zip(flat, light.images([code_sum[part] for code_sum in pose_sums]), strict=True):
                image[part] += total.astype(np.float32)


def _launch(
    scene: Scene,
    rays: CameraRays,
    light: ProjectedLight,
    poses: Sequence[Transform],
    photons: Photons,
    batch: range,
    roi: Roi,
) -> tuple[NDArray[np.int32], NDArray[np.float64], Any, Any]:
    """Trace a ``batch`` of the photons of every pose to a region.

    Returns one entry for each record, in the order of the photons: pixel in the region, radiance, (u, v) and L [mm].
    The pixels of one pose follow those of the pose before.
    """
    first, count, depth, seed = batch.start, len(poses) * len(batch), photons.depth, photons.seed
    index, lane = dr.arange(mi.UInt32, count), None
    if len(poses) > 1:
        per_pose = opaque_index(len(batch))
        lane, index = index // per_pose, index % per_pose
    camera = Eye([pose @ rays.camera.sensor_from_camera for pose in poses], lane)
    projector = ProjectorLight(poses, light.projector, bounds_of(scene.mitsuba), lane)
    has_aperture = rays.aperture_mm > 0
    aperture, inverse_focus = (opaque(value) for value in (0.5 * rays.aperture_mm, 1.0 / rays.focus_mm))
    in_row, surfaces = (opaque_index(n) for n in (rays.camera.width, depth))
    # n_C / n_L; 0 if there are only photons
    samples_per_photon = opaque(0.0 if photons.samples is None else photons.samples / photons.count)

    index += opaque_index(first)
    streams = mi.UInt64(index) + _FIRST_STREAM
    random = mi.PCG32(initstate=dr.opaque(mi.UInt64, seed), initseq=streams)
    side = opaque_index(round(np.sqrt(photons.count)))
    sequence_seed, z_index = opaque_index(seed & 0xFFFFFFFF), z_order(index % side, index // side)
    image_point = mi.Point2f(index % side, index // side)
    image_point = (image_point + mi.Point2f(random.next_float32(), random.next_float32())) / mi.Float(side)
    lens = _in_disc(random) if projector.has_aperture else None
    origin, direction, flux, uv = projector.emit_photon(image_point, lens)

    bsdfs = SceneBsdfs(scene)
    records = depth - 1
    pixels, radiances = dr.zeros(mi.UInt32, count * records), dr.zeros(mi.Float, count * records)
    lengths = dr.zeros(mi.Float, count * records)
    per_photon = opaque_index(records)
    slot = dr.arange(mi.UInt32, count) * per_photon
    initial = _PhotonState(
        active=flux > 0,
        bounce=mi.UInt32(dr.zeros(mi.UInt32, count)),
        origin=mi.Point3f(origin + dr.zeros(mi.Point3f, count)),
        direction=direction,
        weight=mi.Float(flux),
        ratio=dr.zeros(mi.Float, count),
        length=dr.zeros(mi.Float, count),
        random=random,
    )

    def running(photon: _PhotonState) -> Any:
        return photon.active

    def step(photon: _PhotonState) -> tuple[_PhotonState]:
        active, bounce, origin, direction = photon.active, photon.bounce, photon.origin, photon.direction
        weight, ratio, length, random = photon.weight, photon.ratio, photon.length, photon.random
        at_first = bounce == 0
        surface = scene.mitsuba.ray_intersect(mi.Ray3f(origin, direction), active)
        hit = active & surface.is_valid()
        length = length + dr.select(hit, surface.t, 0.0)
        bsdf, context = bsdfs.at(surface), mi.BSDFContext()
        toward_projector = mi.Vector3f(surface.wi)
        cosine_in = dr.maximum(dr.abs(dr.dot(surface.n, direction)), 1e-9)
        # n_C p_C / (n_L p_L) of the surfaces so far, without the factors of the next direction
        ratio = dr.select(at_first, samples_per_photon / projector.density(-direction, surface.t), ratio) / cosine_in

        # to the camera
        lens_point = camera.position
        if has_aperture:
            in_lens = _in_disc(random) * aperture
            lens_point = lens_point + camera.axes[0] * in_lens.x + camera.axes[1] * in_lens.y
        to_camera = lens_point - surface.p
        distance = dr.norm(to_camera)
        toward = to_camera / distance
        local = camera.to_local(-toward)
        in_front = hit & ~at_first & (local.z > 0)
        cosine = dr.select(in_front, local.z, 1.0)
        x, y = local.x / cosine, local.y / cosine
        if has_aperture:
            x += in_lens.x * inverse_focus
            y += in_lens.y * inverse_focus
        column, row, seen = rays.distortion.image(x, y, in_front)
        column, row = mi.UInt32(dr.select(seen, column + 0.5, 0.0)), mi.UInt32(dr.select(seen, row + 0.5, 0.0))
        seen &= ~scene.mitsuba.ray_test(shadow_ray(surface, toward, distance), seen)
        to_lens = surface.to_local(toward)
        value, density = value_and_density(bsdf, surface, toward_projector, to_lens, seen, camera=True)
        # density on the surface of the pixel's samples, which are uniform on its area in the plane z = 1 [1/mm^2]
        importance = dr.abs(dr.dot(surface.n, toward)) / (
            pixel_area(*rays.corners(column, row)) * dr.square(cosine) * cosine * dr.square(distance)
        )
        heuristic = 1.0 / (1.0 + ratio * density * importance)
        radiance = weight * value * importance / cosine_in * heuristic
        lit = seen & (radiance > 0)
        target = slot + bounce - 1
        dr.scatter(pixels, row * in_row + column, target, lit)
        dr.scatter(radiances, radiance, target, lit)
        dr.scatter(lengths, length + distance, target, lit)

        # to the next surface
        sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        even1, even2 = r3_point(z_index, sequence_seed, 1)
        sample1, sample2 = dr.select(at_first, even1, sample1), dr.select(at_first, even2, sample2)
        continues = hit & (bounce + 1 < surfaces)
        sampled, _ = bsdf.sample(context, surface, sample1, sample2, continues)
        continues &= (sampled.pdf > 0) & ~mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        outgoing = surface.to_world(sampled.wo)
        # as at the end of a camera path: the projector must be on the side that is seen
        continues &= ~at_first | (dr.dot(surface.n, -direction) * dr.dot(surface.n, outgoing) > 0)
        value, density = value_and_density(bsdf, surface, toward_projector, sampled.wo, continues, camera=True)
        continues &= value > 0
        cosine_out = dr.maximum(dr.abs(dr.dot(surface.n, outgoing)), 1e-9)
        weight = weight * value * cosine_out / (sampled.pdf * cosine_in)
        ratio = ratio * dr.select(at_first, 1.0, density) * cosine_out / sampled.pdf
        ray = surface.spawn_ray(outgoing)
        return (_PhotonState(continues, bounce + 1, ray.o, ray.d, weight, ratio, length, random),)

    dr.while_loop((initial,), running, step, labels=("photon",), label="photons")
    dr.eval(pixels, radiances, lengths, uv)
    left, top, width, height = (opaque_index(n) for n in (roi.left, roi.top, roi.width, roi.height))
    column, row = pixels % in_row - left, pixels // in_row - top
    inside = (column < width) & (row < height)  # unsigned: differences below 0 become very large
    kept = dr.compress((radiances > 0) & inside)
    if not len(kept):
        return np.empty(0, np.int32), np.empty(0), uv, lengths
    pixel = row * width + column
    if len(poses) > 1:
        pixel += dr.arange(mi.UInt32, count * records) // (per_pose * per_photon) * (width * height)
    pixel = mi.Int32(dr.gather(mi.UInt32, pixel, kept))
    radiance, length = dr.gather(mi.Float, radiances, kept), dr.gather(mi.Float, lengths, kept)
    uv = dr.gather(mi.Point2f, uv, kept // per_photon)
    dr.eval(pixel, radiance, length, uv)
    return np.asarray(pixel), np.asarray(radiance, np.float64), uv, length


@dataclass
class _PhotonState:
    """State of the photons of one launch, one lane each, in Dr.Jit's loop."""

    active: Any  # whether the photon continues
    bounce: Any  # number of surfaces met before
    origin: Any
    direction: Any
    weight: Any  # light of the photon
    ratio: Any  # n_C p_C / (n_L p_L) so far
    length: Any  # optical length so far [mm]
    random: Any


def _in_disc(random: Any) -> Any:
    """Return a uniform random point in the unit disc."""
    return mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random.next_float32(), random.next_float32()))
