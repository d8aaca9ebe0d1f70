"""Compare planned exposures with the preset's own, view by view, on the two pillars.

python tests/benchmarks/exposure_plans.py --sensor ensenso-n10 --views 7 40 63 90 --worlds 8

A plan is made with every unknown at its best estimate. It is tested in other worlds, with all unknowns and noise drawn.
Each world is traced once and exposed both ways. The table has the mean number of points of the three features, and the
share of measurements with a value. Its errors are root mean square errors, planned over own, of the worlds with a value
both ways. They are the geometric mean over the measurements with three such worlds or more.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np

SCENE = Path(__file__).parents[2] / "scenes" / "two_pillars" / "study.toml"

#: first day of the worlds: neither those of races nor those of statements
FIRST_DAY = 1 << 22


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="ensenso-n10")
    parser.add_argument("--ra", nargs="+", type=float, default=[0.09, 0.37])
    parser.add_argument("--views", nargs="+", type=int, default=[7, 40, 63, 90])
    parser.add_argument("--worlds", type=int, default=8)
    given = parser.parse_args()

    from mitsim.scene import backend

    backend.activate(None)
    from characterisation.files.documents import read_toml
    from characterisation.tasks.evaluation import measure
    from mitsim.sensor.exposure import PlannedExposure
    from mitsim.study import MINIMUM_POINTS, StudyFile, open_study
    from mitsim.study.exposures.exposure_plan import PlanRules
    from mitsim.study.exposures.exposure_sweep import needed_shapes
    from mitsim.study.exposures.planned import exposure_in_words, plan_view
    from mitsim.study.virtual.plan import measurements_of
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.trials import Outcome
    from mitsim.study.virtual.world import Trial

    print(
        "| sensor | Ra [um] | view | own | planned | light, planned over own | points, own to planned | values "
        "| errors | planned in |\n" + "| --- " * 10 + "|"
    )
    for ra in given.ra:
        table = {"sensor": given.sensor, "parameters": {"pillar_Ra": ra, "plane_Ra": ra}}
        study = open_study(SCENE, read_toml(SCENE, StudyFile).model_copy(update=table))
        maker = measurements_of(study, study_unknowns(study))
        own = study.sensor.exposure.exposures(None, 1.0)
        shapes, names = needed_shapes(study.task), list(study.task.measurements)
        for number in given.views:
            view, began = study.views[number], time.monotonic()
            plan = plan_view(maker, view, PlanRules())
            seconds = time.monotonic() - began
            points, errors = {False: [], True: []}, {False: [], True: []}
            days = sorted(
                (Trial(FIRST_DAY + k) for k in range(given.worlds)), key=lambda trial: maker.unknowns.draw(trial).finish
            )
            for trial in days:
                world = maker.unknowns.draw(trial)
                for planned in (False, True):
                    cloud, assumed = maker.exposed_as(plan.exposure if planned else None).cloud_of(view, world)
                    part_from_world = assumed.inverse().matrix()
                    found = Outcome.of(measure(cloud, study.task, part_from_world, MINIMUM_POINTS, False))
                    points[planned].append([len(cloud.of_feature(name)) for name in shapes])
                    errors[planned].append([found.errors[name] for name in names])
            before, after = (np.array(errors[planned]) for planned in (False, True))
            both = np.isfinite(before) & np.isfinite(after)
            ratios = [
                math.sqrt((after[both[:, m], m] ** 2).mean() / (before[both[:, m], m] ** 2).mean())
                for m in range(len(names))
                if both[:, m].sum() >= 3
            ]
            counts = [", ".join(f"{one:.0f}" for one in np.mean(points[planned], axis=0)) for planned in (False, True)]
            values = [f"{100 * np.isfinite(one).mean():.0f}" for one in (before, after)]
            ratio = f"{math.exp(np.mean(np.log(ratios))):.2f} ({len(ratios)})" if ratios else "-"
            longer = plan.exposure.seconds / sum(own)
            print(
                f"| {given.sensor} | {ra:g} | {number} | {exposure_in_words(PlannedExposure(own))} "
                f"| {exposure_in_words(plan.exposure)} | {longer:.2f} | {counts[0]} to {counts[1]} "
                f"| {values[0]} to {values[1]} % | {ratio} | {seconds:.0f} s |",
                flush=True,
            )


if __name__ == "__main__":
    main()
