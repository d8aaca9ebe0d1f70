"""Shots as orders of plain values, for worker processes on this machine or on a cluster.

Signal chain: shot of a campaign -> order: the sensor, the recipe of the coupon, its pose and seed -> the same shot in
the worker, whose sensor is prepared once -> capture, measured -> the process that writes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from mitsim.capture.simulated.render import simulated_sensor
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign.acquire import Source, measured, simulated_source
from mitsim.maps.campaign.plan import Campaign, Series, Shot
from mitsim.maps.campaign.store import Finished
from mitsim.maps.prediction import Predictor
from mitsim.running.executor import Executor, check_same_file
from mitsim.scene import backend
from mitsim.scene.coupons import CouponRecipe, Sample, load_sample
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import once_for_sensor
from mitsim.sensor.transforms import Transform


@lru_cache(maxsize=32)
def _sample(recipe: CouponRecipe, origin: str) -> Sample:
    sample = load_sample(recipe)
    check_same_file(recipe.scene, _digest(sample), origin)
    return sample


def _digest(sample: Sample) -> str:
    return hashlib.sha256(sample.origin.encode()).hexdigest()


@dataclass(frozen=True)
class Order:
    """A shot as plain values; ``origin`` is the digest of everything its coupon was made from."""

    sensor: Sensor
    recipe: CouponRecipe
    origin: str
    distance: float
    normal: tuple[float, float, float]
    sensor_from_coupon: Transform
    series_name: str
    series_seed: int
    samples_per_pixel: int
    keep_images: bool

    def shot(self) -> Shot:
        """Return the ordered shot; its coupon is loaded once in a process, and again if its scene has changed."""
        series = Series(_sample(self.recipe, self.origin), self.distance, None, self.series_name, self.series_seed)
        return Shot(series, np.array(self.normal), self.sensor_from_coupon)


def worker_source(workers: Executor, campaign: Campaign) -> Source:
    """Return a source whose shots are taken by workers."""

    def finish(shots: Sequence[Shot]) -> Iterator[tuple[Shot, Finished]]:
        return workers.distribute(shots, lambda shot: order_of(shot, campaign), take_order)

    return finish


def take_order(order: Order) -> Finished:
    """Take one shot; workers call this function."""
    prepared, shot = prepared_sensor(order.sensor), order.shot()
    capture = simulated_source(prepared.simulated, order.samples_per_pixel)(shot)
    return measured(capture, shot, prepared.geometry, order.sensor, order.keep_images)


def order_of(shot: Shot, campaign: Campaign) -> Order:
    """Return a shot of a campaign as an order, with the absolute path of its scene."""
    recipe, series = shot.series.sample.recipe, shot.series
    x, y, z = (float(component) for component in shot.normal)
    return Order(
        campaign.sensor,
        replace(recipe, scene=str(Path(recipe.scene).absolute())),
        _digest(shot.series.sample),
        series.distance,
        (x, y, z),
        shot.sensor_from_coupon,
        series.name,
        series.seed,
        campaign.file.samples_per_pixel,
        campaign.file.keep_images,
    )


class PreparedSensor:
    """A sensor with everything that any number of shots share."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor, self.geometry = sensor, sensor_geometry(sensor)

    @cached_property
    def simulated(self) -> SimulatedSensor:
        """Return the sensor on the device."""
        backend.activate(None)
        return simulated_sensor(self.sensor)

    @cached_property
    def predictor(self) -> Predictor:
        """Return the predictor of its clouds."""
        return Predictor.of_sensor(self.sensor, self.geometry)


#: the sensor of this process, prepared once
prepared_sensor = once_for_sensor(PreparedSensor)
