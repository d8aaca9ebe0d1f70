"""How the time of a run is shared out, in words."""

import re

import pytest

from mitsim.study.time_plan import TimePlan


@pytest.mark.parametrize(("minutes", "told"), [(1, "60 s"), (5, "5 min"), (9.9, "9.9 min"), (120, "120 min")])
def test_the_time_of_a_long_run_is_a_plain_number(minutes, told):
    words = TimePlan(0.1 * 60 * minutes, 0.3 * 60 * minutes, 0.5 * 60 * minutes, 0.1 * 60 * minutes).in_words()
    assert words.startswith(f"about {told}: ") and not re.search(r"\de", words)
