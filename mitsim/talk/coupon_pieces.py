"""Measure flat coupons: patches, their metrics over the tilt, and the sensor against its map.

Slides *Data Collection*, *Point Cloud Processing*, *Results* and *Simulation Validation*.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import xarray as xr

from characterisation.coupon.patch_table import PATCHES, overall
from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.files.arrays import Floats
from characterisation.files.datasets import read_dataset
from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.maps.validation import residual_table
from characterisation.point_cloud import PointCloud
from mitsim.maps.campaign.acquire import coupon_cloud, in_turn, simulated_source
from mitsim.maps.campaign.campaign_file import Band, CampaignFile, SampleEntry
from mitsim.maps.campaign.hold_out import compared, random_normals
from mitsim.maps.campaign.orders import PreparedSensor, prepared_sensor
from mitsim.maps.campaign.plan import Campaign, Shot, plan_campaign
from mitsim.maps.campaign.run import run_campaign
from mitsim.maps.campaign.store import Finished
from mitsim.maps.data_sheet import tilted
from mitsim.maps.prediction import CharacterisedScene
from mitsim.talk.talk_file import map_in, sensor_in

#: columns of patches that are drawn
_DRAWN = ("row", "column", "semi_major", "semi_minor", "recovered_fraction", "incidence", "distance", "included_angle")

#: largest number of patches of a campaign that are kept for drawing
_MOST_PATCHES = 4000

#: step of residuals that are kept [mm]; chosen
STEP_MM = 0.02

#: number of steps that stands for no point: the least of 16 bits, while residuals are clipped to 30,000 steps
NO_POINT = -32768

#: largest side of a picture of residuals [px]; chosen
_SIDE_PX = 300

#: largest incidence of poses of the validation [deg]
_LARGEST_DEG = 70.0


@dataclass(frozen=True)
class CouponPlace:
    """One sample of a campaign file before a sensor: its Ra [um], None for matt white, and its distance [mm]."""

    campaign: str
    sensor: str
    distance: float
    roughness: float | None


def campaign_of(folder: str, coupon_place: CouponPlace, **changes: object) -> Campaign:
    """Return the campaign of one sample at one distance."""
    path, roughness, distance = Path(folder) / coupon_place.campaign, coupon_place.roughness, coupon_place.distance
    content = read_toml(path, CampaignFile)
    entries = [sample for sample in content.samples if roughness_of(sample) == roughness]
    if not entries:
        named = "matt white" if roughness is None else f"Ra {roughness:g}"
        raise InputError(path, "samples", "no such sample", f"one of {named}", "the talk shows it")
    updated = content.model_copy(update={"distances_mm": [distance], "samples": entries, **changes})
    return plan_campaign(path, updated, sensor_in(folder, coupon_place.sensor))


def roughness_of(entry: SampleEntry) -> float | None:
    """Return the Ra [um] of a sample of a campaign, None if its scene has no such parameter."""
    return None if "Ra" not in entry.parameters else float(entry.parameters["Ra"])


def characterised(folder: str, coupon_place: CouponPlace, subdivisions: int, refined: int, seed: int) -> xr.Dataset:
    """Return the samples of a coupon at one distance and their map: orientations refined where F or sigma changes.

    Over ``shot``: the normal ``shot_x`` and ``shot_y`` of each capture, in the order in which they were taken, and its
    ``level``, 0 for the planned ones and 1 for those between them. Over ``patch``, at most 4000 of them: ``patch_x``,
    ``patch_y``, F and sigma. Over (b, a): the fields of the map.

    Parameters
    ----------
    folder, coupon_place, subdivisions, refined, seed
        Folder of the talk, the coupon and its distance, density of the planned orientations, the largest one of those
        added, and seed of the choice of patches.
    """
    bands = [Band(up_to_deg=20, subdivisions=subdivisions), Band(up_to_deg=80, subdivisions=max(subdivisions - 1, 0))]
    plan = campaign_of(folder, coupon_place, orientations=bands)
    if plan.file.refine is not None:
        changed = plan.file.refine.model_copy(update={"subdivisions": refined})
        plan = replace(plan, file=plan.file.model_copy(update={"refine": changed}))
    source = in_turn(simulated_source(prepared_sensor(plan.sensor).simulated, plan.file.samples_per_pixel), plan)
    shots: list[Shot] = []

    def noted(planned_shots: Sequence[Shot]) -> Iterator[tuple[Shot, Finished]]:
        for shot, finished in source(planned_shots):
            shots.append(shot)
            yield shot, finished

    with TemporaryDirectory() as kept:
        performance_map = run_campaign(plan, noted, kept)
        patches = read_dataset(Path(kept) / "samples.nc", PATCHES)
    chosen = np.random.default_rng(seed).permutation(patches.sizes["patch"])[:_MOST_PATCHES]
    here = patches.isel(patch=np.sort(chosen))
    planned = len(plan.file.normals())
    normals = np.array([shot.normal for shot in shots])
    count = patches.sizes["patch"]
    data = xr.Dataset(attrs={"distance_mm": coupon_place.distance, "Ra_um": coupon_place.roughness, "patches": count})
    data["shot_x"], data["shot_y"] = ("shot", normals[:, 0]), ("shot", normals[:, 1])
    data["level"] = ("shot", (np.arange(len(shots)) >= planned).astype(np.int8))
    columns = {"x": "normal_x", "y": "normal_y", "fraction": "recovered_fraction", "sigma": "ray_noise_inliers"}
    for name, column in columns.items():
        data[f"patch_{name}"] = ("patch", here[column].values.astype(np.float32))
    whole = performance_map.data.isel(sample=0, distance=0)
    for name in ("recovered_fraction", "ray_noise_std"):
        data[name] = (("b", "a"), whole[name].transpose("b", "a").values.astype(np.float32))
    return data.assign_coords(a=("a", whole["a"].values), b=("b", whole["b"].values))


def tilts(folder: str, coupon_place: CouponPlace, angles: tuple[float, ...]) -> xr.Dataset:
    """Return F by three definitions, sigma along V and along N, and the sizes of patches, over the tilt.

    The coupon and a matt-white one stand at the same pose; the second is the reference of ``fraction_reference``.
    ``fraction_density`` is the talk's rho. ``along_ray`` and ``along_normal`` [mm] are of matt white, whose finish
    looks the same at every tilt, and ``metal_along_ray`` is of the coupon.
    """
    prepared = prepared_sensor(sensor_in(folder, coupon_place.sensor))
    plans = [campaign_of(folder, place) for place in (coupon_place, replace(coupon_place, roughness=None))]
    rows: list[dict[str, float]] = []
    for angle in angles:
        (metal, coupon), (white, _) = (_taken(prepared, plan, tilted(angle)) for plan in plans)
        by_pixels = measure_patches(metal, coupon)
        by_density = measure_patches(metal, coupon, angular_pitch=metal.grid.angular_pitch)
        by_reference = measure_patches(metal, coupon, reference=white)
        of_white = measure_patches(white, coupon)
        sigma, cosine = overall(of_white).sigma, np.cos(of_white["incidence"].values)
        area = np.pi * by_pixels["semi_major"].values * by_pixels["semi_minor"].values
        seen = area * np.cos(by_pixels["incidence"].values) / by_pixels["distance"].values ** 2
        rows.append(
            {
                "fraction_pixels": float(by_pixels["recovered_fraction"].mean()),
                "fraction_density": float(by_density["recovered_fraction"].mean()),
                "fraction_reference": float(by_reference["recovered_fraction"].mean()),
                "along_ray": sigma,
                "along_normal": sigma * float(np.sqrt(np.mean(cosine**2))),
                "metal_along_ray": overall(by_pixels).sigma,
                "solid_angle": float(seen.mean()) if len(seen) else math.nan,
                "included_deg": math.degrees(float(by_pixels["included_angle"].mean())) if len(seen) else math.nan,
                "patches": by_pixels.sizes["patch"],
            }
        )
    columns = {name: ("tilt", np.array([row[name] for row in rows], float)) for name in rows[0]}
    return xr.Dataset(columns, {"tilt": ("tilt", np.array(angles, float), {"units": "deg"})})


def sub_clouds(folder: str, coupon_place: CouponPlace, angle: float) -> xr.Dataset:
    """Return the cloud of a tilted coupon with its patches: status (row, column), and the ellipses (patch,)."""
    prepared = prepared_sensor(sensor_in(folder, coupon_place.sensor))
    plan = campaign_of(folder, coupon_place)
    cloud, coupon = _taken(prepared, plan, tilted(angle))
    patches = measure_patches(cloud, coupon)
    window, corner = _window(cloud, coupon)
    data = xr.Dataset({name: ("patch", patches[name].values.astype(np.float32)) for name in _DRAWN})
    data["row"], data["column"] = data["row"] - corner[0], data["column"] - corner[1]
    depth = np.where(cloud.valid, cloud.points[..., 2], np.nan)[window]
    data["depth"] = (("y", "x"), depth.astype(np.float32), {"units": "mm"})
    data["status"] = (("y", "x"), cloud.status[window])
    return data.assign_attrs(tilt_deg=angle, distance_mm=coupon_place.distance)


def validation_of(folder: str, coupon_place: CouponPlace, map_name: str, count: int, seed: int) -> xr.Dataset:
    """Return F and sigma of one sample at one distance, captured and predicted, over poses no map was made from.

    Over ``pose``: ``incidence`` [rad], and ``fraction`` and ``sigma`` [mm] as ``..._measured`` and ``..._predicted``.
    The other variables are those of :func:`characterisation.maps.validation.residual_table`, of this one row.
    """
    prepared, plan = prepared_sensor(sensor_in(folder, coupon_place.sensor)), campaign_of(folder, coupon_place)
    series = replace(plan.series[0], seed=plan.series[0].seed ^ (seed + 1))
    rng = np.random.default_rng([seed, round(coupon_place.distance), round(1000 * (coupon_place.roughness or 0.0))])
    normals = random_normals(count, min(_LARGEST_DEG, plan.file.largest_deg), rng)
    performance_map = map_in(folder, map_name)
    take = simulated_source(prepared.simulated, plan.file.samples_per_pixel)
    pairs = [compared(plan.shot(series, normal), prepared, performance_map, take, 1) for normal in normals]
    table = residual_table(pairs).isel(row=0)
    data = xr.Dataset({str(name): ((), values.values) for name, values in table.data_vars.items()})
    data["incidence"] = ("pose", [pair.incidence for pair in pairs], {"units": "rad"})
    for name in ("fraction", "sigma"):
        for side in ("measured", "predicted"):
            data[f"{name}_{side}"] = ("pose", [float(getattr(getattr(pair, side), name)) for pair in pairs])
    return data


def clouds_of_coupon(folder: str, coupon_place: CouponPlace, map_name: str, angle: float, seed: int) -> xr.Dataset:
    """Return the captured cloud of a large coupon and one drawn from the map, as residuals along V from the true plane.

    ``captured`` and ``drawn`` (row, column), thinned, are in steps of :data:`STEP_MM`; :data:`NO_POINT` is no point.
    """
    prepared = prepared_sensor(sensor_in(folder, coupon_place.sensor))
    plan = campaign_of(folder, coupon_place, coupon_px=5000.0)  # as large as the field of view
    cloud, coupon = _taken(prepared, plan, tilted(angle))
    scene, pose = plan.series[0].sample.scene, plan.shot(plan.series[0], tilted(angle)).sensor_from_coupon
    in_map, rng = CharacterisedScene(scene, map_in(folder, map_name)), np.random.default_rng(seed)
    drawn = prepared.predictor.predict(in_map, pose.inverse(), rng, correlated=True)
    window, _ = _window(cloud, coupon)
    data = xr.Dataset(attrs={"distance_mm": coupon_place.distance, "Ra_um": coupon_place.roughness, "tilt_deg": angle})
    for name, point_cloud in (("captured", cloud), ("drawn", drawn)):
        rays = point_cloud.grid.rays()
        reach = ((coupon.centre - point_cloud.grid.origin) @ coupon.normal) / (rays @ coupon.normal)
        off = np.linalg.norm(point_cloud.points - point_cloud.grid.origin, axis=-1) - reach
        cut = np.where(point_cloud.valid, off, np.nan)[window]
        step = max(1, -(-max(cut.shape) // _SIDE_PX))
        steps = np.nan_to_num(np.clip(cut[::step, ::step] / STEP_MM, -30_000, 30_000), nan=NO_POINT)
        data[name] = (("row", "column"), steps.round().astype(np.int16), {"units": f"{STEP_MM:g} mm"})
        data.attrs[f"share_{name}"] = float(point_cloud.valid[window].mean())
    return data


def _taken(prepared: PreparedSensor, plan: Campaign, normal: Floats) -> tuple[PointCloud, Coupon]:
    shot = plan.shot(plan.series[0], normal)
    coupon = shot.series.sample.at(shot.sensor_from_coupon)
    capture = simulated_source(prepared.simulated, plan.file.samples_per_pixel)(shot)
    return coupon_cloud(capture, coupon, prepared.geometry, plan.sensor), coupon


def _window(cloud: PointCloud, coupon: Coupon) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Return the rows and columns that show the coupon, and their first ones."""
    corners = cloud.grid.project(coupon.corners())
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 4, 0)
    high = np.ceil(corners.max(axis=0)).astype(int) + 5
    return (slice(low[1], high[1]), slice(low[0], high[0])), (int(low[1]), int(low[0]))
