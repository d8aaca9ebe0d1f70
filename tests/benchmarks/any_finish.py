"""Six finishes that no map was made of: the tool's quick characterisation against independent captures.

Signal chain: finish -> its quick campaign at a distance of the sensor's map, as ``mitsim run --yes`` makes it -> F and
sigma that it predicts for the patches of random orientations of the same coupon, which it has not seen (another seed,
other noise) -> how far it is off, capture by capture, and how far a perfect map would seem to be off by the captures'
own noise.

    python tests/benchmarks/any_finish.py --sensors ensenso-n10 zivid-2-m70 -o runs/any_finish.json

What was finished is kept in the output and not made again.
"""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from characterisation.coupon.metrics import LEAST_DEGREES
from characterisation.coupon.patch_table import overall
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import shipped_maps
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.finish_cache import kept_finish, made_finish
from mitsim.maps.campaign.hold_out import random_normals
from mitsim.maps.campaign.one_finish import OneFinish, largest_incidence_deg, one_finish_campaign, plan_of
from mitsim.scene import backend
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.preset import load_sensor

SIX = {
    "milled steel Ra 1.6": {"type": "machined_metal", "metal": "carbon_steel", "process": "milled", "Ra": 1.6},
    "turned brass Ra 0.8": {"type": "machined_metal", "metal": "brass", "process": "turned", "Ra": 0.8},
    "powder coat": {"type": "powder_coat"},
    "grit-blasted steel Ra 3.2": {
        "type": "machined_metal",
        "metal": "carbon_steel",
        "process": "grit_blasted",
        "Ra": 3.2,
    },
    "polished aluminium Ra 0.05": {"type": "machined_metal", "metal": "aluminium", "process": "polished", "Ra": 0.05},
    "black plastic": {"type": "powder_coat", "reflectance": 0.04, "gloss": 10.0},
}

#: what is asked of a map: F within this, and sigma within this share
F_WITHIN, SIGMA_WITHIN = 0.05, 0.10

#: orientations up to this incidence; sigma is compared where so much of F came back
LARGEST_DEG, LEAST_F = 70.0, 0.1

F = "recovered_fraction"

#: patches of a capture that a map must know
LEAST_PATCHES = 8


def compared(one: OneFinish, simulated: SimulatedSensor, distance: float, count: int, seed: int) -> dict:
    """Numbers of one cell."""
    found = kept_finish(one, distance)
    if found is None:
        found = made_finish(one, simulated, distance)
    file = plan_of(one.largest_deg, seed)
    campaign = one_finish_campaign(one, distance, file)
    normals = random_normals(count, LARGEST_DEG, np.random.default_rng(seed))
    # each orientation twice with fresh noise: half of what the two differ by is how far their mean is off by noise
    series = [replace(campaign.series[0], seed=campaign.series[0].seed + number) for number in range(2)]
    shots = [campaign.shot(one_of, normal) for normal in normals for one_of in series]
    source = in_turn(simulated_source(simulated, file.samples_per_pixel), campaign)
    off = np.array([against(found, one, done.patches) for _, done in source(shots)]).reshape(count, 2, 2)
    off = off[np.isfinite(off[..., 0]).all(axis=1)]
    f, f_noise = off[..., 0].mean(axis=1), np.diff(off[..., 0], axis=1)[:, 0] / 2
    told = np.isfinite(off[..., 1]).all(axis=1)
    sigma, sigma_noise = off[told, :, 1].mean(axis=1), np.diff(off[told, :, 1], axis=1)[:, 0] / 2
    return {
        "distance_mm": distance,
        "quick_captures": int(found.data.attrs["captures"]),
        "quick_seconds": float(found.data.attrs["seconds"]),
        "orientations": len(f),
        "orientations_sigma": len(sigma),
        "F_mean": float(np.nanmean(found.data[F].values)),
        "F_rms": rms(f),
        "F_largest": float(np.abs(f).max()),
        "F_bias": float(f.mean()),
        "F_within": within(f, F_WITHIN),
        "F_ceiling": within(f_noise, F_WITHIN),
        "F_noise_rms": rms(f_noise),
        "sigma_rms": rms(sigma),
        "sigma_bias": float(sigma.mean()) if len(sigma) else math.nan,
        "sigma_within": within(sigma, SIGMA_WITHIN),
        "sigma_ceiling": within(sigma_noise, SIGMA_WITHIN),
        "sigma_noise_rms": rms(sigma_noise),
    }


def against(performance_map: PerformanceMap, one: OneFinish, patches: xr.Dataset) -> tuple[float, float]:
    """Predicted less seen, of a capture: F, and ln sigma where enough came back; NaN where the map knows too little."""
    across = np.stack([patches["normal_x"].values, patches["normal_y"].values], axis=-1)
    normals = np.column_stack([across, np.sqrt(np.maximum(1 - (across**2).sum(axis=1), 0))])
    distance = np.full(len(normals), performance_map.data["distance"].values[0])
    answer = performance_map.query(one.label, one.finish.roughness, distance, normals, one.finish.light)
    known = np.flatnonzero(np.isfinite(answer.fraction))
    if len(known) < LEAST_PATCHES:
        return math.nan, math.nan
    patches = patches.isel(patch=known)
    seen, points, possible = overall(patches), patches["points"].values, patches["points_possible"].values
    fraction = float((possible * answer.fraction[known]).sum() / possible.sum()) - seen.fraction
    # the map is at one |V|, which differs over a tilted coupon: sigma goes with about its square
    own = answer.sigma[known] * (patches["distance"].values / distance[0]) ** 2
    degrees = np.where(np.isfinite(own) & (points - 3 >= LEAST_DEGREES), points - 3.0, 0.0)
    if not (seen.sigma > 0 and seen.fraction > LEAST_F and degrees.sum() > 0):
        return fraction, math.nan
    predicted = math.sqrt(float((degrees * np.nan_to_num(own) ** 2).sum() / degrees.sum()))
    return fraction, math.log(predicted / seen.sigma)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def within(values: np.ndarray, limit: float) -> float:
    """Share of values within a limit."""
    return float(np.mean(np.abs(values) < limit)) if len(values) else math.nan


def main() -> None:
    """Make all cells and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", nargs="+", default=["ensenso-n10", "zivid-2-m70"])
    parser.add_argument("--finishes", nargs="+", default=list(SIX), choices=list(SIX))
    parser.add_argument("--orientations", type=int, default=100, help="of each cell, two captures each")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/any_finish.json"))
    given = parser.parse_args()
    backend.activate(None)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    cells = json.loads(given.output.read_text()) if given.output.exists() else {}
    print(HEAD)
    for name in given.sensors:
        sensor, known = load_sensor(name), PerformanceMap.load(shipped_maps()[name])
        distances = known.data["distance"].values
        distance, simulated = float(distances[(len(distances) - 1) // 2]), SimulatedSensor(sensor)
        for label in given.finishes:
            key = f"{name} | {label}"
            if key not in cells:
                finish = scene_from_dict({"one": {"type": "rectangle", "bsdf": SIX[label]}}, sensor.wavelength_nm)
                one = OneFinish(finish.finishes[0], sensor, largest_incidence_deg(known))
                cells[key] = compared(one, simulated, distance, given.orientations, given.seed)
                given.output.write_text(json.dumps(cells, indent=1))
            tell(key, cells[key])


HEAD = (
    "| sensor | finish | captures | time | F: off, rms | off, largest | within 0.05 | ceiling "
    "| sigma: off, rms | off, mean | within 10 % | ceiling |\n" + "|---" * 12 + "|"
)


def tell(key: str, one: dict) -> None:
    """One line of the table."""
    print(
        f"| {key} | {one['quick_captures']} | {one['quick_seconds']:.0f} s "
        f"| {one['F_rms']:.3f} | {one['F_largest']:.2f} | {one['F_within']:.0%} | {one['F_ceiling']:.0%} "
        f"| {one['sigma_rms']:.1%} | {one['sigma_bias']:+.1%} "
        f"| {one['sigma_within']:.0%} | {one['sigma_ceiling']:.0%} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
