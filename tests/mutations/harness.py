"""Mutations by seed, each read in a child process: what ends in a traceback, a crash or a hang is told.

The children are forked from a process that has imported most of what readers need, so that each begins at once.

``python -m tests.mutations.harness --count 20000 --seed 1``. Everything is written below a folder of its own,
which is removed; a child that is told to stop is one that was started here. No link is made, and none is followed.
"""

import argparse
import collections
import faulthandler
import multiprocessing
import os
import random
import selectors
import sys
import tempfile
import time
from multiprocessing import forkserver
from pathlib import Path
from unittest import mock

#: seconds in which one mutation is to be read; address space of a child [bytes], of which compilers reserve much
PATIENCE_S, MEMORY = 20.0, 12 << 30

#: how a mutation may end
GOOD = ("refused", "accepted")

#: what the children have in common; none of it starts Mitsuba, whose threads a fork would lose
IMPORTED = [
    "tests.mutations.readers",
    "tests.report.conftest",
    "mitsim.scene.authoring.read_mesh",
    "mitsim.maps.campaign.plan",
    "mitsim.capture.recordings.any_recording",
    "netCDF4",
    "scipy.io",
]


def run(count: int, seed: int, names: list[str], seconds: float = float("inf")) -> dict[str, collections.Counter]:
    """Outcomes by class; those that are not good are keyed by what they were, with a seed that gives them again."""
    found = {name: collections.Counter() for name in names}
    each = -(-count // len(names))
    forks = _forks()
    end = time.monotonic() + seconds
    order = list(names)
    random.Random(seed).shuffle(order)
    for number, name in enumerate(order):
        left = end - time.monotonic()
        share = left / (len(order) - number)
        _class(forks, name, range(seed * 1_000_000, seed * 1_000_000 + each), found[name], time.monotonic() + share)
        rest = sorted(set(found[name]) - set(GOOD))
        print(f"{name}: {sum(found[name].values())} tried", *rest, sep="\n    ", file=sys.stderr, flush=True)
    return found


def _class(forks, name, seeds, found, end):
    at = 0
    seeds = list(seeds)
    while at < len(seeds) and time.monotonic() < end:
        with tempfile.TemporaryDirectory(prefix="mitsim-mutations-") as folder:
            told, telling = forks.Pipe(duplex=False)
            given = (name, Path(folder), seeds[at], len(seeds) - at, telling)
            reading = forks.Process(target=child, name=name, args=given)
            reading.start()
            telling.close()  # the child's end alone is left, and ends with it
            with told:
                at += _followed(reading, told, seeds[at:], found, end)
            reading.join()


def _forks():
    """The context of processes that are forked from one that has imported :data:`IMPORTED`."""
    forks = multiprocessing.get_context("forkserver")
    forks.set_forkserver_preload(IMPORTED)
    paths = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    with mock.patch.dict(os.environ, {"PYTHONPATH": os.pathsep.join(paths)}):
        forkserver.ensure_running()
    first = forks.Process(target=time.sleep, args=(0,))
    first.start()  # waits until all is imported
    first.join()
    return forks


def _followed(reading, told, seeds, found, end):
    """Count what a child tells; returns how many seeds are done with."""
    done = 0
    waiting = selectors.DefaultSelector()
    waiting.register(told, selectors.EVENT_READ)
    first, begun = True, False
    since, used = time.monotonic(), _seconds_of(reading.pid)
    while True:
        if time.monotonic() > end:
            reading.kill()
            return len(seeds)
        if not waiting.select(1.0):
            patience = PATIENCE_S * (3 if first else 1)
            waited, worked = time.monotonic() - since, _seconds_of(reading.pid) - used
            if waited > patience and (worked > patience / 2 or waited > 10 * patience):  # others may use the machine
                reading.kill()
                found[f"HANG (seed {seeds[done]})"] += 1
                return done + 1
            continue
        first = False
        since, used = time.monotonic(), _seconds_of(reading.pid)
        try:
            line = told.recv()
        except EOFError:
            reading.join()
            if not begun:
                raise RuntimeError(
                    f"{reading.name}: the sound file is refused (exit code {reading.exitcode})"
                ) from None
            if done < len(seeds):
                found[f"CRASH {reading.exitcode} (seed {seeds[done]})"] += 1
                done += 1
            return done
        if line == "sound":
            begun = True
            continue
        found[line if line in GOOD else f"{line} (seed {seeds[done]})"] += 1
        done += 1
        if done == len(seeds):
            return done


def _seconds_of(pid: int) -> float:
    """Seconds of a processor that a process has used; 0 where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return 0.0


def child(name, folder, start, count, telling) -> None:
    """Read mutation after mutation in ``folder``, and send how each ended to the pipe's end ``telling``."""
    import resource
    import traceback
    import warnings

    import numpy as np
    import xarray as xr

    from characterisation.files.atomic_io import write_netcdf
    from characterisation.files.errors import InputError, MissingEnvironmentError
    from tests.mutations.mutate import mutated_bytes, mutated_dataset
    from tests.mutations.readers import READERS

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    faulthandler.disable()
    os.chdir(folder)
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    warnings.simplefilter("ignore")
    reader = READERS[name]
    path = reader.sound(folder)
    sound = path.read_bytes()
    data = xr.load_dataset(path) if reader.dataset else None
    reader.read(path)  # what is sound is accepted
    telling.send("sound")
    for seed in range(start, start + count):
        rng = np.random.default_rng(seed)
        if data is None:
            path.write_bytes(mutated_bytes(sound, rng))
        else:
            path.unlink()
            try:
                write_netcdf(mutated_dataset(data, rng), path)  # sealed, so that no probe of its bytes is started
            except Exception:  # a dataset that netCDF cannot hold is no mutation
                telling.send("accepted")
                path.write_bytes(sound)
                continue
        outcome = "accepted"
        try:
            reader.read(path)
        except (InputError, MissingEnvironmentError):
            outcome = "refused"
        except BaseException as error:
            frames = traceback.extract_tb(error.__traceback__)
            ours = [f for f in frames if "/mitsim/" in f.filename or "/characterisation/" in f.filename] or frames
            place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
            outcome = f"{type(error).__name__} at {place}: {' '.join(str(error).split())[:120]}"
        telling.send(outcome)


def main() -> int:
    from tests.mutations.readers import READERS

    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--count", type=int, default=2000)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--seconds", type=float, default=float("inf"))
    asked.add_argument("--only", nargs="*", help="classes, all by default")
    given = asked.parse_args()
    found = run(given.count, given.seed, given.only or list(READERS), given.seconds)
    bad = 0
    for name, outcomes in sorted(found.items()):
        rest = {key: number for key, number in outcomes.items() if key not in GOOD}
        bad += sum(rest.values())
        print(f"{name}: {outcomes['refused']} refused, {outcomes['accepted']} accepted, {sum(rest.values())} neither")
        for key, number in rest.items():
            print(f"    {number} x {key}")
    print(f"{sum(sum(one.values()) for one in found.values())} mutations, {bad} ended in neither")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
