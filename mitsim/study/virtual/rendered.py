"""Virtual measurements by rendering: one sensor and one part in any number of random draws.

Signal chain: view and trial -> draw (:mod:`mitsim.study.virtual.world`) -> images of the part by the *true* sensor:
direct light traced for every trial, interreflections rendered once for a view and finish, room light, power, exposure,
noise -> cloud, decoded with the *nominal* calibration -> errors other than light: path, temperature and form of the
part -> measurement at the assumed pose -> error of every measurement.

Interreflections are rendered at the nominal pose and calibration of the view. They are smooth, and the random pose and
calibration shift them by about a pixel. Trials sorted by finish (:func:`in_order`) render them once for each finish.
With ``separate_light``, every trial renders all of its light at its own pose and calibration. That takes two to three
times as long, and is the reference for this approximation.

Temperature and form displace the decoded points together with the surface, to first order. At 50 um on 500 mm, the
change of the image position is far below a pixel, and that of the brightness far below a grey level.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from characterisation.tasks.evaluation import measure
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.exposing import LightOnImagers
from mitsim.capture.simulated.rendering import IndirectImages, Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.campaign.acquire import one_ahead
from mitsim.maps.prediction import Predictor
from mitsim.scene.light_transport.room_light import directional_albedos, room_radiance
from mitsim.scene.load import Scene, load_scene
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.scene.ray_casting.triangles import hull_corners
from mitsim.sensor.exposure import PlannedExposure
from mitsim.sensor.roi import roi_around
from mitsim.sensor.transforms import Transform
from mitsim.study import MINIMUM_POINTS, Study
from mitsim.study.virtual.drawn_finish import finish_deviation
from mitsim.study.virtual.form import form_deviation
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.world import DrawnValues, Trial, Unknowns
from mitsim.views import View

Floats = NDArray[np.float64]

#: pixels traced around the part, for the blur of the lens and the blocks of the matcher
_MARGIN_PX = 12

#: number of standard deviations of its placement by which the part may be displaced and still be inside the window
_PLACEMENTS = 3.0


@dataclass(frozen=True)
class _SharedLight:
    """Light of a view that is the same in all draws of one finish: interreflections, and the light of the room."""

    view: int
    finish: int
    indirect: IndirectImages
    room: dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class TracedLight:
    """Light of one draw on the imagers of a view before exposure: one tracing serves any number of exposures.

    ``light`` is that of the projector at its nominal power, ``room`` all other light by camera, (h, w) [W / (mm^2 sr)]
    each. ``sensor`` is the true sensor of the draw. ``assumed`` is the assumed pose of the sensor.
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
        self.simulated = SimulatedSensor(study.sensor)
        self.geometry = sensor_geometry(study.sensor)
        self.predictor = Predictor.of_sensor(study.sensor, self.geometry)
        corners = hull_corners(study.scene)
        reach = _PLACEMENTS * unknowns.table.pose.placement_mm if "pose" in unknowns.varied else 0.0
        self.corners = np.concatenate([corners + step for step in reach * _CUBE_CORNERS])
        self._scenes: dict[int, tuple[Scene, list[Floats]]] = {}
        self._cached: _SharedLight | None = None
        self._has_form = any(unknowns.table.form.features.values())

    def exposed_as(self, planned: PlannedExposure | None) -> RenderedMeasurements:
        """Return the same measurements with other exposures than the sensor's own; prepared data is shared."""
        other = copy.copy(self)
        other.planned = planned
        return other

    def in_order(self, jobs: Iterable[Job]) -> list[Job]:
        """Return the jobs sorted by finish and view: a finish is loaded once, and shared light is rendered once."""
        return sorted(jobs, key=lambda job: (self.unknowns.draw(job.trial).finish, job.view.number))

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

    def _finish(self, captured: _Captured, job: Job) -> Outcome:
        cloud, part_from_world = self._cloud(captured), captured.assumed.inverse().matrix()
        return Outcome.of(measure(cloud, self.study.task, part_from_world, MINIMUM_POINTS, False))

    def _captured(self, view: View, drawn: DrawnValues) -> _Captured:
        lit = self.lit(view, drawn)
        capture = self.exposed(lit, self.planned, drawn.seed)
        labels = self.predictor.quick_labels(self.study.scene, lit.assumed)
        surfaces = self.predictor.surfaces(self.study.scene, lit.assumed) if self._has_form and drawn.form else None
        return _Captured(capture, drawn, lit.assumed, surfaces, labels)

    def lit(self, view: View, drawn: DrawnValues) -> TracedLight:
        """Trace the light of one draw in a view, which all of its exposures share."""
        true, assumed = (motion.inverse() @ view.world_from_sensor for motion in (drawn.placed, drawn.assumed))
        sensor = self.simulated.recalibrated(drawn.rig, drawn.unit)
        scene = self._scene(drawn.finish)[0]
        if self.separate_light:
            shared = self._render_shared_light(sensor, true, view, drawn.finish, drawn.seed)
        else:
            shared = self._shared_with(view, drawn.finish)
        light = sensor.light(scene, true, seed=drawn.seed, rendering=replace(self.rendering, indirect=shared.indirect))
        return TracedLight(sensor, light, shared.room, drawn, assumed)

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
        drawn, known = lit.drawn, self.study.sensor.room is not None
        power = drawn.power * (1.0 if planned is None else planned.power)
        exposures = lit.light.exposures if planned is None else planned.exposures_s
        radiance = {name: images.copy() for name, images in lit.light.radiance.items()} if keep else lit.light.radiance
        for name, images in radiance.items():
            images *= np.float32(power)
            if not known:  # a known room is part of the traced light
                images += lit.room[name] * np.float32(drawn.room)
        light = replace(
            lit.light, radiance=radiance, exposures=tuple(seconds * drawn.exposure for seconds in exposures)
        )
        return replace(lit.sensor.expose(light, seed), rig=self.study.sensor.rig)

    def unlabelled_cloud(self, capture: Capture) -> PointCloud:
        """Decode a capture of this sensor with its nominal calibration, without path, temperature and form errors."""
        sensor = self.study.sensor
        return capture_cloud(capture, sensor.settings, self.geometry, imager=sensor.imager)

    def _cloud(self, captured: _Captured) -> PointCloud:
        scene, cloud = self.study.scene, self.unlabelled_cloud(captured.capture)
        points = displaced(cloud, captured.drawn, captured.assumed, scene.centre)
        if captured.surfaces is not None:
            form = self.unknowns.table.form.features
            seed = captured.drawn.form
            points = form_deviation(points, captured.surfaces, scene, form, captured.assumed, cloud.grid, seed)
        return replace(cloud, points=points, feature=captured.labels, feature_names=scene.names)

    def _scene(self, finish: int) -> tuple[Scene, list[Floats]]:
        """Return the part in the finishes of a number, and the directional albedos of its shapes."""
        if finish not in self._scenes:
            self._scenes.clear()  # Dr.Jit compiles a material call for the materials of every scene in memory
            file, scene = self.study.file, self.study.scene
            if finish >= 0:
                parameters = {name: str(value) for name, value in file.parameters.items()}
                wavelength_nm = self.study.sensor.wavelength_nm
                drawn = partial(finish_deviation, self.unknowns, finish)
                scene = load_scene(scene.where, wavelength_nm, parameters, drawn)
            self._scenes[finish] = scene, directional_albedos(scene)
        return self._scenes[finish]

    def _shared_with(self, view: View, finish: int) -> _SharedLight:
        if self._cached is None or (self._cached.view, self._cached.finish) != (view.number, finish):
            self._cached = None  # release the memory first
            pose, seed = view.world_from_sensor, self.unknowns.seed
            self._cached = self._render_shared_light(self.simulated, pose, view, finish, seed)
        return self._cached

    def _render_shared_light(
        self, simulated: SimulatedSensor, pose: Transform, view: View, finish: int, seed: int
    ) -> _SharedLight:
        """Render interreflections and room light from a pose of a view, with the draws of a seed."""
        scene, albedos = self._scene(finish)
        how = self.rendering.indirect_settings
        assert how is not None  # rendering_of a study
        around = view.world_from_sensor.inverse().points(self.corners)
        images, rois, room = {}, {}, {}
        for index, (name, camera) in enumerate(simulated.sensor.rig.cameras.items()):
            roi = roi_around(camera, around, _MARGIN_PX) or simulated.rays[name].whole
            stream = np.random.SeedSequence([seed, view.number, finish + 1, index])
            if self.rendering.depth > 1:
                seed_of_render = int(stream.generate_state(1)[0])
                images[name] = simulated.indirect_radiance(
                    scene, pose, name, how, seed=seed_of_render, depth=self.rendering.depth, roi=roi
                )
            else:
                images[name] = np.zeros((0, roi.height, roi.width), np.float32)
            lit = room_radiance(scene, albedos, simulated.pixel_rays(name), pose)[roi.slices]
            rois[name], room[name] = roi, simulated.apply_lens(lit, name, roi)
        indirect = IndirectImages(images, rois, how, self.rendering.depth)
        return _SharedLight(view.number, finish, indirect, room)


#: corners of a cube, which widen the box of a part by a shift in any direction
_CUBE_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def displaced(
    cloud: PointCloud, drawn: DrawnValues, world_from_sensor: Transform, centre: Sequence[float] | Floats
) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm] of a cloud with the errors of the path length and the expansion of the part.

    The part expands about its middle.

    Parameters
    ----------
    cloud
        Organised cloud, sensor frame.
    drawn
        Drawn errors of a trial: of the path length (offset [mm] and scale) and of the expansion of the part.
    world_from_sensor
        Pose of the sensor that the evaluation assumes.
    centre
        Middle (3,) of the part [mm], part frame.
    """
    known = cloud.valid
    points = cloud.points[known].astype(float)
    offset, scale = drawn.path
    if offset or scale:
        away = points - cloud.grid.origin
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        points = cloud.grid.origin + away * (1 + scale + offset / length)
    if drawn.expansion:
        middle = world_from_sensor.inverse().points(np.asarray(centre, float))
        points = middle + (1 + drawn.expansion) * (points - middle)
    out = cloud.points.copy()
    out[known] = points
    return out
