"""Virtual measurements by rendering: one sensor and one part in any number of random draws.

Signal chain: view and trial -> draw (:mod:`mitsim.study.virtual.world`) -> images of the part by the *true* sensor:
direct light traced for every trial, interreflections on the kept paths of the view with the finish of the trial, room
light, power, exposure, noise -> cloud, decoded with the *nominal* calibration -> errors other than light: path,
temperature and form of the part -> measurement at the assumed pose -> error of every measurement.

The paths of interreflections are those of the nominal pose and calibration of the view
(:mod:`mitsim.capture.simulated.kept_light`). Their images, and those of the room light, move to where the random pose
and calibration show the part, and the code that they carry to where the part is in the pattern
(:mod:`mitsim.capture.simulated.image_motion`). Trials of a view that follow one another
trace its paths once. With ``separate_light``, every trial renders all of its light at its own pose and calibration.
That takes several times as long, and is the reference for this approximation. The interreflections of scenes with
emitters, or with finishes inside other BSDFs, are rendered anew for every finish.

Temperature and form displace the decoded points together with the surface, to first order. At 50 um on 500 mm, the
change of the image position is far below a pixel, and that of the brightness far below a grey level.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from characterisation.tasks.evaluation import measure
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.exposing import LightOnImagers
from mitsim.capture.simulated.image_motion import code_motion, image_motion, moved_images
from mitsim.capture.simulated.indirect_light import IndirectLight
from mitsim.capture.simulated.kept_light import KeptLight, can_be_kept, keep_light, light_on_paths
from mitsim.capture.simulated.render_residual import RenderResidual, residual_of
from mitsim.capture.simulated.rendering import IndirectImages, Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.campaign.acquire import one_ahead
from mitsim.maps.prediction import Predictor
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.scene.ray_casting.triangles import hull_corners
from mitsim.sensor.exposure import PlannedExposure
from mitsim.sensor.pattern import DotPattern, another_mask
from mitsim.sensor.room_light import exposures_in_room
from mitsim.sensor.transforms import Transform
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.study.virtual.displacement import RealFaces
from mitsim.study.virtual.drawn_decoder import drawn_decoder
from mitsim.study.virtual.drawn_finish import DrawnPart
from mitsim.study.virtual.form import measured_with_form
from mitsim.study.virtual.light_file import read_light
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.view_light import LightOfViews, ViewLight, regions, seen_surfaces
from mitsim.study.virtual.world import DrawnValues, Trial, Unknowns
from mitsim.views import View

#: number of standard deviations of its placement by which the part may be displaced and still be inside the window
_PLACEMENTS = 3.0

#: finishes in whose light the paths to keep are chosen, beside the best estimate: numbers of draws
_PROBING_FINISHES = (101, 102, 103, 104)

#: corners of a cube, which widen the box of a part by a shift in any direction
_CUBE_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclass(frozen=True)
class TracedLight:
    """Light of one draw on the imagers of a view before exposure: one tracing serves any number of exposures.

    ``light`` is at the projector's nominal power, with that of lamps and of a known room. ``room`` is that of a room
    that is not known by camera, (h, w) [W / (mm^2 sr)]. ``sensor`` is the true sensor of the draw. ``assumed`` is the
    assumed pose of the sensor.
    """

    sensor: SimulatedSensor
    light: LightOnImagers
    room: dict[str, NDArray[np.float32]]
    drawn: DrawnValues
    assumed: Transform


@dataclass(frozen=True)
class _Captured:
    capture: Capture
    drawn: DrawnValues
    assumed: Transform
    surfaces: Surfaces | None
    labels: NDArray[np.int16]


class RenderedMeasurements:
    """A sensor prepared on the device for any number of virtual measurements of one part."""

    source = "render"

    def __init__(self, study: Study, unknowns: Unknowns, rendering: Rendering, separate_light: bool = False) -> None:
        self.study, self.unknowns, self.rendering, self.separate_light = study, unknowns, rendering, separate_light
        self.planned: PlannedExposure | None = None
        self.light_file: str | None = None  # that of the light of the next view (mitsim/study/virtual/light_file.py)
        self.simulated = SimulatedSensor(study.sensor)
        self.geometry = sensor_geometry(study.sensor)
        self.predictor = Predictor.of_sensor(study.sensor, self.geometry)
        self.hull = corners = hull_corners(study.scene)
        pose, sizes = unknowns.table.pose, _PLACEMENTS if "pose" in unknowns.varied else 0.0
        reach = sizes * pose.placement_mm
        self.corners = np.concatenate([corners + step for step in reach * _CUBE_CORNERS])
        arms = np.linalg.norm(corners - unknowns.centre, axis=1, keepdims=True)
        reaches = reach + sizes * np.radians(pose.placement_deg) * arms
        self.turned_corners = np.concatenate([corners + reaches * step for step in _CUBE_CORNERS])
        self.part, self.views = DrawnPart(study, unknowns), LightOfViews()
        self.faces = RealFaces(study.scene, study.task, unknowns.table)

    def exposed_as(self, planned: PlannedExposure | None) -> RenderedMeasurements:
        """Return the same measurements with other exposures than the sensor's own; prepared data is shared."""
        other = copy.copy(self)
        other.planned = planned
        return other

    def rendered_as(self, rendering: Rendering) -> RenderedMeasurements:
        """Return the same measurements with other light paths; prepared data is shared, but for those of views."""
        if rendering == self.rendering:
            return self
        other = copy.copy(self)
        other.rendering, other.views = rendering, LightOfViews()
        return other

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Outcome]]:
        """Yield the outcome of every virtual measurement, job by job.

        A capture is decoded while the next is rendered.
        """
        return one_ahead(jobs, self._take, self._finish)

    def at_best_estimates(self, view: View) -> tuple[Capture, PointCloud]:
        """Return capture and labelled cloud of a view with every unknown at its best estimate."""
        captured = self._captured(view, replace(self.unknowns, varied=()).draw(Trial(0)))
        return captured.capture, self._cloud(captured)

    def _take(self, job: Job) -> _Captured:
        return self._captured(job.view, self.unknowns.draw(job.trial))

    def cloud_of(self, view: View, drawn: DrawnValues) -> tuple[PointCloud, Transform]:
        """Return the labelled cloud of a view for one draw, and the assumed pose of the sensor."""
        captured = self._captured(view, drawn)
        return self._cloud(captured), captured.assumed

    def outcome(self, capture: Capture, lit: TracedLight) -> Outcome:
        """Return the outcome of a capture of traced light, decoded and measured as in a trial."""
        return self._finish(self._with_labels(capture, lit.drawn, lit.assumed))

    def _finish(self, captured: _Captured, _: Job | None = None) -> Outcome:
        part_from_world = captured.assumed.inverse().matrix()
        decoded = self.unlabelled_cloud(captured.capture, captured.drawn.decoder)

        def evaluate(task: Task, with_form: bool) -> dict[str, Result]:
            cloud = self._labelled(captured, decoded, with_form)
            return measure(cloud, task, part_from_world, MINIMUM_POINTS, False)

        return Outcome.of(measured_with_form(self.study.task, evaluate, self.faces.deviate(captured.drawn)))

    def _captured(self, view: View, drawn: DrawnValues) -> _Captured:
        lit = self.lit(view, drawn)
        return self._with_labels(self.exposed(lit, self.planned, drawn.seed), drawn, lit.assumed)

    def _with_labels(self, capture: Capture, drawn: DrawnValues, assumed: Transform) -> _Captured:
        """Return a capture with the labels of its pixels and, if faces have moved, their nominal surfaces."""
        labels = self.predictor.quick_labels(self.study.scene, assumed)
        surfaces = self.predictor.surfaces(self.study.scene, assumed) if self.faces.lie_off(drawn) else None
        return _Captured(capture, drawn, assumed, surfaces, labels)

    def lit(self, view: View, drawn: DrawnValues) -> TracedLight:
        """Trace the light of one draw in a view, which all of its exposures share."""
        true, assumed = (motion.inverse() @ view.world_from_sensor for motion in (drawn.placed, drawn.assumed))
        sensor = self.simulated.recalibrated(drawn.rig, drawn.unit or None, self._mask(drawn.unit))
        pose = view.world_from_sensor
        shared = self._shared(sensor, true, view, False) if self.separate_light else self.view_light(view)
        scene, albedos = self.part.in_finish(drawn.finish)
        motions = {
            name: image_motion(self.simulated.rays[name].camera, pose, sensor.rays[name].camera, true, self.hull, roi)
            for name, roi in (() if self.separate_light else shared.rois.items())
        }
        images = self._indirect(sensor, scene, true, view, drawn, shared)
        if shared.kept:
            images = {name: moved_images(stack, motions.get(name)) for name, stack in images.items()}
        room = {}
        for name, surfaces in shared.seen.items():
            image = moved_images(surfaces.room_radiance(albedos)[None], motions.get(name))[0]
            room[name] = sensor.apply_lens(image, name, shared.rois[name])
        light = sensor.light(scene, true, seed=drawn.seed, rendering=self._with_indirect(images, shared.rois))
        if self.study.sensor.room is None:
            exposures = exposures_in_room(self.study.sensor, light.exposures, view.standoff, drawn.room)
            light = replace(light, exposures=exposures)
        return TracedLight(sensor, light, room, drawn, assumed)

    def _mask(self, unit: int) -> DotPattern | None:
        """Return the mask of dots of a unit; None for that of the sensor file."""
        pattern = self.study.sensor.pattern
        redrawn = unit > 0 and self.unknowns.table.unit.mask == "another"
        return another_mask(pattern, unit) if redrawn and isinstance(pattern, DotPattern) else None

    def residual(self, view: View) -> RenderResidual:
        """Return the errors of the light of a view's trials, at the best estimates, in its first camera."""
        best = replace(self.unknowns, varied=()).draw(Trial(0))
        camera, simulated, pose = next(iter(self.study.sensor.rig.cameras)), self.simulated, view.world_from_sensor
        rois = {camera: regions(simulated, pose.inverse(), self.corners, self.turned_corners)[camera]}

        def radiance(offset: int, finer: int) -> NDArray[np.float32]:
            other = self.rendered_as(self.rendering.finer(finer))
            other.unknowns = replace(self.unknowns, seed=self.unknowns.seed + offset)
            shared = ViewLight(rois, {}, other._kept(simulated, pose, view, rois) if self.keeps_paths else {})
            scene, _ = self.part.in_finish(best.finish)  # after the paths are kept, which tries other finishes
            images = other._indirect(simulated, scene, pose, view, best, shared)
            rendering = other._with_indirect(images, rois)
            return simulated.radiance(scene, pose, camera, rendering, seed=other.unknowns.seed, roi=rois[camera])

        return residual_of(radiance, self.study.sensor)

    def exposed(self, lit: TracedLight, planned: PlannedExposure | None, seed: int, keep: bool = False) -> Capture:
        """Expose light as planned, or by the sensor's own rule.

        Parameters
        ----------
        lit
            Traced light of a view.
        planned
            Exposure times and power; None for those of the sensor's rule.
        seed
            Selects the noise; every seed gives another capture.
        keep
            Whether to keep the light. Otherwise it is overwritten, since it may be large.

        See Also
        --------
        lit : the light
        """
        drawn, has_room = lit.drawn, self.study.sensor.room is not None
        power = drawn.power * (1.0 if planned is None else planned.power)
        exposures = lit.light.exposures if planned is None else planned.exposures_s
        radiance = {name: images.copy() for name, images in lit.light.radiance.items()} if keep else lit.light.radiance
        for name, images in radiance.items():
            other = lit.light.other.get(name)
            images *= np.float32(power)
            if other is not None:  # lamps and a known room
                images += other * np.float32(1 - power)
            if not has_room:  # a known room is part of the traced light
                images += lit.room[name] * np.float32(drawn.room)
        light = replace(
            lit.light, radiance=radiance, exposures=tuple(seconds * drawn.exposure for seconds in exposures)
        )
        return replace(lit.sensor.expose(light, seed), rig=self.study.sensor.rig)

    def unlabelled_cloud(self, capture: Capture, decoder: int = 0) -> PointCloud:
        """Decode a capture of this sensor with its nominal calibration, without path, temperature and form errors.

        ``decoder`` is the seed of a drawn decoder, 0 for that of the sensor file.
        """
        sensor = self.study.sensor
        settings = drawn_decoder(sensor, self.unknowns.table.decoder, decoder)
        return capture_cloud(capture, settings, self.geometry, imager=sensor.imager)

    def _cloud(self, captured: _Captured) -> PointCloud:
        return self._labelled(captured, self.unlabelled_cloud(captured.capture, captured.drawn.decoder), True)

    def _labelled(self, captured: _Captured, cloud: PointCloud, with_form: bool) -> PointCloud:
        return self.faces.labelled(
            cloud, captured.drawn, captured.assumed, captured.surfaces, captured.labels, with_form
        )

    def view_light(self, view: View) -> ViewLight:
        """Return what all draws of a view share, made at its nominal pose and calibration on first use."""
        make = partial(self._shared, self.simulated, view.world_from_sensor, view, self.keeps_paths)
        return self.views.of(view.number, make)

    @property
    def keeps_paths(self) -> bool:
        """Whether all trials of a view share the paths of its interreflections."""
        return self.rendering.depth > 1 and self.rendering.kept is not None and can_be_kept(self.study.scene)

    @property
    def _indirect_settings(self) -> IndirectLight:
        settings = self.rendering.indirect_settings
        assert settings is not None  # rendering_of a study
        return settings

    def _with_indirect(self, images: dict[str, NDArray[np.float32]], rois: dict[str, Roi]) -> Rendering:
        """Return the settings for the other light of a draw whose interreflections are rendered."""
        indirect = IndirectImages(images, rois, self._indirect_settings, self.rendering.depth)
        return replace(self.rendering, indirect=indirect)

    def _shared(self, simulated: SimulatedSensor, pose: Transform, view: View, keeps_paths: bool) -> ViewLight:
        """Return regions and seen surfaces from a pose of a view, and the paths of interreflections."""
        scene = self.study.scene
        rois = regions(simulated, view.world_from_sensor.inverse(), self.corners, self.turned_corners)
        kept = self._kept(simulated, pose, view, rois) if keeps_paths else {}
        return ViewLight(rois, seen_surfaces(simulated, scene, pose, rois), kept)

    def _kept(
        self, simulated: SimulatedSensor, pose: Transform, view: View, rois: dict[str, Roi]
    ) -> dict[str, KeptLight]:
        """Return the paths of interreflections in regions of the images, from a pose of a view."""
        traced = read_light(self.light_file, rois)
        if traced is not None:
            return light_on_paths(simulated, self.study.scene, pose, traced, self.rendering)
        numbers = (-1, *_PROBING_FINISHES) if "finish" in self.unknowns.varied else (-1,)
        finishes = map(self.part.scene_in, numbers)
        seed = _seed_of(self.unknowns.seed, view.number)
        return keep_light(simulated, self.study.scene, pose, rois, self.rendering, finishes, seed)

    def _indirect(
        self,
        simulated: SimulatedSensor,
        scene: Scene,
        pose: Transform,
        view: View,
        drawn: DrawnValues,
        shared: ViewLight,
    ) -> dict[str, NDArray[np.float32]]:
        """Return the interreflections (P, h, w) of a draw by camera.

        They are rendered from a pose, or on the kept paths, with the code of the pose in the images of the nominal one.
        """
        images, codes = {}, None
        if shared.kept:
            nominal, true = (sensor.patterns.projector.optics for sensor in (self.simulated, simulated))
            codes = code_motion(nominal, view.world_from_sensor, true, pose, self.hull)
        for index, (name, roi) in enumerate(shared.rois.items()):
            if self.rendering.depth == 1:
                images[name] = np.zeros((0, roi.height, roi.width), np.float32)
            elif shared.kept:
                images[name] = shared.kept[name].images(scene, simulated, codes)
            else:
                seed = drawn.seed if self.separate_light else self.unknowns.seed
                seed = _seed_of(seed, view.number, drawn.finish + 1, index)
                images[name] = simulated.indirect_radiance(
                    scene, pose, name, self._indirect_settings, seed=seed, depth=self.rendering.depth, roi=roi
                )
        return images


def _seed_of(*numbers: int) -> int:
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
