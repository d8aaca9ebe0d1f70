"""Whether a campaign survives being killed: kills at random moments, then a run to the end.

    python tests/benchmarks/kills.py [kills]

The campaign uses a known sensor (maps/campaign/known_clouds.py). Every second run is slowed down, so that some kills
fall between captures; the others write nearly all the time. Each run is killed by SIGKILL. One in five is killed at a
random moment of its start, while it reads what is kept. The others are killed a random number of captures later or,
once all captures are kept, at a random moment until the map is made. Only a run that was still alive counts as killed.
The last run is left to end.

Printed are the number of captures kept at each kill, the number of kills that left something half-written, and the
number of captures lost or taken twice in the end. The last line says whether map.nc and samples.nc are byte for byte
those of a campaign without kills.
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

#: seconds between captures, of a run in two
PAUSE_S = 0.1


def kept_in(folder: Path) -> dict[Path, int]:
    """Captures that are kept, and when each was written [ns]."""
    return {path.parent: path.stat().st_mtime_ns for path in folder.glob("coupons/*/[+-]*/shot.json")}


def partial_in(folder: Path) -> int:
    """How much is half-written."""
    return len([*folder.glob("coupons/*/.*partial*"), *folder.glob(".*partial*")])


def campaign_file(folder: Path) -> Path:
    """A campaign of some 500 captures, with refinement."""
    file = folder / "campaign.toml"
    file.write_text(
        "distances_mm = [400, 600]\norientations = [{ up_to_deg = 60, subdivisions = 2 }]\n"
        "refine = { sigma = 0.3, subdivisions = 3 }\n"
        + "".join(f"[[samples]]\nscene = '{ROOT}/scenes/coupon/{name}.xml'\n" for name in ("matt_white", "coupon"))
    )
    return file


def kill(running: subprocess.Popen[bytes], moment: float) -> bool:
    """Kill a run after ``moment`` seconds; whether it was there to be killed."""
    try:
        running.wait(moment)
    except subprocess.TimeoutExpired:
        running.send_signal(signal.SIGKILL)
        return running.wait() == -signal.SIGKILL
    return False


def main() -> None:
    """Kill, count, compare."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        whole, killed = folder / "whole", folder / "killed"
        command: list[str | Path] = [
            sys.executable,
            ROOT / "tests/maps/campaign/known_clouds.py",
            campaign_file(folder),
        ]
        began = time.monotonic()
        first = subprocess.Popen([*command, whole], stderr=subprocess.DEVNULL)
        while not kept_in(whole) and first.poll() is None:
            time.sleep(0.05)
        start = time.monotonic() - began  # imports, the plan
        assert first.wait() == 0
        total = len(kept_in(whole))
        print(f"{total} captures, {kills} kills; a run starts in {start:.1f} s")
        most = max(1, round(2 * total / (0.7 * kills)))  # of one run, so that some kills are left when all are taken
        rng = random.Random(1)
        lost = again = torn = done = ended = 0
        moments = {"starting": 0, "taking captures": 0, "with all captures kept": 0}
        counts = []
        while done < kills and ended < kills:
            before = kept_in(killed)
            running = subprocess.Popen([*command, killed, str(rng.choice([0, PAUSE_S]))], stderr=subprocess.DEVNULL)
            if rng.random() < 0.2:
                gone = kill(running, rng.uniform(0, start))
            else:
                enough = min(len(before) + rng.randint(1, most), total)
                while running.poll() is None and len(before) < total and len(kept_in(killed)) < enough:
                    time.sleep(0.02)
                gone = kill(running, rng.uniform(0, 2 * PAUSE_S if len(before) < total else 1.3 * start))
            after = kept_in(killed)
            lost += len(before.keys() - after.keys())
            again += sum(after[path] != written for path, written in before.items() if path in after)
            if not gone:
                ended += 1
                continue
            done += 1
            torn += bool(partial_in(killed))
            counts.append(len(after))
            taking = "taking captures" if len(after) > len(before) else "starting"
            moments["with all captures kept" if len(before) == total else taking] += 1
        print("captures kept after each kill:", *counts)
        print(f"{done} kills:", ", ".join(f"{count} {moment}" for moment, count in moments.items()), end="; ")
        print(f"{ended} runs ended before they were killed; {torn} kills left something half-written")
        before = kept_in(killed)
        subprocess.run([*command, killed], check=True, capture_output=True)
        after = kept_in(killed)
        lost += len(before.keys() - after.keys())
        again += sum(after[path] != written for path, written in before.items() if path in after)
        same = all((whole / name).read_bytes() == (killed / name).read_bytes() for name in ("map.nc", "samples.nc"))
        print(f"kept in the end {len(after)} of {total}; lost {lost}; taken twice {again}; left {partial_in(killed)}")
        print(f"map.nc and samples.nc byte for byte the same: {same}; {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
