"""Measure a part in one world of the laboratory.

Signal chain: number of the world -> its draw of the study's own unknowns -> true calibration, finish, pose, light ->
images by stock Mitsuba and the laboratory's imager -> cloud by each decoder, with the nominal calibration -> errors of
temperature -> measurements at the assumed pose -> errors.

Only what the laboratory is meant to vary differs from the tool: renderer, surfaces, mask, speckle, imager, decoder.
Geometry that a measurement uses by itself, such as the labels of pixels from the drawing at the assumed pose, is the
tool's, as it would be with a real sensor.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.tasks.evaluation import measure
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.scene.surface.scatter import LARGEST_DEVIATION, Deviation
from mitsim.sensor.modulation import AmplitudeModulation
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.projector_images import described
from mitsim.sensor.room_light import exposures_in_room
from mitsim.sensor.transforms import Transform
from mitsim.study import MINIMUM_POINTS
from mitsim.study.virtual.displacement import displaced
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import Outcome
from mitsim.study.virtual.world import DrawnValues, Trial
from tests.proofs.laboratory.cases import Judged
from tests.proofs.laboratory.decoders import decoded
from tests.proofs.laboratory.finishes import Surface, surface_of
from tests.proofs.laboratory.imager import Exposed, grey_levels, speckle_contrast
from tests.proofs.laboratory.masks import another_mask
from tests.proofs.laboratory.optics import IdealProjector, Lamp, RayBundle, light_on, regions, room_light_on, smoothed
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
        If the sensor modulates its light in time, takes brackets, or chooses its exposure by the scene; if a decoder
        or a family does not suit the case.
    """

    def __init__(self, row: Judged) -> None:
        self.row, self.study = row, row.study()
        sensor, where = self.study.sensor, f"sensor {self.study.sensor.name}"
        if isinstance(sensor.pattern, AmplitudeModulation) or sensor.exposure.base_s is None or sensor.exposure.bracket:
            raise InputError(row.path, where, "light or exposures that no image shows", "patterns and a fixed exposure")
        others = [decoder for decoder in row.case.decoders if decoder != "ours"]
        if others and sensor.technology != "active_stereo":
            raise InputError(row.path, f"cases.{row.case.name}.decoders", others[0], f"'ours' for {sensor.name}")
        self.sensor, self.view = sensor, row.view_of(self.study)
        unknowns = study_unknowns(self.study)
        self.unknowns = replace(unknowns, seed=unknowns.seed + SEED)
        self.geometry = sensor_geometry(sensor)
        self.predictor = Predictor.of_sensor(sensor, self.geometry)
        self.patterns = sensor.patterns()
        self.ideal = IdealProjector.around(sensor.projector.optics)
        scene = self.study.scene
        self.finishes = dict(zip(scene.names, scene.finishes, strict=True))
        surfaces = self.surfaces(-1)
        self.part = LaboratoryPart(row.scene_path, row.scene.parameters, surfaces, self.ideal.description())
        # Dr.Jit compiles a material call for the materials of every scene in memory: only the laboratory's stay
        names = self.part.names
        alone = replace(scene, mitsuba=self.part.lit, names=names, finishes=tuple(self.finishes[n] for n in names))
        self.study = replace(self.study, scene=alone)
        del scene
        gc.collect()

    def surfaces(self, number: int) -> dict[str, Surface]:
        """Return the materials of all faces in a world, by shape.

        Faces of one finish deviate alike, by the unknowns of the study. World -1 has the best estimates.
        """
        ranges = self.unknowns.table.finish
        finishes = list(dict.fromkeys(self.finishes.values()))
        rng = np.random.default_rng([self.unknowns.seed, 11, max(number, 0)])
        drawn = np.clip(rng.standard_normal((len(finishes), 3)), -LARGEST_DEVIATION, LARGEST_DEVIATION)
        drawn *= [ranges.alpha, ranges.wide_angle, ranges.reflectance] if number >= 0 else 0.0
        deviation = {finish: Deviation(*one.tolist()) for finish, one in zip(finishes, drawn, strict=True)}
        return {
            name: surface_of(
                finish, self.row.family, self.sensor.wavelength_nm, deviation[finish], f"{self.row.scene_path}: {name}"
            )
            for name, finish in self.finishes.items()
        }

    def measure(self, number: int, decoders: Sequence[str]) -> dict[str, Outcome]:
        """Return the outcome of the world of a number by each decoder."""
        world = self.unknowns.draw(Trial(number))
        true, assumed = (motion.inverse() @ self.view.world_from_sensor for motion in (world.placed, world.assumed))
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

    def light(self, number: int, world: DrawnValues, true: Transform) -> Light:
        """Return the light of a world on the cameras, from the true pose of the sensor."""
        surfaces = self.surfaces(number)
        self.part.finish(surfaces)
        cameras = self.sensor.misaligned(world.rig).cameras
        rois = regions(cameras, self.study.scene.bounds, true, _MARGIN_PX)
        rays = {name: RayBundle.of(camera, true, rois[name]) for name, camera in cameras.items()}
        optics = world.rig.projector or self.sensor.projector.optics
        lamp = Lamp(self.sensor.projector, optics, self._patterns(world))
        met = {name: self._met(bundle, rois[name]) for name, bundle in rays.items()}
        near = {name: binary_dilation(shape >= 0, iterations=2).ravel() for name, shape in met.items()}
        rays = {name: bundle.only(near[name]) for name, bundle in rays.items()}
        lit = light_on(self.part, self.ideal, lamp, rays, true, self.row.paths, world.seed)
        room = room_light_on(self.part, rays, world.seed)

        def in_image(images: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
            out = {}
            for name, values in images.items():
                whole = np.zeros((*values.shape[:-1], near[name].size), np.float32)
                whole[..., near[name]] = values
                out[name] = whole.reshape(*values.shape[:-1], rois[name].height, rois[name].width)
            return out

        contrast = {}
        for name, shape in met.items():
            heights = [surfaces[one].height_um for one in self.part.names]
            known = np.array([speckle_contrast(self.sensor, cameras[name], height) for height in heights])
            contrast[name] = np.where(shape >= 0, known[shape], 0.0).astype(np.float32)
        direct, more = (in_image({name: both[k] for name, both in lit.items()}) for k in (0, 1))
        projected = {name: np.maximum(image + smoothed(more[name], met[name]), 0) for name, image in direct.items()}
        return Light(rois, projected, in_image(room), contrast)

    def _met(self, rays: RayBundle, roi: Roi) -> NDArray[np.intp]:
        """Return the index of the shape (h, w) at the centre of each pixel, -1 for none."""
        return self.part.shapes_met(rays.origin, rays.middle).reshape(roi.height, roi.width)

    def capture(self, number: int, world: DrawnValues, true: Transform) -> Capture:
        """Return the images of a world, with the nominal calibration."""
        sensor, light = self.sensor, self.light(number, world, true)
        base = sensor.exposure.base_s
        assert base is not None
        (set_here,) = exposures_in_room(sensor, (base,), self.view.standoff, world.room)
        seconds, images = set_here * world.exposure, {}
        for index, (name, camera) in enumerate(sensor.rig.cameras.items()):
            how = Exposed(camera, light.rois[name], seconds, world.unit + index, world.seed + index)
            projected = light.projected[name] * np.float32(world.power)
            if sensor.ambient_image:
                projected = np.concatenate([projected, np.zeros_like(projected[:1])])
            room = light.room[name] * np.float32(world.room)
            images[name] = grey_levels(sensor, how, projected, room, light.contrast[name])
        decoding = Decoding(
            exposure_s=seconds,
            pattern=described(sensor.pattern),
            ambient_image=sensor.ambient_image,
            black_level_dn=sensor.imager.black_level,
            gamma=sensor.imager.gamma,
            read_out={
                name: roi
                for name, roi in light.rois.items()
                if (roi.width, roi.height) != (sensor.rig.cameras[name].width, sensor.rig.cameras[name].height)
            },
        )
        return Capture(
            sensor.name,
            sensor.technology,
            "simulated",
            sensor.rig,
            images,
            sensor.imager.bits,
            decoding,
            world_from_sensor=self.view.world_from_sensor,
        )

    def _patterns(self, world: DrawnValues) -> NDArray[np.float32]:
        pattern, optics = self.sensor.pattern, self.sensor.projector.optics
        if self.row.mask == "preset" or not isinstance(pattern, RandomDots):
            return self.patterns
        return another_mask(pattern, optics.width, optics.height, world.seed)
