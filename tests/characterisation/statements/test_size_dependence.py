"""The drawn number on which the size of an error depends, on errors whose dependence is known."""

import math

import numpy as np
import pytest

from characterisation.statements.coverage import coverage_interval
from characterisation.statements.size_dependence import DrawnNumber, size_dependence


def numbers_of(rng: np.random.Generator, trials: int, count: int = 20) -> list[DrawnNumber]:
    return [DrawnNumber("finish", f"number {k}", "plate", rng.standard_normal(trials)) for k in range(count)]


def test_errors_that_grow_with_a_number(rng):
    numbers = numbers_of(rng, 600)
    errors = np.exp(0.5 * numbers[7].values) * rng.standard_normal(600) + 0.3
    found = size_dependence(errors, coverage_interval(errors), numbers, np.arange(600))
    assert found.group == "finish" and found.name == "number 7" and found.of == "plate"
    assert found.trials == (200, 200)
    # E[exp(x); x > a] = sqrt(e) P(x > a - 1), with P(x > a) = 1 / 3; likewise below -a
    low, high = (math.sqrt(3 * math.exp(0.5) * tail) for tail in (0.0763, 0.7154))
    assert found.uncertainty[0] == pytest.approx(low, rel=0.2)
    assert found.uncertainty[1] == pytest.approx(high, rel=0.2)
    assert found.inside[1] < 0.95 < found.inside[0]


def test_a_number_with_two_values(rng):
    kind = (rng.random(400) < 0.3).astype(float)
    errors = np.where(kind, 3.0, 1.0) * rng.standard_normal(400)
    errors[::17] = np.nan
    numbers = [*numbers_of(rng, 400), DrawnNumber("decoder", "census", "", kind)]
    found = size_dependence(errors, (-5.0, 5.0), numbers, np.arange(400))
    with_value = np.isfinite(errors)
    assert found.name == "census"
    assert found.trials == ((with_value & (kind == 0)).sum(), (with_value & (kind == 1)).sum())
    assert found.uncertainty[1] / found.uncertainty[0] == pytest.approx(3.0, rel=0.2)


def test_chance_is_no_dependence(rng):
    """Of 300 statements without a dependence on any of 20 numbers, one hundredth or fewer name one: 9 at 3 sigma."""
    named = [
        size_dependence(rng.standard_t(4, 100), (-3, 3), numbers_of(rng, 100), np.arange(100)) is not None
        for _ in range(300)
    ]
    assert sum(named) <= 9


def test_captures_of_one_day_count_once(rng):
    """Forty days of five captures are forty draws, too few for thirds."""
    numbers = [DrawnNumber("finish", "tail", "plate", np.repeat(rng.standard_normal(40), 5))]
    errors = np.exp(2 * numbers[0].values) * rng.standard_normal(200)
    assert size_dependence(errors, (-9, 9), numbers, np.repeat(np.arange(40), 5)) is None
    assert size_dependence(errors, (-9, 9), numbers, np.arange(200)) is not None


@pytest.mark.parametrize("errors", [np.full(200, np.nan), np.zeros(200), np.ones(10)])
def test_errors_without_a_size(rng, errors):
    assert size_dependence(errors, (-1, 1), numbers_of(rng, len(errors)), np.arange(len(errors))) is None
