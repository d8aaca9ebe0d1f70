"""Take the shots of a campaign on a Dask cluster.

Each shot is sent to a worker as plain values (the sensor, the recipe of the coupon, its pose and seed) and comes back
measured; only this process writes to the campaign's folder. Workers may join, leave and die while it runs: a shot whose
worker died is taken by another. All workers must have this version of mitsim, see the scenes at the same paths, and
run one thread each (``dask worker ADDRESS --nthreads 1``). The same bytes as on one machine need the same kind of
processor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mitsim.campaign.coupons import CouponRecipe, load_sample
from mitsim.campaign.plan import Campaign, Series, Shot
from mitsim.campaign.store import Finished
from mitsim.campaign.take import Source, measured, simulated_source
from mitsim.capture.cloud import Geometry, sensor_geometry
from mitsim.capture.simulate import SimulatedSensor
from mitsim.errors import InputError, MissingEnvironmentError
from mitsim.sensor.frames import Transform
from mitsim.sensor.preset import Sensor

Item = TypeVar("Item")
Plain = TypeVar("Plain")
Result = TypeVar("Result")

#: shots that wait at each worker, so that none is idle and few are lost when the campaign is stopped
AHEAD = 3

#: workers that may die over one shot before it is given up
DEATHS = 5

#: seconds in which the scheduler must answer
PATIENCE_S = 10


@dataclass(frozen=True)
class Order:
    """A shot as plain values."""

    sensor: Sensor
    recipe: CouponRecipe
    distance: float
    normal: tuple[float, float, float]
    sensor_from_coupon: Transform
    series_name: str
    series_seed: int
    samples_per_pixel: int
    keep_images: bool


def on_cluster(address: str, campaign: Campaign) -> Source:
    """A source that has shots taken by the workers of a Dask scheduler.

    Raises
    ------
    MissingEnvironmentError
        If ``distributed`` is not installed, or nobody answers at the address.
    """
    client = connected(address)

    def finish(shots: Sequence[Shot]) -> Iterator[tuple[Shot, Finished]]:
        return spread(client, address, shots, lambda shot: _order(shot, campaign), take_order)

    return finish


def connected(address: str) -> Any:
    """A client of the Dask scheduler at an address.

    Raises
    ------
    MissingEnvironmentError
        If ``distributed`` is not installed, or nobody answers there.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingEnvironmentError(
            "--scheduler needs Dask, which is not installed: pip install 'mitsim[cluster]'"
        ) from None
    try:
        return Client(address, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise MissingEnvironmentError(
            f"--scheduler {address}: nobody answers there ({error}); start one with: dask scheduler"
        ) from None


def spread(
    client: Any, address: str, items: Sequence[Item], order: Callable[[Item], Plain], work: Callable[[Plain], Result]
) -> Iterator[tuple[Item, Result]]:
    """Items with what workers made of their orders, as they are finished; an order and its result are plain values.

    Raises
    ------
    InputError
        If that is what a worker says.
    MissingEnvironmentError
        For whatever else goes wrong there.
    """
    from distributed import as_completed

    waiting = list(reversed(items))
    running = as_completed(loop=client.loop)
    of: dict[object, Item] = {}

    def send() -> None:
        room = AHEAD * max(sum(client.ncores().values()), 1)
        while waiting and len(of) < room:
            item = waiting.pop()
            future = client.submit(work, order(item), pure=False, retries=DEATHS)
            of[future.key] = item
            running.add(future)

    try:
        send()
        for future in running:
            try:
                done = future.result()
            except InputError:
                raise
            except Exception as error:  # whatever a worker or the network may do
                raise MissingEnvironmentError(
                    f"--scheduler {address}: a capture failed there ({type(error).__name__}: {error}); what was "
                    "finished is kept: mend the cluster, and run the same command again"
                ) from None
            yield of.pop(future.key), done
            send()
    finally:
        client.cancel(list(running.futures))


def take_order(order: Order) -> Finished:
    """Take one shot: what a worker does."""
    simulated, geometry = laid_out(repr(order.sensor), order.sensor)
    sample = _sample(order.recipe)
    series = Series(sample, order.distance, None, order.series_name, order.series_seed)
    shot = Shot(series, np.array(order.normal), order.sensor_from_coupon)
    capture = simulated_source(simulated, order.samples_per_pixel)(shot)
    return measured(capture, shot, geometry, order.sensor, order.keep_images)


def _order(shot: Shot, campaign: Campaign) -> Order:
    recipe, series = shot.series.sample.recipe, shot.series
    x, y, z = (float(component) for component in shot.normal)
    return Order(
        campaign.sensor, replace(recipe, scene=str(Path(recipe.scene).absolute())), series.distance, (x, y, z),
        shot.sensor_from_coupon, series.name, series.seed, campaign.file.samples_per_pixel, campaign.file.keep_images,
    )  # fmt: skip


_sample = lru_cache(maxsize=32)(load_sample)

_places: dict[str, tuple[SimulatedSensor, Geometry]] = {}


def laid_out(key: str, sensor: Sensor) -> tuple[SimulatedSensor, Geometry]:
    """The sensor on this worker's device, laid out once."""
    if key not in _places:
        from mitsim.scene import backend

        backend.activate(None)
        _places.clear()
        _places[key] = SimulatedSensor(sensor), sensor_geometry(sensor)
    return _places[key]
