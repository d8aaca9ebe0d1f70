"""Simulate captures.

Signal chain: scene and pose -> speckle of the surfaces -> radiance per camera and image
(:mod:`mitsim.scene.light_transport.transport`), plus room light -> blur and corner loss of the lens -> exposures by the
sensor's rule -> grey levels with noise (:mod:`mitsim.capture.simulated.exposing`) ->
:class:`~mitsim.capture.capture.Capture`.

One seed determines everything: each camera has its own random streams for rendering, speckle and noise. Speckle is one
draw for all images of a pose. The noise of the imager has a stream for each image.

If only a part of the scene matters, only its region of each image is traced and exposed, as cameras read out a region
of interest. The rest of the image is missing, not dark, and has grey level 0.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.exposing import (
    LightOnImagers,
    UnitPatterns,
    brightest_images,
    capture_of,
    expose_camera,
    shifted_units,
)
from mitsim.capture.simulated.indirect_light import IndirectLight, smoothed
from mitsim.capture.simulated.lens_blur import blur_by_lens
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.surface_speckle import draw_speckle
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.plain_scene import has_emitters, single_plane
from mitsim.scene.light_transport.projected_codes import ModulatedLight, ProjectedLight, ProjectedPatterns
from mitsim.scene.light_transport.room_light import SeenSurfaces, directional_albedos
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.ray_casting.raycast import PixelRays, shapes_met
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.pattern import DotPattern
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.speckle import SpeckleField
from mitsim.sensor.transforms import Transform
from mitsim.sensor.vignetting import camera_illumination
from mitsim.sensor.working_volume import roi_around

#: margin around the required points [px], for the blur of the lens and the window of the matcher
_MARGIN_PX = 12

#: direct light at 16 samples per pixel
_DEFAULT = Rendering()


class SimulatedSensor:
    """A sensor on the device, ready for any number of captures of any scene.

    - ``rays``: of each camera: rays for light paths, with the true calibration.
    - ``patterns``: the projector and its codes.
    - ``units``: fixed patterns of each camera's imager.
    - ``corner_loss``: illumination (H, W) of each camera's image relative to its centre; None without loss.
    """

    def __init__(self, sensor: Sensor) -> None:
        sensor.require("simulation")
        self.sensor = sensor
        cameras = sensor.true_rig.cameras
        self.rays = {name: _camera_rays(sensor, camera) for name, camera in cameras.items()}
        self._cameras = cameras
        self.patterns = _light(sensor)
        self.units = {name: UnitPatterns.of(sensor, index, name) for index, name in enumerate(cameras)}
        corner = sensor.imager.corner_illumination
        self.corner_loss = {name: camera_illumination(corner, camera) for name, camera in cameras.items()}

    def pixel_rays(self, camera: str) -> PixelRays:
        """Return the rays of a camera's pixel centres, with the calibration that this sensor was made with."""
        return PixelRays.of_camera(self._cameras[camera])

    def recalibrated(self, rig: Rig, unit: int | None = None, mask: DotPattern | None = None) -> SimulatedSensor:
        """Return a sensor of the same type with a calibration close to this one's.

        Without another mask, the patterns of the projector are shared: they need most memory on the device. Speckle is
        still drawn for the pixels of this sensor's rig, because a small change does not affect its statistics. A
        projector that has no distortion in this sensor's rig keeps its irradiance for the same reason.

        ``unit`` is the seed of another unit's fixed pattern; None keeps the pattern. It is this unit's pattern, shifted
        by random rows and columns: pixels are independent, so it is as good as a new draw and faster. ``mask`` has the
        dots of another unit (:func:`mitsim.sensor.pattern.another_mask`), which its captures state; None keeps this
        unit's.
        """
        other = copy.copy(self)
        projector = self.sensor.projector.recalibrated(rig.projector or self.sensor.projector.optics)
        other.sensor = replace(self.sensor, rig=rig, projector=projector, pattern=mask or self.sensor.pattern)
        cameras = self.sensor.misaligned(rig).cameras
        other.rays = {name: self.rays[name].recalibrated(camera) for name, camera in cameras.items()}
        if mask is not None and isinstance(self.patterns, ProjectedPatterns):
            other.patterns = self.patterns.showing(other.sensor.patterns())
        else:
            other.patterns = copy.copy(self.patterns)
        other.patterns.projector = projector
        if unit is not None:
            other.units = shifted_units(self.units, unit)
        return other

    def indirect_radiance(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        camera: str,
        indirect: IndirectLight,
        *,
        seed: int,
        depth: int,
        roi: Roi | None = None,
    ) -> NDArray[np.float32]:
        """Return the radiance (P, h, w) of interreflections alone, smoothed, before the lens [W / (mm^2 sr)].

        One more image has the light of the scene's emitters, if the sensor takes an ambient image or the scene has
        emitters.

        Parameters
        ----------
        scene, world_from_sensor, camera
            Scene to render, pose of the sensor, and name of the camera.
        indirect, seed, depth
            Samples and smoothing of the interreflections; seed of the light paths, and their most surfaces.
        roi
            Region of the image; by default all of it.
        """
        rays = self.rays[camera]
        roi = roi or rays.whole
        ambient = self.sensor.ambient_image or has_emitters(scene)
        if single_plane(scene) is not None:  # a flat coupon does not light itself
            return np.zeros((self.patterns.count + ambient, roi.height, roi.width), np.float32)
        paths = LightPaths(indirect.samples, seed, depth, indirect_only=True, with_ambient=ambient)
        images = trace(scene, rays, self.patterns, world_from_sensor, paths, roi)
        shape = shapes_met(scene, self.pixel_rays(camera).within(roi), world_from_sensor)
        return smoothed(images, shape, indirect.smoothing_px)

    def radiance(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        camera: str,
        rendering: Rendering,
        *,
        seed: int,
        roi: Roi | None = None,
        speckle: SpeckleField | None = None,
    ) -> NDArray[np.float32]:
        """Return the radiance (P, h, w) that reaches a camera's imager [W / (mm^2 sr)].

        If the sensor takes an ambient image, it is the last.

        Parameters
        ----------
        scene, world_from_sensor, camera
            Scene to render, pose of the sensor, and name of the camera.
        rendering, seed
            Light paths, interreflections that are rendered already, and seed of the light paths.
        roi, speckle
            Region of the image, by default all of it; its speckle, None for none.
        """
        return self._radiance(scene, world_from_sensor, camera, rendering, seed, roi, speckle)[0]

    def _radiance(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        camera: str,
        rendering: Rendering,
        seed: int,
        roi: Roi | None,
        speckle: SpeckleField | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the radiance, and what of it is not the projector's (h, w); None without lamps and a known room."""
        rays, ambient_image = self.rays[camera], self.sensor.ambient_image
        roi = roi or rays.whole
        lamps = has_emitters(scene)
        separate_ambient = ambient_image or lamps
        depth = rendering.surfaces
        indirect = rendering.indirect_settings if depth > 1 else None
        paths = LightPaths(rendering.samples, seed, depth if indirect is None else 1, with_ambient=separate_ambient)
        shift = None if speckle is None else speckle.shift
        images = trace(scene, rays, self.patterns, world_from_sensor, paths, roi, shift)
        if indirect is not None:
            images += (
                rendering.prerendered.images[camera]
                if rendering.prerendered is not None
                else self.indirect_radiance(scene, world_from_sensor, camera, indirect, seed=seed, depth=depth, roi=roi)
            )[: len(images)]
        projected, ambient_images = images[: self.patterns.count], images[self.patterns.count :]

        # in place, because two copies of a large stack need too much memory
        def finish_projected(image: NDArray[np.float32]) -> None:
            image[:] = self.apply_lens(image, camera, roi)
            if speckle is not None:  # affects the projector's light alone
                if separate_ambient:
                    image -= ambient_images[0]
                image *= speckle.gain
                if separate_ambient:
                    image += ambient_images[0]

        for image in ambient_images:
            image[:] = self.apply_lens(image, camera, roi)
        in_threads(finish_projected, projected)
        other = ambient_images[0].copy() if lamps else None
        if self.sensor.room is not None:
            room = self.apply_lens(self._room_image(scene, world_from_sensor, camera, roi), camera, roi)
            images += room
            other = room if other is None else other + room
        return images[: self.patterns.count + ambient_image], other

    def _room_image(self, scene: Scene, world_from_sensor: Transform, camera: str, roi: Roi) -> NDArray[np.float32]:
        """Return the radiance (h, w) in the light of the sensor file's ``[room]`` alone, before the lens.

        Its gradient is along the axes of the sensor frame at the middle of the working range, the same for all cameras.
        """
        surfaces = SeenSurfaces.of(scene, self.pixel_rays(camera), world_from_sensor, roi)
        relative = surfaces.room_radiance(directional_albedos(scene))
        eye, depth = self.sensor.rig.cameras[camera], float(np.mean(self.sensor.working_range_mm))
        pixels = np.stack(roi.pixels(), axis=-1).astype(float)
        directions = eye.sensor_from_camera.directions(eye.rays_to_fold(pixels))
        points = eye.centre + directions * ((depth - eye.centre[2]) / directions[..., 2:])
        return np.asarray(relative * self.sensor.room_irradiance(points), np.float32)

    def apply_lens(self, image: NDArray[np.float32], camera: str, roi: Roi) -> NDArray[np.float32]:
        """Return the image (h, w) of a region, blurred by a camera's lens and darkened toward the corners."""
        loss = self.corner_loss[camera]
        out = blur_by_lens(image, self.sensor.imager, self.sensor.rig.cameras[camera], roi)
        return out if loss is None else np.asarray(out * loss[roi.slices], np.float32)

    def light(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        *,
        seed: int,
        rendering: Rendering = _DEFAULT,
        around: NDArray[np.floating] | None = None,
        noise: Noise | None = None,
    ) -> LightOnImagers:
        """Return the light on the imagers from one pose, for :meth:`expose`.

        Parameters
        ----------
        scene, world_from_sensor, rendering
            The scene, the pose of the sensor, and the light paths.
        seed
            Seed of the rendering, and of the speckle, which belongs to the surface and the pose.
        around
            (n, 3) points in the *sensor* frame [mm]: of each image, only their bounding box and 12 px more are read
            out. The rest has grey level 0. ``decoding.read_out`` states the region of each camera that has one.
        noise
            The sources of noise that are on; all by default.
        """
        noise, sensor, prerendered = noise or Noise(), self.sensor, rendering.prerendered
        light, rois, other = {}, {}, dict[str, NDArray[np.float32]]()
        for index, (name, camera) in enumerate(sensor.rig.cameras.items()):
            read_out = None if around is None else roi_around(camera, around, _MARGIN_PX)
            roi = rois[name] = prerendered.rois[name] if prerendered is not None else read_out or self.rays[name].whole
            render_stream, _, speckle_stream = np.random.SeedSequence([seed, index]).spawn(3)
            speckle = None
            if noise.speckle:
                rng = np.random.default_rng(speckle_stream)
                speckle = draw_speckle(scene, sensor, camera, self.pixel_rays(name), world_from_sensor, roi, rng)
            own = int(render_stream.generate_state(1)[0])
            light[name], apart = self._radiance(scene, world_from_sensor, name, rendering, own, roi, speckle)
            if apart is not None:
                other[name] = apart
        for name, stack in light.items():
            _check_finite(sensor, stack, f"camera {name}", "radiance")
        exposures = sensor.exposure.exposures(brightest_images(sensor, light), sensor.imager.full_well)
        _check_finite(sensor, np.array(exposures) * sensor.electrons(), "imager", "electrons per radiance")
        records = rendering.records(scene.where, scene.parameters)
        return LightOnImagers(light, rois, exposures, noise, world_from_sensor, records, other)

    def expose(self, light: LightOnImagers, seed: int) -> Capture:
        """Expose the imagers to light and return the capture.

        Each seed gives another capture from the same pose, with the same speckle.
        """
        images = {}
        for index, name in enumerate(light.rois):
            _, noise_stream, _ = np.random.SeedSequence([seed, index]).spawn(3)
            images[name] = expose_camera(self.sensor, light, name, self.units[name], noise_stream)
        return capture_of(self.sensor, light, images, seed)

    def capture(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        *,
        seed: int,
        rendering: Rendering = _DEFAULT,
        around: NDArray[np.floating] | None = None,
        noise: Noise | None = None,
    ) -> Capture:
        """Return one capture: :meth:`light`, exposed once.

        Parameters
        ----------
        scene, world_from_sensor, seed, rendering, around, noise
            As for :meth:`light`; ``seed`` is also that of the noise: the same one gives the same bytes.
        """
        light = self.light(scene, world_from_sensor, seed=seed, rendering=rendering, around=around, noise=noise)
        return self.expose(light, seed)


def _camera_rays(sensor: Sensor, camera: Camera) -> CameraRays:
    focus = sensor.focus_mm
    return CameraRays(camera) if focus is None else CameraRays(camera, sensor.pupil_mm(camera), focus)


def _light(sensor: Sensor) -> ProjectedLight:
    """Return the light whose code depends on the projector coordinate, or on time for time of flight."""
    if isinstance(sensor.pattern, AmplitudeModulation):
        return ModulatedLight(sensor.projector, *sensor.pattern.images())
    return ProjectedPatterns(sensor.patterns(), sensor.projector)


def _check_finite(sensor: Sensor, values: NDArray[np.floating], where: str, quantity: str) -> None:
    """Reject light that is not finite, before it becomes an image of zeros."""
    if not np.isfinite(values.sum(dtype=np.float64)):
        found = f"{quantity} that is infinite or not a number"
        allowed = "finite light: check the optics, flux_w and the scene's own emitters"
        raise InputError(f"sensor {sensor.name}", where, found, allowed)
