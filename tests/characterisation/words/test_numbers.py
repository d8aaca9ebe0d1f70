"""Numbers for readers: decimal places of estimates, of intervals and of accepted readings."""

import math

import pytest

from characterisation.words.numbers import SPACE, accepted_text, beside, interval_text, percent


@pytest.mark.parametrize(
    ("value", "uncertainty", "written"),
    [(12.3412, 0.0101, "12.341"), (134.4, 122.0, "134"), (0.31, 0.0996, "0.31"), (0.3149, None, "0.31")],
)
def test_an_estimate_has_the_places_of_its_uncertainty(value, uncertainty, written):
    assert beside(value, uncertainty) == written


@pytest.mark.parametrize(
    ("low", "high", "written"),
    [
        (12.3204, 12.3607, "12.320 to 12.361"),
        (-0.81, 0.19, "−0.81 to 0.19"),
        (-114.3, 371.2, "−114 to 371"),
        (2, 2, "2.0 to 2.0"),
        (0, 0, "0.0 to 0.0"),
    ],
)
def test_an_interval_has_the_places_of_its_width(low, high, written):
    assert interval_text(low, high) == written


@pytest.mark.parametrize(
    ("low", "high", "tolerance", "written"),
    [
        (69.8214, 70.1786, 0.3, "69.822 to 70.178"),
        (19.82, 20.18, 0.4, "19.820 to 20.180"),
        (-math.inf, 0.1279, 0.2, "up to 0.127"),
        (4.99996, 5.00004, 0.2, "4.999960 to 5.000040"),
        (20, 20, 0.2, "20.000 to 20.000"),
    ],
)
def test_no_reading_beyond_the_accepted_ones_is_written(low, high, tolerance, written):
    assert accepted_text(low, high, tolerance) == written


@pytest.mark.parametrize(
    ("share", "written"), [(0.99, "99"), (0.995, "> 99"), (0.9999, "> 99"), (1, "100"), (0.0004, "< 0.1"), (0, "0")]
)
def test_all_of_it_alone_is_a_hundred_percent(share, written):
    assert percent(share) == f"{written} %".replace(" ", SPACE)
