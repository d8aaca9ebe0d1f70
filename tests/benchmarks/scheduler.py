"""Measure the load of many workers on Dask's scheduler and on the command that hands out work: captures that sleep.

    python tests/benchmarks/scheduler.py [--tasks N] [--workers N] [--threads N] [--seconds S] [--bytes N]

There are three processes: the scheduler, all workers in one event loop, and this one as the command. With
``--threads``, fewer workers sleep in several threads each, which costs less on two cores. The command hands out orders
as campaigns do (:class:`mitsim.running.cluster.Cluster`), and gets back the bytes that a campaign keeps of a capture.

Printed are captures per second, the share of the workers' time that was slept, and the processor time of scheduler and
command for each capture. The inverse of a processor time is what that process can do on a core of its own. Memory is
that at the end.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from mitsim.running.cluster import Cluster

SCHEDULER = """
import asyncio, sys
from distributed import Scheduler
async def main():
    async with Scheduler(port=0, dashboard=False, dashboard_address=":0", protocol="tcp", host="127.0.0.1") as one:
        print(one.address, flush=True)
        await one.finished()
asyncio.run(main())
"""

WORKERS = """
import asyncio, sys
import dask
from distributed import Worker
dask.config.set({"distributed.admin.system-monitor.interval": "60s", "distributed.worker.memory.target": False})
async def main():
    address, count, threads = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    made = [Worker(address, nthreads=threads, dashboard=False, memory_limit=0) for _ in range(count)]
    for one in made:
        await one
    print("there", flush=True)
    await asyncio.gather(*(one.finished() for one in made))
asyncio.run(main())
"""


@dataclass(frozen=True)
class Sleep:
    """An order as large as one of a campaign: a sensor of some 8 kB."""

    number: int
    seconds: float
    bytes: int
    sensor: bytes = bytes(range(256)) * 32


def sleep(order: Sleep) -> bytes:
    """Sleep, and answer as many bytes as patches have."""
    time.sleep(order.seconds)
    return bytes(order.bytes)


def used(pid: int) -> tuple[float, float]:
    """Processor time [s] and resident memory [GiB] of a process (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return seconds, int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 2**30


def main() -> None:
    """Start all, hand out, and tell."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--tasks", type=int, default=100_000)
    asked.add_argument("--workers", type=int, default=200)
    asked.add_argument("--threads", type=int, default=1, help="of each worker")
    asked.add_argument("--seconds", type=float, default=1.0, help="that a capture sleeps")
    asked.add_argument("--bytes", type=int, default=40_000, help="of its patches")
    given = asked.parse_args()
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([sys.executable, "-c", SCHEDULER], **quiet) as scheduler:
        assert scheduler.stdout is not None
        address = scheduler.stdout.readline().strip()
        call = [sys.executable, "-c", WORKERS, address, str(given.workers), str(given.threads)]
        with subprocess.Popen(call, **quiet) as workers:
            assert workers.stdout is not None
            workers.stdout.readline()
            try:
                hand_out(given, Cluster(address), scheduler.pid)
            finally:
                workers.kill()
                scheduler.kill()


def hand_out(given: argparse.Namespace, cluster: Cluster, pid: int) -> None:
    """Hand out all captures, and tell now and then."""
    processes = {"scheduler": pid, "command": os.getpid()}
    list(cluster.distribute(range(given.workers), lambda n: Sleep(n, 0.0, given.bytes), sleep))  # builds are compared
    before = {name: used(one)[0] for name, one in processes.items()}
    began = told = time.perf_counter()
    done = 0
    size = f"{given.workers} workers of {given.threads} threads, captures of {given.seconds:g} s"
    print(f"{size}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", flush=True)
    made = cluster.distribute(range(given.tasks), lambda n: Sleep(n, given.seconds, given.bytes), sleep)
    for done, _ in enumerate(made, 1):
        if time.perf_counter() - told > 30 or done == given.tasks:
            told = time.perf_counter()
            rate = done / (told - began)
            busy = rate * given.seconds / (given.workers * given.threads)
            row = f"{done:7} captures, {rate:6.1f} a second, workers busy {100 * busy:5.1f} %"
            for name, one in processes.items():
                seconds, memory = used(one)
                each = (seconds - before[name]) / done
                row += f"; {name} {1000 * each:.2f} ms a capture ({1 / each:.0f}/s on a core), {memory:.2f} GiB"
            print(row, flush=True)


if __name__ == "__main__":
    main()
