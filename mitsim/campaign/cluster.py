"""Work handed out to the workers of a Dask cluster.

Each order is sent to a worker as plain values, and its result comes back; only this process writes to a folder. Workers
may join, leave and die while it runs: an order whose worker died goes to another. All workers must have this build of
mitsim (:mod:`mitsim.campaign.build`), which is compared before anything is sent and again with every order, for workers
may join later. They see the scenes at the same paths, and run one thread each (``dask worker ADDRESS --nthreads 1``).
The same bytes as on one machine need the same kind of processor.

Whoever reaches a Dask scheduler can run code as the user of every worker and client. ``tls://`` with Dask's own
configuration (``distributed.comm.tls`` in its YAML files or environment) keeps others out.
"""

from __future__ import annotations

import re
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from characterisation.checked_files import is_file
from mitsim.campaign.build import differences, own_build
from mitsim.errors import InputError, MissingEnvironmentError
from mitsim.progress import say

Item = TypeVar("Item")
Plain = TypeVar("Plain")
Result = TypeVar("Result")

#: orders that wait at each worker, so that none is idle and few are lost at a stop
AHEAD = 3

#: workers that may die over one order before it is given up
DEATHS = 5

#: seconds in which the scheduler must answer
PATIENCE_S = 10

#: seconds without any worker, after which a campaign ends: a queue of a cluster may take minutes to start one
LONELY_S = 600

#: seconds between lines that say that there is no worker
TOLD_EVERY_S = 30

#: seconds between looks for finished orders
_LOOK_S = 0.02

_ADDRESS = re.compile(r"(?:(tcp|tls)://)?(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):([0-9]{1,5})")


class Cluster:
    """The workers of a Dask scheduler, as an :class:`mitsim.campaign.executor.Executor`.

    Raises
    ------
    InputError
        If that can be no address.
    MissingEnvironmentError
        If ``distributed`` is not installed, certificates are missing, or nobody answers there.
    """

    def __init__(self, address: str) -> None:
        self.address, self.client = address, connected(address)
        # a client that nobody closes asks for its scheduler forever, in a thread of its own
        weakref.finalize(self, self.client.close).atexit = False  # at the end of the process Dask closes it

    def spread(
        self, items: Sequence[Item], order: Callable[[Item], Plain], work: Callable[[Plain], Result]
    ) -> Iterator[tuple[Item, Result]]:
        """Items with what workers made of their orders, as they are finished; an order and its result are plain values.

        Raises
        ------
        InputError
            If that is what a worker says.
        MissingEnvironmentError
            If there are no workers for :data:`LONELY_S`, one of them runs another build of mitsim, and for whatever
            else goes wrong there.
        """
        from distributed import as_completed

        if not items:
            return
        mine = own_build()
        _compare_builds(self.client, self.address, mine)
        waiting = list(reversed(items))
        running = as_completed(loop=self.client.loop)
        of: dict[object, Item] = {}
        watch = _Watch(self.client, self.address)

        def send() -> None:
            room = AHEAD * max(sum(self.client.ncores().values()), 1)
            while waiting and len(of) < room:
                item = waiting.pop()
                future = self.client.submit(_of_same_build, mine, work, order(item), pure=False, retries=DEATHS)
                of[future.key] = item
                running.add(future)

        try:
            send()
            while of:
                finished = running.next_batch(block=False)
                if not finished:
                    watch.look()
                    time.sleep(_LOOK_S)
                for future in finished:
                    yield of.pop(future.key), _result(future, self.address)
                    send()
        finally:
            self.client.cancel(list(running.futures))


def connected(address: str) -> Any:
    """A client of the Dask scheduler at an address.

    Raises
    ------
    InputError
        If that can be no address.
    MissingEnvironmentError
        If ``distributed`` is not installed, certificates are missing, or nobody answers there.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match[2]) < 65536:
        raise InputError("--scheduler", "", repr(address), "tcp://HOST:PORT or tls://HOST:PORT, as dask scheduler says")
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise MissingEnvironmentError(
            "--scheduler needs Dask, which is not installed: pip install 'mitsim[cluster]'"
        ) from None
    if match[1] == "tls":
        _check_certificates(address, dask.config.get("distributed.comm.tls", {}))
    try:
        return Client(address, timeout=PATIENCE_S, set_as_default=False)
    except Exception as error:  # whatever Dask makes of a network, or of files of certificates
        raise MissingEnvironmentError(
            f"--scheduler {address}: nobody answers there ({_in_a_line(error)}); start one with: dask scheduler"
        ) from None


def _check_certificates(address: str, named: dict[str, Any]) -> None:
    """Refuse a configuration of Dask without the files that TLS needs."""
    client = named.get("client") or {}
    files = {"ca-file": named.get("ca-file"), "client.cert": client.get("cert"), "client.key": client.get("key")}
    missing = [
        f"{key} ({value})" if value else key for key, value in files.items() if not value or not is_file(str(value))
    ]
    if missing:
        raise MissingEnvironmentError(
            f"--scheduler {address}: Dask has no certificates: its configuration distributed.comm.tls names no file as "
            + ", ".join(missing)
        )


def _result(future: Any, address: str) -> Any:
    try:
        done = future.result()
    except InputError:
        raise
    except Exception as error:  # whatever a worker or the network may do
        raise MissingEnvironmentError(
            f"--scheduler {address}: a capture failed there ({_in_a_line(error)}); what was "
            "finished is kept: mend the cluster, and run the same command again"
        ) from None
    if isinstance(done, OtherBuild):
        raise _other_build(address, done.worker, done.differences)
    return done


@dataclass(frozen=True)
class OtherBuild:
    """What a worker answers in place of a result where its build differs from that of the order."""

    worker: str
    differences: str


def _of_same_build(build: dict[str, str], work: Callable[[Plain], Result], order: Plain) -> Result | OtherBuild:
    """Work on an order, if this process runs the build that the order is from: what a worker does."""
    from distributed import get_worker

    if found := differences(build, own_build()):
        return OtherBuild(str(get_worker().address), found)
    return work(order)


def _compare_builds(client: Any, address: str, mine: dict[str, str]) -> None:
    """Wait for a worker, and compare the builds of all that are there."""
    watch = _Watch(client, address)
    while not client.ncores():
        watch.look()
        time.sleep(_LOOK_S)
    try:
        builds = client.run(own_build, on_error="return")
    except Exception as error:  # a worker without this function, or the network
        raise MissingEnvironmentError(f"--scheduler {address}: {_in_a_line(error)}") from None
    for worker, build in builds.items():
        if isinstance(build, OSError):
            continue  # it died meanwhile
        told = differences(mine, build) if isinstance(build, dict) else f"no build of its own ({_in_a_line(build)})"
        if told:
            raise _other_build(address, worker, told)


def _other_build(address: str, worker: str, told: str) -> MissingEnvironmentError:
    return MissingEnvironmentError(
        f"--scheduler {address}: the worker {worker} has {told}: its captures would be others; install the same mitsim "
        "there, and run the same command again"
    )


class _Watch:
    """How long there has been no worker: told now and then, and at last given up."""

    def __init__(self, client: Any, address: str) -> None:
        self.client, self.address = client, address
        self.since = self.told = self.looked = time.monotonic()
        self.alone = False

    def look(self) -> None:
        now = time.monotonic()
        if now - self.looked < 1.0 and self.alone:
            return
        self.looked = now
        if self.client.ncores():
            self.alone = False
            return
        if not self.alone:
            self.alone, self.since, self.told = True, now, now - TOLD_EVERY_S
        if now - self.since > LONELY_S:
            raise MissingEnvironmentError(
                f"--scheduler {self.address}: no workers in {LONELY_S:g} s; start some with: "
                f"dask worker {self.address} --nthreads 1; what was finished is kept"
            )
        if now - self.told >= TOLD_EVERY_S:
            self.told = now
            say(f"{self.address}: no workers yet, waiting up to {LONELY_S - (now - self.since):.0f} s")


def _in_a_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
