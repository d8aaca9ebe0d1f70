"""The result of a set of views in words: kept, missed, out of reach, not confirmed."""

import json

import pytest

from characterisation.statements.verdict_words import Reason
from mitsim.report.first_screen import of_run
from mitsim.report.set_words import set_result, with_sets
from mitsim.study.run_document import ConfirmedEntry, ViewSetEntry
from mitsim.study.run_folder import read_run
from tests.report.conftest import MEASUREMENTS, write_run

LIMITS = {"apart": 0.1, "radius": 0.2}


def entry(confirmed=None, feasible=None, views=(3, 8)) -> ViewSetEntry:
    """A set of views; ``confirmed`` has bias, standard uncertainty and share without value by measurement."""
    keys = ("bias", "standard_uncertainty", "without_value")
    found = {
        name: ConfirmedEntry(unit="mm", trials=40, **dict(zip(keys, values, strict=True)))
        for name, values in (confirmed or {}).items()
    }
    return ViewSetEntry(limits=LIMITS, views=list(views), feasible=feasible or {}, confirmed=found)


def test_a_set_that_keeps_its_limits_is_good():
    result = set_result(entry({"apart": (0.03, 0.04, 0.0), "radius": (0.0, 0.1, 0.0)}))
    assert result.good
    assert result.words == "the set of 2 views (3, 8), measured together, keeps 2 of 2 limits"


def test_a_bias_counts_and_a_missed_limit_is_named_with_its_error():
    result = set_result(entry({"apart": (0.08, 0.08, 0.0), "radius": (0.0, 0.1, 0.0)}))  # 0.113 together
    assert not result.good
    assert "keeps 1 of 2 limits; apart exceeds its limit: error 0.11 mm, 0.1 mm allowed" in result.words


def test_a_limit_out_of_reach_is_missed_though_its_error_is_small():
    result = set_result(entry({"apart": (0.0, 0.01, 0.0), "radius": (0.0, 0.1, 0.0)}, {"apart": False, "radius": True}))
    assert not result.good and "keeps 1 of 2 limits; apart is out of reach" in result.words


def test_a_measurement_without_value_is_missed_and_one_that_often_has_none_is_named():
    result = set_result(entry({"apart": (None, None, 1.0), "radius": (0.0, 0.1, 0.25)}))
    assert not result.good
    assert (
        "apart has no value" in result.words and "radius: no value in 25 % of the virtual measurements" in result.words
    )


def test_a_set_that_no_measurement_confirms_says_so():
    result = set_result(entry())
    assert result.good and "predicted to keep 2 of 2 limits, which no virtual measurement confirms" in result.words
    assert not set_result(entry(feasible={"apart": False})).good
    assert not set_result(entry(views=())).good


def test_the_result_of_a_run_is_good_only_if_its_sets_are():
    missed = entry({"apart": (0.0, 1.0, 0.0), "radius": (0.0, 0.1, 0.0)})
    assert not with_sets([Reason("fits 6 of 6 tolerances")], True, [missed]).good
    assert with_sets([Reason("fits 6 of 6 tolerances")], True, []).good
    assert not with_sets([Reason("fits 5 of 6 tolerances")], False, [entry()]).good
    assert with_sets([Reason("fits 6 of 6 tolerances")], True, [missed]).words.startswith(
        "fits 6 of 6 tolerances; the set of 2"
    )


@pytest.mark.parametrize("u", [0.01, 0.5])
def test_the_first_screen_of_a_run_says_what_its_set_misses(tmp_path, u):
    folder = write_run(tmp_path / "run")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    stated = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    known = stated["measurements"][MEASUREMENTS[0]] | {"without_value": 0.0}
    stated["measurements"] = dict.fromkeys(MEASUREMENTS, known)
    (folder / "statement.json").write_text(json.dumps(stated), encoding="utf-8")
    name, confirmed = MEASUREMENTS[1], {"unit": "mm", "trials": 9, "without_value": 0.0, "bias": 0.0}
    one = {"limits": {name: 0.05}, "views": [2, 7], "confirmed": {name: confirmed | {"standard_uncertainty": u}}}
    (folder / "run.json").write_text(json.dumps(about | {"view_sets": [one]}), encoding="utf-8")
    first = of_run(read_run(folder), None)
    assert f"keeps {int(u < 0.05)} of 1 limits" in first.words()
    assert first.tone == ("plain" if u < 0.05 else "bad")
