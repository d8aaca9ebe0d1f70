"""What a prediction leaves out of the direction of machining marks."""

import pytest

from mitsim.scene.surface.lay import lay_left_out, lays_in_words
from mitsim.scene.surface.machined import MachinedFace, machined
from mitsim.scene.surface.paint import matt_white


@pytest.mark.parametrize(
    ("process", "lay", "left_out"),
    [
        ("turned", None, "round"),
        ("milled", None, "round"),
        ("turned", "u", None),
        ("milled", "v", None),
        ("polished", None, None),
        ("grit_blasted", None, None),
    ],
)
def test_marks_are_left_out_only_where_their_direction_is_not_given(process, lay, left_out):
    assert (
        lay_left_out(f"aluminium/{process}", machined(MachinedFace("aluminium", process, 0.8, lay=lay), 850.0))
        == left_out
    )


def test_a_face_without_marks_leaves_nothing_out():
    assert lay_left_out("matt_white", matt_white()) is None
    assert lay_left_out("aluminium/turned", None) is None


def test_an_omission_is_one_sentence_that_names_its_faces():
    turned, marked = (machined(MachinedFace("brass", "turned", 0.8, lay=lay), 850.0) for lay in (None, "u"))
    finishes = {"top": ("brass/turned", turned), "bore": ("brass/turned", turned), "rim": ("brass/turned", marked)}
    (left_round,) = lays_in_words(finishes | {"plate": ("matt_white", matt_white())})
    assert left_round.startswith("top (brass/turned), bore (brass/turned): no direction of the marks is given")
    assert (
        "plate" not in left_round
        and "rim" not in left_round
        and lays_in_words({"plate": ("matt_white", matt_white())}) == []
    )
