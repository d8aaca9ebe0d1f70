"""Whether a campaign survives being killed: kills at random moments, then a run to the end.

    python tests/benchmarks/kills.py [kills]

The campaign is of a sensor that is known (tests/campaign/known_clouds.py), slowed down so that most of its time is
spent between and within captures; each run is killed by SIGKILL after a random time, and the last one left to end.
Printed: how many captures were kept at each kill, how many were lost or taken twice, and whether map.nc and samples.nc
are byte for byte those of a campaign that nobody disturbed.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]


def kept_in(folder: Path) -> dict[Path, int]:
    """Captures that are kept, and when each was written [ns]."""
    return {path.parent: path.stat().st_mtime_ns for path in folder.glob("coupons/*/[+-]*/shot.json")}


def main() -> None:
    """Kill, count, compare."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "campaign.toml").write_text(
            "distances_mm = [400, 600]\norientations = [{ up_to_deg = 60, subdivisions = 2 }]\n"
            "refine = { sigma = 0.3, subdivisions = 3 }\n"
            + "".join(f"[[samples]]\nscene = '{ROOT}/scenes/coupon/{name}.xml'\n" for name in ("matt_white", "coupon"))
        )
        command = [sys.executable, ROOT / "tests/campaign/known_clouds.py", folder / "campaign.toml"]
        subprocess.run([*command, folder / "whole"], check=True, capture_output=True)
        total = len(kept_in(folder / "whole"))
        print(f"{total} captures, {kills} kills")
        lost = again = 0
        rng = random.Random(1)
        counts = []
        started = time.monotonic()
        for _ in range(kills):
            before = kept_in(folder / "killed")
            running = subprocess.Popen([*command, folder / "killed", "0.1"], stderr=subprocess.DEVNULL)
            time.sleep(rng.uniform(1.0, 5.0))  # from before the first capture of this run to some dozens later
            running.send_signal(signal.SIGKILL)
            running.wait()
            after = kept_in(folder / "killed")
            lost += len(before.keys() - after.keys())
            again += sum(after[path] != written for path, written in before.items() if path in after)
            counts.append(len(after))
        print("captures kept after each kill:", *counts)
        before = kept_in(folder / "killed")
        subprocess.run([*command, folder / "killed"], check=True, capture_output=True)
        after = kept_in(folder / "killed")
        lost += len(before.keys() - after.keys())
        again += sum(after[path] != written for path, written in before.items() if path in after)
        same = all(
            (folder / "whole" / name).read_bytes() == (folder / "killed" / name).read_bytes()
            for name in ("map.nc", "samples.nc")
        )
        left = len(list((folder / "killed").rglob(".*partial*")))
        print(f"kept in the end {len(after)} of {total}; lost {lost}; taken twice {again}; left half-written {left}")
        print(f"map.nc and samples.nc byte for byte the same: {same}; {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
