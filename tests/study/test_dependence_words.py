"""Sentences on the drawn number that an error's size depends on."""

import pytest

from characterisation.statements.size_dependence import SizeDependence
from mitsim.study.dependence_words import dependences_in_words, remedies_in_words


def test_a_sentence_names_both_ends_and_what_to_do():
    one = SizeDependence("finish", "wide_angle", "plate", (2.41, 0.6), (0.88, 1.0), (60, 60))
    (sentence,) = dependences_in_words([("angle", "deg", one, 3.0), ("radius", "mm", None, 0.1)])
    assert sentence == (
        "angle: u is 2.4° with little light at wide angles of plate, 0.60° with much light at wide angles; "
        "88\N{NO-BREAK SPACE}% and 100\N{NO-BREAK SPACE}% of these errors are inside the interval"
    )
    assert remedies_in_words([one, None, one]) == "A capture of the part narrows the finish: mitsim fit finish."


def test_what_the_tolerance_needs_is_said_where_the_number_decides():
    one = SizeDependence("finish", "wide_angle", "", (2.41, 0.6), (0.88, 1.0), (60, 60))
    (sentence,) = dependences_in_words([("angle", "deg", one, 1.2)])
    assert "0.60° with much light at wide angles, and 1.2° is needed; 88" in sentence
    assert all("needed" not in dependences_in_words([("angle", "deg", one, u)])[0] for u in (0.5, 3.0, None))


@pytest.mark.parametrize("dependences", [[], [None]])
def test_no_dependence_needs_no_words(dependences):
    assert remedies_in_words(dependences) == ""
