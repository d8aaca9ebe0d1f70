"""How noisy kept interreflections are in drawn finishes, and what their smoothing does to what is measured.

python tests/benchmarks/drawn_noise.py CASES NAME [--view N] [--seeds N] [--smoothing PX ...]

One case of `tests.proofs statements`. *noise*: root mean square over the pixels of the standard deviation between seeds
of the paths, relative to the mean light, at the best estimate and in twelve drawn finishes; with *wide* lobes alone to
sample with, with *wide and narrow* ones, and *resolved*, as statements are: with these, and no drawn lobe narrower.
*light* is the sum over the image of the resolved one over that of lobes as drawn. *errors* of every measurement over
the same twelve draws, with their mean and median: with each smoothing [px] of kept light, and with light rendered anew.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from mitsim.scene import backend


def main() -> None:
    """Print a row for each way to sample, and a row for each smoothing and measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases")
    parser.add_argument("name")
    parser.add_argument("--view", type=int, default=18)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--smoothing", nargs="*", type=float, default=[2.5, 1.5])
    given = parser.parse_args()
    backend.activate(None)
    for row in rows(given.cases, given.name, given.view, given.seeds, given.smoothing):
        print(row, flush=True)


def rows(cases: str, name: str, number: int, seeds: int, smoothings: list[float]):
    """Yield the rows of one case."""
    from mitsim.scene.light_transport import kept_finishes
    from mitsim.study.session import Session
    from mitsim.study.virtual.plan import measurements_of, rendering_of
    from mitsim.study.virtual.race import Job
    from mitsim.study.virtual.world import Trial
    from tests.proofs.part_cases import read_part_cases

    study = read_part_cases(cases, [name])[0].open()
    unknowns, rendering, view = Session(study).unknowns, rendering_of(study), study.view(number, "--view")
    trials = [Trial(9000 + index) for index in range(12)]
    maker = measurements_of(study, unknowns, False, rendering)
    share, lights = kept_finishes._NARROW_SHARE, {}
    for way, kept_finishes._NARROW_SHARE in (("wide", 0.0), ("wide and narrow", share), ("resolved", share)):
        images = []
        for seed in range(1, seeds + 1):
            other = maker.rendered_as(replace(rendering, samples=rendering.samples + seed))  # with light of its own
            other.unknowns = replace(unknowns, seed=seed)
            kept = next(iter(other.view_light(view).kept.values()))
            kept = kept if way == "resolved" else replace(kept, widths={})
            finishes = [-1, *(unknowns.draw(trial).finish for trial in trials)]
            images.append([kept.images(maker.part.in_finish(each)[0], maker.simulated) for each in finishes])
        spread, mean = np.std(images, axis=0, ddof=1), np.mean(images, axis=0)
        noise = np.sqrt((spread**2).mean(axis=(1, 2, 3))) / mean.mean(axis=(1, 2, 3))
        lights[way] = mean.sum(axis=(1, 2, 3))
        geometric = np.exp(np.log(noise[1:]).mean())
        yield f"noise  {way:<16} best estimate {noise[0]:.2f}  drawn {_row(noise[1:])}  geometric mean {geometric:.2f}"
    yield f"light  {'resolved':<16} {_row((lights['resolved'] / lights['wide and narrow'])[1:])}"
    ways = [(f"{px} px", False, replace(rendering, kept=replace(rendering.kept, smoothing_px=px))) for px in smoothings]
    for way, separate, how in [*ways, ("anew", True, rendering)]:
        made = measurements_of(study, unknowns, separate, how).run([Job(view, trial) for trial in trials])
        errors = [outcome.errors for _, outcome in made]
        for measured in study.task.measurements:
            found = np.array([each[measured] for each in errors], float)
            found = found[np.isfinite(found)]
            texts = " ".join(f"{value:+.2f}" for value in found)
            yield f"errors {way:<8} {measured:<24} mean {found.mean():+.3f} median {np.median(found):+.3f}  {texts}"


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in values)


if __name__ == "__main__":
    main()
