"""One shot is finished while the next is taken: what the campaign may rely on."""

from __future__ import annotations

import threading
import time

import pytest

from mitsim.maps.campaign.acquire import one_ahead


def spared(name: str) -> set[threading.Thread]:
    """Threads of pools that still live, after those that are about to end have ended."""
    for _ in range(100):
        alive = {thread for thread in threading.enumerate() if thread.name.startswith(name)}
        if not alive:
            break
        time.sleep(0.02)
    return alive


def test_all_come_in_order_and_are_taken_in_the_thread_that_asks():
    places = {"take": set(), "finish": set()}

    def take(item):
        places["take"].add(threading.get_ident())
        return 10 * item

    def finish(taken, item):
        places["finish"].add(threading.get_ident())
        time.sleep(0.003 * (item % 3))
        return taken + item

    assert list(one_ahead(range(20), take, finish)) == [(item, 11 * item) for item in range(20)]
    assert places["take"] == {threading.get_ident()}
    assert threading.get_ident() not in places["finish"]
    assert not spared("ThreadPoolExecutor")


def test_one_is_finished_while_the_next_is_taken():
    taken = threading.Event()

    def take(item):
        if item == 1:
            taken.set()
        return item

    def finish(capture, item):
        assert item > 0 or taken.wait(10)  # the first cannot end before the second is taken
        return item

    assert [item for item, _ in one_ahead([0, 1, 2], take, finish)] == [0, 1, 2]


@pytest.mark.parametrize(("fault", "kept"), [(ValueError("no"), [0, 1]), (KeyboardInterrupt(), [0])])
def test_what_was_taken_before_a_fault_still_comes_and_nothing_is_begun_after_it(fault, kept):
    asked, found = [], []

    def take(item):
        asked.append(item)
        if item == 2:
            raise fault
        return item

    with pytest.raises(type(fault)):
        for item, _ in one_ahead(range(5), take, lambda capture, item: item):
            found.append(item)
    assert found == kept
    assert asked == [0, 1, 2]
    assert not spared("ThreadPoolExecutor")


def test_a_fault_in_finishing_is_told_in_its_place():
    def finish(capture, item):
        if item == 1:
            raise ValueError("bad")
        return item

    found = []
    with pytest.raises(ValueError, match="bad"):
        for item, _ in one_ahead(range(5), lambda item: item, finish):
            found.append(item)
    assert found == [0]
    assert not spared("ThreadPoolExecutor")


def test_a_caller_who_stops_asking_leaves_no_thread():
    for item, _ in one_ahead(range(1000), lambda item: item, lambda capture, item: item):
        if item == 3:
            break
    assert not spared("ThreadPoolExecutor")
