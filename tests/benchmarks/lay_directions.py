"""A finish with a lay, shown in four directions: how well they predict coupons in any other direction.

Signal chain: finish with a lay -> its quick campaign in four directions, as ``mitsim run --yes`` makes it -> F and
sigma of every patch of coupons with random normals and directions, predicted from the four directions in several ways
-> differences from the captures, pooled over the patches of each.

    python tests/benchmarks/lay_directions.py --sensor ensenso-n10
"""

import argparse
import math
from dataclasses import replace

import numpy as np
from any_finish import rms, within

from characterisation.coupon.metrics import LEAST_DEGREES
from characterisation.coupon.patch_table import overall
from characterisation.coupon.view_frame import view_frame
from characterisation.maps.lay import lay_angle_deg, mirror_direction
from characterisation.maps.performance_map import PerformanceMap
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.finish_cache import kept_finish, made_finish
from mitsim.maps.campaign.hold_out import random_normals
from mitsim.maps.campaign.one_finish import TURNS_DEG, OneFinish, mirror_mm, one_finish_campaign, plan_of
from mitsim.scene import backend
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.preset import load_sensor

#: the map reaches to the first; half of the normals lie within the second, where the line of light is, the rest within
#: the third
REACH_DEG, NEAR_DEG, FAR_DEG = 60.0, 25.0, 50.0
REPEATS = 2

#: sigma is compared where so much of F came back
LEAST_F = 0.1

WAYS = (
    "mean over directions",
    "nearest direction",
    "between directions, same normal",
    "between directions, normal turned",
)


def answers(known: PerformanceMap, one: OneFinish, distance: float, normals: np.ndarray, along: np.ndarray) -> dict:
    """F and sigma (n,) of patches by each of :data:`WAYS`."""
    at = np.full(len(normals), distance)
    mean, between = (
        known.query(one.label, one.finish.roughness, at, normals, one.finish.light, tangents)
        for tangents in (None, along)
    )
    directions = known.surface(one.label, one.finish.roughness, one.finish.light).directions
    lay_deg = lay_angle_deg(normals, along, mirror_direction(at, mirror_mm(one.sensor)))
    every = np.array([surface.look_up(at, normals)[:2] for surface in directions])
    place, point = lay_deg * len(directions) / 180, np.arange(len(normals))
    before = place.astype(int) % len(directions)
    nearest = every[np.rint(place).astype(int) % len(directions), :, point].T
    near, far, t = every[before, :, point].T, every[(before + 1) % len(directions), :, point].T, place % 1
    plain = (1 - t) * near[0] + t * far[0], np.exp((1 - t) * np.log(near[1]) + t * np.log(far[1]))
    answered = (mean.fraction, mean.sigma), nearest, plain, (between.fraction, between.sigma)
    return dict(zip(WAYS, answered, strict=True))


def off(patches, fraction, sigma, distance: float) -> tuple[float, float]:
    """Predicted less seen, of a capture: F, and ln sigma where enough came back."""
    known = np.flatnonzero(np.isfinite(fraction))
    patches, fraction, sigma = patches.isel(patch=known), fraction[known], sigma[known]
    seen, points, possible = overall(patches), patches["points"].values, patches["points_possible"].values
    own = sigma * (patches["distance"].values / distance) ** 2  # the map is at one |V|
    degrees = np.where(np.isfinite(own) & (points - 3 >= LEAST_DEGREES), points - 3.0, 0.0)
    f_off = float((possible * fraction).sum() / possible.sum()) - seen.fraction
    if not (seen.fraction > LEAST_F and seen.sigma > 0 and degrees.sum() > 0):
        return f_off, math.nan
    return f_off, 0.5 * math.log((degrees * np.nan_to_num(own) ** 2).sum() / degrees.sum()) - math.log(seen.sigma)


def main() -> None:
    """Print a line for each way to use the four directions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="ensenso-n10")
    parser.add_argument("--distance", type=float, default=504.0, help="[mm]")
    parser.add_argument("--process", default="turned")
    parser.add_argument("--roughness", type=float, default=0.8, help="Ra [um]")
    parser.add_argument("--orientations", type=int, default=150)
    parser.add_argument("--seed", type=int, default=30)
    parser.add_argument("--known", action="store_true", help="only the map's own directions: its errors without mixing")
    given = parser.parse_args()
    backend.activate(None)
    sensor = load_sensor(given.sensor)
    simulated, grid = SimulatedSensor(sensor), sensor_geometry(sensor).grid
    bsdf = {
        "type": "machined_metal",
        "metal": "aluminium",
        "process": given.process,
        "Ra": given.roughness,
        "lay": "u",
    }
    finish = scene_from_dict({"one": {"type": "rectangle", "bsdf": bsdf}}, sensor.wavelength_nm).finishes[0]
    one = OneFinish(finish, sensor, REACH_DEG)
    known = kept_finish(one, given.distance) or made_finish(one, simulated, given.distance)
    rng = np.random.default_rng(given.seed)
    half = given.orientations // 2
    normals = np.concatenate(
        [random_normals(half, NEAR_DEG, rng), random_normals(given.orientations - half, FAR_DEG, rng)]
    )
    file, found, repeats = plan_of(REACH_DEG, given.seed), {way: [] for way in WAYS}, []
    source = simulated_source(simulated, file.samples_per_pixel)
    angles = rng.choice(TURNS_DEG, len(normals)) if given.known else rng.uniform(0, 180, len(normals))
    for normal, angle in zip(normals, angles, strict=True):
        campaign = one_finish_campaign(one, given.distance, file, angle)
        series = [replace(campaign.series[0], seed=campaign.series[0].seed + k) for k in range(REPEATS)]
        shots = [campaign.shot(one_of, normal) for one_of in series]
        u, _, n = shots[0].sensor_from_coupon.rotation.T
        off_by = []
        for _, done in in_turn(source, campaign)(shots):
            patches = done.patches
            frame = view_frame(
                grid.rays_at(patches["column"].values, patches["row"].values), sensor.measuring_rig.baseline_direction
            )
            told = answers(known, one, given.distance, frame @ n, frame @ u)
            off_by.append([off(patches, *told[way], given.distance) for way in WAYS])
        for way, values in zip(WAYS, np.mean(off_by, axis=0), strict=True):
            found[way].append(values)
        repeats.append((off_by[0][0][0] - off_by[1][0][0]) / 2)
    print(f"{given.sensor}, {finish}, {given.distance:g} mm: {len(normals)} normals, each with a direction of its own")
    for way in WAYS:
        f, sigma = np.array(found[way]).T
        f, sigma = f[np.isfinite(f)], sigma[np.isfinite(sigma)]
        print(
            f"{way:34} F off by {rms(f):.3f} rms, {np.abs(f).max():.2f} at most, {within(f, 0.05):.0%} within 0.05; "
            f"sigma by {rms(sigma):.1%} rms, {np.abs(sigma).max():.0%} at most, {within(sigma, 0.1):.0%} within 10 %"
        )
    print(f"noise of the captures: F {rms(np.array(repeats)):.3f} rms")


if __name__ == "__main__":
    main()
