"""Limits of time, a first Ctrl-C, and the plan of a run; nothing waits."""

import os
import signal
import time
from dataclasses import replace

import pytest

from mitsim.running.time_limit import TimeLimit, ending_in_order, stopped_by_user
from mitsim.study.time_plan import time_plan


def test_a_part_of_the_time_that_is_left_ends_before_the_whole():
    whole = TimeLimit(100.0, time.monotonic() - 40.0)
    part = whole.part(0.5, reserve=20.0)
    assert whole.left == pytest.approx(60.0, abs=1.0) and part.left == pytest.approx(20.0, abs=1.0)
    assert not whole.over() and not part.over()
    late = TimeLimit(1.0, time.monotonic() - 2.0)
    assert late.over() and late.part(0.5, reserve=20.0).over()
    assert not TimeLimit().part(0.5).over() and TimeLimit().left == float("inf")


def test_the_first_ctrl_c_ends_every_limit_and_the_second_the_command():
    limit = TimeLimit()
    with ending_in_order():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        assert stopped_by_user() and limit.over() and limit.part().over()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
    assert not stopped_by_user() and not limit.over()


@pytest.mark.parametrize("seconds", [6.0, 30.0, 120.0, 600.0, 36000.0])
@pytest.mark.parametrize("views", [1, 102, 5000])
@pytest.mark.parametrize("remedies", [False, True])
@pytest.mark.parametrize("sets", [False, True])
def test_a_plan_shares_out_all_of_the_time(seconds, views, remedies, sets):
    plan = time_plan(seconds, views, remedies, sets)
    steps = (plan.screening, plan.race, plan.statement, plan.report)
    assert min(steps) > 0 and sum(steps) + plan.remedies + plan.sets == pytest.approx(seconds)
    words = plan.in_words()
    assert (plan.remedies > 0) == remedies == ("changes that would fit" in words)
    assert (plan.sets > 0) == sets == ("set of views" in words)
    assert words.startswith("about ") and all(
        name in words for name in ("screening", "comparing views", "statement", "report")
    )


def test_the_statement_gets_the_time_that_the_race_leaves():
    plan = time_plan(120.0, 102)
    limit = TimeLimit(120.0, time.monotonic() - 30.0)
    assert plan.race_limit(limit).left < plan.statement_limit(limit).left < limit.left


def test_the_remedies_get_what_the_statement_leaves_but_for_pictures_and_report():
    with_them, without = time_plan(600.0, 102, True), time_plan(600.0, 102)
    limit = TimeLimit(600.0, time.monotonic() - 300.0)
    assert with_them.statement_limit(limit).left < without.statement_limit(limit).left
    assert with_them.statement_limit(limit).left < with_them.rest_limit(limit).left < limit.left


@pytest.mark.parametrize("remedies", [False, True])
def test_a_set_of_views_gets_its_planned_share(remedies):
    """Before, changes left it 40 % of the time after the race, where the plan had 24 %."""
    plan, limit = time_plan(600.0, 102, remedies, sets=True), TimeLimit(600.0, time.monotonic() - 300.0)
    ratio = plan.rest_limit(limit).left / plan.statement_limit(limit).left
    assert ratio == pytest.approx((plan.statement + plan.remedies) / plan.statement, rel=1e-3)


def test_a_page_that_took_long_before_is_given_that_time_again():
    """Clouds and page of a part of 100 faces take many times those of a simple part."""
    plan, limit = time_plan(300.0, 102), TimeLimit(300.0, time.monotonic() - 100.0)
    slow = replace(plan, page_s=60.0)
    assert plan.last_limit(limit).left > 150
    assert slow.last_limit(limit).left == pytest.approx(140.0, abs=1.0)
    assert slow.statement_limit(limit).left <= 140.0
