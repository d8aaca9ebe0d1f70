"""What handing out work costs: captures of coupons in this process, in two processes, and on two Dask workers.

    python tests/benchmarks/engine.py [--captures N] [--sensor NAME] [--workers N]

The same shots are taken three ways, after some that are not counted and in which everything is compiled: by a
campaign in this process, which renders in all cores and decodes one capture while it takes the next; by processes of
this machine with their share of the cores; by workers of a Dask cluster of this machine, one thread each. Told are
captures a second, the gain over this process, and the share of the workers' time in which none of them worked on a
capture: that is lost to the engine. It is taken from the workers' own clocks, so that it holds on a machine that others
use too; the gain does not. Patches are compared byte for byte.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.maps.campaign.acquire import in_turn, simulated_source
from mitsim.maps.campaign.orders import Order, order_of, take_order
from mitsim.maps.campaign.plan import Shot, read_campaign
from mitsim.maps.campaign.store import _table_bytes
from mitsim.running.cluster import Cluster
from mitsim.running.executor import Executor, Pool
from mitsim.sensor.preset import load_sensor

CAMPAIGN = Path(__file__).parents[2] / "scenes/coupon/quick.toml"


def timed(order: Order) -> tuple[bytes, float]:
    """Take a shot; its patches and how long that took [s]."""
    began = time.perf_counter()
    patches = take_order(order).patches
    return _table_bytes(patches), time.perf_counter() - began


def spread(workers: Executor, shots: Sequence[Shot], campaign, warm: Sequence[Shot]) -> tuple[dict, float, float]:
    """Patches by shot, the time of all [s], and that in which workers worked [s]."""
    list(workers.distribute(warm, lambda shot: order_of(shot, campaign), timed))
    began = time.perf_counter()
    found = list(workers.distribute(shots, lambda shot: order_of(shot, campaign), timed))
    whole = time.perf_counter() - began
    return {_key(shot): data for shot, (data, _) in found}, whole, sum(seconds for _, (_, seconds) in found)


def _key(shot: Shot) -> tuple[str, str]:
    return shot.series.name, shot.name


def main() -> None:
    """Print a row for each way."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--captures", type=int, default=60)
    asked.add_argument("--sensor", default="ensenso-n10")
    asked.add_argument("--workers", type=int, default=2)
    given = asked.parse_args()
    campaign = read_campaign(CAMPAIGN, load_sensor(given.sensor))
    normals = campaign.file.normals()
    every = [
        campaign.shot(campaign.series[n % len(campaign.series)], normals[n % len(normals)])
        for n in range(given.captures + 8 * given.workers)
    ]
    warm, shots = every[: 8 * given.workers], every[8 * given.workers :]
    print(f"{given.sensor}, {len(shots)} captures, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", flush=True)

    here = in_turn(simulated_source(SimulatedSensor(campaign.sensor), campaign.file.samples_per_pixel), campaign)
    list(here(warm))
    began = time.perf_counter()
    alone = {_key(shot): _table_bytes(finished.patches) for shot, finished in here(shots)}
    plain = time.perf_counter() - began
    print(f"{'this process':<28} {len(shots) / plain:6.2f} captures/s", flush=True)

    def told(name: str, workers: Executor) -> None:
        found, whole, worked = spread(workers, shots, campaign, warm)
        lost = 1 - worked / (given.workers * whole)
        same = "the same bytes" if found == alone else "OTHER BYTES"
        print(
            f"{name:<28} {len(shots) / whole:6.2f} captures/s, {plain / whole:4.2f} times; lost to the engine "
            f"{100 * lost:4.1f} %; {same}",
            flush=True,
        )

    pool = Pool(given.workers)
    told(f"{given.workers} processes", pool)
    pool.close()
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=given.workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs="ERROR"
    ) as made:
        told(f"{given.workers} Dask workers", Cluster(made.scheduler_address))


if __name__ == "__main__":
    main()
