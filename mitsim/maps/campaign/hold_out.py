"""Compare a map with captures at poses that were not used to make it.

Signal chain: random normals and distances in the map's range -> captures of the coupons, as in a campaign -> patches;
the same coupon predicted from the map -> a cloud -> the same patches ->
:func:`characterisation.maps.validation.residual_table`.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.coupon.patch_table import Overall, overall
from characterisation.coupon.patches import Coupon, measure_patches, patch_residuals
from characterisation.files.checked_files import read_bounded
from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.validation import Pair
from characterisation.point_cloud import PointCloud
from mitsim.maps.campaign.acquire import CaptureSource, coupon_cloud, coupon_place, own_sensor, simulated_source
from mitsim.maps.campaign.campaign_file import CampaignFile
from mitsim.maps.campaign.live import LiveCampaign, plan_live
from mitsim.maps.campaign.orders import Order, PreparedSensor, order_of, prepared_sensor
from mitsim.maps.campaign.plan import Campaign, Shot, plan_campaign
from mitsim.maps.prediction import performance
from mitsim.running.executor import check_same_file
from mitsim.scene.coupons import Sample
from mitsim.sensor.sensor import Sensor

#: relative extent in |V| of a patch on either side of its middle
PATCH_REACH = 0.015

#: relative margin of a live stage from the ends of a map's distances, for the extent of a tilted coupon
LIVE_MARGIN = 0.03

#: relative standard error of sigma above which a pose is repeated
LARGEST_SIGMA_ERROR = 0.03

#: largest factor on the repeats
MOST_REPEATS = 4

#: [rad]
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

#: number of draws, each of all wanted normals, in which the stage must reach enough of them
DRAWS = 100


def random_normals(count: int, largest_deg: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return unit normals (count, 3) in the view frame, each uniform on the cap up to an incidence, in random order.

    The sample is stratified: each ring with a ``count``-th of the cap's area has one normal, and azimuths are about a
    golden angle apart. Independent normals could all miss the lobe of a polished coupon, a tenth of the cap.
    """
    ring = (np.arange(count) + rng.random(count)) / count
    z = 1.0 - (1.0 - math.cos(math.radians(largest_deg))) * ring
    turn = (np.arange(count) + rng.random(count) / 2) * GOLDEN_ANGLE + rng.uniform(0.0, 2 * math.pi)
    across = np.sqrt(1 - z**2)
    return rng.permutation(np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1))


def distances_between(performance_map: PerformanceMap) -> list[float]:
    """Return the map's distances [mm], those at both ends moved slightly inward, and the geometric means between."""
    distances = performance_map.data["distance"].values.astype(float)
    if len(distances) == 1:
        return [float(distances[0])]
    # a tilted coupon extends nearer and farther than its middle, and the map ends at the middles of its coupons
    log = np.log(distances)
    ends = np.exp([0.85 * log[0] + 0.15 * log[1], 0.15 * log[-2] + 0.85 * log[-1]])
    middles = np.sqrt(distances[1:] * distances[:-1])
    return [float(f"{distance:.4g}") for distance in (ends[0], *sorted([*distances[1:-1], *middles]), ends[1])]


def held_out_campaign(path: str | Path, sensor: Sensor, performance_map: PerformanceMap) -> Campaign:
    """Return the coupons of a campaign file at the distances of :func:`distances_between`.

    These replace the distances of the file. Raises InputError if the map belongs to another sensor, or lacks a sample.
    """
    file = read_toml(path, CampaignFile).model_copy(update={"distances_mm": distances_between(performance_map)})
    campaign = plan_campaign(path, file, sensor)
    _check_map(campaign, performance_map)
    return campaign


def held_out_live(
    path: str | Path, file: CampaignFile, sensor: Sensor, performance_map: PerformanceMap
) -> LiveCampaign:
    """Return a campaign with a device for comparison with a map, at the stage positions within the map's distances.

    Raises InputError if the campaign is not possible, the map belongs to another sensor or lacks a sample, or no
    position is within its distances.

    Parameters
    ----------
    path, file, sensor
        As in :func:`~mitsim.maps.campaign.live.plan_live`.
    performance_map
        To be compared; it may be that of a simulated sensor, which compares the simulation with the device.
    """
    distances = performance_map.data["distance"].values.astype(float)
    live = plan_live(path, file, sensor, (distances.min() * (1 + LIVE_MARGIN), distances.max() * (1 - LIVE_MARGIN)))
    _check_map(live.campaign, performance_map)
    return live


def _check_map(campaign: Campaign, performance_map: PerformanceMap) -> None:
    """Check that a map belongs to a campaign's sensor, and contains its samples."""
    map_sensor = str(performance_map.data.attrs.get("sensor"))
    if map_sensor != campaign.sensor.name:
        raise InputError("map", "sensor", repr(map_sensor), repr(campaign.sensor.name))
    for sample in campaign.samples:
        performance_map.require(sample.finish, sample.roughness, sample.light)


def held_out_shots(campaign: Campaign, count: int, seed: int) -> list[Shot]:
    """Return ``count`` shots of each series at random normals that the stage can show; InputError if hardly any."""
    shots = []
    for number, series in enumerate(campaign.series):
        if series.variant is not None:
            continue
        rng = np.random.default_rng([seed, number])
        fresh = replace(series, seed=series.seed ^ (seed + 1))
        normals = np.empty((0, 3))
        for _ in range(DRAWS):
            drawn = random_normals(count, campaign.file.largest_deg, rng)
            normals = np.concatenate([normals, drawn[campaign.reachable(drawn)]])[:count]
            if len(normals) == count:
                break
        else:
            allowed = f"limits that reach more of the normals up to {campaign.file.largest_deg:g} deg"
            raise InputError("campaign", "stage.axes", f"{len(normals)} normals in {DRAWS * count} draws", allowed)
        shots += [campaign.shot(fresh, normal) for normal in normals]
    return shots


def compared(
    shot: Shot, prepared: PreparedSensor, performance_map: PerformanceMap, take: CaptureSource, repeats: int
) -> Pair:
    """Take a shot ``repeats`` times with fresh noise, pool the patches, and predict it as many times.

    With few points sigma is uncertain in both. The shot is then repeated up to :data:`MOST_REPEATS` times as often,
    until the standard error of sigma is :data:`LARGEST_SIGMA_ERROR` of it. Pose and calibration are those of the first
    capture, since a stage is read back and a device has its own calibration.

    Parameters
    ----------
    shot, prepared, performance_map, take, repeats
        The shot to take and to predict; the sensor, prepared once; the map that predicts; takes a shot; number of
        captures with fresh noise.
    """
    sensor = prepared.sensor
    seeds = (shot.series.seed + 2**32 * number for number in range(MOST_REPEATS * repeats))
    repeated = [replace(shot, series=replace(shot.series, seed=seed)) for seed in seeds]
    first = take(repeated[0])
    sample, pose = shot.series.sample, coupon_place(first, shot)
    capture_sensor = own_sensor(first, sensor)
    if capture_sensor is not sensor:
        prepared = PreparedSensor(capture_sensor)
    coupon = sample.at(pose)
    predictor = prepared.predictor
    surfaces = predictor.surfaces(sample.scene, pose.inverse())
    ideal, labels = predictor.ideal(surfaces), predictor.labels(sample.scene, pose.inverse(), surfaces)
    fraction, sigma = performance(ideal, sample.scene, performance_map)
    rng = np.random.default_rng([shot.seed, 1])
    measured, predicted = list[_Measured](), list[_Measured]()
    mapped_patches = np.empty(0, np.int64)  # patches for which the map has a value; all captures have this pose
    taken = [first]
    del first
    for number, repetition in enumerate(repeated):
        if number >= repeats:
            pooled = _pooled(measured, mapped_patches)
            if not pooled.sigma_error > LARGEST_SIGMA_ERROR * pooled.sigma:  # known, or impossible to estimate
                break
        # keep only one capture and cloud at a time; with many pixels they have 100 MB each
        capture = taken.pop() if taken else take(repetition)
        measured.append(_measure(coupon_cloud(capture, coupon, prepared.geometry, sensor), coupon))
        del capture
        predicted.append(_measure(predictor.draw(sample.scene, ideal, labels, fraction, sigma, rng), coupon))
        if number == 0:
            mapped_patches = np.flatnonzero(_known(measured[0][0], sample, performance_map))
    return Pair(
        sample.finish,
        sample.roughness,
        shot.series.distance,
        math.acos(min(1.0, float(shot.normal[2]))),
        _pooled(measured, mapped_patches),
        _pooled(predicted, mapped_patches),
        _residuals(measured, mapped_patches),
        _residuals(predicted, mapped_patches),
    )


@dataclass(frozen=True)
class HeldOutOrder:
    """A held-out shot as plain values. The worker reads the map, which must have this ``digest``."""

    order: Order
    map_path: str
    digest: str
    repeats: int


def held_out_orders(campaign: Campaign, shots: list[Shot], map_path: Path, repeats: int) -> list[HeldOutOrder]:
    """Return an order for each shot.

    Parameters
    ----------
    campaign, shots, map_path, repeats
        The campaign, its held-out shots, path of the map, the same on every machine, and captures of each shot.
    """
    path, digest = str(map_path.absolute()), _digest(map_path)
    return [HeldOutOrder(order_of(shot, campaign), path, digest, repeats) for shot in shots]


def hold_out_order(held_out: HeldOutOrder) -> Pair:
    """Take, predict and compare one shot; workers call this function. InputError if the map is another."""
    performance_map = _map(held_out.map_path, held_out.digest)
    prepared = prepared_sensor(held_out.order.sensor)
    take = simulated_source(prepared.simulated, held_out.order.samples_per_pixel)
    return compared(held_out.order.shot(), prepared, performance_map, take, held_out.repeats)


@lru_cache(maxsize=2)
def _map(path: str, digest: str) -> PerformanceMap:
    check_same_file(path, _digest(Path(path)), digest)
    return PerformanceMap.load(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(read_bounded(path, "a map")).hexdigest()


#: the patches of a cloud, and the residuals of the points of each [mm]
_Measured = tuple[xr.Dataset, NDArray[np.float64]]


def _measure(cloud: PointCloud, coupon: Coupon) -> _Measured:
    return measure_patches(cloud, coupon), patch_residuals(cloud, coupon)


def _pooled(measurements: list[_Measured], patch_indices: NDArray[np.int64]) -> Overall:
    return overall(xr.concat([patches.isel(patch=patch_indices) for patches, _ in measurements], "patch"))


def _residuals(measurements: list[_Measured], patch_indices: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the residuals of all points of the patches that are compared, one after another."""
    chosen = np.concatenate([residuals[patch_indices].ravel() for _, residuals in measurements])
    return np.asarray(chosen[np.isfinite(chosen)])


def _known(patches: xr.Dataset, sample: Sample, performance_map: PerformanceMap) -> NDArray[np.bool_]:
    """Return the patches for which the map has a value over their whole extent, which a tilted coupon may exceed."""
    across = np.stack([patches["normal_x"].values, patches["normal_y"].values], axis=-1)
    normals = np.column_stack([across, np.sqrt(np.maximum(1 - (across**2).sum(axis=1), 0))])
    mapped = np.ones(len(normals), bool)
    for reach in (1 - PATCH_REACH, 1 + PATCH_REACH):
        distance = reach * patches["distance"].values
        answer = performance_map.query(sample.finish, sample.roughness, distance, normals, sample.light)
        mapped &= np.isfinite(answer.fraction)
    return mapped
