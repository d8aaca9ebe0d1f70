"""Virtual measurements by rendering: one sensor before one part, in any number of drawn worlds.

Signal chain: view and trial -> world (:mod:`mitsim.virtual.world`) -> images of the part as the *true* sensor takes
them: direct light traced anew, light by way of other surfaces rendered once for a view and finish, room light, power,
exposure, noise -> cloud, decoded with the *nominal* calibration -> errors that are no light: path, temperature and form
of the part -> measured at the pose that the measurement is told -> error of every measurement.

Light by way of other surfaces is taken from the view's nominal pose and calibration. It is smooth, and the draws move
it by about a pixel. Trials in order of their finish (:func:`in_order`) render it once for each finish. With
``apart`` nothing is shared: every trial renders all of its light, from its own pose and with its own calibration. That
takes two to three times as long, and is what the approximation is judged by.

Temperature and form move the decoded points along with the surface, to first order: at 50 um on 500 mm the change of
where and how bright the surface is seen is far below a pixel and a grey level.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from characterisation.tasks.evaluation import measure
from mitsim.campaign.acquire import one_ahead
from mitsim.capture.capture import Capture
from mitsim.prediction import Predictor
from mitsim.reconstruction.cloud import capture_cloud, sensor_geometry
from mitsim.scene.light_transport.room_light import directional_albedos, room_radiance
from mitsim.scene.load import Scene, load_scene, share_kernels
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.scene.ray_casting.triangles import outermost
from mitsim.sensor.exposure import PlannedExposure
from mitsim.sensor.roi import roi_around
from mitsim.sensor.transforms import Transform
from mitsim.simulation.exposing import LightOnImagers
from mitsim.simulation.rendering import LaterLight, Rendering
from mitsim.simulation.simulate import SimulatedSensor
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.views import View
from mitsim.virtual.form import form_deviation
from mitsim.virtual.race import Job
from mitsim.virtual.world import Trial, Unknowns, World, finish_deviation

Floats = NDArray[np.float64]

#: pixels of an image that are traced around the part: for the blur of the lens and the reach of the matcher
_MARGIN_PX = 12

#: standard deviations of its placement by which the part may lie elsewhere and still be inside the window
_PLACEMENTS = 3.0


@dataclass(frozen=True)
class _Before:
    """What of a view's light is the same in all worlds of one finish."""

    view: int
    finish: int
    later: LaterLight
    room: dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Lit:
    """Light of one world on the imagers of a view, before it is exposed: one tracing for any number of exposures.

    ``light`` of the projector at its full nominal power, and ``room`` of everything else by camera, (h, w)
    [W / (mm^2 sr)] each; ``sensor`` of that world; ``told`` where the measurement believes that it stands.
    """

    sensor: SimulatedSensor
    light: LightOnImagers
    room: dict[str, NDArray[np.float32]]
    world: World
    told: Transform


@dataclass(frozen=True)
class _Taken:
    capture: Capture
    world: World
    told: Transform
    surfaces: Surfaces | None
    labels: NDArray[np.int16]


class RenderedMeasurements:
    """A sensor laid out on the device before a part, ready for any number of virtual measurements."""

    source = "render"

    def __init__(self, study: Study, unknowns: Unknowns, rendering: Rendering, apart: bool = False) -> None:
        self.study, self.unknowns, self.rendering, self.apart = study, unknowns, rendering, apart
        self.planned: PlannedExposure | None = None
        self.simulated = SimulatedSensor(study.sensor)
        self.geometry = sensor_geometry(study.sensor)
        self.predictor = Predictor.of_sensor(study.sensor, self.geometry)
        corners = outermost(study.scene)
        reach = _PLACEMENTS * unknowns.table.pose.placement_mm if "pose" in unknowns.varied else 0.0
        self.corners = np.concatenate([corners + step for step in reach * _DIAGONALS])
        self._scenes: dict[int, tuple[Scene, list[Floats]]] = {}
        self._before: _Before | None = None
        self._has_form = any(unknowns.table.form.features.values())

    def exposed_as(self, planned: PlannedExposure | None) -> RenderedMeasurements:
        """The same measurements with another exposure than the sensor's own; what is laid out is shared."""
        other = copy.copy(self)
        other.planned = planned
        return other

    def in_order(self, jobs: Iterable[Job]) -> list[Job]:
        """Jobs by finish and view: a finish is loaded once, and the light that jobs share is rendered once."""
        return sorted(jobs, key=lambda job: (self.unknowns.draw(job.trial).finish, job.view.number))

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, dict[str, float]]]:
        """Errors of every measurement, NaN where it has no value, job by job; one is decoded while the next renders."""
        return one_ahead(jobs, self._take, self._finish)

    def best_guess(self, view: View) -> tuple[Capture, PointCloud]:
        """Capture and labelled cloud of a view with every unknown at its best guess."""
        taken = self._taken(view, replace(self.unknowns, varied=()).draw(Trial(0)))
        return taken.capture, self._cloud(taken)

    def _take(self, job: Job) -> _Taken:
        return self._taken(job.view, self.unknowns.draw(job.trial))

    def cloud_of(self, view: View, world: World) -> tuple[PointCloud, Transform]:
        """Labelled cloud of a view in a world, and where the measurement believes that the sensor stands."""
        taken = self._taken(view, world)
        return self._cloud(taken), taken.told

    def measured(self, lit: Lit, planned: PlannedExposure | None) -> tuple[PointCloud, dict[str, float]]:
        """Labelled cloud of a world's light, exposed as planned, and the errors of every measurement.

        The light is kept, for other exposures of it.
        """
        taken = self._exposed(lit, planned, True)
        cloud = self._cloud(taken)
        return cloud, self._errors(cloud, taken)

    def _finish(self, taken: _Taken, job: Job) -> dict[str, float]:
        return self._errors(self._cloud(taken), taken)

    def _errors(self, cloud: PointCloud, taken: _Taken) -> dict[str, float]:
        found = measure(cloud, self.study.task, taken.told.inverse().matrix(), MINIMUM_POINTS, False)
        return {name: float(one.error) for name, one in found.items()}

    def _taken(self, view: View, world: World) -> _Taken:
        return self._exposed(self.lit(view, world), self.planned, False)

    def _exposed(self, lit: Lit, planned: PlannedExposure | None, keep: bool) -> _Taken:
        world = lit.world
        capture = self.exposed(lit, planned, world.seed, keep)
        labels = self.predictor.quick_labels(self.study.scene, lit.told)
        surfaces = self.predictor.surfaces(self.study.scene, lit.told) if self._has_form and world.form else None
        return _Taken(capture, world, lit.told, surfaces, labels)

    def lit(self, view: View, world: World) -> Lit:
        """Trace the light of a world in a view: what all of its exposures have in common."""
        true, told = (motion.inverse() @ view.world_from_sensor for motion in (world.placed, world.told))
        sensor = self.simulated.moved(world.rig, world.unit)
        scene = self._scene(world.finish)[0]
        if self.apart:
            before = self._light_before(sensor, true, view, world.finish, world.seed)
        else:
            before = self._shared(view, world.finish)
        light = sensor.light(scene, true, seed=world.seed, rendering=replace(self.rendering, indirect=before.later))
        return Lit(sensor, light, before.room, world, told)

    def exposed(self, lit: Lit, planned: PlannedExposure | None, seed: int, keep: bool = False) -> Capture:
        """Expose light as planned, or by the sensor's own rule; every ``seed`` is another capture.

        The light is used up unless it is to be kept: it may be large, and exists once.
        """
        world, known = lit.world, self.study.sensor.room is not None
        power = world.power * (1.0 if planned is None else planned.power)
        exposures = lit.light.exposures if planned is None else planned.exposures_s
        radiance = {name: images.copy() for name, images in lit.light.radiance.items()} if keep else lit.light.radiance
        for name, images in radiance.items():
            images *= np.float32(power)
            if not known:  # else it is in the light
                images += lit.room[name] * np.float32(world.room)
        light = replace(
            lit.light, radiance=radiance, exposures=tuple(seconds * world.exposure for seconds in exposures)
        )
        return replace(lit.sensor.expose(light, seed), rig=self.study.sensor.rig)

    def unlabelled_cloud(self, capture: Capture) -> PointCloud:
        """Decode a capture of this sensor with its nominal calibration; nothing that is no light is added."""
        sensor = self.study.sensor
        return capture_cloud(capture, sensor.settings, self.geometry, imager=sensor.imager)

    def _cloud(self, taken: _Taken) -> PointCloud:
        scene, cloud = self.study.scene, self.unlabelled_cloud(taken.capture)
        points = displaced(cloud, taken.world, taken.told, scene.centre)
        if taken.surfaces is not None:
            form = self.unknowns.table.form.features
            points = form_deviation(points, taken.surfaces, scene, form, taken.told, cloud.grid, taken.world.form)
        return replace(cloud, points=points, feature=taken.labels, feature_names=scene.names)

    def _scene(self, finish: int) -> tuple[Scene, list[Floats]]:
        """The part in the finishes of a number, and the directional albedos of its shapes."""
        if finish not in self._scenes:
            self._scenes.clear()  # Dr.Jit traces a call to a material for those of every scene that is kept
            file, scene = self.study.file, self.study.scene
            if finish >= 0:
                parameters = {name: str(value) for name, value in file.parameters.items()}
                scene = share_kernels(
                    load_scene(
                        scene.where,
                        self.study.sensor.wavelength_nm,
                        parameters,
                        lambda name: finish_deviation(self.unknowns, finish, name),
                    )
                )
            self._scenes[finish] = scene, directional_albedos(scene)
        return self._scenes[finish]

    def _shared(self, view: View, finish: int) -> _Before:
        if self._before is not None and (self._before.view, self._before.finish) == (view.number, finish):
            return self._before
        self._before = None  # first give back the memory
        self._before = self._light_before(self.simulated, view.world_from_sensor, view, finish, self.unknowns.seed)
        return self._before

    def _light_before(self, simulated: SimulatedSensor, pose: Transform, view: View, finish: int, seed: int) -> _Before:
        """Light by way of other surfaces and of the room, from a pose of a view, with the draws of a seed."""
        scene, albedos = self._scene(finish)
        how = self.rendering.indirectly
        assert how is not None  # rendering_of a study
        around = view.world_from_sensor.inverse().points(self.corners)
        images, rois, room = {}, {}, {}
        for index, (name, camera) in enumerate(simulated.sensor.rig.cameras.items()):
            roi = roi_around(camera, around, _MARGIN_PX) or simulated.rays[name].whole
            stream = np.random.SeedSequence([seed, view.number, finish + 1, index])
            if self.rendering.depth > 1:
                seed_of_render = int(stream.generate_state(1)[0])
                images[name] = simulated.later_light(
                    scene, pose, name, how, seed=seed_of_render, depth=self.rendering.depth, roi=roi
                )
            else:
                images[name] = np.zeros((0, roi.height, roi.width), np.float32)
            lit = room_radiance(scene, albedos, simulated.middles[name], pose)[roi.slices]
            rois[name], room[name] = roi, simulated.through_lens(lit, name, roi)
        later = LaterLight(images, rois, how, self.rendering.depth)
        return _Before(view.number, finish, later, room)


#: corners of a cube, to widen the box of a part by a shift in any direction
_DIAGONALS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def displaced(
    cloud: PointCloud, world: World, world_from_sensor: Transform, centre: Sequence[float] | Floats
) -> NDArray[np.float32]:
    """Points (H, W, 3) [mm] of a cloud with the errors of the path's length and the expansion of the part.

    The part expands about its middle.
    """
    known = cloud.valid
    points = cloud.points[known].astype(float)
    offset, scale = world.path
    if offset or scale:
        away = points - cloud.grid.origin
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        points = cloud.grid.origin + away * (1 + scale + offset / length)
    if world.expansion:
        middle = world_from_sensor.inverse().points(np.asarray(centre, float))
        points = middle + (1 + world.expansion) * (points - middle)
    out = cloud.points.copy()
    out[known] = points
    return out
