"""Reasons of measurements without a value, counted by kind."""

from hypothesis import given
from hypothesis import strategies as st

from characterisation.statements.losses import Loss, LostFeature, losses, lost_features


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


def test_a_feature_has_one_entry_with_all_its_measurements_and_reasons():
    few, bent, plane = Loss("pin: 3 points", 5), Loss("pin: too far", 2), Loss("plane: 7 points", 4)
    found = lost_features(
        [
            ("radius", 20, [few, bent]),
            ("angle", 20, [few, plane]),
            ("height", 30, [plane, Loss("an axis lies in a plane", 1)]),
        ]
    )
    assert found == (
        LostFeature("pin", ("radius", "angle"), 7, 20, (Loss("3 points", 5), Loss("too far", 2))),
        LostFeature("plane", ("angle",), 4, 20, (Loss("7 points", 4),)),
        LostFeature("plane", ("height",), 4, 30, (Loss("7 points", 4),)),
        LostFeature("", ("height",), 1, 30, (Loss("an axis lies in a plane", 1),)),
    )
    assert [one.in_words() for one in found] == [
        "7 of 20: pin (radius, angle): 3 points (5 times; 1 other reason)",
        "4 of 20: plane (angle): 7 points",
        "4 of 30: plane (height): 7 points",
        "1 of 30 (height): an axis lies in a plane",
    ]
