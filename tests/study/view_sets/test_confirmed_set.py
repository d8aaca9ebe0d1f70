"""Sets of views that are searched by a hopeful map, measured, and searched again: errors of known distributions."""

from types import SimpleNamespace

import numpy as np
import pytest

import mitsim.study.view_sets.confirmed_set as confirmed_set
from characterisation.scores.view_sets import ViewSet
from characterisation.statements.statement import statement
from mitsim.study import SetTable
from mitsim.study.view_sets.confirmed_set import MOST_SETS, TriedSet, stricter, tried_entries
from tests.two_balls import TASK

VIEWS = 12
LIMITS = {"apart": 0.1, "radius": 0.1}


@pytest.fixture
def search_and_measure(monkeypatch):
    """Views of noise 0.2 as the map has it and of 0.2 ``hope`` in truth, with a ``floor`` that no view averages."""

    def run(hope=(1.0, 1.0), floor=0.0, most=VIEWS, sets=MOST_SETS + 1):
        measured = []

        def search(limits):
            wanted = [int(np.ceil((0.2 / limit) ** 2)) for limit in limits.values()]
            able = np.array([count <= most for count in wanted])
            count = max([one for one, fine in zip(wanted, able, strict=True) if fine], default=0)
            return ViewSet(tuple(range(count)), np.full(2, 0.2 / np.sqrt(max(count, 1))), able, True)

        def state(session, chosen, over):
            measured.append(len(chosen.views))
            rng = np.random.default_rng(len(measured))
            spread = 0.2 * np.array(hope) / np.sqrt(len(chosen.views))
            return [
                statement(name, "mm", rng.normal(floor, sigma, 4000))
                for name, sigma in zip(LIMITS, spread, strict=True)
            ]

        monkeypatch.setattr(confirmed_set, "state_set", state)
        study = SimpleNamespace(file=SimpleNamespace(set=SetTable(limits=LIMITS)), task=TASK)
        session = SimpleNamespace(study=study)
        tried = confirmed_set.confirmed_set(session, search(LIMITS), search, lambda: len(measured) >= sets)
        assert measured[0] == 4 and len(measured) == len(tried) <= MOST_SETS
        return tried, measured

    return run


def test_a_set_that_keeps_its_limits_is_measured_once(search_and_measure):
    tried, measured = search_and_measure(hope=(0.9, 0.9))
    assert measured == [4] and tried[-1].excess(LIMITS) <= 1


def test_when_time_ends_no_further_set_is_measured(search_and_measure):
    whole, _ = search_and_measure(hope=(1.5, 0.5))
    tried, measured = search_and_measure(hope=(1.5, 0.5), sets=1)
    assert len(tried) == len(measured) == 1 < len(whole)


def test_a_map_that_is_too_hopeful_by_half_gets_a_set_of_more_than_twice_the_views(search_and_measure):
    tried, measured = search_and_measure(hope=(1.5, 0.5))
    assert measured[:2] == [4, 9] or measured[:2] == [4, 10]  # 2.25 times as many, and what chance adds
    assert tried[-1].excess(LIMITS) <= 1 < tried[0].excess(LIMITS)
    assert tried[-1].searched["radius"] == LIMITS["radius"]  # it was kept: it is not made stricter
    entries = tried_entries(tried, LIMITS)
    assert [len(entry["views"]) for entry in entries] == [len(one.chosen.views) for one in tried]


def test_an_error_that_no_view_averages_ends_the_search_with_the_best_set(search_and_measure):
    tried, _ = search_and_measure(floor=0.2)
    assert min(one.excess(LIMITS) for one in tried) == tried[-1].excess(LIMITS) > 2


def test_where_the_map_can_keep_no_stricter_limit_the_search_comes_back_to_those_that_it_can(
    search_and_measure, capsys
):
    tried, measured = search_and_measure(hope=(2.0, 2.0), most=8)
    assert measured[:2] == [4, 8] and tried[-1].excess(LIMITS) > 1  # sixteen would do; eight come nearest
    assert len(tried[-1].chosen.views) == 8 and tried[-1].searched["apart"] < 0.1
    told = capsys.readouterr().err
    assert "set 1, views 0, 1, 2, 3: apart missed, 2.0 times its limit; radius missed, 2.0 times its limit" in told
    assert "no further set is tried: by the map, no set of other views is more accurate" in told


def test_a_limit_out_of_reach_does_not_keep_the_search_from_another_that_is_missed(search_and_measure):
    tried, measured = search_and_measure(hope=(3.0, 1.0), most=5)
    assert measured[1] == 5 and tried[-1].searched["radius"] == LIMITS["radius"]


def test_a_search_ends_after_as_many_sets_as_it_may_measure(search_and_measure, capsys):
    _, measured = search_and_measure(floor=0.2, most=10**6)
    assert len(measured) == MOST_SETS == len(set(measured))
    assert f"{MOST_SETS} sets were measured, the most that a run measures" in capsys.readouterr().err


def test_only_missed_limits_become_stricter_by_what_was_missed():
    chosen = ViewSet((0,), np.array([0.08, 0.05]), np.array([True, True]), True)
    errors = np.array([-1.0, 1.0] * 50)
    errors *= np.sqrt(99 / 100)  # a standard deviation of 1 with n - 1
    stated = [statement("apart", "mm", 0.16 * errors), statement("radius", "mm", 0.09 * errors)]
    found = stricter(TriedSet(chosen, dict(LIMITS), tuple(stated)), LIMITS)
    assert found["apart"] == pytest.approx(0.05) and found["radius"] == 0.1
    nothing = [statement("apart", "mm", np.full(9, np.nan)), stated[1]]
    assert stricter(TriedSet(chosen, dict(LIMITS), tuple(nothing)), LIMITS)["apart"] < 0.1
