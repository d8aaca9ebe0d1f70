"""Distribute work to the workers of a Dask cluster.

Each order is sent to a worker as plain values, and its result is returned; only this process writes to a folder.
Workers may join, leave and die during the work: the order of a dead worker goes to another, as often as the scheduler's
``distributed.scheduler.allowed-failures`` says. An order that raises an error is not repeated. All workers need this
build of mitsim (:mod:`mitsim.running.build`). It is compared before anything is sent, and again with every order, since
workers may join later. They must see the scenes at the same paths, and run one thread each (``dask worker ADDRESS
--nthreads 1``). The same kind of processor gives the same bytes as one machine.

Everyone with access to a Dask scheduler can run code as the user of every worker and client. ``tls://`` with Dask's own
configuration (``distributed.comm.tls`` in its YAML files or environment) restricts the access.
"""

from __future__ import annotations

import re
import time
import weakref
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

from characterisation.files.checked_files import is_file
from characterisation.files.errors import InputError, MissingEnvironmentError, in_one_line
from characterisation.words.progress import say
from mitsim.running.build import differences, own_build
from mitsim.running.executor import Item, Plain, Result, finished_orders
from mitsim.running.time_limit import stopped_by_user

#: orders that wait at each worker: enough to keep it busy, few enough to lose little at a stop
AHEAD = 3

#: time limit for the answer of the scheduler [s]
CONNECT_TIMEOUT_S = 10

#: time without any worker after which a campaign ends [s]; the queue of a cluster may take minutes to start one
NO_WORKER_S = 600

#: time between messages about missing workers [s]
REPORT_EVERY_S = 30

#: time between checks for workers while no order is finished [s]
_POLL_S = 1.0

_ADDRESS = re.compile(r"(?:(tcp|tls)://)?(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):([0-9]{1,5})")


class Cluster:
    """The workers of a Dask scheduler, as an :class:`mitsim.running.executor.Executor`.

    Raises InputError if the address is not valid. Raises MissingEnvironmentError if ``distributed`` is not installed,
    certificates are missing, or no scheduler answers.
    """

    on_this_machine = False

    def __init__(self, address: str) -> None:
        self.address, self.client = address, connected(address)
        self.given_up: Callable[[], bool] = stopped_by_user
        # an unclosed client looks for its scheduler forever, in its own thread
        weakref.finalize(self, self.client.close).atexit = False  # Dask closes it at the end of the process

    def distribute(
        self,
        items: Sequence[Item],
        order: Callable[[Item], Plain],
        work: Callable[[Plain], Result],
        prepared: Callable[[Item], tuple[Hashable, Hashable]] | None = None,
    ) -> Iterator[tuple[Item, Result]]:
        """Yield items with their results, as they are finished, until given up.

        Raises MissingEnvironmentError also if there are no workers for :data:`NO_WORKER_S`, a worker has another build
        of mitsim, or any other error occurs there.

        Parameters
        ----------
        items, order, work, prepared
            As of :meth:`~mitsim.running.executor.Executor.distribute`. The scheduler chooses the workers.
        """
        if not items:
            return
        build = own_build()
        _compare_builds(self.client, self.address, build)
        executor = self.client.get_executor(pure=False)
        try:
            running: dict[Any, Item] = {}
            yield from finished_orders(
                deque(items),
                running,
                lambda item: executor.submit(_of_same_build, self.address, build, work, order(item)),
                lambda: 0 if len(running) < AHEAD * max(sum(self.client.ncores().values()), 1) else None,
                self.given_up,
                _POLL_S,
                _Watch(self.client, self.address).check,
            )
        except (InputError, MissingEnvironmentError):
            raise
        except Exception as error:  # any error of a worker or the network
            raise MissingEnvironmentError(
                f"--scheduler {self.address}: a capture failed there ({_in_a_line(error)}); finished "
                "work is kept: repair the cluster, and run the same command again"
            ) from None


def connected(address: str) -> Any:
    """Return a client of the Dask scheduler at an address."""
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match[2]) < 65536:
        allowed = "tcp://HOST:PORT or tls://HOST:PORT, as dask scheduler prints"
        raise InputError("--scheduler", "", repr(address), allowed)
    try:
        import dask
        from distributed import Client
    except ImportError:
        missing = "--scheduler needs Dask, which is not installed: pip install 'mitsim[cluster]'"
        raise MissingEnvironmentError(missing) from None
    if match[1] == "tls":
        _check_certificates(address, dask.config.get("distributed.comm.tls", {}))
    try:
        return Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except Exception as error:  # Dask raises many types for networks and certificate files
        raise MissingEnvironmentError(
            f"--scheduler {address}: no scheduler answers there ({_in_a_line(error)}); start one with: dask scheduler"
        ) from None


def _check_certificates(address: str, named: dict[str, Any]) -> None:
    """Reject a configuration of Dask without the files that TLS needs."""
    client = named.get("client") or {}
    files = {"ca-file": named.get("ca-file"), "client.cert": client.get("cert"), "client.key": client.get("key")}
    absent = {key: value for key, value in files.items() if not value or not is_file(str(value))}
    if absent:
        missing = ", ".join(f"{key} ({value})" if value else key for key, value in absent.items())
        raise MissingEnvironmentError(
            f"--scheduler {address}: Dask has no certificates: its configuration distributed.comm.tls has no file as "
            f"{missing}"
        )


def _of_same_build(address: str, build: dict[str, str], work: Callable[[Plain], Result], order: Plain) -> Result:
    """Work on an order if this process has the build of the order; workers call this function."""
    from distributed import get_worker

    if differing := differences(build, own_build()):
        raise _other_build(address, str(get_worker().address), differing)
    return work(order)


def _compare_builds(client: Any, address: str, local: dict[str, str]) -> None:
    """Wait for a worker, and compare the builds of all workers."""
    watch = _Watch(client, address)
    while not client.ncores():
        watch.check()
        time.sleep(0.1)
    try:
        builds = client.run(own_build, on_error="return")
    except Exception as error:  # a worker without this function, or a network error
        raise MissingEnvironmentError(f"--scheduler {address}: {_in_a_line(error)}") from None
    for worker, build in builds.items():
        if isinstance(build, OSError):
            continue  # the worker died meanwhile
        differing = differences(local, build) if isinstance(build, dict) else f"no known build ({_in_a_line(build)})"
        if differing:
            raise _other_build(address, worker, differing)


def _other_build(address: str, worker: str, difference: str) -> MissingEnvironmentError:
    return MissingEnvironmentError(
        f"--scheduler {address}: the worker {worker} has {difference}: its captures would differ; install the same "
        "mitsim there, and run the same command again"
    )


class _Watch:
    """Watches for a time without workers: reports it from time to time, and finally raises an error."""

    def __init__(self, client: Any, address: str) -> None:
        self.client, self.address = client, address
        self.alone_since: float | None = None
        self.reported = -float(REPORT_EVERY_S)

    def check(self) -> None:
        if self.client.ncores():
            self.alone_since = None
            return
        now = time.monotonic()
        self.alone_since = now if self.alone_since is None else self.alone_since
        alone = now - self.alone_since
        if alone > NO_WORKER_S:
            raise MissingEnvironmentError(
                f"--scheduler {self.address}: no workers in {NO_WORKER_S:g} s; start some with: "
                f"dask worker {self.address} --nthreads 1; finished work is kept"
            )
        if now - self.reported >= REPORT_EVERY_S:
            self.reported = now
            say(f"{self.address}: no workers yet, waiting up to {NO_WORKER_S - alone:.0f} s")


def _in_a_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {in_one_line(error, 300)}"
