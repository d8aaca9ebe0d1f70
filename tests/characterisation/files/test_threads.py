"""One setting for threads: what it is read from, and that no result depends on it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from characterisation.files import threads
from characterisation.files.threads import MOST_THREADS, in_threads, thread_count
from mitsim.decoding.blocks import BLOCK, in_blocks
from mitsim.maps.prediction.noise_field import averaging_field, persistent_field


@pytest.mark.parametrize(
    ("asked", "cores", "count"),
    [("1", 4, 1), ("3", 1, 3), ("5,2", 4, 5), ("", 4, 4), ("0", 4, 4), ("many", 4, 4), ("64", 4, MOST_THREADS)],
)
def test_the_count_is_what_the_environment_asks_for_or_the_usable_cores(monkeypatch, asked, cores, count):
    monkeypatch.setattr(threads, "usable_cores", lambda: cores)
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert thread_count() == count


BLAS_THREADS = """
import atexit, os, sys
from mitsim.cli.program import main
def tell():
    import numpy, threadpoolctl
    print(*(pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"))
atexit.register(tell)
sys.argv = ["mitsim", "--version"]
main()
"""


@pytest.mark.parametrize(("asked", "used"), [({}, "1"), (dict.fromkeys(threads.BLAS_VARIABLES, "2"), "2")])
def test_a_command_has_one_thread_of_blas_unless_its_variables_are_set(asked, used):
    environment = {name: value for name, value in os.environ.items() if name not in threads.BLAS_VARIABLES}
    environment |= {"OMP_NUM_THREADS": "2"} | asked
    done = subprocess.run([sys.executable, "-c", BLAS_THREADS], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.splitlines()[-1].split()) == {used}


@pytest.mark.parametrize(("asked", "most", "used"), [(1, 8, 1), (3, 8, 3), (3, 2, 2), (8, 8, 4)])
def test_pieces_are_shared_by_so_many_threads_and_keep_their_order(monkeypatch, asked, most, used):
    """All threads meet once, so each of them must have a piece; there are four pieces."""
    monkeypatch.setenv("OMP_NUM_THREADS", str(asked))
    meet, seen = threading.Barrier(used, timeout=30), set()

    def work(piece: int) -> int:
        if piece < used:
            meet.wait()
        seen.add(threading.get_ident())
        return piece * piece

    assert in_threads(work, range(4), most) == [0, 1, 4, 9]
    assert len(seen) == used
    assert (threading.get_ident() in seen) == (used == 1)


@pytest.mark.parametrize("asked", ["1", "2"])
def test_the_exception_of_a_piece_is_raised(monkeypatch, asked):
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda piece: 1 // piece, (1, 0, 1))


@pytest.mark.parametrize("asked", ["1", "2", "3", "8"])
@pytest.mark.parametrize("count", [0, 1, BLOCK, 4 * BLOCK + 1, 9 * BLOCK])
def test_blocks_cover_every_pixel_once(monkeypatch, asked, count):
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    times = np.zeros(count, int)

    def work(blocks: list[slice]) -> None:
        for block in blocks:
            times[block] += 1

    in_blocks(work, count)
    assert (times == 1).all()


def test_fields_of_errors_have_the_same_bytes_in_any_number_of_threads(monkeypatch, rng):
    pixel, normal = rng.integers(0, 97, (7000, 2)), rng.standard_normal((7000, 3)).astype(np.float32)
    area = rng.uniform(1, 40, 7000)
    made = set()
    for asked in "1358":
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
        stream = np.random.default_rng(1)
        fields = persistent_field(pixel, normal, stream), averaging_field(area, pixel, stream)
        made.add(b"".join(field.tobytes() for field in fields))
    assert len(made) == 1
