"""Whether a long campaign grows: memory, open and temporary files over many captures in one process, and their time.

python tests/benchmarks/memory.py [captures]
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.campaign.acquire import coupon_cloud, simulated_source
from mitsim.maps.campaign.plan import read_campaign
from mitsim.sensor.preset import load_sensor

CAMPAIGN = Path(__file__).parents[2] / "scenes/coupon/campaign.toml"


def resident_mib() -> float:
    """Resident size of this process [MiB] (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS in /proc/self/status")


def files() -> tuple[int, int]:
    """Files that this process holds open, and entries of the system's temporary folder (Linux)."""
    return len(list(Path("/proc/self/fd").iterdir())), len(list(Path(tempfile.gettempdir()).iterdir()))


def main() -> None:
    """Take captures of coupons at changing poses, finishes and windows; print memory and time as they go."""
    captures = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    sensor = load_sensor("ensenso-n10")
    campaign = read_campaign(CAMPAIGN, sensor)
    take = simulated_source(SimulatedSensor(sensor), campaign.file.samples_per_pixel)
    geometry, normals, times = sensor_geometry(sensor), campaign.file.normals(), []
    start = 0.0
    print(
        f"{'captures':>9} {'resident MiB':>13} {'growth':>8} {'open files':>11} {'temporary':>10} "
        f"{'median s of the last hundred':>29}",
        flush=True,
    )
    for number in range(captures + 1):
        before = time.perf_counter()
        shot = campaign.shot(campaign.series[number % len(campaign.series)], normals[number % len(normals)])
        coupon_cloud(take(shot), shot.series.sample.at(shot.sensor_from_coupon), geometry, sensor)
        times.append(time.perf_counter() - before)
        if number == 50:  # everything has been compiled and allocated once
            start = resident_mib()
        if number >= 100 and number % 100 == 0:
            now = resident_mib()
            print(
                f"{number:9} {now:13.1f} {100 * (now / start - 1):7.1f}% {files()[0]:11} {files()[1]:10} "
                f"{statistics.median(times[-100:]):29.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
