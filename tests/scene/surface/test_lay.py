"""What maps leave out of the direction of machining marks."""

import pytest

from mitsim.scene.surface.lay import lay_left_out, lays_in_words
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.paint import matt_white


@pytest.mark.parametrize(
    ("process", "lay", "left_out"),
    [
        ("turned", None, "round"),
        ("milled", None, "round"),
        ("turned", "u", None),
        ("turned", "none", None),
        ("milled", "v", None),
        ("polished", None, None),
        ("grit_blasted", None, None),
    ],
)
def test_marks_are_left_out_only_where_their_direction_is_not_given(process, lay, left_out):
    assert lay_left_out(machined(MachinedFace("aluminium", process, 0.8, lay=lay), 850.0)) == left_out


def test_a_face_without_open_marks_leaves_nothing_out():
    assert lay_left_out(matt_white()) is None and lay_left_out(None) is None
    assert lay_left_out(machined(MachinedFace("aluminium", "ground", 0.8, alpha=0.1), 850.0)) is None


def test_lays_that_are_not_given_take_one_line():
    turned, marked = (machined(MachinedFace("brass", "turned", 0.8, lay=lay), 850.0) for lay in (None, "u"))
    scatters = {"top": turned, "rim": marked, "plate": matt_white()}
    (line,) = lays_in_words(scatters)
    assert line.startswith("top: no lay, the direction of") and "draw it" in line and "maps omit it" in line
    (line,) = lays_in_words(scatters | {f"bore{i}": turned for i in range(40)})
    assert line.startswith("top and 40 more: ") and len(line) < 120
    assert lays_in_words({"plate": matt_white()}) == []
