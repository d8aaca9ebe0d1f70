"""Peak memory of every preset: one capture of a part and its decoding, and a validation of its map.

    python tests/benchmarks/peak_memory.py [--sensors NAME ...] [--poses N]

Each command runs alone, in a process of its own, and its largest resident size is told, as the system counts it
(Linux; children included). The capture is of the two pillars in ground aluminium, the whole image, light of three
surfaces, 16 samples per pixel, from the middle of the working range. The validation is ``mitsim map validate`` of matt
white with so many poses at each distance. How large a worker must be is the largest number of its row.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mitsim.sensor.preset import load_sensor, presets

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes/two_pillars/two_pillars.xml"


def peak(*arguments: object) -> tuple[float, float]:
    """Largest resident size [GiB] of a command and its children, and its time [s]."""
    began = time.perf_counter()
    told = tempfile.TemporaryFile()  # noqa: SIM115 - the child writes to it
    child = subprocess.Popen([sys.executable, "-m", "mitsim", *map(str, arguments)], stdout=told, stderr=told, cwd=ROOT)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in (0, 1):  # 1: ran, and the map misses a pose, as with one pose it may
        told.seek(0)
        raise RuntimeError(told.read().decode()[-2000:])
    return usage.ru_maxrss / 2**20, time.perf_counter() - began


def main() -> None:
    """Print a row for each sensor."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--sensors", nargs="+", default=presets())
    asked.add_argument("--poses", type=int, default=1)
    given = asked.parse_args()
    print("| sensor | capture | decode | map validate | time |\n|---|---|---|---|---|", flush=True)
    for name in given.sensors:
        near, far = load_sensor(name).working_range_mm
        height = (near * far) ** 0.5
        with tempfile.TemporaryDirectory() as folder:
            campaign = Path(folder) / "campaign.toml"
            white = (ROOT / "scenes/coupon/matt_white.xml").as_posix()
            turns = "orientations = [{ up_to_deg = 40, subdivisions = 0 }]"
            text = f'samples = [{{ scene = "{white}" }}]\nsamples_per_pixel = 16\n{turns}\n'
            campaign.write_text(text, encoding="utf-8")
            place = ("--position", 0, -0.5 * height, 0.87 * height, "--sensor", name)
            found = [
                peak("render", SCENE, *place, "-o", f"{folder}/c"),
                peak("decode", f"{folder}/c", "-o", f"{folder}/c.ply"),
                peak("map", "validate", name, campaign, "--sensor", name, "--poses", given.poses, "-o", f"{folder}/v"),
            ]
        sizes = " | ".join(f"{size:.2f} GiB" for size, _ in found)
        print(f"| `{name}` | {sizes} | {', '.join(f'{seconds:.0f}' for _, seconds in found)} s |", flush=True)


if __name__ == "__main__":
    main()
