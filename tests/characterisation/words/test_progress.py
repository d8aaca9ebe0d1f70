"""The time that is left, from the times when items were finished."""

import numpy as np
import pytest

from characterisation.words.progress import time_left


def test_what_is_prepared_before_the_first_item_is_no_part_of_the_rest():
    """Ten seconds of preparation, then one item a second."""
    finished = 10.0 + np.arange(1, 6)
    assert time_left(finished, 40) == "35 s left"


def test_the_first_item_bounds_the_time():
    assert time_left([12.0], 40) == "at most 468 s left"


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_return_eight_items_at_once(workers):
    """Each worker takes eight seconds for eight items, after five seconds of preparation."""
    finished = [5.0 + 8 * (1 + k // (8 * workers)) for k in range(48)]
    seconds = float(time_left(finished, 88).split()[0])
    assert seconds == pytest.approx(40 / workers, abs=8)  # within the eight seconds of what is in work


def test_the_first_items_of_workers_bound_the_time():
    assert time_left([20.0] * 8, 40) == "at most 80 s left"
