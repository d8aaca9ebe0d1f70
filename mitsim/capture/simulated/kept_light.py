"""Interreflections of one view for any finish: paths traced once, evaluated and smoothed for every draw.

Signal chain: scene with finishes to sample with -> candidates of each camera
(:mod:`mitsim.scene.light_transport.kept_tracing`) -> paths that matter
(:mod:`mitsim.scene.light_transport.kept_paths`); then for each draw: BSDFs, with lobes no narrower than the paths
resolve -> light of each code -> Gaussian filter over the pixels of one shape -> images.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from characterisation.files.threads import in_threads
from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.indirect_light import KeptSettings, Smoothing
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.light_transport.kept_finishes import broad, least_width, resolved
from mitsim.scene.light_transport.kept_paths import CandidatePaths, KeptPaths, mattering
from mitsim.scene.light_transport.kept_tracing import camera_paths, photon_paths
from mitsim.scene.light_transport.kept_walks import Tracer, Tracing
from mitsim.scene.light_transport.plain_scene import distinct_bsdfs, has_emitters
from mitsim.scene.load import Scene, bsdf_of
from mitsim.scene.ray_casting.raycast import shapes_met
from mitsim.scene.turned_lay import is_turned
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class KeptLight:
    """Interreflected light of one camera's region, for any finish.

    ``widths`` are those of the narrowest lobes that the paths resolve [1], by the ids of BSDFs.
    """

    paths: KeptPaths
    smoothing: Smoothing
    ambient_image: bool
    widths: Mapping[str, float]

    @property
    def bytes(self) -> int:
        """Memory that it needs."""
        return self.paths.bytes + self.smoothing.bytes

    def images(
        self, scene: Scene, simulated: SimulatedSensor, motion: NDArray[np.float64] | None = None
    ) -> NDArray[np.float32]:
        """Return the radiance (P, h, w) in the finishes of a scene, before the lens [W / (mm^2 sr)].

        ``motion``: that of the code from where the paths were traced
        (:func:`~mitsim.capture.simulated.image_motion.code_motion`), None for none.

        Like :meth:`~mitsim.capture.simulated.simulate.SimulatedSensor.indirect_radiance`, one more image is the light
        of other sources, if the sensor takes an ambient image.
        """
        light = simulated.patterns
        codes = self.paths.codes(_resolved_bsdfs(scene, self.widths), light, motion)
        in_threads(self.smoothing.apply, codes)
        images = light.images(list(codes))
        if self.ambient_image:
            images.append(np.zeros_like(images[0]))
        return np.asarray(images, np.float32)


def can_be_kept(scene: Scene) -> bool:
    """Whether paths of a scene can be kept: all finishes can be changed, and the scene has no emitters."""
    return scene.changeable and not has_emitters(scene)


def keep_light(
    simulated: SimulatedSensor,
    scene: Scene,
    world_from_sensor: Transform,
    rois: dict[str, Roi],
    rendering: Rendering,
    finishes: Iterable[Scene],
    seed: int,
) -> dict[str, KeptLight]:
    """Trace the interreflections that each camera sees.

    Parameters
    ----------
    simulated, scene, world_from_sensor
        The sensor, the scene in its best estimates, and the pose.
    rois, rendering
        Region of each camera's image, and numbers of paths and surfaces.
    finishes
        The scene in finishes that may be drawn; each is used before the next is asked for. Paths are kept by their
        light in these.
    seed
        Of all random numbers.

    See Also
    --------
    light_on_paths : the same, of paths that were traced before
    """
    bsdfs = distinct_bsdfs(scene)
    assert bsdfs is not None  # can_be_kept
    described = _descriptions(scene)
    widths = _least_widths(scene)
    drawn = [number if bsdf.id() in described else -1 for number, bsdf in enumerate(bsdfs)]
    sampled = [bsdf_of(broad(described[bsdf.id()])) if bsdf.id() in described else bsdf for bsdf in bsdfs]
    probed = [_resolved_bsdfs(finished, widths) for finished in finishes]
    turned = [any(is_turned(finish[number]) for finish in probed) for number in range(len(bsdfs))]
    out, ambient = {}, simulated.sensor.ambient_image
    for index, (camera, roi) in enumerate(rois.items()):
        shape = _shapes(simulated, scene, world_from_sensor, camera, roi)
        pixels, settings = _lit_pixels(shape, rendering)
        photons = int(np.ceil(np.sqrt(settings.photons * settings.samples * len(pixels)))) ** 2
        own = int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
        tracing = Tracing(settings.samples, photons, rendering.depth, own, drawn, sampled, turned)
        rays, projector = simulated.rays[camera], simulated.patterns.projector
        candidates: list[CandidatePaths] = []
        if len(pixels):
            tracer = Tracer(scene, rays, projector, world_from_sensor, roi, tracing)
            candidates += [*camera_paths(tracer, pixels), *photon_paths(tracer)]
        paths = KeptPaths.of(mattering(candidates, probed, roi, settings.kept * len(pixels), own), roi)
        out[camera] = KeptLight(paths, Smoothing.of(shape, settings.smoothing_px), ambient, widths)
    return out


def light_on_paths(
    simulated: SimulatedSensor,
    scene: Scene,
    world_from_sensor: Transform,
    traced: Mapping[str, KeptPaths],
    rendering: Rendering,
) -> dict[str, KeptLight]:
    """Return the light of each camera on its traced paths.

    Parameters
    ----------
    simulated, scene, world_from_sensor, rendering
        As of :func:`keep_light`, with which the paths were traced.
    traced
        The paths of each camera.

    See Also
    --------
    keep_light : the same, with paths that it traces
    """
    out, ambient = {}, simulated.sensor.ambient_image
    widths = _least_widths(scene)
    for camera, paths in traced.items():
        shape = _shapes(simulated, scene, world_from_sensor, camera, paths.roi)
        _, settings = _lit_pixels(shape, rendering)
        out[camera] = KeptLight(paths, Smoothing.of(shape, settings.smoothing_px), ambient, widths)
    return out


def _descriptions(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return the descriptions of the finishes that can be changed, by the ids of their BSDFs."""
    return {
        shape.bsdf().id(): finish.description
        for shape, finish in zip(scene.shapes, scene.finishes, strict=True)
        if finish is not None and finish.description is not None
    }


def _least_widths(scene: Scene) -> dict[str, float]:
    """Return the least width of the lobes that paths sampled for these finishes resolve, by the ids of their BSDFs."""
    return {name: least_width(description) for name, description in _descriptions(scene).items()}


def _resolved_bsdfs(scene: Scene, widths: Mapping[str, float]) -> list[Any]:
    """Return the distinct BSDFs of a scene with lobes of at least some widths, by the ids of BSDFs; [] of instances."""
    described = _descriptions(scene)

    def resolved_bsdf(bsdf: Any) -> Any:
        if bsdf.id() not in widths:
            return bsdf
        wide = resolved(described[bsdf.id()], widths[bsdf.id()])
        return bsdf if wide == described[bsdf.id()] else bsdf_of(wide)

    return [resolved_bsdf(bsdf) for bsdf in distinct_bsdfs(scene) or []]


def _shapes(
    simulated: SimulatedSensor, scene: Scene, world_from_sensor: Transform, camera: str, roi: Roi
) -> NDArray[np.integer]:
    return shapes_met(scene, simulated.pixel_rays(camera).within(roi), world_from_sensor)


def _lit_pixels(shape: NDArray[np.integer], rendering: Rendering) -> tuple[NDArray[np.integer], KeptSettings]:
    """Return the indices of the pixels that may see the part, and the settings for their number."""
    assert rendering.kept is not None
    # a pixel at the edge of the part may see it although its centre does not
    pixels = np.flatnonzero(binary_dilation(shape >= 0, np.ones((3, 3))))
    return pixels, rendering.kept.for_pixels(len(pixels))
