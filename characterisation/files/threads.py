"""Set the number of threads of this process, for the renderer and for loops over arrays.

NumPy, SciPy and OpenCV release the interpreter in their loops, so threads share work on arrays. The number is that of
``OMP_NUM_THREADS``, which Dask's workers also read; by default it is the number of cores that this process may use. No
result depends on it.

BLAS has one thread in a command: its products here are of thousands of points with a 3 x 3 matrix, or of tens of
columns. Threads of BLAS wait for one another by spinning, which takes long if other programs use the cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

#: environment variables that BLAS libraries read when they are loaded: OpenBLAS, MKL, Accelerate
BLAS_VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

Piece = TypeVar("Piece")
Result = TypeVar("Result")

#: largest number of threads: each holds its arrays, and more threads wait for memory
MOST_THREADS = 8


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def asked_threads() -> int | None:
    """Return the number in ``OMP_NUM_THREADS``; None if it holds no number."""
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # a list has a number for each level
    return int(asked) or None if asked.isdecimal() else None


def thread_count() -> int:
    """Return the number of threads to use: ``OMP_NUM_THREADS`` or the usable cores, :data:`MOST_THREADS` at most."""
    return min(asked_threads() or usable_cores(), MOST_THREADS)


def keep_blas_to_one_thread() -> None:
    """Limit BLAS to one thread in this process, if NumPy is not loaded yet, and in the processes that it starts.

    A variable of :data:`BLAS_VARIABLES` that is set keeps its value. On two cores that other programs use as well, two
    threads take 90 ms for 361,000 points times a 3 x 3 matrix, one takes 1 ms (OpenBLAS 0.3 of NumPy's wheels).
    """
    for name in BLAS_VARIABLES:
        os.environ.setdefault(name, "1")


def in_threads(work: Callable[[Piece], Result], pieces: Iterable[Piece], most: int = MOST_THREADS) -> list[Result]:
    """Return the result of ``work`` for every piece, in order, by at most ``most`` threads; raise the first error."""
    items = list(pieces)
    count = min(thread_count(), most, len(items))
    if count < 2:
        return [work(piece) for piece in items]
    with ThreadPoolExecutor(count) as threads:
        return list(threads.map(work, items))
