"""How noisy the interreflections of drawn finishes are on the kept paths of a view, and where.

    python tests/benchmarks/brushed_light.py [--sensors NAME ...] [--view N] [--trials N]

Two pillars of `scenes/two_pillars/study.toml`. For the finish of each trial: ratio of alpha along the marks to alpha
across them; root mean square difference of the interreflections of two seeds over sqrt(2), in standard deviations of
their image; share of the squared difference in one hundredth of the pixels; the same without these pixels. The last
line is the share of finishes below 0.2, with these pixels and without. The first camera alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mitsim.scene import backend

STUDY = Path(__file__).parents[2] / "scenes" / "two_pillars" / "study.toml"


def main() -> None:
    """Print a line for each finish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["ensenso-n10", "zivid-2-m70", "david-sls-3"])
    parser.add_argument("--view", type=int, default=99)
    parser.add_argument("--trials", type=int, default=20)
    given = parser.parse_args()
    backend.activate(None)
    for name in given.sensors:
        print_noise(name, given.view, given.trials)


def print_noise(name: str, number: int, trials: int) -> None:
    """Print the lines of one sensor."""
    from characterisation.files.documents import read_toml
    from mitsim.capture.simulated.kept_light import keep_light
    from mitsim.study import StudyFile, open_study
    from mitsim.study.virtual.plan import measurements_of
    from mitsim.study.virtual.rendered import _PROBING_FINISHES
    from mitsim.study.virtual.study_unknowns import study_unknowns
    from mitsim.study.virtual.world import Trial

    study = open_study(STUDY, read_toml(STUDY, StudyFile).model_copy(update={"sensor": name}))
    maker = measurements_of(study, study_unknowns(study))
    view, simulated = study.view(number, "--view"), maker.simulated

    def kept(seed: int):
        finishes = map(maker.part.scene_in, (-1, *_PROBING_FINISHES))
        return keep_light(simulated, study.scene, pose, rois, maker.rendering, finishes, seed)[camera]

    rois, pose = maker.view_light(view).rois, view.world_from_sensor
    camera = next(iter(rois))
    seeds = [kept(seed) for seed in (1, 2)]
    noises = []
    for day in range(trials):
        scene, _ = maker.part.in_finish(maker.unknowns.draw(Trial(day)).finish)
        scatters = [finish.scatter for finish in scene.finishes if finish is not None and finish.scatter is not None]
        ratio = min(one.alpha_u / one.alpha_v for one in scatters)
        first, second = (one.images(scene, simulated)[0] for one in seeds)
        lit = (first > 0) | (second > 0)
        square = np.sort((first - second)[lit] ** 2)[::-1] / 2
        few, spread = len(square) // 100, first[lit].std()
        noises.append((np.sqrt(square.mean()) / spread, np.sqrt(square[few:].mean()) / spread))
        print(
            f"{name:<14} day {day:<3} lay ratio {ratio:.2f}  noise {noises[-1][0]:.2f}  "
            f"{square[:few].sum() / square.sum():.0%} of it in 1 % of the pixels, without these {noises[-1][1]:.2f}",
            flush=True,
        )
    every, without = (np.array(noises) < 0.2).mean(axis=0)
    print(f"{name}: below 0.2: {every:.0%} of {trials} finishes, without 1 % of the pixels {without:.0%}")


if __name__ == "__main__":
    main()
