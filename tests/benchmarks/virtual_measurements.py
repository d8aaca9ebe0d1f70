"""How many virtual measurements a sensor makes in a second before the two pillars, and where their time goes.

    python tests/benchmarks/virtual_measurements.py [--sensors NAME ...] [--trials N]

One view, 45 deg above the plate, ground aluminium of Ra 0.37, light of two surfaces. Every trial has a finish of its
own. `paths` are the seconds, once for the view, in which the paths of interreflections are traced; the other times are
those of one trial: the finish with what it returns of the room's light, the interreflections in it, all direct light,
and what follows. One is decoded while the next is rendered: the parts add up to more than the whole. On a machine that
others use too, compare the ratios.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from mitsim.scene import backend

SCENES = Path(__file__).parents[2] / "scenes" / "two_pillars"


def main() -> None:
    """Print a row for each sensor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["ensenso-n10", "david-sls-3", "zivid-2-m70"])
    parser.add_argument("--trials", type=int, default=16)
    given = parser.parse_args()
    backend.activate(None)
    print(f"{'sensor':<26} {'trials/s':>8} {'paths':>6}   seconds of: finish indirect  light  expose  decode measure")
    for name in given.sensors:
        print(row(name, given.trials), flush=True)


def row(name: str, count: int) -> str:
    """Time the trials of one sensor."""
    import mitsim.study.virtual.rendered as rendered
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.study import StudyFile, open_study
    from mitsim.study.virtual.plan import measurements_of
    from mitsim.study.virtual.race import Job
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.view_light import LightOfViews
    from mitsim.study.virtual.world import Trial

    study = open_study(
        SCENES / "study.toml",
        StudyFile.model_validate(
            {
                "scene": "two_pillars.xml",
                "parameters": {"plane_Ra": 0.37, "pillar_Ra": 0.37},
                "task": "task.toml",
                "sensor": name,
                "views": {"subdivisions": 1, "lowest_elevation_deg": 20},
            }
        ),
    )
    maker = measurements_of(study, study_unknowns(study))
    view = min(study.views, key=lambda one: abs(one.elevation_deg - 45))
    seconds: dict[str, float] = {}

    def timed(owner, attribute, what):
        original = getattr(owner, attribute)

        def wrapped(*arguments, **named):
            began = time.perf_counter()
            try:
                return original(*arguments, **named)
            finally:
                seconds[what] = seconds.get(what, 0.0) + time.perf_counter() - began

        setattr(owner, attribute, wrapped)
        return owner, attribute, original

    list(maker.run([Job(view, Trial(day)) for day in range(2)]))  # compiles
    maker.views = LightOfViews()
    began = time.perf_counter()
    maker.view_light(view)
    paths = time.perf_counter() - began
    places = [
        timed(maker.part, "in_finish", "finish"),
        timed(maker, "_indirect", "indirect"),
        timed(SimulatedSensor, "light", "light"),
        timed(SimulatedSensor, "expose", "expose"),
        timed(rendered, "capture_cloud", "decode"),
        timed(rendered, "measure", "measure"),
    ]
    began = time.perf_counter()
    list(maker.run([Job(view, Trial(100 + day)) for day in range(count)]))
    whole = time.perf_counter() - began
    for owner, attribute, original in places:
        setattr(owner, attribute, original)
    names = ("finish", "indirect", "light", "expose", "decode", "measure")
    parts = "  ".join(f"{seconds.get(what, 0.0) / count:6.3f}" for what in names)
    return f"{name:<26} {count / whole:8.2f} {paths:6.2f}             {parts}"


if __name__ == "__main__":
    main()
