"""Every unknown has its line in the list of influences."""

from __future__ import annotations

import pytest
from pydantic import BaseModel, ValidationError

from mitsim.sensor.unknowns import UnknownsTable
from mitsim.study.virtual.influences import influences

#: they scale another unknown, whose line stands for both
SCALES = {"room_factor", "daylight", "filter_nm", "body_per_kelvin", "focal_per_kelvin"}


def numbers():
    """Group and key of every number."""
    for group, table in UnknownsTable():
        for key, value in table if isinstance(table, BaseModel) else ():
            if isinstance(value, int | float) and not isinstance(value, bool) and key not in SCALES:
                yield group, key


@pytest.mark.parametrize(("group", "key"), list(numbers()))
def test_a_number_alone_shows_in_the_list(group, key):
    """A new unknown whose line was forgotten passed all tests."""
    others = {other: 1.0 if other in ("room_factor", "scale") else 0.0 for name, other in numbers() if name == group}
    others |= {"room_factor": 1.0} if group == "light" else {}
    lists = set()
    for value in (0.0, 0.01, 1.0):
        try:
            table = UnknownsTable.model_validate({group: others | {key: value}})
        except ValidationError:
            continue
        for flight in (False, True):
            lists.add((flight, str(influences(table, "render", 2, sprayed=True, flight=flight))))
    assert len(lists) > 2
