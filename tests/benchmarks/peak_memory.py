"""Peak memory of every preset: one capture of a part and its decoding, and a validation of its map.

    python tests/benchmarks/peak_memory.py [--sensors NAME ...] [--poses N]
    python tests/benchmarks/peak_memory.py --trials [--sensors NAME ...]

Each command runs alone, in a process of its own, and its largest resident size is told, as the system counts it
(Linux; children included). The capture is of the two pillars in ground aluminium, the whole image, light of three
surfaces, 16 samples per pixel, from the middle of the working range. The validation is ``mitsim map validate`` of matt
white with so many poses at each distance. With ``--trials``, six virtual measurements of each of two views of
``scenes/two_pillars/study.toml`` instead. How large a worker must be is the largest number of its row.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mitsim.sensor.preset import load_sensor, presets

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes/two_pillars/two_pillars.xml"

#: views whose trials are made
VIEWS = (99, 85)


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


def print_trials(name: str) -> None:
    """Print the largest resident size [GiB] of this process after trials of one view, and of two."""
    from characterisation.files.documents import read_toml
    from mitsim.scene import backend
    from mitsim.study import StudyFile, open_study
    from mitsim.study.virtual.plan import measurements_of
    from mitsim.study.virtual.race import Job
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.world import Trial

    backend.activate(None)
    path, sizes = ROOT / "scenes/two_pillars/study.toml", []
    study = open_study(path, read_toml(path, StudyFile).model_copy(update={"sensor": name}))
    maker = measurements_of(study, study_unknowns(study))
    for number in VIEWS:
        list(maker.run(Job(study.view(number), Trial(day)) for day in range(6)))
        sizes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
    print(f"| `{name}` | {' | '.join(f'{size:.2f} GiB' for size in sizes)} |", flush=True)


def main() -> None:
    """Print a row for each sensor."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--sensors", nargs="+", default=presets())
    asked.add_argument("--poses", type=int, default=1)
    asked.add_argument("--trials", action="store_true", help="virtual measurements instead")
    asked.add_argument("--of", help=argparse.SUPPRESS)
    given = asked.parse_args()
    if given.of:
        print_trials(given.of)
        return
    if given.trials:
        print("| sensor | one view | two views |\n|---|---|---|", flush=True)
        for name in given.sensors:
            subprocess.run([sys.executable, __file__, "--of", name], check=True, stderr=subprocess.DEVNULL)
        return
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
