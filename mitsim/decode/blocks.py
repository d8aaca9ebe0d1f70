"""Images treated block by block: what a block needs stays in the processor's cache, and two threads share them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

#: pixels treated at once: one period's images as float32 fill half a megabyte
BLOCK = 16384

#: NumPy and OpenCV let go of the interpreter in their loops
THREADS = 2


def in_blocks(work: Callable[[list[slice]], None], count: int) -> None:
    """Call ``work`` with slices that together cover ``count`` pixels, once in each thread.

    Every block is the same whatever thread it falls to, so results do not depend on the threads.
    """
    blocks = [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]
    if len(blocks) < 2 * THREADS:
        work(blocks)
        return
    shares = [blocks[len(blocks) * k // THREADS : len(blocks) * (k + 1) // THREADS] for k in range(THREADS)]
    with ThreadPoolExecutor(THREADS) as threads:
        list(threads.map(work, shares))
