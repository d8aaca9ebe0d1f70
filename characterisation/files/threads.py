"""In how many threads this process computes: one setting for the renderer, and for NumPy's loops in threads of our own.

NumPy, SciPy and OpenCV let go of the interpreter in their loops, so threads share work on arrays. The number is that of
``OMP_NUM_THREADS``, which BLAS and Dask's workers read as well; without it, that of the cores that this process may
use. No result depends on it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Piece = TypeVar("Piece")
Result = TypeVar("Result")

#: threads at most: each holds arrays of its own, and more of them wait for memory
MOST_THREADS = 8


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def asked_threads() -> int | None:
    """Return the number in ``OMP_NUM_THREADS``, None without one."""
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # a list has a number for each level
    return int(asked) or None if asked.isdecimal() else None


def thread_count() -> int:
    """Return in how many threads to compute: ``OMP_NUM_THREADS`` or the usable cores, :data:`MOST_THREADS` at most."""
    return min(asked_threads() or usable_cores(), MOST_THREADS)


def in_threads(work: Callable[[Piece], Result], pieces: Iterable[Piece], most: int = MOST_THREADS) -> list[Result]:
    """Return the result of ``work`` for every piece, in order, computed in at most ``most`` threads.

    The first exception of a piece is raised.
    """
    given = list(pieces)
    count = min(thread_count(), most, len(given))
    if count < 2:
        return [work(piece) for piece in given]
    with ThreadPoolExecutor(count) as threads:
        return list(threads.map(work, given))
