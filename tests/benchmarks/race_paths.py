"""What fewer paths of interreflections change in the trials of a race, and what they save.

python tests/benchmarks/race_paths.py [--sensors NAME ...] [--views N ...] [--trials N]

Two pillars with tolerances. The same trials with all paths and with those of the race. For each view: seconds of the
first trial, which traces the paths, and of a later one (median); for each measurement, root mean square of the change
of its error over that of the error, and the ratio of the root mean squares of the errors.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from mitsim.scene import backend

STUDY = Path(__file__).parents[2] / "scenes" / "two_pillars" / "tolerances.toml"


def main() -> None:
    """Print a table for each sensor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["ensenso-n10", "david-sls-3", "zivid-2-m70"])
    parser.add_argument("--views", nargs="+", type=int, default=[17, 74, 93, 99])
    parser.add_argument("--trials", type=int, default=12)
    given = parser.parse_args()
    backend.activate(None)
    for name in given.sensors:
        print(name, "first trial and later ones [s], all paths | race; change / error; error of the race / of all")
        for number in given.views:
            print(f"  view {number:3d} ", row(name, number, given.trials), flush=True)


def row(name: str, number: int, count: int) -> str:
    """Return the row of a view."""
    from mitsim.study.choose import read_candidates
    from mitsim.study.session import Session
    from mitsim.study.virtual.plan import race_rendering
    from mitsim.study.virtual.race import Job
    from mitsim.study.virtual.world import Trial

    study = read_candidates(STUDY, [name])[0][0].study
    runner, view = Session(study).renderer, study.view(number)
    assert runner is not None
    errors, seconds = [], []
    for each in (runner, runner.rendered_as(race_rendering(study))):
        times, made = [], []
        for day in range(count):
            began = time.perf_counter()
            ((_, outcome),) = each.run([Job(view, Trial(day))])
            times.append(time.perf_counter() - began)
            made.append(list(outcome.errors.values()))
        errors.append(np.array(made))
        seconds.append(f"{times[0]:.1f} {np.median(times[1:]):.2f}")
    with np.errstate(invalid="ignore"):
        full, fewer = (np.sqrt(np.nanmean(one**2, axis=0)) for one in errors)
        change = np.sqrt(np.nanmean((errors[1] - errors[0]) ** 2, axis=0)) / full
    return " | ".join([*seconds, " ".join(f"{x:.2f}" for x in change), " ".join(f"{x:.2f}" for x in fewer / full)])


if __name__ == "__main__":
    main()
