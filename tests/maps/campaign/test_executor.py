"""Work handed out to processes: the same results in any number of them, also where one dies or says no."""

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections import deque
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.files.errors import InputError, MissingEnvironmentError
from mitsim.capture.devices.device_error import DeviceError
from mitsim.cli.options import requested_workers
from mitsim.cli.program import app
from mitsim.running import executor
from mitsim.running.executor import Pool, fitting_processes, giving_up, results_of
from tests.smaller_sensors import coarse_sensor

pytestmark = pytest.mark.timeout(300)

ROOT = Path(__file__).parents[3]


def squared(value):
    return value**2


def threads_of_renderer(_):
    from mitsim.scene.backend import dr

    return dr.thread_count()


def refuse(value):
    raise InputError("a.toml", "key", value, "another", "write one")


def die_once(order):
    number, mark = order
    if number == 3 and not Path(mark).exists():
        Path(mark).write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(order):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def pool():
    """Two processes as the program starts them: new interpreters."""
    made = Pool(2)
    yield made
    made.close()


def test_every_item_comes_once_with_its_result(pool):
    found = dict(pool.distribute(range(20), lambda n: n + 1, squared))
    assert found == {n: (n + 1) ** 2 for n in range(20)}
    assert results_of([3, 1, 2], squared, pool, "squares") == [9, 1, 4] == results_of([3, 1, 2], squared, None, "")
    assert list(pool.distribute([], squared, squared)) == []


def test_each_process_renders_with_its_share_of_the_cores(pool):
    assert results_of([0], threads_of_renderer, pool, "") == [max(1, executor.usable_cores() // 2)]


def test_who_stops_asking_leaves_nothing_in_work(pool):
    asked = pool.distribute(range(100), lambda n: n, squared)
    next(asked)
    asked.close()
    assert dict(pool.distribute([5], lambda n: n, squared)) == {5: 25}


def test_closing_waits_until_the_processes_have_ended():
    pool = Pool(2)
    before = threading.active_count()
    results_of([1, 2, 3, 4], squared, pool, "")
    processes = [process for worker in pool._workers.values() for process in worker._processes.values()]
    assert processes and all(process.is_alive() for process in processes)
    assert threading.active_count() > before
    pool.close()
    assert not any(process.is_alive() for process in processes)
    assert threading.active_count() == before


class Here:
    """A worker that is this process: it notes its orders, and finishes the first when it is asked to."""

    def __init__(self):
        self.made, self.left = [], []

    def submit(self, work, value):
        self.made.append(value)
        self.left.append((Future(), work(value)))
        return self.left[-1][0]

    def finish(self):
        future, result = self.left.pop(0)
        future.set_result(result)


@pytest.fixture
def pool_of_two(monkeypatch):
    """Two workers in this process, the first of which finishes all that it has before the second finishes anything."""
    pool, workers = Pool(2), [Here(), Here()]

    def ready(number):
        pool._prepared.setdefault(number, set())
        return workers[number]

    def wait(running, *_):
        next(one for one in workers if one.left and one.left[0][0] in running).finish()
        return SimpleNamespace(done=[one for one in running if one.done()])

    monkeypatch.setattr(pool, "_ready", ready)
    monkeypatch.setattr(executor, "wait", wait)
    return pool, workers


def in_upper_case(pool, whole, orders):
    return dict(pool.distribute(orders, lambda one: one, str.upper, lambda one: (whole, one[0])))


def test_orders_go_to_the_worker_that_prepared_for_them_unless_one_is_idle(pool_of_two):
    """Two views of a race: each is prepared by one worker, until a worker has nothing of its own left."""
    pool, workers = pool_of_two
    orders = ["a1", "a2", "a3", "b1", "b2", "b3", "b4", "b5", "b6", "b7", "b8"]
    assert in_upper_case(pool, "study", orders) == {one: one.upper() for one in orders}
    first, second = (one.made for one in workers)
    assert first[:3] == ["a1", "a2", "a3"] and second[:2] == ["b1", "b2"]  # the first finishes all that it has
    assert set(first[3:]) | set(second) == {one for one in orders if one[0] == "b"} and first[3:]


def test_no_order_waits_for_a_worker_that_has_gone_to_another_study(pool_of_two):
    pool, workers = pool_of_two
    for whole in ("study", "changed study"):
        in_upper_case(pool, whole, ["a1"])
    in_upper_case(pool, "study", ["b1", "c1", "b2", "a2", "d1"])
    assert workers[1].made[:2] == ["c1", "a2"]  # nobody has a any more, so the sequence is kept


def test_a_process_that_dies_loses_no_work(pool, tmp_path, capsys):
    found = [item for item, _ in pool.distribute(range(8), lambda n: (n, str(tmp_path / "died")), die_once)]
    assert sorted(found) == list(range(8)) and (tmp_path / "died").exists()
    assert "a worker process died" in capsys.readouterr().err


def last_a_minute(mark):
    Path(mark).write_text("")
    time.sleep(60)
    return mark


def test_orders_in_work_are_given_up_when_time_is_over(pool, tmp_path):
    """The results of two orders of a minute are not waited for, and what comes after finds free processes."""
    marks = [tmp_path / "first", tmp_path / "second"]
    with giving_up(pool, lambda: all(mark.exists() for mark in marks)):
        assert list(pool.distribute(map(str, marks), str, last_a_minute)) == []
    assert results_of([3], squared, pool, "") == [9]


def test_who_stops_asking_after_the_end_leaves_no_process_at_work(pool, tmp_path):
    mark, over = tmp_path / "other", []
    with giving_up(pool, lambda: bool(over)):
        asked = pool.distribute([str(mark), 3], lambda order: order, last_a_minute_or_square)
        assert next(asked) == (3, 9)
        while not mark.exists():
            time.sleep(0.05)
        working = {process.pid for process in multiprocessing.active_children()}
        over.append(True)
        asked.close()
    # not process.is_alive(): the pool waits for the same process in a thread, and one of two that wait learns its end
    until = time.monotonic() + 10
    while any(map(exists, working)) and time.monotonic() < until:
        time.sleep(0.05)
    assert working and not any(map(exists, working))


def exists(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def last_a_minute_or_square(order):
    return order**2 if isinstance(order, int) else last_a_minute(order)


def test_processes_that_always_die_are_given_up(monkeypatch):
    monkeypatch.setattr(executor, "DEATHS", 1)
    with pytest.raises(MissingEnvironmentError, match="died in a row"):
        list(Pool(2).distribute([1], lambda n: n, die))


def test_what_a_worker_refuses_is_told_as_it_said_it(pool):
    with pytest.raises(InputError, match=r"a\.toml: key: found 7; allowed: another\. write one") as caught:
        list(pool.distribute([7], lambda n: n, refuse))
    assert caught.value.field == "key"
    for error in (caught.value, DeviceError("stage", "move", "nothing", "an answer", "look")):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error) and str(again) == str(error)


def refuse_beside(order):
    number, mark = order
    if number:
        Path(mark).with_suffix(".half").write_text(str(os.getpid()))
        Path(mark).with_suffix(".half").replace(mark)
        time.sleep(60)
    while not Path(mark).exists():
        time.sleep(0.02)
    return refuse(number)


def test_an_error_of_an_order_ends_the_others_in_work(pool, tmp_path):
    """Before, the order of a minute went on to its end, and what came next waited for it."""
    mark = tmp_path / "process"
    with pytest.raises(InputError):
        list(pool.distribute([0, 1], lambda number: (number, str(mark)), refuse_beside))
    working, until = int(mark.read_text()), time.monotonic() + 20
    while exists(working) and time.monotonic() < until:
        time.sleep(0.05)
    assert not exists(working)


def test_an_error_loses_no_result_that_is_there(monkeypatch):
    """Of two orders that end together, the finished one comes first; before, it was lost after the error."""
    bad, good = Future(), Future()
    bad.set_exception(InputError("a.toml", "key", 1, "another"))
    good.set_result("done")
    monkeypatch.setattr(executor, "wait", lambda *_: SimpleNamespace(done=[bad, good]))
    running = {bad: 0, good: 1}
    found = executor.finished_orders(deque(), running, Future, lambda: None, lambda: False, 1)
    assert next(found) == (1, "done")
    with pytest.raises(InputError):
        next(found)


def test_processes_follow_cores_and_memory(monkeypatch):
    monkeypatch.setattr(executor, "usable_cores", lambda: 16)
    monkeypatch.setattr(executor, "available_memory", lambda: 15 << 30)
    assert fitting_processes() == 4
    monkeypatch.setattr(executor, "available_memory", lambda: 1 << 20)
    assert fitting_processes() == 1
    monkeypatch.setattr(executor, "available_memory", lambda: 1 << 50)
    assert fitting_processes() == 16
    monkeypatch.setattr(executor, "fitting_processes", fitting_processes)
    for devices, expected in ((1, type(None)), (0, Pool)):  # one process uses a whole CUDA device
        monkeypatch.setattr("mitsim.scene.backend.cuda_devices", lambda devices=devices: devices)
        assert type(requested_workers(None, 0)) is expected
    assert requested_workers(None, 1) is None and isinstance(requested_workers(None, 3), Pool)
    with pytest.raises(InputError, match="--processes"):
        requested_workers("tcp://a:1", 2)


PLAN = "captures = 2\n[views]\nsubdivisions = 0\nstandoff_mm = 500\n"


def test_commands_give_the_same_bytes_in_two_processes(tmp_path, pool, monkeypatch):
    monkeypatch.setattr(executor, "Pool", {2: pool}.__getitem__)  # what --processes 2 starts, started once for all
    (tmp_path / "plan.toml").write_text(PLAN)
    sensor = coarse_sensor("ensenso-n10", 2, tmp_path)
    white = (ROOT / "scenes/coupon/matt_white.xml").as_posix()
    (tmp_path / "campaign.toml").write_text(
        "distances_mm = [500]\nsamples_per_pixel = 1\norientations = [{ up_to_deg = 20, subdivisions = 0 }]\n"
        f'samples = [{{ scene = "{white}" }}]\n'
    )
    many = [
        "render",
        f"{ROOT}/scenes/two_pillars/two_pillars.xml",
        "--many",
        tmp_path / "plan.toml",
        "--samples",
        1,
        "--depth",
        1,
    ]
    for command, call in (("many", many), ("map", ["map", "make", tmp_path / "campaign.toml"])):
        for processes in (1, 2):
            place = tmp_path / f"{command}_{processes}"
            asked = [*map(str, [*call, "--sensor", sensor, "-o", place, "--processes", processes])]
            done = CliRunner().invoke(app, asked)
            assert done.exit_code == 0, (done.exception, done.stderr)
        one, two = (
            {str(p.relative_to(place)): p.read_bytes() for p in place.rglob("*") if p.is_file()}
            for place in (tmp_path / f"{command}_1", tmp_path / f"{command}_2")
        )
        assert one.keys() == two.keys() and len(one) > 5
        assert [name for name in one if one[name] != two[name]] == []


def test_a_data_sheet_is_the_same_in_two_processes(pool, half_n10, monkeypatch):
    from mitsim.maps import data_sheet

    monkeypatch.setattr(data_sheet, "DISTANCES", 2)
    monkeypatch.setattr(data_sheet, "METALS", [])
    one, two = (data_sheet.measure_sensor(half_n10, 3, workers) for workers in (None, pool))
    assert len(one.residuals.values) > 1000
    np.testing.assert_equal(one.numbers(), two.numbers())
    np.testing.assert_array_equal(one.residuals.values, two.residuals.values)
