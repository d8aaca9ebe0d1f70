"""Images treated block by block: the data of a block stay in the processor's cache, and threads share the blocks."""

from __future__ import annotations

from collections.abc import Callable

from characterisation.threads import in_threads, thread_count

#: pixels treated at once: one period's images as float32 fill half a megabyte
BLOCK = 16384


def in_blocks(work: Callable[[list[slice]], None], count: int) -> None:
    """Call ``work`` with slices that together cover ``count`` pixels, once in each thread.

    Every block is the same whatever thread it falls to, so results do not depend on the threads.
    """
    blocks = [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]
    parts = max(min(thread_count(), len(blocks) // 2), 1)
    in_threads(work, [blocks[len(blocks) * k // parts : len(blocks) * (k + 1) // parts] for k in range(parts)])
