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


def test_an_influence_that_is_fixed_is_not_said_to_be_drawn():
    """With sizes of 0 the list said "no", and beside it "drawn anew in every trial" or "drawn within 0 %"."""
    none = UnknownsTable.model_validate(
        {group: {key: 0.0 for other, key in numbers() if other == group} | {"room_factor": 1} for group in ("light",)}
        | {
            group: {key: 0.0 for other, key in numbers() if other == group}
            for group in ("pose", "temperature", "finish")
        }
        | {"form": {"features": {"plane": 0.0}}}
    )
    for table, source in ((none, "render"), (none, "map"), (UnknownsTable(), "map"), (UnknownsTable(), "render")):
        for one in influences(table, source, 1):
            assert one.included or not one.how.startswith(("drawn", "rendered")), one


def test_a_matt_white_part_draws_its_reflectance_alone():
    """A sprayed part was declared with a lobe, its tail and a lay; the spray is a diffuse surface."""
    table = UnknownsTable()
    for names, drawn in (({"matt_white"}, "reflectance"), ({"matt_white", "aluminium"}, "width of the lobe")):
        own = table.model_copy(update={"finish": table.finish.of_finishes(names)})
        how = {one.name: one.how for one in influences(own, "render", 2)}["finish of the part"]
        assert how.startswith(f"drawn: {drawn}") and ("lobe" in how) == (len(names) > 1)


def test_only_a_sensor_with_dots_has_a_mask():
    for dots in (False, True):
        assert any("mask" in one.name + one.how for one in influences(UnknownsTable(), "render", 2, dots=dots)) == dots
