"""Measure a part in one world of the laboratory.

Signal chain: number of the world -> its draw of the study's own unknowns -> true calibration, finish, pose, light ->
images by stock Mitsuba and the laboratory's imager -> cloud by each decoder, with the nominal calibration -> errors of
temperature -> measurements at the assumed pose -> errors.

Only what the laboratory is meant to vary differs from the tool: renderer, surfaces, mask, speckle, imager, decoder.
Geometry that a measurement uses by itself, such as the labels of pixels from the drawing at the assumed pose, is the
tool's, as it would be with a real sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.tasks.evaluation import measure
from mitsim.capture.capture import Capture
from mitsim.decode.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.scene.load import load_scene
from mitsim.scene.surface.metals import normal_reflectance
from mitsim.scene.surface.scatter import LARGEST_DEVIATION, Deviation
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.transforms import Transform
from mitsim.study import MINIMUM_POINTS
from mitsim.study.virtual.rendered import displaced
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.world import Trial, World
from tests.proofs.laboratory.cases import Judged
from tests.proofs.laboratory.decoders import decoded
from tests.proofs.laboratory.finishes import Surface, surface_of
from tests.proofs.laboratory.imager import Exposed, grey_levels, speckle_contrast
from tests.proofs.laboratory.masks import another_mask
from tests.proofs.laboratory.optics import IdealProjector, Lamp, RayBundle, light_on, regions, room_light_on
from tests.proofs.laboratory.part import LaboratoryPart

#: offset of the seed of the laboratory's worlds from the study's: no trial of a tool shares one
SEED = 5 << 20

#: pixels around the part
_MARGIN_PX = 12


@dataclass(frozen=True)
class Light:
    """Light of a world on the cameras, by name, in regions ``rois``.

    ``projected`` (P, h, w) is that of the projector and ``room`` (h, w) that of a room of irradiance 1
    [W / (mm^2 sr)]. ``contrast`` (h, w) is that of the speckle.
    """

    rois: dict[str, Roi]
    projected: dict[str, NDArray[np.float32]]
    room: dict[str, NDArray[np.float32]]
    contrast: dict[str, NDArray[np.float32]]


class Laboratory:
    """A part before a sensor, ready for any number of worlds of one case, family and mask.

    Raises
    ------
    InputError
        If the sensor modulates its light in time, takes brackets, or chooses its exposure by the scene.
    """

    def __init__(self, row: Judged) -> None:
        self.row, self.study = row, row.study()
        sensor, where = self.study.sensor, f"sensor {self.study.sensor.name}"
        if isinstance(sensor.pattern, AmplitudeModulation) or sensor.exposure.base_s is None or sensor.exposure.bracket:
            raise InputError(row.path, where, "its light or its exposure", "a pattern, and one fixed exposure")
        self.sensor, self.view = sensor, row.view_of(self.study)
        unknowns = study_unknowns(self.study)
        self.unknowns = replace(unknowns, seed=unknowns.seed + SEED, pooled=False)
        self.geometry = sensor_geometry(sensor)
        self.predictor = Predictor.of_sensor(sensor, self.geometry)
        self.patterns = sensor.patterns()
        self.ideal = IdealProjector.around(sensor.projector.optics)
        surfaces = self.surfaces(0)
        self.part = LaboratoryPart(row.scene_path, row.scene.parameters, surfaces, self.ideal.description())

    def surfaces(self, number: int) -> dict[str, Surface]:
        """Return the materials of all faces in a world, by shape."""
        scene, ranges = self.study.scene, self.unknowns.table.finish
        names = sorted({finish.name + str(finish.roughness) for finish in scene.finishes if finish is not None})
        rng = np.random.default_rng([self.unknowns.seed, 11, number])
        drawn = np.clip(rng.standard_normal((len(names), 3)), -LARGEST_DEVIATION, LARGEST_DEVIATION)
        scale = np.array([ranges.alpha, ranges.wide_angle, ranges.reflectance])
        by_bsdf = dict(zip(self._bsdf_ids(), [finish for finish in scene.finishes], strict=True))
        deviation = {
            bsdf: Deviation(*(drawn[names.index(finish.name + str(finish.roughness))] * scale).tolist())
            for bsdf, finish in by_bsdf.items()
            if finish is not None
        }
        given = {key: str(value) for key, value in self.row.scene.parameters.items()}
        loaded = load_scene(scene.where, self.sensor.wavelength_nm, given, lambda name: deviation[name])
        out = {}
        for name, finish, bsdf in zip(loaded.names, loaded.finishes, self._bsdf_ids(), strict=True):
            reflected = 1.0
            if finish is not None and "/" in finish.name:
                bright = normal_reflectance(finish.name.partition("/")[0], self.sensor.wavelength_nm)
                reflected = deviation[bsdf].reflected(bright)
            out[name] = surface_of(
                finish, self.row.family, self.sensor.wavelength_nm, reflected, f"{scene.where}: {name}"
            )
        return out

    def _bsdf_ids(self) -> list[str]:
        return [shape.bsdf().id() for shape in self.study.scene.shapes]

    def measure(self, number: int, decoders: Sequence[str]) -> dict[str, Outcome]:
        """Return the outcome of the world of a number by each decoder."""
        world = self.unknowns.draw(Trial(number))
        true, assumed = (
            motion.inverse() @ self.view.world_from_sensor for motion in (world.placed, world.assumed)
        )
        capture = self.capture(number, world, true)
        labels = self.predictor.quick_labels(self.study.scene, assumed)
        out = {}
        for decoder in decoders:
            cloud = decoded(capture, self.sensor, self.geometry, decoder, world.seed)
            points = displaced(cloud, world, assumed, self.study.scene.centre)
            cloud = replace(cloud, points=points, feature=labels, feature_names=self.study.scene.names)
            pose = assumed.inverse().matrix()
            out[decoder] = Outcome.of(measure(cloud, self.study.task, pose, MINIMUM_POINTS, False))
        return out

    def light(self, number: int, world: World, true: Transform) -> Light:
        """Return the light of a world on the cameras, from the true pose of the sensor."""
        surfaces = self.surfaces(number)
        self.part.finish(surfaces)
        cameras = self.sensor.misaligned(world.rig).cameras
        rois = regions(cameras, self.study.scene.bounds, true, _MARGIN_PX)
        rays = {name: RayBundle.of(camera, true, rois[name]) for name, camera in cameras.items()}
        optics = world.rig.projector or self.sensor.projector.optics
        lamp = Lamp(self.sensor.projector, optics, self._patterns(world))
        lit = light_on(self.part, self.ideal, lamp, rays, true, self.row.file.paths, world.seed)
        room = room_light_on(self.part, rays, world.seed)
        contrast = {}
        for name, bundle in rays.items():
            heights = [surfaces[shape].height_um for shape in self.part.names]
            known = [speckle_contrast(self.sensor, cameras[name], height) for height in heights]
            met = self.part.shapes_met(bundle.origin, bundle.middle)
            contrast[name] = np.where(met >= 0, np.array(known)[met], 0.0).astype(np.float32)

        def shaped(images: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
            return {
                name: image.reshape(*image.shape[:-1], rois[name].height, rois[name].width)
                for name, image in images.items()
            }

        return Light(rois, shaped(lit), shaped(room), shaped(contrast))

    def capture(self, number: int, world: World, true: Transform) -> Capture:
        """Return the images of a world, with the nominal calibration."""
        sensor, light = self.sensor, self.light(number, world, true)
        base = sensor.exposure.base_s
        assert base is not None
        seconds, images = base * world.exposure, {}
        for index, (name, camera) in enumerate(sensor.rig.cameras.items()):
            how = Exposed(camera, light.rois[name], seconds, world.unit + index, world.seed + index)
            projected = light.projected[name] * np.float32(world.power)
            if sensor.ambient_image:
                projected = np.concatenate([projected, np.zeros_like(projected[:1])])
            room = light.room[name] * np.float32(world.room)
            images[name] = grey_levels(sensor, how, projected, room, light.contrast[name])
        settings = {
            "exposure_s": seconds,
            "pattern": sensor.pattern.model_dump(mode="json"),
            "ambient_image": sensor.ambient_image,
            "black_level_dn": sensor.imager.black_level,
            "gamma": sensor.imager.gamma,
            "read_out": {
                name: [roi.left, roi.top, roi.width, roi.height]
                for name, roi in light.rois.items()
                if (roi.width, roi.height) != (sensor.rig.cameras[name].width, sensor.rig.cameras[name].height)
            },
        }
        return Capture(
            sensor.name,
            sensor.technology,
            "simulated",
            sensor.rig,
            images,
            sensor.imager.bits,
            settings,
            world_from_sensor=self.view.world_from_sensor,
        )

    def _patterns(self, world: World) -> NDArray[np.float32]:
        pattern, optics = self.sensor.pattern, self.sensor.projector.optics
        if self.row.mask == "preset" or not isinstance(pattern, RandomDots):
            return self.patterns
        return another_mask(pattern, optics.width, optics.height, world.seed)
