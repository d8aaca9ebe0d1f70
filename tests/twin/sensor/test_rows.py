"""Turns of a second camera from its row errors, with a prior."""

import numpy as np
import pytest

from mitsim.twin.sensor.rows import _line


def test_a_prior_decides_what_the_rows_do_not():
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.4, -0.25, 14)  # a specimen in one part of the field
    design = 0.59 * np.column_stack([np.ones(14), -x])
    held, spreads, free_off = [], [], []
    for _ in range(600):
        truth = rng.normal(0, 0.12, 2)
        values = design @ truth + rng.normal(0, 0.025, 14)
        found, covariance, _ = _line(design, values, np.array([0.12, 0.12]))
        held.append(np.abs(found - truth) < 1.96 * np.sqrt(np.diag(covariance)))
        spreads.append(np.sqrt(np.diag(covariance)))
        free_off.append(_line(design, values, np.array([1e3, 1e3]))[0] - truth)
    share = np.mean(held, axis=0)
    assert (share > 0.92).all() and (share < 0.98).all()
    # without one, row and roll of so small a part run apart
    assert np.std(free_off, axis=0)[1] > 2 * np.mean(spreads, axis=0)[1]


def test_a_wide_prior_is_least_squares_and_a_narrow_one_is_zero():
    rng = np.random.default_rng(1)
    design, values = rng.normal(size=(20, 2)), rng.normal(size=20)
    wide, _, rest = _line(design, values, np.array([1e6, 1e6]))
    assert wide == pytest.approx(np.linalg.lstsq(design, values, rcond=None)[0])
    assert rest == pytest.approx(values - design @ wide)
    assert _line(design, values, np.array([1e-6, 1e-6]))[0] == pytest.approx([0, 0], abs=1e-9)
