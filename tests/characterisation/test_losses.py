"""Reasons of measurements without a value, counted by kind."""

from hypothesis import given
from hypothesis import strategies as st

from characterisation.statements.losses import Loss, common_losses, losses


def test_reasons_that_differ_in_numbers_are_one_kind_with_their_range():
    found = losses(
        [
            "pin: 12 points, at least 100 are required",
            "",
            "pin: only 3 % of 640 points lie near the nominal surface, at least 25 % are required",
            "pin: 3 points, at least 100 are required",
            "pin: 40 points, at least 100 are required",
        ]
    )
    assert found == (
        Loss("pin: 3 to 40 points, at least 100 are required", 3),
        Loss("pin: only 3 % of 640 points lie near the nominal surface, at least 25 % are required", 1),
    )


def test_numbers_in_names_of_features_are_no_measured_numbers():
    found = losses(["pillar1: 7 points", "pillar2: 9 points", "pillar2: 1.5e+2 points"])
    assert found == (Loss("pillar2: 9 to 1.5e+2 points", 2), Loss("pillar1: 7 points", 1))


@given(st.lists(st.text()))
def test_any_texts_are_counted_once_each(reasons):
    found = losses(reasons)
    assert sum(one.count for one in found) == sum(1 for reason in reasons if reason)
    assert [one.count for one in found] == sorted((one.count for one in found), reverse=True)


def test_measurements_that_are_lost_together_have_one_entry():
    pin, plane = Loss("pin: 3 points", 5), Loss("plane: 7 points", 5)
    found = common_losses([("radius", 20, [pin]), ("angle", 20, [pin, plane]), ("height", 30, [plane])])
    assert found == [
        (["radius", "angle"], 5, 20, "pin: 3 points"),
        (["angle"], 5, 20, "plane: 7 points"),
        (["height"], 5, 30, "plane: 7 points"),
    ]
