"""Take a capture in a simulated world.

Signal chain: scene and pose -> speckle of the surfaces -> radiance per camera and image
(:mod:`mitsim.scene.light_transport.transport`), and that of the sensor's own [room] -> blur and corner loss of the lens
-> exposures, by the sensor's rule -> grey levels with noise (:mod:`mitsim.simulation.exposing`) ->
:class:`~mitsim.capture.capture.Capture`.

One seed goes in; every camera draws from streams of its own for the render, the speckle and the noise. Speckle is one
draw for all images of a pose; the imager's noise has a stream for each image.

Where only a part of the world matters, only its region of each image is traced and exposed, as cameras read out a
region of interest, and the capture says so. The rest of such an image is not dark but absent, at grey level 0.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.threads import in_threads
from mitsim.capture.capture import Capture
from mitsim.errors import InputError
from mitsim.scene.light_transport.ambient import has_emitters
from mitsim.scene.light_transport.projector_light import Light, LitPatterns, ModulatedLight
from mitsim.scene.light_transport.room_light import directional_albedos, room_radiance
from mitsim.scene.light_transport.transport import LightPaths, trace
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.ray_casting.raycast import PixelRays, shapes_met
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.image_formation import converter
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi, roi_around
from mitsim.sensor.speckle import SpeckleField
from mitsim.sensor.transforms import Transform
from mitsim.sensor.vignetting import camera_illumination
from mitsim.sensor.written_imager import written_imager
from mitsim.simulation.exposing import LightOnImagers, UnitPatterns, brightest, exposed
from mitsim.simulation.indirect_light import IndirectLight, smoothed
from mitsim.simulation.lens_blur import through_point_spread
from mitsim.simulation.rendering import Rendering
from mitsim.simulation.surface_speckle import draw_speckle

#: pixels traced around what must be seen, for the blur of the lens and the reach of the matcher
_MARGIN_PX = 12

#: direct light at 16 samples per pixel
_USUAL = Rendering()


class SimulatedSensor:
    """A sensor laid out on the device, ready to take any number of captures of any scene."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        cameras = sensor.true_rig.cameras
        self.rays = {name: _camera_rays(sensor, camera) for name, camera in cameras.items()}
        self.middles = {name: PixelRays.of_camera(camera) for name, camera in cameras.items()}
        self.patterns = _light(sensor)
        self.units = {name: UnitPatterns.of(sensor, index, name) for index, name in enumerate(cameras)}
        corner = sensor.imager.corner_illumination
        self.corner_loss = {name: camera_illumination(corner, camera) for name, camera in cameras.items()}

    def moved(self, rig: Rig, unit: int | None = None) -> SimulatedSensor:
        """The same type of sensor with another calibration, near its own, and another unit's fixed pattern.

        That of another unit is this unit's, moved round by some rows and columns: pixels are independent, so it is as
        good as a new draw and costs less. ``unit`` None keeps it where it is.
        Patterns, which are the largest thing on the device, are shared. Speckle is still drawn for the pixels of the
        own rig: its statistics do not depend on a small move.
        """
        other = copy.copy(self)
        optics = rig.projector or self.sensor.projector.optics
        projector = replace(self.sensor.projector, optics=optics)
        other.sensor = replace(self.sensor, rig=rig, projector=projector)
        cameras = self.sensor.misaligned(rig).cameras
        other.rays = {name: self.rays[name].moved(camera) for name, camera in cameras.items()}
        other.patterns = copy.copy(self.patterns)
        other.patterns.projector = projector
        if unit is not None:
            steps = np.random.default_rng(unit).integers(1, 10_000, (len(rig.cameras), 2))
            moves = dict(zip(rig.cameras, steps, strict=True))
            other.units = {name: patterns.moved(*moves[name]) for name, patterns in self.units.items()}
        return other

    def later_light(
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
        """Radiance (P, h, w) that comes by way of other surfaces alone, smoothed, before the lens.

        With one image more, of the scene's own light, where the sensor takes one or the author lit the scene.
        """
        rays = self.rays[camera]
        roi = roi or rays.whole
        ambient = self.sensor.ambient_image or has_emitters(scene)
        paths = LightPaths(indirect.samples, seed, depth, only_later=True, with_ambient=ambient)
        images = trace(scene, rays, self.patterns, world_from_sensor, paths, roi)
        shape = shapes_met(scene, self.middles[camera], world_from_sensor)[roi.slices]
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
        """Radiance (P, h, w) [W / (mm^2 sr)] that reaches a camera's imager, of a region, else of the whole image.

        One image more, of the scene's own light alone, where the sensor takes one. ``speckle`` is of the region.
        """
        rays, ambient_image = self.rays[camera], self.sensor.ambient_image
        roi = roi or rays.whole
        separate = ambient_image or (speckle is not None and has_emitters(scene))
        indirect, depth = rendering.indirectly, rendering.surfaces
        apart = indirect is not None and depth > 1
        paths = LightPaths(rendering.samples, seed, 1 if apart else depth, with_ambient=separate)
        shift = None if speckle is None else speckle.shift
        images = trace(scene, rays, self.patterns, world_from_sensor, paths, roi, shift)
        if apart:
            assert indirect is not None
            if rendering.before is not None:
                later = rendering.before.images[camera]
            else:
                later = self.later_light(scene, world_from_sensor, camera, indirect, seed=seed, depth=depth, roi=roi)
            images += later[: len(images)]
        lit, others = images[: self.patterns.count], images[self.patterns.count :]

        def through_lens(image: NDArray[np.float32]) -> None:  # in place: a large stack must not exist twice
            image[:] = self.through_lens(image, camera, roi)

        def of_projector(image: NDArray[np.float32]) -> None:
            through_lens(image)
            if speckle is not None:  # of the projector's light alone
                if separate:
                    image -= others[0]
                image *= speckle.gain
                if separate:
                    image += others[0]

        for image in others:
            through_lens(image)
        in_threads(of_projector, lit)
        if self.sensor.room is not None:
            images += self.room_light(scene, world_from_sensor, camera, roi)
        return images[: self.patterns.count + ambient_image]

    def room_light(self, scene: Scene, world_from_sensor: Transform, camera: str, roi: Roi) -> NDArray[np.float32]:
        """Radiance (h, w) [W / (mm^2 sr)] of the sensor's own [room], behind the lens.

        Its gradient is that along the sensor frame's axes at the middle of the working range, whatever the camera.
        """
        lit = room_radiance(scene, directional_albedos(scene), self.middles[camera], world_from_sensor)[roi.slices]
        eye, depth = self.sensor.rig.cameras[camera], float(np.mean(self.sensor.working_range_mm))
        pixels = np.stack(roi.pixels(), axis=-1).astype(float)
        rays = eye.sensor_from_camera.directions(eye.rays(pixels))
        points = eye.centre + rays * ((depth - eye.centre[2]) / rays[..., 2:])
        return self.through_lens(np.asarray(lit * self.sensor.room_irradiance(points), np.float32), camera, roi)

    def through_lens(self, image: NDArray[np.float32], camera: str, roi: Roi) -> NDArray[np.float32]:
        """Blur the image (h, w) of a region by a camera's lens, and darken it toward the corners."""
        loss = self.corner_loss[camera]
        out = through_point_spread(image, self.sensor.imager, self.sensor.rig.cameras[camera], roi)
        return out if loss is None else np.asarray(out * loss[roi.slices], np.float32)

    def light(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        *,
        seed: int,
        rendering: Rendering = _USUAL,
        around: NDArray[np.floating] | None = None,
        noise: Noise | None = None,
    ) -> LightOnImagers:
        """What reaches the imagers from one pose, ready to be exposed: :meth:`expose`.

        Parameters
        ----------
        seed
            Of the render and of the speckle, which belongs to the surface and to the pose.
        around
            (n, 3) points in the *sensor* frame [mm]: of each image, only their bounding box and 12 px more are read
            out. The rest is at grey level 0, and ``settings["read_out"]`` gives the region of every camera that has one
            as [left, top, width, height].
        noise
            Which sources of noise are on; all by default.
        """
        noise, sensor, before = noise or Noise(), self.sensor, rendering.before
        light, rois = {}, {}
        for index, (name, camera) in enumerate(sensor.rig.cameras.items()):
            near = None if around is None else roi_around(camera, around, _MARGIN_PX)
            roi = rois[name] = before.rois[name] if before is not None else near or self.rays[name].whole
            render, _, grain = np.random.SeedSequence([seed, index]).spawn(3)
            speckle = None
            if noise.speckle:
                rng = np.random.default_rng(grain)
                speckle = draw_speckle(scene, sensor, camera, self.middles[name], world_from_sensor, roi, rng)
            light[name] = self.radiance(
                scene,
                world_from_sensor,
                name,
                rendering,
                seed=int(render.generate_state(1)[0]),
                roi=roi,
                speckle=speckle,
            )
        for name, stack in light.items():
            self._check_finite(stack, f"camera {name}", "radiance")
        exposures = sensor.exposure.exposures(brightest(sensor, light), sensor.imager.full_well)
        self._check_finite(np.array(exposures) * sensor.electrons(), "imager", "electrons per radiance")
        rendered: dict[str, Any] = {"scene": scene.where, "samples_per_pixel": rendering.samples}
        rendered["light_path_depth"] = rendering.surfaces
        if rendering.indirectly is not None:
            rendered["indirect_light"] = asdict(rendering.indirectly)
        return LightOnImagers(light, rois, exposures, noise, world_from_sensor, rendered)

    def _check_finite(self, values: NDArray[np.floating], where: str, what: str) -> None:
        """Refuse light that is no number before it becomes an image of zeros."""
        if not np.isfinite(values.sum(dtype=np.float64)):
            raise InputError(
                f"sensor {self.sensor.name}",
                where,
                f"{what} that is infinite or no number",
                "finite light: check the optics, flux_w and the scene's own emitters",
            )

    def expose(self, light: LightOnImagers, seed: int) -> Capture:
        """Expose the imagers to light: every seed is another capture from the same pose, of the same speckle."""
        noise, sensor, exposures = light.noise, self.sensor, light.exposures
        images = {}
        for index, name in enumerate(light.rois):
            _, draw, _ = np.random.SeedSequence([seed, index]).spawn(3)
            images[name] = exposed(sensor, light, name, self.units[name], draw)
        settings: dict[str, Any] = {
            "exposure_s": exposures[0] if len(exposures) == 1 else list(exposures),
            "exposure_rule": sensor.exposure.rule,
            "pattern": sensor.pattern.model_dump(mode="json"),
            **light.rendered,
            "ambient_image": sensor.ambient_image,
            "seed": seed,
            "noise": asdict(noise),
        }
        chip = converter(sensor.imager, noise)
        settings |= {"black_level_dn": chip.black_level, "gamma": chip.gamma}
        settings |= {"decoder": sensor.settings.model_dump(mode="json"), "imager": written_imager(sensor.imager)}
        read_out = {
            name: [roi.left, roi.top, roi.width, roi.height]
            for name, roi in light.rois.items()
            if roi != self.rays[name].whole
        }
        if read_out:
            settings["read_out"] = read_out
        return Capture(
            sensor=sensor.name,
            technology=sensor.technology,
            source="simulated",
            rig=sensor.rig,
            images=images,
            bits=chip.bits,
            settings=settings,
            world_from_sensor=light.world_from_sensor,
        )

    def capture(
        self,
        scene: Scene,
        world_from_sensor: Transform,
        *,
        seed: int,
        rendering: Rendering = _USUAL,
        around: NDArray[np.floating] | None = None,
        noise: Noise | None = None,
    ) -> Capture:
        """Take one capture: :meth:`light`, exposed once. Same seed, same bytes; give every capture its own."""
        light = self.light(scene, world_from_sensor, seed=seed, rendering=rendering, around=around, noise=noise)
        return self.expose(light, seed)


def _camera_rays(sensor: Sensor, camera: Camera) -> CameraRays:
    if sensor.focus_mm is None:
        return CameraRays(camera)
    return CameraRays(camera, sensor.pupil_mm(camera), sensor.focus_mm)


def _light(sensor: Sensor) -> Light:
    """What carries the sensor's code: the place in the projector, or time."""
    if isinstance(sensor.pattern, AmplitudeModulation):
        return ModulatedLight(sensor.projector, *sensor.pattern.images())
    return LitPatterns(sensor.patterns(), sensor.projector)
