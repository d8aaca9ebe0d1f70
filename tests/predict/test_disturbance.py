"""What of a view's other light reaches the map's answers, with the parts put together by hand."""

import numpy as np
import pytest

from mitsim.predict.disturbance import Indirect, disturbed
from mitsim.predict.interreflection import LOST_OF_CODES, PULL_LEFT, PULL_OF_CODES, kept_share
from mitsim.predict.mirrored_code import FOUND, LEAST_SCATTERED, SCATTERED, Mirrored
from mitsim.predict.predictor import Ideal


def test_of_a_code_in_phase_the_stronger_light_says_where_a_point_lies():
    rho = np.array([0.0, 0.5, 8.0, np.nan])
    mirrored, pull, average = np.array([-20.0, -20, -20, np.nan]), np.array([0.0, 0.3, 0.4, 0.0]), np.full(4, 0.01)
    none = np.zeros((4, 3))
    ideal = Ideal(np.arange(4), none, none, np.full(4, 500.0), none, np.zeros(4, np.int16), np.zeros(4, np.uint8))
    indirect = Indirect(rho, np.zeros(4), None, Mirrored(mirrored, np.ones(4)), pull, np.array([0, 0.3, 0, 0.2]))
    found = disturbed(indirect, average, np.full(4, 0.9), None, ideal, (2, 2), 1e-3, 4)
    own = kept_share(rho, *LOST_OF_CODES)
    assert own[2] < 0.3 < own[1]
    assert found.kept == pytest.approx([1, own[1], 0, 1])
    assert found.blinded == pytest.approx([0, 0, FOUND * (1 - own[2]), 0])
    assert found.displaced == pytest.approx([0.01, 0.31, -19.99, 0.01])
    assert found.noisier == pytest.approx([1, np.sqrt(1.5), 3, 1])
    assert found.lasting == pytest.approx([0, 0.5 * PULL_OF_CODES, 7 * PULL_OF_CODES, 0])
    assert found.scattered == pytest.approx([0, 0.3, np.hypot(20 * SCATTERED, LEAST_SCATTERED), 0.2])
    # where the own code is read, half of its pull is not known
    assert found.uneven == pytest.approx([0, 0.3 * PULL_LEFT, 0, 0])
