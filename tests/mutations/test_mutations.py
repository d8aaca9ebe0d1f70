"""Mutations of every class of input end in a message or are accepted: no traceback, no crash, no hang.

Each class that reads in milliseconds gets :data:`EACH` mutations. ``MITSIM_MUTATIONS=20000`` makes as many of all
classes, ``MITSIM_MUTATION_SEED`` others; ``python -m mutations.harness --only CLASS --seed N`` from ``tests`` gives one
again.
"""

import os

import pytest

from tests.mutations.harness import GOOD, run
from tests.mutations.readers import READERS

pytestmark = [pytest.mark.timeout(7200)]

#: mutations of each class without MITSIM_MUTATIONS
EACH = 6


def test_mutations_end_in_a_message_or_are_accepted():
    asked = int(os.environ.get("MITSIM_MUTATIONS", "0"))
    seed = int(os.environ.get("MITSIM_MUTATION_SEED", "20261127"))
    slow = ("mitsim ", "scene.xml", "coupon.xml", "part.")  # a child of these takes seconds to begin
    classes = list(READERS) if asked else [name for name in READERS if not name.startswith(slow)]
    found = run(asked or EACH * len(classes), seed, classes)
    wrong = {name: {key: n for key, n in one.items() if key not in GOOD} for name, one in found.items()}
    assert not any(wrong.values()), {name: one for name, one in wrong.items() if one}
    assert all(sum(one.values()) >= EACH for one in found.values())
