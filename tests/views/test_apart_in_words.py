"""Screening says whether one view can make all measurements."""

import numpy as np
import xarray as xr

from mitsim.views.no_view import apart_in_words


def _scores(possible):
    names = ["bore", "slot", "face"][: len(possible)]
    return xr.Dataset(
        {"uncertainty_possible": (("measurement", "view"), np.array(possible, bool))},
        {"measurement": names, "view": np.arange(7, 7 + len(possible[0]))},
    )


def test_a_part_whose_features_face_apart_has_no_single_view():
    assert apart_in_words(_scores([[1, 0, 1], [0, 1, 1], [0, 1, 0]])) == (
        "no single view can make all 3 measurements: view 8 can make the most, 2"
    )
    assert apart_in_words(_scores([[0, 1], [0, 0], [1, 1]])).endswith(
        "view 8 can make the most, 2; no view can make slot"
    )
    assert apart_in_words(_scores([[0, 0], [0, 0]])) == "no view can make any of the 2 measurements"


def test_nothing_is_said_where_one_view_makes_all():
    assert apart_in_words(_scores([[1, 0], [1, 1]])) == ""
    assert apart_in_words(_scores([[0, 0]])) == ""  # the result of a single measurement says so itself
