"""How much the direction of machining marks changes F and sigma: what a prediction without it leaves out.

Signal chain: one finish, round and with marks -> coupons of both at the same distance, tilts and axes of tilt, the
marks along the baseline and across it -> F and sigma of each capture -> differences from the round finish and from the
mean over directions, which a map answers if the direction is not given.

    python tests/benchmarks/lay.py --sensor ensenso-n10 --distance 500
"""

import argparse
import math
from dataclasses import replace

import numpy as np

from characterisation.coupon.patch_table import overall
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.one_finish import OneFinish, one_finish_campaign, plan_of
from mitsim.scene import backend
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.preset import load_sensor

TILTS_DEG = (0.0, 5.0, 10.0, 20.0, 30.0, 45.0)
REPEATS, LARGEST_DEG = 2, 80.0

#: sigma is compared where so much of F came back
LEAST_F = 0.1


def finish_of(sensor, process, roughness, lay):
    """One face of aluminium; without a lay it is round, as wide as across the marks."""
    bsdf = {"type": "machined_metal", "metal": "aluminium", "process": process, "Ra": roughness}
    bsdf |= {} if lay is None else {"lay": lay}
    return scene_from_dict({"one": {"type": "rectangle", "bsdf": bsdf}}, sensor.wavelength_nm).finishes[0]


def captured(finish, sensor, simulated, distance, turn):
    """F and ln sigma (axis of tilt, tilt), NaN where too little came back; the mean of the repeats."""
    file = plan_of(LARGEST_DEG)
    campaign = one_finish_campaign(OneFinish(finish, sensor, LARGEST_DEG), distance, file, turn)
    tilts = np.radians(TILTS_DEG)
    ways = [np.array([math.sin(t), 0, math.cos(t)]) for t in tilts] + [
        np.array([0, math.sin(t), math.cos(t)]) for t in tilts
    ]
    again = [replace(campaign.series[0], seed=campaign.series[0].seed + k) for k in range(REPEATS)]
    source = in_turn(simulated_source(simulated, file.samples_per_pixel), campaign)
    shots = [campaign.shot(series, way) for way in ways for series in again]
    seen = [overall(done.patches) for _, done in source(shots)]
    rows = np.array([(one.fraction, math.log(one.sigma) if one.fraction > LEAST_F else math.nan) for one in seen])
    return rows.reshape(2, len(TILTS_DEG), REPEATS, 2).mean(axis=2)


def main() -> None:
    """Print a row for each tilt."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="ensenso-n10")
    parser.add_argument("--distance", type=float, default=500.0, help="[mm]")
    parser.add_argument("--process", default="turned")
    parser.add_argument("--roughness", type=float, default=0.8, help="Ra [um]")
    given = parser.parse_args()
    backend.activate(None)
    sensor = load_sensor(given.sensor)
    simulated = SimulatedSensor(sensor)
    round_one, marked = (finish_of(sensor, given.process, given.roughness, lay) for lay in (None, "u"))
    scatters = round_one.scatter, marked.scatter
    print(", ".join(f"alpha {one.alpha_u:.3f} by {one.alpha_v:.3f}" for one in scatters), flush=True)
    isotropic = captured(round_one, sensor, simulated, given.distance, 0.0)
    by_turn = np.array([captured(marked, sensor, simulated, given.distance, turn) for turn in (0.0, 90.0)])
    print("tilt about  deg  F round  F marks along  F marks across  sigma along / round  sigma across / round")
    for axis, name in enumerate(("y (along the baseline)", "x")):
        for k, tilt in enumerate(TILTS_DEG):
            f, along, across = isotropic[axis, k], by_turn[0, axis, k], by_turn[1, axis, k]
            ratios = np.exp([along[1] - f[1], across[1] - f[1]])
            print(
                f"{name:22} {tilt:4.0f} {f[0]:7.3f} {along[0]:7.3f} {across[0]:7.3f} {ratios[0]:7.2f} {ratios[1]:7.2f}"
            )
    off = by_turn - isotropic
    spread = by_turn - by_turn.mean(axis=0)
    for name, one in (("from the round finish", off), ("from the mean over directions", spread)):
        f, sigma = one[..., 0], one[..., 1][np.isfinite(one[..., 1])]
        print(
            f"{name}: F off by {np.sqrt(np.mean(f**2)):.3f} rms, {np.abs(f).max():.2f} at most; "
            f"sigma by {np.sqrt(np.mean(sigma**2)):.0%} rms, {np.abs(sigma).max():.0%} at most"
        )


if __name__ == "__main__":
    main()
