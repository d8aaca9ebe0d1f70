"""Quick campaign of one finish at one distance, for a sensor whose map lacks it.

Signal chain: finish from a loaded scene, and |V| -> a flat coupon of it -> the same plan of orientations for every
finish, refined where F or sigma changes fast -> a map of one sample at one distance.

A finish with a lay is shown with its marks along, across and at 45 deg on either side of the baseline. A map has no
axis for this direction. It contains the mean over the four directions, and their differences as its spread.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.coupon.orientations import Refinement
from characterisation.maps.joined import mean_over
from characterisation.maps.performance_map import PerformanceMap
from mitsim.campaign.acquire import in_turn, simulated_source
from mitsim.campaign.coupons import CouponRecipe, Sample
from mitsim.campaign.plan import (
    MEASUREMENT_VERSION,
    Band,
    Campaign,
    CampaignFile,
    SampleEntry,
    Series,
    Shot,
    half_size,
    sensor_checksum,
)
from mitsim.campaign.run import run_campaign
from mitsim.scene.load import flat_coupon
from mitsim.scene.materials import Finish
from mitsim.sensor.preset import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.simulation.simulate import SimulatedSensor
from mitsim.version import __version__

#: increased if the plan below changes, so that cached maps are made again
DESIGN_VERSION = 1

#: directions of a lay to show [deg]
TURNS_DEG = (0.0, 45.0, 90.0, 135.0)

#: mirror-like and glossy lobes are 5 to 20 deg wide; a matt finish varies only with cos
BANDS = ((20.0, 3), (80.0, 2))
REFINED = Refinement(fraction=0.3, sigma=0.7, sigma_error=0.08, subdivisions=4)
COUPON_PX, SAMPLES_PER_PIXEL = 150.0, 16


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
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class _RotatedCampaign(Campaign):
    """A campaign whose coupons are rotated about their normals."""

    turn_deg: float = 0.0

    def shot(self, series: Series, normal: NDArray[np.float64]) -> Shot:
        """Return a shot of the coupon of a series with a given normal."""
        shot = super().shot(series, normal)
        turn = Transform(Rotation.from_euler("z", self.turn_deg, degrees=True).as_matrix(), np.zeros(3))
        return replace(shot, sensor_from_coupon=shot.sensor_from_coupon @ turn)


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


def one_finish_campaign(one: OneFinish, distance: float, file: CampaignFile, turn_deg: float = 0.0) -> Campaign:
    """Return the campaign of a finish at a distance [mm], with its coupon rotated about its normal."""
    half = half_size(one.sensor, distance, COUPON_PX if file.coupon_px is None else file.coupon_px)
    recipe = CouponRecipe(one.finish.name, (), one.sensor.wavelength_nm)
    scene = flat_coupon(one.finish, half)
    sample = Sample(recipe, scene, 2 * half, 2 * half, one.label, one.finish.roughness, "", one.finish.light)
    digest = one.digest(distance)
    series = Series(sample, distance, None, f"{turn_deg:g}deg_{digest}", int(digest[:8], 16) ^ file.seed)
    return _RotatedCampaign(file, one.sensor, (distance,), (series,), (), turn_deg)


def characterise_finish(one: OneFinish, simulated: SimulatedSensor, distance: float, folder: Path) -> PerformanceMap:
    """Run the campaign of a finish at a distance [mm] in its own folder.

    Raises
    ------
    MissingEnvironmentError
        If the disk is full.
    """
    file, made = plan_of(one.largest_deg, one.seed), []
    for turn in one.turns:
        campaign = one_finish_campaign(one, distance, file, turn)
        source = in_turn(simulated_source(simulated, file.samples_per_pixel), campaign)
        made.append(run_campaign(campaign, source, folder / f"{turn:g}"))
    return made[0] if len(made) == 1 else mean_over(made)


def largest_incidence_deg(performance_map: PerformanceMap) -> float:
    """Return the largest incidence of a map [deg]."""
    reach = float(np.abs(performance_map.data["a"].values).max())
    return round(math.degrees(2 * math.asin(min(reach / 2, 1.0))), 3)
