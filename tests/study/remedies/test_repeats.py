"""The mean of repeated captures of one part."""

import numpy as np
import pytest

from characterisation.features.form import NODE_SHARES
from characterisation.statements.one_sided import OneSidedErrors
from characterisation.tasks.deviations import form_basis, form_size
from mitsim.study.remedies.repeats import mean_errors


def test_the_mean_form_of_captures_has_less_noise_than_that_of_one():
    """A face of known form with noise twice as large: the mean of 100 captures shows it, one does not."""
    rng, days, captures = np.random.default_rng(4), 100, 100
    basis = form_basis("plane")
    modes = len(basis)

    form = np.tensordot(np.ones(modes), basis, axes=1)
    noise = 2 * np.tensordot(rng.standard_normal((captures, days, modes)), basis, axes=1)
    rows = form + noise
    rows[..., -1, 0] = np.sqrt((noise[..., :-1, 0] ** 2).mean(axis=(0, 1)) @ NODE_SHARES / NODE_SHARES.sum())
    rows[3, 5] = np.nan  # a capture without a value
    taken = [OneSidedErrors(one, np.zeros_like(one), form_size, None) for one in rows]
    assert np.mean(form_size(mean_errors(taken, True).vectors)) == pytest.approx(float(np.ptp(form[:-1])), rel=0.05)
