"""Quick campaign of one finish at one distance, for a sensor whose map lacks it.

Signal chain: finish from a loaded scene, and |V| -> a flat coupon of it -> the same plan of orientations for every
finish, refined where F or sigma changes fast -> a map of one sample at one distance.

A finish with a lay is shown in four directions (:mod:`characterisation.maps.lay`). Its map contains the fields of each,
their mean for queries without a direction, and their differences as the spread of that mean.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.orientations import Refinement
from characterisation.coupon.view_frame import view_frame
from characterisation.maps.joined import mean_over, with_directions
from characterisation.maps.lay import mirror_direction, tangent_at
from characterisation.maps.performance_map import PerformanceMap
from characterisation.words.version import __version__
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.campaign_file import Band, CampaignFile, SampleEntry
from mitsim.maps.campaign.plan import MEASUREMENT_VERSION, Campaign, Series, Shot, half_size, view_axes
from mitsim.maps.campaign.run import run_campaign
from mitsim.scene.coupons import CouponRecipe, Sample
from mitsim.scene.load import flat_coupon
from mitsim.scene.materials import Finish
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import sensor_checksum
from mitsim.sensor.transforms import Transform

#: increased if the plan below changes, so that cached maps are made again
DESIGN_VERSION = 2

#: the same for a lay, of sensors whose baseline is not along their x
LAY_DESIGN_VERSION = 1

#: directions of u of a finish with a lay [deg], equally spaced from 0 to 180
TURNS_DEG = (0.0, 45.0, 90.0, 135.0)

#: mirror-like and glossy lobes are 5 to 20 deg wide; a matt finish varies only with cos
BANDS = ((20.0, 3), (80.0, 2))
REFINED = Refinement(fraction=0.3, sigma=0.7, sigma_error=0.08, subdivisions=4)

#: side of the coupon seen face on
COUPON_PX = 150.0

SAMPLES_PER_PIXEL = 16


@dataclass(frozen=True)
class OneFinish:
    """A finish to characterise for a sensor, up to an incidence [deg]; ``seed`` determines all random values."""

    finish: Finish
    sensor: Sensor
    largest_deg: float
    seed: int = 1

    @property
    def label(self) -> str:
        """Return its name in a map: the finish, with its optical numbers if they do not follow from process and Ra."""
        light = self.finish.light
        return self.finish.name if light is None or light.as_made else f"{self.finish.name} ({light.in_words()})"

    @property
    def turns(self) -> tuple[float, ...]:
        """Return the directions of its lay to show [deg]."""
        return TURNS_DEG if self.finish.light is not None and self.finish.light.has_lay else TURNS_DEG[:1]

    def digest(self, distance: float) -> str:
        """Return sixteen hexadecimal digits of everything that determines its map at a distance [mm].

        These are the sensor, the BSDF as the renderer defines it, the surface parameters of speckle, the plan and the
        versions.
        """
        content = [
            __version__,
            MEASUREMENT_VERSION,
            DESIGN_VERSION,
            sensor_checksum(self.sensor),
            json.dumps(self.finish.description, sort_keys=True, default=repr),
            repr(self.finish.scatter),
            self.label,
            str(self.finish.roughness),
            f"{distance:.6g}",
            f"{self.largest_deg:.4f}",
            self.seed,
            self.turns,
        ]
        axis = self.sensor.rig.reference.sensor_from_camera.rotation[:, 2]
        if len(self.turns) > 1 and not np.allclose(_sensor_from_view(self.sensor), view_axes(axis)):
            content.append(LAY_DESIGN_VERSION)
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class _RotatedCampaign(Campaign):
    """A campaign whose coupons have their u, the x axis, at one lay angle [deg]; None for any."""

    lay_deg: float | None = None

    def shot(self, series: Series, normal: NDArray[np.float64]) -> Shot:
        """Return a shot of the coupon of a series with a given normal."""
        shot = super().shot(series, normal)
        if self.lay_deg is None:
            return shot
        mirror = mirror_direction(np.array(series.distance), mirror_mm(self.sensor))
        view = _sensor_from_view(self.sensor)
        u, z = view @ tangent_at(normal, self.lay_deg, mirror), view @ normal
        axes = np.stack([u, np.cross(z, u), z], axis=1)
        return replace(shot, sensor_from_coupon=Transform(axes, shot.sensor_from_coupon.translation))


def mirror_mm(sensor: Sensor) -> tuple[float, float]:
    """Return the place half-way between camera and light in the view frame, as a mean over the cameras [mm].

    The light of a sensor without a projector is taken to be at its reference camera.
    """
    rig = sensor.measuring_rig
    cameras = [camera.centre for camera in rig.cameras.values()]
    light = cameras[0] if rig.projector is None else rig.projector.centre
    middle = (np.mean(cameras, axis=0) + light) / 2 - cameras[0]
    x, y, _ = middle @ _sensor_from_view(sensor)
    return float(x), float(y)


def _sensor_from_view(sensor: Sensor) -> NDArray[np.float64]:
    """Return the axes of the view frame as a map has it, x along the baseline, as columns in the sensor frame."""
    return view_frame(sensor.rig.reference.sensor_from_camera.rotation[:, 2], sensor.rig.baseline_direction).T


def plan_of(largest_deg: float, seed: int = 1) -> CampaignFile:
    """Return the plan of a quick campaign, as a campaign file would define it."""
    bands = [Band(up_to_deg=min(edge, largest_deg), subdivisions=fine) for edge, fine in BANDS if edge < largest_deg]
    if not bands or bands[-1].up_to_deg < largest_deg:
        bands.append(Band(up_to_deg=largest_deg, subdivisions=BANDS[-1][1]))
    return CampaignFile(
        coupon_px=COUPON_PX,
        orientations=bands,
        refine=REFINED,
        samples_per_pixel=SAMPLES_PER_PIXEL,
        seed=seed,
        samples=[SampleEntry(scene="the finish of a scene")],
    )


def one_finish_campaign(finish: OneFinish, distance: float, file: CampaignFile, lay_deg: float = 0.0) -> Campaign:
    """Return the campaign of a finish at a distance [mm] by a plan of :func:`plan_of`; a lay has its u at an angle."""
    half = half_size(finish.sensor, distance, COUPON_PX if file.coupon_px is None else file.coupon_px)
    recipe = CouponRecipe(finish.finish.name, (), finish.sensor.wavelength_nm)
    scene = flat_coupon(finish.finish, half)
    sample = Sample(recipe, scene, 2 * half, 2 * half, finish.label, finish.finish.roughness, "", finish.finish.light)
    digest = finish.digest(distance)
    series = Series(sample, distance, None, f"{lay_deg:g}deg_{digest}", int(digest[:8], 16) ^ file.seed)
    shown = lay_deg if len(finish.turns) > 1 else None
    return _RotatedCampaign(file, finish.sensor, (distance,), (series,), (), shown)


def characterise_finish(finish: OneFinish, simulated: SimulatedSensor, distance: float, folder: Path) -> PerformanceMap:
    """Run the campaign of a finish at a distance [mm] in an empty folder; MissingEnvironmentError if the disk fills."""
    file, made = plan_of(finish.largest_deg, finish.seed), []
    for turn in finish.turns:
        campaign = one_finish_campaign(finish, distance, file, turn)
        source = in_turn(simulated_source(simulated, file.samples_per_pixel), campaign)
        made.append(run_campaign(campaign, source, folder / f"{turn:g}"))
    return made[0] if len(made) == 1 else with_directions(mean_over(made), made, mirror_mm(finish.sensor))


def largest_incidence_deg(performance_map: PerformanceMap) -> float:
    """Return the largest incidence of a map [deg]."""
    reach = float(np.abs(performance_map.data["a"].values).max())
    return round(math.degrees(2 * math.asin(min(reach / 2, 1.0))), 3)
