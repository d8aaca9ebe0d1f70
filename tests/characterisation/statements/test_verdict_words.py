"""The last line of a run, word by word."""

import math
from dataclasses import replace

from characterisation.statements.verdict_words import Judged, Reason, fits_all, in_words, result_reasons


def words_of(judged, kept=None):
    return in_words(result_reasons(judged), kept)


def test_what_fits_is_counted_and_the_worst_is_named_first():
    judged = [
        Judged("height", "mm", "fits", 0.01, 0.05),
        Judged("angle", "deg", "does not fit", 0.2, 0.1),
        Judged("seat_radius", "mm", "undecidable", 0.12, 0.03),
        Judged("width", "mm", "not decided", 0.02, 0.02),
        Judged("note", "mm", "no tolerance", 0.02, math.nan),
    ]
    assert words_of(judged) == (
        "fits 1 of 4 tolerances, 1 open; seat_radius is undecidable: standard uncertainty 0.12 mm, 0.030 mm "
        "needed; angle does not fit: standard uncertainty 0.20 deg, 0.10 deg needed; width: not decided, more virtual "
        "measurements are needed"
    )
    assert not fits_all(judged) and fits_all([judged[0], judged[3], judged[4]])


def test_a_bias_that_is_all_and_values_that_are_missing_are_told():
    bias = Judged("a", "mm", "does not fit", 0.01, 0.05, fits_corrected=True)
    lost = Judged("b", "mm", "undecidable", math.nan, math.nan, without_value=1.0)
    seldom = Judged("c", "mm", "fits", 0.01, 0.05, without_value=0.13)
    words = words_of([bias, lost, seldom])
    assert "a does not fit unless its bias is subtracted" in words
    assert "b is undecidable: no virtual measurement gave a value" in words
    assert "c fits, but has no value in 13 % of the virtual measurements" in words


def test_a_bias_beyond_the_uncertainty_is_named():
    """A flatness of 0.2 mm whose noise alone reads 0.38 mm: the uncertainty is not what is missing."""
    flat = Judged("top", "mm", "undecidable", 0.028, 0.025, bias=0.378)
    assert words_of([flat]).endswith(
        "top is undecidable: bias 0.38 mm and standard uncertainty 0.028 mm, 0.025 mm needed without bias"
    )
    assert "bias" not in words_of([replace(flat, bias=0.05)])


def test_measurements_left_out_of_a_summary_are_counted_one_by_one():
    many = [Judged(name, "mm", "not decided", math.nan, math.nan, without_value=1.0) for name in "abcdefghijk"]
    judged = [Judged("top", "mm", "does not fit", 0.2, 0.1), *many]
    words = words_of(judged)
    assert words_of(judged, 1).endswith("0.10 mm needed; and 11 more, see the table")
    assert words_of(judged, 0) == "fits 0 of 12 tolerances, 11 open; see the table"
    assert words_of(judged, 2) == words
    assert "; a, b, c and 8 more: not decided, no value" in words


def test_measurements_without_a_value_are_one_reason():
    """A part that one view cannot show: eleven reasons of the same words fill the first screen."""
    lost = [Judged(name, "mm", "undecidable", math.nan, math.nan, without_value=1.0) for name in "abcdefghijk"]
    judged = [*lost, Judged("top", "mm", "does not fit", 0.2, 0.1)]
    assert words_of(judged) == (
        "fits 0 of 12 tolerances; a, b, c and 8 more are undecidable: no virtual measurement gave a value; top does "
        "not fit: standard uncertainty 0.20 mm, 0.10 mm needed"
    )
    assert words_of(judged, 0) == "fits 0 of 12 tolerances; see the table"
    four = words_of([replace(one, trials=0) for one in lost[:4]])
    assert four.endswith("; a, b, c, d are undecidable: by screening, no view can make them")


def test_a_single_value_is_not_told_as_none():
    single = Judged("b", "mm", "not decided", math.nan, math.nan, without_value=0.5, trials=2)
    assert words_of([single]) == ("1 of 1 tolerances open; b: not decided, a single virtual measurement gave a value")


def test_without_tolerances_the_losses_are_told():
    a, b = (Judged(name, "mm", "no tolerance", 0.1, math.nan, without_value=0.25) for name in "ab")
    none = "Uncertainty given for 1 measurement. The task has no tolerances: nothing to accept or reject"
    assert words_of([a]) == f"{none}. a has no value in 25 % of the virtual measurements"
    assert words_of([replace(a, without_value=0.0)]) == none
    assert words_of([a, b]).endswith("a and 1 other have no value in up to 25 % of the virtual measurements")
    few = replace(b, without_value=0.001)
    assert words_of([replace(a, without_value=0.0), few]).endswith(
        "b has no value in less than 1 % of the virtual measurements"
    )
    assert words_of([replace(a, without_value=0.997)]).endswith(
        "a has no value in more than 99 % of the virtual measurements"
    )


def test_words_within_a_name_or_a_reason_change_no_count_and_summaries_stay():
    """Counts came from the words: a comma or a semicolon in a name, or a number in a reason, made them wrong."""
    reasons = [
        Reason("sensor, new: fits 0 of 4 tolerances"),
        Reason(" are undecidable: no value; and 3 more", ("a, b", "c; d")),
        Reason(" does not fit: u 2 mm", ("e and 7 more",)),
        Reason(" has no value", ("a, b",)),
        Reason("the set of 2 views keeps 0 of 4 limits"),
    ]
    assert in_words(reasons, 1) == (
        "sensor, new: fits 0 of 4 tolerances; a, b, c; d are undecidable: no value; and 3 more; the set of 2 views "
        "keeps 0 of 4 limits; and 1 more, see the table"
    )
    assert in_words(reasons, 0).endswith("keeps 0 of 4 limits; see the table")
