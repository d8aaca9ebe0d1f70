"""Distribute independent orders to processes on this machine or to the workers of a Dask scheduler.

Signal chain: items -> orders, which are plain values -> each is worked on separately, anywhere and in any sequence ->
items with results, as they are finished.

A result depends on its order alone, so the whole is the same for any number of workers. The caller keeps each result
before it asks for the next, so a stop loses only the orders in work. A dead worker is replaced and its orders are
repeated, at most :data:`DEATHS` times in a row. Orders may name what a worker prepares for them: they go to a worker
that has prepared it, unless another would be idle.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Protocol, TypeVar

from characterisation.files.errors import InputError, MissingEnvironmentError
from characterisation.files.threads import keep_blas_to_one_thread, usable_cores
from characterisation.words.progress import say, track
from mitsim.running.time_limit import stopped_by_user

Item = TypeVar("Item")
Plain = TypeVar("Plain")
Result = TypeVar("Result")

#: memory of a worker [bytes]: the largest value in docs/explanation/scale.md
MEMORY = 7 << 29

#: orders that wait for each process, so that none is idle
AHEAD = 2

#: number of processes that may die in a row without any finished order
DEATHS = 5

#: time between questions whether to give up the orders in work [s]; chosen
_POLL_S = 0.2

#: where Linux tells the memory of a container: limit, use and its parts, and the name of cached files, of versions 2, 1
_GROUP = Path("/sys/fs/cgroup")
_GROUP_FILES = (
    (("memory.max", "memory.current", "memory.stat"), "inactive_file"),
    (("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"), "total_inactive_file"),
)


class Executor(Protocol):
    """Distributes work: :class:`Pool`, or :class:`mitsim.running.cluster.Cluster`.

    ``on_this_machine``: whether all workers read the files of this machine. ``given_up`` says whether to give up the
    orders in work, whose results are then lost: by default after the first Ctrl-C of a command that ends in order; see
    :func:`giving_up`.
    """

    on_this_machine: bool
    given_up: Callable[[], bool]

    def distribute(
        self,
        items: Sequence[Item],
        order: Callable[[Item], Plain],
        work: Callable[[Plain], Result],
        prepared: Callable[[Item], tuple[Hashable, Hashable]] | None = None,
    ) -> Iterator[tuple[Item, Result]]:
        """Yield items with the results of ``work``, a module-level function, on their orders, as they are finished.

        Raises InputError if a worker raises it. Raises MissingEnvironmentError if no worker is left.

        Parameters
        ----------
        items, order, work
            What there is to do; plain value of an item, and the function of it.
        prepared
            Names of what a worker prepares for an item: a whole, of which it keeps the last, and a part of it; by
            default nothing.
        """


@contextlib.contextmanager
def giving_up(workers: Executor | None, over: Callable[[], bool]) -> Iterator[None]:
    """Let workers give up orders in work as soon as ``over``; this process finishes what it has begun."""
    if workers is None:
        yield
        return
    workers.given_up = over
    try:
        yield
    finally:
        workers.given_up = stopped_by_user


def fitting_processes() -> int:
    """Return the number of workers for this machine: one per core and per :data:`MEMORY`."""
    return max(1, min(usable_cores(), available_memory() // MEMORY))


def available_memory() -> int:
    """Return the available memory [bytes] of the machine, or of the container of this process."""
    available = [8 << 30]
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        available = [1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))]
    for names, cached in _GROUP_FILES:
        with contextlib.suppress(OSError, ValueError, StopIteration):
            limit, used, numbers = ((_GROUP / name).read_text(encoding="ascii") for name in names)
            # files in memory that nobody reads are dropped before the limit is exceeded
            cache = next(int(line.split()[1]) for line in numbers.splitlines() if line.split()[0] == cached)
            available.append(max(int(limit) - max(int(used) - cache, 0), 0))
    return min(available)


def finished_orders(
    waiting: deque[Item],
    running: dict[Future[Result], Item],
    submit: Callable[[Item], Future[Result]],
    next_of: Callable[[], int | None],
    given_up: Callable[[], bool],
    idle_s: float,
    idle: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Item, Result]]:
    """Submit waiting items while there is room, and yield each with its result as it is finished.

    ``next_of`` returns the index of the next among those that wait, None without room. When no item was finished for
    ``idle_s`` [s], ends if given up, and else calls ``idle``. After that, or an error, the futures in ``running`` are
    cancelled, and it has the items without a result.
    """
    try:
        while waiting or running:
            while waiting and (index := next_of()) is not None:
                item = waiting[index]
                running[submit(item)] = item
                del waiting[index]
            done = wait(running, idle_s, FIRST_COMPLETED).done
            if not done:
                if given_up():
                    return
                idle()
            for future in sorted(done, key=lambda one: one.exception() is not None):  # an error loses no result
                result = future.result()
                yield running.pop(future), result
    finally:
        for future in running:
            future.cancel()


class Pool:
    """Processes on this machine, each with its share of the cores."""

    on_this_machine = True

    def __init__(self, processes: int) -> None:
        self.processes = processes
        self.given_up: Callable[[], bool] = stopped_by_user
        self._workers: dict[int, ProcessPoolExecutor] = {}
        self._prepared: dict[int, set[tuple[Hashable, Hashable]]] = {}

    def distribute(
        self,
        items: Sequence[Item],
        order: Callable[[Item], Plain],
        work: Callable[[Plain], Result],
        prepared: Callable[[Item], tuple[Hashable, Hashable]] | None = None,
    ) -> Iterator[tuple[Item, Result]]:
        """Yield items with their results, as they are finished, until given up; dead processes are replaced.

        An error of an order ends the others in work.

        Parameters
        ----------
        items, order, work, prepared
            As of :meth:`Executor.distribute`.
        """
        name_of, deaths, chosen = prepared or (lambda _: (None, None)), 0, 0
        waiting: deque[Item] = deque(items)
        running: dict[Future[Result], Item] = {}
        worker_of: dict[Future[Result], int] = {}

        def next_of() -> int | None:
            nonlocal chosen
            index, chosen = self._next(waiting, name_of, Counter(worker_of[future] for future in running))
            return index

        def submit(item: Item) -> Future[Result]:
            worker, value = self._ready(chosen), order(item)
            with _signals_held():
                future = worker.submit(work, value)
            name = name_of(item)
            self._prepared[chosen] = {entry for entry in self._prepared[chosen] if entry[0] == name[0]} | {name}
            worker_of[future] = chosen
            return future

        try:
            while (waiting or running) and not self.given_up():
                try:
                    for finished in finished_orders(waiting, running, submit, next_of, self.given_up, _POLL_S):
                        deaths = 0
                        yield finished
                except BrokenProcessPool:
                    self.close(wait=False)
                    waiting.extendleft(reversed(running.values()))
                    running.clear()
                    deaths += 1
                    if deaths > DEATHS:
                        found = f"{deaths} of them died in a row, maybe for lack of memory"
                        hint = "finished work is kept: use fewer, and run the same command again"
                        raise MissingEnvironmentError(f"--processes {self.processes}: {found}; {hint}") from None
                    say("a worker process died; its work is repeated")
        except (KeyboardInterrupt, Exception):
            self._end()
            raise
        finally:
            if self.given_up() and any(not future.done() for future in running):
                self._end()

    def _end(self) -> None:
        """End the processes at once, and lose the results of their orders."""
        processes = [process for worker in self._workers.values() for process in worker._processes.values()]
        self.close(wait=False)
        for process in processes:
            process.kill()

    def close(self, wait: bool = True) -> None:
        """End the processes after their current orders; ``wait`` for these."""
        workers, self._workers, self._prepared = list(self._workers.values()), {}, {}
        if not wait:
            for worker in workers:
                worker.shutdown(wait=False, cancel_futures=True)
        elif workers:  # all at once; after a shutdown without waiting, another would not wait
            with ThreadPoolExecutor(len(workers)) as threads:
                list(threads.map(lambda worker: worker.shutdown(cancel_futures=True), workers))

    def _next(
        self, waiting: deque[Item], name_of: Callable[[Item], tuple[Hashable, Hashable]], orders: Counter[int]
    ) -> tuple[int | None, int]:
        """Return the index of the next of the waiting items, and its worker; None without room.

        ``orders`` are those in work at each worker. A worker takes what it has prepared, or nobody has; an idle one
        takes any.
        """
        anywhere = set().union(*self._prepared.values())
        free = [worker for worker in range(self.processes) if orders[worker] < AHEAD]
        for worker in sorted(free, key=lambda number: orders[number]):
            mine = self._prepared.get(worker, set())
            for index, name in enumerate(map(name_of, waiting)):
                if name in mine or name not in anywhere:
                    return index, worker
            if not orders[worker]:
                return 0, worker
        return None, 0

    def _ready(self, worker: int) -> ProcessPoolExecutor:
        if worker not in self._workers:
            threads = max(1, usable_cores() // self.processes)
            context = multiprocessing.get_context("spawn")  # a forked process with Dr.Jit's threads hangs
            self._workers[worker] = ProcessPoolExecutor(1, context, _start_worker, (threads, os.getpid()))
            self._prepared[worker] = set()
        return self._workers[worker]


@contextlib.contextmanager
def _signals_held() -> Iterator[None]:
    """Hold Ctrl-C back while a process starts, which then never gets one: its imports would end in a traceback."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(threads: int, parent: int) -> None:
    """Set up a worker process: limit its threads, end with its parent (Linux), and leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        raise SystemExit(0)
    os.environ["OMP_NUM_THREADS"] = str(threads)
    keep_blas_to_one_thread()


def check_same_file(path: str | Path, digest: str, ordered: str) -> None:
    """Check that a worker reads the file that the command did, by their digests.

    Raises InputError if the file is another one, or has changed since.
    """
    if digest != ordered:
        found, allowed = "another content than when the command read it", "the same file on every machine, unchanged"
        raise InputError(path, "", found, allowed)


def results_of(
    orders: Sequence[Plain], work: Callable[[Plain], Result], workers: Executor | None, label: str
) -> list[Result]:
    """Return the results of orders, in their sequence, from workers or this process.

    Parameters
    ----------
    orders, work, workers, label
        Plain values; a module-level function of one; None for this process; label of the progress on stderr.
    """
    if workers is None:
        return [work(order) for order in track(orders, label)]
    made = workers.distribute(range(len(orders)), orders.__getitem__, work)
    results = dict(track(made, label, len(orders)))
    return [results[number] for number in range(len(orders))]
