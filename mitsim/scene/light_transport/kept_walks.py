"""The state of light paths on their way, for :mod:`mitsim.scene.light_transport.kept_tracing`.

Signal chain: lanes of one step -> those that are lit become records, those that go on are compressed, in their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, opaque_index, vectors_to_host
from mitsim.scene.light_transport.kept_paths import CandidatePaths
from mitsim.scene.light_transport.plain_scene import SceneBsdfs
from mitsim.scene.light_transport.projector_light import ProjectorLight
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.ray_casting.eye import Eye
from mitsim.scene.turned_lay import from_z_axis
from mitsim.sensor.projector import Projector
from mitsim.sensor.transforms import Transform


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
class Walk:
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

    def at(self, index: Any) -> Walk:
        """Return the lanes with an index."""

        def lanes(value: Any) -> Any:
            return dr.gather(type(value), value, index)

        return Walk(
            lane=lanes(self.lane),
            pixel=lanes(self.pixel),
            origin=lanes(self.origin),
            direction=lanes(self.direction),
            weight=lanes(self.weight),
            ratio=lanes(self.ratio),
            length=lanes(self.length),
            code=lanes(self.code),
            surfaces=[[lanes(value) for value in surface] for surface in self.surfaces],
        )


class Tracer:
    """What camera paths and photons of one light have in common.

    ``rays`` of the camera, ``pose`` of the sensor, ``roi`` of the image, and numbers of paths and surfaces.
    """

    def __init__(
        self, scene: Scene, rays: CameraRays, projector: Projector, pose: Transform, roi: Roi, tracing: Tracing
    ) -> None:
        self.scene, self.rays, self.roi, self.tracing = scene, rays, roi, tracing
        self.camera = Eye(pose @ rays.camera.sensor_from_camera)
        self.projector = ProjectorLight(pose, projector, bounds_of(scene.mitsuba))
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
        """Return a point of the unit disc for each path."""
        return mi.warp.square_to_uniform_disk_concentric(self.random(lane, stream))

    def material(self, surface: Any, valid: Any) -> Any:
        """Return the number of the drawn finish of each lane, -1 for none."""
        return dr.gather(mi.Int32, self.drawn, self.bsdfs.index_of(surface, valid), valid)

    def kept(self, surface: Any, material: Any, toward_camera: Any, toward_projector: Any) -> list[Any]:
        """Return material and local directions of a surface as a path keeps them.

        Parameters
        ----------
        surface
            Interaction of each lane.
        material
            Number of its drawn finish, -1 for none.
        toward_camera, toward_projector
            Unit vectors in the surface's shading frame.
        """
        directions = [mi.Vector3f(toward_camera), mi.Vector3f(toward_projector)]
        if any(self.tracing.turned):
            turned = dr.gather(mi.Bool, self.turned, mi.UInt32(dr.maximum(material, 0)), material >= 0)
            directions = [
                dr.select(turned, from_z_axis(surface.sh_frame, direction), direction) for direction in directions
            ]
        return [material, *directions]

    def factor(self, material: Any, value: Any) -> Any:
        """Return the part of a BSDF that belongs into the weight: its value if its finish is not drawn, else 1."""
        return mi.Float(1.0) if self.all_drawn else dr.select(material < 0, value, 1.0)


def split_walk(
    walk: Walk, lit: Any, record: Any, goes_on: Any, follower: Walk | None
) -> tuple[Walk | None, CandidatePaths | None]:
    """Return the lanes that go on, and the records of those that are lit; None for none.

    ``walk``: lanes of this step. ``lit``, ``record``: mask of the lanes that are lit, and their weight, (u, v), length,
    material and local directions. ``goes_on``, ``follower``: mask of the lanes that go on, and all lanes after the
    step.
    """
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


def _arrays(walk: Walk) -> list[Any]:
    return [walk.lane, walk.pixel, walk.origin, walk.direction, walk.weight, walk.ratio, walk.length, walk.surfaces]


def _candidates(walk: Walk, record: Any, index: Any) -> CandidatePaths:
    weight, uv, length, *last = record

    def lanes(value: Any) -> Any:
        return dr.gather(type(value), value, index)

    surfaces = [*walk.surfaces, last]
    code = np.stack([np.asarray(lanes(value)) for value in (uv.x, uv.y, length)], axis=-1)
    material = np.stack([np.asarray(lanes(surface[0])).astype(np.int16) for surface in surfaces], axis=-1)
    toward = np.stack(
        [
            np.concatenate([vectors_to_host(lanes(surface[1])), vectors_to_host(lanes(surface[2]))], axis=1)
            for surface in surfaces
        ],
        axis=1,
    )
    return CandidatePaths(
        np.asarray(lanes(walk.pixel)).astype(np.int32), np.asarray(lanes(weight), np.float32), code, material, toward
    )


def place_of(pixel: Any, roi: Roi) -> tuple[Any, Any]:
    """Return column and row in the whole image."""
    width = opaque_index(roi.width)
    return pixel % width + opaque_index(roi.left), pixel // width + opaque_index(roi.top)


def value_and_density(
    bsdf: Any, surface: Any, toward_projector: Any, toward_camera: Any, active: Any, camera: bool = False
) -> tuple[Any, Any]:
    """Return the BSDF times cosine, and the density of the other direction of travel [1/sr].

    ``bsdf``, ``surface``, ``active``: BSDF, surface interaction, and mask of the lanes. ``toward_projector``,
    ``toward_camera``: local directions. ``camera``: whether the density is that of a camera path that continues to the
    projector; else of a photon to the camera.
    """
    view = mi.SurfaceInteraction3f(surface)
    view.wi = toward_camera
    if camera:
        value, density = bsdf.eval_pdf(mi.BSDFContext(), view, toward_projector, active)
        return value[0], density
    value = bsdf.eval(mi.BSDFContext(), view, toward_projector, active)
    view.wi = toward_projector
    return value[0], bsdf.pdf(mi.BSDFContext(), view, toward_camera, active)


def density_to_camera(bsdf: Any, surface: Any, toward_projector: Any, active: Any) -> Any:
    """Return the density with which a photon continues to the camera [1/sr].

    ``bsdf``, ``surface``, ``active``: BSDF, surface interaction met from the camera, and mask of the lanes.
    ``toward_projector``: local direction from which the photon arrives.
    """
    view = mi.SurfaceInteraction3f(surface)
    view.wi = toward_projector
    return bsdf.pdf(mi.BSDFContext(), view, surface.wi, active)
