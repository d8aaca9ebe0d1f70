"""Mutations by seed, each read in a child process: what ends in a traceback, a crash or a hang is told.

``python -m mutations.harness --count 20000 --seed 1`` from ``tests``. Everything is written below a folder of its own,
which is removed; a child that is told to stop is one that was started here. No link is made, and none is followed.
"""

import argparse
import collections
import os
import random
import selectors
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: seconds in which one mutation is to be read; address space of a child [bytes], of which compilers reserve much
PATIENCE_S, MEMORY = 20.0, 12 << 30

#: how a mutation may end
GOOD = ("refused", "accepted")


def run(count: int, seed: int, names: list[str], seconds: float = float("inf")) -> dict[str, collections.Counter]:
    """Outcomes by class; those that are not good are keyed by what they were, with a seed that gives them again."""
    found = {name: collections.Counter() for name in names}
    each = -(-count // len(names))
    end = time.monotonic() + seconds
    order = list(names)
    random.Random(seed).shuffle(order)
    for number, name in enumerate(order):
        left = end - time.monotonic()
        share = left / (len(order) - number)
        _class(name, range(seed * 1_000_000, seed * 1_000_000 + each), found[name], time.monotonic() + share)
        rest = sorted(set(found[name]) - set(GOOD))
        print(f"{name}: {sum(found[name].values())} tried", *rest, sep="\n    ", file=sys.stderr, flush=True)
    return found


def _class(name, seeds, found, end):
    at = 0
    seeds = list(seeds)
    while at < len(seeds) and time.monotonic() < end:
        with tempfile.TemporaryDirectory(prefix="mitsim-mutations-") as folder:
            command = [
                sys.executable,
                "-m",
                "mutations.harness",
                "--child",
                name,
                "--folder",
                folder,
                "--from",
                str(seeds[at]),
                "--count",
                str(len(seeds) - at),
            ]
            tests = Path(__file__).resolve().parents[1]
            paths = [str(tests), str(tests.parent), os.environ.get("PYTHONPATH", "")]
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONFAULTHANDLER": "0"}
            with subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=folder, env=environment, text=True
            ) as child:
                at += _followed(child, seeds[at:], found, end)


def _followed(child, seeds, found, end):
    """Count what a child tells; returns how many seeds are done with."""
    assert child.stdout is not None
    done = 0
    waiting = selectors.DefaultSelector()
    waiting.register(child.stdout, selectors.EVENT_READ)
    first, begun = True, False
    since, used = time.monotonic(), _seconds_of(child.pid)
    while True:
        if time.monotonic() > end:
            child.kill()
            return len(seeds)
        if not waiting.select(1.0):
            patience = PATIENCE_S * (3 if first else 1)
            waited, worked = time.monotonic() - since, _seconds_of(child.pid) - used
            if waited > patience and (worked > patience / 2 or waited > 10 * patience):  # others may use the machine
                child.kill()
                found[f"HANG (seed {seeds[done]})"] += 1
                return done + 1
            continue
        first = False
        since, used = time.monotonic(), _seconds_of(child.pid)
        line = child.stdout.readline()
        begun = begun or line.startswith("sound")
        if not line:
            code = child.wait()
            if not begun:
                raise RuntimeError(f"the sound file is refused (exit code {code}): {' '.join(map(str, child.args))}")
            if done < len(seeds):
                found[f"CRASH {code} (seed {seeds[done]})"] += 1
                done += 1
            return done
        if line.startswith("= "):
            outcome = line[2:].strip()
            found[outcome if outcome in GOOD else f"{outcome} (seed {seeds[done]})"] += 1
            done += 1
            if done == len(seeds):
                child.wait()
                return done


def _seconds_of(pid: int) -> float:
    """Seconds of a processor that a process has used; 0 where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return 0.0


def child(name: str, folder: Path, start: int, count: int) -> None:
    """Read mutation after mutation, and say of each how it ended."""
    import resource
    import traceback
    import warnings

    import numpy as np
    import xarray as xr

    from characterisation.errors import InputError
    from mitsim.errors import MissingEnvironmentError
    from mutations.mutate import mutated_bytes, mutated_dataset
    from mutations.readers import READERS

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    reader = READERS[name]
    path = reader.sound(folder)
    sound = path.read_bytes()
    data = xr.load_dataset(path) if reader.dataset else None
    reader.read(path)  # what is sound is accepted
    print("sound", file=out, flush=True)
    for seed in range(start, start + count):
        rng = np.random.default_rng(seed)
        if data is None:
            path.write_bytes(mutated_bytes(sound, rng))
        else:
            path.unlink()
            try:
                mutated_dataset(data, rng).to_netcdf(path)
            except Exception:  # a dataset that netCDF cannot hold is no mutation
                print("= accepted", file=out, flush=True)
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
        print(f"= {outcome}", file=out, flush=True)


def main() -> int:
    from mutations.readers import READERS

    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--count", type=int, default=2000)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--seconds", type=float, default=float("inf"))
    asked.add_argument("--only", nargs="*", help="classes, all by default")
    asked.add_argument("--child", help=argparse.SUPPRESS)
    asked.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    asked.add_argument("--from", dest="start", type=int, default=0, help=argparse.SUPPRESS)
    given = asked.parse_args()
    if given.child:
        child(given.child, given.folder, given.start, given.count)
        return 0
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
