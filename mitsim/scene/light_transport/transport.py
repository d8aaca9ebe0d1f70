"""Render all images of one camera from one tracing of the light paths.

Signal chain: scene, camera rays, projector and its codes -> bands of rows that fit into one launch -> light of each
code on the camera's paths (:mod:`mitsim.scene.light_transport.path_loop`) -> images; plus photons
(:mod:`mitsim.scene.light_transport.light_tracing`).

The code of an image is a function of (u, v) or of the optical length L
(:mod:`mitsim.scene.light_transport.projector_light`). All images of a capture are therefore evaluated on the same
paths. Photons from the projector carry a part of their light, on paths that are rarely found from the camera. Emitters
of the scene add the same light to all images (:mod:`mitsim.scene.light_transport.path_loop`). ``jitter`` draws the
positions in pixels and lenses at random, for comparison with other renderers.

Radiometry: code value x plane irradiance E_1 [W] -> radiance [W / (mm^2 sr)], see :mod:`mitsim.sensor.projector`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.light_tracing import PHOTONS_AT_ONCE, Photons, add_photons
from mitsim.scene.light_transport.path_loop import launch
from mitsim.scene.light_transport.plain_scene import single_plane
from mitsim.scene.light_transport.projected_codes import ProjectedLight
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.transforms import Transform

#: number of floats in the images of one launch (64 MiB); a larger capture is traced in bands of rows. The device needs
#: a few times this memory
LARGEST_LAUNCH = 1 << 24


def trace(
    scene: Scene,
    rays: CameraRays,
    light: ProjectedLight,
    world_from_sensor: Transform,
    paths: LightPaths,
    roi: Roi | None = None,
    shift: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """Return the radiance that one camera sees in each image of a capture.

    Returns: (P, height, width), or (P + 1, height, width), of the region, float32 [W / (mm^2 sr)].

    Parameters
    ----------
    scene, rays, world_from_sensor
        The scene, the camera's rays, and the pose of the sensor.
    light
        The projector with its codes: :class:`~mitsim.scene.light_transport.projected_codes.ProjectedPatterns` or
        :class:`~mitsim.scene.light_transport.projected_codes.ModulatedLight`.
    paths
        The light paths.
    roi
        Region of the image to trace, by default all of it. Its pixels are the same as in the whole image.
    shift
        (2, height, width) [rad] of the region, along the x and y axes of the camera. The code of direct light is
        evaluated at this angle, seen from the camera, beside the surface point. Speckle causes it.

    See Also
    --------
    trace_poses : several poses
    """
    (images,) = _traced(scene, rays, light, [world_from_sensor], paths, roi or rays.whole, shift)
    return np.asarray(images)


def trace_poses(
    scene: Scene,
    rays: CameraRays,
    light: ProjectedLight,
    poses: Sequence[Transform],
    paths: LightPaths,
    roi: Roi | None = None,
) -> NDArray[np.float32]:
    """Return the radiance of :func:`trace` for images at several poses: (poses, P, height, width).

    Poses that fit into one launch share it. Recording a kernel takes about as long as rendering 20 000 pixels.

    Parameters
    ----------
    scene, rays, light, paths
        As for :func:`trace`.
    poses
        ``world_from_sensor`` of each.
    roi
        As for :func:`trace`, the same at all poses.

    See Also
    --------
    trace : one pose
    """
    region = roi or rays.whole
    photons = paths.photon_count(rays.camera.width * rays.camera.height)
    lanes = region.width * region.height * (light.count + 1)
    together = max(1, min(LARGEST_LAUNCH // lanes, PHOTONS_AT_ONCE // max(1, photons)))
    # of about equal size: a launch of one pose would be another kernel
    groups = np.array_split(np.arange(len(poses)), -(-len(poses) // together))
    return np.concatenate([_traced(scene, rays, light, [poses[k] for k in group], paths, region) for group in groups])


def _traced(
    scene: Scene,
    rays: CameraRays,
    light: ProjectedLight,
    poses: Sequence[Transform],
    paths: LightPaths,
    roi: Roi,
    shift: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """Return the radiance (poses, P, height, width) of a region, at poses that share their launches."""
    if single_plane(scene) is not None:  # a flat coupon does not light itself
        paths = replace(paths, depth=1)
    photons = paths.photon_count(rays.camera.width * rays.camera.height)
    images = np.empty((len(poses), light.count + paths.with_ambient, roi.height, roi.width), np.float32)
    rows = max(1, LARGEST_LAUNCH // (len(poses) * roi.width * (light.count + 1)))
    for first in range(0, roi.height, rows):
        band = Roi(roi.left, roi.top + first, roi.width, min(rows, roi.height - first))
        band_shift = None if shift is None else shift[:, first : first + band.height]
        traced = launch(scene, rays, light, poses, paths, band, band_shift)
        for number, values in zip(range(images.shape[1]), traced, strict=False):  # the ambient image may be unused
            images[:, number, first : first + band.height] = np.asarray(values).reshape(-1, band.height, band.width)
    if photons:
        request = Photons(photons, paths.depth, paths.seed, paths.side**2)
        add_photons(images[:, : light.count], scene, rays, light, poses, request, roi)
    return images
