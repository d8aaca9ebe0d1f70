"""How often the 95 % intervals of ``mitsim fit sensor`` hold the truth: many simulated units of one small sensor.

python tests/benchmarks/fit_sensor_coverage.py [first unit] [last unit] [simulations averaged]

Each unit has another power, pattern, noise, corner loss and room; a fit takes some 5 s. 97 % of 100 units is 1.7
standard deviations off 95 %.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.twin.sensor.small_unit import standard_errors


def main(first: int, last: int, draws: int) -> None:
    every = []
    for seed in range(first, last):
        found, errors = standard_errors(seed, draws)
        every.append(errors)
        print(
            f"unit {seed}: chi-square {found.moment_fit.chi_square:.1f} of {found.moment_fit.freedom}", file=sys.stderr
        )
    print("| number | units | mean error / u | its standard deviation | in the 95 % interval |")
    print("| --- | --- | --- | --- | --- |")
    for key in sorted({key for errors in every for key in errors}):
        own = np.array([errors[key] for errors in every if key in errors])
        print(f"| {key} | {len(own)} | {own.mean():+.2f} | {own.std():.2f} | {np.mean(np.abs(own) < 1.96):.3f} |")
    pooled = np.array([error for errors in every for error in errors.values()])
    print(f"| all | {len(every)} | {pooled.mean():+.2f} | {pooled.std():.2f} | {np.mean(np.abs(pooled) < 1.96):.3f} |")


if __name__ == "__main__":
    given = [int(argument) for argument in sys.argv[1:]]
    main(*(given + [0, 100, 3][len(given) :]))
