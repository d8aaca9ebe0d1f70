"""How noisy kept interreflections are in drawn finishes, and what their smoothing does to what is measured.

python tests/benchmarks/drawn_noise.py CASES NAME [--view N] [--seeds N] [--smoothing PX ...] [--fine N]

One case of `tests.proofs statements`. *noise*: root mean square over the pixels of the standard deviation between seeds
of the paths, relative to the mean light, at the best estimate and in twelve drawn finishes; sampled with one, two and
three lobes, the drawn ones widened to the narrowest of these, and with three and no widening (*as drawn*). *light* is
the sum over the image with three lobes over that of lobes as drawn. *errors* of every measurement in the same worlds:
with one to three lobes and each smoothing [px] of kept light, with light rendered anew, and anew with N times the paths
and less smoothing (*fine*); median and mean of the absolute difference from the last.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from mitsim.scene import backend

#: smoothing of the finest light that is rendered anew [px]; chosen, as its paths are many
_FINE_PX = 1.0


def main() -> None:
    """Print a row for each way to sample, and one for each measurement and way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases")
    parser.add_argument("name")
    parser.add_argument("--view", type=int, default=18)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--smoothing", nargs="*", type=float, default=[1.5])
    parser.add_argument("--fine", type=int, default=12)
    given = parser.parse_args()
    backend.activate(None)
    for row in rows(given.cases, given.name, given.view, given.seeds, given.smoothing, given.fine):
        print(row, flush=True)


def rows(cases: str, name: str, number: int, seeds: int, smoothings: list[float], fine: int):
    """Yield the rows of one case."""
    from mitsim.capture.simulated.indirect_light import IndirectLight
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
    lobes, lights = list(zip(kept_finishes._FACTORS, kept_finishes._SHARES, strict=True)), {}

    def sampled_with(count: int) -> None:
        """Sample with the first lobes alone, in shares that stay in proportion."""
        kept_finishes._FACTORS, shares = zip(*lobes[:count], strict=True)
        kept_finishes._SHARES = tuple(share / sum(shares) for share in shares)

    for count, drawn in ((1, False), (2, False), (3, False), (3, True)):
        sampled_with(count)
        images = []
        for seed in range(1, seeds + 1):
            other = maker.rendered_as(replace(rendering, samples=rendering.samples + seed))  # with light of its own
            other.unknowns = replace(unknowns, seed=seed)
            kept = next(iter(other.view_light(view).kept.values()))
            kept = replace(kept, widths={}) if drawn else kept
            finishes = [-1, *(unknowns.draw(trial).finish for trial in trials)]
            images.append([kept.images(maker.part.in_finish(each)[0], maker.simulated) for each in finishes])
        spread, mean = np.std(images, axis=0, ddof=1), np.mean(images, axis=0)
        noise = np.sqrt((spread**2).mean(axis=(1, 2, 3))) / mean.mean(axis=(1, 2, 3))
        lights[drawn] = mean.sum(axis=(1, 2, 3))
        way, geometric = f"{count} lobes{', as drawn' if drawn else ''}", np.exp(np.log(noise[1:]).mean())
        yield f"noise  {way:<17} best estimate {noise[0]:.2f}  drawn {_row(noise[1:])}  geometric mean {geometric:.2f}"
    yield f"light  {_row((lights[False] / lights[True])[1:])}"
    finer = replace(rendering, indirect=IndirectLight(fine * rendering.indirect.samples, _FINE_PX))
    kept = {px: replace(rendering, kept=replace(rendering.kept, smoothing_px=px)) for px in smoothings}
    ways = [(f"{count} lobes, {px} px", count, False, kept[px]) for count in (1, 2, 3) for px in kept]
    errors = {}
    for way, count, separate, how in [*ways, ("anew", 3, True, rendering), ("fine", 3, True, finer)]:
        sampled_with(count)
        made = measurements_of(study, unknowns, separate, how).run([Job(view, trial) for trial in trials])
        outcomes = [outcome.errors for _, outcome in made]
        errors[way] = {name: np.array([each[name] for each in outcomes], float) for name in study.task.measurements}
    for name in study.task.measurements:
        for way, of_way in errors.items():
            off = np.abs(of_way[name] - errors["fine"][name])
            texts = " ".join(f"{value:+.2f}" for value in of_way[name])
            yield f"errors {name:<24} {way:<16} off by {np.nanmedian(off):.3f} {np.nanmean(off):.3f}  {texts}"


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in values)


if __name__ == "__main__":
    main()
