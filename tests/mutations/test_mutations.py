"""Mutations of every class of input end in a message or are accepted: no traceback, no crash, no hang.

8 s of reading in CI; ``MITSIM_MUTATIONS=20000`` makes as many mutations. The seed follows the day, so that every
run tries others; ``python -m mutations.harness --only CLASS --seed N`` from ``tests`` gives them again.
"""

import datetime
import os

import pytest

from .harness import GOOD, run
from .readers import READERS

pytestmark = [pytest.mark.timeout(7200)]


def test_mutations_end_in_a_message_or_are_accepted():
    asked = int(os.environ.get("MITSIM_MUTATIONS", "0"))
    seed = int(os.environ.get("MITSIM_MUTATION_SEED", datetime.date.today().toordinal()))
    slow = ("mitsim ", "scene.xml", "coupon.xml", "part.")  # a child of these takes seconds to begin
    quick = [name for name in READERS if not name.startswith(slow)]
    found = run(asked or 1000, seed, list(READERS) if asked else quick, float("inf") if asked else 8.0)
    wrong = {name: {key: n for key, n in one.items() if key not in GOOD} for name, one in found.items()}
    assert not any(wrong.values()), {name: one for name, one in wrong.items() if one}
    assert sum(sum(one.values()) for one in found.values()) > 20  # a slow machine tries fewer in its time
